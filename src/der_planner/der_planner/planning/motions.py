"""Motions: what the tip should do, as bend angles first and tip positions after them.

Every motion becomes a `Reference`: smooth bend angles q̄(t) of constant-curvature arcs, which
begin and end where the vented limb rests, and the tip r̄(t) of these arcs (of a limb that sags out
of its plane: the tip of a rod that bends so). The reference belongs to no model: all planners get
the same r̄(t) and find their own configuration for it, so that their errors compare.

Named motions of the paper, with s(t) = ½ (1 − cos 2πt/T), amplitude A and period T; under gravity
the angles count from where the loads let the limb sag to:

- ``asynchronous``: segment j follows A s(t − j T/4);
- ``same_direction``: all segments follow A s(t);
- ``opposite_direction``: segment j follows (−1)ʲ A s(t).

The first quarter of a period is faded in by a quintic, and a closing quarter after the last cycle
brings the limb back to rest by a quintic that meets angle, rate and acceleration: the driver can
vent without a jump. A motion of two cycles of 20 s thus lasts 45 s.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import BSpline

from der_planner.arrays import Array
from der_planner.model import CONTROL_PERIOD
from der_planner.planning import paths
from der_planner.planning.loads import PlanningError
from der_planner.planning.nearest import Deviation, line, nearest_path
from der_planner.planning.timing import (
    FINE_PERIOD,
    LONGEST,
    PathLimits,
    Start,
    at_rest,
    fine_grid,
    in_turn,
    led_in,
    on_grid,
    quintic,
    resting_spline,
    sample_spline,
    smooth_step,
    with_transitions,
)
from der_planner.planning.workspace import Workspace, check_branch

JOINT_MOTIONS = {
    "asynchronous": (0.25, 1.0),
    "same_direction": (0.0, 1.0),
    "opposite_direction": (0.0, -1.0),
}
"""Segment j lags behind the first by j times a share of the period, and has a sign to the j."""
NAMES = (*JOINT_MOTIONS, *paths.SHAPES)
DEFAULT_AMPLITUDE = math.pi / 4
"""Largest bend of a segment where none is given [rad]."""
DEFAULT_PERIOD = 20.0
"""Period of a cycle where none is given [s]."""
DEFAULT_CYCLES = 2
"""Number of cycles where none is given."""
_SAG_ROUNDS = 3
"""Corrections of a path for the limb's sag, each of which leaves some per cent of the last."""


@dataclass(frozen=True)
class Reference:
    """A motion made concrete for one limb.

    Attributes:
        time: (K,) instants of the setpoints, 50 ms apart, from 0 [s].
        tip: (K, 2) r̄ [m].
        bend_angles: (K, M) q̄ of constant-curvature arcs [rad].
        spline: q̄(t), twice continuously differentiable; `sample` reads it.
        rest: (M,) bend angles of arcs where the vented limb rests [rad].
        start: where it begins, if not where the vented limb rests.
        deviation: from the drawn path, of a motion that follows the nearest one.
    """

    time: Array
    tip: Array
    bend_angles: Array
    spline: BSpline
    rest: Array
    start: Start | None = None
    deviation: Deviation | None = None

    @property
    def duration(self) -> float:
        """Instant of the last setpoint [s]."""
        return float(self.time[-1])

    def sample(self, time: ArrayLike) -> tuple[Array, Array, Array]:
        """Return q̄, its rate and acceleration (…, M) at instants, at rest outside the motion."""
        return sample_spline(self.spline, time)


