"""Parameters with a description and a range: bad values and unknown names are refused or said."""

from __future__ import annotations

import difflib
import itertools
import re
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import InvalidParameterTypeException, ParameterNotDeclaredException
from rclpy.node import Node
from rclpy.parameter import Parameter

_OF_RCLPY = ("qos_overrides.", "start_type_description_service")
"""Beginnings of the names of parameters that rclpy declares itself."""
_TAKEN = {str: (int, float), float: (int,)}
"""Numbers that are taken where a text or a float is wanted."""
Value = bool | int | float | str | list[float] | list[int] | list[str]


class ParameterError(ValueError):
    """A parameter has a value that the node cannot work with; the message names both."""


def declare(
    node: Node,
    name: str,
    default: Value,
    description: str,
    at_least: float | None = None,
    at_most: float | None = None,
    choices: tuple[str, ...] = (),
    read_only: bool = True,
) -> Value:
    """Declare one parameter and return its value.

    Args:
        node: the node that owns it.
        name: of the parameter.
        default: used where neither a file nor the command line sets it; its type is the type.
        description: one sentence with the unit, shown by ``ros2 param describe``.
        at_least: smallest admissible number.
        at_most: largest admissible number.
        choices: the admissible values of a string.
        read_only: refuse changes while the node runs.

    Raises:
        ParameterError: the value that was set has another type, is out of range or no choice.
    """
    descriptor = ParameterDescriptor(description=description, read_only=read_only)
    if choices:
        descriptor.additional_constraints = "one of " + ", ".join(choices)
    if at_least is not None or at_most is not None:
        number, widest = (float, 1e308) if isinstance(default, float) else (int, 2**62)
        limits = {
            "from_value": number(-widest if at_least is None else at_least),
            "to_value": number(widest if at_most is None else at_most),
        }
        if number is float:
            descriptor.floating_point_range = [FloatingPointRange(**limits)]
        else:
            descriptor.integer_range = [IntegerRange(**limits)]
    try:
        value = _declared(node, name, default, descriptor)
    except Exception as error:
        raise ParameterError(f"parameter '{name}' ({description}): {error}") from error
    if choices and value not in choices:
        raise ParameterError(f"parameter '{name}' is '{value}': choose {', '.join(choices)}")
    return value  # type: ignore[no-any-return]


def _declared(node: Node, name: str, default: Value, descriptor: ParameterDescriptor) -> Any:
    """Declare a parameter; a number is taken where a text or a float is wanted, as ``a:=10``.

    The command line makes a whole number of ``10`` whatever is wanted.
    """
    try:
        return node.declare_parameter(name, default, descriptor).value
    except InvalidParameterTypeException:
        given = node.declare_parameter(
            name, default, ParameterDescriptor(dynamic_typing=True)
        ).value
        node.undeclare_parameter(name)
        if type(given) not in _TAKEN.get(type(default), ()):
            raise
        meant = type(default)(given)
        return node.declare_parameter(name, meant, descriptor, ignore_override=True).value


def check_overrides(node: Node) -> None:
    """Refuse parameter values that nothing took; call it when all parameters are declared.

    A value that was meant to change something must not leave the default in force. From then on a
    parameter that is set and not declared is refused by its name, too.

    Raises:
        ParameterError: names the value, and what it may have been meant to be.
    """
    node.add_pre_set_parameters_callback(lambda given: _only_declared(node, given))
    if found := [*_unknown_names(node), *_foreign_files(node)]:
        raise ParameterError("; ".join(found))


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


def _foreign_files(node: Node) -> Iterator[str]:
    """Yield a sentence for each parameter file that was meant for this node and misses it."""
    own = node.get_fully_qualified_name()
    for word, path in itertools.pairwise(sys.argv):
        if word != "--params-file":
            continue
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
