"""The simulated limb: a PyElastica rod with chambers, fittings, friction and creep."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from der_planner.arrays import Array
from der_planner.limb import PointMass
from der_planner.twin.body import RADIUS, NodeLoads, Push, TwinError, build
from der_planner.twin.hardware import DrawnHardware, draw
from der_planner.twin.kernel import Pegs, Ramp, advance

ATMOSPHERE = 101_325.0
"""Absolute pressure outside the chambers [Pa]."""
TIME_STEP = 2e-4
"""Explicit step [s]; stable for 0.25 ms as well (see the page of the twin)."""
RAMP = 0.02
"""Time in which new chamber pressures reach the limb [s], on a straight line: a jump would ring.
The board tells its pressures once in that time."""
_CHAMBER_LIMIT = 2e5
_SETTLING_DRAG = 8.0
"""Damping [1/s] with which a limb finds its rest: about critical for its first mode."""
_SETTLED_SPEED = 2e-5
"""Largest speed of a node [m/s] of a limb that rests."""
BACKLOG = 0.25
"""Longest delay [s] that a real-time loop catches up; time beyond it is dropped and counted."""
TICKS_PER_PERIOD = 4
"""A real-time loop simulates this often in each period of publishing."""
_LONGEST_SETTLING = 30.0
"""Simulated time [s] after which a limb that still creeps toward its rest is left to the run."""


@dataclass(frozen=True)
class TwinShape:
    """The true centreline at one instant, in `limb_base`.

    Attributes:
        arc_length: (P,) material coordinate from the clamp [m].
        points: (P, 2) x, y [m].
        heading: (P,) direction of the material tangent, from +x toward +y [rad].
    """

    arc_length: Array
    points: Array
    heading: Array


class LimbTwin:
    """A planar two-segment limb that stands in for the hardware.

    Clamped at the origin along +x; the tip is the last node, at material arc length 0.244 m.

    Args:
        seed: draws the hardware; a trial is a seed.
        run: draws how the rest angles wander in this run of the same hardware.
        hardware: takes this hardware instead of drawing it (for tests).
        atmosphere: absolute pressure outside [Pa].
        gravity: (3,) acceleration in `limb_base` [m/s²].
        masses: point masses that the limb carries beside its own from the start.

    Attributes:
        gain: by which the moment of all chambers is multiplied, 1 at first; may be changed while
            the limb moves, as the gain of a real limb does when its silicone warms or tears.

    Raises:
        TwinError: a mass is not on the limb, or gravity is not finite.
    """

    def __init__(
        self,
        seed: int = 0,
        run: int = 0,
        hardware: DrawnHardware | None = None,
        atmosphere: float = ATMOSPHERE,
        gravity: tuple[float, float, float] = (0.0, 0.0, 0.0),
        masses: Iterable[PointMass] = (),
    ) -> None:
        self._hardware = draw(seed) if hardware is None else hardware
        self.atmosphere = float(atmosphere)
        self.time, self.gain = 0.0, 1.0
        self._carry = 0.0
        self._pressure = np.full(2 * self.segment_count, self.atmosphere)
        self._ramp_left = 0
        self._wander_noise = np.random.default_rng([7_919, seed, run])
        self._pegs = Pegs(np.empty((0, 3)), np.empty(0), np.empty((0, 3, 1)))
        self._body = build(self._hardware)
        rod = self._rod = self._body.rod
        self._material = self._body.material
        self._rigid_elements = np.nonzero(self._body.element_segment < 0)[0]
        self._loads = NodeLoads(self._body.node_arc, rod.mass, rod.external_forces, gravity)
        for item in masses:
            self.push(Push(-math.inf, item.arc_length, mass=item.mass))
        self._wander = np.array([s.wander for s in self._hardware.segments])
        self._wander *= self._wander_noise.standard_normal(self.segment_count)
        self._settle()
        if self._loads.any:
            self._settle_under_loads()

    @property
    def segment_count(self) -> int:
        """M, the number of segments."""
        return len(self._hardware.segments)

    @property
    def tip(self) -> Array:
        """(2,) position of the tip [m]."""
        return np.array(self._rod.position_collection[:2, -1])

    @property
    def bend_angles(self) -> Array:
        """(M,) heading at the end of each segment less the heading at its start [rad]."""
        return np.array(np.diff(self._element_headings()[self._rigid_elements]))

    def step(self, chamber_pressure: Array, duration: float) -> None:
        """Advance the limb under constant chamber pressures, which it feels after `RAMP`.

        The explicit step is fixed: a remainder shorter than it is kept for the next call.

        Args:
            chamber_pressure: (2M,) absolute pressures: chambers 0, 1 of segment 0, then of
                segment 1 [Pa].
            duration: [s].

        Raises:
            TwinError: the pressures have another shape, are not finite or above 2 bar gauge.
        """
        target = self._target(chamber_pressure, duration)
        if not np.array_equal(chamber_pressure, self._pressure):
            self._pressure = np.array(chamber_pressure, dtype=float)
            self._ramp_left = round(RAMP / TIME_STEP)
        self._carry += duration
        steps = int(self._carry / TIME_STEP + 1e-9)
        self._carry -= steps * TIME_STEP
        ramp = self._ramp(target, self._ramp_left or steps)
        self._ramp_left = max(0, self._ramp_left - steps)
        while steps:
            left = (self._loads.next_change(self.time) - self.time) / TIME_STEP
            count = math.ceil(min(steps, left))
            drag = self._hardware.drag
            advance(self._body.arrays, self._material, ramp, self._pegs, count, TIME_STEP, drag)
            ramp = ramp._replace(steps=max(0, ramp.steps - count))
            steps -= count
            self.time += count * TIME_STEP
            self._loads.update(self.time)
        if not np.isfinite(self._rod.position_collection[0, -1]):
            raise TwinError(f"the simulated limb became unstable at t = {self.time:.3f} s")

    def push(self, push: Push) -> None:
        """Push the limb, or hang a mass on it, from an instant of `time` on.

        Raises:
            TwinError: the place is not on the limb, or a number is not finite.
        """
        self._loads.add(push)
        self._loads.update(self.time)

    def put_pegs(self, pegs: ArrayLike) -> None:
        """Put round things that do not move in the limb's way, in place of those before.

        Args:
            pegs: (P, 3) x, y and radius of each [m].

        Raises:
            TwinError: a peg stands where the limb is.
        """
        x, y, radius = np.asarray(pegs, dtype=float).reshape(-1, 3).T
        centre = np.stack([x, y, np.zeros_like(x)], axis=1)
        points = self.shape().points
        for peg, size in zip(centre[:, :2], radius, strict=True):
            if np.linalg.norm(points - peg, axis=1).min() < RADIUS + size:
                raise TwinError(
                    f"a peg of {size:g} m at ({peg[0]:g}, {peg[1]:g}) m stands where the limb of "
                    f"radius {RADIUS:g} m is"
                )
        self._pegs = Pegs(centre, np.ascontiguousarray(radius), np.zeros((len(centre), 3, 1)))

    def shape(self) -> TwinShape:
        """Return the true centreline at the nodes and in the middle of each element.

        The middles are those of cubic Hermite pieces along the material tangents.
        """
        arc, heading = self._body.node_arc, self._node_headings()
        nodes = self._rod.position_collection[:2].T
        tangent = np.stack([np.cos(heading), np.sin(heading)], axis=1)
        lengths = np.linalg.norm(np.diff(nodes, axis=0), axis=1)[:, None]
        middle = 0.5 * (nodes[1:] + nodes[:-1]) - lengths / 8 * np.diff(tangent, axis=0)
        between = np.arange(1, len(nodes))
        return TwinShape(
            np.insert(arc, between, 0.5 * (arc[1:] + arc[:-1])),
            np.insert(nodes, between, middle, axis=0),
            np.insert(heading, between, 0.5 * (heading[1:] + heading[:-1])),
        )

    def _target(self, chamber_pressure: Array, duration: float) -> dict[str, Array]:
        """Return what the material shall be under these pressures, by the fields of `Ramp`."""
        pressure = np.asarray(chamber_pressure, dtype=float)
        if pressure.shape != (2 * self.segment_count,):
            raise TwinError(
                f"expected {2 * self.segment_count} chamber pressures, got shape {pressure.shape}"
            )
        gauge = pressure - self.atmosphere
        if not np.all(np.abs(gauge) < _CHAMBER_LIMIT):
            raise TwinError(
                f"chamber pressures must be absolute, in Pa and within 2 bar of the atmosphere "
                f"({self.atmosphere:.0f} Pa): got {pressure}"
            )
        names = ("active", "stiffness", "rest", "rest_stretch")
        target = {name: getattr(self._material, name).copy() for name in names}
        differential = np.concatenate([[0.0], gauge[0::2] - gauge[1::2], [0.0]])
        for index, segment in enumerate(self._hardware.segments):
            neighbours = differential[index] + differential[index + 2]
            crossing = segment.coupling * 0.5 * sum(segment.chamber_gain)
            fade = math.exp(-duration / segment.wander_time)
            kick = segment.wander * math.sqrt(1.0 - fade * fade)
            self._wander[index] = fade * self._wander[index] + kick * float(
                self._wander_noise.standard_normal()
            )
            left, right = gauge[2 * index], gauge[2 * index + 1]
            here = self._body.vertex_segment == index
            target["active"][here] = self.gain * (
                segment.chamber_gain[0] * left
                - segment.chamber_gain[1] * right
                + crossing * neighbours
            )
            target["stiffness"][here] = segment.bending_stiffness * (
                1.0 + segment.pressure_stiffening * (left + right)
            )
            target["rest"][here] = segment.rest_curvature + self._wander[index]
            target["rest_stretch"][self._body.element_segment == index] = segment.elongation * (
                left + right
            )
        return target

    def _ramp(self, target: dict[str, Array], steps: int) -> Ramp:
        each = {
            name: (value - getattr(self._material, name)) / max(steps, 1)
            for name, value in target.items()
        }
        return Ramp(steps=steps, **each)

    def _settle(self) -> None:
        steps = int(2.0 / TIME_STEP)
        ramp = self._ramp(self._target(self._pressure, 0.0), steps // 4)
        advance(
            self._body.arrays, self._material, ramp, self._pegs, steps, TIME_STEP, _SETTLING_DRAG
        )
        self._stop()

    def _settle_under_loads(self) -> None:
        """Bring the limb to the pose in which its loads leave it.

        Friction and creep are switched off meanwhile and begin the run relaxed: the limb has hung
        there for long, and has been moved about before.
        """
        material = self._material
        calm = material._replace(
            friction_moment=np.zeros_like(material.friction_moment),
            creep_stiffness=np.zeros_like(material.creep_stiffness),
        )
        ramp = self._ramp(self._target(self._pressure, 0.0), 0)
        steps = round(0.5 / TIME_STEP)
        for _ in range(round(_LONGEST_SETTLING / (steps * TIME_STEP))):
            advance(self._body.arrays, calm, ramp, self._pegs, steps, TIME_STEP, _SETTLING_DRAG)
            if np.abs(self._rod.velocity_collection).max() < _SETTLED_SPEED:
                break
        self._stop()
        material.friction[:] = 0.0

    def _stop(self) -> None:
        """Take all speed from the limb, and relax its creep."""
        self._rod.velocity_collection[:] = 0.0
        self._rod.omega_collection[:] = 0.0
        self._material.creep[:] = 0.0

    def _element_headings(self) -> Array:
        tangent = self._rod.director_collection[2]
        heading: Array = np.unwrap(np.arctan2(tangent[1], tangent[0]))
        return heading

    def _node_headings(self) -> Array:
        element = self._element_headings()
        # Between a stiff and a flexible element the bend belongs to the flexible half.
        flexible = np.where(self._body.element_segment >= 0, self._rod.rest_lengths, 0.0)
        weight = flexible[1:] / np.maximum(flexible[1:] + flexible[:-1], 1e-12)
        inner = element[:-1] + (1.0 - weight) * np.diff(element)
        return np.concatenate([element[:1], inner, element[-1:]])


class RealTimeLoop:
    """Advances a simulation by the steady time that has passed and publishes on a fixed grid.

    Args:
        advance: called with a duration to simulate [s].
        publish: called once a period with the age of the simulated state [s].
        period: of publishing [s].
        clock: steady clock that measures the cost of a call [s].

    Attributes:
        lag: how late the last tick was [s].
        simulated_until: steady time up to which was simulated [s].
        dropped: time that was never simulated [s].
        behind: time was dropped within the last seconds.
    """

    def __init__(
        self,
        advance: Callable[[float], None],
        publish: Callable[[float], None],
        period: float,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._advance = advance
        self._publish = publish
        self._period = period
        self._clock = clock
        self._begin = self.simulated_until = 0.0
        self._next_publish = 0.0
        self._started = False
        self._last_drop = -1e9
        self.lag = self.dropped = 0.0
        self.behind = False

    @property
    def real_time_factor(self) -> float:
        """Simulated over passed time since the start; 1 when nothing was dropped."""
        passed = self.simulated_until - self._begin
        return 1.0 - self.dropped / passed if passed > 0 else 1.0

    def tick(self, now: float) -> float:
        """Simulate up to ``now`` [s, steady], publish if due, return the time to sleep [s]."""
        if not self._started:
            self._begin = self.simulated_until = self._next_publish = now
            self._started = True
        passed = now - self.simulated_until
        self.lag = max(0.0, passed - self._period / TICKS_PER_PERIOD)
        if passed > BACKLOG:
            self.dropped += passed - BACKLOG
            self.simulated_until = now - BACKLOG
            self._last_drop = now
            passed = BACKLOG
        self.behind = now - self._last_drop < 5.0
        begin = self._clock()
        if passed > 0:
            self._advance(passed)
            self.simulated_until = now
        if now >= self._next_publish:
            self._publish(self._clock() - begin)
            while self._next_publish <= now:
                self._next_publish += self._period
        wake = min(now + self._period / TICKS_PER_PERIOD, self._next_publish)
        return max(0.0, wake - now - (self._clock() - begin))
