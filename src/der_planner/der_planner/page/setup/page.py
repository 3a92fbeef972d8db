"""The set-up guide: a checklist for the first power-up, each line checked while one looks."""

from __future__ import annotations

from nicegui import ui

from der_planner.limb import Limb
from der_planner.page.server import STATIC, Parts
from der_planner.page.setup.steps import SetupGuide

ADDRESS = "/setup"
INTERVAL = 0.5
"""[s] between two looks."""


def add_setup(parts: Parts) -> None:
    """Add the page at `ADDRESS`."""

    @ui.page(ADDRESS, title="Limb: set-up", favicon="🦑")
    def guide() -> None:
        ui.add_head_html('<link rel="stylesheet" href="/static/page.css">')
        ui.add_body_html((STATIC / "frame.html").read_text())
        steps = SetupGuide(parts.studio.limb.segment_count, Limb.default().name)
        with ui.element("main").props('id="setup"'):
            ui.html("<h2>First power-up</h2>", sanitize=False)
            ui.label("From top to bottom; every line is checked twice a second.")
            lines = ui.column().classes("fill")

        def look() -> None:
            calibrated, problem = parts.overlay.camera()
            found = steps.steps(parts.situation.snapshot(), problem, calibrated)
            lines.clear()
            with lines:
                for number, step in enumerate(found, 1):
                    with ui.element("div").classes("step done" if step.done else "step"):
                        ui.label(f"{'✔' if step.done else '○'} {number}. {step.title}")
                        ui.label(step.seen if step.done else f"{step.seen}. {step.advice}")

        look()
        ui.timer(INTERVAL, look)
