"""Every parameter of the driver node, declared once with unit, range and meaning."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from limb_interfaces.overrides import check_overrides
from limb_interfaces.parameters import ParameterError, declare
from pressure_driver.core import CoreSettings
from pressure_driver.grid import NANOSECONDS
from pressure_driver.protocols import NAMES
from pressure_driver.safety import SafetyLimits
from pressure_driver.schedule import ScheduleLimits
from pressure_driver.watch.limits import MonitorLimits

if TYPE_CHECKING:
    from rclpy.node import Node


@dataclass(frozen=True)
class DriverOptions:
    """The node's parameters, checked."""

    port: str
    protocol: str
    baud_rate: int
    real_time_priority: int
    accept_cmd_u_t: bool
    guardian: str
    core: CoreSettings


def read_parameters(node: Node) -> DriverOptions:
    """Declare and check the driver's parameters.

    Raises:
        ParameterError: a value is out of range, or two contradict each other; names them.
    """

    def number(name: str, default: float, text: str, low: float, high: float) -> Any:
        return declare(node, name, default, text, at_least=low, at_most=high)

    port = declare(
        node,
        "port",
        "/dev/ttyACM0",
        "serial port of the board; /dev/serial/by-id names survive re-plugging",
    )
    protocol = declare(node, "protocol", "ezloop", "language of the board", choices=NAMES)
    baud_rate = number("baud_rate", 0, "[baud] 0: what the protocol says", 0, 4_000_000)
    priority = number("real_time_priority", 10, "SCHED_FIFO priority, 0: none", 0, 90)
    cmd_u_t = declare(
        node,
        "accept_cmd_u_t",
        False,
        "also take std_msgs/Float64MultiArray in hPa on cmd_u_t, in force at once",
    )
    guardian = declare(
        node,
        "guardian",
        "auto",
        "a process that vents if the driver dies or hangs; auto: for boards without a watchdog",
        choices=("auto", "always", "never"),
    )
    core = _core_settings(node, number)
    # A misspelt limit must not leave the default in force.
    check_overrides(node, refuse=True)
    return DriverOptions(
        str(port), str(protocol), int(baud_rate), int(priority), bool(cmd_u_t), str(guardian), core
    )


def _core_settings(node: Node, number: Any) -> CoreSettings:
    rate = number("rate", 20.0, "[Hz] ticks, on an absolute grid", 1.0, 100.0)
    interpolation = declare(
        node, "interpolation", "hold", "between setpoints", choices=("hold", "linear")
    )
    atmosphere = number(
        "atmosphere", 0.0, "[Pa] absolute pressure of the room; 0: measure it at rest", 0.0, 1.1e5
    )
    validity = number(
        "command_validity",
        0.25,
        "[s] a command holds on a board that has a watchdog",
        0.06,
        10.0,
    )
    core = CoreSettings(
        schedule=_schedule_limits(number),
        monitor=_monitor_limits(node, number),
        safety=_safety_limits(number),
        period=round(NANOSECONDS / rate),
        interpolate=interpolation == "linear",
        atmosphere=float(atmosphere),
        command_validity=float(validity),
    )
    _check_together(core)
    return core


def _schedule_limits(number: Any) -> ScheduleLimits:
    return ScheduleLimits(
        segment_count=number("segment_count", 2, "M, pairs of chambers", 1, 16),
        pressure_limit=number(
            "pressure_limit", 24_000.0, "[Pa] largest differential pressure", 0.0, 100_000.0
        ),
        slew_limit=number(
            "slew_limit", 200_000.0, "[Pa/s] of setpoints and of what is commanded", 1.0, 1e7
        ),
        horizon=number("horizon", 10.0, "[s] a setpoint's stamp may lie ahead", 0.1, 3600.0),
    )


def _monitor_limits(node: Node, number: Any) -> MonitorLimits:
    default = MonitorLimits()
    return MonitorLimits(
        telemetry_timeout=number(
            "telemetry_timeout", default.telemetry_timeout, "[s] without telemetry", 0.06, 60.0
        ),
        over_pressure=number(
            "over_pressure", default.over_pressure, "[Pa] gauge in any chamber", 1.0, 200_000.0
        ),
        supply_low=number(
            "supply_low", default.supply_low, "[Pa] absolute, smallest supply", 0.0, 1e6
        ),
        supply_high=number(
            "supply_high", default.supply_high, "[Pa] absolute, largest supply", 0.0, 1e6
        ),
        supply_time=number(
            "supply_time", default.supply_time, "[s] the supply may be outside", 0.0, 60.0
        ),
        supply_required=bool(
            declare(
                node,
                "supply_required",
                default.supply_required,
                "arm only with a fresh reading of the supply, where the protocol tells it",
            )
        ),
        **_following_limits(number, default),
        **_slow_limits(number, default),
        vented_tolerance=number(
            "vented_tolerance",
            default.vented_tolerance,
            "[Pa] gauge that counts as vented",
            10.0,
            5_000.0,
        ),
    )


