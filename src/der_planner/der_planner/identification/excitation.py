"""The pressures of a calibration run, and the twin that plays them in one process, in seconds.

The run holds stairs, slow waves, steps and a band-limited sweep.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from der_planner.arrays import Array
from der_planner.files import write_columns
from der_planner.identification.fit import fit
from der_planner.identification.log import CalibrationLog, LogError
from der_planner.identification.report import FitReport
from der_planner.limb import Limb
from der_planner.model import CONTROL_PERIOD as PERIOD
from der_planner.model.commands import limit_slew

ANGLE_NOISE = np.deg2rad(0.1)
"""Standard deviation of a bend angle from tags [rad]."""
TIP_NOISE = 3e-4
"""Standard deviation of a tip from tags [m]."""
PRESSURE_NOISE = 5.0
"""Standard deviation of the board's telemetry [Pa]."""
CALIBRATION_RUN = 1
"""The run of the twin that a calibration sees; experiments are run 0 of the same hardware."""
AMPLITUDE = 0.7
"""Share of the pressure limit that a calibration uses."""


@dataclass(frozen=True)
class Excitation:
    """A sequence of differential pressures, 50 ms apart.

    Attributes:
        differential_pressure: (K, M) [Pa].
        name: of what it is for; the plan's id begins with it.
        prompts: what an operator is to do, by the index of the setpoint with which it is said.
    """

    differential_pressure: Array
    name: str = "calibration"
    prompts: Mapping[int, str] = field(default_factory=dict)

    @property
    def time(self) -> Array:
        """(K,) instants of the pressures [s]."""
        return PERIOD * np.arange(len(self.differential_pressure), dtype=float)

    @property
    def duration(self) -> float:
        """Length of the run [s]."""
        return PERIOD * len(self.differential_pressure)

    def with_rest(self, duration: float) -> Excitation:
        """Return the run with a rest without pressure after it [s]."""
        rows = np.zeros((round(duration / PERIOD), self.differential_pressure.shape[1]))
        return Excitation(np.concatenate([self.differential_pressure, rows]))


def write_excitation(excitation: Excitation, path: Path) -> None:
    """Write a run as CSV: time_s and one column of pressures [Pa] a segment."""
    segments = enumerate(excitation.differential_pressure.T)
    pressures = {f"differential_pressure_{i}_Pa": column for i, column in segments}
    write_columns(path, {"time_s": excitation.time, **pressures})


def read_excitation(path: Path, segment_count: int) -> Excitation:
    """Read what `write_excitation` wrote, or a table of one's own in the same form.

    Raises:
        LogError: the file cannot be read, has other columns, numbers that are not finite, or
            times that are not 0, 0.05, 0.10 … s.
    """
    try:
        table = np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2)
    except (OSError, ValueError) as error:
        raise LogError(f"cannot read the excitation {path}: {error}") from error
    if table.shape[0] < 2 or table.shape[1] != segment_count + 1:
        raise LogError(
            f"the excitation {path} has {table.shape[0]} rows of {table.shape[1]} columns, "
            f"expected time_s and {segment_count} pressures below one line of names"
        )
    regular = np.abs(table[:, 0] - PERIOD * np.arange(len(table))).max() <= 1e-6
    if not (regular and np.isfinite(table).all()):
        raise LogError(
            f"the excitation {path}: times must be 0, {PERIOD}, {2 * PERIOD} … s, and all numbers "
            "finite"
        )
    return Excitation(table[:, 1:])


def within_limits(excitation: Excitation, pressure_limit: float, slew_limit: float) -> Excitation:
    """Return the run with steps drawn out to ramps where they are steeper than allowed.

    Args:
        excitation: to be played from rest.
        pressure_limit: largest |differential pressure| [Pa].
        slew_limit: largest change of a setpoint [Pa/s].

    Raises:
        LogError: a pressure beyond the limit.
    """
    wanted = excitation.differential_pressure
    largest = float(np.abs(wanted).max())
    if largest > pressure_limit:
        raise LogError(
            f"the excitation asks for {largest:.0f} Pa, the limit is ±{pressure_limit:.0f} Pa"
        )
    ramps = limit_slew(wanted, np.zeros(wanted.shape[1]), slew_limit * PERIOD)
    return replace(excitation, differential_pressure=ramps)


def staircase(amplitude: float, segment_count: int = 2) -> Array:
    """Return a staircase (K, M) [Pa] both ways: each input alone, all together and alternating.

    Args:
        amplitude: largest |differential pressure| [Pa], in two stairs of 3 s each.
        segment_count: M.
    """
    ways = [*np.eye(segment_count)]
    if segment_count > 1:
        ways += [np.ones(segment_count), (-1.0) ** np.arange(segment_count)]
    cycle = np.array([0.5, 1.0, 0.5, 0.0, -0.5, -1.0, -0.5, 0.0])
    heights = np.concatenate([np.outer(cycle, way) for way in ways])
    return np.repeat(amplitude * heights, round(3.0 / PERIOD), axis=0)


