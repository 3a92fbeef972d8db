"""Find how a rig is put together: which hose goes where, what reads it, how fast, who sits where.

    python3 scripts/check_rig.py --hardware my_rig.yaml --out my_checked_rig.yaml
    python3 scripts/check_rig.py --bag checks/DATE/bag --out my_checked_rig.yaml
    python3 scripts/check_rig.py --seed 3 --wiring 3 4 2 1 --out rig.yaml    # the twin's graph

Each chamber is filled gently, alone, for three seconds: half a minute for two segments. The rig
file that is written is the one that was given, with the wiring that was found for the driver, and
what was found in the section `found`; experiments take it by --hardware. Exit code 0: the rig can
be played; 3: it contradicts itself, and no file is written; 1: an error; 2: bad options.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from apriltag_tracker.bodies.body_map import BodyMap
from apriltag_tracker.installed import CONFIG
from apriltag_tracker.pose.clamp import Clamp, at_clamp, find_clamp
from apriltag_tracker.tag_map import MapError, TagMap
from der_planner.bags.reader import BagError, BagReader
from der_planner.bags.record import PRESSURE_TYPE, Columns, header_stamp
from der_planner.experiment.console import OptionError, check_file, check_folder, command
from der_planner.experiment.processes import GraphError, Hardware, NodeError
from der_planner.files import write_whole
from der_planner.identification.excitation import within_limits
from der_planner.identification.rig import GENTLE, RigError, RigFinding, RigLog, check_run, find_rig
from der_planner.limb import Limb
from der_planner.twin import TwinError
from der_planner.twin.wiring import Wiring
from limb_interfaces import topics
from pressure_driver.protocols import NAMES, SettingError
from pressure_driver.settings import Settings

TAGS_TYPE = "der_msgs/msg/TagDetectionArray"
CLAMP_OFF = (0.002, 0.002, float(np.deg2rad(1.5)))
"""What the clamp may be beside the origin of `limb_base` [m, m, rad]."""
SEEN_TOGETHER = 10
"""Messages of each kind that a bag must hold."""
FAILURES = (RigError, SettingError, BagError, MapError, TwinError, GraphError, NodeError, OSError)
"""What may end a check early."""


def _options(parser: argparse.ArgumentParser) -> argparse.Namespace:
    parser.add_argument("--hardware", type=Path, metavar="FILE", help="rig file to begin with")
    parser.add_argument("--bag", type=Path, help="judge a check that was recorded before")
    parser.add_argument(
        "--pressure", type=float, help="of the fills [Pa] (default: an eighth of the limit)"
    )
    parser.add_argument("--seed", type=int, default=1, help="of the twin (default: 1)")
    parser.add_argument(
        "--wiring",
        type=int,
        nargs="+",
        metavar="CHAMBER",
        help="of the twin: the chamber that each valve fills, from 1; minus: bends the other way",
    )
    parser.add_argument("--board", choices=NAMES, default=NAMES[0], help="of the twin")
    parser.add_argument("--poses", action="store_true", help="of the twin: motion capture, no tags")
    parser.add_argument("--folder", type=Path, help="for bag and logs (default: checks/ and time)")
    parser.add_argument("--out", type=Path, metavar="FILE", help="rig file to write")
    return parser.parse_args()


@command(*FAILURES, stopped="no rig file was written")
def main(parser: argparse.ArgumentParser) -> int:
    """Run the command line."""
    given = _options(parser)
    if given.hardware and (given.wiring or given.poses):
        raise OptionError("--wiring and --poses are about the twin: leave --hardware out")
    content: dict[str, Any] = {"driver": {"protocol": given.board}, "twin": {}}
    if given.wiring:
        content["twin"] = {"wiring": list(Wiring(tuple(given.wiring)).chambers)}
    if given.poses:
        content["poses"] = {}
    hardware = Hardware(**content)
    if given.hardware:
        hardware = Hardware.from_yaml(given.hardware)
        content = yaml.safe_load(given.hardware.read_text(encoding="utf-8"))
    if given.out is not None:
        check_file(given.out)
    bag = given.bag or _play(given, hardware)
    map_path = _map_path(hardware)
    bodies = (TagMap if hardware.poses is None else BodyMap).from_yaml(map_path)
    log = read_check(bag, bodies)
    finding = find_rig(log)
    lines = finding.lines()
    clamp = find_clamp(bodies, log.places)
    if clamp is not None and not finding.contradictions:
        lines += clamp_lines(clamp)
    lines += _plane_line(bag)
    print("\n".join(lines))
    try:
        wiring = played_wiring(finding, hardware.driver)
    except (SettingError, RigError) as error:
        print(f"no file is written: {error}", file=sys.stderr)
        return 3
    if given.out is not None:
        content["driver"] = {**(content.get("driver") or {}), "wiring": wiring}
        content["found"] = lines
        if clamp is not None and is_off(clamp):
            _move_base(content, map_path, clamp, given.out)
        write_whole(given.out, yaml.safe_dump(content, sort_keys=False, allow_unicode=True))
        print(f"rig file: {given.out}")
    return 0


def _move_base(content: dict[str, Any], map_path: Path, clamp: Clamp, out: Path) -> None:
    """Write the map with `limb_base` at the clamp beside the rig file, which then names it."""
    node, parameter = ("poses", "body_map") if "poses" in content else ("tracker", "tag_map")
    moved = out.with_suffix(f".{parameter}.yaml").resolve()
    written = at_clamp(yaml.safe_load(map_path.read_text()), clamp)
    write_whole(moved, yaml.safe_dump(written, sort_keys=False))
    parameters = content.get(node) or {}
    if "host" in parameters:
        print(f"map with limb_base at the clamp, for {parameters['host']}: {moved}")
        return
    content[node] = {**parameters, parameter: str(moved)}
    print(f"map with limb_base at the clamp: {moved}")


def _plane_line(bag: Path) -> list[str]:
    """Return what the tracker of bodies has found of the plane of motion, if it has."""
    told: dict[str, str] = {}
    with BagReader(bag) as reader:
        for _, _, message in reader.messages([topics.DIAGNOSTICS]):
            for status in message.status:
                told.update({entry.key: entry.value for entry in status.values})
    if "plane_tilt_deg" not in told:
        return []
    return [
        f"plane of motion: tilted by {told['plane_tilt_deg']}° toward "
        f"{told['plane_tilt_toward_deg']}°, bodies leave it by {told['out_of_plane_mm_rms']} mm"
    ]


def clamp_lines(clamp: Clamp) -> list[str]:
    """Say where the limb begins, and what to do where that is not the origin."""
    (x, y, turn), (x_sigma, y_sigma, turn_sigma) = clamp.place, clamp.sigma
    lines = [
        f"clamp in limb_base: x {1e3 * x:.1f} ± {1e3 * x_sigma:.1f} mm, y {1e3 * y:.1f} ± "
        f"{1e3 * y_sigma:.1f} mm, turned by {np.degrees(turn):.1f} ± {np.degrees(turn_sigma):.1f}°"
    ]
    if is_off(clamp):
        lines.append("warning: limb_base is not at the clamp: --out writes a map in which it is")
    return lines


def is_off(clamp: Clamp) -> bool:
    """Return whether the limb surely begins beside the origin of `limb_base`."""
    return bool((np.abs(clamp.place) > np.maximum(CLAMP_OFF, 3.0 * clamp.sigma)).any())


def _play(given: argparse.Namespace, hardware: Hardware) -> Path:
    """Play a check on the graph; return its bag."""
    # ROS is imported only by who needs it.
    from der_planner.experiment.graph_trials import play_calibration  # noqa: PLC0415

    folder = given.folder or Path("checks") / time.strftime("%Y-%m-%d_%H-%M-%S")
    check_folder(folder, "--folder")
    driver = hardware.limits
    most = 0.5 * driver.pressure_limit
    pressure = GENTLE * driver.pressure_limit if given.pressure is None else given.pressure
    if not 0.0 < pressure <= most:
        raise OptionError(f"--pressure is {pressure:g}: choose up to {most:g} Pa, half the limit")
    run = check_run(driver.segment_count, pressure)
    run = within_limits(run, np.inf, driver.slew_limit)  # the driver refuses what is beyond its own
    return play_calibration(run, folder.resolve(), Limb.default(), given.seed, hardware)


def _map_path(hardware: Hardware) -> Path:
    """Return the file of the tracker's map of tags or bodies."""
    if hardware.poses is not None:
        return Path(hardware.poses.get("body_map", CONFIG / "bodies.yaml"))
    return Path(hardware.tracker.get("tag_map", CONFIG / "tags.yaml"))


