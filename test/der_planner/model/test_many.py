"""Many limbs in one call: each run is that of `simulate`, and errors name the run."""

from dataclasses import replace

import numpy as np
import pytest

from der_planner.limb import Limb
from der_planner.model.response import RodModel, build, simulate, simulate_many
from der_planner.rod import ConvergenceError, Rod
from der_planner.rod.many import simulate_many as simulate_rods

TIME = 0.05 * np.arange(30)
RUNS = 5


def limb(index: int) -> Limb:
    """Limbs that differ in everything that a calibration changes, and in length."""
    default = Limb.default()
    segments = tuple(
        replace(
            s,
            length=s.length * (1 + 0.02 * index),
            moment_gain=s.moment_gain * (1 + 0.03 * index),
            damping=s.damping * (1 + 0.2 * index),
            rest_curvature=0.1 * index,
            friction_moment=300 * s.moment_gain,
            friction_curvature=0.12 / s.length,
            creep_stiffness=400 * s.moment_gain * s.length,
            creep_time=8.0,
        )
        for s in default.segments
    )
    air = replace(default.pneumatics, vent_rate=4000.0 + 500 * index, delay=0.03)
    return replace(default, segments=segments, pneumatics=air)


def commands(index: int) -> np.ndarray:
    return 6e3 * np.stack([np.sin(2.0 * TIME + index), np.cos(1.5 * TIME - index)], axis=1)


COMMANDS = np.stack([commands(index) for index in range(RUNS)])
LIMBS = [limb(index) for index in range(RUNS)]


def assert_rows_equal(many, singles):
    for index, single in enumerate(singles):
        scale = {"tip": 0.25, "bend_angles": 1.0, "effective_pressure": 1e4}
        for name, size in scale.items():
            difference = getattr(many, name)[index] - getattr(single, name)
            assert np.abs(difference).max() < 1e-12 * size, (name, index)
    assert np.array_equal(many.time, singles[0].time)


@pytest.mark.parametrize("model", ["der", "pcc"])
@pytest.mark.parametrize("threads", [1, 3])
def test_limbs_and_inputs_of_their_own(model, threads):
    many = simulate_many(LIMBS, TIME, commands=COMMANDS, model=model, threads=threads)
    singles = [
        simulate(each, TIME, commands=given, model=model)
        for each, given in zip(LIMBS, COMMANDS, strict=True)
    ]
    assert_rows_equal(many, singles)
    # The runs differ: equal rows would pass a comparison of wrong rows.
    assert np.abs(np.diff(many.tip[:, -1], axis=0)).max(axis=1).min() > 1e-3


def test_one_limb_under_many_pressures():
    many = simulate_many(LIMBS[2], TIME, pressures=COMMANDS)
    assert_rows_equal(many, [simulate(LIMBS[2], TIME, pressures=given) for given in COMMANDS])


def test_many_limbs_under_one_series_go_on_where_they_were():
    first = simulate_many(LIMBS, TIME, commands=COMMANDS[0])
    before = COMMANDS[0][-1]
    second = simulate_many(
        LIMBS,
        TIME,
        commands=COMMANDS[1],
        start=first.final,
        memory=first.memory,
        before=before,
    )
    singles = []
    for each in LIMBS:
        begin = simulate(each, TIME, commands=COMMANDS[0])
        singles.append(
            simulate(
                each,
                TIME,
                commands=COMMANDS[1],
                start=begin.final,
                memory=begin.memory,
                before=before,
            )
        )
    assert_rows_equal(second, singles)


def test_a_rod_in_space_and_a_step_that_has_to_be_cut():
    hanging = replace(Limb.default(), gravity=(0.0, 0.0, -9.81))
    many = simulate_many([hanging] * 2, TIME[:6], commands=COMMANDS[:2, :6])
    assert_rows_equal(
        many, [simulate(hanging, TIME[:6], commands=given) for given in COMMANDS[:2, :6]]
    )
    # Ten times the pressure at once: Newton fails at this step, and halves of it converge.
    rod = Rod.from_limb(Limb.default(), 21)
    state = rod.straight_state()
    pressures = np.zeros((3, 4, 2))
    pressures[1, 1:] = 1.5e5
    with pytest.raises(ConvergenceError):
        rod.simulate(state, pressures[1], 0.3, halvings=0)
    together = simulate_rods(rod, state, pressures, 0.3)
    alone = rod.simulate(state, pressures[1], 0.3)
    assert np.abs(together.outputs[1] - alone.q[:, -3:-1]).max() < 1e-12
    assert np.array_equal(together.final[1].q, alone.final.q)


def test_derivative():
    many = simulate_many(LIMBS[:2], TIME, commands=COMMANDS[:2], linearise=True)
    change = np.cos(np.arange(TIME.size * 2)).reshape(-1, 2)
    for index in range(2):
        single = simulate(LIMBS[index], TIME, commands=COMMANDS[index], linearise=True)
        assert single.derivative is not None
        tip, angles = many.derivative[index].tangent(change)
        wanted_tip, wanted_angles = single.derivative.tangent(change)
        assert np.abs(tip - wanted_tip).max() < 1e-12 * np.abs(wanted_tip).max()
        assert np.abs(angles - wanted_angles).max() < 1e-12 * np.abs(wanted_angles).max()


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"commands": COMMANDS[:3]}, r"\(3, 30, 2\) and 5 limb"),
        ({"commands": COMMANDS[:, :20]}, r"\(30,\) and \(20, 2\)"),
        ({}, "either commands or pressures"),
        ({"commands": COMMANDS, "pressures": COMMANDS}, "either commands or pressures"),
        ({"commands": COMMANDS, "before": np.zeros(3)}, r"\(2,\) or \(5, 2\), got \(3,\)"),
        (
            {"commands": COMMANDS, "start": [None] * 4},
            "start must be one, or one for each",
        ),
    ],
)
def test_arguments_that_do_not_fit(given, expected):
    with pytest.raises(ValueError, match=expected):
        simulate_many(LIMBS, TIME, **given)


def test_rods_that_differ_in_more_than_numbers():
    models = [RodModel(LIMBS[0], 21), RodModel(LIMBS[1], 25)]
    with pytest.raises(ValueError, match="nodes"):
        simulate_many(models, TIME, commands=COMMANDS[:2])
    with pytest.raises(ValueError, match="all rods or all arcs"):
        simulate_many([build(LIMBS[0], "der"), build(LIMBS[1], "pcc")], TIME, commands=COMMANDS[:2])


def test_an_error_names_the_run():
    rod = Rod.from_limb(Limb.default(), 21)
    pressures = np.zeros((3, 2, 2))
    pressures[2] = 1e12
    with pytest.raises(ConvergenceError, match="run 2: step 0"):
        simulate_rods(rod, rod.straight_state(), pressures, 0.05)
