"""The parameters of the driver and of the emulated board, each declared once.

From here come what the nodes declare, the options of the `board` command, the limits of the state
machine and the files under `config/`: after a change, `python3 scripts/write_driver_parameters.py`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import MISSING, Field, dataclass, field, fields
from typing import Any, NamedTuple, TypeVar

from pressure_driver.protocols import NAMES, USUAL_LIMIT, SettingError, order_of

TERMINALS = ("vtem", "mpa")
TERMINAL = "valves of a `festo` terminal: a motion terminal, or VPPM regulators"
DEVICE = "number of a `pneudrive` board, which its address follows from"
SENSOR_RANGE = "of the sensors of a `pneudrive` board, whose counts are a thousandth of it"


class Declaration(NamedTuple):
    """What is known of one parameter beside its type and default."""

    text: str
    """What it means and how to choose it, for `ros2 param describe` and the README."""
    unit: str = ""
    range: tuple[float, float] | None = None
    """Smallest and largest admissible number."""
    derive: Callable[[float], float] | None = None
    """Returns what 0 stands for at a `pressure_limit`."""
    choices: tuple[str, ...] = ()
    """Admissible texts."""
    changeable: bool = False
    """Whether it may be set while the node runs."""

    @property
    def description(self) -> str:
        """The meaning with the unit."""
        return f"[{self.unit}] {self.text}" if self.unit else self.text


def _number(default: Any, unit: str, low: float, high: float, text: str) -> Any:
    return field(default=default, metadata={"declaration": Declaration(text, unit, (low, high))})


def _scaled(usual: float, unit: str, top: float, text: str, fixed: float = 0.0) -> Any:
    # Sensors err by some 200 Pa, and the supply of a weak limb is no weaker.
    least, share = usual if fixed else 300.0, (usual - fixed) / USUAL_LIMIT

    def derive(limit: float) -> float:
        return max(fixed + (usual - fixed) * limit / USUAL_LIMIT, least)

    text += f"; 0: {share:.4g} * pressure_limit{f' + {fixed:g}' * bool(fixed)}, at least {least:g}"
    return field(default=0.0, metadata={"declaration": Declaration(text, unit, (0.0, top), derive)})


def _other(default: Any, text: str, choices: tuple[str, ...] = (), changeable: bool = False) -> Any:
    declaration = Declaration(text, choices=choices, changeable=changeable)
    return field(default=default, metadata={"declaration": declaration})


@dataclass(frozen=True)
class Settings:
    """The parameters of the driver.

    Raises:
        SettingError: a value is out of its range, or two contradict each other.
    """

    port: str = _other(
        "/dev/ttyACM0",
        "serial port of the board, better its name under /dev/serial/by-id, which survives "
        "re-plugging; or tcp://host:port",
    )
    protocol: str = _other("ezloop", "language of the board", NAMES)
    baud_rate: int = _number(
        0, "baud", 0, 4_000_000, "0: what the protocol says, 1000000 for `pneudrive`, else 115200"
    )
    terminal: str = _other("vtem", TERMINAL, TERMINALS)
    device: int = _number(0, "", 0, 3, DEVICE)
    sensor_range: float = _number(689_500.0, "Pa", 1e3, 1e7, SENSOR_RANGE)
    rate: float = _number(20.0, "Hz", 1.0, 100.0, "ticks, on an absolute grid")
    real_time_priority: int = _number(
        10, "", 0, 90, "SCHED_FIFO of the port's process; 0: none; ignored without the right to it"
    )
    command_validity: float = _number(
        0.25, "s", 0.06, 10.0, "a `native` board vents by itself after this time without a command"
    )
    segment_count: int = _number(2, "", 1, 16, "pairs of chambers")
    wiring: str = _other(
        "",
        "valve of the board that feeds each chamber of the limb, as 3,4,1,2; empty: each its own "
        "(scripts/check_rig.py finds it)",
    )
    pressure_limit: float = _number(USUAL_LIMIT, "Pa", 1.0, 1e6, "largest differential pressure")
    slew_limit: float = _scaled(200_000.0, "Pa/s", 1e8, "of setpoints and of what is commanded")
    atmosphere: float = _number(
        0.0, "Pa", 0.0, 1.1e5, "absolute, of the room; 0: measured with vented chambers"
    )
    horizon: float = _number(10.0, "s", 0.1, 3600.0, "a setpoint's stamp may lie ahead")
    accept_cmd_u_t: bool = _other(
        False, "also take std_msgs/Float64MultiArray in hPa on cmd_u_t, in force at once"
    )
    setpoint_timeout: float = _number(0.2, "s", 0.05, 60.0, "without a next setpoint until HOLDING")
    hold_time: float = _number(1.0, "s", 0.0, 600.0, "of HOLDING until the ramp down")
    on_lost_operator: str = _other(
        "ramp",
        "when an operator's lease ends while armed: keep the pressures for hold_time and then let "
        "them down; let them down; vent at once. DISARMED afterwards; without a lease nothing "
        "changes",
        ("hold", "ramp", "vent"),
    )
    vent_rate: float = _scaled(10_000.0, "Pa/s", 1e7, "of the ramp down")
    vent_timeout: float = _number(10.0, "s", 0.5, 120.0, "a vent may take before it is a fault")
    telemetry_timeout: float = _number(0.5, "s", 0.06, 60.0, "without chamber pressures")
    frozen_time: float = _number(
        2.0, "s", 0.0, 600.0, "in which `ezloop` and `native` readings change; 0: they need not"
    )
    over_pressure: float = _scaled(30_000.0, "Pa", 2e6, "gauge, in any chamber")
    supply_low: float = _scaled(115_000.0, "Pa", 2e6, "absolute, smallest supply", fixed=1e5)
    supply_high: float = _scaled(200_000.0, "Pa", 2e6, "absolute, largest supply", fixed=1e5)
    supply_time: float = _number(0.5, "s", 0.0, 60.0, "the supply may be outside of these")
    supply_required: bool = _other(
        True, "arm only with a fresh reading of the supply, where the protocol tells it"
    )
    follow_tolerance: float = _scaled(
        3_000.0, "Pa", 1e6, "beyond the slowest and fastest normal response of a chamber"
    )
    follow_time: float = _number(2.0, "s", 0.1, 60.0, "a chamber may be outside of it")
    slowest_fill: float = _scaled(4_000.0, "Pa/s", 1e7, "that a working valve reaches")
    slowest_vent: float = _number(
        2.5, "s", 0.05, 60.0, "time constant in which a working valve vents"
    )
    leak_time: float = _number(
        10.0, "s", 2.0, 600.0, "over which slow leaks are looked for; longer than a fill"
    )
    leak_tolerance: float = _scaled(
        1_000.0,
        "Pa",
        1e6,
        "a chamber may lie below its command in the mean of leak_time; choose a few times what a "
        "sound limb shows at steady pressure (20 to 160 Pa on a real one)",
    )
    leak_opening: float = _number(
        0.25,
        "",
        0.0,
        1.0,
        "mean opening of an inlet at steady pressure that is no leak; choose twice what "
        "valve_opening shows there; 1: do not look",
    )
    vented_tolerance: float = _scaled(500.0, "Pa", 1e5, "gauge that counts as vented")

    def __post_init__(self) -> None:
        for name, declaration, _ in declarations(type(self)):
            _check(name, value := getattr(self, name), declaration)
            if declaration.derive and not value:
                object.__setattr__(self, name, declaration.derive(self.pressure_limit))
        for low, high, reason in (
            ("supply_low", "supply_high", ""),
            ("pressure_limit", "over_pressure", ", or every full command would end in a fault"),
        ):
            below, above = getattr(self, low), getattr(self, high)
            if below >= above:
                raise SettingError(
                    f"parameters '{low}' ({below:g} Pa) and '{high}' ({above:g} Pa): the first "
                    f"must be smaller{reason}"
                )
        valves = self.valves
        if self.protocol == "ezloop" and any(
            left // 2 != right // 2 for left, right in zip(valves[0::2], valves[1::2], strict=True)
        ):
            raise SettingError(
                f"parameter 'wiring' is '{self.wiring}': an `ezloop` board vents one valve of each "
                "pair 1 and 2, 3 and 4: put the hoses of each segment on one pair"
            )
        if self.protocol == "pneudrive" and self.segment_count > 2:
            raise SettingError("parameter 'segment_count': a `pneudrive` board has four valves")
        if self.command_validity * self.rate <= 1.0:
            raise SettingError(
                f"parameters 'command_validity' ({self.command_validity:g} s) and 'rate' "
                f"({self.rate:g} Hz): a command must stay valid until the next tick"
            )

    @property
    def valves(self) -> tuple[int, ...]:
        """The valve of each chamber (2M,), counted from 0."""
        return order_of(self.wiring, 2 * self.segment_count)


@dataclass(frozen=True)
class EmulatorSettings:
    """The parameters of the emulated board."""

    port_link: str = _other(
        "/tmp/der_limb_board_0",
        "symbolic link to the pseudo-terminal, or tcp://host:port to listen at",
    )
    protocol: str = _other("ezloop", "language of the board", NAMES)
    terminal: str = _other("vtem", TERMINAL, TERMINALS)
    device: int = _number(0, "", 0, 3, DEVICE)
    sensor_range: float = _number(689_500.0, "Pa", 1e3, 1e7, SENSOR_RANGE)
    segment_count: int = _number(2, "", 1, 16, "pairs of chambers")
    seed: int = _number(0, "", 0, 2**62, "of sensors, valves and the day's atmosphere")
    wiring: str = _other(
        "", "chamber of the limb that each valve fills, as 3,4,2,1; empty: each its own"
    )
    real_time_priority: int = _number(10, "", 0, 90, "SCHED_FIFO; 0: none")
    faults: str = _other("", 'e.g. "stick:1,leak:2"; may be set while it runs', changeable=True)


@dataclass(frozen=True)
class TopicBoardSettings:
    """The parameters of the board that a lab's own driver of valves is."""

    listen: str = _other("tcp://127.0.0.1:5021", "where the driver finds it, as its port")
    message: str = _other(
        "Float64MultiArray",
        "of both topics: one array, or one `FluidPressure` for each chamber",
        ("Float64MultiArray", "FluidPressure"),
    )
    command_topic: str = _other(
        "/valves/command",
        "pressures to regulate to; {} is the place of a chamber, as in /valve{}/command",
    )
    measured_topic: str = _other("/valves/measured", "pressures that are measured, as above")
    scale: float = _number(1.0, "1/Pa", 1e-9, 1e9, "of the topics: 0.001 where they are in kPa")
    offset: float = _number(
        0.0, "", -1e9, 1e9, "added to scaled pressures: the room's where they are absolute"
    )
    segment_count: int = _number(2, "", 1, 16, "pairs of chambers")
    largest_pressure: float = _number(1e6, "Pa", 0.0, 1e6, "gauge, that the valves take")

    def __post_init__(self) -> None:
        for name in ("command_topic", "measured_topic"):
            if self.message == "FluidPressure" and "{}" not in getattr(self, name):
                raise SettingError(f"parameter '{name}' needs a {{}} for the place of a chamber")


NodeSettings = Settings | EmulatorSettings | TopicBoardSettings
NODES: dict[str, type[NodeSettings]] = {
    "pressure_driver": Settings,
    "board_emulator": EmulatorSettings,
    "topic_board": TopicBoardSettings,
}
"""The parameters of each node."""
Declared = TypeVar("Declared", Settings, EmulatorSettings, TopicBoardSettings)


def declarations(settings: type[NodeSettings]) -> Iterator[tuple[str, Declaration, Any]]:
    """Yield name, declaration and default of each parameter."""
    each: Field[Any]
    for each in fields(settings):
        assert each.default is not MISSING
        yield each.name, each.metadata["declaration"], each.default


def _check(name: str, value: Any, declaration: Declaration) -> None:
    if declaration.choices and value not in declaration.choices:
        choices = ", ".join(declaration.choices)
        raise SettingError(f"parameter '{name}' is '{value}': choose {choices}")
    if declaration.range is not None:
        low, high = declaration.range
        if not (isinstance(value, int | float) and low <= value <= high):
            raise SettingError(
                f"parameter '{name}' ({declaration.description}) is {value}: "
                f"allowed are {low:g} to {high:g}"
            )
