"""``ros2 action`` of the stand-in, against an action server in this process."""

from __future__ import annotations

import signal
import subprocess
import threading
import time

import pytest
from test.scripts.test_ros2 import DOMAIN, listed, ros2, start

TYPE = "der_msgs/action/PlayMotion"


class Player:
    """Serves `play`: says how far it is, and how it ended, in its own thread."""

    def __init__(self) -> None:
        import rclpy
        from rclpy.action import ActionServer, CancelResponse
        from rclpy.context import Context
        from rclpy.executors import MultiThreadedExecutor

        from der_msgs.action import PlayMotion

        self.kind = PlayMotion
        self.cancelled = False
        self.released = threading.Event()
        self._context = Context()
        rclpy.init(context=self._context, domain_id=DOMAIN)
        self._node = rclpy.create_node("player", context=self._context)
        ActionServer(
            self._node,
            PlayMotion,
            "play",
            self._play,
            cancel_callback=lambda _: CancelResponse.ACCEPT,
        )
        self._executor = MultiThreadedExecutor(2, context=self._context)
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._executor.spin, daemon=True)
        self._thread.start()

    def _play(self, goal):
        result = self.kind.Result(plan_id=goal.request.command.motion, tip_error=0.25)
        goal.publish_feedback(self.kind.Feedback(state="streaming", progress=0.5))
        if goal.request.command.motion == "endless":
            while not goal.is_cancel_requested:
                time.sleep(0.01)
            self.cancelled = True
            goal.canceled()
            return result
        if goal.request.command.motion == "deaf":
            self.released.wait(60.0)
        goal.succeed()
        return result

    def close(self) -> None:
        self._executor.shutdown()
        self._thread.join(5.0)
        self._node.destroy_node()
        self._context.try_shutdown()


@pytest.fixture(scope="module")
def player():
    server = Player()
    yield server
    server.close()


@pytest.mark.graph
def test_actions_are_listed(player: Player):
    # Others may be there: a planner of another test that was killed a moment ago.
    assert f"/play [{TYPE}]" in listed(f"/play [{TYPE}]", "action", "list", "-t")


@pytest.mark.graph
def test_a_goal_is_sent_and_its_feedback_and_result_shown(player: Player):
    answer = ros2("action", "send_goal", "-f", "/play", TYPE, "{command: {motion: star}}")
    assert answer.returncode == 0, answer.stderr
    for text in ("state: streaming", "plan_id: star", "tip_error: 0.25", "status: SUCCEEDED"):
        assert text in answer.stdout, answer.stdout
    answer = ros2("action", "send_goal", "/play", TYPE, "{command: {motions: star}}")
    assert answer.returncode == 1
    assert "motions" in answer.stderr


def streaming(motion: str) -> subprocess.Popen[str]:
    """Start a goal and wait for its feedback."""
    goal = f"{{command: {{motion: {motion}}}}}"
    process = start("action", "send_goal", "-f", "/play", TYPE, goal)
    assert process.stdout is not None
    heard = ""
    while "streaming" not in heard:
        line = process.stdout.readline()
        assert line, process.communicate()
        heard += line
    return process


@pytest.mark.graph
def test_ctrl_c_cancels_the_goal(player: Player):
    process = streaming("endless")
    process.send_signal(signal.SIGINT)
    said, complaint = process.communicate(timeout=60)
    assert player.cancelled, complaint
    assert "status: CANCELED" in said
    assert process.returncode == 1


@pytest.mark.graph
def test_a_second_ctrl_c_ends_the_waiting_for_a_server_that_does_not_answer(player: Player):
    process = streaming("deaf")
    assert process.stderr is not None
    process.send_signal(signal.SIGINT)
    assert "Canceling goal" in process.stderr.readline()
    process.send_signal(signal.SIGINT)
    _, complaint = process.communicate(timeout=60)
    player.released.set()
    assert process.returncode == 1
    assert "the goal may still be carried out" in complaint
