"""What the board says is doubted: supply, rest pressures, numbers that are none, floods of text."""

import numpy as np
import pytest

from pressure_driver.protocols import NAMES
from pressure_driver.safety import Mode

# ---------------------------------------------------------------------------------- supply


def without(sim, tag):
    """Have the board leave out the lines that begin with a tag."""
    telemetry = sim.board.telemetry

    def fewer():
        return b"".join(x for x in telemetry().splitlines(keepends=True) if not x.startswith(tag))

    sim.board.telemetry = fewer
    return telemetry


def test_arming_wants_a_reading_of_the_supply_where_the_protocol_tells_it(simulate):
    sim = simulate()
    telemetry = without(sim, b"[RPR]")
    sim.run(4.0)
    assert "has not told its supply" in sim.core.arm()[1]
    sim.board.telemetry = telemetry
    sim.tick()
    assert sim.core.arm()[0]
    # One that is not told any more is no reading either.
    without(sim, b"[RPR]")
    sim.run_until(lambda: sim.mode is Mode.FAULT, 1.5)
    assert "no reading of the supply" in sim.faults[0]
    assert "no reading of the supply" in sim.core.arm()[1]


def test_a_board_without_a_sensor_of_the_supply_needs_a_parameter(simulate):
    sim = simulate(supply_required=False)
    without(sim, b"[RPR]")
    sim.arm()
    sim.run(3.0)
    assert sim.mode is Mode.ARMED


def test_a_supply_that_is_not_a_number_is_a_fault(simulate):
    sim = simulate()
    sim.arm()
    without(sim, b"[RPR]")
    telemetry = sim.board.telemetry
    sim.board.telemetry = lambda: telemetry() + b"[RPR]: nan\r\n"
    sim.run_until(lambda: sim.mode is Mode.FAULT, 0.7)
    assert "not a number" in sim.faults[0]


# ------------------------------------------------------------------------------------- rest


def trap(sim, gauge):
    """Close every valve upon air."""
    sim.board.pneumatics._gauge[:] = gauge
    sim.have(*(f"stick:{chamber}" for chamber in range(4)))


@pytest.mark.parametrize("protocol", NAMES)
def test_air_trapped_in_all_chambers_is_not_taken_for_rest(simulate, protocol):
    sim = simulate(protocol, seed=2)
    trap(sim, 7_000.0)
    sim.run(10.0)
    success, text = sim.core.arm()
    assert not success
    assert "let trapped air out" in text
    assert sim.gauge.min() > 6_900.0
    # Once the valves open, the air goes and the zero is the room's.
    sim.have()
    sim.run_until(lambda: sim.core.arm()[0], 8.0)
    assert sim.vented
    # Most boards tell gauge pressures only.
    room = 101_325.0 if protocol not in ("ezloop", "native") else sim.board.pneumatics.atmosphere
    assert sim.core.monitor.rest.mean == pytest.approx(room, abs=250.0)


def test_with_the_rooms_pressure_given_less_trapped_air_is_seen_too(simulate):
    room = simulate(seed=2).board.pneumatics.atmosphere
    sim = simulate(seed=2, atmosphere=room + 100.0)
    trap(sim, 1_500.0)
    sim.run(10.0)
    assert "not vented yet" in sim.core.arm()[1]


def test_air_that_leaves_slowly_is_not_taken_for_rest(simulate):
    """50 Pa/s: within the spread of steady readings, and not at rest."""
    sim = simulate(seed=2)
    trap(sim, 2_500.0)
    for _ in range(200):
        sim.board.pneumatics._gauge -= 2.5
        sim.tick()
        assert not sim.core.arm()[0]
    sim.run_until(lambda: sim.core.arm()[0], 4.0)


def test_a_sensor_that_is_never_steady_is_named(simulate):
    sim = simulate(seed=2)
    for tick in range(100):
        sim.board.pneumatics._gauge[1] = 300.0 * (tick % 2)
        sim.tick()
    assert "the readings of chamber 1 differ by" in sim.core.arm()[1]


@pytest.mark.parametrize("protocol", NAMES)
def test_chambers_that_disagree_are_not_at_rest(simulate, protocol):
    sim = simulate(protocol)
    sim.board.pneumatics._gauge[2] = 1_800.0
    sim.have("stick:2")
    sim.run(6.0)
    assert "agree within" in sim.core.arm()[1]


@pytest.mark.parametrize("protocol", NAMES)
def test_rest_is_not_taken_again_from_chambers_that_rest_higher_than_before(simulate, protocol):
    sim = simulate(protocol, seed=2)
    sim.arm()
    sim.core.vent()
    sim.run_until(lambda: sim.mode is Mode.DISARMED)
    before = sim.core.monitor.rest.mean
    trap(sim, 2_000.0)
    sim.run(6.0)
    assert sim.core.monitor.rest.mean == pytest.approx(before, abs=20.0)
    assert "not vented yet" in sim.core.arm()[1]


