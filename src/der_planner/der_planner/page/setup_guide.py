"""The set-up guide: a checklist for the first power-up, each line judged from what is heard now."""

from __future__ import annotations

import asyncio
import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from nicegui import Client, ui

from der_planner.page.alarm import WITHOUT_PRESSURE, board_answers, describe_limb
from der_planner.page.commands import FILLING, Answer
from der_planner.page.server import STATIC, Parts
from limb_interfaces.diagnostics import PRESSED

ADDRESS = "/setup"
RECONNECT = 60.0
"""What a window's panels hold is kept for this time [s] while its connection is away."""
INTERVAL = 0.5
"""The steps are judged at this interval [s]."""
DRIVEN = 1.0 / 8.0
"""A segment counts as driven to one side from this share of the driver's limit on."""
FILLED = 5.0 / 24.0
"""The page's buttons fill a chamber to this share of it, or less where the limb bears less."""
MOCAP = "motion capture stands in its place: pose_tracker runs"
CHAMBERS = "Each chamber has been filled alone"
"""Title of the step with the buttons that fill chambers."""
CHECK, CALIBRATION = "check-", "calibration-"
"""The plans of `check_rig.py` and `calibrate_limb.py` have names that begin so."""


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
    """Judges the steps; remembers which chambers have been driven alone, and a calibration.

    Args:
        segments: of the limb.
    """

    def __init__(self, segments: int) -> None:
        self._chambers = [(segment, side) for segment in range(segments) for side in (1, -1)]
        self._driven: set[tuple[int, int]] = set()
        self._playing = ""
        self._played: set[str] = set()

    def steps(self, data: dict[str, Any], camera_problem: str, calibrated: bool) -> list[Step]:
        """Return all steps.

        Args:
            data: `Situation.snapshot` of now.
            camera_problem: why the camera's pose is not known; empty if it is.
            calibrated: whether the camera has sent a calibration.
        """
        sources = data["sources"]
        driver = data["driver"] if sources["driver"]["fresh"] else None
        limb = data["limb"] if sources["tracker"]["fresh"] else None
        gone = ("late", "dead", "ended")
        alive = {node["own"]: node["values"] for node in data["nodes"] if node["state"] not in gone}
        planner, mocap = alive.get("planner", {}), "pose_tracker" in alive
        planned, identified = planner.get("limb", ""), planner.get("limb_identified", "")
        told = f"identified on {identified}" if identified else "which nobody identified"
        self._watch(driver)
        return [
            _board(driver),
            _zero_pressure(driver),
            self._each_chamber(),
            _camera(bool(sources["camera"]["fresh"]), calibrated, mocap),
            Step(
                "The camera's pose is known from the fixed tags",
                mocap or (calibrated and not camera_problem),
                MOCAP if mocap else camera_problem or "the fixed tags fit together",
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
            self._check(),
            self._calibration(identified),
            Step(
                "The planner has this limb's own file",
                bool(identified),
                f"it plans for '{planned}', {told}" if planned else "no planner is heard",
                "scripts/calibrate_limb.py makes it from a calibration run; start the planner with "
                "limb_file:=FILE.",
            ),
        ]

    def _watch(self, driver: dict[str, Any] | None) -> None:
        """Remember what the driver does now."""
        driver = driver or {"plan_id": "", "measured_kpa": []}
        plan, known = driver["plan_id"], driver["measured_kpa"]
        self._playing = next((each for each in (CHECK, CALIBRATION) if plan.startswith(each)), "")
        self._played.add(self._playing)
        shares = [(value or 0.0) / driver["limit_kpa"] for value in known]
        for index, value in enumerate(shares):
            others = [abs(share) for k, share in enumerate(shares) if k != index]
            if abs(value) >= DRIVEN and max(others, default=0.0) < PRESSED:
                self._driven.add((index, 1 if value > 0 else -1))

    def _each_chamber(self) -> Step:
        left = [chamber(*place) for place in self._chambers if place not in self._driven]
        return Step(
            CHAMBERS,
            not left,
            f"not yet: {', '.join(left)}" if left else "all of them, since this page was opened",
            "Arm and fill each with these buttons; look whether the limb bends to the side "
            "that is said.",
        )

    def _run(self, kind: str) -> tuple[bool, str]:
        """Return whether a run of a kind has been played, and what to say of it."""
        if self._playing == kind:
            return False, "one is being played"
        if kind in self._played:
            return True, "one has been played"
        return False, "none has been played since this page was opened"

    def _check(self) -> Step:
        return Step(
            "A check of hoses, sensors and tags has been played",
            *self._run(CHECK),
            "`python3 scripts/check_rig.py --hardware RIG.yaml --out CHECKED.yaml` says which "
            "valve fills which chamber; end all nodes but this page first.",
        )

    def _calibration(self, identified: str) -> Step:
        done, seen = self._run(CALIBRATION)
        if identified and CALIBRATION not in self._played:
            seen = f"the planner's limb was identified on {identified}"
        return Step(
            "A calibration run has been played",
            done or bool(identified),
            seen,
            "`python3 scripts/calibrate_limb.py --graph --hardware RIG.yaml --out LIMB.yaml` plays "
            "and records one with nodes of its own: end all nodes but this page first.",
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
        board_answers(driver),
        seen,
        "Plug it in, start pressure_driver with the port that `ls /dev/serial/by-id` shows.",
    )


def _zero_pressure(driver: dict[str, Any] | None) -> Step:
    measured: Sequence[float | None] = [] if driver is None else driver["measured_kpa"]
    known = [abs(value) for value in measured if value is not None]
    vented = driver is not None and driver["mode"] == "disarmed"
    zero = describe_limb(driver) == WITHOUT_PRESSURE
    seen = f"largest differential pressure {max(known):.2f} kPa" if known else "nothing measured"
    if driver is not None and not vented:
        seen += f", the driver is {driver['mode']}"
    return Step(
        "Vented, the pressures are zero",
        zero and vented,
        seen,
        "Vent. What remains is the sensors' offset, or a chamber that does not vent.",
    )


def _camera(live: bool, calibrated: bool, mocap: bool) -> Step:
    said = "pictures come" if live else "no fresh picture (they are only asked for while looked at)"
    known = "its calibration is known" if calibrated else "it has sent no calibration"
    return Step(
        "The camera is calibrated",
        calibrated or mocap,
        MOCAP if mocap else f"{said}; {known}",
        "scripts/calibrate_camera.py writes the camera_info file.",
    )


def show_answer(client: Client, answer: Answer) -> None:
    """Show in a window what came of a request."""
    with client:
        ui.notify(answer.message, type="positive" if answer.success else "negative", timeout=6000)


def add_frame(client: Client) -> None:
    """Add what every window has beside its panels, plain HTML: alarm, state, vent, live data."""
    name = f"<script>window.limbWindow = '{client.id}';</script>"
    ui.add_body_html(name + (STATIC / "frame.html").read_text())


def add_setup_guide(parts: Parts) -> None:
    """Add the page at `ADDRESS`."""

    @ui.page(ADDRESS, title="Limb: set-up", favicon="🦑", reconnect_timeout=RECONNECT)
    def show_guide(client: Client) -> None:
        ui.add_head_html('<link rel="stylesheet" href="/static/page.css">')
        add_frame(client)
        guide = SetupGuide(parts.previewer.limb.segment_count)
        with ui.element("div").props('id="setup"') as main:
            ui.html(f"<h2>First power-up of {parts.situation.namespace}</h2>", sanitize=False)
            ui.label("From top to bottom; every step is checked twice a second.")
            shown: list[tuple[ui.step, ui.label]] = []

        def read() -> list[Step]:
            calibrated, problem = parts.overlay.camera_problem()
            return guide.steps(parts.situation.snapshot(), problem, calibrated)

        def judge() -> None:
            for (line, label), step in zip(shown, read(), strict=True):
                label.set_text(step.seen if step.done else f"{step.seen}. {step.advice}")
                title = f"{'✔' if step.done else '○'} {step.title}"
                if line.props["title"] != title:
                    line.props["title"] = title

        first = next((step.title for step in read() if not step.done), None)
        with main, ui.stepper(value=first).props("vertical header-nav").classes("fill") as stepper:
            for step in read():
                with ui.step(step.title) as line:
                    shown.append((line, ui.label()))
                    if step.title == CHAMBERS:
                        _add_buttons(client, parts)
                    with ui.stepper_navigation():
                        ui.button("Next", on_click=stepper.next).props("flat")
        judge()
        ui.timer(INTERVAL, judge)


def _add_buttons(client: Client, parts: Parts) -> None:
    """Add the buttons that arm and fill one chamber; each commands only as long as it acts."""
    limb = parts.previewer.limb

    def may_command() -> bool:
        if parts.desk.take(client.id):
            return True
        show_answer(client, Answer(False, "another window commands: give up control there first"))
        return False

    async def arm() -> None:
        if may_command():
            try:
                show_answer(client, await parts.commands.call("arm"))
            finally:
                parts.desk.leave(client.id)

    async def fill(segment: int, side: int) -> None:
        if may_command():
            try:
                pressure = min(FILLED * parts.situation.limit, limb.pneumatics.pressure_limit)
                answer = parts.commands.fill(segment, side, pressure, limb.segment_count)
                show_answer(client, answer)
                await asyncio.sleep(FILLING)
            finally:
                parts.desk.leave(client.id)

    ui.label(f"One chamber alone, for {FILLING:.0f} s:")
    with ui.row().classes("line"):
        ui.button("Arm", on_click=arm, color="positive").props('id="arm"')
        for segment in range(limb.segment_count):
            for side in (1, -1):
                press = functools.partial(fill, segment, side)
                name = f"fill-{segment}-{'left' if side > 0 else 'right'}"
                text = chamber(segment, side).partition(" (")[0]
                ui.button(f"Fill {text}", on_click=press).props(f'id="{name}"')
