"""Whether the operator's page disturbs the driver: the wire's jitter with and without it."""

from __future__ import annotations

from benchmarks.driver import Seen, evaluate, play_plan
from benchmarks.page_rig import BrowserError, report, running


def measure_jitter(seconds: float, with_page: bool) -> dict[str, float]:
    """Play a motion with or without the page and a window that looks; return the wire's jitter."""
    with running(with_page) as rig:
        if with_page:
            rig.browse()
        rig.client.call("pressure_driver/arm", 20.0)
        del rig.commands[:], rig.states[:]
        wanted = play_plan(rig.client, seconds)
        name = "wire_with_page" if with_page else "wire_without_page"
        found = evaluate(name, wanted, Seen(rig.commands, rig.states))
        return {key: float(value) for key, value in found.items()}


def run(quick: bool) -> dict[str, float]:
    """Play 20 s with and without the page, twice in turn; once if ``quick``."""
    figures: dict[str, float] = {}
    try:
        for turn in range(1 if quick else 2):
            for with_page in (False, True):
                found = measure_jitter(20.0, with_page)
                figures |= {f"{key}_turn_{turn + 1}": value for key, value in found.items()}
                report("driver, whole graph, with the page" if with_page else "without it", found)
    except BrowserError as error:
        print(f"page_wire: not measured: {error}")
    return figures
