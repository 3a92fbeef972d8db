"""What is wrong, worst first, in plain words: what it is, what the limb does, what to do now."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

from limb_interfaces.diagnostics import PRESSED, TOUCHED

SUPPLY = "close the valve at the air supply"
"""What is left where no program can vent the limb."""
WITHOUT_PRESSURE = "without pressure"
"""What a limb is whose chambers are all known to be vented."""
BOARD_SILENT = 0.5
"""A valve board counts as silent after this time [s] without telemetry."""
LATE = 1.6
"""A node counts as late after this time [s] without diagnostics, which it sends once a second."""
NODES = {
    "pressure_driver": "nothing watches the pressures of the limb",
    "planner": "no motion can be asked for",
    "apriltag_tracker": "the limb is not tracked",
    "pose_tracker": "the limb is not tracked",
    "recorder": "nothing is recorded",
    "page": "",
    "experiment": "the experiment has stopped",
    "board_emulator": "the twin's valve board stands still",
    "limb_twin": "the twin stands still",
    "synthetic_camera": "the twin's camera stands still",
    "synthetic_poses": "the twin's motion capture stands still",
}
"""Nodes of a limb, worst first, with what their end means."""
DRIVER = "pressure_driver"
TRACKERS = ("apriltag_tracker", "pose_tracker")
PACKAGES = {
    **dict.fromkeys((DRIVER, "board_emulator"), "pressure_driver"),
    **dict.fromkeys((*TRACKERS, "synthetic_camera", "synthetic_poses"), "apriltag_tracker"),
}
"""Packages of the nodes that are not of der_planner."""
WANTED = (DRIVER, "planner", TRACKERS[0], "recorder")
"""Without these a limb is not played, seen and recorded."""
ORDER = ("dead", "error", "late", "warning", "stale", "ok", "ended")
"""States of nodes, worst first."""


class Alarm(NamedTuple):
    """One line of the alarm.

    Attributes:
        level: ``danger``: red, somebody must act; ``notice``: something to know.
        text: what is wrong.
        since: [s] for how long; None where no time belongs to it.
        advice: what to do; may be empty.
    """

    level: str
    text: str
    since: float | None
    advice: str


def worst_first(nodes: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return nodes in the order in which they are shown: this limb's worst first, then others."""
    ranks = list(NODES)

    def rank(node: dict[str, Any]) -> tuple[int, int, str]:
        if not node["own"]:
            return len(ORDER), 0, node["name"]
        return ORDER.index(node["state"]), ranks.index(node["own"]), node["name"]

    return sorted(nodes, key=rank)


def missing(nodes: Sequence[dict[str, Any]]) -> list[str]:
    """Return the commands that start what has never been heard of a whole graph."""
    heard = {node["own"] for node in nodes}
    if "experiment" in heard:  # it starts them
        return []
    heard |= set(TRACKERS) if heard & set(TRACKERS) else set()
    return [start_of(name, None) for name in WANTED if name not in heard]


def describe_limb(driver: dict[str, Any] | None) -> str:
    """Return what the limb does by the driver's newest state, to be said after "the limb is"."""
    if driver is None:
        return "in an unknown state"
    measured, commanded = driver["measured_kpa"], driver["commanded_kpa"]
    told = (*measured, *commanded, driver["highest_kpa"])
    largest = max([abs(value) for value in told if value is not None], default=0.0)
    if largest > PRESSED * driver["limit_kpa"]:
        return f"under pressure ({largest:.1f} kPa)"
    return "of unknown pressure" if not measured or None in measured else WITHOUT_PRESSURE


def board_answers(driver: dict[str, Any] | None) -> bool:
    """Tell whether the driver's newest state has readings of what the chambers hold now."""
    age = None if driver is None else driver["telemetry_age"]
    return age is not None and age < BOARD_SILENT


def alarms(snapshot: dict[str, Any]) -> list[Alarm]:
    """Return what is wrong, worst first.

    Args:
        snapshot: `Situation.snapshot`, with nodes and sources.
    """
    own = {node["own"]: node for node in snapshot["nodes"] if node["own"]}
    found = [*_of_touch(snapshot, own.get("planner")), *_of_nodes(own)]
    if not _between_runs(own):
        found[:0] = _of_driver(snapshot, own.get(DRIVER))
    return sorted(found, key=lambda alarm: alarm.level != "danger")


