"""What counts as normal: every bound of the watching, declared once."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class MonitorLimits:
    """Bounds of normal operation."""

    telemetry_timeout: float = 0.5
    """[s] without chamber pressures."""
    over_pressure: float = 30_000.0
    """[Pa] gauge, in any chamber."""
    supply_low: float = 115_000.0
    """[Pa] absolute."""
    supply_high: float = 200_000.0
    """[Pa] absolute."""
    supply_time: float = 0.5
    """[s] that the supply may be outside its bounds."""
    follow_tolerance: float = 3_000.0
    """[Pa] beyond the slowest and fastest response that counts as normal."""
    follow_time: float = 2.0
    """[s] that a chamber may be outside."""
    slowest_fill: float = 4_000.0
    """[Pa/s] that a working valve reaches."""
    slowest_vent: float = 2.5
    """[s] time constant in which a working valve vents."""
    leak_time: float = 10.0
    """[s] over which leaks are looked for: longer than one fill, and than what a neighbour adds."""
    leak_tolerance: float = 1_000.0
    """[Pa] that a chamber may lie below its command in the mean of `leak_time`: some times what a
    sound limb shows at steady pressure (20 to 160 Pa in logs of a real board)."""
    leak_opening: float = 0.25
    """Mean opening of an inlet valve in `leak_time` that a sound chamber may need at steady
    pressure: twice what `valve_opening` shows there; 1 where the board's valves are told otherwise
    or rest open."""
    probe_pressure: float = 150.0
    """[Pa] by which a steady command is changed to see whether the board hears: above the dead band
    of its valves and the noise of its sensors, below what moves the limb much; 0: never."""
    probe_interval: float = 20.0
    """[s] that a command must have been steady before it is changed for a moment."""
    rest_time: float = 1.0
    """[s] of steady readings that make a rest measurement."""
    rest_spread: float = 100.0
    """[Pa] that readings at rest may differ by."""
    rest_drift: float = 20.0
    """[Pa] that the two halves of a rest measurement may differ by in the mean."""
    supply_required: bool = True
    """Arm only with a fresh reading of the supply, on boards whose protocol tells it."""
    vented_tolerance: float = 500.0
    """[Pa] gauge below which a chamber counts as vented."""
