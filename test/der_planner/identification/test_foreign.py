"""Logs of other programs: tables of motion capture, bags of other messages, maps that are asked."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from apriltag_tracker.bodies.body_map import BodyMap
from apriltag_tracker.synthetic.poses import MocapFaults, SyntheticMocap
from apriltag_tracker.synthetic.shapes import constant_curvature
from der_planner.identification import CalibrationLog, ColumnMap, LogError, read_csv
from der_planner.identification.foreign import bends_of, read_bag_table, read_poses
from der_planner.identification.readers import ask_map

BODIES = Path(__file__).resolve().parents[3] / "src/apriltag_tracker/config/bodies.yaml"
STORE = get_typestore(Stores.ROS2_JAZZY)


@pytest.fixture(scope="module")
def bodies() -> BodyMap:
    return BodyMap.from_yaml(BODIES)


@pytest.fixture(scope="module")
def take(bodies):
    """Poses at 50 Hz of a limb that bends to one side, and its angles."""
    time = np.arange(0.0, 4.0, 0.02)
    angles = np.stack([0.5 * np.sin(time), 0.3 * (1.0 - np.cos(time))], axis=1)
    mocap = SyntheticMocap(bodies, MocapFaults(position_noise=1e-5, direction_noise=1e-4))
    frames = [
        mocap.frame(round(1e9 * t), constant_curvature(bodies.segment_lengths, bends))
        for t, bends in zip(time, angles, strict=True)
    ]
    return time, angles, frames


def motive(path: Path, bodies: BodyMap, take, unit: str = "Millimeters") -> Path:
    """Write a take as Motive exports it: rotation before position, markers among the bodies."""
    scale = {"Millimeters": 1e3, "Meters": 1.0}[unit]
    parts = ("Rotation",) * 4 + ("Position",) * 3
    columns = [(name, part) for name in bodies.names for part in parts]
    about = ["Format Version", "1.23", "Take Name", "t", "Rotation Type", "Quaternion"]
    rows = [
        [*about, "Length Units", unit, "Coordinate Space", "Global"],
        [],
        ["", "Type", *["Rigid Body"] * len(columns), "Marker"],
        ["", "Name", *[name for name, _ in columns], "loose"],
        ["", "ID", *["1"] * len(columns), "2"],
        ["", "", *[part for _, part in columns], "Position"],
        ["Frame", "Time (Seconds)", *[*"XYZWXYZ"] * len(bodies.names), "X"],
    ]
    for k, (time, _, frame) in enumerate(zip(*take, strict=True)):
        cells = []
        for position, turn in zip(frame.positions, frame.quaternions, strict=True):
            cells += [f"{value:.7f}" for value in [*turn, *(scale * position)]]
        if k == 10:  # the second body is lost
            cells[7:14] = [""] * 7
        rows.append([str(k), f"{time:.4f}", *cells, ""])
    path.write_text("\n".join(",".join(row) for row in rows) + "\n")
    return path


def qualisys(path: Path, bodies: BodyMap, take) -> Path:
    """Write a take as QTM exports it: millimetres, matrices by columns, zeros for what is lost."""
    parts = ["X", "Y", "Z", "Roll", "Pitch", "Yaw", "Residual", *[f"Rot[{k}]" for k in range(9)]]
    heads = [f"{name} {part}" if part == "X" else part for name in bodies.names for part in parts]
    lines = [
        f"NO_OF_FRAMES\t{len(take[0])}",
        "NO_OF_CAMERAS\t4",
        f"NO_OF_BODIES\t{len(bodies.names)}",
        "FREQUENCY\t50",
        "DESCRIPTION\t--",
        "DATA_INCLUDED\t6D",
        "\t".join(["BODY_NAMES", *bodies.names]),
        "\t".join(["Frame", "Time", *heads, ""]),
    ]
    for k, (time, _, frame) in enumerate(zip(*take, strict=True)):
        cells = [str(k + 1), f"{time:.5f}"]
        matrices = Rotation.from_quat(frame.quaternions).as_matrix()
        for i, (position, matrix) in enumerate(zip(frame.positions, matrices, strict=True)):
            values = [*(1e3 * position), 0.0, 0.0, 0.0, 0.1, *matrix.T.ravel()]
            cells += [f"{0.0 if k == 10 and i == 1 else value:.6f}" for value in values]
        lines.append("\t".join(cells) + "\t")
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("write", [motive, qualisys])
def test_tables_of_motion_capture_become_angles_and_tips(tmp_path, bodies, take, write):
    log = read_poses(write(tmp_path / "take", bodies, take))
    time, angles, frames = take
    assert log.names == bodies.names
    assert np.allclose(log.time, time, atol=1e-4)
    assert np.isnan(log.positions[10, 1]).all()
    assert np.allclose(log.positions[20], frames[20].positions, atol=1e-6)
    found, tips = bends_of(log, BODIES, log.time)
    # The map's stiff stretches are not in these arcs.
    assert np.nanmax(np.abs(found - angles)) < 0.03
    assert np.isfinite(tips).all(axis=1).mean() > 0.95


def test_poses_that_cannot_be_used_are_refused_with_the_remedy(tmp_path, bodies, take):
    other = tmp_path / "other.csv"
    other.write_text("t,x\n0,1\n1,2\n")
    with pytest.raises(LogError, match="export it from Motive"):
        read_poses(other)
    path = motive(tmp_path / "euler.csv", bodies, take)
    path.write_text(path.read_text().replace("Quaternion", "XYZ"))
    with pytest.raises(LogError, match="rotations as XYZ"):
        read_poses(path)
    strangers = read_poses(motive(tmp_path / "take.csv", bodies, take))
    stranger = tmp_path / "bodies.yaml"
    stranger.write_text(BODIES.read_text().replace("limb_5", "tip_body"))
    with pytest.raises(LogError, match="no body 'tip_body': theirs are clamp, limb_1"):
        bends_of(strangers, stranger, strangers.time)


def test_pressures_of_a_table_and_poses_beside_it_are_one_log(tmp_path, bodies, take):
    time, angles, _ = take
    motive(tmp_path / "take.csv", bodies, take)
    (tmp_path / "bodies.yaml").write_text(BODIES.read_text())
    rows = np.column_stack([time + 0.4, *[1e5 * (1.0 + k + 0 * time) for k in range(4)]])
    rows[:, 1] += 10.0 * time
    np.savetxt(tmp_path / "log.csv", rows, delimiter=",", header="t,a,b,c,d", comments="")
    (tmp_path / "map.yaml").write_text(
        "time: t\ncommanded: [a, b, c, d]\nchambers: [a, b, c, d]\nposes: take.csv\n"
        "bodies: bodies.yaml\nposes_late: -0.4\n"
    )
    log = read_csv(tmp_path / "log.csv", ColumnMap.from_yaml(tmp_path / "map.yaml"))
    # Commands of chambers are differential pressures of pairs.
    assert np.allclose(log.commanded_differential[:, 0], -1e5 + 10.0 * time)
    assert np.nanmax(np.abs(log.bend_angles - angles)) < 0.03
    first, last = log.parted(0.25)
    assert len(last.time) == pytest.approx(0.25 * len(log.time), abs=2)
    assert len(first.time) + len(last.time) == len(log.time)


def test_a_bag_of_joint_states_and_arrays_becomes_a_table(tmp_path):
    types = STORE.types
    with Writer(tmp_path / "bag", version=9) as writer:
        topics = {
            name: writer.add_connection(name, kind, typestore=STORE)
            for name, kind in (
                ("/joints", "sensor_msgs/msg/JointState"),
                ("/pressures", "std_msgs/msg/Float64MultiArray"),
            )
        }
        for k in range(100):
            stamp = 1_700_000_000_000_000_000 + 50_000_000 * k
            clock = types["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9)
            joints = types["sensor_msgs/msg/JointState"](
                header=types["std_msgs/msg/Header"](clock, ""),
                name=["bend_0", "bend_1"],
                position=np.array([0.1 * k, -0.1 * k]),
                velocity=np.zeros(0),
                effort=np.zeros(0),
            )
            layout = types["std_msgs/msg/MultiArrayLayout"]([], 0)
            array = types["std_msgs/msg/Float64MultiArray"](layout, np.array([1e5, 1e5 + k]))
            for name, message in (("/joints", joints), ("/pressures", array)):
                data = STORE.serialize_cdr(message, topics[name].msgtype)
                writer.write(topics[name], stamp, data)
    table = read_bag_table(tmp_path / "bag")
    assert set(table) == {
        "time",
        "/joints.bend_0.position",
        "/joints.bend_1.position",
        "/pressures[0]",
        "/pressures[1]",
    }
    assert np.allclose(table["/joints.bend_1.position"], -2.0 * table["time"], atol=1e-6)
    assert np.allclose(table["/pressures[1]"], 1e5 + 20.0 * table["time"], atol=1e-3)
    columns = ColumnMap(
        time="time",
        commanded=("/pressures[0]",),
        chambers=("/pressures[0]", "/pressures[1]"),
        angles=("/joints.bend_0.position",),
    )
    assert isinstance(read_csv(tmp_path / "bag", columns), CalibrationLog)


def test_what_cannot_be_known_is_asked_once(tmp_path, capsys):
    answers = {
        "time": "0",
        "time_unit": "ms",
        "commanded": "1 2",
        "chambers": "p0, p1, 5, 6",
        "pressure_unit": "hPa",
        "poses": "take.csv",
        "bodies": "bodies.yaml",
        "poses_late": "0.02",
    }
    asked = []

    def ask(question: str) -> str:
        asked.append(question)
        return list(answers.values())[len(asked) - 1]

    names = ["t", "u0", "u1", "p0", "p1", "p2", "p3"]
    path = tmp_path / "log.csv.columns.yaml"
    ask_map(names, path, ask)
    assert len(asked) == len(answers)
    assert "  3: p0" in capsys.readouterr().out
    assert yaml.safe_load(path.read_text())["commanded"] == ["u0", "u1"]
    found = ColumnMap.from_yaml(path)
    assert found.chambers == ("p0", "p1", "p2", "p3")
    assert found.poses == str(tmp_path / "take.csv")
    assert found.poses_late == 0.02
