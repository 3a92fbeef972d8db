"""`plan`: from a limb and a motion to timed pressures."""

from __future__ import annotations

import time as clock
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from threadpoolctl import ThreadpoolController

from der_planner.limb import Limb
from der_planner.model import NODES, STEPS, Initial, simulate
from der_planner.model.commands import SlowVenting, slow_venting, within_limits
from der_planner.model.commands import commands as commands_for
from der_planner.model.series import CONTROL_PERIOD
from der_planner.planning import models
from der_planner.planning.errors import PlanningError
from der_planner.planning.loads.rest import nearly_buckling
from der_planner.planning.models import METHODS, PlanningModel
from der_planner.planning.motions import Motion, Reference
from der_planner.planning.optimal import Optimiser
from der_planner.planning.result import Plan
from der_planner.planning.ways import Start, sample_spline
from der_planner.rod import ConvergenceError

Array = NDArray[np.float64]

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
        physics = models.build(limb, model, nodes)
        reference = motion.reference(limb, start)
        spline = _configuration(physics, reference, model)
        report(0.3)
        solved = _followed(physics, spline, reference, method, report)
    bend = sample_spline(spline, reference.time)[0]
    left = [
        str(reference.deviation or ""), limb.other_mounting, nearly_buckling(physics.limb)
    ]  # fmt: skip
    warnings = filter(None, left + solved.warnings + _calibration_warnings(physics.limb, bend))
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
        limb=physics.limb,
        kinematics=physics.kinematics,
        solve_time=clock.perf_counter() - begin,
        warnings=tuple(warnings),
        details=solved.details,
    )


def _configuration(physics: PlanningModel, reference: Reference, model: str) -> BSpline:
    """Return q̄(t) of a model; a refusal of arcs that sag out of their plane advises the rod."""
    try:
        return physics.configuration(reference)
    except PlanningError as error:
        if model == "pcc" and physics.limb.gravity[2]:
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


def _followed(
    physics: PlanningModel,
    spline: BSpline,
    reference: Reference,
    method: str,
    report: Callable[[float], None],
) -> _Solved:
    """Call `_solve`; a rod that does not converge becomes a refusal with the remedy.

    Raises:
        PlanningError: the rod cannot be simulated along the motion.
    """
    try:
        return _solve(physics, spline, reference, method, report)
    except ConvergenceError as error:
        raise PlanningError(
            f"the rod cannot be rolled forward along this motion ({error}): take a longer "
            "period, a smaller amplitude, or check the limb file's stiffness and mass"
        ) from error


def _solve(
    physics: PlanningModel,
    spline: BSpline,
    reference: Reference,
    method: str,
    report: Callable[[float], None],
) -> _Solved:
    """Return commands that keep the limits, and what the model expects of them."""
    optimal = method == "optimal"
    time, effective, bend = balance(physics, spline, reference, "projected" if optimal else method)
    wanted = commands_for(physics, time, effective, bend, CONTROL_PERIOD)
    if optimal:
        begin = physics.begin(spline, reference.start)
        solver = Optimiser(physics, begin, spline, reference, wanted, STEPS)
        outcome = solver.run(lambda share: report(0.4 + 0.6 * share))
        commands, tip, said = outcome.commands, outcome.tip, ""
        missed = _mean_distance(tip, reference)
        elsewhere = _begins_elsewhere(tip, reference) and not _excessive(physics.limb, wanted)
        if outcome.limited and missed > _NOTABLE_ERROR and not elsewhere:
            said = f"the limits leave a mean error of {missed * 1000:.1f} mm on the model itself"
        details: dict[str, float] = {"steps": outcome.steps, "limited_windows": outcome.limited}
    else:
        before = None if reference.start is None else reference.start.pressure
        commands, cut = within_limits(wanted, physics.air, CONTROL_PERIOD, before)
        tip = tip_under(physics, spline, commands, reference.start)
        said = (
            f"limits cut the wanted pressures by up to {cut:.0f} Pa" if cut > _NOTABLE_CUT else ""
        )
        details = {}
    pressure = physics.material.differential_pressure(time, effective, bend)
    slow = slow_venting(physics.air, time, pressure)
    warnings = _vent_warnings(slow, _mean_distance(tip, reference))
    if said and not (optimal and warnings):
        warnings.insert(0, f"{said}: {_excess(physics.limb, wanted)}")
    warnings += _error_warnings(tip, reference, method)
    return _Solved(commands, tip, warnings, details)


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
    physics: PlanningModel, spline: BSpline, reference: Reference, method: str
) -> tuple[Array, Array, Array]:
    """Return instants (F,) [s], wanted effective pressures (F, M) [Pa] and bend angles (F, M)."""
    ahead = CONTROL_PERIOD + physics.limb.pneumatics.delay
    count = int(np.ceil((reference.duration + ahead) / CONTROL_PERIOD * _FINE - 1e-6)) + 1
    fine = np.arange(count, dtype=np.float64) * (CONTROL_PERIOD / _FINE)
    fine[-1] = reference.duration + ahead
    effective = physics.pressures(method, spline, fine, reference.start)
    return fine, effective, sample_spline(spline, fine)[0]


def tip_under(
    physics: PlanningModel, spline: BSpline, commands: Array, start: Start | None = None
) -> Array:
    """Return the tip (K, 2) [m] of a model at the instants of commands (K, M) [Pa].

    Args:
        physics: model of the limb.
        spline: bend angles of the motion, along which friction and creep act [rad].
        commands: (K, M) [Pa].
        start: where the motion begins; None: at rest.
    """
    response = simulate(
        physics,
        np.arange(len(commands)) * CONTROL_PERIOD,
        commands=commands,
        bend=lambda time: sample_spline(spline, time)[0],
        initial=Initial(physics.begin(spline, start), None if start is None else start.pressure),
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


def _excessive(limb: Limb, wanted: Array) -> bool:
    largest, fastest = _wants(wanted)
    return largest > limb.pneumatics.pressure_limit or fastest > limb.pneumatics.slew_limit


def _excess(limb: Limb, wanted: Array) -> str:
    air = limb.pneumatics
    largest, fastest = _wants(wanted)
    return (
        f"the motion wants {largest:.0f} Pa and {fastest:.0f} Pa/s, allowed are "
        f"{air.pressure_limit:.0f} Pa and {air.slew_limit:.0f} Pa/s; a longer period or a smaller "
        "amplitude keeps them"
    )
