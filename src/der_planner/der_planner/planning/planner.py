"""`plan`: from a limb and a motion to timed pressures."""

from __future__ import annotations

import time as clock
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from threadpoolctl import ThreadpoolController

from der_planner import actuation
from der_planner.limb import Limb
from der_planner.planning import models, pneumatics
from der_planner.planning.errors import PlanningError
from der_planner.planning.models import METHODS, PlanningModel
from der_planner.planning.motions import CONTROL_PERIOD, Motion, Reference, Start, sample_spline
from der_planner.planning.optimal import Optimiser
from der_planner.planning.result import Plan
from der_planner.planning.rod_model import NODES, RodModel
from der_planner.rod import ConvergenceError

Vector = NDArray[np.float64]

DEFAULT_METHOD = {"der": "optimal", "pcc": "paper"}
_THREADS = ThreadpoolController()
SUBSTEPS = 5
"""Integrator steps a control period: 10 ms."""
_FINE = 2
"""Points of the balance's grid a control period."""


_STRAIGHT = 1e-3
"""A limb that rests within this bend [rad] of straight starts there."""
_NOTABLE_CUT = 20.0
"""Cuts by limits are worth a warning from here on [Pa]."""
_NOTABLE_OPPOSITE = 1000.0
"""So much pressure in the opposite chamber, to make up for slow venting, is worth one [Pa]."""
_NOTABLE_ERROR = 5e-4
"""What the limits leave is worth a warning from here on [m]."""


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
        method: ``paper``, ``projected`` or ``optimal`` for the rod, ``paper`` for PCC; empty takes
            the model's default.
        nodes: of the rod.
        start: where another motion is left; None: where the vented limb rests.
        progress: called with the share that is done, 0 … 1.

    Returns:
        The plan; its `warnings` say where limits cut the wanted pressures.

    Raises:
        PlanningError: unknown model or method.
        UnreachableError: a point is out of reach or needs more pressure than allowed.
    """
    begin = clock.perf_counter()
    method = choose_method(model, method)
    report = progress or (lambda _share: None)
    physics = models.build(limb, model, nodes)
    reference = motion.reference(limb, start or resting_start(limb))
    report(0.1)
    spline = physics.configuration(reference)
    report(0.3)
    try:
        solved = _solve(physics, spline, reference, method, report)
    except ConvergenceError as error:
        raise PlanningError(
            f"the rod cannot be rolled forward along this motion ({error}): take a longer period, "
            "a smaller amplitude, or check the limb file's stiffness and mass"
        ) from error
    bend = sample_spline(spline, reference.time)[0]
    report(1.0)
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
        warnings=tuple(solved.warnings + _calibration_warnings(physics.limb, bend)),
        details=solved.details,
    )


@dataclass(frozen=True)
class _Solved:
    commands: Vector
    tip: Vector
    warnings: list[str]
    details: dict[str, float]


def _solve(
    physics: PlanningModel,
    spline: BSpline,
    reference: Reference,
    method: str,
    report: Callable[[float], None],
) -> _Solved:
    """Return commands that keep the limits, and what the model expects of them."""
    air = physics.limb.pneumatics
    optimal = method == "optimal" and isinstance(physics, RodModel)
    time, effective, bend = balance(physics, spline, reference, "projected" if optimal else method)
    wanted = pneumatics.commands(physics.limb, time, effective, bend, CONTROL_PERIOD)
    if optimal and isinstance(physics, RodModel):
        solver = Optimiser(physics, spline, reference, wanted, SUBSTEPS)
        # Matrices of a few hundred rows: more threads only get into other processes' way.
        with _THREADS.limit(limits=1, user_api="blas"):
            outcome = solver.run(lambda share: report(0.4 + 0.6 * share))
        commands, tip, said = outcome.commands, outcome.tip, ""
        missed = _mean_distance(tip, reference)
        if outcome.limited and missed > _NOTABLE_ERROR:
            said = f"the limits leave a mean error of {missed * 1000:.1f} mm on the model itself"
        details: dict[str, float] = {"steps": outcome.steps, "limited_windows": outcome.limited}
    else:
        before = None if reference.start is None else reference.start.pressure
        commands, cut = pneumatics.within_limits(wanted, air, CONTROL_PERIOD, before)
        tip = predict(physics, spline, commands, reference.start)
        said = (
            f"limits cut the wanted pressures by up to {cut:.0f} Pa" if cut > _NOTABLE_CUT else ""
        )
        details = {}
    slow = pneumatics.slow_venting(physics.limb, time, effective, bend)
    warnings = _vent_warnings(slow, _mean_distance(tip, reference))
    if said and not (optimal and warnings):
        warnings.insert(0, f"{said}: {_excess(physics.limb, wanted)}")
    return _Solved(commands, tip, warnings, details)


def resting_start(limb: Limb) -> Start | None:
    """Return the pose of a vented limb that does not rest straight, None for one that does."""
    rest = np.array([s.rest_curvature * s.length for s in limb.segments])
    if np.abs(rest).max() < _STRAIGHT:
        return None
    zero = np.zeros_like(rest)
    return Start(rest, zero, zero, zero)


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
) -> tuple[Vector, Vector, Vector]:
    """Return instants (F,) [s], wanted effective pressures (F, M) [Pa] and bend angles (F, M)."""
    ahead = CONTROL_PERIOD + physics.limb.pneumatics.delay
    count = int(np.ceil((reference.duration + ahead) / CONTROL_PERIOD * _FINE - 1e-6)) + 1
    fine = np.arange(count, dtype=np.float64) * (CONTROL_PERIOD / _FINE)
    fine[-1] = reference.duration + ahead
    effective = physics.pressures(method, spline, fine)
    return fine, effective, sample_spline(spline, fine)[0]


def predict(
    physics: PlanningModel, spline: BSpline, commands: Vector, start: Start | None = None
) -> Vector:
    """Return the tip (K, 2) [m] that the model expects under commands, with the chambers' lag."""
    air = physics.limb.pneumatics
    before = None if start is None else start.pressure
    chambers = pneumatics.chamber_pressures(air, commands, CONTROL_PERIOD, SUBSTEPS, before)
    effective = effective_pressures(physics.limb, spline, chambers)
    return physics.simulate(effective, CONTROL_PERIOD, None if start is None else spline)


