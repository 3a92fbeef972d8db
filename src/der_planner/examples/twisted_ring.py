"""A ring that is twisted until it jumps out of its plane, beside Michell's and Zajac's twist.

A straight rod of length L is bent to a closed circle and its two ends, held together, are turned
against each other. The plane ring stays at rest, but above the total twist 2π √3 EI/GJ it is
unstable (Michell 1889; Zajac, J. Appl. Mech. 29, 1962): the smallest eigenvalue of the rod's
stiffness, apart from the motion that costs nothing, changes its sign.

    python3 src/der_planner/examples/twisted_ring.py
"""

from __future__ import annotations

import numpy as np

from der_planner.model.bending import PolylineKinematics
from der_planner.rod import Rod, RodState

EI, GJ = 0.02, 0.016
CRITICAL = 2 * np.pi * np.sqrt(3) * EI / GJ


def ring(nodes: int, twist: float) -> tuple[Rod, RodState]:
    """Return a closed ring of `nodes` nodes under a total twist [rad]; two more nodes overlap.

    The reference frames are carried along in small steps: first while the rod is bent, then while
    its edges turn about themselves.
    """
    count = nodes + 2
    held = [*range(7), *range(4 * count - 8, 4 * count - 1)]
    rod = Rod.uniform(
        length=1.0 + 1.0 / nodes, nodes=count, EI=EI, EA=2e5, GJ=GJ, mass_per_length=1.0,
        clamp="inside", fixed=held, segments=[(0, count)], moment_gain=[1.0],
    )  # fmt: skip
    bent = PolylineKinematics(rod)
    state = rod.straight_state()
    for part in np.linspace(0.02, 1.0, 50):
        state = rod.state(bent.configuration([part * 2 * np.pi]), like=state)
    for part in np.linspace(0.05, 1.0, 20):
        q = state.q.copy()
        q[3::4] = np.linspace(0.0, part * twist, count - 1)
        state = rod.state(q, like=state)
    return rod, state


def softest(nodes: int, twist: float) -> float:
    """Return the smallest eigenvalue of the twisted ring's stiffness [N/m]; below 0 it buckles.

    Left out is the eigenvalue nearest to zero: to turn the ring about its held edge, and its
    cross-sections back, costs a rod that is equally stiff in all directions nothing.
    """
    rod, state = ring(nodes, twist)
    values = np.linalg.eigvalsh(rod.stiffness(state)[np.ix_(rod.free, rod.free)])
    return float(np.delete(values, np.argmin(np.abs(values)))[0])


def critical_twist(nodes: int, tolerance: float = 1e-4) -> float:
    """Return the twist at which the ring becomes unstable, as a multiple of Michell's."""
    stable, unstable = 0.9, 1.1
    if not softest(nodes, stable * CRITICAL) > 0 > softest(nodes, unstable * CRITICAL):
        raise RuntimeError(f"a ring of {nodes} nodes does not buckle within 10 % of {CRITICAL} rad")
    while unstable - stable > tolerance:
        middle = 0.5 * (stable + unstable)
        is_stable = softest(nodes, middle * CRITICAL) > 0
        stable, unstable = (middle, unstable) if is_stable else (stable, middle)
    return 0.5 * (stable + unstable)


def main() -> None:
    """Print the critical twist for finer and finer rings."""
    print(f"Michell, Zajac: {CRITICAL:.4f} rad")
    for nodes in (24, 48):
        found = critical_twist(nodes)
        print(f"{nodes:2d} nodes: {found * CRITICAL:.4f} rad, {found - 1:+.3%}")


if __name__ == "__main__":
    main()
