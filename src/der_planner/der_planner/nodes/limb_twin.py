"""The simulated limb as a node: chamber pressures in, shape and ground truth out, in real time."""

from __future__ import annotations

import functools
import math
import threading
import time
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import Point
from rclpy.node import Node
from std_msgs.msg import Header

from der_msgs.msg import ChamberPressures, LimbPush, LimbShape, LimbState
from der_planner.limb import PointMass
from der_planner.twin import LimbTwin, Push, TwinError
from der_planner.twin.limb_twin import BACKLOG, RealTimeLoop
from der_planner.twin.wiring import Wiring
from limb_interfaces import parameters, qos, stamps, topics
from limb_interfaces.diagnostics import DiagnosticsPublisher, Health
from limb_interfaces.parameters import check_overrides
from limb_interfaces.runner import run_node

SILENCE = 1.0
"""Without chamber pressures for this long [s] the node warns."""


class LimbTwinNode(Node):
    """Steps a `LimbTwin` against the steady clock and publishes where it is."""

    def __init__(self) -> None:
        super().__init__("limb_twin", namespace=topics.NAMESPACE)
        self.fatal_error = ""
        read: Any = functools.partial(parameters.declare, self)
        seed = read("seed", 0, "draws the hardware of this trial", at_least=0)
        run = read("run", 0, "draws how the rest angles wander in this run", at_least=0)
        rate = read("rate", 30.0, "shapes published per second [Hz]", 1.0, 120.0)
        self._twin = self._mount(seed, run, read)
        moments = "of the chambers' moments, 1: as drawn; may be set at run time"
        read("gain", 1.0, moments, 0.0, 2.0, read_only=False)
        hoses = "chamber of each valve; minus: it bends the other way"
        self._wiring = Wiring(tuple(map(int, read("wiring", [1, 2, 3, 4], hoses))))
        check_overrides(self)
        self._lock = threading.Lock()
        self._pressures: np.ndarray | None = None
        self._received_at = math.nan
        self._messages = 0
        self._bad_message = ""
        self._shape = self.create_publisher(LimbShape, topics.TWIN_SHAPE, qos.STATES)
        self._truth = self.create_publisher(LimbState, topics.TWIN_GROUND_TRUTH, qos.STATES)
        self.create_subscription(
            ChamberPressures, topics.TWIN_CHAMBER_PRESSURES, self._on_pressures, qos.STATES
        )
        self.create_subscription(LimbPush, topics.TWIN_PUSH, self._on_push, qos.COMMANDS)
        self._loop = RealTimeLoop(self._advance, self._publish, 1.0 / rate)
        self._diagnostics = DiagnosticsPublisher(self, self._report)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._work, name="physics", daemon=True)
        self._thread.start()

    def _mount(self, seed: int, run: int, read: Any) -> LimbTwin:
        """Return the twin under the loads that the parameters name.

        Raises:
            TwinError: a load is impossible.
        """
        gravity = read("gravity", [0.0, 0.0, 0.0], "acceleration in limb_base: x, y, z [m/s^2]")
        masses = read("masses", [0.0], "that the limb carries [kg]")
        places = read("masses_at", [0.0], "where each mass sits, along the limb from its clamp [m]")
        if len(masses) != len(places):
            raise TwinError(
                f"parameters 'masses' and 'masses_at' must be of one length, got {len(masses)} and "
                f"{len(places)}"
            )
        both = zip(masses, places, strict=True)
        carried = [PointMass(float(at), float(mass)) for mass, at in both]
        round_things = "round things in the limb's way: x, y, radius of each [m]; 0: nothing"
        pegs = read("pegs", [0.0], round_things)
        twin = LimbTwin(seed, run, gravity=tuple(map(float, gravity)), masses=carried)
        if any(pegs):
            if len(pegs) % 3:
                raise TwinError(f"parameter 'pegs' must be x, y, radius of each, got {pegs}")
            twin.put_pegs(pegs)
        return twin

    def close(self) -> None:
        """Stop the physics before the publishers go."""
        self._stop.set()
        self._thread.join(timeout=2.0)

    def _on_pressures(self, message: ChamberPressures) -> None:
        pressures = np.array(message.pressure, dtype=float)
        expected = 2 * self._twin.segment_count
        if pressures.shape != (expected,) or not np.all(np.isfinite(pressures)):
            self._bad_message = (
                f"{topics.TWIN_CHAMBER_PRESSURES}: expected {expected} finite absolute pressures, "
                f"got {list(message.pressure)}"
            )
            return
        with self._lock:
            if self._pressures is None:
                # The board starts vented, so its lowest chamber tells the air pressure of the room.
                self._twin.atmosphere = float(pressures.min())
            self._pressures = self._wiring.felt(pressures, self._twin.atmosphere)
            self._received_at = time.monotonic()
            self._messages += 1
        self._bad_message = ""

    def _on_push(self, message: LimbPush) -> None:
        """Take a push at the simulated time that its stamp stands for."""
        stamp = stamps.nanoseconds(message.header.stamp)
        now = self.get_clock().now().nanoseconds
        ahead = (stamp - now) / stamps.NANOSECONDS if stamp else 0.0
        force = message.force
        try:
            with self._lock:
                behind = min(BACKLOG, time.monotonic() - self._loop.simulated_until)
                self._twin.push(
                    Push(
                        self._twin.time + max(0.0, ahead + behind),
                        message.arc_length,
                        (force.x, force.y, force.z),
                        message.mass,
                        message.duration or math.inf,
                    )
                )
        except TwinError as error:
            self.get_logger().error(f"{topics.TWIN_PUSH} was not taken: {error}")
        else:
            what = f"{math.hypot(force.x, force.y):g} N and {message.mass:g} kg"
            self.get_logger().info(f"pushed by {what} at {message.arc_length:g} m")

    def _work(self) -> None:
        try:
            while not self._stop.is_set():
                self._stop.wait(self._loop.tick(time.monotonic()))
        except Exception as error:
            if rclpy.ok() and not self._stop.is_set():
                self.fatal_error = f"the physics thread failed: {error!r}"

    def _advance(self, duration: float) -> None:
        with self._lock:
            self._twin.gain = float(self.get_parameter("gain").value)
            pressures = self._pressures
            if pressures is None:
                pressures = np.full(2 * self._twin.segment_count, self._twin.atmosphere)
            self._twin.step(pressures, duration)

    def _publish(self, age: float) -> None:
        shape = self._twin.shape()
        now = self.get_clock().now().nanoseconds - round(age * stamps.NANOSECONDS)
        header = Header(stamp=stamps.stamp_from_nanoseconds(now), frame_id=topics.BASE_FRAME)
        points = [Point(x=float(x), y=float(y)) for x, y in shape.points]
        self._shape.publish(
            LimbShape(
                header=header,
                arc_length=shape.arc_length.tolist(),
                points=points,
                heading=shape.heading.tolist(),
            )
        )
        angles = self._twin.bend_angles
        length = float(np.linalg.norm(np.diff(shape.points, axis=0), axis=1).sum())
        rest = float(shape.arc_length[-1])
        self._truth.publish(
            LimbState(
                header=header,
                valid=True,
                reason="ground truth of the simulated limb",
                tip=points[-1],
                bend_angle=angles.tolist(),
                bend_angle_sigma=[0.0] * len(angles),
                curvature=(angles * len(angles) / rest).tolist(),
                elongation=length / rest,
                curve=points,
            )
        )

    def _report(self) -> Health:
        loop = self._loop
        with self._lock:
            silence = time.monotonic() - self._received_at
            messages = self._messages
        values = {
            "real_time_factor": f"{loop.real_time_factor:.4f}",
            "lag_s": f"{loop.lag:.4f}",
            "dropped_s": f"{loop.dropped:.3f}",
            "simulated_s": f"{self._twin.time:.2f}",
            "pressures_received": messages,
            "pressures_age_s": f"{silence:.3f}",
        }
        if self._bad_message:
            return Health("error", self._bad_message, values)
        if messages == 0:
            return Health("stale", f"waiting for {topics.TWIN_CHAMBER_PRESSURES}", values)
        if silence > SILENCE:
            text = f"no chamber pressures for {silence:.1f} s: is board_emulator alive?"
            return Health("warning", text, values)
        if loop.behind:
            text = f"does not keep real time: {loop.dropped:.2f} s dropped so far"
            return Health("warning", text, values)
        return Health("ok", "keeps real time", values)


def main() -> int:
    """Run the node."""
    return run_node(LimbTwinNode)
