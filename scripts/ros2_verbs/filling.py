"""Messages from values in YAML, checked: the generated classes check nothing when they send."""

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
from ros2_verbs.messages import type_name

_FLOATS = ("float", "double", "long double")
_FLOAT_LIMIT = float(np.finfo(np.float32).max)
_HEADER = ("std_msgs", "msg", "Header")
_TIME = ("builtin_interfaces", "msg", "Time")


def values_of(text: str) -> Any:
    """Return the values of a message as they were written in YAML.

    Raises:
        CommandError: it is no YAML.
    """
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise CommandError(f"The passed value is no YAML: {error}") from error


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
                if value == "auto" and kind.namespaced_name() == _HEADER:
                    self._stamps.append(partial(setattr, field, "stamp"))
                elif value == "now" and kind.namespaced_name() == _TIME:
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
        exact, most = getattr(kind, "size", None), getattr(kind, "maximum_size", sys.maxsize)
        if len(value) > most or (exact is not None and len(value) != exact):
            wanted = f"at most {most}" if exact is None else exact
            raise TypeError(f"'{path}' takes {wanted} elements, not {len(value)}")
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
    refused = TypeError(f"'{path}' of type {type_name(kind)} cannot be {value!r}")
    if isinstance(kind, (AbstractString, AbstractWString)):
        too_long = len(str(value)) > getattr(kind, "maximum_size", sys.maxsize)
        if isinstance(value, (Mapping, list)) or value is None or too_long:
            raise refused
        return str(value)
    if kind.typename == "boolean":
        if not isinstance(value, bool) and value not in (0, 1):
            raise refused
        return bool(value)
    if kind.typename == "octet" and isinstance(value, str) and len(value) == 1:
        return value.encode("latin-1")
    if isinstance(value, bool):
        raise refused
    try:
        return _number(kind.typename, value)
    except (TypeError, ValueError, OverflowError) as error:
        raise refused from error


def _number(name: str, value: Any) -> float | int | bytes:
    """Return a number of one of the basic types; raises an error if it is not one exactly."""
    if name in _FLOATS:
        number = float(value)
        if name == "float" and abs(number) > _FLOAT_LIMIT and not np.isinf(number):
            raise OverflowError(value)
        return number
    whole = int(value)
    if not isinstance(value, str) and whole != value:
        raise ValueError(value)
    limits = np.iinfo("uint8" if name in ("octet", "char") else name)
    if not limits.min <= whole <= limits.max:
        raise OverflowError(value)
    return bytes([whole]) if name == "octet" else whole
