"""Parameter values that were given to a node and that no parameter took: said, or refused."""

from __future__ import annotations

import difflib
import itertools
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml
from rclpy.exceptions import ParameterNotDeclaredException
from rclpy.node import Node
from rclpy.parameter import Parameter

from limb_interfaces.parameters import ParameterError

_OF_RCLPY = ("qos_overrides.", "start_type_description_service")


def check_overrides(
    node: Node, refuse: bool = False, arguments: Sequence[str] | None = None
) -> None:
    """Warn of every parameter value that nothing took; call it when all parameters are declared.

    From then on a parameter that is set and not declared is refused by its name, too.

    Args:
        node: the node.
        refuse: raise instead: for a node on which a limit that is silently left at its default
            could break the limb.
        arguments: command line of the process, `sys.argv` if None.

    Raises:
        ParameterError: with ``refuse``, a value was taken by no parameter; names it and what it
            may have been meant to be.
    """
    node.add_pre_set_parameters_callback(lambda given: _only_declared(node, given))
    found = [*_unknown_names(node), *_foreign_files(node, arguments)]
    if found and refuse:
        raise ParameterError("; ".join(found))
    for text in found:
        node.get_logger().warning(text)


def _only_declared(node: Node, given: list[Parameter]) -> list[Parameter]:
    """Return the parameters that are set; rclpy would refuse others without their names.

    Raises:
        ParameterNotDeclaredException: the node has not declared one of them.
    """
    unknown = [each.name for each in given if not node.has_parameter(each.name)]
    if unknown:
        raise ParameterNotDeclaredException(unknown)
    return given


def _unknown_names(node: Node) -> Iterator[str]:
    """Yield a sentence for each override of this node that names no parameter of it."""
    known = [name for name in node._parameters if not name.startswith(_OF_RCLPY)]
    for name in sorted(node._parameter_overrides):
        if name in known or name.startswith(_OF_RCLPY):
            continue
        near = difflib.get_close_matches(name, known, n=1)
        meant = f": did you mean '{near[0]}'?" if near else f"; it has {', '.join(sorted(known))}"
        yield f"parameter '{name}' is set, but {node.get_fully_qualified_name()} has none{meant}"


def _foreign_files(node: Node, arguments: Sequence[str] | None) -> Iterator[str]:
    """Yield a sentence for each parameter file that was meant for this node and misses it."""
    own = node.get_fully_qualified_name()
    for path in parameter_files(sys.argv if arguments is None else arguments):
        try:
            content = yaml.safe_load(Path(path).read_text())
        except (OSError, yaml.YAMLError):
            continue  # rcl has refused it with its own words
        keys = list(node_keys(content))
        strangers = [key for key in keys if not key_matches(key, own)]
        same_name = [key for key in strangers if key.rsplit("/", 1)[-1] == node.get_name()]
        if same_name or (keys and len(strangers) == len(keys)):
            yield (
                f"parameter file {path}: nothing under {', '.join(same_name or strangers)} is for "
                f"{own}; name it /**/{node.get_name()}, which fits every namespace"
            )


def parameter_files(arguments: Sequence[str]) -> list[str]:
    """Return the files that the command line gives as ``--params-file``."""
    return [
        following for word, following in itertools.pairwise(arguments) if word == "--params-file"
    ]


def node_keys(content: Any, above: str = "") -> Iterator[str]:
    """Yield the nodes that the content of a parameter file names, as absolute names."""
    if not isinstance(content, Mapping):
        return
    for key, value in content.items():
        if key == "ros__parameters":
            yield above
        else:
            yield from node_keys(value, f"{above}/{str(key).strip('/')}")


def key_matches(key: str, name: str) -> bool:
    """Tell whether a node's key in a parameter file, with its wildcards, names a node."""
    pattern = re.escape(key).replace(r"/\*\*", r"(/[^/]+)*").replace(r"\*", r"[^/]+")
    return re.fullmatch(pattern, name) is not None
