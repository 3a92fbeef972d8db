"""What is played on the graph: a trial of a planned motion, or the pressures of a calibration."""

from __future__ import annotations

import math
import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path as PathMessage

from der_msgs.msg import MotionCommand, PressurePlan, PressureSetpoint
from der_planner.experiment.client import GraphClient
from der_planner.experiment.console import Progress, interrupt_once
from der_planner.experiment.graph_run import running_graph
from der_planner.experiment.options import TrialRun
from der_planner.experiment.processes import GraphError, GraphSetup, Hardware
from der_planner.identification.excitation import Excitation
from der_planner.limb import Limb
from der_planner.methods import LEARNED
from der_planner.planning import paths
from der_planner.planning.streaming import GRID, first_stamp
from limb_interfaces import qos, stamps, topics

PLAN_TIMEOUT = 120.0
"""A plan is waited for this long [s]."""
LEAD = 200_000_000
"""A setpoint of a calibration is sent at least this much [ns] before its stamp."""
PAUSE = 50_000_000
"""What is due is looked for again after this time [ns] at the latest."""


# A trial -----------------------------------------------------------------------------------------


def play_on_graph(run: TrialRun, progress: Progress) -> dict[str, Any]:
    """Play a run on the graph; return what is kept of it beside its bag.

    Raises:
        GraphError: a node is not ready, the planner refuses, the driver reports a fault.
        NodeError: a node cannot be started or has died.
    """
    options, name = run.options, run.trial.name
    setup = GraphSetup(
        _bag_folder(options.out, name),
        run.metadata,
        seed=run.trial.seed,
        run=run.trial.run - 1,
        limb=run.limb,
        hardware=options.hardware,
        board=options.board,
        planner=_planner_parameters(run),
        record_images=options.record_images,
        poses=options.poses,
        obstacles=options.in_the_way,
    )
    drawn = options.path if run.learned is None else None
    asked = _path(drawn) if drawn is not None else _command(run)
    with GraphClient() as client:
        client.subscribe(PressurePlan, topics.PLAN, qos.LATCHED)
        topic = topics.PATH if drawn is not None else topics.COMMAND
        publisher = client.node.create_publisher(type(asked), topic, qos.COMMANDS)

        def planner_listens() -> bool:
            # The recorder may listen, too.
            found = client.node.get_subscriptions_info_by_topic(publisher.topic_name)
            return any(info.node_name == "planner" for info in found)

        with running_graph(client, setup, options.out / "logs" / name, progress) as graph:
            client.wait_for(planner_listens, 30.0, "the planner to listen")
            client.newest.pop(topics.PLAN, None)
            publisher.publish(asked)
            plan = client.wait_for(lambda: _plan_of(run, client), PLAN_TIMEOUT, "the plan")
            progress.say(
                f"  planned in {plan.solve_time:.2f} s, "
                f"predicted error {plan.predicted_error * 100:.2f} cm"
            )
            shown: list[str] = []

            def show_warning() -> None:
                warning = warning_of(client.diagnostic_values("planner"), plan.plan_id)
                if warning and not shown:
                    shown.append(warning)
                    progress.say(f"  warning: {warning}")

            graph.play(stamps.seconds(plan.header.stamp), float(plan.time[-1]), show_warning)
    factor = graph.real_time_factor
    return {
        "bag": str(graph.bag.relative_to(options.out)),
        "plan_id": plan.plan_id,
        "twin_real_time_factor": None if math.isnan(factor) else round(factor, 3),
    }


def _bag_folder(out: Path, name: str) -> Path:
    """Return the folder of a run's bag; what a stopped run has left goes to ``stopped/``."""
    bag, logs, stopped, number = out / "bags" / name, out / "logs" / name, out / "stopped", 1
    while (stopped / f"{name}_{number}").exists() or (stopped / f"{name}_{number}_logs").exists():
        number += 1
    for left, kept in ((bag, f"{name}_{number}"), (logs, f"{name}_{number}_logs")):
        if left.exists():
            stopped.mkdir(exist_ok=True)
            left.rename(stopped / kept)
    return bag


def _planner_parameters(run: TrialRun) -> dict[str, Any]:
    trial, options = run.trial, run.options
    parameters: dict[str, Any] = {
        "limb_file": str(run.limb_file or ""),
        **options.load._asdict(),
        "feedback": trial.feedback,
        "reaction": options.reaction,
        "force_limit": options.force_limit,
        "obstacles": str(options.obstacles or ""),
    }
    if run.learned is not None:
        parameters["learned_plans"] = str(run.learned.parent)
    elif options.path is not None:
        # A path names no model: it gets the planner's defaults.
        parameters |= {"default_model": trial.model, "default_method": trial.method}
        parameters["nearest_path"] = options.nearest
    return parameters