def played_wiring(finding: RigFinding, driver: Mapping[str, Any]) -> str:
    """Return the driver's parameter ``wiring`` for what was found.

    Args:
        finding: of a check.
        driver: parameters of the driver in it.

    Raises:
        SettingError: the board cannot play it; says what to do.
        RigError: the rig contradicts itself.
    """
    present = Settings(**driver)
    found = ",".join(str(present.valves[channel] + 1) for channel in finding.wiring)
    return replace(present, wiring=found).wiring


def read_check(path: Path, bodies: TagMap | BodyMap) -> RigLog:
    """Read the log of a check from its bag.

    Raises:
        RigError: it holds no pressures, or nothing was seen of the limb.
        BagError: the bag cannot be read.
    """
    limb = {each: place for place, each in enumerate(bodies.limb_names)}
    commands, measured, opening, places = Columns(), Columns(), Columns(), Columns()
    with BagReader(path) as bag:
        kinds = {name: topic.type_name for name, topic in bag.topics.items()}
        wanted = [name for name, kind in kinds.items() if kind in (PRESSURE_TYPE, TAGS_TYPE)]
        for name, _, message in bag.messages(wanted):
            stamp = header_stamp(message)
            if kinds[name] == PRESSURE_TYPE:
                commands.append(stamp, message.commanded_differential)
                measured.append(stamp, message.measured_chamber)
                opening.append(stamp, message.valve_opening)
                continue
            row = np.full((len(limb), 3), np.nan)
            for each in message.detections:
                if each.pose_valid and each.id in limb:
                    row[limb[each.id]] = each.pose.x, each.pose.y, each.pose.theta
            places.append(stamp, row.ravel())
    for kind, columns in (("pressures", commands), ("tags or bodies", places)):
        if len(columns) < SEEN_TOGETHER:
            raise RigError(f"the bag {path} holds no {kind}: were driver and tracker running?")
    count, first = len(bodies.segment_lengths), commands.stamps()[0]
    seen = places.values(3 * len(limb)).reshape(-1, len(limb), 3)
    for column in seen[..., 2].T:
        known = np.isfinite(column)
        column[known] = np.unwrap(column[known])
    return RigLog(
        time=1e-9 * (commands.stamps() - first),
        command=np.nan_to_num(commands.values(count)),
        measured=measured.values(2 * count),
        opening=opening.values(2 * count),
        seen_time=1e-9 * (places.stamps() - first),
        places=seen,
        names=tuple(bodies.limb_names.values()),
        arc_lengths=np.array([body.arc_length for body in bodies.limb]),
        segment_lengths=bodies.segment_lengths,
    )
