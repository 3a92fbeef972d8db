"""`plan`: from a limb and a motion to timed pressures."""

from __future__ import annotations

import time as clock
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from threadpoolctl import ThreadpoolController

from der_planner.arrays import Array
from der_planner.limb import Limb
from der_planner.model import CONTROL_PERIOD, NODES, Model, RodModel
from der_planner.model.commands import SlowVenting, slow_venting, within_limits
from der_planner.model.commands import commands as commands_for
from der_planner.planning.configuration import METHODS, Configuration, configure
from der_planner.planning.loads import (
    BucklingError,
    OverloadError,
    PlanningError,
    nearly_buckling,
)
from der_planner.planning.motions import NAMES, Motion, Reference
from der_planner.planning.obstacles import Obstacles
from der_planner.planning.optimal import Optimiser, Optimum
from der_planner.planning.plan_file import Plan
from der_planner.planning.timing import Start, resting_spline
from der_planner.planning.workspace import UnreachableError, Workspace
from der_planner.rod import ConvergenceError

_THREADS = ThreadpoolController()
_FINE = 2
"""Points of the balance's grid a control period."""
_ROUNDS = 8
"""A reference is led past what is in the way so often at most."""
_ROOM = 0.5
"""Share of the pressure that is left which one of these rounds may use."""
_SAME = 3e-3
"""Change of a bend angle up to which the way past stays the same [rad]."""
_SEARCHES = 4
"""A nearest path is sought so often, each time with less pressure."""
_HELD = 0.94
"""Share of the pressure that may be held, where a refusal does not tell it."""
_SHRINK = 0.98
"""Share of what may be held that the next search has, or a way past what is in the way."""
_NOTABLE_CUT = 8e-4
"""Cuts by limits are worth a warning from this share of the pressure limit on."""
_NOTABLE_OPPOSITE = 0.042
"""So much pressure in the opposite chamber, to make up for slow venting, is worth one; as a share
of the limit."""
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
    obstacles: Obstacles | None = None,
) -> Plan:
    """Plan the chamber pressures for a motion.

    Args:
        limb: the robot.
        motion: what the tip should do.
        model: ``der`` (discrete elastic rod) or ``pcc`` (constant curvature).
        method: ``paper``, ``projected`` or ``optimal``; empty: ``optimal``.
        nodes: of the rod.
        start: where another motion is left; None: where the vented limb rests.
        progress: called with the share that is done, 0 … 1.
        obstacles: in the way of the limb; None: nothing. The method ``optimal`` of the rod leaves
            the path where it must to keep off them; the plan's reference is the path past them.

    The plan's `warnings` say where limits cut the wanted pressures, and where the limb's numbers
    are those of another mounting.

    Raises:
        PlanningError: unknown model or method, or something else than a motion.
        UnreachableError: a point is out of reach or needs more pressure than allowed.
        OverloadError: holding the limb under its loads takes more pressure than allowed.
        ObstacleError: the limb would run into an obstacle.
        BucklingError: the limb does not stay where it rests, or on the way.
    """
    begin = clock.perf_counter()
    if not isinstance(motion, Motion):
        raise PlanningError(
            f"a motion is expected, got {type(motion).__name__}: Motion.named(name) with "
            f"{', '.join(NAMES)}; or Motion.from_tip_path(time, points)"
        )
    if not isinstance(obstacles, Obstacles | None):
        raise PlanningError(
            f"obstacles are expected, got {type(obstacles).__name__}: "
            "Obstacles.from_yaml(path) or Obstacles.from_mapping(content)"
        )
    method = choose_method(model, method)
    report = progress or (lambda _share: None)
    # Its matrices are small: more threads only get into other processes' way.
    with _THREADS.limit(limits=1, user_api="blas"):
        rod = RodModel(limb, nodes)
        body = rod if model == "der" else Model.of(limb, model)
        reference, configuration = reference_and_configuration(motion, rod, body, start)
        led = touched = ""
        if obstacles is not None and obstacles.items:
            rounds = _ROUNDS if model == "der" and method == "optimal" else 0
            configuration, led, reference = _led_past(
                obstacles, rod, configuration, reference, rounds
            )
        bend = configuration.bend_at(reference.time)
        report(0.3)
        try:
            # The optimum begins from the projected balance.
            start_method = "projected" if method == "optimal" else method
            wanted, slow = balance(configuration, reference, start_method)
            found = _solve(configuration, reference, method, wanted, report)
            if obstacles is not None:
                moving = configuration.response(found.commands, configuration.bend_at).bend_angles
                touched = _touched(obstacles, rod, configuration, reference.time, moving[:-1])
        except ConvergenceError as error:
            raise PlanningError(
                f"the rod cannot be rolled forward along this motion ({error}): take a longer "
                "period, a smaller amplitude, or check the limb file's stiffness and mass"
            ) from error
    seen = body.limb
    said = [
        str(reference.deviation or ""),
        seen.other_mounting,
        nearly_buckling(seen),
        led,
        touched,
        *_limit_warnings(configuration, reference, wanted, slow, found, method),
        _error_warning(found.tip, reference, method),
        _calibration_warning(seen, bend),
    ]
    return Plan(
        time=reference.time,
        differential_pressure=found.commands,
        reference=reference,
        tip_predicted=found.tip,
        bend_angles=bend,
        motion=motion.name,
        model=model,
        method=method,
        amplitude=motion.amplitude,
        period=motion.period,
        cycles=motion.cycles,
        body=body,
        solve_time=clock.perf_counter() - begin,
        warnings=tuple(filter(None, said)),
        curves=configuration.curves(reference.time),
    )


