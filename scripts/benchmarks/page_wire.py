"""Whether the operator's page disturbs the driver: the wire's jitter with and without it."""

from __future__ import annotations

from benchmarks.driver import Seen, evaluate, play_plan
from benchmarks.page_rig import BrowserError, report, running

SETTINGS = {
    "without_page": "without the page",
    "page_served": "with the page, whose pictures a program takes that draws nothing",
    "page_and_browser": "with the page and a browser on this computer",
}


def measure_jitter(seconds: float, setting: str) -> dict[str, float]:
    """Play a motion in one of the `SETTINGS`; return the wire's jitter."""
    with running(setting != "without_page") as rig:
        if setting == "page_and_browser":
            rig.browse()
        elif setting == "page_served":
            viewer = rig.view()
            rig.wait(lambda: viewer.pictures, "the first picture")
        rig.arm()
        del rig.commands[:], rig.states[:]
        wanted = play_plan(rig.client, seconds)
        name = f"wire_{setting}"
        found = evaluate(name, wanted, Seen(rig.commands, rig.states))
        return {key: float(value) for key, value in found.items()}


def run(quick: bool) -> dict[str, float]:
    """Play 20 s in each setting, twice in turn; once if ``quick``."""
    figures: dict[str, float] = {}
    try:
        for turn in range(1 if quick else 2):
            for setting, title in SETTINGS.items():
                found = measure_jitter(20.0, setting)
                figures |= {f"{key}_turn_{turn + 1}": value for key, value in found.items()}
                report(f"driver, whole graph, {title}", found)
    except BrowserError as error:
        print(f"page_wire: not measured: {error}")
    return figures