def _between_runs(own: dict[str, dict[str, Any]]) -> bool:
    """Tell whether an experiment starts the driver, which has not run or has ended in order."""
    driver, experiment = own.get(DRIVER), own.get("experiment")
    waits = driver is None or driver["state"] == "ended"
    return waits and experiment is not None and experiment["state"] in ("ok", "error")


def _of_driver(snapshot: dict[str, Any], node: dict[str, Any] | None) -> Iterator[Alarm]:
    source, driver = snapshot["sources"]["driver"], snapshot["driver"]
    dead = f"The driver is dead: {_reason(node)}" if node and node["state"] == "dead" else ""
    if driver is None:
        if dead:
            yield Alarm("danger", dead, None, _restart(node))
        elif node is None:
            yield Alarm("notice", "No driver is heard", None, "start it: " + start_of(DRIVER, None))
        return
    if not source["fresh"] and node is not None and node["state"] == "ended":
        told = "The driver has been ended in order, and has vented the limb"
        yield Alarm("notice", told, None, "start it again: " + start_of(DRIVER, node))
        return
    limb = describe_limb(driver)
    if dead or source["age"] > LATE:
        told = f"{dead or 'The driver says nothing'}. When last heard, the limb was {limb}"
        told += f", in mode {driver['mode']}"
        yield Alarm("danger", told, source["age"], _restart(node))
        return
    if driver["mode"] == "fault":
        faults = "; ".join(driver["faults"]) or "no reason given"
        advice = "remove the cause, then arm"
        if board_answers(driver):
            told = f"The driver has vented after a fault: {faults}. The limb is {limb}"
        else:
            told = f"The driver cannot reach the board: {faults}. The limb may keep its pressures"
            advice = f"{SUPPLY}; then {advice}"
        yield Alarm("danger", told, None, advice)
    elif node is not None and (lost := node["values"].get("lost_operator", "none")) != "none":
        told = f"The operator was lost ({lost}): the driver stopped the limb, which is {limb}"
        yield Alarm("notice", told, None, "arm to go on")


def _restart(node: dict[str, Any] | None) -> str:
    return f"{SUPPLY}; then start the driver again: {start_of(DRIVER, node)}"


def _reason(node: dict[str, Any]) -> str:
    """Return why a node is dead, with its last words if it had any."""
    return " — ".join(text for text in (node["trouble"], node["last_words"]) if text)


def start_of(name: str, node: dict[str, Any] | None) -> str:
    """Return the command that starts a node: as it was started, where that is known."""
    known = "" if node is None else node["command"]
    return known or f"scripts/ros2 run {PACKAGES.get(name, 'der_planner')} {name}"


def _of_touch(snapshot: dict[str, Any], planner: dict[str, Any] | None) -> Iterator[Alarm]:
    """Yield what touches the limb, or that the limb was vented for it."""
    contact, driver, sources = snapshot["contact"], snapshot["driver"], snapshot["sources"]
    reason = planner["values"].get("reason", "") if planner is not None else ""
    heard = sources["driver"]["fresh"]
    if heard and contact is not None and contact["touched"] and sources["contact"]["fresh"]:
        told = f"Something touches the limb: {contact['said']}"
        yield Alarm("notice", told, None, "look at the limb, and vent it where that must not be")
    elif reason.startswith(TOUCHED) and heard and driver["mode"] in ("venting", "disarmed"):
        yield Alarm("danger", f"The limb was vented: {reason}", None, "free the limb, then arm")


def _of_nodes(own: dict[str, dict[str, Any]]) -> Iterator[Alarm]:
    """Yield other nodes of this limb that are dead, and what has failed of experiment or record."""
    for name, failed, again in (
        ("experiment", "has stopped", "start it again with the same --out"),
        ("recorder", "does not record", "begin the recording again"),
    ):
        if name in own and own[name]["state"] == "error":
            told = f"The {name} {failed}: {own[name]['message']}"
            yield Alarm("danger", told, None, f"see to it, then {again}")
    for name, meaning in NODES.items():
        node = own.get(name)
        if name != DRIVER and node is not None and node["state"] == "dead":
            told = f"The {name} is dead: {_reason(node)}"
            advice = "" if "experiment" in own else f"start it again: {start_of(name, node)}"
            yield Alarm("danger", f"{told}; {meaning}" if meaning else told, node["age"], advice)
