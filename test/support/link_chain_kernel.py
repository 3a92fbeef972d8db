"""The compiled step of a `LinkChain`: air, hysteresis and the dynamics of rigid links.

With the headings ψ of n links, the angle of joint i is φ_i = ψ_i − ψ_{i−1} and

    Σ_j a_ij cos(ψ_i − ψ_j) ψ̈_j + Σ_j a_ij sin(ψ_i − ψ_j) ψ̇_j² = f_i + t_i − t_{i+1}

where a_ij = ℓ_j B_i for j < i, a_ii = J_i + ℓ_i² R_i, R_i the mass outboard of link i, B_i its own
first moment plus ℓ_i R_i and J_i its own second moment; f_i the torque of gravity and pushes on the
heading; t_i the torque of joint i: drive less spring, friction and viscosity.

One step is the midpoint rule with springs and dashpots taken linearly implicitly: second order, and
stable however stiff a short link is.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

ORIFICE_BAND = 1500.0
"""Pressure error at which a proportional valve is wide open [Pa]."""


class Links(NamedTuple):
    """Mechanics of n links and joints in M segments; R play operators a segment."""

    inertia: np.ndarray  # (n, n) a_ij [kg m²]
    first: np.ndarray  # (n,) B_i [kg m]
    stiffness: np.ndarray  # (n,) [N m/rad]
    viscosity: np.ndarray  # (n,) [N m s/rad]
    hardening: np.ndarray  # (n,) relative growth of a spring's torque per φ² [1/rad²]
    rest: np.ndarray  # (n,) joint angles without torque [rad]
    owner: np.ndarray  # (n,) segment of each joint
    gain: np.ndarray  # (M, 2) torque per gauge pressure of both chambers [N m/Pa]
    width: np.ndarray  # (R,) bend at which each friction element slips [rad]
    slip: np.ndarray  # (M, R) torque at which it slips [N m]
    gravity: np.ndarray  # (2,) [m/s²]


class Air(NamedTuple):
    """Orifices: a valve passes opening × coefficient × √(pressure drop)."""

    inlet: np.ndarray  # (M, 2) [√Pa/s]
    outlet: np.ndarray  # (M, 2) [√Pa/s]
    supply: float  # gauge [Pa]


class State(NamedTuple):
    """What changes; all arrays are written in place."""

    heading: np.ndarray  # (n,) [rad]
    rate: np.ndarray  # (n,) [rad/s]
    stuck: np.ndarray  # (M, R) bend stored in each friction element [rad]
    pressure: np.ndarray  # (M, 2) gauge [Pa]


@njit(cache=True)
def breathe(pressure, command, h, air):
    """Advance the chambers by h under commands (M,) [Pa]: one of a pair is filled, one vented."""
    goal = np.stack((np.maximum(command, 0.0), np.maximum(-command, 0.0)), axis=1)
    # A chamber that is to be empty has its outlet wide open.
    opening = np.where(goal == 0.0, 1.0, np.minimum(np.abs(goal - pressure) / ORIFICE_BAND, 1.0))
    filled = pressure + h * opening * air.inlet * np.sqrt(np.maximum(air.supply - pressure, 0.0))
    vented = pressure - h * opening * air.outlet * np.sqrt(np.maximum(pressure, 0.0))
    filling = goal > pressure
    pressure[:] = np.where(filling, np.minimum(filled, goal), np.maximum(vented, goal))


@njit(cache=True)
def of_joints(headings):
    """Return (n,) what the headings of the links, or their changes, are at the joints."""
    joints = headings.copy()
    joints[1:] -= headings[:-1]
    return joints


@njit(cache=True)
def curved_torques(bent, stuck, pressure, links):
    """Return (n,) torques of drive, friction and hardening: all but linear springs and dashpots."""
    drive = links.gain[:, 0] * pressure[:, 0] - links.gain[:, 1] * pressure[:, 1]
    drive -= (links.slip * stuck / links.width).sum(axis=1)
    return drive[links.owner] - links.stiffness * links.hardening * bent**3


@njit(cache=True)
def slid(stuck, change, links):
    """Return the friction elements' stored bend after a change of the headings."""
    moved = np.zeros((len(stuck), 1))
    for joint, turned in enumerate(of_joints(change)):
        moved[links.owner[joint]] += turned
    return np.minimum(np.maximum(stuck + moved, -links.width), links.width)


@njit(cache=True)
def move(state, h, push, links):
    """Advance the links by h; ``push`` (n,) is the torque of outer forces on each heading."""
    rate = state.rate
    middle = state.heading + 0.5 * h * rate
    bent = of_joints(middle) - links.rest
    stuck = slid(state.stuck, 0.5 * h * rate, links)
    torque = curved_torques(bent, stuck, state.pressure, links)
    torque -= links.stiffness * bent + links.viscosity * of_joints(rate)
    along, across = links.gravity
    force = torque + push + links.first * (across * np.cos(middle) - along * np.sin(middle))
    force[:-1] -= torque[1:]
    turn = middle.reshape(-1, 1) - middle
    force -= (links.inertia * np.sin(turn)) @ rate**2
    matrix = links.inertia * np.cos(turn)
    spring = links.stiffness * (1.0 + 3.0 * links.hardening * bent**2)
    held = 0.5 * h * links.viscosity + 0.25 * h * h * spring
    for i in range(len(held)):
        matrix[i, i] += held[i]
        if i > 0:
            matrix[i - 1, i - 1] += held[i]
            matrix[i, i - 1] -= held[i]
            matrix[i - 1, i] -= held[i]
    gained = np.linalg.solve(matrix, h * force)
    change = h * (rate + 0.5 * gained)
    state.stuck[:] = slid(state.stuck, change, links)
    state.heading[:] += change
    state.rate[:] += gained


@njit(cache=True)
def advance(state, command, h, steps, arms, pushed, links, air):
    """Advance by ``steps`` of h [s] under commands (M,) [Pa] and a push.

    Args:
        state: written in place.
        command: (M,) differential pressures [Pa].
        h: [s].
        steps: their number.
        arms: (n,) of the push along each link [m].
        pushed: (2,) [N].
        links: of the chain.
        air: of the chambers.
    """
    for _ in range(steps):
        breathe(state.pressure, command, h, air)
        turned = pushed[1] * np.cos(state.heading) - pushed[0] * np.sin(state.heading)
        move(state, h, arms * turned, links)
