"""The commands on tables of a limb that hangs and carries something."""

import re
import sys

import pytest
from chain_calibration import write_csv
from link_chain import LinkChain

from der_planner.commands import calibrate_limb, check_limb
from der_planner.identification.excitation import waves
from der_planner.limb import Limb, gravity_of

pytestmark = pytest.mark.slow


def run(command, *arguments: object, monkeypatch) -> int:
    monkeypatch.setattr(sys, "argv", ["command", *map(str, arguments)])
    return command.main()


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    folder = tmp_path_factory.mktemp("hanging")
    pressure = waves(12_000.0, 2, 24.0)
    time = [0.05 * k for k in range(len(pressure))]
    chain = LinkChain(3, gravity_of("hanging"), [(0.2, 0.05)])
    played = chain.play(time, pressure, 20.0)
    write_csv(played.log(), folder / "log.csv", folder / "columns.yaml")
    return folder


def test_mounting_stays_in_the_limb_file_and_payload_does_not(table, monkeypatch, capsys):
    out = table / "limb.yaml"
    loads = ("--payload", 0.05, "--payload-at", 0.2)
    given = ("--csv", table / "log.csv", "--columns", table / "columns.yaml", "--terms", "friction")
    status = run(
        calibrate_limb, *given, "--mounting", "hanging", *loads, "--out", out,
        monkeypatch=monkeypatch,
    )  # fmt: skip
    assert status == 0
    pulled = re.search(r"pulls at (\d+) g", capsys.readouterr().out)
    assert float(pulled[1]) == pytest.approx(310, abs=12)
    limb = Limb.from_yaml(out)
    assert limb.gravity == gravity_of("hanging")
    assert limb.masses == ()
    later = (table / "log.csv", "--columns", table / "columns.yaml", "--limb", out)
    assert run(check_limb, *later, *loads, monkeypatch=monkeypatch) == 0
    assert run(check_limb, *later, "--mounting", "0", monkeypatch=monkeypatch) == 3


def test_loads_that_cannot_be_are_refused(table, monkeypatch, capsys):
    given = ("--csv", table / "log.csv", "--columns", table / "columns.yaml")
    for wrong, reason in (
        (("--mounting", "upside"), "mounting 'upside' is unknown"),
        (("--payload", 0.05, "--payload-at", 0.7), "at most the limb's length"),
    ):
        assert run(calibrate_limb, *given, *wrong, monkeypatch=monkeypatch) != 0
        assert reason in capsys.readouterr().err
