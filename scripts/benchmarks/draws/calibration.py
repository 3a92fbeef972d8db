"""Does every limb calibrate in every mounting? Drawn limbs, each fitted from the default limb file.

Of six limbs in a mounting four are the project's own rod with drawn numbers, one is a twin and one
a chain of links (test/support/link_chain.py); neither shares code with what is fitted. Limbs that
stand are all rods. Each plays the short calibration (86 s) and is seen through the noise of tags
and board. The fit is given the mounting and nothing else: neither mass nor lengths. Rows are kept
in doc/calibration_draws.csv as they come, and a row of it is not computed again: a run that was
stopped goes on.
"""

from __future__ import annotations

import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from benchmarks import rows as kept
from benchmarks.draws.limb import drawn_friction
from der_planner.identification import CalibrationLog, LogError, calibration_run, fit, record_twin
from der_planner.identification.offline import (
    AMPLITUDE,
    ANGLE_NOISE,
    PRESSURE_NOISE,
    TIP_NOISE,
)
from der_planner.limb import Limb, PointMass, Segment
from der_planner.limb_loads import gravity_of
from der_planner.model import simulate
from der_planner.model.series import interpolate, step_middles
from der_planner.planning import BucklingError
from der_planner.planning.loads.rest import rest_of
from der_planner.rod import ConvergenceError
from der_planner.twin.hardware import draw as draw_twin
from workspace_setup.basics import ROOT

Array = NDArray[np.float64]
Generator = np.random.Generator

ROWS = ROOT / "src" / "der_planner" / "doc" / "calibration_draws.csv"
CHAINS = ROOT / "test" / "support"
LIMBS, QUICK_LIMBS = 100, 5
MOUNTINGS = ("horizontal", "10", "sideways", "hanging", "standing")
"""In turn, as `gravity_of` takes them."""
KINDS = ("rod", "rod", "twin", "rod", "rod", "chain")
"""In turn with every round of the mountings; only rods are drawn so stiff that they stand."""
UPRIGHT = 1.25
"""A standing limb would also stand with so many times its weight."""
GOOD = 0.7
"""Root mean square of what a good fit leaves of the bend angles [deg]."""
RECORD_NODES = 31
"""Of the rod that plays; the rod of the fit has 13."""


@dataclass(frozen=True)
class Truth:
    """The true numbers of a limb.

    Attributes:
        stiffness, gain, rest: (M,) of each segment, EI / L [N·m/rad], [rad/Pa] and [rad].
        mass, length: of the whole limb from its clamp on [kg, m].
    """

    stiffness: Array
    gain: Array
    rest: Array
    mass: float
    length: float


@dataclass(frozen=True)
class Row:
    """One limb in one mounting.

    Attributes:
        number: of the draw.
        kind: of the limb, of `KINDS`.
        mounting: of `MOUNTINGS`.
        outcome: fitted, refused (`LogError`), exception, or not played (the drawn limb itself
            cannot be simulated).
        fit_deg, largest_deg, arcs_deg: root mean square and largest of what the fit leaves of the
            bend angles, and root mean square of arcs; of the worse segment.
        stiffness_0, stiffness_1: EI / L of each segment, found over true.
        gain_0, gain_1: bend angle per pressure, found over true.
        rest_0_deg, rest_1_deg: rest angle, found less true.
        mass: of the whole limb, in the limb file over the true one.
        length_mm: whole length, found less true.
        cpu_s: of the fit, on a shared machine.
        said: warnings, or what went wrong.
        commit: of the program.
    """

    number: int
    kind: str
    mounting: str
    outcome: str = ""
    fit_deg: float = float("nan")
    largest_deg: float = float("nan")
    arcs_deg: float = float("nan")
    stiffness_0: float = float("nan")
    stiffness_1: float = float("nan")
    gain_0: float = float("nan")
    gain_1: float = float("nan")
    rest_0_deg: float = float("nan")
    rest_1_deg: float = float("nan")
    mass: float = float("nan")
    length_mm: float = float("nan")
    cpu_s: float = float("nan")
    said: str = ""
    commit: str = ""


