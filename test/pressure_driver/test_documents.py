"""What is written down agrees with the code: parameter files, and the native page's vectors."""

import re
from pathlib import Path

import pytest
import yaml

from pressure_driver.core import CoreSettings
from pressure_driver.protocols.base import Telemetry
from pressure_driver.protocols.framing import crc16, unstuff
from pressure_driver.protocols.native import NativeBoard, NativeHost

PACKAGE = Path(__file__).resolve().parents[2] / "src" / "pressure_driver"
README = (PACKAGE / "README.md").read_text(encoding="utf-8")
PROTOCOL = (PACKAGE / "doc" / "native_protocol.md").read_text(encoding="utf-8")
VECTOR = re.compile(r"^\| (\w+) \|.*\| `([0-9a-f ]+)` \|$", re.MULTILINE)


def parameters(name):
    document = yaml.safe_load((PACKAGE / "config" / f"{name}.yaml").read_text())
    return document[f"/**/{name}"]["ros__parameters"]


def test_the_parameter_file_holds_the_defaults():
    values = parameters("pressure_driver")
    settings = CoreSettings()
    for group in (settings.schedule, settings.monitor, settings.safety):
        for name, default in vars(group).items():
            if name not in ("capacity", "rest_time", "rest_spread", "rest_drift"):
                assert values.pop(name) == default, name
    assert values.pop("rate") == 1e9 / settings.period
    assert values.pop("command_validity") == settings.command_validity
    assert values.pop("atmosphere") == settings.atmosphere


@pytest.mark.parametrize("name", ["pressure_driver", "board_emulator"])
def test_the_parameter_file_names_every_parameter_of_the_node(name):
    source = "node_parameters.py" if name == "pressure_driver" else "emulator/node.py"
    text = (PACKAGE / "pressure_driver" / source).read_text()
    declared = set(re.findall(r"(?:declare\(\s*(?:node|self),|number\()\s*\"(\w+)\"", text))
    assert declared == set(parameters(name))


def vectors():
    found = dict(VECTOR.findall(PROTOCOL))
    assert len(found) >= 7
    return {name: bytes.fromhex(text) for name, text in found.items()}


@pytest.mark.parametrize(
    "name", ["HELLO", "SETPOINT", "VENT", "IDENTITY", "STATUS", "FAULT", "REFUSED"]
)
def test_the_vectors_are_sound_frames(name):
    wire = vectors()[name]
    assert wire[-1] == 0
    payload = unstuff(wire[:-1])
    assert crc16(payload[:-2]).to_bytes(2, "little") == payload[-2:]


def test_the_vectors_of_the_host_are_what_the_driver_sends():
    wire = vectors()
    host = NativeHost(4)
    assert host.start() == b"\0" + wire["HELLO"]
    assert host.setpoint([7500.0, -3200.0], 0.0, 0.25) == (wire["SETPOINT"], 2)
    assert host.vent(0.0) == (wire["VENT"], 3)


def test_the_vectors_of_the_board_are_understood():
    wire, host = vectors(), NativeHost(4)
    (identity,) = host.decode(wire["IDENTITY"])
    assert (identity.chamber_count, identity.largest_pressure) == (4, 30_000.0)
    assert identity.firmware == "lab 1.0"
    telemetry, echo = host.decode(wire["STATUS"])
    assert telemetry == Telemetry(
        (108_812.0, 101_325.0, 101_322.0, 104_530.0), (51 / 255, 0.0, 0.0, 1.0), 140_000.0
    )
    assert echo.sequence == 2
    (fault,) = host.decode(wire["FAULT"])
    assert fault.fatal
    (refused,) = host.decode(wire["REFUSED"])
    assert not refused.fatal
    assert host.rejected == 0
    assert len(NativeBoard(4).decode(wire["HELLO"] + wire["SETPOINT"] + wire["VENT"])) == 3


def test_every_rule_of_the_safety_table_names_tests_that_exist():
    table = README.split("| what fails |")[1].split("\n\n")[0].splitlines()[2:]
    assert len(table) >= 30
    for row in table:
        named = row.rstrip("| ").split("| ")[-1].strip().strip("`")
        for group in named.split("; "):
            module, _, names = group.partition(": ")
            source = (Path(__file__).parent / f"test_{module}.py").read_text()
            for name in names.split(", "):
                assert name, row
                assert f"def test_{name}" in source, f"{name} in the row: {row}"