@dataclass(frozen=True)
class Motion:
    """What the tip should do: a named motion, or a path of the tip.

    Use `Motion.named`, `Motion.from_tip_path` or `Motion.from_csv`.

    Attributes:
        name: one of `NAMES`, or the name given to a path.
        amplitude: largest bend of a segment; scales the shapes; 0 for a path [rad].
        period: of one cycle; 0 for a path [s].
        cycles: number of them; 1 for a path.
        path: the tip path of shapes and paths.
        branch: of the arcs at the first point of a path, see `workspace.BRANCHES`; empty: least
            pressure. A nearest path takes whichever comes nearest.
        nearest: follow the nearest path that the limb can follow instead of refusing one that
            leaves its reach, see `nearest`.
        limits: of the tip on a nearest path whose times mean nothing; None: its times count.
    """

    name: str
    amplitude: float
    period: float
    cycles: int = 1
    path: paths.TipPath | None = None
    branch: str = ""
    nearest: bool = False
    limits: PathLimits | None = None

    @classmethod
    def named(
        cls,
        name: str,
        amplitude: float = DEFAULT_AMPLITUDE,
        period: float = DEFAULT_PERIOD,
        cycles: int = DEFAULT_CYCLES,
        branch: str = "",
    ) -> Motion:
        """Return one of the motions in `NAMES`.

        Args:
            name: of the motion.
            amplitude: largest bend of a segment [rad]; a shape is drawn around the tip of a limb
                bent by 1.2 times of it, and grows in proportion.
            period: of one cycle [s].
            cycles: how many.
            branch: for shapes, which way to reach the first point.

        Raises:
            PlanningError: unknown name, or a number that is out of range.
        """
        if name not in NAMES:
            raise PlanningError(f"motion '{name}' is unknown: choose {', '.join(NAMES)}")
        for what, value, unit in (("amplitude", amplitude, "rad"), ("period", period, "s")):
            if not (math.isfinite(value) and value > 0):
                raise PlanningError(f"{what} must be positive and finite in {unit}, got {value}")
        if amplitude > math.pi:
            raise PlanningError(
                f"amplitude is {amplitude:.4g} rad ({math.degrees(amplitude):.0f} degrees): "
                "a segment bends by 3.14 rad at most; is it in radians?"
            )
        if not (math.isfinite(cycles) and cycles == int(cycles) and cycles >= 1):
            raise PlanningError(f"cycles must be a whole number of 1 or more, got {cycles}")
        if period < 4 * CONTROL_PERIOD:
            raise PlanningError(f"period is {period} s: the shortest is {4 * CONTROL_PERIOD} s")
        if period * cycles > LONGEST:
            raise PlanningError(
                f"{cycles} cycles of {period} s are longer than {LONGEST:.0f} s: plan fewer"
            )
        return cls(name, float(amplitude), float(period), int(cycles), branch=branch)

    @classmethod
    def from_tip_path(
        cls,
        time: ArrayLike | None,
        tip: ArrayLike,
        name: str = "path",
        branch: str = "",
        limits: PathLimits | None = None,
        nearest: bool = False,
    ) -> Motion:
        """Return a motion along a path of the tip.

        The limb first goes from rest to the first point and at the end back, over times of their
        own. With ``nearest``, a path that leaves the limb's reach is not refused: the limb follows
        the nearest one that it can, a trembling line is smoothed, and times are stretched where
        pressures cannot change as fast. `Reference.deviation` and the plan's warnings say how far
        that is from what was drawn.

        Args:
            time: (P,) increasing instants [s]; None: the path gets its timing from the limits.
            tip: (P, 2) points in `limb_base` [m].
            name: for tables.
            branch: which way to reach the first point; empty: the one with the least pressure.
                A nearest path takes the one that comes nearest.
            limits: speed and acceleration for a path without times.
            nearest: follow the nearest path that the limb can follow.

        Raises:
            PlanningError: wrong shapes, not finite, not increasing, too few points; unknown branch.
        """
        check_branch(branch)
        if nearest and time is None:
            drawn, limits = line(paths.checked_points(tip)), limits or PathLimits()
            return cls(name, 0.0, 0.0, path=drawn, branch=branch, nearest=True, limits=limits)
        path = paths.TipPath.build(time, tip, limits)
        return cls(name, 0.0, 0.0, path=path, branch=branch, nearest=nearest)

    @classmethod
    def from_csv(cls, path: str | Path, nearest: bool = False) -> Motion:
        """Return a motion along a path in a CSV file: columns x, y [m] and, if timed, time [s].

        Raises:
            PlanningError: the file cannot be read; the message names line and column.
        """
        time, tip = paths.read_csv(path)
        return cls.from_tip_path(time, tip, Path(path).stem, nearest=nearest)

    def reference(self, workspace: Workspace, start: Start | None = None) -> Reference:
        """Return q̄(t) and r̄(t) for a limb.

        Args:
            workspace: of the limb.
            start: where the limb is if another motion is left; None: where it rests, vented.

        Raises:
            UnreachableError: a point of a tip path is out of reach.
            BucklingError: the vented limb does not stay where it rests.
            PlanningError: the path cannot be followed, or must be in another unit.
        """
        deviation, rest, fastest = None, workspace.rest, workspace.fastest
        if self.name in JOINT_MOTIONS and self.path is None:
            time, angles = self._joint_motion(workspace)
            if start is None and np.any(angles[0] != rest.bend_angles):
                time, angles = led_in(fastest, at_rest(rest.bend_angles), time, angles)
        else:
            time, angles, deviation = self._tip_motion(workspace)
        if start is not None:
            state = (start.bend_angles, start.rate, start.acceleration)
            time, angles = led_in(fastest, state, time, angles)
        spline = resting_spline(time, angles, start)
        instants = np.arange(round(time[-1] / CONTROL_PERIOD) + 1) * CONTROL_PERIOD
        sampled = sample_spline(spline, instants)[0]
        tip = workspace.arcs.tip(sampled) + rest.offset
        if workspace.sags:
            tip = workspace.sagging_tips(instants, sampled)
        return Reference(instants, tip, sampled, spline, rest.bend_angles, start, deviation)

    def _joint_motion(self, workspace: Workspace) -> tuple[Array, Array]:
        rest, segments = workspace.rest, workspace.limb.segment_count
        total = self.cycles * self.period
        time = fine_grid(total)
        place = np.arange(segments)
        share, alternating = JOINT_MOTIONS[self.name]
        sign = alternating**place
        phase = 2 * np.pi * (time[:, None] - place * self.period * share) / self.period
        wave = 0.5 * self.amplitude * sign * (1 - np.cos(phase))
        angles = rest.bend_by_load + wave * smooth_step(time / (self.period / 4))[:, None]
        rate = 2 * np.pi / self.period
        last = phase[-1]
        state = (
            angles[-1],
            0.5 * self.amplitude * sign * rate * np.sin(last),
            0.5 * self.amplitude * sign * rate**2 * np.cos(last),
        )
        closing = fine_grid(on_grid(self.period / 4))
        back = quintic(closing, state, at_rest(rest.bend_angles))
        return in_turn((time, angles), (closing, back))

    def _tip_motion(self, workspace: Workspace) -> tuple[Array, Array, Deviation | None]:
        rest, path = workspace.rest, self.path
        if path is None:
            path = paths.draw_shape(
                self.name,
                workspace.arcs,
                self.amplitude,
                self.period,
                self.cycles,
                rest.bend_by_load,
            )
        path.check_unit(workspace.limb.length)
        if self.nearest:
            return self._nearest_motion(workspace, path)
        time, tip = path.resample(FINE_PERIOD * 2)
        angles = workspace.follow(time, tip - rest.offset, self.branch)
        if workspace.sags:
            # Arcs reach farther than a limb that sags out of the plane does at the same bend.
            for _ in range(_SAG_ROUNDS):
                short = workspace.arcs.tip(angles) - workspace.sagging_tips(time, angles)
                angles = workspace.follow(time, tip + short, self.branch)
        joined = with_transitions(workspace.fastest, time, angles, rest.bend_angles)
        if _beyond(workspace, joined[1]) and not _beyond(workspace, angles):
            ends = np.linalg.norm(np.gradient(tip, time, axis=0)[[0, -1]], axis=1)
            raise PlanningError(
                f"the path begins or ends in motion, at up to {ends.max():.2g} m/s, or in noise: "
                "on the way there or back the limb would swing beyond its reach. Let it begin and "
                "end slower, or follow the nearest path (nearest=True; --nearest)"
            )
        return (*joined, None)

    def _nearest_motion(
        self, workspace: Workspace, path: paths.TipPath
    ) -> tuple[Array, Array, Deviation]:
        offset, limits = workspace.rest.offset, self.limits
        fastest, home = workspace.fastest, workspace.rest.bend_angles
        time, angles, deviation = nearest_path(workspace, path, offset, limits)
        if workspace.sags:
            # On average: the arcs' reach is longer than that of a limb which sags out of the plane.
            tips = workspace.sagging_tips(time, angles)
            offset = (tips - workspace.arcs.tip(angles)).mean(axis=0)
            time, angles, deviation = nearest_path(workspace, path, offset, limits)
        joined = with_transitions(fastest, time, angles, home)
        if _beyond(workspace, joined[1]):
            # A transition that begins or ends in full motion near a limit would swing beyond it.
            time, angles, deviation = nearest_path(workspace, path, offset, limits, rest=True)
            joined = with_transitions(fastest, time, angles, home)
        return (*joined, deviation)


def _beyond(workspace: Workspace, angles: Array) -> bool:
    """Tell whether bend angles (K, M) [rad] leave what the limb reaches."""
    return bool(np.any(angles < workspace.low) or np.any(angles > workspace.high))
