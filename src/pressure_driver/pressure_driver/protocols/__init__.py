"""The languages of valve boards."""

from __future__ import annotations

from pressure_driver.protocols.base import BoardProtocol, HostProtocol
from pressure_driver.protocols.ctrlp import CtrlpBoard, CtrlpHost
from pressure_driver.protocols.ezloop import EzloopBoard, EzloopHost
from pressure_driver.protocols.native import NativeBoard, NativeHost

HOSTS: dict[str, type[HostProtocol]] = {
    "ezloop": EzloopHost,
    "ctrlp": CtrlpHost,
    "native": NativeHost,
}
BOARDS: dict[str, type[BoardProtocol]] = {
    "ezloop": EzloopBoard,
    "ctrlp": CtrlpBoard,
    "native": NativeBoard,
}
NAMES = tuple(HOSTS)
"""The protocols that can be chosen."""


def host_protocol(name: str, chamber_count: int = 4) -> HostProtocol:
    """Return the driver's end of a protocol.

    Raises:
        ValueError: there is no such protocol; the message lists them.
    """
    if name not in HOSTS:
        raise ValueError(f"unknown board protocol '{name}': choose {', '.join(NAMES)}")
    return HOSTS[name](chamber_count)


def board_protocol(name: str, chamber_count: int = 4) -> BoardProtocol:
    """Return the firmware's end of a protocol.

    Raises:
        ValueError: there is no such protocol; the message lists them.
    """
    if name not in BOARDS:
        raise ValueError(f"unknown board protocol '{name}': choose {', '.join(NAMES)}")
    return BOARDS[name](chamber_count)