def waves(amplitude: float, segment_count: int = 2, duration: float = 64.0) -> Array:
    """Return slow waves (K, M) [Pa]: different periods, first one-sided, then both ways.

    Loops of several widths tell friction from creep and from stiffening.
    """
    t = np.arange(round(duration / PERIOD)) * PERIOD
    columns = []
    for index in range(segment_count):
        period = duration / (3 + index)
        wave = np.sin(2 * np.pi * t / period - 0.5 * np.pi) + 1.0
        offset = np.clip((t - 0.4 * duration) / (0.2 * duration), 0.0, 1.0)
        columns.append((-1.0) ** index * 0.5 * amplitude * (wave - offset * (1 + 0.5 * offset)))
    return _fade(np.stack(columns, axis=1), 2.0)


def steps(amplitude: float, segment_count: int = 2) -> Array:
    """Return one step of 4 s up and down of each input in turn (K, M) [Pa], for air and swing."""
    up_and_down = np.kron(np.eye(segment_count), [[amplitude], [0.0]])
    return np.repeat(up_and_down, round(4.0 / PERIOD), axis=0)


def sweep(amplitude: float, segment_count: int = 2, duration: float = 16.0) -> Array:
    """Return a sweep (K, M) [Pa] from 0.1 to 1.2 Hz, its inputs out of step."""
    t = np.arange(round(duration / PERIOD)) * PERIOD
    low, high = 0.1, 1.2
    phase = 2 * np.pi * low * duration / np.log(high / low) * ((high / low) ** (t / duration) - 1)
    columns = [np.sin(phase * (1 + 0.15 * index)) for index in range(segment_count)]
    return _fade(amplitude * np.stack(columns, axis=1), 1.0)


def calibration_run(amplitude: float, segment_count: int = 2, quick: bool = False) -> Excitation:
    """Return the whole run, about three minutes for two segments.

    Args:
        amplitude: largest |differential pressure| [Pa].
        segment_count: M.
        quick: leave out the staircase and the steps: a minute and a half.
    """
    pause = np.zeros((round(2.0 / PERIOD), segment_count))
    stairs_and_steps = [staircase(amplitude, segment_count), steps(0.4 * amplitude, segment_count)]
    pressure = np.concatenate(
        [
            pause,
            waves(amplitude, segment_count),
            pause,
            *([] if quick else stairs_and_steps),
            sweep(0.25 * amplitude, segment_count),
            pause,
        ]
    )
    return Excitation(pressure)


def _fade(wave: Array, duration: float) -> Array:
    """Return a wave (K, M) that begins and ends gently, over a duration [s] each."""
    rows = np.arange(len(wave))
    near = np.minimum(rows, rows[::-1]) / round(duration / PERIOD)
    faded: Array = wave * (0.5 - 0.5 * np.cos(np.pi * np.minimum(near, 1.0)))[:, None]
    return faded


def record_twin(
    seed: int,
    excitation: Excitation,
    run: int = CALIBRATION_RUN,
    noise: float = 1.0,
    limb: Limb | None = None,
) -> CalibrationLog:
    """Play an excitation on the twin and return what camera and board would have measured.

    Args:
        seed: of the hardware.
        excitation: pressures to play.
        run: of the same hardware.
        noise: factor on the sensors' noise.
        limb: the twin is mounted as this limb is, and carries its masses; None: no loads.
    """
    # PyElastica takes a second to import: only who plays pays for it.
    from der_planner.twin.offline import play  # noqa: PLC0415

    loads = limb or Limb.default()
    played = play(
        excitation.time,
        excitation.differential_pressure,
        seed,
        run=run,
        gravity=loads.gravity,
        masses=loads.masses,
    )
    generator = np.random.default_rng([seed, run])

    def noisy(values: Array, deviation: float) -> Array:
        return values + noise * deviation * generator.standard_normal(values.shape)

    return CalibrationLog(
        time=played.time,
        commanded_differential=played.commanded_differential,
        measured_differential=noisy(played.measured_differential, PRESSURE_NOISE),
        bend_angles=noisy(played.bend_angles, ANGLE_NOISE),
        tip=noisy(played.tip, TIP_NOISE),
        source=f"twin, seed {seed}, run {run}",
    )


def calibrate_twin(
    seed: int, prior: Limb, *, quick: bool = True, noise: float = 1.0
) -> tuple[Limb, FitReport]:
    """Run a calibration on the twin of a seed and fit the prior to it.

    Only what a camera and the board would measure is used, with their noise.

    Args:
        seed: of the hardware.
        prior: limb with the geometry, masses and limits, and first guesses of the rest; the twin is
            mounted as it is and carries its `masses`.
        quick: use the short run of a minute and a half instead of three minutes.
        noise: of tags and board, as a multiple of the usual one.

    Returns:
        The identified limb and what the fit says of it.

    Raises:
        LogError: the run does not tell the parameters.
    """
    amplitude = AMPLITUDE * prior.pneumatics.pressure_limit
    excitation = calibration_run(amplitude, prior.segment_count, quick)
    limb, report = fit(prior, record_twin(seed, excitation, noise=noise, limb=prior))
    return replace(limb, name=f"{prior.name}, twin {seed}"), report