def _following_limits(number: Any, default: MonitorLimits) -> dict[str, Any]:
    """Return the bounds of chambers that follow in seconds."""
    return {
        "follow_tolerance": number(
            "follow_tolerance",
            default.follow_tolerance,
            "[Pa] beyond the normal response of a chamber",
            100.0,
            100_000.0,
        ),
        "follow_time": number(
            "follow_time", default.follow_time, "[s] a chamber may be outside of it", 0.1, 60.0
        ),
        "slowest_fill": number(
            "slowest_fill", default.slowest_fill, "[Pa/s] of a working valve", 100.0, 1e6
        ),
        "slowest_vent": number(
            "slowest_vent", default.slowest_vent, "[s] time constant of a working valve", 0.05, 60.0
        ),
    }


def _slow_limits(number: Any, default: MonitorLimits) -> dict[str, Any]:
    """Return the bounds of slow leaks, and of boards that no longer hear."""
    return {
        "leak_time": number(
            "leak_time",
            default.leak_time,
            "[s] over which slow leaks are looked for; longer than a fill of a chamber",
            2.0,
            600.0,
        ),
        "leak_tolerance": number(
            "leak_tolerance",
            default.leak_tolerance,
            "[Pa] a chamber may lie below its command in the mean of leak_time; choose some times "
            "what a sound limb shows at steady pressure",
            50.0,
            100_000.0,
        ),
        "leak_opening": number(
            "leak_opening",
            default.leak_opening,
            "mean opening of an inlet at steady pressure that is no leak; choose twice what "
            "valve_opening shows there, 1: do not look",
            0.0,
            1.0,
        ),
        "probe_pressure": number(
            "probe_pressure",
            default.probe_pressure,
            "[Pa] by which a steady command is changed for a moment to see whether a board without "
            "echo hears; choose more than the dead band of its valves, 0: never",
            0.0,
            2_000.0,
        ),
        "probe_interval": number(
            "probe_interval",
            default.probe_interval,
            "[s] a command is steady before it is changed for a moment",
            5.0,
            3600.0,
        ),
    }


def _safety_limits(number: Any) -> SafetyLimits:
    default = SafetyLimits()
    return SafetyLimits(
        setpoint_timeout=number(
            "setpoint_timeout",
            default.setpoint_timeout,
            "[s] without a next setpoint until HOLDING",
            0.05,
            60.0,
        ),
        hold_time=number(
            "hold_time", default.hold_time, "[s] of HOLDING until the ramp down", 0.0, 600.0
        ),
        vent_rate=number("vent_rate", default.vent_rate, "[Pa/s] of the ramp down", 100.0, 1e6),
        vent_timeout=number(
            "vent_timeout", default.vent_timeout, "[s] a `vent` may take", 0.5, 120.0
        ),
    )


def _check_together(core: CoreSettings) -> None:
    """Refuse values that are fine alone and wrong together."""
    if core.monitor.supply_low >= core.monitor.supply_high:
        raise ParameterError(
            f"parameters 'supply_low' ({core.monitor.supply_low:g} Pa) and 'supply_high' "
            f"({core.monitor.supply_high:g} Pa): the first must be smaller"
        )
    if core.monitor.over_pressure <= core.schedule.pressure_limit:
        raise ParameterError(
            f"parameters 'over_pressure' ({core.monitor.over_pressure:g} Pa) and 'pressure_limit' "
            f"({core.schedule.pressure_limit:g} Pa): the first must be larger, or every full "
            "command would end in a fault"
        )
    period = core.period / NANOSECONDS
    if core.command_validity <= period:
        raise ParameterError(
            f"parameters 'command_validity' ({core.command_validity:g} s) and 'rate' "
            f"({1.0 / period:g} Hz): a command must stay valid until the next tick"
        )