def effective_pressures(limb: Limb, spline: BSpline, chambers: Vector) -> Vector:
    """Return what the model feels, (K, S, M) [Pa], of chamber pressures along a known bend."""
    count, substeps, inputs = chambers.shape
    middle = (np.arange(count * substeps) + 0.5) * (CONTROL_PERIOD / substeps)
    bend = sample_spline(spline, middle)[0]
    flat = chambers.reshape(-1, inputs)
    return actuation.effective_pressure(limb, middle, flat, bend).reshape(chambers.shape)


def _calibration_warnings(limb: Limb, bend: Vector) -> list[str]:
    said = []
    seen = np.array(limb.calibrated.bend_angle)
    if seen.size == limb.segment_count and np.any(np.abs(bend).max(axis=0) > seen * 1.05):
        j = int(np.argmax(np.abs(bend).max(axis=0) - seen))
        said.append(
            f"segment {j} bends by {np.degrees(np.abs(bend[:, j]).max()):.0f} degrees, "
            f"its calibration covered {np.degrees(seen[j]):.0f}"
        )
    return said


def _mean_distance(tip: Vector, reference: Reference) -> float:
    return float(np.linalg.norm(tip - reference.tip, axis=1).mean())


def _vent_warnings(slow: pneumatics.SlowVenting | None, missed: float) -> list[str]:
    if slow is None or slow.opposite < _NOTABLE_OPPOSITE:
        return []
    left = f", which leaves {missed * 1000:.1f} mm of mean error on the model itself"
    return [
        f"pressure {slow.index} should fall by {slow.wanted:.0f} Pa/s at {slow.time:.1f} s, where "
        f"its chamber is vented by {slow.possible:.0f} Pa/s: the opposite chamber is filled by up "
        f"to {slow.opposite:.0f} Pa to make up for it{left if missed > _NOTABLE_ERROR else ''}; "
        "a longer period or a smaller amplitude needs less"
    ]


def _excess(limb: Limb, wanted: Vector) -> str:
    air = limb.pneumatics
    largest = float(np.abs(wanted).max())
    fastest = float(np.abs(np.diff(wanted, axis=0)).max(initial=0.0)) / CONTROL_PERIOD
    return (
        f"the motion wants {largest:.0f} Pa and {fastest:.0f} Pa/s, allowed are "
        f"{air.pressure_limit:.0f} Pa and {air.slew_limit:.0f} Pa/s; a longer period or a smaller "
        "amplitude keeps them"
    )
