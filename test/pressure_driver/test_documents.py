"""What is written down agrees with the code: parameter files, and the native page's vectors."""

import re
from pathlib import Path

import pytest
import yaml

from figures import driver_parameters
from pressure_driver import settings
from pressure_driver.emulator.firmware import NativeBoard
from pressure_driver.protocols import BoardFailure, BoardText, Telemetry, host_protocol

PACKAGE = Path(__file__).resolve().parents[2] / "src" / "pressure_driver"
DOCS = PACKAGE.parents[1] / "docs"
DRIVER = (DOCS / "guide" / "driver.md").read_text(encoding="utf-8")
PROTOCOL = (DOCS / "reference" / "native_protocol.md").read_text(encoding="utf-8")
VECTOR = re.compile(r"^\| (\w+) \|.*\| `([0-9a-f ]+)` \|$", re.MULTILINE)


@pytest.mark.parametrize("name", settings.NODES)
def test_the_parameter_file_is_what_the_declaration_says(name):
    written = (PACKAGE / "config" / f"{name}.yaml").read_text(encoding="utf-8")
    assert written == driver_parameters.parameter_file(name)
    values = yaml.safe_load(written)[f"/**/{name}"]["ros__parameters"]
    assert settings.NODES[name](**values) == settings.NODES[name]()


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ({"over_pressure": 20_000.0}, "'pressure_limit'.*'over_pressure'"),
        ({"supply_high": 110_000.0}, "'supply_low'.*'supply_high'"),
        ({"rate": 3.0}, "'command_validity'.*'rate'"),
        ({"pressure_limit": -5.0}, "'pressure_limit'.*allowed"),
        ({"protocol": "modbus"}, "ezloop, ctrlp, native"),
    ],
)
def test_parameters_that_cannot_work_are_named(values, told):
    with pytest.raises(settings.SettingError, match=told):
        settings.Settings(**values)


def vectors():
    found = dict(VECTOR.findall(PROTOCOL))
    assert len(found) >= 7
    return {name: bytes.fromhex(text) for name, text in found.items()}


def test_the_vectors_of_the_host_are_what_the_driver_sends():
    wire = vectors()
    host = host_protocol(settings.Settings(protocol="native"))
    assert host.start() == b"\0" + wire["HELLO"]
    assert host.setpoint([7500.0, 0.0, 0.0, 3200.0]) == wire["SETPOINT"]
    assert host.number == 2
    assert host.vent() == wire["VENT"]


def test_the_vectors_of_the_board_are_understood():
    wire, host = vectors(), host_protocol(settings.Settings(protocol="native"))
    (identity,) = host.decode(wire["IDENTITY"])
    assert (identity.chamber_count, identity.largest_pressure) == (4, 30_000.0)
    assert identity.firmware == "lab 1.0"
    telemetry, echo = host.decode(wire["STATUS"])
    assert telemetry == Telemetry(
        (108_812.0, 101_325.0, 101_322.0, 104_530.0), (51 / 255, 0.0, 0.0, 1.0), 140_000.0
    )
    assert echo.sequence == 2
    (fault,) = host.decode(wire["FAULT"])
    assert isinstance(fault, BoardFailure)
    (refused,) = host.decode(wire["REFUSED"])
    assert isinstance(refused, BoardText)
    assert host.rejected == 0
    assert len(NativeBoard(4).decode(wire["HELLO"] + wire["SETPOINT"] + wire["VENT"])) == 3


def test_every_rule_of_the_safety_table_names_tests_that_exist():
    table = DRIVER.split("| what fails |")[1].split("\n\n")[0].splitlines()[2:]
    assert len(table) >= 30
    for row in table:
        named = row.rstrip("| ").split("| ")[-1].strip().strip("`")
        for group in named.split("; "):
            module, _, names = group.partition(": ")
            source = (Path(__file__).parent / f"test_{module}.py").read_text()
            for name in names.split(", "):
                assert name, row
                assert f"def test_{name}" in source, f"{name} in the row: {row}"
