"""The commands on tables of a limb that hangs and carries something."""

import argparse
import re

import numpy as np
import pytest
from link_chain import LinkChain
from log_table import write_csv

from der_planner.commands import calibrate_limb, check_limb
from der_planner.identification.excitation import waves
from der_planner.identification.stiffness import HELD, LEAST_REST
from der_planner.limb import Limb, gravity_of
from der_planner.model import CONTROL_PERIOD

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    folder = tmp_path_factory.mktemp("hanging")
    pressure = waves(12_000.0, 2, 24.0)
    time = [0.05 * k for k in range(len(pressure))]
    chain = LinkChain(3, gravity_of("hanging"), [(0.2, 0.05)])
    played = chain.play(time, pressure, 20.0)
    write_csv(played.log(), folder / "log.csv", folder / "columns.yaml")
    return folder


def test_mounting_stays_in_the_limb_file_and_payload_does_not(table, call):
    out = table / "limb.yaml"
    loads = ("--payload", 0.05, "--payload-at", 0.2)
    given = (table / "log.csv", "--columns", table / "columns.yaml", "--terms", "friction")
    code, said, _ = call(calibrate_limb, *given, "--mounting", "hanging", *loads, "--out", out)
    assert code == 0
    pulled = re.search(r"pulls at (\d+) g", said)
    assert float(pulled[1]) == pytest.approx(310, abs=12)
    limb = Limb.from_yaml(out)
    assert limb.gravity == gravity_of("hanging")
    assert limb.masses == ()
    later = (table / "log.csv", "--columns", table / "columns.yaml", "--limb", out)
    assert call(check_limb, *later, *loads)[0] == 0
    assert call(check_limb, *later, "--mounting", "0")[0] == 3


def test_what_a_scale_shows_sets_the_scale_of_the_limb_file(table, call):
    """Stiffness and gain follow the mass; a log of shapes and pressures shows their ratios only."""
    rows = (table / "log.csv").read_text().splitlines()
    (table / "short.csv").write_text("\n".join(rows[: 20 * 14]))
    given = (table / "short.csv", "--columns", table / "columns.yaml")
    given += ("--terms", "dynamics")
    given += ("--mounting", "hanging", "--payload", 0.05, "--payload-at", 0.2)
    heavier = 1.15 * Limb.default().mass
    found, said = [], ""
    for more in ((), ("--mass", heavier)):
        out = table / f"limb{len(found)}.yaml"
        code, told, _ = call(calibrate_limb, *given, *more, "--out", out)
        assert code == 0
        found.append(Limb.from_yaml(out))
        said += told
    assert "as in the prior: it was not weighed (--mass KG)" in said
    prior, limb = found
    assert f"the limb weighs {1000 * limb.mass:.0f} g in its file, by --mass" in said
    assert limb.mass == pytest.approx(heavier, rel=1e-9)
    assert limb.provenance["weighed_kg"] == pytest.approx(heavier)
    # The payload on both is the same 50 g: what the scale changes is a little less than 15 %.
    for before, after in zip(prior.segments, limb.segments, strict=True):
        assert 1.03 < after.bending_stiffness / before.bending_stiffness < 1.16
        assert 1.03 < after.moment_gain / before.moment_gain < 1.16


def test_loads_that_cannot_be_are_refused(table, call):
    given = (table / "log.csv", "--columns", table / "columns.yaml")
    for wrong, reason in (
        (("--payload", "nan"), "must be at least 0 kg, got nan"),
        (("--payload-at", 0.1), "give --payload, too"),
        (("--payload", 0.05, "--payload-at", -0.1), "arc_length must be at least 0 m, got -0.1"),
        (("--mass", 310), "310 kg are 1192 times what the limb file says, 0.26 kg: give kg"),
        (("--weight", 0.05, "--at", 0.4), "the weight's arc_length must be at most"),
        (("--mass", 0.3, "--fit-mass"), "choose one of the two"),
    ):
        code, _, said = call(calibrate_limb, *given, *wrong)
        assert code != 0
        assert reason in said


def test_a_run_says_in_its_rest_when_to_hang_the_weight_on():
    given = argparse.Namespace(play=None, quick=True, weight=0.05, at=0.2)
    played = calibrate_limb._excitation(Limb.default(), 20_000.0, given)
    ((index, said),) = played.prompts.items()
    assert "hang 0.05 kg on at 0.2 m" in said
    pressed = np.flatnonzero(played.differential_pressure.any(axis=1))[-1]
    rested = CONTROL_PERIOD * (index - pressed)
    assert HELD < rested < played.duration - CONTROL_PERIOD * pressed - LEAST_REST
