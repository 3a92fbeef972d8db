"""Messages to text and from text, as the real tool has them (rosidl_runtime_py is no wheel)."""

from __future__ import annotations

import array
import importlib
import sys
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
import yaml
from rosidl_parser.definition import (
    AbstractNestedType,
    AbstractString,
    AbstractWString,
    NamespacedType,
)

from ros2_verbs.cli import CommandError

SHOWN = 128
"""Number of elements of an array, or characters of a string, after which the rest is left out."""
_HEADER = ("std_msgs", "msg", "Header")
_TIME = ("builtin_interfaces", "msg", "Time")


def interface(identifier: str, kind: str) -> Any:
    """Return the class of a message, service or action.

    Args:
        identifier: ``std_msgs/msg/String``, or ``std_msgs/String``.
        kind: ``msg``, ``srv`` or ``action``.

    Raises:
        CommandError: there is no such type.
    """
    package, _, name = identifier.partition("/")
    try:
        return getattr(importlib.import_module(f"{package}.{kind}"), name.removeprefix(f"{kind}/"))
    except (AttributeError, ImportError, ValueError) as error:
        what = {"msg": "message", "srv": "service"}.get(kind, kind)
        raise CommandError(f"The passed {what} type is invalid") from error


def to_yaml(message: Any, shown: int | None = None, arrays: bool = True) -> str:
    """Return a message as YAML, fields in the order of its definition.

    Args:
        message: the message.
        shown: this many elements of arrays and characters of strings; all if None.
        arrays: show elements of arrays; else only their type and number.
    """
    return yaml.dump(
        _plain(message, shown, arrays),
        Dumper=yaml.SafeDumper,
        allow_unicode=True,
        width=sys.maxsize,
        default_flow_style=False,
        sort_keys=False,
    )


def _plain(value: Any, shown: int | None, arrays: bool, type_name: str = "") -> Any:
    """Return a value of a message as what YAML knows: dict, list, str, bool, int, float."""
    if hasattr(value, "get_fields_and_field_types"):
        return {
            name: _plain(getattr(value, name), shown, arrays, kind)
            for name, kind in value.get_fields_and_field_types().items()
        }
    if isinstance(value, (str, bytes)):
        text = value.decode("latin-1") if isinstance(value, bytes) else value
        return text if shown is None or len(text) <= shown else text[:shown] + "..."
    if isinstance(value, (list, tuple, array.array, np.ndarray)):
        if not arrays:
            return f"<{type_name}, length: {len(value)}>"
        elements = [_plain(item, shown, arrays) for item in value[:shown]]
        return elements if len(elements) == len(value) else [*elements, "..."]
    return value.item() if isinstance(value, np.generic) else value


class Filled:
    """A message that is filled with values in YAML.

    Fields ``header: auto`` and ``stamp: now`` (any builtin_interfaces/Time) are set by `stamp`.

    Args:
        kind: class of the message.
        text: the values in YAML.

    Raises:
        CommandError: the text is no dictionary in YAML, a field does not exist, or it takes no such
            value; names the field.
    """

    def __init__(self, kind: Any, text: str) -> None:
        self._stamps: list[Callable[[Any], None]] = []
        try:
            values = yaml.safe_load(text)
        except yaml.YAMLError as error:
            raise CommandError(f"The passed value is no YAML: {error}") from error
        if not isinstance(values, Mapping):
            raise CommandError("The passed value needs to be a dictionary in YAML format")
        self.message = self._filled(kind, values, "")

    def stamp(self, now: Any) -> None:
        """Set the stamps to a builtin_interfaces/Time."""
        for set_time in self._stamps:
            set_time(now)

    def _filled(self, kind: Any, values: Any, path: str) -> Any:
        # Without the argument, a generated class takes any value and fails when it is sent.
        message = kind(check_fields=True)
        if not isinstance(values, Mapping):
            raise CommandError(f"Failed to populate field: '{path}' takes a dictionary")
        slots = dict(zip(message.get_fields_and_field_types(), message.SLOT_TYPES, strict=True))
        for name, value in values.items():
            if name not in slots:
                raise CommandError(f"Failed to populate field: {kind.__name__} has no '{name}'")
            where = f"{path}.{name}".lstrip(".")
            kind_of_field = getattr(slots[name], "namespaced_name", tuple)()
            if value == "now" and kind_of_field == _TIME:
                self._stamps.append(partial(setattr, message, name))
            elif value == "auto" and kind_of_field == _HEADER:
                self._stamps.append(partial(setattr, getattr(message, name), "stamp"))
            else:
                try:
                    setattr(message, name, self._converted(slots[name], value, where))
                except (AssertionError, TypeError, ValueError, OverflowError) as error:
                    type_name = message.get_fields_and_field_types()[name]
                    raise CommandError(
                        f"Failed to populate field: '{where}' of type {type_name} cannot be "
                        f"{value!r}"
                    ) from error
        return message

    def _converted(self, kind: Any, value: Any, path: str) -> Any:
        """Return a value of the type of a field; nothing is rounded or cut to make it one."""
        if isinstance(kind, NamespacedType):
            namespace = importlib.import_module(".".join(kind.namespaces))
            return self._filled(getattr(namespace, kind.name), value, path)
        if isinstance(kind, AbstractNestedType):
            if not isinstance(value, (list, bytes)):
                raise TypeError(path)
            return [
                self._converted(kind.value_type, item, f"{path}[{index}]")
                for index, item in enumerate(value)
            ]
        if isinstance(kind, (AbstractString, AbstractWString)):
            if isinstance(value, (Mapping, list)) or value is None:
                raise TypeError(path)
            return str(value)
        if kind.typename in ("float", "double"):
            return float(value)  # YAML reads ``1e-3`` as a text
        return bytes([value]) if kind.typename == "octet" else value
