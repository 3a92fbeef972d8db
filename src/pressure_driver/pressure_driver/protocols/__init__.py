"""The languages of valve boards."""

from __future__ import annotations

from pressure_driver.protocols.base import BoardProtocol, HostProtocol
from pressure_driver.protocols.ctrlp import CtrlpBoard, CtrlpHost
from pressure_driver.protocols.ezloop import EzloopBoard, EzloopHost
from pressure_driver.protocols.native import NativeBoard, NativeHost

PROTOCOLS: dict[str, tuple[type[HostProtocol], type[BoardProtocol]]] = {
    "ezloop": (EzloopHost, EzloopBoard),
    "ctrlp": (CtrlpHost, CtrlpBoard),
    "native": (NativeHost, NativeBoard),
}
"""Both ends of each."""
NAMES = tuple(PROTOCOLS)
"""The protocols that can be chosen."""


def host_protocol(name: str, chamber_count: int = 4) -> HostProtocol:
    """Return the driver's end of one of the `PROTOCOLS`."""
    return PROTOCOLS[name][0](chamber_count)


def board_protocol(name: str, chamber_count: int = 4) -> BoardProtocol:
    """Return the firmware's end of one of the `PROTOCOLS`."""
    return PROTOCOLS[name][1](chamber_count)
