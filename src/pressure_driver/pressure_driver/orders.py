"""In which order valves and chambers stand, as parameters name it."""

from __future__ import annotations


class SettingError(ValueError):
    """A parameter has a value that the driver cannot work with; the message names both."""


def order_of(text: str, count: int, first: int = 1, name: str = "wiring") -> tuple[int, ...]:
    """Return the numbers (count,), counted from 0, of a parameter like `wiring`.

    Args:
        text: each number once; empty: in order.
        count: of them.
        first: the smallest one.
        name: of the parameter.

    Raises:
        SettingError: it does not name each of them once.
    """
    usual = [str(first + k) for k in range(count)]
    named = text.replace(",", " ").split() or usual
    if sorted(named) != sorted(usual):
        raise SettingError(
            f"parameter '{name}' is '{text}': name each of {', '.join(usual)} once, in any order"
        )
    return tuple(int(number) - first for number in named)
