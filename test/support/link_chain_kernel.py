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

    length: np.ndarray  # (n,) [m]
    outboard: np.ndarray  # (n,) R_i [kg]
    first: np.ndarray  # (n,) B_i [kg m]
    second: np.ndarray  # (n,) J_i [kg m²]
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
    for m in range(command.shape[0]):
        for side in range(2):
            goal = max(command[m] if side == 0 else -command[m], 0.0)
            now = pressure[m, side]
            error = goal - now
            opening = min(1.0, abs(error) / ORIFICE_BAND)
            if goal == 0.0:
                opening = 1.0  # a chamber that is to be empty has its outlet wide open
            if error > 0.0:
                now += h * opening * air.inlet[m, side] * np.sqrt(max(air.supply - now, 0.0))
                now = min(now, goal)
            elif error < 0.0:
                now -= h * opening * air.outlet[m, side] * np.sqrt(max(now, 0.0))
                now = max(now, goal)
            pressure[m, side] = now


@njit(cache=True)
def curved_torques(heading, stuck, pressure, links):
    """Return (n,) torques of drive, friction and hardening: all but linear springs and dashpots."""
    count, segments = heading.shape[0], stuck.shape[0]
    friction = np.zeros(segments)
    for m in range(segments):
        for r in range(stuck.shape[1]):
            friction[m] += links.slip[m, r] * stuck[m, r] / links.width[r]
    torque = np.empty(count)
    for i in range(count):
        m = links.owner[i]
        bent = heading[i] - (heading[i - 1] if i > 0 else 0.0) - links.rest[i]
        torque[i] = links.gain[m, 0] * pressure[m, 0] - links.gain[m, 1] * pressure[m, 1]
        torque[i] -= friction[m] + links.stiffness[i] * links.hardening[i] * bent**3
    return torque


@njit(cache=True)
def slide(stuck, heading, change, links, share, out):
    """Write the friction elements' stored bend after ``share`` of a change of the headings."""
    for m in range(stuck.shape[0]):
        moved = 0.0
        for i in range(heading.shape[0]):
            if links.owner[i] == m:
                moved += share * (change[i] - (change[i - 1] if i > 0 else 0.0))
        for r in range(stuck.shape[1]):
            out[m, r] = min(max(stuck[m, r] + moved, -links.width[r]), links.width[r])


@njit(cache=True)
def move(state, h, push, links):
    """Advance the links by h; ``push`` (n,) is the torque of outer forces on each heading."""
    count = state.heading.shape[0]
    rate = state.rate
    middle = state.heading + 0.5 * h * rate
    stuck = np.empty_like(state.stuck)
    slide(state.stuck, state.heading, h * rate, links, 0.5, stuck)
    curved = curved_torques(middle, stuck, state.pressure, links)
    torque = np.empty(count)
    for i in range(count):
        bent = middle[i] - (middle[i - 1] if i > 0 else 0.0) - links.rest[i]
        turning = rate[i] - (rate[i - 1] if i > 0 else 0.0)
        torque[i] = curved[i] - links.stiffness[i] * bent - links.viscosity[i] * turning
    matrix, right = np.zeros((count, count)), np.empty(count)
    for i in range(count):
        force = torque[i] - (torque[i + 1] if i + 1 < count else 0.0) + push[i]
        force += links.first[i] * (
            links.gravity[1] * np.cos(middle[i]) - links.gravity[0] * np.sin(middle[i])
        )
        matrix[i, i] = links.second[i] + links.length[i] ** 2 * links.outboard[i]
        for j in range(count):
            if j == i:
                continue
            low, high = min(i, j), max(i, j)
            coupled = links.length[low] * links.first[high]
            turn = middle[i] - middle[j]
            force -= coupled * np.sin(turn) * rate[j] ** 2
            matrix[i, j] = coupled * np.cos(turn)
        right[i] = h * force
    for i in range(count):
        bent = middle[i] - (middle[i - 1] if i > 0 else 0.0) - links.rest[i]
        spring = links.stiffness[i] * (1.0 + 3.0 * links.hardening[i] * bent**2)
        held = 0.5 * h * links.viscosity[i] + 0.25 * h * h * spring
        matrix[i, i] += held
        if i > 0:
            matrix[i - 1, i - 1] += held
            matrix[i, i - 1] -= held
            matrix[i - 1, i] -= held
    right = np.linalg.solve(matrix, right)
    change = h * (rate + 0.5 * right)
    slide(state.stuck, state.heading, change, links, 1.0, state.stuck)
    state.heading[:] += change
    state.rate[:] += right


@njit(cache=True)
def advance(state, command, h, steps, push_at, push_force, links, air):
    """Advance by ``steps`` of h [s] under commands (M,) [Pa] and a push.

    Args:
        state: written in place.
        command: (M,) differential pressures [Pa].
        h: [s].
        steps: their number.
        push_at: (link, distance along it [m]) of the point that is pushed.
        push_force: (2,) [N].
        links: of the chain.
        air: of the chambers.
    """
    count = state.heading.shape[0]
    push = np.zeros(count)
    for _ in range(steps):
        breathe(state.pressure, command, h, air)
        if push_force[0] != 0.0 or push_force[1] != 0.0:
            for i in range(count):
                arm = 0.0
                if i < push_at[0]:
                    arm = links.length[i]
                elif i == push_at[0]:
                    arm = push_at[1]
                push[i] = arm * (
                    push_force[1] * np.cos(state.heading[i])
                    - push_force[0] * np.sin(state.heading[i])
                )
        move(state, h, push, links)
