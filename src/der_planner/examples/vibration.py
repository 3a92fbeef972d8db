"""The natural frequencies of a cantilever, beside Euler and Bernoulli's.

`Rod.linearise_step` returns the exact A of x' = A x over one time step, x = (q, v) of the free
coordinates. The implicit midpoint rule maps an eigenvalue μ of the continuous motion to
λ = (1 + μ dt/2) / (1 − μ dt/2), which is solved for μ: the frequencies and damping rates of the
rod follow without a simulation. The beam has f_k = β_k² √(EI/m) / (2π L²) with
cos β cosh β = −1 and the mass m per length.

    python3 src/der_planner/examples/vibration.py
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from der_planner.rod import Rod

LENGTH, EI, MASS, DAMPING = 0.25, 0.0175, 1.066, 0.75
STEP = 1e-3


def beam_frequencies(count: int) -> NDArray[np.float64]:
    """Return the first frequencies of the Euler-Bernoulli cantilever [Hz]."""
    beta = [
        brentq(lambda b: np.cos(b) * np.cosh(b) + 1.0, k * np.pi, (k + 1) * np.pi)
        for k in range(count)
    ]
    scale = np.sqrt(EI / MASS) / (2 * np.pi * LENGTH**2)
    return np.array([scale * b**2 for b in beta])


def rod_frequencies(nodes: int, count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the first undamped frequencies [Hz] and the damping rates [1/s] of the rod."""
    rod = Rod.uniform(
        length=LENGTH, nodes=nodes, EI=EI, EA=1e3, GJ=0.01, mass_per_length=MASS,
        damping=DAMPING, plane="xy",
    )  # fmt: skip
    step, _ = rod.linearise_step(rod.straight_state(), [], STEP, "midpoint")
    values = np.asarray(np.linalg.eigvals(step), dtype=np.complex128)
    rates = 2.0 / STEP * (values - 1.0) / (values + 1.0)
    rates = rates[rates.imag > 0.0]
    rates = rates[np.argsort(np.abs(rates))][:count]
    return np.array(np.abs(rates) / (2 * np.pi)), np.array(-rates.real)


def main() -> None:
    """Print the first three frequencies for finer and finer rods."""
    beam = beam_frequencies(3)
    print("beam      " + "   ".join(f"{f:8.4f} Hz        " for f in beam))
    for nodes in (11, 21, 41, 81):
        found, damping = rod_frequencies(nodes, 3)
        errors = "   ".join(
            f"{f:8.4f} Hz {e:+.3%}" for f, e in zip(found, found / beam - 1, strict=True)
        )
        print(f"{nodes:2d} nodes  {errors}   damping rates {np.round(damping, 3)} 1/s")
    print(f"(mass-proportional damping of {DAMPING} 1/s: every mode decays at {DAMPING / 2} 1/s)")


if __name__ == "__main__":
    main()
