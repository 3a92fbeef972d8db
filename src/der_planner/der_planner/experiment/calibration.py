"""The calibration on the running graph: timed pressures from the orchestrator, no planner."""

from __future__ import annotations

import uuid
from pathlib import Path
from typing import Any

from der_msgs.msg import PressureSetpoint, PressureState
from der_planner.experiment.client import GraphClient
from der_planner.experiment.graph_run import GraphPlayer, GraphRun, Playing
from der_planner.experiment.node_specs import Hardware, NodeSpec, node_specs
from der_planner.experiment.progress import Progress
from der_planner.identification import Excitation
from der_planner.limb import Limb
from der_planner.planning.streaming import GRID, first_stamp
from limb_interfaces import qos, stamps, topics

LEAD = 200_000_000
"""A setpoint is sent at least this much [ns] before its stamp."""
LOOK = 50_000_000
"""Largest time [ns] between two looks at what is due."""


class GraphCalibration(GraphPlayer):
    """Plays the pressures of a calibration; use `play`.

    Args:
        excitation: pressures to play, on the grid of 50 ms.
        folder: gets the bag (``bag``) and the nodes' logs (``logs``).
        metadata: stored in the bag.
        progress: shows what happens.
        limb: whose gravity and masses the twin gets; None: no loads.
        seed: of the twin.
        hardware: in place of the twin.
    """

    def __init__(
        self,
        excitation: Excitation,
        folder: Path,
        metadata: dict[str, Any],
        progress: Progress,
        *,
        limb: Limb | None = None,
        seed: int = 0,
        hardware: Hardware | None = None,
    ) -> None:
        super().__init__(folder / "logs", hardware, progress)
        self._excitation = excitation
        self._bag = folder / "bag"
        self._metadata = metadata
        self._limb = limb
        self._seed = seed
        # The driver refuses a plan that it has heard before an arming: each run has its own.
        self._plan_id = f"calibration-{uuid.uuid4().hex[:8]}"
        self._start_stamp = 0
        self._next = 0
        self._publisher: Any = None
        self._last_state: PressureState | None = None

    def play(self) -> GraphRun:
        """Play the calibration; see `GraphPlayer.play`. Says when setpoints were not executed."""
        run = super().play()
        state = self._last_state
        lost = state.setpoints_late + state.setpoints_refused if state is not None else 0
        if lost:
            self._progress.say(
                f"  WARNING: the driver did not take {lost} of {len(self._excitation.time)} "
                f"setpoints; its log in {self._logs} says why"
            )
        return run

    def _specs(self, port: str) -> list[NodeSpec]:
        return node_specs(
            port,
            self._bag,
            self._metadata,
            seed=self._seed,
            limb=self._limb,
            hardware=self._hardware,
        )

    def _join(self, client: GraphClient) -> None:
        client.subscribe(PressureState, topics.PRESSURE_STATE, qos.STATES, self._keep_state)
        # Before the nodes start, so that the recorder knows the topic when it begins to record.
        self._publisher = client.node.create_publisher(
            PressureSetpoint, topics.PRESSURE_SETPOINT, qos.SETPOINTS
        )

    def _keep_state(self, state: PressureState) -> None:
        self._last_state = state

    def _begin(self, client: GraphClient) -> Playing:
        client.wait_for(self._publisher.get_subscription_count, 30.0, "the driver to listen")
        self._start_stamp = first_stamp(_now(client) + 2 * LOOK, LEAD)
        self._next = 0
        return Playing(
            self._start_stamp / stamps.NANOSECONDS,
            float(self._excitation.time[-1]),
            lambda: self._send_due(_now(client)),
        )

    def _send_due(self, now: int) -> None:
        """Publish every setpoint that must be under way before the next look."""
        while self._next < len(self._excitation.time):
            stamp = self._start_stamp + self._next * GRID
            if stamp - now > LEAD + LOOK:
                return
            setpoint = PressureSetpoint(plan_id=self._plan_id, index=self._next)
            setpoint.header.stamp = stamps.stamp_from_nanoseconds(stamp)
            setpoint.header.frame_id = topics.BASE_FRAME
            values = self._excitation.differential_pressure[self._next]
            setpoint.differential_pressure = values.tolist()
            self._publisher.publish(setpoint)
            self._next += 1


def _now(client: GraphClient) -> int:
    return int(client.node.get_clock().now().nanoseconds)
