"""The experiment's command line: what is refused, and what order trials are played in."""

import json
from contextlib import nullcontext
from pathlib import Path

import pytest

from der_planner.commands.run_experiment import Ledger
from der_planner.experiment.console import OptionError
from der_planner.experiment.options import parse
from der_planner.experiment.processes import GraphSetup, Hardware
from der_planner.limb import Limb, Load
from der_planner.planning import ObstacleError


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--trials", "0"], "--trials"),
        (["--period", "0.1"], "--period"),
        (["--hardware", "/nowhere/rig.yaml"], "/nowhere/rig.yaml"),
        (["--nearest"], "--nearest is about a path"),
        (["--page", "70000"], "--page is 70000"),
        (["--page", "--offline"], "does not go with --offline"),
        (["--library", "/nowhere"], "/nowhere is no folder"),
        (["--poses", "--offline"], "--poses is motion capture of the twin"),
        (["--force-limit", "0.2"], "about feedback: add --feedback"),
        (["--feedback", "--reaction", "hold", "--force-limit", "0.2"], "what the reaction yield"),
        (["--feedback", "--force-limit", "200"], "--force-limit is 200"),
        (["--board", "festo", "--offline"], "--board is about the twin.s nodes"),
    ],
)
def test_a_bad_option_is_refused_by_its_name(arguments, named):
    with pytest.raises(OptionError, match=named):
        parse(arguments)


@pytest.mark.parametrize("option", ["--motions", "--models", "--method", "--board", "--reaction"])
def test_an_unknown_name_is_refused(option, capsys):
    with pytest.raises(SystemExit, match="2"):
        parse([option, "guess"])
    assert f"argument {option}: invalid choice: 'guess' (choose from" in capsys.readouterr().err


def test_hardware_without_its_serial_device_is_refused(tmp_path: Path):
    rig = tmp_path / "rig.yaml"
    rig.write_text("driver: {port: /dev/serial/by-id/no-such-board}\nlimb: limb.yaml\n")
    with pytest.raises(OptionError, match="no-such-board"):
        parse(["--hardware", str(rig)])
    rig.write_text("pump: {}\n")
    with pytest.raises(OptionError, match="unknown key 'pump'"):
        parse(["--hardware", str(rig)])
    for limit in ("2.0e+9", "24 kPa"):
        rig.write_text(f"driver: {{pressure_limit: {limit}}}\ntwin: {{}}\n")
        with pytest.raises(OptionError, match=r"rig\.yaml: driver: .*pressure_limit.* allowed are"):
            parse(["--hardware", str(rig)])


def test_a_node_of_another_computer_is_marked_and_keeps_its_parameters_there(tmp_path: Path):
    rig = tmp_path / "rig.yaml"
    rig.write_text(
        "driver: {port: tcp://valves:502, wiring: '2,1,4,3'}\ntracker: {host: camera-pc}\n"
    )
    hardware = Hardware.from_yaml(rig)
    nodes = GraphSetup(tmp_path, {}, hardware=hardware).nodes("")
    assert {node.executable: node.host for node in nodes if node.host} == {
        "apriltag_tracker": "camera-pc"
    }
    (recorder,) = (node for node in nodes if node.executable == "recorder")
    assert json.loads(recorder.parameters["metadata"])["wiring"] == [1, 0, 3, 2]
    rig.write_text("driver: {host: valve-pc}\n")
    assert Hardware.from_yaml(rig).place == "valve-pc"
    rig.write_text("driver: {host: valve-pc, port: /dev/ttyACM0}\n")
    with pytest.raises(OptionError, match=r"on valve-pc: give its parameters \(port\) there"):
        Hardware.from_yaml(rig)


def test_a_rig_file_of_a_twin_needs_no_board_and_no_limb_file(tmp_path: Path):
    rig = tmp_path / "rig.yaml"
    rig.write_text("driver: {protocol: native, wiring: '2,1,4,3'}\ntwin: {wiring: [2, -1, 4, 3]}\n")
    options = parse(["--hardware", str(rig)])
    nodes = GraphSetup(tmp_path, {}, hardware=options.hardware).nodes("/tmp/board")
    found = {node.executable: node.parameters for node in nodes}
    assert found["limb_twin"]["wiring"] == [2, -1, 4, 3]
    assert found["board_emulator"]["wiring"] == "2,1,4,3"
    assert found["board_emulator"]["protocol"] == found["pressure_driver"]["protocol"] == "native"
    assert found["pressure_driver"]["wiring"] == "2,1,4,3"


