"""``ros2 action``: the actions of the graph."""

from __future__ import annotations

import argparse
import signal
import sys
from typing import Any

import rclpy
from action_msgs.msg import GoalStatus
from rclpy.action import ActionClient, get_action_names_and_types

from ros2_verbs.cli import CommandError, add_verb, add_verbs
from ros2_verbs.filling import Filler, values_of
from ros2_verbs.messages import interface, to_yaml
from ros2_verbs.session import Session, add_session_arguments, print_names

_ENDS = {
    GoalStatus.STATUS_SUCCEEDED: "SUCCEEDED",
    GoalStatus.STATUS_CANCELED: "CANCELED",
    GoalStatus.STATUS_ABORTED: "ABORTED",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the verbs of ``ros2 action`` and their arguments."""
    verbs = add_verbs(parser, "action")
    lister = add_verb(verbs, "list", "Output a list of action names", _list)
    add_session_arguments(lister)
    lister.add_argument(
        "-t", "--show-types", action="store_true", help="Additionally show the action type"
    )
    send = add_verb(verbs, "send_goal", "Send an action goal", _send_goal)
    send.add_argument("action_name", help="Name of the ROS action")
    send.add_argument("action_type", help="Type of the ROS action")
    send.add_argument("goal", help="Goal request values in YAML format (e.g. '{order: 10}')")
    send.add_argument(
        "-f", "--feedback", action="store_true", help="Echo feedback messages for the goal"
    )


def _list(options: argparse.Namespace) -> None:
    with Session(options) as session:
        session.discover()
        found = dict(sorted(get_action_names_and_types(session.node)))
    print_names(found, options.show_types)


def _send_goal(options: argparse.Namespace) -> int:
    kind = interface(options.action_type, "action")
    values = values_of(options.goal)
    goal = Filler(kind.Goal(), values).message
    with Session(options) as session:
        client = ActionClient(session.node, kind, options.action_name)
        print("Waiting for an action server to become available...")
        client.wait_for_server()
        # A flag instead of an exception, which would tear rclpy's waiting apart. From before the
        # goal is sent on: the server may move the limb before its answer is here.
        asked: list[int] = []
        signal.signal(signal.SIGINT, lambda number, _: asked.append(number))
        print(f"Sending goal:\n     {to_yaml(goal)}")
        sent = client.send_goal_async(goal, _show if options.feedback else None)
        handle = _result(session, sent, asked)
        if not handle.accepted:
            print("Goal was rejected.")
            return 1
        print(f"Goal accepted with ID: {bytes(handle.goal_id.uuid).hex()}\n")
        awaited = handle.get_result_async()
        cancelling = None
        while not awaited.done():
            _spin(session, asked)
            if asked and cancelling is None:
                # As the real tool: what was asked for is not left to run on alone.
                print("Canceling goal...", file=sys.stderr)
                cancelling = handle.cancel_goal_async()
        answer = _result(session, awaited, asked)
        print(f"Result:\n    {to_yaml(answer.result)}")
        status = _ENDS.get(answer.status, "UNKNOWN")
        print(f"Goal finished with status: {status}")
        client.destroy()
    return 0 if answer.status == GoalStatus.STATUS_SUCCEEDED else 1


def _show(message: Any) -> None:
    print(f"Feedback:\n    {to_yaml(message.feedback)}")


def _spin(session: Session, asked: list[int]) -> None:
    """Take what the server says; at the second Ctrl-C, wait for it no longer.

    Raises:
        CommandError: that was asked for.
    """
    rclpy.spin_once(session.node, timeout_sec=0.1)
    if len(asked) > 1:
        raise CommandError("the action server does not answer: the goal may still be carried out")


def _result(session: Session, future: Any, asked: list[int]) -> Any:
    """Wait for an answer of the server.

    Raises:
        CommandError: it is an error, or is waited for no longer.
    """
    while not future.done():
        _spin(session, asked)
    if future.result() is None:
        raise CommandError(f"Exception while calling the action: {future.exception()!r}")
    return future.result()
