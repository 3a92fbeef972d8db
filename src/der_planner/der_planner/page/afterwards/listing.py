"""The page of earlier experiments: a list, and table, figures and report of the chosen one."""

from __future__ import annotations

from urllib.parse import quote

from nicegui import ui

from der_planner.page.afterwards.experiments import COLUMNS, Experiments
from der_planner.page.afterwards.replay import replay_address
from der_planner.page.server import STATIC

ADDRESS = "/afterwards"


def add_afterwards(experiments: Experiments) -> None:
    """Add the page at `ADDRESS`."""

    @ui.page(ADDRESS, title="Limb: experiments", favicon="🦑")
    def afterwards() -> None:
        ui.add_head_html('<link rel="stylesheet" href="/static/page.css">')
        ui.add_body_html((STATIC / "frame.html").read_text())
        with ui.element("main").props('id="afterwards"'):
            ui.html("<h2>Experiments</h2>", sanitize=False)
            ui.label(f"in {experiments.folder.resolve()}")
            names = experiments.names()
            if not names:
                ui.label("None yet: scripts/run_experiment.py makes them.").props('id="none"')
                return
            chosen = ui.select(names, value=names[0], label="Experiment").classes("fill")
            shown = ui.column().classes("fill")
            chosen.on_value_change(lambda event: _show(experiments, str(event.value), shown))
            _show(experiments, names[0], shown)


def _show(experiments: Experiments, name: str, shown: ui.column) -> None:
    found = experiments.load(name)
    shown.clear()
    with shown:
        if found.problem:
            ui.label(found.problem)
            return
        place = f"/experiments/{quote(name)}/"
        if found.report:
            ui.link("Report", place + found.report, new_tab=True)
        with ui.element("table").classes("results"):
            with ui.element("tr"):
                for column in (*COLUMNS, ""):
                    with ui.element("th"):
                        ui.label(column)
            for row, bag in zip(found.rows, found.bags, strict=True):
                with ui.element("tr"):
                    for text in row:
                        with ui.element("td"):
                            ui.label(text)
                    with ui.element("td"):
                        if bag:
                            ui.link("Replay", replay_address(bag))
        for figure in found.figures:
            ui.image(place + quote(figure)).classes("figure").props(f'alt="{figure}"')