def reference_and_configuration(
    motion: Motion, rod: RodModel, body: Model, start: Start | None
) -> tuple[Reference, Configuration]:
    """Return a motion's reference, and the configuration of a model along it.

    Arcs tell only to about a tenth what a loaded rod takes to be held: a nearest path that the
    model refuses is sought again where arcs take less pressure.
    """
    share = 1.0
    for left in reversed(range(_SEARCHES if motion.nearest else 1)):
        try:
            reference = motion.reference(Workspace(rod, share), start)
            return reference, configure(body, reference)
        except (BucklingError, OverloadError, UnreachableError) as error:
            if not left or error.point is None:  # at rest already
                raise
            held = _HELD
            if isinstance(error, OverloadError):
                held = error.pressure_limit / error.required_pressure
            share *= _SHRINK * held
    raise AssertionError("one of the searches returns or raises")


def _solve(
    configuration: Configuration,
    reference: Reference,
    method: str,
    wanted: Array,
    report: Callable[[float], None],
) -> Optimum:
    """Return commands that keep the limits, and what the model expects of them."""
    if method == "optimal":
        solver = Optimiser(configuration, reference, wanted)
        return solver.run(lambda share: report(0.4 + 0.6 * share))
    air, before = configuration.model.air, configuration.initial.before
    commands, cut = within_limits(wanted, air, CONTROL_PERIOD, before)
    tip = configuration.response(commands, configuration.bend_at).tip[:-1]
    return Optimum(commands, tip, 0, int(cut > _NOTABLE_CUT * air.pneumatics.pressure_limit))


def _led_past(
    obstacles: Obstacles,
    rod: RodModel,
    configuration: Configuration,
    reference: Reference,
    rounds: int,
) -> tuple[Configuration, str, Reference]:
    """Lead a reference past what is in the way; return its configuration, a warning, and itself.

    Raises:
        PlanningError: an obstacle is where the limb rests, or leaves no way past that it can take.
    """
    path, led, time = reference.tip, "", reference.time
    obstacles.check_rest(rod, configuration.curves(time[:1])[0], configuration.bend_at(time[:1])[0])
    begin = configuration.near(time).tip(configuration.bend_at(time))
    for _ in range(rounds):
        bend, shape = configuration.bend_at(time), configuration.near(time)
        off = shape.tip(bend) - begin, shape.tip_jacobians(bend)
        room = _room(configuration, time)
        change = obstacles.led_past(rod, configuration.curves(time), bend, off, room)
        if np.abs(change).max() < _SAME:
            break
        angles = reference.bend_angles + change
        reference = replace(
            reference,
            tip=path + shape.tip(bend + change) - begin,
            bend_angles=angles,
            spline=resting_spline(time, angles, reference.start),
        )
        try:
            configuration = configure(configuration.model, reference)
        except PlanningError as error:
            raise PlanningError(
                f"the way past what is in the way cannot be taken: {error}; shrink or move the "
                "motion, or give the obstacles as they are"
            ) from error
        off = np.linalg.norm(reference.tip - path, axis=1)
        led = (
            f"what is in the way leads the tip up to {off.max() * 1000:.1f} mm off its path, at "
            f"{time[off.argmax()]:.1f} s; errors count from the path past it"
        )
    return configuration, led, reference


def _touched(
    obstacles: Obstacles, rod: RodModel, configuration: Configuration, time: Array, bend: Array
) -> str:
    """Refuse a motion whose own prediction, bend angles (K, M) [rad], runs into an obstacle.

    Returns what it touches with a force that is allowed, see `Obstacles.check`.

    Raises:
        ObstacleError: names instant, place, clearance and force.
    """
    shape, poses = configuration.model.kinematics, configuration.bend_at(time)
    moved = [shape.curve(to) - shape.curve(pose) for to, pose in zip(bend, poses, strict=True)]
    return obstacles.check(rod, time, configuration.curves(time) + np.stack(moved), bend)


