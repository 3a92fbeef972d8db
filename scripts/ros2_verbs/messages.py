"""Messages from and to YAML, with the layout of the real tool (rosidl_runtime_py is no wheel)."""

from __future__ import annotations

import array
import importlib
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import yaml
from rosidl_parser.definition import (
    AbstractNestedType,
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
_FLOATS = ("float", "double", "long double")


def interface(identifier: str, kind: str) -> Any:
    """Return the class of a message or service.

    Args:
        identifier: ``std_msgs/msg/String``, or ``std_msgs/String``.
        kind: ``msg`` or ``srv``.

    Raises:
        CommandError: there is no such type.
    """
    what = "message" if kind == "msg" else "service"
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
    element = _type_name(kind.value_type)
    if isinstance(kind, Array):
        return f"<array type: {element}[{kind.size}]>"
    bound = f"[{kind.maximum_size}]" if isinstance(kind, BoundedSequence) else ""
    return f"<sequence type: {element}{bound}, length: {len(value)}>"


def _type_name(kind: Any) -> str:
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


class Filler:
    """Fills a message with values; remembers which stamps are to be the time of sending.

    ``header: auto`` and ``stamp: now`` (any builtin_interfaces/Time) are set by `stamp`.
    """

    def __init__(self, message: Any, values: Any) -> None:
        """Set the fields.

        Raises:
            CommandError: a field does not exist or takes no such value; names it.
        """
        self._stamps: list[Callable[[Any], None]] = []
        self.message = message
        try:
            self._set_fields(message, values, "")
        except Exception as error:
            raise CommandError(f"Failed to populate field: {error}") from error

    def stamp(self, now: Any) -> None:
        """Set the stamps to a builtin_interfaces/Time."""
        for set_time in self._stamps:
            set_time(now)

    def _set_fields(self, message: Any, values: Any, path: str) -> None:
        if not isinstance(values, Mapping):
            raise TypeError(
                f"Value '{values}' is expected to be a dictionary but is a {type(values).__name__}"
            )
        slots = dict(zip(message.get_fields_and_field_types(), message.SLOT_TYPES, strict=True))
        for name, value in values.items():
            if name not in slots:
                raise AttributeError(f"'{type(message).__name__}' object has no attribute '{name}'")
            kind, where = slots[name], f"{path}{name}"
            if isinstance(kind, NamespacedType):
                field = getattr(message, name)
                if value == "auto" and kind.namespaced_name() == ("std_msgs", "msg", "Header"):
                    self._stamps.append(partial(setattr, field, "stamp"))
                elif value == "now" and kind.namespaced_name() == (
                    "builtin_interfaces",
                    "msg",
                    "Time",
                ):
                    self._stamps.append(partial(setattr, message, name))
                else:
                    self._set_fields(field, value, f"{where}.")
            elif isinstance(kind, AbstractNestedType):
                setattr(message, name, self._array(getattr(message, name), kind, value, where))
            else:
                setattr(message, name, scalar(kind, value, where))

    def _array(self, current: Any, kind: Any, value: Any, path: str) -> Any:
        if not isinstance(value, (list, bytes)):
            raise TypeError(f"'{path}' takes a list, not {value!r}")
        if isinstance(kind.value_type, NamespacedType):
            namespaces = ".".join(kind.value_type.namespaces)
            element = getattr(importlib.import_module(namespaces), kind.value_type.name)
            filled = [element() for _ in value]
            for index, (item, part) in enumerate(zip(filled, value, strict=True)):
                self._set_fields(item, part, f"{path}[{index}].")
            return filled
        items = [scalar(kind.value_type, part, f"{path}[{i}]") for i, part in enumerate(value)]
        if isinstance(current, array.array):
            return array.array(current.typecode, items)
        return np.array(items, dtype=current.dtype) if isinstance(current, np.ndarray) else items


def scalar(kind: Any, value: Any, path: str = "") -> Any:
    """Return a value of the type of a field.

    Args:
        kind: the field's type from ``SLOT_TYPES``, no array and no message.
        value: from YAML; numbers may be texts, since YAML reads ``1e-3`` as one.
        path: of the field, for the message of an error.

    Raises:
        TypeError: the value is no such thing; nothing is rounded or cut to make it one.
    """
    refused = TypeError(f"'{path}' of type {_type_name(kind)} cannot be {value!r}")
    if isinstance(kind, (AbstractString, AbstractWString)):
        if isinstance(value, (Mapping, list)) or value is None:
            raise refused
        return str(value)
    if kind.typename == "boolean":
        if not isinstance(value, bool) and value not in (0, 1):
            raise refused
        return bool(value)
    if kind.typename == "octet" and isinstance(value, str) and len(value) == 1:
        return value.encode("latin-1")
    try:
        if isinstance(value, bool) or (kind.typename not in _FLOATS and int(value) != float(value)):
            raise refused
        number = float(value) if kind.typename in _FLOATS else int(value)
        return bytes([number]) if kind.typename == "octet" else number
    except (ValueError, OverflowError) as error:
        raise refused from error
