"""Recorder and evaluation: what is lost, what it costs, how fast bags are read."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from geometry_msgs.msg import Point
from rclpy.serialization import serialize_message

from benchmarks import cpu_time, show
from der_msgs.msg import (
    LimbState,
    PressurePlan,
    PressureSetpoint,
    PressureState,
    TagDetection,
    TagDetectionArray,
)
from der_planner.bags.reader import BagReader
from der_planner.bags.recover import recover_bag
from der_planner.bags.topics import OfferedQos, TopicSpec
from der_planner.bags.writer import BagWriter
from der_planner.experiment.processes import NodeProcess
from limb_interfaces.stamps import stamp_from_nanoseconds

SOURCE = """
import sys, time
import numpy as np, rclpy
from rclpy.node import Node
from sensor_msgs.msg import Image
from der_msgs.msg import LimbState, PressureState
from limb_interfaces import qos, topics
seconds = float(sys.argv[1])
rclpy.init(args=[])
node = Node("source", namespace=topics.NAMESPACE)
image = node.create_publisher(Image, topics.IMAGE, qos.SENSOR_DATA)
states = [node.create_publisher(LimbState, f"bench/state_{i}", qos.STATES) for i in range(6)]
while not (image.get_subscription_count() and all(p.get_subscription_count() for p in states)):
    time.sleep(0.05)
time.sleep(1.0)
pixels = np.random.default_rng(0).integers(0, 255, 1280 * 720, dtype=np.uint8)
message = Image(height=720, width=1280, encoding="mono8", step=1280, data=pixels.tobytes())
frames = round(30 * seconds)
begin = time.monotonic()
for index in range(frames):
    message.header.frame_id = f"{index}"
    image.publish(message)
    for publisher in states:
        publisher.publish(LimbState(reason=f"{index}"))
    time.sleep(max(0.0, begin + (index + 1) / 30 - time.monotonic()))
print(time.monotonic() - begin, flush=True)
time.sleep(0.5)
"""


@contextlib.contextmanager
def _recording(seconds: float) -> Iterator[tuple[Path, NodeProcess, subprocess.Popen[str]]]:
    """Record a source of images that lasts some seconds; yield its folder and both processes."""
    with tempfile.TemporaryDirectory(dir=os.environ.get("BENCHMARK_FOLDER")) as name:
        bag = str(Path(name) / "bag")
        parameters = {"output": bag, "autostart": True, "record_images": True}
        recorder = NodeProcess("der_planner", "recorder", parameters, Path(name))
        command = [sys.executable, "-c", SOURCE, str(seconds)]
        source = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        try:
            yield Path(name), recorder, source
        finally:
            source.kill()
            source.wait()
            recorder.stop(timeout=30.0)


def record_images(seconds: float) -> dict[str, float]:
    """Record 720p mono8 images and six other topics at 30 Hz; count what is missing."""
    with _recording(seconds) as (folder, recorder, source):
        time.sleep(2.0)
        begin, used = time.monotonic(), cpu_time(recorder.pid)
        source.wait(seconds + 60.0)
        cpu = (cpu_time(recorder.pid) - used) / (time.monotonic() - begin)
        recorder.stop(timeout=30.0)
        with BagReader(folder / "bag") as bag:
            counts = {n: t.message_count for n, t in bag.topics.items()}
        size = sum(path.stat().st_size for path in (folder / "bag").glob("*.mcap"))
    frames = round(30 * seconds)
    states = [counts.get(f"/limb/bench/state_{i}", 0) for i in range(6)]
    return {
        "recorded_s": seconds,
        "images_sent": frames,
        "images_lost": frames - counts.get("/limb/camera/image_raw", 0),
        "states_sent": 6 * frames,
        "states_lost": 6 * frames - sum(states),
        "recorder_cpu_percent_of_a_core": 100 * cpu,
        "written_MB_per_s": size / 1e6 / seconds,
    }


def kill_and_recover(seconds: float) -> dict[str, float]:
    """Kill the recorder while it records images; how much time is missing at the end?"""
    with _recording(seconds + 30.0) as (folder, recorder, source):
        time.sleep(4.0 + seconds)
        killed = time.time_ns()
        recorder.signal(signal.SIGKILL)
        recorder.stop()
        source.kill()
        found = recover_bag(folder / "bag")
        with BagReader(found.folder) as bag:
            last = {message.topic: message.log_time for message in bag.raw()}
    return {
        "killed_lost_of_images_s": (killed - last["/limb/camera/image_raw"]) / 1e9,
        "killed_lost_of_small_topics_s": (killed - last["/limb/bench/state_0"]) / 1e9,
    }


def evaluate_long_bag(minutes: float) -> dict[str, float]:
    """Evaluate a bag of the graph's topics at their rates; time per recorded hour."""
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "long"
        _write_run(path, minutes * 60.0)
        size = sum(file.stat().st_size for file in path.glob("*.mcap"))
        command = [sys.executable, "-c", EVALUATE, str(path)]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
    took, peak = map(float, done.stdout.split())
    return {
        "evaluated_bag_min": minutes,
        "evaluated_bag_MB": size / 1e6,
        "evaluation_s_per_recorded_hour": took * 60.0 / minutes,
        "evaluation_peak_memory_MB": peak,
    }


