"""Plans: timed pressures with what the model expects of them, and files to keep them in.

A file is YAML, in SI units, with one row a setpoint. It holds the limb it was
made for (under its loads), the reference and the commands, so that it needs neither the limb file
nor the motion; model and kinematics are built anew from them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from der_planner.arrays import Array
from der_planner.files import read_yaml, write_whole, yaml_text
from der_planner.limb import Limb, LimbError
from der_planner.model import CONTROL_PERIOD, NODES, Model
from der_planner.model.commands import within_limits
from der_planner.planning.configuration import configure
from der_planner.planning.loads import PlanningError
from der_planner.planning.motions import Reference
from der_planner.planning.timing import Start, resting_spline

SCHEMA_VERSION = 1
SUFFIX = ".yaml"
_SAME = 1e-9
"""Relative difference of two numbers of limbs that are the same."""
_MOVES_NOTHING = ("name", "provenance", "calibrated", "pcc_segments")
"""Keys of a limb's mapping that do not move it as its model sees it."""
_SINGLE: dict[str, type] = dict.fromkeys(("motion", "model", "method"), str)
_SINGLE |= {"amplitude": float, "period": float, "cycles": int, "solve_time": float}
"""What a file has of a plan beside its rows."""


@dataclass(frozen=True)
class Plan:
    """A planned motion of K setpoints, 50 ms apart.

    Attributes:
        time: (K,) instants of the setpoints since the first [s].
        differential_pressure: (K, M) commands, each held until the next [Pa].
        reference: r̄ and q̄ as functions of time.
        tip_predicted: (K, 2) tip of the model under these commands, with the chambers' lag [m].
        bend_angles: (K, M) of the model's reference configuration [rad].
        motion, model, method: names, as they were asked for.
        amplitude, period, cycles: of the motion; 0, 0 and 1 for a path.
        body: the model of the limb that it was made for.
        solve_time: wall time of the planning [s].
        warnings: sentences: limits that cut the wanted pressures, ranges that were left.
        chambers_beyond: (K, M) by how much the chambers held more than their model in the last run
            that a learned plan is from, mean of each period [Pa]; None: nobody told.
        curves: (K, P, 2) centreline of the reference configuration [m]; None: it bends evenly.
    """

    time: Array
    differential_pressure: Array
    reference: Reference
    tip_predicted: Array
    bend_angles: Array
    motion: str
    model: str
    method: str
    amplitude: float
    period: float
    cycles: int
    body: Model
    solve_time: float
    warnings: tuple[str, ...] = ()
    chambers_beyond: Array | None = None
    curves: Array | None = None

    @property
    def limb(self) -> Limb:
        """The limb that it was made for, as its model sees it."""
        return self.body.limb

    @property
    def tip_reference(self) -> Array:
        """(K, 2) r̄ at the setpoints [m]."""
        return self.reference.tip

    def curve(self, index: int) -> Array:
        """Return the centreline (P, 2) [m] of the reference configuration at a setpoint."""
        if self.curves is None:
            return self.body.kinematics.curve(self.bend_angles[index])
        shape: Array = self.curves[index]
        return shape

    @property
    def error(self) -> Array:
        """(K,) distance of the predicted from the reference tip [m]."""
        distance: Array = np.linalg.norm(self.tip_predicted - self.tip_reference, axis=1)
        return distance

    @property
    def predicted_error(self) -> float:
        """Mean distance of the predicted from the reference tip [m]."""
        return float(self.error.mean())

    @property
    def largest_error(self) -> float:
        """Largest distance of the predicted from the reference tip [m]."""
        return float(self.error.max())

    @property
    def duration(self) -> float:
        """Instant of the last setpoint [s]."""
        return float(self.time[-1])

    @property
    def pressure_margin(self) -> float:
        """What is left to the pressure limit at the largest command [Pa]."""
        largest = float(np.abs(self.differential_pressure).max())
        return self.limb.pneumatics.pressure_limit - largest

    @property
    def slew_margin(self) -> float:
        """What is left to the slew limit at the fastest change from setpoint to setpoint [Pa/s]."""
        steps = np.diff(self.differential_pressure, axis=0)
        fastest = float(np.abs(steps).max(initial=0.0)) / float(self.time[1] - self.time[0])
        return self.limb.pneumatics.slew_limit - fastest


def write_plan(plan: Plan, path: str | Path, about: Mapping[str, Any] | None = None) -> None:
    """Write a plan, whole or not at all.

    Args:
        plan: to keep.
        path: of the file.
        about: what else is worth knowing of it, e.g. how it was learned; kept as it is.
    """
    start = plan.reference.start
    content: dict[str, Any] = {
        "schema_version": SCHEMA_VERSION,
        **{name: getattr(plan, name) for name in _SINGLE},
        "nodes": plan.body.nodes,
        "about": dict(about or {}),
        "limb": plan.limb.to_mapping(),
        "start": None
        if start is None
        else {key: np.asarray(value).tolist() for key, value in vars(start).items()},
        "rest_bend_angles_rad": np.asarray(plan.reference.rest).tolist(),
        # rows of setpoints, 50 ms apart
        "differential_pressure_pa": plan.differential_pressure.tolist(),
        "tip_reference_m": plan.reference.tip.tolist(),
        "tip_predicted_m": plan.tip_predicted.tolist(),
        "reference_bend_angles_rad": plan.reference.bend_angles.tolist(),
    }
    if plan.chambers_beyond is not None:
        content["chambers_beyond_pa"] = plan.chambers_beyond.tolist()
    text = "# A plan, in SI units; row by row the setpoints, 50 ms apart.\n"
    text += yaml_text(content, default_flow_style=None)
    write_whole(path, text)