def _path(file: Path) -> PathMessage:
    """Return the path in a file; stamps are relative, all zero for a path without times."""
    time, tip = paths.read_csv(file)
    message = PathMessage()
    message.header.frame_id = topics.BASE_FRAME
    for index, (x, y) in enumerate(tip):
        pose = PoseStamped()
        pose.header.frame_id = topics.BASE_FRAME
        if time is not None:
            since = round((float(time[index]) - float(time[0])) * stamps.NANOSECONDS)
            pose.header.stamp = stamps.stamp_from_nanoseconds(since)
        pose.pose.position.x, pose.pose.position.y = float(x), float(y)
        message.poses.append(pose)
    return message


def _command(run: TrialRun) -> MotionCommand:
    trial, options, learned = run.trial, run.options, run.learned
    return MotionCommand(
        # A learned plan's name stands in place of the motion's.
        motion=trial.motion if learned is None else learned.stem,
        model=trial.model,
        method=trial.method if learned is None else LEARNED,
        amplitude=options.amplitude,
        period=options.period,
        cycles=options.cycles,
        plan_id=trial.name,
    )


def _plan_of(run: TrialRun, client: GraphClient) -> PressurePlan | None:
    """Return the planner's answer; None while it plans.

    Raises:
        GraphError: the planner has refused.
    """
    plan = client.newest.get(topics.PLAN)
    named = run.options.path is None
    if plan is not None and (plan.plan_id == run.trial.name or not named):
        return plan
    told = client.diagnostic_values("planner")
    if told.get("state") == "refused":
        raise GraphError(f"the planner refused: {told.get('reason', 'no reason given')}")
    return None


def warning_of(told: Mapping[str, str], plan_id: str) -> str:
    """Return what the planner's diagnostics warn of a plan that is played; empty: nothing.

    Raises:
        GraphError: the plan was ended by a vent, a silent driver or a cancellation.
    """
    if told.get("plan_id") != plan_id:
        return ""
    state, reason = told.get("state"), told.get("reason", "")
    if state in ("vented", "lost", "idle"):
        raise GraphError(f"the motion was not played to its end: {reason}")
    return reason if state == "streaming" else ""


# A calibration -----------------------------------------------------------------------------------


def play_calibration(
    excitation: Excitation,
    folder: Path,
    prior: Limb,
    seed: int = 0,
    hardware: Hardware | None = None,
) -> Path:
    """Play the pressures of a calibration; say when the driver did not take all of them.

    A signal ends it with the limb vented.

    Args:
        excitation: pressures to play, on the grid of 50 ms.
        folder: gets the bag (``bag``) and the nodes' logs (``logs``).
        prior: whose gravity and masses the twin gets.
        seed: of the twin.
        hardware: in place of the twin.

    Returns:
        The bag.

    Raises:
        GraphError, NodeError: as `play_on_graph`.
    """
    interrupt_once()
    progress, count = Progress(), len(excitation.time)
    real = hardware is not None and hardware.twin is None
    stage = f"the hardware at {hardware.place}" if hardware and real else f"the twin of seed {seed}"
    progress.say(f"playing {excitation.duration:.0f} s on {stage}, into {folder}")
    metadata = {
        "motion": excitation.name,
        "stage": stage,
        "seed": None if real else seed,
        "largest_pressure_Pa": float(np.abs(excitation.differential_pressure).max()),
        "prior": prior.name,
    }
    setup = GraphSetup(folder / "bag", metadata, seed=seed, limb=prior, hardware=hardware)
    # The driver refuses a plan that it has heard before an arming: each run has its own.
    plan_id = f"{excitation.name}-{uuid.uuid4().hex[:8]}"
    sent = 0
    with GraphClient() as client:
        publisher = client.node.create_publisher(
            PressureSetpoint, topics.PRESSURE_SETPOINT, qos.SETPOINTS
        )
        with running_graph(client, setup, folder / "logs", progress) as graph:
            client.wait_for(publisher.get_subscription_count, 30.0, "the driver to listen")
            first = first_stamp(_now(client) + 2 * PAUSE, LEAD)

            def send_due() -> None:
                """Publish every setpoint that must be under way before the next look."""
                nonlocal sent
                while sent < count and first + sent * GRID - _now(client) <= LEAD + PAUSE:
                    setpoint = PressureSetpoint(plan_id=plan_id, index=sent)
                    setpoint.header.stamp = stamps.stamp_from_nanoseconds(first + sent * GRID)
                    setpoint.header.frame_id = topics.BASE_FRAME
                    values = excitation.differential_pressure[sent]
                    setpoint.differential_pressure = values.tolist()
                    publisher.publish(setpoint)
                    if sent in excitation.prompts:
                        progress.say(excitation.prompts[sent])
                    sent += 1

            graph.play(first / stamps.NANOSECONDS, float(excitation.time[-1]), send_due)
        state = client.newest[topics.PRESSURE_STATE]
    lost = state.setpoints_late + state.setpoints_refused
    if lost:
        progress.say(
            f"  WARNING: the driver did not take {lost} of {count} setpoints; its log in "
            f"{folder / 'logs'} says why"
        )
    progress.say(f"bag: {graph.bag}")
    return graph.bag


def _now(client: GraphClient) -> int:
    return int(client.node.get_clock().now().nanoseconds)
