"""Limbs with numbers drawn at random, and such a limb simulated tick by tick: rod and air."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from der_planner.limb import Limb, Segment
from der_planner.limb_days import on_another_day
from der_planner.model import air, material
from der_planner.model import RodModel, simulate

Array = NDArray[np.float64]

_TICK = 1.0 / 60.0
"""Commands at 20 Hz and pictures at 30 Hz come at multiples of it [s]."""


def drawn_friction(
    draw: Callable[[float, float], float], stiffness: float, length: float
) -> dict[str, float]:
    """Return fields of a `Segment` for unequal chambers and for friction.

    Friction saturates at 2 to 12 % of the elastic moment at a bend of 0.5 rad.

    Args:
        draw: gives a number between two others.
        stiffness: EI of the segment [N·m²].
        length: of the segment [m].
    """
    return {
        "gain_asymmetry": draw(-0.08, 0.08),
        "friction_moment": draw(0.02, 0.12) * 0.5 * stiffness / length,
        "friction_curvature": draw(0.05, 0.25) / length,
    }


def drawn(limb: Limb, generator: np.random.Generator) -> Limb:
    """Return a limb of other numbers than a given one, as one that was never calibrated."""
    draw = generator.uniform

    def segment(known: Segment) -> Segment:
        stiffness = known.bending_stiffness * draw(0.85, 1.2)
        day = on_another_day(known, generator.standard_normal(), generator.standard_normal())
        return replace(
            day,
            bending_stiffness=stiffness,
            **drawn_friction(draw, stiffness, known.length),
        )

    air_of = replace(
        limb.pneumatics,
        time_constant=limb.pneumatics.time_constant * draw(0.6, 1.6),
        delay=draw(0.0, 0.05),
    )
    return replace(limb, segments=tuple(segment(s) for s in limb.segments), pneumatics=air_of)


def with_slow_air(limb: Limb, generator: np.random.Generator) -> Limb:
    """Return a limb whose outlets hold its chambers up, and whose segments creep and damp.

    Its first swing has a damping ratio of about 0.03 to 0.06, as a silicone limb's.
    """
    draw = generator.uniform
    air_of = replace(
        limb.pneumatics,
        time_constant=draw(0.08, 0.3),
        vent_time_constant=draw(0.1, 0.3),
        vent_rate=draw(4500.0, 6500.0),
        vent_exponent=draw(0.55, 0.75),
    )
    creeping = [
        replace(
            s,
            creep_stiffness=draw(0.0, 0.03) * s.bending_stiffness,
            creep_time=3.0,
            material_damping=draw(0.006, 0.012),
        )
        for s in limb.segments
    ]
    return replace(limb, segments=tuple(creeping), pneumatics=air_of)


def nearly(true: Limb, generator: np.random.Generator) -> Limb:
    """Return a limb as a calibration finds it.

    Its errors are normal, of 1 % (gain), 2 % (stiffness, lags of the air), 20 % (friction, creep),
    0.3° (rest), 3 % (venting) and 5 ms (dead time).
    """

    def near(value: float, share: float) -> float:
        return value * float(np.exp(share * generator.standard_normal()))

    def segment(known: Segment) -> Segment:
        rest = np.deg2rad(0.3) * generator.standard_normal() / known.length
        return replace(
            known,
            moment_gain=near(known.moment_gain, 0.01),
            bending_stiffness=near(known.bending_stiffness, 0.02),
            friction_moment=near(known.friction_moment, 0.2),
            friction_curvature=near(known.friction_curvature, 0.2),
            creep_stiffness=near(known.creep_stiffness, 0.2),
            rest_curvature=float(known.rest_curvature + rest),
        )

    of = true.pneumatics
    air_of = replace(
        of,
        time_constant=near(of.time_constant, 0.02),
        vent_time_constant=near(of.vent_time_constant, 0.02),
        vent_rate=near(of.vent_rate, 0.03),
        delay=max(0.0, of.delay + 0.005 * float(generator.standard_normal())),
    )
    return replace(true, segments=tuple(segment(s) for s in true.segments), pneumatics=air_of)


class DrawnLimb:
    """A limb's rod and air as a plant of the lock-step.

    Friction and creep act along the bend that the limb has, on a straight line from tick to tick.

    Args:
        limb: the true one, vented and at rest.
    """

    def __init__(self, limb: Limb) -> None:
        self._limb, self._model = limb, RodModel(limb)
        self._remembered = int(np.ceil(air.memory_of(limb.pneumatics) / _TICK))
        still = np.zeros((2, limb.segment_count))
        self._held = still[0]
        self._commands = [still[0]]
        self._seen = simulate(self._model, np.array([0.0, _TICK]), pressures=still)
        rested = self._seen.bend_angles[0]
        self._memory = material.Memory(rested, np.zeros_like(rested), np.zeros_like(rested))

    def advance(self, command: Array, duration: float) -> None:
        """Hold a command (M,) [Pa] for a time [s], a multiple of the tick."""
        for _ in range(round(duration / _TICK)):
            self._commands.append(np.array(command))
            del self._commands[: -self._remembered - 1]
            commands = np.array(self._commands)
            chambers = air.follow_commands(
                self._limb.pneumatics, commands[1:], _TICK, 1, commands[0]
            )
            bend = self._seen.bend_angles
            rate = (bend[-1] - bend[-2]) / _TICK
            before, self._held = self._held, chambers.pair[-1, :, 0] - chambers.pair[-1, :, 1]
            self._seen = simulate(
                self._model,
                np.array([0.0, _TICK]),
                pressures=np.stack([before, self._held]),
                bend=lambda time, at=bend[-1], rate=rate: at + np.multiply.outer(time, rate),
                start=self._seen.final,
                memory=self._memory,
                steps=1,
            )
            turned = np.stack([self._memory.bend, self._seen.bend_angles[-1]])
            known = material.remember(self._limb, np.array([0.0, _TICK]), turned, self._memory)
            self._memory = known.at(-1)

    @property
    def differential_pressure(self) -> Array:
        """(M,) in the chambers [Pa]."""
        return self._held

    @property
    def bend_angles(self) -> Array:
        """(M,) [rad]."""
        return self._seen.bend_angles[-1]

    @property
    def tip(self) -> Array:
        """(2,) [m]."""
        return self._seen.tip[-1]
