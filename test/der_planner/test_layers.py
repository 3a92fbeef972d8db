"""Which part of der_planner may import which: downward only, without cycles, also for types."""

import ast
import functools
import graphlib
from pathlib import Path

import der_planner

ROOT = Path(der_planner.__file__).parent
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
    "identification": 5,
    "control": 6,
    "experiment": 7,
    "page": 7,
    "nodes": 7,
    "studies": 8,
    "commands": 9,
}
"""Place of each part in the order; an import must go to a lower one, or stay inside its part."""


@functools.cache
def modules() -> dict[str, Path]:
    return {
        "der_planner." + ".".join(path.relative_to(ROOT).with_suffix("").parts): path
        for path in ROOT.rglob("*.py")
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
