"""The first power-up, step by step, each judged from what the graph says now."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

PRESSED = 3.0
"""[kPa] Differential pressure at which a segment counts as driven to one side."""
FILLED = 5.0
"""[kPa] to which the page's buttons fill a chamber, or less where the limb bears less."""
QUIET = 1.0
"""[kPa] Below it a segment counts as vented."""
CALIBRATION = "calibration-"
"""With what the plans of `calibrate_limb.py` begin."""


@dataclass(frozen=True)
class Step:
    """One line of the checklist.

    Attributes:
        title: what should be so.
        done: whether it is, as far as is known now.
        seen: what is known.
        advice: what to do if it is not.
    """

    title: str
    done: bool
    seen: str
    advice: str


class SetupGuide:
    """Judges the steps; remembers which chambers have been driven alone.

    Args:
        segments: of the limb.
        default: name of the limb that comes with the package, which is nobody's own.
    """

    def __init__(self, segments: int, default: str) -> None:
        self._default = default
        self._segments = segments
        self._driven: set[tuple[int, int]] = set()
        self._calibrating = self._calibrated = False

    def steps(self, data: dict[str, Any], camera_problem: str, calibrated: bool) -> list[Step]:
        """Return all steps.

        Args:
            data: `Situation.snapshot` of now.
            camera_problem: why the camera's pose is not known; empty if it is.
            calibrated: whether the camera has sent a calibration.
        """
        driver = data["driver"] if data["sources"]["driver"]["fresh"] else None
        self._watch(driver)
        limb = data["limb"] if data["sources"]["tracker"]["fresh"] else None
        return [
            _board(driver),
            _zero(driver),
            self._chambers(),
            _camera(data, calibrated),
            Step(
                "The camera's pose is known from the fixed tags",
                calibrated and not camera_problem,
                camera_problem or "the fixed tags fit together",
                "Print tags with scripts/make_tags.py, enter their places in the tag map.",
            ),
            Step(
                "The limb's tags are seen",
                bool(limb and limb["valid"]),
                "no fresh picture of the limb"
                if limb is None
                else limb["reason"] or "tip at ({:.1f}, {:.1f}) cm".format(*limb["tip_cm"]),
                "Light it evenly; tags should be 25 px wide or more.",
            ),
            self._calibration(data["nodes"]),
            _limb_file(data["nodes"], self._default),
        ]

    def _calibration(self, nodes: Sequence[dict[str, Any]]) -> Step:
        own = _planned_limb(nodes) not in ("", self._default)
        seen = "none has been played since this page was opened"
        if self._calibrated:
            seen = "one is being played" if self._calibrating else "one has been played"
        elif own:
            seen = "there is a limb file"
        return Step(
            "A calibration run has been played",
            own or (self._calibrated and not self._calibrating),
            seen,
            "`python3 scripts/calibrate_limb.py --graph --hardware RIG.yaml --out LIMB.yaml` plays "
            "and records one with nodes of its own: end all nodes but this page first.",
        )

    def _watch(self, driver: dict[str, Any] | None) -> None:
        plan = "" if driver is None else driver["plan_id"]
        self._calibrating = plan.startswith(CALIBRATION)
        self._calibrated = self._calibrated or self._calibrating
        if driver is None:
            return
        pressures = [0.0 if value is None else value for value in driver["measured_kpa"]]
        for index, value in enumerate(pressures):
            others = [abs(p) for k, p in enumerate(pressures) if k != index]
            if abs(value) >= PRESSED and max(others, default=0.0) < QUIET:
                self._driven.add((index, 1 if value > 0 else -1))

    def _chambers(self) -> Step:
        wanted = [(segment, side) for segment in range(self._segments) for side in (1, -1)]
        left = [chamber(*place) for place in wanted if place not in self._driven]
        return Step(
            "Each chamber has been filled alone",
            not left,
            f"not yet: {', '.join(left)}" if left else "all of them, since this page was opened",
            "Arm and fill each with the buttons below; look whether the limb bends to the side "
            "that is said.",
        )


def chamber(segment: int, side: int) -> str:
    """Return the name of a chamber: side 1 is the left one."""
    return f"segment {segment} {'left (bends counter-clockwise)' if side > 0 else 'right'}"


def _board(driver: dict[str, Any] | None) -> Step:
    age = None if driver is None else driver["telemetry_age"]
    seen = "no driver is heard" if driver is None else "the board has never been heard"
    if age is not None:
        seen = f"heard {age:.2f} s ago"
    return Step(
        "The valve board answers",
        age is not None and age < 0.5,
        seen,
        "Plug it in, start pressure_driver with the port that `ls /dev/serial/by-id` shows.",
    )


def _zero(driver: dict[str, Any] | None) -> Step:
    measured: Sequence[float | None] = [] if driver is None else driver["measured_kpa"]
    known = [abs(value) for value in measured if value is not None]
    vented = driver is not None and driver["mode"] == "disarmed"
    zero = bool(known) and len(known) == len(measured) and max(known) < QUIET
    seen = f"largest differential pressure {max(known):.2f} kPa" if known else "nothing measured"
    if driver is not None and not vented:
        seen += f", the driver is {driver['mode']}"
    return Step(
        "Vented, the pressures are zero",
        zero and vented,
        seen,
        "Vent. What remains is the sensors' offset, or a chamber that does not vent.",
    )


def _camera(data: dict[str, Any], calibrated: bool) -> Step:
    live = bool(data["sources"]["camera"]["fresh"])
    said = "pictures come" if live else "no fresh picture (they are only asked for while looked at)"
    return Step(
        "The camera is calibrated",
        calibrated,
        f"{said}; {'its calibration is known' if calibrated else 'it has sent no calibration'}",
        "scripts/calibrate_camera.py writes the camera_info file.",
    )


def _planned_limb(nodes: Sequence[dict[str, Any]]) -> str:
    """Return the name of the limb that the planner plans for; empty if it is not heard."""
    planner = next((node for node in nodes if node["name"] == "planner"), None)
    if planner is None or planner["state"] in ("late", "dead"):
        return ""
    return str(planner["values"].get("limb", ""))


def _limb_file(nodes: Sequence[dict[str, Any]], default: str) -> Step:
    name = _planned_limb(nodes)
    return Step(
        "The planner has this limb's own file",
        name not in ("", default),
        f"it plans for '{name}'" if name else "no planner is heard",
        "scripts/calibrate_limb.py makes it from a calibration run; start the planner with "
        "limb_file:=FILE.",
    )
