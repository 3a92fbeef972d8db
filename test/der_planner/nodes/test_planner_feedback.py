"""Feedback of the planner node: revisions in time, estimates, lost tags, and slow solutions."""

import threading
import time

import numpy as np
import pytest

pytestmark = pytest.mark.graph


@pytest.fixture
def limb(graph):
    """Return a planner with feedback, and a limb that bends by 0.8 of what the plan expects."""
    from der_msgs.msg import (
        LimbEstimate,
        LimbState,
        MotionCommand,
        PressurePlan,
        PressureSetpoint,
        PressureState,
    )
    from limb_interfaces import qos, topics
    from limb_interfaces.stamps import nanoseconds, stamp_from_nanoseconds

    class Limb:
        def __init__(self):
            self.client, self.seen, self.running = graph.client, True, True
            self.setpoints, self.estimates, self.plans = [], [], []
            subscribe = self.client.subscribe
            subscribe(PressureSetpoint, topics.PRESSURE_SETPOINT, qos.SETPOINTS, self._keep)
            subscribe(LimbEstimate, topics.ESTIMATE, qos.STATES, self.estimates.append)
            subscribe(PressurePlan, topics.PLAN, qos.LATCHED, self.plans.append)
            node = self.client.node
            self.commands = node.create_publisher(MotionCommand, topics.COMMAND, qos.COMMANDS)
            self._states = node.create_publisher(LimbState, topics.LIMB_STATE, qos.STATES)
            self._driver = node.create_publisher(PressureState, topics.PRESSURE_STATE, qos.STATES)
            graph.start("der_planner", "planner")
            self.client.wait_ready(["planner"])
            self.client.wait_for(self.commands.get_subscription_count, 30.0, "the planner")
            self._thread = threading.Thread(target=self._live, daemon=True)
            self._thread.start()

        def _keep(self, message):
            self.setpoints.append((self.now(), message))

        def now(self):
            return self.client.node.get_clock().now().nanoseconds

        def play(self):
            self.commands.publish(
                MotionCommand(
                    motion="same_direction",
                    model="der",
                    amplitude=0.6,
                    period=4.0,
                    cycles=1,
                    feedback=True,
                    plan_id="corrected",
                )
            )
            return self.client.wait_for(lambda: self.plans, 60.0, "a plan")[0]

        def _in_force(self, stamp):
            """Return the pressures that hold at an instant: the newest revision of each."""
            found = {}
            for _, message in list(self.setpoints):
                at = nanoseconds(message.header.stamp)
                if at <= stamp:
                    found[at] = message.differential_pressure
            return np.array(found[max(found)]) if found else np.zeros(2)

        def _live(self):
            """Show 0.8 of the bend that the default limb has under the pressures, at 30 Hz."""
            gain, held = 6.34e-5, np.zeros(2)
            while self.running:
                stamp = self.now()
                held = held + 0.2 * (self._in_force(stamp) - held)
                driver = PressureState(mode=PressureState.ARMED, telemetry_age=0.0)
                driver.measured_differential = held.tolist()
                driver.header.stamp = stamp_from_nanoseconds(stamp)
                self._driver.publish(driver)
                state = LimbState(valid=self.seen, bend_angle=(0.8 * gain * held).tolist())
                state.bend_angle_sigma = [2e-3, 2e-3]
                state.tip.x = state.tip.y = float("nan")
                state.header.stamp = driver.header.stamp
                if self.seen:
                    self._states.publish(state)
                time.sleep(0.033)

        def close(self):
            self.running = False
            self._thread.join(timeout=5.0)

    each = Limb()
    yield each
    each.close()


def test_setpoints_are_revised_in_time_until_the_tags_are_lost(limb):
    from limb_interfaces.stamps import nanoseconds

    plan = limb.play()
    planned = np.array(plan.differential_pressure).reshape(-1, 2)
    assert plan.method.endswith("feedback")
    revised = limb.client.wait_for(
        lambda: [(at, m) for at, m in limb.setpoints if m.revision and m.index > 40], 60.0, "one"
    )
    limb.client.wait_for(lambda: len(limb.estimates) > 40, 60.0, "estimates")
    early = [nanoseconds(m.header.stamp) - at for at, m in revised]
    assert np.median(early) > 0
    index = revised[-1][1].index
    added = np.array(revised[-1][1].differential_pressure) - planned[index]
    # The limb bends too little: more pressure is wanted of both segments.
    assert np.all(np.sign(added) == np.sign(planned[index]))
    estimate = limb.estimates[-1]
    assert estimate.plan_id == "corrected"
    assert len(estimate.curve) > 5
    assert 0.0 < estimate.solve_time < 1.0
    limb.seen = False
    limb.client.wait_for(
        lambda: any(e.reason == "tags lost" for e in limb.estimates), 60.0, "the reason"
    )


def test_solutions_that_take_too_long_never_hold_up_the_plan():
    """Every command comes too late: setpoints go out meanwhile, and then the plan is left alone."""
    from der_msgs.msg import LimbState
    from der_planner.control import Feedback
    from der_planner.limb import Limb
    from der_planner.nodes.planner_feedback import Corrector
    from der_planner.planning import Motion, plan
    from der_planner.planning.streaming import Schedule
    from limb_interfaces.stamps import stamp_from_nanoseconds

    class Slow(Feedback):
        def __init__(self, plan):
            super().__init__(plan)
            self.busy, self.released = threading.Event(), threading.Event()

        def command(self, instant):
            self.busy.set()
            self.released.wait(60.0)
            time.sleep(0.3)
            return super().command(instant)

    class Output:
        def setpoint(self, schedule, index, pressures, revision):
            said.append("revised")

        def estimate(self, *arguments, **about):
            pass

    said = []
    motion = Motion.named("same_direction", period=60.0, cycles=2)
    planned = plan(Limb.default(), motion, method="projected")
    slow = Slow(planned)
    corrector = Corrector(Output(), said.append, time.time_ns)
    schedule = Schedule("slow", planned, time.time_ns() - 1_000_000_000)
    corrector.follow(schedule, slow)
    assert slow.busy.wait(60.0)
    # It hangs in its first command; a setpoint's pressures are there all the same.
    np.testing.assert_array_equal(
        corrector.pressures(schedule, 30), planned.differential_pressure[30]
    )
    assert not slow.released.is_set()
    slow.released.set()
    deadline = time.monotonic() + 60.0
    while not any("late" in text for text in said) and time.monotonic() < deadline:
        state = LimbState(valid=True, bend_angle=[0.1, 0.1])
        state.header.stamp = stamp_from_nanoseconds(time.time_ns())
        corrector.add_state(state)
        time.sleep(0.02)
    corrector.close()
    assert any("late" in text for text in said)
    assert "revised" not in said
    assert slow.reason == "late"
