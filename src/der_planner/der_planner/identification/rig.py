"""How a rig is put together, found from what moves when one chamber after another is filled.

Each chamber is filled gently, alone and from rest. Which sensor then rises, which segment bends and
to which side tell the wiring; when they do tells the lags; how far each body moves tells their
order along the limb.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from der_planner.arrays import Array
from der_planner.identification.excitation import Excitation
from der_planner.model import CONTROL_PERIOD
from der_planner.model.air import pair_of

GENTLE = 0.125
"""Pressure of the fills over the driver's limit: a tenth of a right angle on the default limb."""
REST, HOLD, VENT = 2.0, 3.0, 4.0
"""Before the first fill, of each fill, and after each [s]."""
LEVEL = 0.5
"""Levels are means over so long [s]."""
CROSSING = 0.1
"""A path has begun to answer at this share of its rise."""
LEAST_RISE = 0.2
"""Share of the command that a sensor must show to be the one of the chamber."""
LEAST_BEND = np.deg2rad(1.0)
"""Bend that counts as one [rad]."""
CLEAR = 0.5
"""The second largest answer must be below this share of the largest one."""
LEAKS, SENSOR_ERROR, OPEN = 0.1, 300.0, 0.1
"""A leak: this shortfall of the pressure, which must be more than a sensor's error [Pa], or this
opening of the inlet at steady pressure."""
STAYS = 0.15
"""Share of the rise that is left after `VENT` in a chamber that does not vent."""
SIDES = {1: "left", -1: "right"}
"""Names of the chambers of a segment by the sign of its bend."""


class RigError(ValueError):
    """The log of a check cannot be judged; the message says what is missing in it."""


@dataclass(frozen=True)
class RigLog:
    """What was commanded, measured and seen while one chamber after another was filled.

    Attributes:
        time: (K,) of commands and sensors [s].
        command: (K, M) differential pressures [Pa]; above zero the first chamber of a pair is
            filled, below it the second one.
        measured: (K, 2M) of the sensors, absolute [Pa].
        opening: (K, 2M) of the inlet valves, 0 to 1; NaN where the board does not tell.
        seen_time: (J,) of what was seen [s].
        places: (J, B, 3) x, y [m] and heading [rad] of tags or bodies; NaN where not seen.
        names: of the B bodies.
        arc_lengths: (B,) where the map says that they are [m].
        segment_lengths: (M,) [m].
    """

    time: Array
    command: Array
    measured: Array
    opening: Array
    seen_time: Array
    places: Array
    names: tuple[str, ...]
    arc_lengths: Array
    segment_lengths: tuple[float, ...]


class ValveFinding(NamedTuple):
    """What the fill of one valve has shown.

    Attributes:
        valve: counted from 0; with the present wiring it fills chamber ``valve`` of the limb.
        sensor: that reads it, counted from 0; None if none does.
        segment: that it bends, counted from 0; None if none does.
        side: +1 if it bends to the left, counter-clockwise; −1 to the right.
        rise: of its pressure [Pa].
        bend: of the segment [rad].
        sure: 1: only this sensor and this segment answered; 0: others did as much.
        to_pressure: from the command to the sensor's answer [s].
        to_motion: from the sensor's answer to that of the limb [s].
        problems: what is wrong with it.
    """

    valve: int
    sensor: int | None
    segment: int | None
    side: int
    rise: float
    bend: float
    sure: float
    to_pressure: float
    to_motion: float
    problems: tuple[str, ...]

    @property
    def chamber(self) -> int | None:
        """The chamber of the limb that it fills: 0, 1 of segment 0, then of segment 1."""
        return None if self.segment is None else 2 * self.segment + (self.side < 0)

    def text(self) -> str:
        """Say it in a line."""
        moves, reads = "moves nothing", "no sensor reads it"
        if self.segment is not None:
            angle = np.degrees(abs(self.bend))
            moves = f"bends segment {self.segment} to the {SIDES[self.side]} by {angle:.1f}°"
        if self.sensor is not None:
            reads = f"sensor {self.sensor + 1} reads {self.rise:.0f} Pa"
        lags = f"{1e3 * self.to_pressure:.0f} + {1e3 * self.to_motion:.0f} ms"
        line = f"valve {self.valve + 1}: {moves}, {reads}, {lags}, sure to {100 * self.sure:.0f} %"
        return "; ".join([line, *self.problems])


