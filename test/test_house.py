"""Rules of the house that no linter knows: one name for one thing, short lists, layers."""

from __future__ import annotations

import ast
import functools
import graphlib
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import TypeVar

import der_planner

ROOT = Path(__file__).resolve().parents[1]
MOST_PARAMETERS = 8

MANY_PARAMETERS = {"rod.py uniform", "rod.py simulate"}
"""Functions of the public interface with more than `MOST_PARAMETERS`, named by their callers."""

Kind = TypeVar("Kind", bound=ast.AST)


@functools.cache
def nodes() -> list[tuple[Path, ast.AST]]:
    """Return all of the sources and scripts as their parser sees them, with the files."""
    every = (path for folder in ("src", "scripts") for path in (ROOT / folder).rglob("*.py"))
    paths = [path for path in every if "build" not in path.parts]  # pip leaves a copy there
    return [
        (path.relative_to(ROOT), node)
        for path in sorted(paths)
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, (ast.ClassDef, ast.FunctionDef))
    ]


def definitions(kind: type[Kind]) -> Iterator[tuple[Path, Kind]]:
    """Return every definition of a kind in the sources and scripts, with its file."""
    return ((path, node) for path, node in nodes() if isinstance(node, kind))


def test_a_public_class_name_means_one_thing():
    places = defaultdict(list)
    for path, node in definitions(ast.ClassDef):
        if not node.name.startswith("_"):
            places[node.name].append(str(path))
    twice = {name: where for name, where in places.items() if len(where) > 1}
    assert not twice


def test_no_function_has_many_parameters():
    many = {}
    for path, node in definitions(ast.FunctionDef):
        given = node.args
        names = [each.arg for each in (*given.posonlyargs, *given.args, *given.kwonlyargs)]
        count = len([name for name in names if name not in ("self", "cls")])
        if count > MOST_PARAMETERS:
            many[f"{path.name} {node.name}"] = count
    assert many.keys() == MANY_PARAMETERS, many


# Layers of der_planner: imports go downward only, without cycles, also for types.
PARTS = Path(der_planner.__file__).parent
LAYERS = {
    "methods": 0,
    "arrays": 0,
    "files": 0,
    "limb": 1,
    "rod": 2,
    "model": 3,
    "twin": 4,
    "planning": 4,
    "bags": 4,
    "results": 5,
    "estimation": 5,
    "identification": 6,
    "control": 7,
    "experiment": 8,
    "page": 8,
    "nodes": 8,
    "studies": 9,
    "commands": 10,
}
"""Place of each part in the order; an import must go to a lower one, or stay inside its part."""


@functools.cache
def modules() -> dict[str, Path]:
    return {
        "der_planner." + ".".join(path.relative_to(PARTS).with_suffix("").parts): path
        for path in PARTS.rglob("*.py")
        if path.name != "__init__.py"
    }


@functools.cache
def imports(path: Path) -> frozenset[str]:
    """Return every dotted name that a file imports, at any depth and under TYPE_CHECKING."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return frozenset(name for name in found if name.startswith("der_planner."))


def part(name: str) -> str:
    return name.split(".")[1]


def test_every_part_has_its_place():
    assert {part(name) for name in modules()} <= LAYERS.keys()


def test_imports_go_downward_and_none_to_the_nodes():
    wrong = [
        f"{name} imports {other}"
        for name, path in modules().items()
        for other in imports(path)
        if part(name) != part(other)
        and (LAYERS[part(other)] >= LAYERS[part(name)] or part(other) == "nodes")
    ]
    assert not wrong, "\n".join(wrong)


def test_no_module_imports_itself_by_way_of_others():
    graph = {
        name: {other for other in imports(path) if other in modules()}
        for name, path in modules().items()
    }
    graphlib.TopologicalSorter(graph).prepare()  # raises an error that names the cycle