def read_plan(path: str | Path) -> Plan:
    """Read a plan that `write_plan` wrote.

    Raises:
        PlanningError: the file cannot be read, or is not a whole plan; names what is wrong.
    """
    content = read_yaml(path, "the plan", PlanningError, _Loader)
    try:
        return _plan_of(content)
    except (KeyError, TypeError, ValueError, LimbError) as error:
        what = f"'{error.args[0]}' is missing" if isinstance(error, KeyError) else str(error)
        raise PlanningError(
            f"the plan {path} cannot be used: {what}; write it again with scripts/learn.py"
        ) from error


_Loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def _plan_of(content: Any) -> Plan:
    if not isinstance(content, Mapping) or content.get("schema_version") != SCHEMA_VERSION:
        raise ValueError(f"expected a plan of schema_version {SCHEMA_VERSION}")
    limb = Limb.from_mapping(content["limb"])
    command = _rows(content, "differential_pressure_pa", limb.segment_count, None)
    count = len(command)
    tip, predicted = (
        _rows(content, key, 2, count) for key in ("tip_reference_m", "tip_predicted_m")
    )
    angles = _rows(content, "reference_bend_angles_rad", limb.segment_count, count)
    beyond = None
    if "chambers_beyond_pa" in content:
        beyond = _rows(content, "chambers_beyond_pa", limb.segment_count, count)
    start = None
    if content["start"] is not None:
        start = Start(**{key: np.array(value, float) for key, value in content["start"].items()})
    body = Model.of(limb, str(content["model"]), int(content.get("nodes", NODES)))
    beside = within_limits(command, body.air, CONTROL_PERIOD, command[0])[1]
    if beside > _SAME * limb.pneumatics.pressure_limit:
        raise ValueError("its pressures or their changes are beyond the limb's limits")
    time: Array = np.arange(count, dtype=np.float64) * CONTROL_PERIOD
    rest = np.array(content["rest_bend_angles_rad"], dtype=float)
    reference = Reference(time, tip, angles, resting_spline(time, angles, start), rest, start)
    configuration = configure(body, reference)
    return Plan(
        time=time,
        differential_pressure=command,
        reference=reference,
        tip_predicted=predicted,
        bend_angles=configuration.bend_at(time),
        body=body,
        chambers_beyond=beyond,
        curves=configuration.curves(time),
        **{name: kind(content[name]) for name, kind in _SINGLE.items()},
    )


def _rows(content: Mapping[str, Any], key: str, width: int, count: int | None) -> Array:
    rows = np.array(content[key], dtype=float)
    wanted = (len(rows) if count is None else count, width)
    if rows.shape != wanted or len(rows) < 2 or not np.isfinite(rows).all():
        raise ValueError(f"{key} must be finite numbers of shape {wanted}, got {rows.shape}")
    return rows


def learned_names(folder: str | Path) -> list[str]:
    """Return the names of the learned plans in a folder; none where there is no such folder."""
    return sorted(path.stem for path in Path(folder).glob(f"*{SUFFIX}"))


def learned_plan(folder: str | Path | None, name: str, limb: Limb) -> Plan:
    """Return the learned plan of a name from a folder, for the limb as it is now.

    Args:
        folder: of learned plans.
        name: of the file, without ``.yaml``.
        limb: that is to play it, under its loads.

    Raises:
        PlanningError: there is no such plan, or it was learned on another limb or load.
    """
    if not folder:
        raise PlanningError(
            f"the learned plan '{name}' has no place: set the planner's learned_plans to a folder"
        )
    known = learned_names(folder)
    if name not in known:
        raise PlanningError(
            f"no learned plan '{name}' in {folder}, only: {', '.join(known) or 'none'}"
        )
    plan = read_plan(Path(folder) / f"{name}{SUFFIX}")
    other = difference(plan.limb.to_mapping(), limb.for_model(plan.model).to_mapping())
    if other:
        raise PlanningError(
            f"the plan '{name}' was learned on a limb with another {other}: plan the motion by "
            "another method and learn again"
        )
    return plan


def difference(one: Any, other: Any, name: str = "") -> str:
    """Return the name of the first number that differs in the mappings of two limbs, else empty.

    What does not move a limb may differ.
    """
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        keys = (key for key in {**one, **other} if key not in _MOVES_NOTHING)
        parts = [(f"{name}.{key}".strip("."), one.get(key), other.get(key)) for key in keys]
    elif isinstance(one, list | tuple) and isinstance(other, list | tuple):
        parts = [(f"{name}[{k}]", *pair) for k, pair in enumerate(zip_longest(one, other))]
    elif isinstance(one, float) and isinstance(other, float):
        return "" if math.isclose(one, other, rel_tol=_SAME) else name
    else:
        return "" if one == other else name
    return next(filter(None, (difference(a, b, part) for part, a, b in parts)), "")
