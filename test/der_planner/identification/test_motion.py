"""Stiffness from motion, on a limb that shares nothing with the project and rubs otherwise."""

import numpy as np
from link_chain import LinkChain

from der_planner.identification.excitation import calibration_run
from der_planner.identification.log import prepare
from der_planner.identification.stiffness import stiffness_in_motion
from der_planner.limb import Limb

LIMB = Limb.default()


def test_stiffness_is_found_though_friction_stops_each_swing():
    run, chain = calibration_run(16_800.0), LinkChain(1)
    log = chain.play(run.time, run.differential_pressure, run=1, noise=3.0).log()
    compliance = np.sum(1.0 / chain._stiffness.reshape(2, -1), axis=1)
    true = np.log(
        [s.length / c / s.bending_stiffness for s, c in zip(LIMB.segments, compliance, strict=True)]
    )
    change, deviation = stiffness_in_motion(LIMB, prepare(log, LIMB))
    assert deviation.max() < 0.1
    assert np.abs(change - true).max() < 0.12
