"""What nodes say of themselves, as the graph hears it."""

from __future__ import annotations

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue


def status(name: str, message: str = "", level: bytes = b"\0", **values: str) -> DiagnosticStatus:
    """Return the diagnostics of a node."""
    pairs = [KeyValue(key=key, value=value) for key, value in values.items()]
    return DiagnosticStatus(name=name, level=level, message=message, values=pairs)
