"""The driver and the emulated board as running nodes: runs, faults, what is refused."""

import os
import time
import uuid

import numpy as np
import pytest
from driver_bench import PERIOD, difference
from std_msgs.msg import Float64MultiArray

from der_msgs.msg import PressureState
from limb_interfaces import qos
from limb_interfaces.stamps import nanoseconds

pytestmark = pytest.mark.graph


@pytest.mark.parametrize("protocol", ["ezloop", "ctrlp", "native"])
def test_a_run_from_arming_to_the_end_of_the_process(bench, protocol):
    run = bench(protocol)
    assert run.mode in (-1, PressureState.DISARMED)
    run.arm()
    wanted = run.play(24, lambda k: (200.0 * (k + 1), -100.0 * (k + 1)))
    # Setpoints stop: hold, ramp down, vented.
    run.wait_mode(PressureState.HOLDING)
    run.wait_mode(PressureState.VENTING)
    run.wait_mode(PressureState.ARMED)
    run.wait(run.vented, "vented chambers")
    assert nanoseconds(run.air[-1].header.stamp) - max(wanted) < 20_000_000_000
    state = run.states[-1]
    counters = (
        state.setpoints_accepted,
        state.setpoints_late + state.setpoints_duplicate + state.setpoints_refused,
    )
    received = {}
    for command in run.commands:
        key = tuple(np.round(difference(command), -1))
        received.setdefault(key, nanoseconds(command.header.stamp))
    # A machine that stalls for seconds may make setpoints late; none may then be played.
    assert sum(counters) == len(wanted)
    in_time = [
        received[key] - stamp
        for stamp, u in wanted.items()
        if (key := tuple(np.round(u, -1))) in received
    ]
    assert len(in_time) >= 1
    assert min(in_time) >= 0
    assert state.bytes_sent > 1000
    assert state.bytes_received > 1000
    if protocol == "ezloop":
        assert np.isnan(state.round_trip)
    else:
        run.wait(lambda: run.states[-1].round_trip > 0.0, "the echo of a command")
    assert np.isfinite(state.supply_pressure) == (protocol != "ctrlp")
    assert run.client.call("pressure_driver/vent")
    run.wait_mode(PressureState.DISARMED)
    assert run.vented()
    ticks = [nanoseconds(s.header.stamp) for s in run.states]
    assert all(tick % PERIOD == 0 for tick in ticks if tick)
    assert ticks == sorted(ticks)
    assert run.driver.stop() == 0
    assert run.board.stop() == 0
    assert not os.path.lexists(run.link)


def test_cmd_u_t_is_taken_in_hectopascal(bench):
    run = bench(accept_cmd_u_t=True)
    run.arm()
    publisher = run.client.node.create_publisher(Float64MultiArray, "cmd_u_t", qos.SETPOINTS)
    run.wait(publisher.get_subscription_count, "the driver's subscription")

    def commanded():
        publisher.publish(Float64MultiArray(data=[12.0, -34.0]))
        return run.commands and difference(run.commands[-1]) == pytest.approx([1200.0, -3400.0])

    run.wait(commanded, "the command on the wire")
    assert run.states[-1].plan_id in ("", "cmd_u_t")


def refused(process, *words):
    deadline = time.monotonic() + 60.0
    while process.alive and time.monotonic() < deadline:
        time.sleep(0.05)
    assert process.exit_code == 1, process.last_words()
    for word in words:
        assert word in process.last_words(), process.last_words()


def test_what_cannot_work_is_refused_at_the_start(graph, bench):
    missing = graph.start("pressure_driver", "pressure_driver", name="a", port="/dev/ttyNOWHERE")
    contradiction = graph.start("pressure_driver", "pressure_driver", name="b", over_pressure=2e4)
    protocol = graph.start("pressure_driver", "pressure_driver", name="c", protocol="modbus")
    limit = graph.start("pressure_driver", "pressure_driver", name="d", pressure_limit=-5.0)
    link = f"/tmp/der_limb_board_test_{uuid.uuid4().hex[:8]}"
    fault = graph.start("pressure_driver", "board_emulator", name="e", faults="jam", port_link=link)
    refused(missing, "/dev/ttyNOWHERE", "ports that exist", "'port'")
    refused(contradiction, "over_pressure", "pressure_limit")
    refused(protocol, "protocol", "ezloop, ctrlp, native")
    refused(limit, "pressure_limit")
    refused(fault, "jam", "stick:CHAMBER")
    assert not os.path.lexists(link)
    run = bench()
    second = graph.start("pressure_driver", "pressure_driver", name="second", port=run.link)
    refused(second, run.link, "in use", "fuser")
    run.driver.check()
