"""Declare parameters with a description and a range, so that a bad value is refused by its name."""

from __future__ import annotations

from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import InvalidParameterTypeException
from rclpy.node import Node

Value = bool | int | float | str | list[float] | list[int] | list[str]


class ParameterError(ValueError):
    """A parameter has a value that the node cannot work with; the message names both."""


def declare(
    node: Node,
    name: str,
    default: Value,
    description: str,
    *,
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
    bounded = at_least is not None or at_most is not None
    if bounded and isinstance(default, float):
        descriptor.floating_point_range = [
            FloatingPointRange(
                from_value=-1e308 if at_least is None else float(at_least),
                to_value=1e308 if at_most is None else float(at_most),
            )
        ]
    elif bounded and isinstance(default, int):
        descriptor.integer_range = [
            IntegerRange(
                from_value=-(2**62) if at_least is None else int(at_least),
                to_value=2**62 if at_most is None else int(at_most),
                step=0,
            )
        ]
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
        if not isinstance(default, (str, float)):
            raise
        given = node.declare_parameter(
            name, default, ParameterDescriptor(dynamic_typing=True)
        ).value
        node.undeclare_parameter(name)
        whole = isinstance(given, int) and not isinstance(given, bool)
        if not (whole or (isinstance(given, float) and isinstance(default, str))):
            raise
        meant = type(default)(given)
        return node.declare_parameter(name, meant, descriptor, ignore_override=True).value
