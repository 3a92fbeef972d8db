"""`plan`: from a limb and a motion to timed pressures."""

from __future__ import annotations

import time as clock
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from threadpoolctl import ThreadpoolController

from der_planner.arrays import Array
from der_planner.limb import Limb
from der_planner.model import CONTROL_PERIOD, NODES, Model, RodModel, simulate
from der_planner.model.commands import SlowVenting, slow_venting, within_limits
from der_planner.model.commands import commands as commands_for
from der_planner.planning.configuration import METHODS, Configuration, configure
from der_planner.planning.errors import PlanningError
from der_planner.planning.loads import nearly_buckling
from der_planner.planning.motions import Motion, Reference
from der_planner.planning.optimal import Optimiser
from der_planner.planning.plan_file import Plan
from der_planner.planning.timing import Start
from der_planner.planning.workspace import Workspace
from der_planner.rod import ConvergenceError

DEFAULT_METHOD = {"der": "optimal", "pcc": "optimal"}
_THREADS = ThreadpoolController()
_FINE = 2
"""Points of the balance's grid a control period."""
_NOTABLE_CUT = 20.0
"""Cuts by limits are worth a warning from here on [Pa]."""
_NOTABLE_OPPOSITE = 1000.0
"""So much pressure in the opposite chamber, to make up for slow venting, is worth one [Pa]."""
_NOTABLE_ERROR = 5e-4
"""What the limits leave is worth a warning from here on [m]."""
_LARGE_ERROR = 5e-3
"""A plan whose own model misses the reference by more at any instant says so [m]."""


def plan(
    limb: Limb,
    motion: Motion,
    model: str = "der",
    method: str = "",
    *,
    nodes: int = NODES,
    start: Start | None = None,
    progress: Callable[[float], None] | None = None,
) -> Plan:
    """Plan the chamber pressures for a motion.

    Args:
        limb: the robot.
        motion: what the tip should do.
        model: ``der`` (discrete elastic rod) or ``pcc`` (constant curvature).
        method: ``paper``, ``projected`` or ``optimal``; empty: the default.
        nodes: of the rod.
        start: where another motion is left; None: where the vented limb rests.
        progress: called with the share that is done, 0 … 1.

    The plan's `warnings` say where limits cut the wanted pressures, and where the limb's numbers
    are those of another mounting.

    Raises:
        PlanningError: unknown model or method.
        UnreachableError: a point is out of reach or needs more pressure than allowed.
        OverloadError: holding the limb under its loads takes more pressure than allowed.
        BucklingError: the limb does not stay where it rests, or on the way.
    """
    begin = clock.perf_counter()
    method = choose_method(model, method)
    report = progress or (lambda _share: None)
    # Its matrices are small: more threads only get into other processes' way.
    with _THREADS.limit(limits=1, user_api="blas"):
        rod = RodModel(limb, nodes)
        body = rod if model == "der" else Model.of(limb, model)
        reference = motion.reference(Workspace(rod), start)
        configuration = _configured(body, reference)
        report(0.3)
        solved = _solve(configuration, reference, method, report)
    bend, seen = configuration.bend_at(reference.time), body.limb
    own = [str(reference.deviation or ""), limb.other_mounting, nearly_buckling(seen)]
    warnings = filter(None, own + solved.warnings + _calibration_warnings(seen, bend))
    return Plan(
        time=reference.time,
        differential_pressure=solved.commands,
        reference=reference,
        tip_predicted=solved.tip,
        bend_angles=bend,
        motion=motion.name,
        model=model,
        method=method,
        amplitude=motion.amplitude,
        period=motion.period,
        cycles=motion.cycles,
        body=body,
        solve_time=clock.perf_counter() - begin,
        warnings=tuple(warnings),
        details=solved.details,
    )


