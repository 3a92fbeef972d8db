"""Whether the operator's page disturbs the driver: the wire's jitter with and without it."""

from __future__ import annotations

from benchmarks.driver import Seen, evaluate, play_plan
from benchmarks.page.rig import BrowserError, report, running

SETTINGS = {
    "without_page": "without the page",
    "page_served": "with the page, whose pictures a program takes that draws nothing",
    "page_and_browser_last": "with the page and a browser of lowest priority on this computer",
    "page_and_browser": "with the page and a browser on this computer",
}
NEXT_DIAGNOSTICS = 1.1
"""[s] after which every node has said how it is."""
LOWEST = 19
"""Niceness of a browser of lowest priority."""


def measure_jitter(seconds: float, setting: str) -> dict[str, float]:
    """Play a motion in one of the `SETTINGS`; return the wire's jitter.

    The board's clock is read by a program that shares the cores with all others; the driver's own
    clock tells from a tick to the end of its write.
    """
    with running(setting != "without_page") as rig:
        if setting.startswith("page_and_browser"):
            rig.browse(LOWEST if setting.endswith("last") else 0)
        elif setting == "page_served":
            viewer = rig.view()
            rig.wait(lambda: viewer.pictures, "the first picture")
        rig.arm()
        del rig.commands[:], rig.states[:]
        wanted = play_plan(rig.client, seconds)
        name = f"wire_{setting}"
        found = evaluate(name, wanted, Seen(rig.commands, rig.states))
        rig.client.spin(NEXT_DIAGNOSTICS)
        told = rig.client.diagnostic_values("pressure_driver")
        found |= {f"{name}_{key}": value for key, value in told.items() if key.startswith("tick_")}
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
