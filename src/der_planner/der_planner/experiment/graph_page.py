"""The operator's page of an experiment: from its first second, over all its runs, to its report."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rclpy.executors import ExternalShutdownException

from der_planner.experiment.client import GraphClient
from der_planner.experiment.console import Progress
from der_planner.experiment.options import Options
from der_planner.experiment.processes import PAGE_TOKEN, GraphSetup, NodeProcess
from limb_interfaces.diagnostics import DiagnosticsPublisher, Health

NAME = "experiment"
"""Of the node that says what the experiment does."""


@contextlib.contextmanager
def experiment_page(options: Options, progress: Progress) -> Iterator[NodeProcess]:
    """Serve the page, and tell it what the experiment does, until the end of the context.

    The page shows the limb of the options; one that is calibrated on the way is near to it.

    Raises:
        NodeError: it cannot be started, or has ended at once.
        GraphError: it is not ready in time.
    """
    planner: dict[str, Any] = {
        "limb_file": str(options.limb or ""), "mounting": options.loads.mounting,
    }  # fmt: skip
    planner |= {"payload": options.loads.payload, "payload_at": options.loads.payload_at or 0.0}
    setup = GraphSetup(Path(), {}, hardware=options.hardware, planner=planner, page=options.page)
    (spec,) = [each for each in setup.nodes("") if each.executable == "page"]
    parameters = {**spec.parameters, "report": str(options.out / "report")}
    page = NodeProcess(
        spec.package, spec.executable, parameters, options.out / "logs", setup.rig.remap
    )
    try:
        with GraphClient(NAME) as client:
            client.watch([page])
            client.wait_ready(["page"])
            progress.say(
                f"the operator's page is at {client.diagnostic_values('page')['url']}"
                f"?token={PAGE_TOKEN}"
            )
            DiagnosticsPublisher(client.node, lambda: Health("ok", progress.newest))
            client.watch(())
            ended = threading.Event()
            speaker = threading.Thread(target=_speak, args=(client, ended), name=NAME, daemon=True)
            speaker.start()
            try:
                yield page
            finally:
                ended.set()
                speaker.join(1.0)
    finally:
        page.stop()


def _speak(client: GraphClient, ended: threading.Event) -> None:
    """Serve the node until the end: it says once a second what the experiment does."""
    with contextlib.suppress(ExternalShutdownException):
        while not ended.is_set():
            client.spin(0.1)
