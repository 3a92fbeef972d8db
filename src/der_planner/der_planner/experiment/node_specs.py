"""Which nodes a run consists of, with which parameters, and in which order they stop."""

from __future__ import annotations

import dataclasses
import json
import secrets
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from der_planner.experiment.errors import OptionError
from der_planner.limb import Limb

STOP_ORDER = (
    "planner",
    "apriltag_tracker",
    "synthetic_camera",
    "limb_twin",
    "recorder",
    "pressure_driver",
    "page",
    "board_emulator",
)
TWIN_NODES = ("board_emulator", "limb_twin", "synthetic_camera")
"""Nodes that stand in for the hardware."""


@dataclass(frozen=True)
class Hardware:
    """What stands in place of the twin: parameters of the nodes that touch the hardware.

    Attributes:
        driver, tracker, planner, recorder: parameters by name for each node.
        remap: new names of topics by their old ones, for all nodes.
        limb: the limb file, or None for the one on the command line.
    """

    driver: dict[str, Any] = field(default_factory=dict)
    tracker: dict[str, Any] = field(default_factory=dict)
    planner: dict[str, Any] = field(default_factory=dict)
    recorder: dict[str, Any] = field(default_factory=dict)
    remap: dict[str, str] = field(default_factory=dict)
    limb: str | None = None

    @classmethod
    def from_yaml(cls, path: Path) -> Hardware:
        """Read a hardware file (see scripts/hardware_example.yaml).

        Raises:
            OptionError: the file cannot be read, has unknown keys or no serial port.
        """
        try:
            content = yaml.safe_load(path.read_text())
        except (OSError, yaml.YAMLError) as error:
            raise OptionError(f"cannot read hardware file {path}: {error}") from error
        known = [item.name for item in dataclasses.fields(cls)]
        if not isinstance(content, dict):
            raise OptionError(f"hardware file {path}: expected the keys {', '.join(known)}")
        for key in content:
            if key not in known:
                raise OptionError(f"hardware file {path}: unknown key '{key}'; known: {known}")
        hardware = cls(**{key: value for key, value in content.items() if value is not None})
        if not hardware.driver.get("port"):
            raise OptionError(
                f"hardware file {path}: driver.port is missing; `ls /dev/serial/by-id` shows ports"
            )
        if not Path(hardware.driver["port"]).exists():
            raise OptionError(
                f"hardware file {path}: no serial device {hardware.driver['port']}; is the valve "
                "board plugged in? `ls /dev/serial/by-id` shows what is there"
            )
        return hardware


PAGE_TOKEN = secrets.token_urlsafe()
"""Opens the page of each run's graph, so that a window that is open stays let in."""


@dataclass(frozen=True)
class NodeSpec:
    """What is needed to start one node."""

    package: str
    executable: str
    parameters: dict[str, Any] = field(default_factory=dict)


def node_specs(
    port: str,
    bag: Path,
    metadata: dict[str, Any],
    *,
    seed: int = 0,
    run: int = 0,
    limb: Limb | None = None,
    hardware: Hardware | None = None,
    planner: dict[str, Any] | None = None,
    record_images: bool = False,
    page: int | None = None,
) -> list[NodeSpec]:
    """Return the nodes of a run in the order in which they start.

    Args:
        port: where the emulated board appears.
        bag: folder that the recorder makes.
        metadata: stored in the bag.
        seed: of the twin.
        run: of the same twin: its rest angles wander in each in a way of their own.
        limb: whose gravity and masses the twin gets; None: no loads.
        hardware: in place of the twin.
        planner: parameters of the planner; None for a graph without one.
        page: port of the operator's page; None for a graph without one.
        record_images: whether the bag holds the raw images, too.
    """
    rig = hardware or Hardware()
    driver = {"port": port, "protocol": "ezloop", **rig.driver}
    recorder = {
        "output": str(bag),
        "metadata": json.dumps(metadata),
        "record_images": record_images,
        **rig.recorder,
    }
    specs = [
        NodeSpec("pressure_driver", "board_emulator", {"port_link": port, "seed": seed}),
        NodeSpec("pressure_driver", "pressure_driver", driver),
        NodeSpec("der_planner", "limb_twin", {"seed": seed, "run": run, **twin_loads(limb)}),
        NodeSpec("apriltag_tracker", "synthetic_camera", {"seed": seed}),
        NodeSpec("apriltag_tracker", "apriltag_tracker", dict(rig.tracker)),
    ]
    if hardware is not None:
        specs = [spec for spec in specs if spec.executable not in TWIN_NODES]
    if planner is not None:
        specs.append(NodeSpec("der_planner", "planner", {**planner, **rig.planner}))
    specs.append(NodeSpec("der_planner", "recorder", recorder))
    if page is not None:
        specs.append(NodeSpec("der_planner", "page", page_parameters(page, planner or {}, rig)))
    return specs


def page_parameters(port: int, planner: dict[str, Any], rig: Hardware) -> dict[str, Any]:
    """Return the parameters of a page that draws with the planner's limb on the tracker's tags."""
    shared = ("limb_file", "mounting", "payload", "payload_at", "path_speed", "path_acceleration")
    all_of_planner = {**planner, **rig.planner}
    parameters = {name: all_of_planner[name] for name in shared if name in all_of_planner}
    if "tag_map" in rig.tracker:
        parameters["tag_map"] = rig.tracker["tag_map"]
    return {"port": port, "token": PAGE_TOKEN, **parameters}


def twin_loads(limb: Limb | None) -> dict[str, Any]:
    """Return the parameters by which the twin's node is mounted and loaded as a limb."""
    if limb is None:
        return {}
    parameters: dict[str, Any] = {"gravity": list(limb.gravity)}
    if limb.masses:
        parameters["masses"] = [item.mass for item in limb.masses]
        parameters["masses_at"] = [item.arc_length for item in limb.masses]
    return parameters