def wanted(number: int) -> Row:
    """Return the row of a draw, without results."""
    mounting = MOUNTINGS[number % len(MOUNTINGS)]
    kind = KINDS[number // len(MOUNTINGS) % len(KINDS)]
    return Row(number, "rod" if mounting == "standing" else kind, mounting)


def drawn_rod(generator: Generator, mounting: str) -> Limb:
    """Return a limb of other numbers than the default one's, in a mounting in which it rests."""
    while True:
        limb = _rod(generator, mounting)
        heavier = replace(limb, gravity=tuple(UPRIGHT * g for g in limb.gravity))
        try:
            rest_of(heavier if mounting == "standing" else limb)
        except BucklingError:
            continue
        return limb


def _rod(generator: Generator, mounting: str) -> Limb:
    draw, default = generator.uniform, Limb.default()

    def segment(known: Segment) -> Segment:
        length = known.length * draw(0.93, 1.07)
        stiffness = known.bending_stiffness * np.exp(draw(*np.log((0.6, 1.7))))
        if mounting == "standing":
            stiffness *= 2.0
        gain = known.static_gain * draw(0.6, 1.4) * stiffness / length
        return replace(
            known,
            length=length,
            bending_stiffness=stiffness,
            mass_per_length=known.mass_per_length * draw(0.85, 1.2),
            moment_gain=gain,
            rest_curvature=np.deg2rad(draw(-6.0, 6.0)) / length,
            cubic_stiffness=draw(0.0, 0.05) * stiffness * length**2,
            pressure_stiffening=draw(0.0, 5e-6),
            **drawn_friction(draw, stiffness, length),
            creep_stiffness=draw(0.0, 0.06) * stiffness,
            creep_time=draw(5.0, 40.0),
            coupling_before=draw(-0.05, 0.05),
            coupling_after=draw(-0.05, 0.05),
            material_damping=draw(0.0, 0.02),
        )

    damping = default.segments[0].damping * draw(0.6, 2.0)
    air = replace(
        default.pneumatics,
        time_constant=draw(0.08, 0.25),
        vent_time_constant=draw(0.1, 0.35),
        delay=draw(0.0, 0.08),
        vent_rate=draw(15e3, 60e3),
        vent_exponent=draw(0.5, 1.0),
    )
    limb = replace(
        default,
        segments=tuple(replace(segment(s), damping=damping) for s in default.segments),
        connector_length=draw(0.002, 0.012),
        base_length=draw(0.0, 0.008),
        pneumatics=air,
    )
    middle = limb.base_length + limb.segments[0].length + 0.5 * limb.connector_length
    fittings = (
        PointMass(middle, draw(0.0, 0.01), "connector"),
        PointMass(limb.length, draw(0.0, 0.01), "tip"),
    )
    return replace(limb.mounted(mounting), masses=fittings)


def _rod_log(row: Row, _: Limb) -> tuple[CalibrationLog, Truth]:
    generator = np.random.default_rng([88, row.number])
    limb = drawn_rod(generator, row.mounting)
    run = calibration_run(AMPLITUDE * limb.pneumatics.pressure_limit, quick=True)
    seen = simulate(limb, run.time, commands=run.differential_pressure, nodes=RECORD_NODES)
    inside = seen.differential_pressure
    amid = seen.time[0] + step_middles(*inside.shape[:2], seen.time[1] - seen.time[0])
    pressure = interpolate(run.time, amid, inside.reshape(len(amid), -1))

    def noisy(values: Array, deviation: float) -> Array:
        return values + deviation * generator.standard_normal(values.shape)

    log = CalibrationLog(
        run.time,
        run.differential_pressure,
        noisy(pressure, PRESSURE_NOISE),
        noisy(seen.bend_angles[:-1], ANGLE_NOISE),
        noisy(seen.tip[:-1], TIP_NOISE),
        f"drawn rod {row.number}",
    )
    return log, Truth(*_of_segments(limb), limb.mass, limb.length)


def _twin_log(row: Row, prior: Limb) -> tuple[CalibrationLog, Truth]:
    seed = 200 + row.number
    run = calibration_run(AMPLITUDE * prior.pneumatics.pressure_limit, quick=True)
    built = draw_twin(seed)
    length = np.array([s.flexible_length for s in built.segments])
    stiffness = np.array([s.bending_stiffness for s in built.segments]) / length
    moment = np.array([np.mean(s.chamber_gain) for s in built.segments])
    rest = np.array([s.rest_curvature for s in built.segments]) * length
    whole = built.base_fitting + length.sum() + built.connector + built.tip_fitting
    mass = built.mass_per_length * whole + built.connector_mass + built.tip_mass
    truth = Truth(stiffness, moment / stiffness, rest, mass, whole)
    return record_twin(seed, run, limb=prior), truth


def _chain_log(row: Row, prior: Limb) -> tuple[CalibrationLog, Truth]:
    if str(CHAINS) not in sys.path:
        sys.path.append(str(CHAINS))
    from link_chain import MASS_PER_LENGTH, LinkChain  # noqa: PLC0415

    chain = LinkChain(200 + row.number, prior.gravity)
    springs = chain._stiffness.reshape(chain.segment_count, -1)
    stiffness = 1.0 / np.sum(1.0 / springs, axis=1)
    gain = chain._gain.mean(axis=1) * np.sum(1.0 / springs, axis=1)
    mass = MASS_PER_LENGTH * chain.length
    return chain.log(), Truth(stiffness, gain, chain._rest, mass, chain.length)


_LOGS: dict[str, Callable[[Row, Limb], tuple[CalibrationLog, Truth]]] = {
    "rod": _rod_log,
    "twin": _twin_log,
    "chain": _chain_log,
}


def _of_segments(limb: Limb) -> tuple[Array, Array, Array]:
    stiffness = [s.bending_stiffness / s.length for s in limb.segments]
    gain = [s.static_gain for s in limb.segments]
    rest = [s.rest_curvature * s.length for s in limb.segments]
    return np.array(stiffness), np.array(gain), np.array(rest)


def calibrate(row: Row) -> Row:
    """Return the row with what came of it: any exception is a result here, not an end."""
    prior = replace(Limb.default(), gravity=gravity_of(row.mounting))
    try:
        log, truth = _LOGS[row.kind](row, prior)
    except ConvergenceError as error:
        return replace(row, outcome="not played", said=str(error))
    begin = time.process_time()
    try:
        found, report = fit(prior, log)
    except LogError as error:
        return replace(row, outcome="refused", said=str(error))
    except Exception:
        traceback.print_exc()
        said = traceback.format_exc(limit=-1).replace("\n", " ")
        return replace(row, outcome="exception", said=said)
    stiffness, gain, rest = _of_segments(found)
    return replace(
        row,
        outcome="fitted",
        fit_deg=float(np.degrees(report.residual).max()),
        largest_deg=float(np.degrees(report.largest).max()),
        arcs_deg=float(np.degrees(report.pcc_residual).max()),
        **{f"stiffness_{i}": float(v) for i, v in enumerate(stiffness / truth.stiffness)},
        **{f"gain_{i}": float(v) for i, v in enumerate(gain / truth.gain)},
        **{f"rest_{i}_deg": float(v) for i, v in enumerate(np.degrees(rest - truth.rest))},
        mass=found.mass / truth.mass,
        length_mm=1000.0 * (found.length - truth.length),
        cpu_s=time.process_time() - begin,
        said="; ".join(report.warnings),
    )


def run(quick: bool = False) -> dict[str, float]:
    """Calibrate the limbs that the rows lack, and return how many of all did."""
    done = {row.number for row in kept.read(Row, ROWS)}
    now = kept.commit()
    for number in range(QUICK_LIMBS if quick else LIMBS):
        if number not in done:
            row = replace(calibrate(wanted(number)), commit=now)
            kept.append(row, ROWS)
            said = f"{row.fit_deg:.2f}°" if row.outcome == "fitted" else row.said
            print(f"{number:3d} {row.kind} {row.mounting}: {row.outcome}, {said}", flush=True)
    return summary(kept.read(Row, ROWS))


def summary(rows: list[Row]) -> dict[str, float]:
    """Print what came of the limbs of each mounting, and return how many did what in all."""
    print(
        "\nmounting: limbs, fitted, refused, exceptions, not played | fit in deg: median, largest"
    )
    for mounting in MOUNTINGS:
        of_it = [row for row in rows if row.mounting == mounting]
        if of_it:
            _print_mounting(mounting, of_it)
    fits = np.array([row.fit_deg for row in rows if row.outcome == "fitted"])
    figures = {outcome.replace(" ", "_"): float(count) for outcome, count in _counts(rows).items()}
    return figures | {"limbs": float(len(rows)), "above_good": float(np.sum(fits > GOOD))}


def _counts(rows: list[Row]) -> dict[str, int]:
    outcomes = ("fitted", "refused", "exception", "not played")
    return {outcome: sum(row.outcome == outcome for row in rows) for outcome in outcomes}


def _print_mounting(mounting: str, rows: list[Row]) -> None:
    fitted = [row for row in rows if row.outcome == "fitted"]
    counts = ", ".join(str(count) for count in _counts(rows).values())
    print(f"{mounting}: {len(rows)}, {counts}", end="")
    if not fitted:
        print()
        return
    fit_deg = np.array([row.fit_deg for row in fitted])
    print(
        f" | {np.median(fit_deg):.2f}, {fit_deg.max():.2f}; {np.sum(fit_deg > GOOD)} above {GOOD}"
    )
    # Without a weighed limb a log tells stiffness over mass.
    mass = np.array([row.mass for row in fitted])
    stiffness = np.array([[row.stiffness_0, row.stiffness_1] for row in fitted]) / mass[:, None]
    gain = np.array([[row.gain_0, row.gain_1] for row in fitted])
    rest = np.array([[row.rest_0_deg, row.rest_1_deg] for row in fitted])
    for name, unit, errors in (
        ("stiffness over mass", "%", 100.0 * (stiffness - 1.0)),
        ("gain", "%", 100.0 * (gain - 1.0)),
        ("rest angle", "°", rest),
        ("length", "mm", np.array([[row.length_mm] for row in fitted])),
    ):
        middle, largest = np.median(np.abs(errors), axis=0), np.abs(errors).max(axis=0)
        pairs = (f"{m:.2g} ({w:.2g}) {unit}" for m, w in zip(middle, largest, strict=True))
        print(f"    {name} off by, median and largest: {', '.join(pairs)}")
