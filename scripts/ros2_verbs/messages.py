"""Messages as YAML and CSV, with the layout of the real tool (rosidl_runtime_py is no wheel)."""

from __future__ import annotations

import array
import importlib
import sys
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import yaml
from rosidl_parser.definition import (
    AbstractString,
    AbstractWString,
    Array,
    BasicType,
    BoundedSequence,
    NamedType,
    NamespacedType,
)

from ros2_verbs.cli import CommandError

_ARRAYS = (list, tuple, array.array, np.ndarray)


def interface(identifier: str, kind: str) -> Any:
    """Return the class of a message, service or action.

    Args:
        identifier: ``std_msgs/msg/String``, or ``std_msgs/String``.
        kind: ``msg``, ``srv`` or ``action``.

    Raises:
        CommandError: there is no such type.
    """
    what = {"msg": "message", "srv": "service"}.get(kind, kind)
    parts = identifier.split("/")
    if len(parts) == 2:
        parts.insert(1, kind)
    try:
        if len(parts) != 3 or parts[1] != kind or not all(parts):
            raise ValueError(identifier)
        found = getattr(importlib.import_module(f"{parts[0]}.{kind}"), parts[2])
    except (AttributeError, ImportError, ValueError) as error:
        raise CommandError(f"The passed {what} type is invalid") from error
    return found


def to_yaml(
    message: Any,
    truncate: int | None = None,
    no_arrays: bool = False,
    no_strings: bool = False,
    flow_style: bool = False,
) -> str:
    """Return a message as YAML, fields in the order of its definition.

    Args:
        message: the message.
        truncate: show this many elements of arrays and characters of strings; all if None.
        no_arrays: say the type and length of arrays instead of the contents.
        no_strings: say the length of strings instead of the contents.
        flow_style: on one line.
    """
    return yaml.dump(
        _plain(message, truncate, no_arrays, no_strings),
        Dumper=yaml.SafeDumper,
        allow_unicode=True,
        width=sys.maxsize,
        default_flow_style=flow_style,
        sort_keys=False,
    )


def _plain(
    value: Any, truncate: int | None, no_arrays: bool, no_strings: bool, kind: Any = None
) -> Any:
    """Return a value of a message as what YAML knows: dict, list, str, bool, int, float."""
    recurse = partial(_plain, truncate=truncate, no_arrays=no_arrays, no_strings=no_strings)
    if hasattr(value, "get_fields_and_field_types"):
        names = value.get_fields_and_field_types()
        return {
            name: recurse(getattr(value, name), kind=slot)
            for name, slot in zip(names, value.SLOT_TYPES, strict=True)
        }
    if isinstance(value, str) and no_strings:
        return f"<string length: <{len(value)}>>"
    if isinstance(value, (str, bytes)):
        text = value.decode("latin-1") if isinstance(value, bytes) else value
        return text if truncate is None or len(text) <= truncate else text[:truncate] + "..."
    if isinstance(value, _ARRAYS):
        if no_arrays and kind is not None:
            return _abbreviated(value, kind)
        shown = [recurse(item) for item in value[:truncate]]
        return shown if len(shown) == len(value) else [*shown, "..."]
    return value.item() if isinstance(value, np.generic) else value


def _abbreviated(value: Sequence[Any], kind: Any) -> str:
    element = type_name(kind.value_type)
    if isinstance(kind, Array):
        return f"<array type: {element}[{kind.size}]>"
    bound = f"[{kind.maximum_size}]" if isinstance(kind, BoundedSequence) else ""
    return f"<sequence type: {element}{bound}, length: {len(value)}>"


def type_name(kind: Any) -> str:
    """Return the name of a field's type, given as in ``SLOT_TYPES``."""
    if isinstance(kind, BasicType):
        return str(kind.typename)
    if isinstance(kind, AbstractString):
        return "string"
    if isinstance(kind, AbstractWString):
        return "wstring"
    if isinstance(kind, NamespacedType):
        return "/".join(kind.namespaced_name())
    return str(kind.name) if isinstance(kind, NamedType) else "unknown"


def to_csv(
    value: Any,
    truncate: int | None = None,
    no_arrays: bool = False,
    no_strings: bool = False,
    kind: Any = None,
) -> str:
    """Return the values of all fields of a message, or one value, separated by commas."""
    recurse = partial(to_csv, truncate=truncate, no_arrays=no_arrays, no_strings=no_strings)
    if hasattr(value, "get_fields_and_field_types"):
        names = value.get_fields_and_field_types()
        return ",".join(
            recurse(getattr(value, name), kind=slot)
            for name, slot in zip(names, value.SLOT_TYPES, strict=True)
        )
    if isinstance(value, _ARRAYS):
        if no_arrays and kind is not None:
            return _abbreviated(value, kind)
        shown = [recurse(item) for item in value[:truncate]]
        return ",".join(shown if len(shown) == len(value) else [*shown, "..."])
    if no_strings and isinstance(value, str):
        return f"<string length: <{len(value)}>>"
    if isinstance(value, (str, bytes)) and truncate is not None and len(value) > truncate:
        value = value[:truncate] + (b"..." if isinstance(value, bytes) else "...")
    return str(value)
