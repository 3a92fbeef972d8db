"""A limb foreign to the project: a planar chain of rigid links, for tests that must not flatter it.

Nothing here uses the project's rod, arcs, twin, air or material laws. What is different:

- Shape: seven rigid links a segment (fourteen joints), whose springs have uneven stiffness and a
  slight hardening of their own each; the links are massive, no node carries a lumped mass.
- Hysteresis: Prandtl-Ishlinskii, three elastic-slipping (play) elements a segment along its bend.
- Damping: viscous in the joints alone, 5 % of critical for the first swing of 1.2 Hz.
- Air: proportional valves on orifices (flow ∝ √pressure drop). A chamber at 10 kPa takes 2.5 s from
  90 to 10 %, and there is no first-order lag anywhere.
- Chambers of uneven gain, rest angles of some degrees, masses, pushes, and gravity in any direction
  (its part out of the plane is held by what holds the chain in its plane).

Lengths (0.122 m each, no fittings), the limits of ±24 kPa and the mean gain, stiffness and mass per
length are those of the default limb. A seed draws the hardware; seed, run and commands together
give the same result, always: a run draws the sensors' noise. One second takes about 5 ms.
"""

from __future__ import annotations

import fcntl
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from link_chain_kernel import Air, Links, State, advance
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import eigvalsh

from der_planner.identification import CalibrationLog

Array = NDArray[np.float64]

SEGMENTS, PER_SEGMENT = 2, 7
SEGMENT_LENGTH = 0.122
STIFFNESS, MASS_PER_LENGTH, GAIN = 0.0175, 1.066, 9.1e-6  # N m², kg/m, N m/Pa
DAMPING_RATIO = 0.05
SLIP_WIDTH = np.array([0.05, 0.15, 0.4])
"""Bend at which each friction element slips [rad]."""
SLIP_PRESSURE = np.array([[120.0, 160.0, 260.0], [60.0, 100.0, 140.0]])
"""Differential pressure that each of them holds when it slips [Pa]."""
SUPPLY = 60e3
STEP = 1.0 / 600.0
"""Integrator step [s]; 20 and 30 Hz are multiples of it."""
ANGLE_NOISE, TIP_NOISE, PRESSURE_NOISE = np.deg2rad(0.1), 3e-4, 5.0
"""Standard deviations of the sensors [rad], [m], [Pa] at noise 1."""

Mass = tuple[float, float]
"""Arc length from the clamp [m], mass [kg]."""


class Seen(NamedTuple):
    """What sensors show at one instant.

    Attributes:
        time: since `reset` [s].
        differential_pressure: (M,) [Pa].
        tip: (2,) [m].
        bend_angles: (M,) [rad].
    """

    time: float
    differential_pressure: Array
    tip: Array
    bend_angles: Array


class Record(NamedTuple):
    """A run as a camera and a board see it, K instants.

    Attributes:
        time: (K,) [s].
        commanded_differential: (K, M) in force at the instant [Pa].
        measured_differential: (K, M) [Pa].
        tip: (K, 2) [m].
        bend_angles: (K, M) [rad].
    """

    time: Array
    commanded_differential: Array
    measured_differential: Array
    tip: Array
    bend_angles: Array

    def log(self) -> CalibrationLog:
        """Return what `fit` takes."""
        time, commanded, measured, tip, bend_angles = self
        return CalibrationLog(time, commanded, measured, bend_angles, tip)


