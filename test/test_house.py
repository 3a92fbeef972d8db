"""Rules of the house that no linter knows: one name for one thing, short lists of parameters."""

from __future__ import annotations

import ast
import functools
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import TypeVar

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