@pytest.mark.parametrize("protocol", NAMES)
def test_a_zero_that_was_trapped_air_shows_as_soon_as_it_escapes(simulate, protocol):
    """Too little to be implausible: the limb must not be played on with a wrong zero."""
    sim = simulate(protocol, seed=2)
    trap(sim, 2_000.0)
    sim.run_until(lambda: sim.core.arm()[0], 5.0)
    sim.have()
    sim.run_until(lambda: sim.mode is Mode.FAULT, 5.0)
    assert "below its rest pressure" in sim.faults[0]
    sim.run_until(lambda: sim.core.arm()[0], 8.0)
    assert sim.vented
    assert np.abs(sim.core.monitor.gauge).max() < 250.0


# ------------------------------------------------------------------- numbers that are none


@pytest.mark.parametrize(("protocol", "word"), [("ezloop", b"nan"), ("ctrlp", b"nan")])
def test_a_sensor_that_reads_nan_in_three_of_four_lines_is_a_fault(simulate, protocol, word):
    sim = simulate(protocol)
    sim.arm()
    telemetry = sim.board.telemetry
    count = iter(range(10**6))

    def broken():
        report = telemetry()
        if next(count) % 4 == 0:
            return report
        lines = report.splitlines(keepends=True)
        # The chambers are told first by one board and last by the other.
        place, separator = (0, b" ") if protocol == "ezloop" else (-1, b"\t")
        parts = lines[place].split()
        lines[place] = separator.join([*parts[:-1], word]) + b"\r\n"
        return b"".join(lines)

    sim.board.telemetry = broken
    sim.run_until(lambda: sim.mode is Mode.FAULT, 2.5)
    assert "no plausible reading" in sim.faults[0] or "damaged telemetry" in sim.faults[0]
    assert not sim.core.arm()[0]
    sim.board.telemetry = telemetry
    sim.run_until(lambda: sim.core.arm()[0], 5.0)


def test_a_few_bad_readings_are_only_skipped(simulate):
    sim = simulate()
    sim.arm()
    for _ in range(20):
        sim.core.received(b"[MPR]: nan 1013.00 1013.00 1013.00\n")
        sim.run(0.5)
    assert sim.mode is Mode.ARMED
    assert np.isfinite(sim.core.state()["measured_chamber"]).all()


# --------------------------------------------------------------------------- faults and texts


def test_a_further_fault_while_in_fault_is_added(simulate):
    sim = simulate()
    sim.arm()
    sim.have("supply:300000")
    sim.run_until(lambda: sim.mode is Mode.FAULT, 1.0)
    assert len(sim.faults) == 1
    sim.have("supply:300000", "mute")
    sim.run(3.0)
    assert len(sim.faults) == 2
    assert "no telemetry" in sim.faults[1]
    sim.core.lost("serial link lost: pulled")
    sim.run(1.0)
    assert sim.faults[2:] == ("serial link lost: pulled",)


def test_text_of_the_board_is_logged_once_a_tick(simulate):
    sim = simulate()
    logged = []
    sim.core._log = lambda text, _: logged.append(text)
    sim.arm()
    logged.clear()
    for _ in range(200):
        sim.core.received(b"a\n" * 243)  # 9.7 kB/s
        sim.tick()
    texts = [text for text in logged if text == "board: a"]
    assert len(texts) == 200
    assert len(logged) == len(texts)
    assert sim.mode is Mode.ARMED


def test_reports_of_another_language_are_said_to_be_so(simulate):
    sim = simulate("ezloop")
    telemetry = sim.board.telemetry
    sim.board.telemetry = lambda: telemetry().replace(b".", b",")  # a decimal comma
    sim.run(3.0)
    (obstacle,) = sim.core.obstacles()
    assert "not of this language" in obstacle
    assert "(the last: [VAL]: 0,00" in obstacle
    assert not sim.core.arm()[0]


def test_a_board_of_which_nothing_is_understood_is_told_from_one_that_is_silent(simulate):
    sim = simulate("ezloop")
    telemetry = sim.board.telemetry
    sim.board.telemetry = lambda: b""
    sim.run(3.0)
    assert "look at its power, its cable" in sim.core.obstacles()[0]
    sim.board.telemetry = lambda: telemetry().replace(b"\n", b"\r")
    sim.run(3.0)
    assert "not of this language" in sim.core.obstacles()[0]


def test_telemetry_that_ends_with_damaged_lines_shows_one(simulate):
    sim = simulate("ezloop")
    sim.arm()
    sim.board.telemetry = lambda: b"[MPR]: 1013.2 ----- 1013.1 1013.3\n"
    sim.run(2.0)
    assert any("no telemetry" in text and "-----" in text for text in sim.core.obstacles())


def test_reports_in_another_unit_are_said_to_be_implausible(simulate):
    sim = simulate("ezloop")
    sim.board.telemetry = lambda: b"[MPR]: 101.33 101.32 101.30 101.35\n[RPR]: 140.0\n"  # kPa
    sim.run(3.0)
    assert "chamber 0 has no plausible reading: 10133 Pa" in sim.core.obstacles()[0]