class LinkChain:
    """The limb of one seed under one mounting.

    Args:
        seed: draws the hardware.
        gravity: (3,) in the limb's frame: x along the straight limb, y to its left [m/s²].
        masses: fixed to the limb.
    """

    length = SEGMENTS * SEGMENT_LENGTH

    def __init__(
        self, seed: int, gravity: ArrayLike = (0.0, 0.0, 0.0), masses: Sequence[Mass] = ()
    ) -> None:
        self.seed = seed
        self.gravity = np.array(gravity, dtype=float)
        self.masses = [(float(at), float(mass)) for at, mass in masses]
        self._draw(np.random.default_rng([2_718, seed]))
        self.reset()

    def _draw(self, generator: np.random.Generator) -> None:
        count = SEGMENTS * PER_SEGMENT
        pitch = SEGMENT_LENGTH / PER_SEGMENT
        self._owner = np.repeat(np.arange(SEGMENTS), PER_SEGMENT)
        # Half a link at the clamp does not move; the last one is half as long.
        self._links_at = pitch * (np.arange(count) + 0.5)
        self._lengths = np.diff(np.append(self._links_at, self.length))
        segment = generator.uniform(0.9, 1.1, SEGMENTS)
        uneven = generator.uniform(0.75, 1.25, (SEGMENTS, PER_SEGMENT))
        uneven *= np.mean(1.0 / uneven, axis=1, keepdims=True)  # the same compliance altogether
        self._stiffness = (STIFFNESS / pitch * segment[:, None] * uneven).ravel()
        # 2 to 5 % more torque at 60° of a segment's bend.
        per_joint = np.deg2rad(60.0) / PER_SEGMENT
        self._hardening = generator.uniform(0.02, 0.05, count) / per_joint**2
        gain = GAIN * generator.uniform(0.85, 1.15, (SEGMENTS, 1))
        self._gain = gain * generator.uniform(0.95, 1.05, (SEGMENTS, 2))
        self._rest = np.deg2rad(generator.uniform(-4.0, 4.0, SEGMENTS))
        self._slip = GAIN * SLIP_PRESSURE * generator.uniform(0.8, 1.2, (SEGMENTS, 1))
        inlet = np.sqrt(SUPPLY) * generator.uniform(0.18, 0.24, (SEGMENTS, 2))
        outlet = 50.6 * generator.uniform(0.92, 1.08, (SEGMENTS, 2))
        self._air = Air(inlet, outlet, SUPPLY)
        self._viscosity = np.zeros(count)
        free = self._links(np.zeros(2), ())
        first = _first_frequency(free)
        self._viscosity = 2.0 * DAMPING_RATIO / first * self._stiffness

    def _links(self, gravity: Array, masses: Sequence[Mass], factor: float = 1.0) -> Links:
        count = len(self._lengths)
        mass = MASS_PER_LENGTH * self._lengths
        first, second = 0.5 * mass * self._lengths, mass * self._lengths**2 / 3.0
        for at, value in masses:
            link, along = self._place(at)
            if link >= 0:
                mass[link] += value
                first[link] += value * along
                second[link] += value * along**2
        outboard = np.append(np.cumsum(mass[::-1])[::-1][1:], 0.0)
        first += self._lengths * outboard
        index = np.arange(count)
        low, high = np.minimum.outer(index, index), np.maximum.outer(index, index)
        inertia = self._lengths[low] * first[high]
        np.fill_diagonal(inertia, second + self._lengths**2 * outboard)
        return Links(
            inertia=inertia,
            first=first,
            stiffness=self._stiffness,
            viscosity=self._viscosity,
            hardening=self._hardening,
            rest=self._rest[self._owner] / PER_SEGMENT,
            owner=self._owner,
            gain=self._gain * factor,
            width=SLIP_WIDTH,
            slip=self._slip,
            gravity=gravity,
        )

    def _place(self, at: float) -> tuple[int, float]:
        """Return the link at an arc length and the distance along it; −1 for the fixed half."""
        link = int(np.searchsorted(self._links_at, at, side="right")) - 1
        return link, at - self._links_at[max(link, 0)]

    # Running -----------------------------------------------------------------------------------

    def reset(
        self,
        *,
        run: int = 0,
        noise: float = 0.0,
        swing: ArrayLike = (0.0, 0.0),
    ) -> Seen:
        """Vent the limb, let it come to rest under its loads, and return what is seen then.

        Args:
            run: of the same hardware; draws the noise.
            noise: factor on the sensors' noise.
            swing: bend rates (M,) with which it begins [rad/s].
        """
        self._generator = np.random.default_rng([self.seed, run])
        self._noise = noise
        self._factor = 1.0
        self.push(0.0, (0.0, 0.0))
        self._time = 0.0
        count = len(self._lengths)
        self._state = State(
            np.cumsum(self._rest[self._owner] / PER_SEGMENT),
            np.zeros(count),
            np.zeros((SEGMENTS, len(SLIP_WIDTH))),
            np.zeros((SEGMENTS, 2)),
        )
        self._settle()
        self._state.rate[:] = np.cumsum(np.asarray(swing, dtype=float)[self._owner] / PER_SEGMENT)
        return self.seen()

    def _settle(self) -> None:
        """Come to rest without friction, as a limb that has been shaken does."""
        self._rebuild()
        thick = self._built._replace(
            viscosity=20.0 * self._viscosity, slip=np.zeros_like(self._slip)
        )
        for _ in range(100):
            advance(self._state, np.zeros(SEGMENTS), STEP, 300, *self._push, thick, self._air)
            if np.abs(self._state.rate).max() < 1e-6:
                break
        self._state.rate[:] = 0.0
        self._state.stuck[:] = 0.0

    def advance(self, command: ArrayLike, duration: float) -> Seen:
        """Hold commands (M,) [Pa] for a time [s] and return what is seen at its end."""
        self._glide(np.array(command, dtype=float), duration)
        return self.seen()

    def _glide(self, held: Array, duration: float) -> None:
        steps = max(1, int(np.ceil(duration / STEP - 1e-6)))
        advance(self._state, held, duration / steps, steps, *self._push, self._built, self._air)
        self._time += duration

    def change_gain(self, factor: float) -> None:
        """Scale the gains from now on."""
        self._factor = factor
        self._rebuild()

    def push(self, at: float, force: ArrayLike) -> None:
        """Push with a force (2,) [N] at an arc length [m] from now on; zeros end it."""
        link, along = self._place(at)
        arms = np.where(np.arange(len(self._lengths)) < link, self._lengths, 0.0)
        if link >= 0:
            arms[link] = along
        self._push = (arms, np.array(force, dtype=float))

    def _rebuild(self) -> None:
        self._built = self._links(self.gravity[:2], self.masses, self._factor)

    def seen(self) -> Seen:
        """Return what the sensors show now, with the noise asked for in `reset`."""
        noisy, heading = self._noisy, self._state.heading
        ends = np.append(0.0, heading[PER_SEGMENT - 1 :: PER_SEGMENT])
        chambers = noisy(self._state.pressure, PRESSURE_NOISE)
        return Seen(
            self._time,
            chambers[:, 0] - chambers[:, 1],
            noisy(self.nodes()[-1], TIP_NOISE),
            noisy(np.diff(ends), ANGLE_NOISE),
        )

    def _noisy(self, values: Array, deviation: float) -> Array:
        if not self._noise:
            return values.copy()
        return values + self._noise * deviation * self._generator.standard_normal(values.shape)

    def nodes(self) -> Array:
        """Return the clamp, all joints and the tip (n + 2, 2) [m] as they are."""
        heading = self._state.heading
        steps = self._lengths[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=1)
        base = np.array([[0.0, 0.0], [self._links_at[0], 0.0]])
        return np.concatenate([base, base[1] + np.cumsum(steps, axis=0)])

    def play(
        self,
        time: ArrayLike,
        commands: ArrayLike,
        camera_rate: float = 30.0,
        *,
        noise: float = 1.0,
        run: int = 0,
        swing: ArrayLike = (0.0, 0.0),
        gains: Sequence[tuple[float, float]] = (),
    ) -> Record:
        """Play commands from rest and film them.

        Args:
            time: (K,) rising instants [s]; each command holds until the next, the last one 50 ms.
            commands: (K, M) [Pa].
            camera_rate: [Hz]; the first image is at ``time[0]``. 0: images at ``time``.
            noise, run, swing: as of `reset`.
            gains: (instant [s], factor) on the gains from then on.
        """
        instants, wanted = np.asarray(time, dtype=float), np.asarray(commands, dtype=float)
        end = instants[-1] + 0.05
        images = instants
        if camera_rate > 0:
            images = np.arange(instants[0], end + 1e-9, 1.0 / camera_rate)
        changes = sorted(gains, key=lambda change: change[0])
        self.reset(run=run, noise=noise, swing=swing)
        self._time = float(instants[0])
        seen, held, k = [], np.zeros_like(wanted[0]), 0
        boundaries = np.concatenate([instants, images, [at for at, _ in changes if at < end]])
        for now in np.unique(np.round(boundaries, 9)):
            if now > self._time:
                self._glide(held, float(now) - self._time)
            while changes and changes[0][0] <= now + 1e-9:
                self.change_gain(changes.pop(0)[1])
            if len(seen) < len(images) and abs(images[len(seen)] - now) < 1e-8:
                seen.append((self.seen(), held))
            while k < len(instants) and instants[k] <= now + 1e-9:
                held, k = wanted[k], k + 1
        table = [np.stack(column) for column in zip(*(one for one, _ in seen), strict=True)]
        return Record(images[: len(seen)], np.stack([u for _, u in seen]), *table[1:])


def _first_frequency(links: Links) -> float:
    """Return the first natural frequency of the straight chain without loads [rad/s]."""
    count = len(links.stiffness)
    turn = np.eye(count) - np.eye(count, k=-1)
    squares = eigvalsh(turn.T @ np.diag(links.stiffness) @ turn, links.inertia)
    return float(np.sqrt(squares[0]))


with Path(__file__).open() as alone:
    # In a new clone one worker compiles the kernel, while the others wait for its cache.
    fcntl.flock(alone, fcntl.LOCK_EX)
    LinkChain(0)
