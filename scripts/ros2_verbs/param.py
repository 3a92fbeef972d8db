"""``ros2 param``: the parameters of nodes."""

from __future__ import annotations

import argparse
import re
import sys
from typing import Any

import yaml
from rcl_interfaces.msg import Parameter, ParameterDescriptor, ParameterType, ParameterValue
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters, SetParameters
from rclpy.parameter import get_parameter_value

from ros2_verbs.cli import CommandError, add_verb, add_verbs
from ros2_verbs.session import HIDDEN_PREFIX, Session, absolute, add_session_arguments, full_name

# By type: the field of ParameterValue, how `get` announces it, what `describe` calls it.
_KINDS = {
    ParameterType.PARAMETER_BOOL: ("bool_value", "Boolean value is:", "boolean"),
    ParameterType.PARAMETER_INTEGER: ("integer_value", "Integer value is:", "integer"),
    ParameterType.PARAMETER_DOUBLE: ("double_value", "Double value is:", "double"),
    ParameterType.PARAMETER_STRING: ("string_value", "String value is:", "string"),
    ParameterType.PARAMETER_BYTE_ARRAY: ("byte_array_value", "Byte values are:", "byte array"),
    ParameterType.PARAMETER_BOOL_ARRAY: (
        "bool_array_value",
        "Boolean values are:",
        "boolean array",
    ),
    ParameterType.PARAMETER_INTEGER_ARRAY: (
        "integer_array_value",
        "Integer values are:",
        "integer array",
    ),
    ParameterType.PARAMETER_DOUBLE_ARRAY: (
        "double_array_value",
        "Double values are:",
        "double array",
    ),
    ParameterType.PARAMETER_STRING_ARRAY: (
        "string_array_value",
        "String values are:",
        "string array",
    ),
    ParameterType.PARAMETER_NOT_SET: ("", "Parameter not set.", "not set"),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the verbs of ``ros2 param`` and their arguments."""
    verbs = add_verbs(parser, "param")
    lister = add_verb(verbs, "list", "Output a list of available parameters", _list)
    lister.add_argument("node_name", nargs="?", help="Name of the ROS node")
    lister.add_argument(
        "--param-prefixes",
        nargs="+",
        default=[],
        help="Only list parameters with the provided prefixes",
    )
    lister.add_argument(
        "--param-type", action="store_true", help="Print parameter types with parameter names"
    )
    lister.add_argument("--filter", help="Only list parameters matching the provided regex")
    getter = add_verb(verbs, "get", "Get parameter", _get)
    getter.add_argument("node_name", help="Name of the ROS node")
    getter.add_argument("parameter_name", help="Name of the parameter")
    getter.add_argument("--hide-type", action="store_true", help="Hide the type information")
    setter = add_verb(verbs, "set", "Set parameter", _set)
    setter.add_argument("node_name", help="Name of the ROS node")
    setter.add_argument("parameter_name", help="Name of the parameter")
    setter.add_argument("value", help="Value of the parameter")
    describer = add_verb(
        verbs, "describe", "Show descriptive information about declared parameters", _describe
    )
    describer.add_argument("node_name", help="Name of the ROS node")
    describer.add_argument("parameter_names", nargs="+", help="Names of the parameters")
    for verb in (lister, getter, setter, describer):
        add_session_arguments(verb)
        verb.add_argument(
            "--include-hidden-nodes", action="store_true", help="Consider hidden nodes as well"
        )
        verb.add_argument(
            "--timeout", type=float, dest="spin_time", help="Wait for N seconds until node appears"
        )


def _found(session: Session, options: argparse.Namespace) -> str:
    """Return the full name of the node that the caller named.

    Raises:
        CommandError: there is no such node.
    """
    if not session.find_node(options.node_name, options.include_hidden_nodes):
        raise CommandError("Node not found")
    return absolute(options.node_name)


def _descriptors(session: Session, node: str, names: list[str]) -> list[ParameterDescriptor]:
    request = DescribeParameters.Request(names=names)
    return list(
        session.call(DescribeParameters, f"{node}/describe_parameters", request).descriptors
    )


def _list(options: argparse.Namespace) -> None:
    wanted = re.compile(options.filter or "")
    with Session(options) as session:
        if options.node_name:
            nodes = [_found(session, options)]
        else:
            session.discover()
            services = session.services()
            nodes = [
                full_name(name, space)
                for name, space in session.nodes()
                if options.include_hidden_nodes or not name.startswith(HIDDEN_PREFIX)
            ]
            nodes = [node for node in nodes if f"{node}/list_parameters" in services]
        for node in nodes:
            request = ListParameters.Request(prefixes=options.param_prefixes)
            try:
                answer = session.call(ListParameters, f"{node}/list_parameters", request)
            except CommandError as error:
                print(f"Exception while calling service of node '{node}': {error}", file=sys.stderr)
                continue
            names = sorted(name for name in answer.result.names if wanted.search(name))
            if not options.node_name:
                print(f"{node}:")
            types = {}
            if options.param_type:
                types = {item.name: item.type for item in _descriptors(session, node, names)}
            for name in names:
                suffix = f" (type: {_KINDS[types[name]][2]})" if options.param_type else ""
                print(f"  {name}{suffix}")


def _get(options: argparse.Namespace) -> str | None:
    with Session(options) as session:
        node = _found(session, options)
        request = GetParameters.Request(names=[options.parameter_name])
        values = session.call(GetParameters, f"{node}/get_parameters", request).values
    if not values:
        return "Parameter not set"
    if values[0].type not in _KINDS:
        return f"Unknown parameter type '{values[0].type}'"
    field, label, _ = _KINDS[values[0].type]
    value: Any = getattr(values[0], field) if field else None
    if options.hide_type:
        print(value)
    else:
        print(*([label] if value is None else [label, value]))
    return None


def parameter_value(text: str) -> ParameterValue:
    """Return a parameter's value of the type that the text has in YAML; else it is a string.

    Raises:
        CommandError: an integer does not fit into 64 bit.
    """
    try:
        value = yaml.safe_load(text)
    except yaml.YAMLError:
        value = None
    integers = value if isinstance(value, list) else [value]
    if any(isinstance(item, int) and not -(2**63) <= item < 2**63 for item in integers):
        raise CommandError(f"{text} does not fit into an integer parameter (64 bit)")
    if isinstance(value, (bool, int, float, str, list)):
        return get_parameter_value(text)
    return ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=text)


def _set(options: argparse.Namespace) -> None:
    with Session(options) as session:
        node = _found(session, options)
        parameter = Parameter(name=options.parameter_name, value=parameter_value(options.value))
        request = SetParameters.Request(parameters=[parameter])
        result = session.call(SetParameters, f"{node}/set_parameters", request).results[0]
    outcome = "Set parameter successful" if result.successful else "Setting parameter failed"
    reason = f": {result.reason}" if result.reason else ""
    # The real tool exits with 0 in both cases.
    print(outcome + reason, file=sys.stdout if result.successful else sys.stderr)


def _describe(options: argparse.Namespace) -> None:
    with Session(options) as session:
        node = _found(session, options)
        for descriptor in _descriptors(session, node, options.parameter_names):
            _print_descriptor(descriptor)


def _print_descriptor(descriptor: ParameterDescriptor) -> None:
    print(f"Parameter name: {descriptor.name}")
    print(f"  Type: {_KINDS[descriptor.type][2]}")
    if descriptor.description:
        print(f"  Description: {descriptor.description}")
    print("  Constraints:")
    if descriptor.read_only:
        print("    Read only: true")
    for limits in [*descriptor.floating_point_range, *descriptor.integer_range][:1]:
        print(f"    Min value: {limits.from_value}")
        print(f"    Max value: {limits.to_value}")
        if limits.step:
            print(f"    Step: {limits.step}")
    if descriptor.additional_constraints:
        print(f"    Additional constraints: {descriptor.additional_constraints}")
