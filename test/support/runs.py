"""Synthetic runs with known errors, as arrays and as bags."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from bags import SECOND, START, message, spec, store

from der_planner.bags.writer import RUN_KEY, BagWriter
from der_planner.results import Description, RunSeries

PERIOD, CYCLES = 4.0, 2
TIMES = np.arange(0.0, PERIOD * CYCLES + 1.0 + 1e-9, 0.05)
FRAMES = np.arange(-0.5, TIMES[-1] + 0.5, 1 / 30) + 0.011


def reference(time: np.ndarray) -> np.ndarray:
    """Return a tip path (N, 2) [m]."""
    phase = 2 * np.pi * np.asarray(time) / PERIOD
    return np.column_stack([0.2 + 0.02 * np.cos(phase), 0.06 * np.sin(phase)])


def series(
    tip, *, model="der", trial=0, seed=0, motion="same_direction", time=FRAMES, **changes
) -> RunSeries:
    """Return a run whose measured tip is given at `FRAMES`."""
    about = {
        "method": "paper",
        "trial": trial,
        "seed": seed,
        "amplitude": 0.7,
        "period": PERIOD,
        "cycles": CYCLES,
    }
    about.update(changes)
    return RunSeries.from_arrays(
        Description(motion, model, **about),
        time=time,
        tip=tip,
        reference_time=TIMES,
        tip_reference=reference(TIMES),
        tip_predicted=reference(TIMES) + np.array([0.001, 0.0]),
    )


OURS = (
    "LimbState",
    "LimbContact",
    "PressurePlan",
    "PressureSetpoint",
    "PressureState",
    "ChamberPressures",
)


class BagOfRun:
    """Writes the messages of one run into a bag, with rosbags' serializer."""

    def __init__(
        self,
        folder: Path,
        writer: BagWriter | None = None,
        run: str = "{}",
        namespace: str = "/limb",
        types: tuple[str, ...] = (),
    ) -> None:
        self.namespace = namespace
        self.types = store(*types, *(f"der_msgs/msg/{name}" for name in OURS))
        self.bag = writer or BagWriter(folder, {RUN_KEY: run})
        self.start = START + 7 * SECOND
        self.travel = 0.03
        """[s] from a stamp to the arrival: less than nothing if the stamp's clock is ahead."""

    def stamp(self, seconds: float) -> int:
        return self.start + round(seconds * SECOND)

    def make(self, name: str, **fields):
        return message(self.types, name, **fields)

    def header(self, seconds: float):
        sec, nanosec = divmod(self.stamp(seconds), SECOND)
        stamp = self.make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id="limb_base")

    def write(self, topic: str, name: str, seconds: float, latched: bool = False, **fields) -> None:
        topic = topic.replace("/limb", self.namespace, 1)
        name = name if "/" in name else f"der_msgs/msg/{name}"
        made = self.make(name, header=self.header(seconds), **fields)
        data = bytes(self.types.serialize_cdr(made, name))
        # A message arrives some time after its stamp; the evaluation must go by the stamp.
        arrival = self.stamp(seconds + self.travel)
        self.bag.write(spec(topic, name, latched), arrival, arrival - SECOND // 100, data)

    def plan(self, plan_id="p", model="der", stamp=0.0, **fields) -> None:
        """Write a plan of no pressure, or with other fields than that."""
        usual = {
            "motion": "same_direction",
            "method": "paper",
            "amplitude": 0.7,
            "period": PERIOD,
            "cycles": CYCLES,
            "limb": "test limb",
            "segment_count": 2,
            "time": TIMES,
            "differential_pressure": np.zeros(2 * len(TIMES)),
            "tip_reference": reference(TIMES).ravel(),
            "tip_predicted": reference(TIMES).ravel(),
        }
        fields = {**usual, "plan_id": plan_id, "model": model, **fields}
        self.write("/limb/plan", "PressurePlan", stamp, latched=True, **fields)

    def still_run(self, offset=(0.0, 0.0), **plan) -> Path:
        """Write a run without pressure whose tip is off by a constant, and close the bag."""
        self.plan(**plan)
        for index in range(len(TIMES)):
            self.setpoint(index, [0.0, 0.0])
        for when in FRAMES:
            self.state(when, reference(when)[0] + offset)
        return self.bag.close()

    def setpoint(self, index: int, value, plan_id="p", revision=0) -> None:
        self.write(
            "/limb/pressure_setpoint",
            "PressureSetpoint",
            TIMES[index],
            plan_id=plan_id,
            index=index,
            revision=revision,
            differential_pressure=np.asarray(value, dtype=float),
        )

    def state(self, seconds: float, tip, valid=True, topic="/limb/state", bend=(0.1, 0.2)) -> None:
        x, y = tip if valid else (np.nan, np.nan)
        point = self.make("geometry_msgs/msg/Point", x=float(x), y=float(y))
        angles = np.asarray(bend, dtype=float)
        self.write(topic, "LimbState", seconds, valid=valid, tip=point, bend_angle=angles)

    def pressure(self, seconds: float, commanded, measured, mode=2, faults=()) -> None:
        self.write(
            "/limb/pressure_state",
            "PressureState",
            seconds,
            mode=mode,
            faults=list(faults),
            commanded_differential=np.asarray(commanded, dtype=float),
            measured_differential=np.asarray(measured, dtype=float),
        )

    def touch(self, seconds: float, since: float, distance: float, said: str) -> None:
        began = self.header(since).stamp
        about = {"plan_id": "p", "touched": True, "since": began, "said": said}
        self.write("/limb/contact", "LimbContact", seconds, distance=distance, **about)

    def command(self, seconds: float, differential, sequence: int, valves=range(4)) -> None:
        chambers = np.repeat(101_300.0, 4)
        for segment, value in enumerate(differential):
            chambers[2 * segment + (value < 0)] += abs(value)
        self.write(
            "/limb/twin/board_commands",
            "ChamberPressures",
            seconds,
            sequence=sequence,
            pressure=np.round(chambers, -2)[np.argsort(valves)],
        )
