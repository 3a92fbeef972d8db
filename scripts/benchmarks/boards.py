"""Each valve board in simulated time: tip error of the main job, and what it does without a host.

Bytes go to and fro between the driver's end and the emulated board, at 20 Hz and never late: what
boards differ by is then their own.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from der_planner.identification import calibrate_twin
from der_planner.limb import Limb
from der_planner.planning import Motion, Plan, plan
from der_planner.twin.offline import OfflineTwin
from pressure_driver.emulator import board as emulated
from pressure_driver.emulator.board import EmulatedBoard, Faults
from pressure_driver.emulator.firmware import BOARDS
from pressure_driver.emulator.pneumatics import BoardPneumatics
from pressure_driver.following import chamber_gauge
from pressure_driver.protocols import NAMES, host_protocol
from pressure_driver.settings import EmulatorSettings, Settings

PERIOD = 0.05
"""[s] between two commands, which stay valid for five of them."""
SEEDS = (0, 1, 2, 3)
"""Of twins."""
START = 8.0
"""[s] in which every board runs."""
COMMAND = (9_000.0, -5_000.0)
"""[Pa] when the host dies."""
VENTED = 500.0
"""[Pa] gauge."""
PATIENCE = 60.0
"""[s] after which a board counts as one that keeps its pressures."""


def connected(
    name: str, air: BoardPneumatics, seed: int, fault: str = "", **parameters: float
) -> tuple[EmulatedBoard, Callable[[Sequence[float]], None]]:
    """Return a board, and what tells it a command (M,) [Pa], starting it where it does not run."""
    host = host_protocol(Settings(protocol=name, **parameters))
    firmware = BOARDS[name]()
    firmware.configure(EmulatorSettings(protocol=name, **parameters))
    board = EmulatedBoard(firmware, air, seed)
    board.set_faults(Faults.parse([fault], 4))
    ticks = 0

    def tell(command: Sequence[float]) -> None:
        nonlocal ticks
        data = host.start() if host.unsettled or not ticks else b""
        data += host.setpoint(chamber_gauge(command))
        while data:
            _, answer = board.receive(data)
            host.decode(answer)
            data = host.follow_up()
        ticks += 1

    host.clock = lambda: ticks * PERIOD
    return board, tell


def seconds_until_vented(name: str, fault: str = "") -> float:
    """Return how long a board keeps pressure without a host [s]; infinity for one that does."""
    air = BoardPneumatics(2, 0)
    board, tell = connected(name, air, 0, fault)
    while np.max(air.pressure) - air.atmosphere < 0.95 * max(COMMAND):
        tell(COMMAND)
        board.step(PERIOD)
    waited = 0.0
    while np.max(air.pressure) - air.atmosphere > VENTED:
        if waited > PATIENCE:
            return math.inf
        board.step(PERIOD)
        waited += PERIOD
    return waited


def tip_error(planned: Plan, name: str, seed: int, **parameters: float) -> float:
    """Return the mean tip error [m] of a plan that is played through a board."""
    plant = OfflineTwin(seed)
    board, tell = connected(name, plant.pneumatics, seed, **parameters)
    plant.pneumatics = board  # it steps its air, and its own time with it
    rest = np.zeros((round(START / PERIOD), 2))
    errors = []
    for command in (*rest, *planned.differential_pressure):
        errors.append(plant.tip)
        tell(command)
        plant.rest(PERIOD)
    gaps = np.array(errors[len(rest) :]) - planned.tip_reference
    return float(np.linalg.norm(gaps, axis=1).mean())


def main() -> None:
    """Print the table."""
    plans = {}
    for seed in SEEDS:
        limb, _ = calibrate_twin(seed, Limb.default())
        plans[seed] = plan(limb, Motion.named("same_direction"), model="der", method="optimal")
    cases = [(name, name, emulated.SENSOR_OFFSET, {}) for name in NAMES]
    cases.append(("ezloop, exact sensors", "ezloop", 0.0, {}))
    cases.append(("pneudrive of 15 psi", "pneudrive", 0.0, {"sensor_range": 103_400.0}))
    for label, name, emulated.SENSOR_OFFSET, parameters in cases:
        found = [100.0 * tip_error(plans[seed], name, seed, **parameters) for seed in SEEDS]
        told = ", ".join(f"{error:.3f}" for error in found)
        print(f"{label:22s} tip errors {told}, mean {np.mean(found):.3f} cm", flush=True)
    for name, fault in [*((name, "") for name in NAMES), ("festo", "hold")]:
        seconds = seconds_until_vented(name, fault)
        told = f"vented after {seconds:.1f} s" if math.isfinite(seconds) else "keeps its pressures"
        print(f"{name:10s} {fault:6s} {told}")


if __name__ == "__main__":
    main()