EVALUATE = """
import resource, sys, time
from der_planner.results import evaluate_run, load_run
begin = time.perf_counter()
result = evaluate_run(load_run(sys.argv[1]))
assert abs(result.mean_error_m - 0.005) < 1e-4, result
print(time.perf_counter() - begin, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3)
"""


def _write_run(path: Path, seconds: float) -> None:
    """Write a run with the topics that the evaluation reads, and tags that it must skip."""
    origin = 1_700_000_000_000_000_000
    bag = BagWriter(path)

    def write(topic: str, message: object, when: float) -> None:
        kind = f"der_msgs/msg/{type(message).__name__}"
        stamp = origin + round(when * 1e9)
        message.header.stamp = stamp_from_nanoseconds(stamp)  # type: ignore[attr-defined]
        spec = TopicSpec.installed(topic, kind, (OfferedQos(),))
        bag.write(spec, stamp, stamp, serialize_message(message))

    times = np.arange(0.0, seconds, 0.05)
    tip = np.column_stack([0.2 + 0.02 * np.cos(times), 0.06 * np.sin(times)])
    plan = PressurePlan(plan_id="p", motion="same_direction", model="der", segment_count=2)
    plan.time, plan.tip_reference = times.tolist(), tip.ravel().tolist()
    plan.tip_predicted, plan.differential_pressure = plan.tip_reference, [0.0] * 2 * len(times)
    write("/limb/plan", plan, 0.0)
    tags = TagDetectionArray(detections=[TagDetection(id=i) for i in range(12)])
    values = [1000.0, 1000.0]
    for frame in range(round(30 * seconds)):
        when = frame / 30
        place = Point(x=0.203 + 0.02 * np.cos(when), y=0.06 * np.sin(when) - 0.004)
        curve = [Point() for _ in range(41)]
        state = LimbState(valid=True, tip=place, bend_angle=[0.1, 0.1], curve=curve)
        write("/limb/state", state, when)
        write("/limb/tags", tags, when)
        pressure = PressureState(commanded_differential=values, measured_differential=values)
        write("/limb/pressure_state", pressure, when)
    for index, when in enumerate(times):
        setpoint = PressureSetpoint(plan_id="p", index=index, differential_pressure=values)
        write("/limb/pressure_setpoint", setpoint, float(when))
    bag.close()


def run(quick: bool) -> dict[str, float | str]:
    """Measure; every figure has its unit in its name."""
    figures: dict[str, float | str] = {}
    figures |= record_images(8.0 if quick else 60.0)
    figures |= kill_and_recover(3.0 if quick else 8.0)
    figures |= evaluate_long_bag(2.0 if quick else 20.0)
    show(figures)
    return figures
