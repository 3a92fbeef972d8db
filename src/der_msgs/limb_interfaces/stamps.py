"""Between ROS stamps and numbers."""

from __future__ import annotations

from builtin_interfaces.msg import Time

NANOSECONDS = 1_000_000_000


def nanoseconds(stamp: Time) -> int:
    """Return a stamp as integer nanoseconds since the epoch of its clock."""
    return stamp.sec * NANOSECONDS + stamp.nanosec


def seconds(stamp: Time) -> float:
    """Return a stamp in s; a double resolves 0.2 µs at today's Unix time."""
    return stamp.sec + stamp.nanosec * 1e-9


def stamp_from_nanoseconds(value: int) -> Time:
    """Return the stamp of integer nanoseconds."""
    return Time(sec=value // NANOSECONDS, nanosec=value % NANOSECONDS)