@dataclass(frozen=True)
class RigFinding:
    """How a rig is put together.

    Attributes:
        valves: (2M,) what each of them does.
        order: (B,) the bodies by how far along the limb they are, as indices into ``names``.
        order_ratio: smallest ratio between the ways of neighbours, which tell the order.
        names: of the bodies.
        contradictions: why the rig cannot be played as it is; each names the cables to look at.
        warnings: what does not keep it from being played.
    """

    valves: tuple[ValveFinding, ...]
    order: tuple[int, ...]
    order_ratio: float
    names: tuple[str, ...]
    contradictions: tuple[str, ...]
    warnings: tuple[str, ...]

    @property
    def wiring(self) -> tuple[int, ...]:
        """The valve of each chamber of the limb, counted from 0.

        Raises:
            RigError: the rig contradicts itself.
        """
        if self.contradictions:
            raise RigError("; ".join(self.contradictions))
        valves = {valve.chamber: valve.valve for valve in self.valves}
        return tuple(valves[chamber] for chamber in range(len(self.valves)))

    def lines(self) -> list[str]:
        """Say it in lines, for people and for the rig file."""
        along = ", ".join(self.names[k] for k in self.order)
        return [
            *(valve.text() for valve in self.valves),
            f"from the clamp to the tip: {along}; each goes {self.order_ratio:.1f} times as far as "
            "the one before, or farther",
            *(f"warning: {each}" for each in self.warnings),
            *(f"refused: {each}" for each in self.contradictions),
        ]