def test_the_limits_of_a_rig_are_those_of_its_driver():
    limits = Hardware(driver={"pressure_limit": 240e3, "port": "/dev/null", "misspelt": 1}).limits
    assert (limits.pressure_limit, limits.slew_limit) == (240e3, 2e6)
    assert Hardware(driver={"slew_limit": 5e4}).limits.slew_limit == 5e4


def test_the_twin_has_the_board_that_is_named(tmp_path: Path):
    board, driver, *_ = GraphSetup(tmp_path, {}, board="festo").nodes("tcp://127.0.0.1:5020")
    assert board.parameters["protocol"] == driver.parameters["protocol"] == "festo"
    assert board.parameters["port_link"] == driver.parameters["port"] == "tcp://127.0.0.1:5020"


def test_trials_share_seeds_between_models_and_differ_between_trials():
    trials = parse(["--motions", "all", "--trials", "2", "--seed", "7"]).plan_of_trials()
    assert len(trials) == 3 * 2 * 2
    assert {trial.seed for trial in trials if trial.number == 1} == {7}
    assert {trial.seed for trial in trials if trial.number == 2} == {8}
    assert len({trial.name for trial in trials}) == len(trials)


def test_a_stopped_experiment_goes_on_and_refuses_other_options(tmp_path: Path):
    arguments = ["--out", str(tmp_path), "--trials", "2"]
    options = parse(arguments)
    first, second = options.plan_of_trials()[:2]
    Ledger(options).record(first, {"bag": "somewhere"})
    again = Ledger(parse(arguments))
    assert again.finished(first) == {"bag": "somewhere"}
    assert again.finished(second) is None
    with pytest.raises(OptionError, match=r"period = 20\.0, not 6\.0"):
        Ledger(parse([*arguments, "--period", "6"])).finished(first)
    with pytest.raises(OptionError, match="reaction = yield, not warn"):
        Ledger(parse([*arguments, "--feedback", "--reaction", "warn"])).finished(first)
    # Another path of the same name is not taken for done.
    file = tmp_path / "curve.csv"
    file.write_text("x,y\n0.20,0.10\n0.19,0.12\n")
    drawn = ["--path", str(file), *arguments]
    trial = parse(drawn).plan_of_trials()[0]
    Ledger(parse(drawn)).record(trial, {"arrays": "somewhere"})
    assert Ledger(parse(drawn)).finished(trial) == {"arrays": "somewhere"}
    file.write_text("x,y\n0.20,0.10\n0.18,0.12\n")
    with pytest.raises(OptionError, match="path_sha256"):
        Ledger(parse(drawn)).finished(trial)


def test_a_motion_into_an_obstacle_is_refused_before_anything_is_started(tmp_path: Path):
    file, limb = tmp_path / "peg.yaml", tmp_path / "limb.yaml"
    Limb.default().to_yaml(limb)
    motion = ["--amplitude", "0.4", "--period", "4", "--cycles", "1", "--method", "projected"]
    arguments = [*motion, "--models", "der", "--limb", str(limb), "--obstacles", str(file)]
    for place, refused in ((0.09, True), (-0.2, False)):
        peg = {"circle_m": [0.2, place], "radius_m": 0.02}
        file.write_text(json.dumps({"limb_radius_m": 0.015, "obstacles": [peg]}))
        options = parse(arguments)
        with pytest.raises(ObstacleError) if refused else nullcontext():
            options.check_motions(Limb.default(), options.plan_of_trials())


def test_the_load_is_that_of_the_command_line():
    options = parse(["--mounting", "hanging", "--payload", "0.02", "--payload-at", "0.2"])
    assert options.load == Load(0.02, 0.2, "hanging")
    assert parse([]).load == Load()


def test_a_path_is_refused_with_its_line_and_the_remedy(tmp_path: Path):
    file = tmp_path / "my path.csv"
    file.write_text("time [s], x [cm], y [cm]\n0, 20, 10\n1, here, 11\n")
    with pytest.raises(OptionError, match=r"line 3: column 'x' is not a number: 'here'; correct"):
        parse(["--path", str(file)])
    file.write_text("time [s], x [cm], y [cm]\n0, 20, 10\n1, 19.5, 11\n")
    assert parse(["--path", str(file)]).plan_of_trials()[0].name == "my_path_der_optimal_trial1"
    with pytest.raises(OptionError, match="give one of the two"):
        parse(["--path", str(file), "--motions", "star"])
