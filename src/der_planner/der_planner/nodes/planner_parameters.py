"""Every parameter of the planner node, declared once with unit, range and meaning."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rclpy.node import Node

from der_planner.limb import HEAVIEST, Limb
from der_planner.planning import METHODS, PathLimits
from der_planner.planning.inverse import BRANCHES
from limb_interfaces.parameters import declare


@dataclass(frozen=True)
class PlannerOptions:
    """The node's parameters, checked; times in ns where they meet stamps, else in s.

    `limb` is mounted as the parameters say, and does not carry the payload yet.
    """

    limb: Limb
    payload: float
    payload_at: float
    model: str
    method: str
    nodes: int
    lead: int
    auto_start: bool
    branch: str
    limits: PathLimits
    nearest_path: bool
    driver_timeout: float
    learned_plans: str
    feedback: bool


def read_parameters(node: Node) -> PlannerOptions:
    """Declare and check the planner's parameters.

    Raises:
        ParameterError: a value is out of range; names it.
        LimbError: the limb file cannot be used.
    """
    read: Any = functools.partial(declare, node)
    return PlannerOptions(
        limb=_read_limb(read),
        payload=float(
            read("payload", 0.0, "mass [kg] carried beside the limb's own masses, where a command "
                 "names none", at_least=0.0, at_most=HEAVIEST, read_only=False)
        ),
        payload_at=float(
            read("payload_at", 0.0, "where, along the limb from its clamp [m]; 0: the tip",
                 at_least=0.0, read_only=False)
        ),
        model=str(
            read("default_model", "der", "model for paths and for commands that name none",
                 choices=tuple(METHODS))
        ),
        method=str(
            read("default_method", "", "method where none is named; empty: the best",
                 choices=("", *METHODS["der"]))
        ),
        nodes=int(read("nodes", 21, "nodes of the rod", at_least=6, at_most=201)),
        lead=round(
            1e9 * read("lead_time", 0.2, "time between sending a setpoint and its stamp [s]",
                       at_least=0.05, at_most=2.0)
        ),
        auto_start=bool(read("auto_start", True, "play a plan as soon as it is ready")),
        branch=str(
            read("branch", "", "side of the fold for paths and shapes; empty: the least pressure",
                 choices=("", *BRANCHES))
        ),
        limits=PathLimits(
            float(read("path_speed", 0.03, "speed along a path without times [m/s]",
                       at_least=1e-3, at_most=1.0)),
            float(read("path_acceleration", 0.05, "acceleration along and across it [m/s^2]",
                       at_least=1e-3, at_most=10.0)),
        ),
        nearest_path=bool(
            read("nearest_path", False, "follow the nearest path that the limb can follow where a "
                 "path leaves its reach, instead of refusing it", read_only=False)
        ),
        driver_timeout=float(
            read("driver_timeout", 1.0, "silence of the driver [s] after which it counts as dead",
                 at_least=0.2, at_most=60.0)
        ),
        learned_plans=_absolute(
            read("learned_plans", "", "folder of learned plans: a command of the method 'learned' "
                 "names one of them in place of its motion")
        ),
        feedback=bool(
            read("feedback", False, "correct plans of the rod while they are played, where a "
                 "command does not ask for it")
        ),
    )  # fmt: skip


def _absolute(folder: object) -> str:
    """Return a folder as other processes find it; empty stays empty."""
    return str(Path(str(folder)).expanduser().resolve()) if folder else ""


def _read_limb(read: Any) -> Limb:
    """Return the limb of the file that is named, mounted as the parameter says."""
    limb_file = str(read("limb_file", "", "limb file (YAML); empty: the default limb"))
    mounting = str(
        read("mounting", "", "horizontal, hanging, standing, sideways or degrees of tilt; empty: "
             "gravity as in the limb file")
    )  # fmt: skip
    limb = Limb.from_yaml(limb_file) if limb_file else Limb.default()
    return limb.mounted(mounting) if mounting else limb
