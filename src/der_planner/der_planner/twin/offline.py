"""Pressures played on the twin in one process, faster than real time, without ROS."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from der_planner.arrays import Array
from der_planner.limb import PointMass
from der_planner.model.air import pair_of
from der_planner.twin.body import Push, TwinError
from der_planner.twin.limb_twin import LimbTwin
from pressure_driver.emulator.pneumatics import BoardPneumatics

FINE_STEP = 0.01
"""Chamber pressures are held on the limb for this long [s], half the board's telemetry period."""
LEAD = 1.0
"""Vented time before the first setpoint [s]."""


@dataclass(frozen=True)
class Playback:
    """What happened while pressures were played on the twin, sampled at the setpoints' instants.

    Attributes:
        time: (K,) [s], as given.
        tip: (K, 2) true tip [m].
        bend_angles: (K, M) true bend angles [rad].
        commanded_differential: (K, M) as given [Pa].
        measured_differential: (K, M) differential pressures in the chambers [Pa].
    """

    time: Array
    tip: Array
    bend_angles: Array
    commanded_differential: Array
    measured_differential: Array


class OfflineTwin:
    """The twin of a seed with its board's air, for a loop that commands it step by step.

    Args:
        seed: draws limb and pneumatics.
        run: draws the wandering rest angles of this run of the same hardware.
        segment_count: M.
        gravity: (3,) acceleration in `limb_base` [m/s²].
        masses: what the limb carries from the start beside its own mass.

    Attributes:
        pneumatics, twin: the two of it.

    Raises:
        TwinError: the twin has another number of segments.
    """

    def __init__(
        self,
        seed: int = 0,
        run: int = 0,
        *,
        segment_count: int = 2,
        gravity: tuple[float, float, float] = (0.0, 0.0, 0.0),
        masses: Iterable[PointMass] = (),
    ) -> None:
        self.pneumatics = BoardPneumatics(segment_count, seed)
        atmosphere = self.pneumatics.atmosphere
        self.twin = LimbTwin(seed, run, atmosphere=atmosphere, gravity=gravity, masses=masses)
        if self.twin.segment_count != segment_count:
            raise TwinError(
                f"the twin has {self.twin.segment_count} segments, the pressures {segment_count}"
            )

    @property
    def differential_pressure(self) -> Array:
        """(M,) in the chambers [Pa]."""
        chambers = self.pneumatics.pressure
        difference: Array = chambers[0::2] - chambers[1::2]
        return difference

    @property
    def bend_angles(self) -> Array:
        """(M,) true ones [rad]."""
        return self.twin.bend_angles

    @property
    def tip(self) -> Array:
        """(2,) true one [m]."""
        return self.twin.tip

    def command(self, differential: Array) -> None:
        """Give the board a command (M,) [Pa]."""
        self.pneumatics.command(self.pneumatics.atmosphere + pair_of(differential).ravel())

    def rest(self, duration: float) -> None:
        """Let time pass [s] under the last command."""
        count = max(1, int(np.ceil(duration / FINE_STEP - 1e-9)))
        for _ in range(count):
            self.twin.step(self.pneumatics.step(duration / count), duration / count)

    def advance(self, command: Array, duration: float) -> None:
        """Hold a command (M,) [Pa] for a time [s]."""
        self.command(command)
        self.rest(duration)


def play(
    time: ArrayLike,
    differential_pressure: ArrayLike,
    seed: int = 0,
    *,
    run: int = 0,
    gravity: tuple[float, float, float] = (0.0, 0.0, 0.0),
    masses: Iterable[PointMass] = (),
    pushes: Iterable[Push] = (),
) -> Playback:
    """Play differential pressures on the twin of a seed, from rest.

    Each setpoint takes effect at its instant and holds until the next, as on the graph; row k of
    the result is the twin at that instant, before the setpoint acts.

    Args:
        time: (K,) rising instants [s].
        differential_pressure: (K, M) [Pa].
        seed: draws limb and pneumatics.
        run: draws the wandering rest angles of this run of the same hardware.
        gravity: (3,) acceleration in `limb_base` [m/s²].
        masses: what the limb carries from the start beside its own mass.
        pushes: what pushes or loads it on the way; their instants are on the axis of ``time``.

    Raises:
        TwinError: the arrays do not fit together or to the twin, or a load is not on the limb.
    """
    instants, wanted = _checked(time, differential_pressure)
    limb = OfflineTwin(seed, run, segment_count=wanted.shape[1], gravity=gravity, masses=masses)
    tip = np.empty((instants.size, 2))
    angles, measured = np.empty_like(wanted), np.empty_like(wanted)
    for push in pushes:
        limb.twin.push(replace(push, instant=push.instant - instants[0] + LEAD))
    limb.rest(LEAD)
    for k, setpoint in enumerate(wanted):
        tip[k], angles[k], measured[k] = limb.tip, limb.bend_angles, limb.differential_pressure
        limb.command(setpoint)
        if k + 1 < instants.size:
            limb.rest(instants[k + 1] - instants[k])
    return Playback(
        time=instants,
        tip=tip,
        bend_angles=angles,
        commanded_differential=wanted,
        measured_differential=measured,
    )


def _checked(time: ArrayLike, differential_pressure: ArrayLike) -> tuple[Array, Array]:
    """Return time (K,) and pressures (K, M) as arrays.

    Raises:
        TwinError: they do not fit together, or are not finite and in order.
    """
    instants = np.asarray(time, dtype=float)
    wanted = np.asarray(differential_pressure, dtype=float)
    if instants.ndim != 1 or not instants.size or wanted.ndim != 2 or len(wanted) != instants.size:
        raise TwinError(
            f"expected time (K,) and pressures (K, M), got {instants.shape} and {wanted.shape}"
        )
    if not np.all(np.isfinite(wanted)) or not np.all(np.diff(instants) > 0):
        raise TwinError("time must rise and pressures must be finite")
    return instants, wanted
