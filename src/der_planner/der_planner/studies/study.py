"""A study as its file says: the task, its factors and draws, the kept columns, the figures.

scipy.stats takes most of a second to import: only who draws with it pays for it.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from statistics import NormalDist
from typing import Any

import numpy as np

from der_planner.arrays import Array
from der_planner.files import read_yaml
from der_planner.limb import Limb, LimbError
from der_planner.studies.factors import Factor, StudyError, Value, factor
from der_planner.studies.tasks import TASKS, Task

SHIPPED = Path(__file__).resolve().parent / "shipped"
_KEYS = ("name", "about", "task", "limb", "factors", "draw", "keep", "plots")
METHODS = ("random", "sobol", "saltelli")
"""Independent draws; a Sobol sequence; one arranged for Sobol indices (see `saltelli`)."""
PLOTS = {
    "lines": ("x", "y"),
    "scatter": ("x", "y"),
    "histogram": ("x",),
    "indices": ("of",),
}
"""The kinds of figures, and what each needs."""
_FACTORS_OF_PLOTS = ("lines", "panels")
_MORE_OF_PLOTS = ("kind", "name", "title", "log")


@dataclass(frozen=True)
class Spread:
    """What a drawn factor is drawn from.

    Attributes:
        scale: "even" or "log" between low and high, or "normal" with mean ``low`` and standard
            deviation ``high``.
    """

    low: float
    high: float
    scale: str = "even"

    def value(self, share: float) -> Value:
        """Return the value below which ``share`` (0 … 1) of the draws lie."""
        if self.scale == "normal":
            return NormalDist(self.low, self.high).inv_cdf(share)
        if self.scale == "log":
            return float(self.low * math.exp(share * math.log(self.high / self.low)))
        return float(self.low + share * (self.high - self.low))


@dataclass(frozen=True)
class Draw:
    """How often and how the ranges are drawn from."""

    method: str = "sobol"
    count: int = 1
    seed: int = 0

    def shares(self, dimensions: int) -> Array:
        """Return points (draws, dimensions) in the open unit cube, the same for the same seed."""
        if self.method == "random":
            points = np.random.default_rng(self.seed).random((self.count, dimensions))
        elif self.method == "sobol":
            points = _sobol(dimensions, self.count, self.seed)
        else:
            points = saltelli(dimensions, self.count, self.seed)
        inside: Array = np.clip(points, 1e-12, 1.0 - 1e-12)
        return inside


def _sobol(dimensions: int, count: int, seed: int) -> Array:
    from scipy.stats import qmc  # noqa: PLC0415

    sequence = qmc.Sobol(dimensions, rng=np.random.default_rng(seed))
    points: Array = sequence.random_base2(int(math.log2(count)))
    return points


def saltelli(dimensions: int, count: int, seed: int) -> Array:
    """Return (count · (dimensions + 2), dimensions) points from which Sobol indices are found.

    Two samples A and B, and for each dimension A with this column of B (Saltelli et al., "Variance
    based sensitivity analysis of model output", Comput. Phys. Commun. 181, 2010): first all of A,
    then B, then the mixed ones, as `scipy.stats.sobol_indices` takes their results.
    """
    both = _sobol(2 * dimensions, count, seed)
    a, b = both[:, :dimensions], both[:, dimensions:]
    columns = np.arange(dimensions)
    return np.concatenate([a, b, *(np.where(columns == each, b, a) for each in columns)])


def rows(
    grid: Mapping[str, Sequence[Value]], spreads: Mapping[str, Spread], draw: Draw
) -> list[dict[str, Value]]:
    """Return every row: the grid's first factor changes slowest, the draws fastest."""
    drawn: list[dict[str, Value]] = [{}]
    if spreads:
        points = draw.shares(len(spreads))
        drawn = [
            {
                name: spread.value(float(share))
                for (name, spread), share in zip(spreads.items(), point, strict=True)
            }
            for point in points
        ]
    combinations = itertools.product(*grid.values())
    return [
        dict(zip(grid, values, strict=True)) | each for values in combinations for each in drawn
    ]


@dataclass(frozen=True)
class Row:
    """One run of a study.

    Attributes:
        key: digest of everything that the run depends on but the code.
        values: of the factors that the study names.
    """

    key: str
    values: Mapping[str, Value]


@dataclass(frozen=True)
class Study:
    """A table of runs, from YAML by `Study.read`.

    Attributes:
        name: of the study, also of its folder.
        about: its question, in a sentence.
        task: what a row does.
        grid: factors with their values.
        spreads: factors that are drawn.
        draw: how.
        keep: result columns of the rows.
        plots: figures, as written.
        limb: text of the limb file that tasks begin with; empty for the default limb.
        text: the YAML file.
    """

    name: str
    about: str
    task: Task
    grid: Mapping[str, list[Value]]
    spreads: Mapping[str, Spread]
    draw: Draw
    keep: tuple[str, ...]
    plots: tuple[dict[str, str], ...] = ()
    limb: str = ""
    text: str = field(default="", repr=False)

    @classmethod
    def read(cls, given: str | Path) -> Study:
        """Read a study from a file, or a shipped one by its name.

        Raises:
            StudyError: the file is missing or something in it is wrong; names file and key.
        """
        path = find(given)
        content = read_yaml(path, "study", StudyError)
        try:
            return _parse(content, path, path.read_text(encoding="utf-8"))
        except StudyError as error:
            raise StudyError(f"study {path}: {error}") from error

    @property
    def factors(self) -> dict[str, Factor]:
        """The factors that the study names."""
        return {name: factor(name, self.task.name) for name in (*self.grid, *self.spreads)}

    @cached_property
    def rows(self) -> tuple[Row, ...]:
        """Every row once, in the order in which they are begun."""
        made: dict[str, Row] = {}
        for values in rows(self.grid, self.spreads, self.draw):
            made.setdefault(key := self.key(values), Row(key, dict(values)))
        return tuple(made.values())

    def key(self, values: Mapping[str, Value]) -> str:
        """Return the digest of a row."""
        about = {"task": self.task.name, "limb": _digest(self.limb), "values": dict(values)}
        return _digest(json.dumps(about, sort_keys=True, allow_nan=False))[:20]


def find(given: str | Path) -> Path:
    """Return the path of a study's file; the name of a shipped study is enough.

    Raises:
        StudyError: there is neither; lists the shipped ones.
    """
    path = Path(given)
    if path.exists():
        return path
    shipped = SHIPPED / f"{path.name.removesuffix('.yaml')}.yaml"
    if path.parent == Path() and shipped.exists():
        return shipped
    names = ", ".join(sorted(each.stem for each in SHIPPED.glob("*.yaml")))
    raise StudyError(f"no file {path}, and no shipped study of that name: there are {names}")


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _parse(content: object, path: Path, text: str) -> Study:
    body = _mapping(content, "the file", _KEYS)
    name = body.get("task", "run")
    if name not in TASKS:
        raise StudyError(f"task must be one of {', '.join(TASKS)}, got {name!r}")
    task = TASKS[name]
    given = _mapping(body.get("factors"), "factors")
    if not given:
        raise StudyError("factors is missing: name at least one, e.g. 'seed: [1, 2, 3]'")
    found = {each: _values(value, factor(each, name), each) for each, value in given.items()}
    grid = {each: values for each, values in found.items() if isinstance(values, list)}
    spreads = {each: spread for each, spread in found.items() if isinstance(spread, Spread)}
    study = Study(
        name=str(body.get("name", path.stem)),
        about=str(body.get("about", "")).strip(),
        task=task,
        grid=grid,
        spreads=spreads,
        draw=_draw(body.get("draw"), spreads, math.prod(map(len, grid.values()))),
        keep=_keep(body.get("keep"), task),
        limb=_limb(body.get("limb"), path),
        text=text,
    )
    return replace(study, plots=_plots(body.get("plots") or [], study))


def _mapping(content: object, where: str, known: Sequence[str] = ()) -> dict[str, Any]:
    """Return the keys of a part of the file, all of them ``known`` ones where these are given."""
    if content is None:
        return {}
    if not isinstance(content, Mapping):
        raise StudyError(f"{where} must be keys with values, got {type(content).__name__}")
    for key in content:
        if known and key not in known:
            raise StudyError(f"{where}: unknown key '{key}'; known: {', '.join(known)}")
    return {str(key): value for key, value in content.items()}


def _values(content: Any, declared: Factor, name: str) -> list[Value] | Spread:
    """Return the values of a factor, or what it is drawn from."""
    where = f"factors.{name}"
    if not isinstance(content, Mapping):
        values = content if isinstance(content, list) else [content]
        if not values:
            raise StudyError(f"{where} is an empty list")
        return [
            declared.checked(value, f"{where}[{index}]" if len(values) > 1 else where)
            for index, value in enumerate(values)
        ]
    if set(content) != {"first", "count"}:
        return _spread(content, declared, where)
    first = declared.checked(content["first"], f"{where}.first")
    if not isinstance(first, int):
        raise StudyError(f"{where}: first and count are for whole numbers")
    count = _whole(content["count"], f"{where}.count")
    declared.checked(first + count - 1, f"{where}.count")
    return list(range(first, first + count))


def _spread(content: Mapping[str, Any], declared: Factor, where: str) -> Spread:
    if not isinstance(declared.default, float):
        raise StudyError(f"{where}: only numbers are drawn from a range: list the values")
    if set(content) == {"mean", "deviation"}:
        deviation = content["deviation"]
        if not isinstance(deviation, (int, float)) or not deviation > 0:
            raise StudyError(f"{where}.deviation must be above 0, got {deviation!r}")
        mean = declared.checked(content["mean"], f"{where}.mean")
        return Spread(float(mean), float(deviation), "normal")
    if set(content) - {"scale"} != {"low", "high"}:
        raise StudyError(
            f"{where} must be a value, a list, {{first, count}} of whole numbers, {{low, high}} "
            f"with scale (even or log) if wanted, or {{mean, deviation}}; got the keys "
            f"{', '.join(map(str, content))}"
        )
    scale = str(content.get("scale", "even"))
    low, high = (float(declared.checked(content[key], f"{where}.{key}")) for key in ("low", "high"))
    if scale not in ("even", "log") or (scale == "log" and low <= 0):
        raise StudyError(f"{where}.scale must be even, or log above 0, got {scale!r}")
    if not low < high:
        raise StudyError(f"{where}.low must be below {where}.high, got {low:g} and {high:g}")
    return Spread(low, high, scale)


def _draw(content: object, spreads: Mapping[str, Spread], combinations: int) -> Draw:
    given = _mapping(content, "draw", ("method", "count", "seed"))
    if not spreads:
        if given:
            raise StudyError("draw is given, but no factor has {low, high} or {mean, deviation}")
        return Draw()
    if "count" not in given:
        raise StudyError(f"draw.count is missing: {', '.join(spreads)} are drawn")
    method, count = str(given.get("method", "sobol")), _whole(given["count"], "draw.count")
    if method not in METHODS:
        raise StudyError(f"draw.method must be one of {', '.join(METHODS)}, got {method!r}")
    if method != "random" and count & (count - 1):
        raise StudyError(
            f"draw.count must be a power of two for {method}, got {count}: choose "
            f"{2 ** round(math.log2(count))}, or method random"
        )
    if method == "saltelli" and (combinations != 1 or len(spreads) < 2):
        raise StudyError(
            "draw.method saltelli needs two drawn factors or more, and one value of every other "
            f"factor; these make {combinations} combinations: write one study for each"
        )
    return Draw(method, count, _whole(given.get("seed", 0), "draw.seed", least=0))


def _whole(value: object, where: str, least: int = 1) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or value < least:
        raise StudyError(f"{where} must be a whole number of {least} or more, got {value!r}")
    return value


def _keep(content: object, task: Task) -> tuple[str, ...]:
    if content is None:
        return tuple(task.columns)
    if not isinstance(content, list) or not content:
        raise StudyError(f"keep must be a list of columns of {', '.join(task.columns)}")
    for name in content:
        if name not in task.columns:
            raise StudyError(f"keep: unknown column '{name}'; known: {', '.join(task.columns)}")
    return tuple(dict.fromkeys(map(str, content)))


def _limb(content: object, path: Path) -> str:
    """Return the text of a limb file, given relative to the study's own folder."""
    if content is None:
        return ""
    file = path.parent / str(content)
    try:
        Limb.from_yaml(file)
    except LimbError as error:
        raise StudyError(f"limb: {error}") from error
    return file.read_text(encoding="utf-8")


def _plots(content: object, study: Study) -> tuple[dict[str, str], ...]:
    if not isinstance(content, list):
        raise StudyError("plots must be a list, each with a kind")
    columns, plots = (*study.factors, *study.keep), []
    for index, item in enumerate(content):
        where = f"plots[{index}]"
        plot = {key: str(value) for key, value in _mapping(item, where).items()}
        kind = plot.get("kind", "")
        if kind not in PLOTS:
            raise StudyError(f"{where}.kind must be one of {', '.join(PLOTS)}, got {kind!r}")
        named = (*PLOTS[kind], *_FACTORS_OF_PLOTS)
        _mapping(plot, where, (*named, *_MORE_OF_PLOTS))
        for key in named:
            if key not in plot and key in PLOTS[kind]:
                raise StudyError(f"{where}.{key} is missing: a {kind} needs {PLOTS[kind]}")
            if key in plot and plot[key] not in columns:
                raise StudyError(
                    f"{where}.{key}: no column '{plot[key]}'; there are {', '.join(columns)}"
                )
        if kind == "indices" and study.draw.method != "saltelli":
            raise StudyError(f"{where}: indices need draw.method saltelli")
        plots.append({"name": f"{kind}_{index}", **plot})
    names = [plot["name"] for plot in plots]
    if len(set(names)) < len(names) or "/" in "".join(names):
        raise StudyError(f"plots: the names {', '.join(names)} must be files', each once")
    return tuple(plots)
