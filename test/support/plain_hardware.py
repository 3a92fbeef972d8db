"""Hardware of the twin whose segments are elastic rods."""

from dataclasses import replace

from der_planner.twin.hardware import DrawnHardware, draw


def plain(seed: int = 0, **changes: float) -> DrawnHardware:
    """Return hardware without friction, creep and stiffening: an elastic rod."""
    hardware = draw(seed)
    segments = tuple(
        replace(
            segment,
            cubic_stiffness=0.0,
            pressure_stiffening=0.0,
            elongation=0.0,
            rest_curvature=0.0,
            friction_moment=0.0,
            creep_stiffness=(0.0, 0.0, 0.0),
            wander=0.0,
            coupling=0.0,
            **changes,
        )
        for segment in hardware.segments
    )
    return replace(hardware, segments=segments)