def _room(configuration: Configuration, time: Array) -> tuple[Array, Array]:
    """Return by how much bend angles (K, M) [rad] may surely change under the pressure limit."""
    material, limb = configuration.model.material, configuration.model.limb
    effective, bend = configuration.pressures("projected", time), configuration.bend_at(time)
    pressure = material.differential_pressure(time, effective, bend)
    limit, gain = _SHRINK * limb.pneumatics.pressure_limit, _ROOM * limb.static_gain
    low, high = gain * (-limit - pressure), gain * (limit - pressure)
    low[[0, -1]] = high[[0, -1]] = 0.0  # it begins and ends as before
    return np.minimum(low, 0.0), np.maximum(high, 0.0)


def choose_method(model: str, method: str) -> str:
    """Return the method, or ``optimal`` for an empty one.

    Raises:
        PlanningError: unknown model, or a method that it has not.
    """
    if model not in METHODS:
        raise PlanningError(f"model '{model}' is unknown: choose {' or '.join(METHODS)}")
    chosen = method or "optimal"
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


# Warnings --------------------------------------------------------------------------------------


def _limit_warnings(
    configuration: Configuration,
    reference: Reference,
    wanted: Array,
    slow: SlowVenting | None,
    found: Optimum,
    method: str,
) -> list[str]:
    """Say where slow chambers and limits keep commands from what a balance wants (K, M) [Pa]."""
    missed = float(np.linalg.norm(found.tip - reference.tip, axis=1).mean())
    left = f"mean error of {missed * 1000:.1f} mm on the model itself"
    said, air = [], configuration.model.air.pneumatics
    if slow is not None and slow.opposite > _NOTABLE_OPPOSITE * air.pressure_limit:
        effect = f", which leaves a {left}" if missed > _NOTABLE_ERROR else ""
        said.append(
            f"pressure {slow.index} should fall by {slow.wanted:.0f} Pa/s at {slow.time:.1f} s, "
            f"where its chamber is vented by {slow.possible:.0f} Pa/s: the opposite chamber is "
            f"filled by up to {slow.opposite:.0f} Pa to make up for it{effect}; a longer period or "
            "a smaller amplitude needs less"
        )
    fastest = np.abs(np.diff(wanted, axis=0)).max(initial=0)
    largest, per_second = np.abs(wanted).max(), fastest / CONTROL_PERIOD
    if found.limited and (largest > air.pressure_limit or per_second > air.slew_limit):
        excess = (
            f"the motion wants {largest:.0f} Pa and {per_second:.0f} Pa/s, allowed are "
            f"{air.pressure_limit:.0f} Pa and {air.slew_limit:.0f} Pa/s; a longer period or a "
            "smaller amplitude keeps them"
        )
        if method != "optimal":
            cut = np.abs(found.commands - wanted).max()
            said.insert(0, f"limits cut the wanted pressures by up to {cut:.0f} Pa: {excess}")
        elif missed > _NOTABLE_ERROR and not said:
            said.append(f"the limits leave a {left}: {excess}")
    return said


def _error_warning(tip: Array, reference: Reference, method: str) -> str:
    missed = np.linalg.norm(tip - reference.tip, axis=1)
    if missed.max() <= _LARGE_ERROR:
        return ""
    remedy = "" if method == "optimal" else ", or the method optimal,"
    advice = f"a longer period{remedy} or a smaller amplitude misses less"
    if reference.start is None and missed[0] > 0.5 * missed.max():
        advice = (
            f"it begins {missed[0] * 1000:.1f} mm off, since it rests elsewhere than the limb "
            "under its load, which no period changes: the rod (der) rests where the limb does"
        )
    return (
        f"the model itself misses the reference by {missed.mean() * 1000:.1f} mm on average and by "
        f"{missed.max() * 1000:.1f} mm at {reference.time[missed.argmax()]:.1f} s: {advice}"
    )


def _calibration_warning(limb: Limb, bend: Array) -> str:
    """Name a segment that bends (K, M) [rad] further than its calibration did."""
    covered, most = np.array(limb.calibrated.bend_angle), np.abs(bend).max(axis=0)
    if covered.size != most.size or np.all(most <= covered * 1.05):
        return ""
    j = int(np.argmax(most - covered))
    return (
        f"segment {j} bends by {np.degrees(most[j]):.0f} degrees, its calibration covered "
        f"{np.degrees(covered[j]):.0f}"
    )