def _configured(model: Model, reference: Reference) -> Configuration:
    """Return the configuration; a refusal of arcs that sag out of their plane advises the rod."""
    try:
        return configure(model, reference)
    except PlanningError as error:
        if model.name == "pcc" and model.limb.gravity[2]:
            error.args = (
                f"{error}. Arcs know nothing of the sag out of their plane that this gravity "
                "brings: plan with the rod (der)",
            )
        raise


@dataclass(frozen=True)
class _Solved:
    commands: Array
    tip: Array
    warnings: list[str]
    details: dict[str, float]


def _solve(
    configuration: Configuration,
    reference: Reference,
    method: str,
    report: Callable[[float], None],
) -> _Solved:
    """Return commands that keep the limits, and what the model expects of them.

    Raises:
        PlanningError: the rod cannot be simulated along the motion; names the remedy.
    """
    try:
        if method == "optimal":
            return _optimal(configuration, reference, report)
        return _balanced(configuration, reference, method)
    except ConvergenceError as error:
        raise PlanningError(
            f"the rod cannot be rolled forward along this motion ({error}): take a longer "
            "period, a smaller amplitude, or check the limb file's stiffness and mass"
        ) from error


def _optimal(
    configuration: Configuration, reference: Reference, report: Callable[[float], None]
) -> _Solved:
    wanted, slow = balance(configuration, reference, "projected")
    solver = Optimiser(configuration, reference, wanted)
    found = solver.run(lambda share: report(0.4 + 0.6 * share))
    missed = _mean_distance(found.tip, reference)
    warnings = _vent_warnings(slow, missed)
    model = configuration.model
    elsewhere = _begins_elsewhere(found.tip, reference) and not _excessive(model, wanted)
    if found.limited and missed > _NOTABLE_ERROR and not elsewhere and not warnings:
        said = f"the limits leave a mean error of {missed * 1000:.1f} mm on the model itself"
        warnings.insert(0, f"{said}: {_excess(model, wanted)}")
    warnings += _error_warnings(found.tip, reference, "optimal")
    return _Solved(found.commands, found.tip, warnings, found.details)


def _balanced(configuration: Configuration, reference: Reference, method: str) -> _Solved:
    wanted, slow = balance(configuration, reference, method)
    model, before = configuration.model, configuration.initial.before
    commands, cut = within_limits(wanted, model.air, CONTROL_PERIOD, before)
    tip = tip_under(configuration, commands)
    warnings = _vent_warnings(slow, _mean_distance(tip, reference))
    if cut > _NOTABLE_CUT:
        said = f"limits cut the wanted pressures by up to {cut:.0f} Pa"
        warnings.insert(0, f"{said}: {_excess(model, wanted)}")
    warnings += _error_warnings(tip, reference, method)
    return _Solved(commands, tip, warnings, {})


def choose_method(model: str, method: str) -> str:
    """Return the method, or the model's default for an empty one.

    Raises:
        PlanningError: unknown model, or a method that it has not.
    """
    if model not in METHODS:
        raise PlanningError(f"model '{model}' is unknown: choose {' or '.join(METHODS)}")
    chosen = method or DEFAULT_METHOD[model]
    if chosen not in METHODS[model]:
        raise PlanningError(
            f"the model '{model}' has no method '{method}': choose {', '.join(METHODS[model])}"
        )
    return chosen


def balance(
    configuration: Configuration, reference: Reference, method: str
) -> tuple[Array, SlowVenting | None]:
    """Return the commands (K, M) [Pa] that a balance wants, before limits.

    Also where it wants a chamber to fall faster than it is vented.
    """
    air, material = configuration.model.air, configuration.model.material
    end = reference.duration + CONTROL_PERIOD + air.pneumatics.delay
    count = int(np.ceil(end / CONTROL_PERIOD * _FINE - 1e-6)) + 1
    fine = np.arange(count, dtype=np.float64) * (CONTROL_PERIOD / _FINE)
    fine[-1] = end
    effective = configuration.pressures(method, fine)
    pressure = material.differential_pressure(fine, effective, configuration.bend_at(fine))
    return commands_for(air, fine, pressure, CONTROL_PERIOD), slow_venting(air, fine, pressure)