def check_run(segment_count: int, pressure: float) -> Excitation:
    """Return the pressures of a check: each chamber is filled once, alone, and vented."""
    held, vented = round(HOLD / CONTROL_PERIOD), round(VENT / CONTROL_PERIOD)
    rows = [np.zeros((round(REST / CONTROL_PERIOD), segment_count))]
    for valve in range(2 * segment_count):
        fill = np.zeros((held + vented, segment_count))
        fill[:held, valve // 2] = pressure * (1 - 2 * (valve % 2))
        rows.append(fill)
    return Excitation(np.concatenate(rows), "check")


def find_rig(log: RigLog) -> RigFinding:
    """Find how a rig is put together.

    Raises:
        RigError: a chamber was not filled in the log, or too little was seen of the limb.
    """
    fills = _fills(log)
    ways = np.array([_change(log.seen_time, log.places[..., :2], fill) for fill in fills])
    blind = np.isnan(ways).any(axis=(0, 2))
    if blind.all():
        raise RigError("nothing was seen of the limb: does the tracker see its tags or bodies?")
    moved = np.sqrt(np.nansum(ways**2, axis=(0, 2)))
    along = sorted((int(k) for k in np.flatnonzero(~blind)), key=lambda k: moved[k])
    arcs = np.sort(log.arc_lengths[along])
    ends = _segment_ends(arcs, log.segment_lengths)
    headings = log.places[:, [along[k] for k in ends], 2]
    bends = np.diff(headings, axis=1, prepend=0.0)
    valves = tuple(_judge(log, valve, fill, bends) for valve, fill in enumerate(fills))
    contradictions, warnings = _compare(valves, len(log.segment_lengths))
    expected = [int(k) for k in np.argsort(log.arc_lengths) if not blind[k]]
    if along != expected:
        there, said = (", ".join(log.names[k] for k in order) for order in (along, expected))
        contradictions.append(f"along the limb are {there}, and in the map {said}")
    warnings += [f"{log.names[k]} was not seen in every fill" for k in np.flatnonzero(blind)]
    steps = moved[along[1:]] / np.maximum(moved[along[:-1]], 1e-9)
    return RigFinding(
        valves,
        tuple(along),
        float(steps.min()) if len(steps) else np.inf,
        log.names,
        tuple(contradictions),
        tuple(warnings),
    )


def _fills(log: RigLog) -> list[tuple[float, float]]:
    """Return from when to when each chamber was filled [s].

    Raises:
        RigError: one was not, or two were at once.
    """
    held = pair_of(log.command).reshape(len(log.time), -1)
    filled = held > 0.5 * held.max()
    if not filled.any() or (filled.sum(axis=1) > 1).any():
        raise RigError("this is no log of a check: no chamber is filled, or two are at once")
    found = []
    for valve, rows in enumerate(map(np.flatnonzero, filled.T), start=1):
        if not len(rows):
            raise RigError(f"valve {valve} was not filled in this log")
        last = min(rows[-1] + 1, len(log.time) - 1)
        found.append((float(log.time[rows[0]]), float(log.time[last])))
    return found


def _level(time: Array, values: Array, until: float) -> Array:
    """Return the mean of values shortly before an instant; NaN where fewer than half are known.

    Raises:
        RigError: there are none.
    """
    rows = values[(time > until - LEVEL) & (time <= until)]
    if not len(rows):
        raise RigError(f"nothing was recorded shortly before {until:.1f} s")
    known = np.isfinite(rows)
    count = known.sum(axis=0)
    mean = rows.sum(axis=0, where=known) / np.maximum(count, 1)
    level: Array = np.where(2 * count >= len(rows), mean, np.nan)
    return level


def _change(time: Array, values: Array, fill: tuple[float, float]) -> Array:
    """Return how much values change in a fill."""
    return _level(time, values, fill[1]) - _level(time, values, fill[0])


def _crossing(time: Array, values: Array, fill: tuple[float, float]) -> float:
    """Return when values have made `CROSSING` of their way in a fill [s], NaN if never."""
    rows = (time >= fill[0]) & (time <= fill[1]) & np.isfinite(values)
    share = (values[rows] - _level(time, values, fill[0])) / _change(time, values, fill)
    k = int(np.argmax(share >= CROSSING))
    if share[k] < CROSSING:
        return float("nan")
    around = slice(max(k - 1, 0), k + 1)
    return float(np.interp(CROSSING, share[around], time[rows][around]))


def _segment_ends(arcs: Array, lengths: Sequence[float]) -> list[int]:
    """Return which body, in the order along the limb, tells the heading where a segment ends.

    Raises:
        RigError: no body is on the second half of a segment.
    """
    found = []
    for index, (end, length) in enumerate(zip(np.cumsum(lengths), lengths, strict=True)):
        within = np.flatnonzero((arcs <= end + 0.05 * length) & (arcs > end - 0.5 * length))
        if not len(within):
            raise RigError(f"no tag or body on the second half of segment {index} was seen")
        found.append(int(within[-1]))
    return found


def _judge(log: RigLog, valve: int, fill: tuple[float, float], bends: Array) -> ValveFinding:
    """Judge what the fill of a valve has shown.

    Args:
        log: of the check.
        valve: counted from 0.
        fill: from when to when it was filled [s].
        bends: (J, M) of the segments [rad].
    """
    start, end = fill
    problems: list[str] = []
    wanted = float(np.abs(log.command).max())
    sensor, rise, sensor_sure = _largest(_change(log.time, log.measured, fill), LEAST_RISE * wanted)
    segment, bend, bend_sure = _largest(_change(log.seen_time, bends, fill), LEAST_BEND)
    answered = moved = float("nan")
    if sensor is not None:
        pressure = log.measured[:, sensor]
        answered = _crossing(log.time, pressure, fill)
        short = wanted - rise
        opening = _level(log.time, log.opening, end)[valve]
        if short > max(LEAKS * wanted, SENSOR_ERROR):
            below = f"{short:.0f} Pa below its command"
            problems.append(f"it leaks, is fed too little, or its sensor is off: {below}")
        elif opening > OPEN:
            problems.append(f"it leaks: its inlet is {100 * opening:.0f} % open")
        left = _change(log.time, pressure, (start, end + VENT))
        if left > STAYS * rise:
            problems.append(f"it does not vent: {left:.0f} Pa are left after {VENT:.0f} s")
        if sensor_sure < 1.0 - CLEAR:
            problems.append("more than one sensor rises: is its hose joined to another one?")
    if segment is not None:
        moved = _crossing(log.seen_time, bends[:, segment], fill)
        if bend_sure < 1.0 - CLEAR:
            problems.append("more than one segment bends: is its hose joined to another one?")
    if sensor is None and segment is None:
        problems.append("dead: look at its valve, its supply and its hose at the board")
    elif segment is None:
        problems.append("pressure but no motion: its hose ends in no chamber, or is blocked")
    elif sensor is None:
        problems.append("motion but no pressure: look at its sensor")
    sure = max(0.0, min(sensor_sure, bend_sure))
    lags = (answered - start, moved - answered)
    side = 1 if bend >= 0.0 else -1
    return ValveFinding(valve, sensor, segment, side, rise, bend, sure, *lags, tuple(problems))


def _largest(changes: Array, least: float) -> tuple[int | None, float, float]:
    """Return which value changed most, by how much, and how clearly; None if none did."""
    sizes = np.where(np.isfinite(changes), np.abs(changes), 0.0)
    order = np.argsort(sizes)[::-1]
    best = int(order[0])
    if sizes[best] < least:
        return None, float(changes[best]), 0.0
    second = sizes[order[1:2]].sum()
    return best, float(changes[best]), float(1.0 - second / sizes[best])


def _compare(valves: Sequence[ValveFinding], count: int) -> tuple[list[str], list[str]]:
    """Return why valves contradict each other, and what else is worth a warning."""
    contradictions, warnings = list[str](), list[str]()
    bent, read = defaultdict(list), defaultdict(list)
    for each in valves:
        bent[each.chamber].append(str(each.valve + 1))
        read[each.sensor].append(str(each.valve + 1))
        for said in each.problems:
            grave = each.segment is None or "more than one" in said
            (contradictions if grave else warnings).append(f"valve {each.valve + 1}: {said}")
    for chamber in range(2 * count):
        moved = f"segment {chamber // 2} to the {SIDES[1 - 2 * (chamber % 2)]}"
        by = " and ".join(bent[chamber])
        if len(bent[chamber]) > 1:
            contradictions.append(f"valves {by} both bend {moved}: a hose is in the wrong port")
        elif not by:
            contradictions.append(f"no valve bends {moved}")
    for sensor in range(2 * count):
        by = " and ".join(read[sensor])
        if len(read[sensor]) > 1:
            contradictions.append(f"sensor {sensor + 1} answers to valves {by}: look at its cable")
        elif by and by != str(sensor + 1):
            warnings.append(f"sensor {sensor + 1} reads valve {by}: are their cables swapped?")
    return contradictions, warnings