def tip_under(configuration: Configuration, commands: Array) -> Array:
    """Return the tip (K, 2) [m] of a model at the instants of commands (K, M) [Pa]."""
    response = simulate(
        configuration.model,
        np.arange(len(commands)) * CONTROL_PERIOD,
        commands=commands,
        bend=configuration.bend_at,
        initial=configuration.initial,
    )
    return response.tip[:-1]


def _calibration_warnings(limb: Limb, bend: Array) -> list[str]:
    said = []
    seen = np.array(limb.calibrated.bend_angle)
    if seen.size == limb.segment_count and np.any(np.abs(bend).max(axis=0) > seen * 1.05):
        j = int(np.argmax(np.abs(bend).max(axis=0) - seen))
        said.append(
            f"segment {j} bends by {np.degrees(np.abs(bend[:, j]).max()):.0f} degrees, "
            f"its calibration covered {np.degrees(seen[j]):.0f}"
        )
    return said


def _error_warnings(tip: Array, reference: Reference, method: str) -> list[str]:
    missed = np.linalg.norm(tip - reference.tip, axis=1)
    if missed.max() <= _LARGE_ERROR:
        return []
    remedy = "" if method == "optimal" else ", or the method optimal,"
    advice = f"a longer period{remedy} or a smaller amplitude misses less"
    if _begins_elsewhere(tip, reference):
        advice = (
            f"it begins {missed[0] * 1000:.1f} mm off, since it rests elsewhere than the limb "
            "under its load, which no period changes: the rod (der) rests where the limb does"
        )
    return [
        f"the model itself misses the reference by {missed.mean() * 1000:.1f} mm on average and by "
        f"{missed.max() * 1000:.1f} mm at {reference.time[missed.argmax()]:.1f} s: {advice}"
    ]


def _begins_elsewhere(tip: Array, reference: Reference) -> bool:
    """Tell whether most of what tips (K, 2) miss is there when the motion begins at rest."""
    missed = np.linalg.norm(tip - reference.tip, axis=1)
    return reference.start is None and bool(missed[0] > 0.5 * missed.max())


def _mean_distance(tip: Array, reference: Reference) -> float:
    return float(np.linalg.norm(tip - reference.tip, axis=1).mean())


def _vent_warnings(slow: SlowVenting | None, missed: float) -> list[str]:
    if slow is None or slow.opposite < _NOTABLE_OPPOSITE:
        return []
    left = f", which leaves {missed * 1000:.1f} mm of mean error on the model itself"
    return [
        f"pressure {slow.index} should fall by {slow.wanted:.0f} Pa/s at {slow.time:.1f} s, where "
        f"its chamber is vented by {slow.possible:.0f} Pa/s: the opposite chamber is filled by up "
        f"to {slow.opposite:.0f} Pa to make up for it{left if missed > _NOTABLE_ERROR else ''}; "
        "a longer period or a smaller amplitude needs less"
    ]


def _wants(wanted: Array) -> tuple[float, float]:
    """Return the largest pressure [Pa] and the largest change [Pa/s] of wanted commands (K, M)."""
    fastest = np.abs(np.diff(wanted, axis=0)).max(initial=0.0) / CONTROL_PERIOD
    return float(np.abs(wanted).max()), float(fastest)


def _excessive(model: Model, wanted: Array) -> bool:
    air = model.air.pneumatics
    largest, fastest = _wants(wanted)
    return largest > air.pressure_limit or fastest > air.slew_limit


def _excess(model: Model, wanted: Array) -> str:
    air = model.air.pneumatics
    largest, fastest = _wants(wanted)
    return (
        f"the motion wants {largest:.0f} Pa and {fastest:.0f} Pa/s, allowed are "
        f"{air.pressure_limit:.0f} Pa and {air.slew_limit:.0f} Pa/s; a longer period or a smaller "
        "amplitude keeps them"
    )
