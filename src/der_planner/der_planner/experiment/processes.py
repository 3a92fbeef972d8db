"""The nodes of a run: which ones with which parameters, started, watched and stopped."""

from __future__ import annotations

import contextlib
import ctypes
import dataclasses
import json
import os
import secrets
import shutil
import signal
import socket
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import yaml

from der_planner.bags.topics import installed_prefixes
from der_planner.experiment.console import OptionError
from der_planner.files import read_yaml
from der_planner.limb import Limb
from der_planner.planning import Obstacles
from pressure_driver.protocols import SettingError, order_of
from pressure_driver.settings import Settings

MOVABLE = {"driver": "pressure_driver", "tracker": "apriltag_tracker", "poses": "pose_tracker"}
"""Nodes that may run on another computer, by their keys in a hardware file."""
BOARD_PARAMETERS = {"pneudrive": {"sensor_range": 103_400.0}}
"""Of boards of the twin: with sensors of 15 psi, a step is 0.13 kPa and not 0.84."""
PAGE_TOKEN = secrets.token_urlsafe()
"""Opens the page of each run's graph, so that a window that is open stays let in."""
POSE_RATE = 60.0
"""Simulated motion capture tells poses so often [Hz], as many as the tracker of bodies takes."""
_PR_SET_PDEATHSIG = 1
_LIBC = ctypes.CDLL(None)


class NodeError(RuntimeError):
    """A node did not start or died; the message names it and shows its last words."""


class GraphError(RuntimeError):
    """The graph did not do what was asked; the message says what and why."""


# Which nodes -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Hardware:
    """What stands in place of the twin: parameters of the nodes that touch the hardware.

    Attributes:
        driver, tracker, planner, recorder: parameters by name for each node.
        twin: parameters of the twin, which then stands there instead of hardware.
        poses: parameters of the tracker of bodies, where motion capture stands in place of the
            camera; None: the camera.
        found: what scripts/check_rig.py has written; for people.
        remap: new names of topics by their old ones, for all nodes.
        hosts: computers on which somebody else starts a node, by its name; in the file, `host`
            stands in the place of the node's parameters.
        limb: the limb file, or None for the one on the command line.
    """

    driver: dict[str, Any] = field(default_factory=dict)
    tracker: dict[str, Any] = field(default_factory=dict)
    twin: dict[str, Any] | None = None
    poses: dict[str, Any] | None = None
    found: tuple[str, ...] = ()
    planner: dict[str, Any] = field(default_factory=dict)
    recorder: dict[str, Any] = field(default_factory=dict)
    remap: dict[str, str] = field(default_factory=dict)
    hosts: dict[str, str] = field(default_factory=dict)
    limb: str | None = None

    @property
    def limits(self) -> Settings:
        """The driver's segments and limits; whatever else stands there, its node judges."""
        names = {"segment_count", "pressure_limit", "slew_limit"} & self.driver.keys()
        return Settings(**{name: self.driver[name] for name in names})

    @property
    def place(self) -> str:
        """Where the valve board is: its port, or the computer of its driver."""
        return str(self.driver.get("port") or self.hosts.get("pressure_driver", ""))

    @classmethod
    def from_yaml(cls, path: Path) -> Hardware:
        """Read a hardware file (see scripts/hardware_example.yaml).

        Raises:
            OptionError: the file cannot be read, has unknown keys or no serial port.
        """
        content = read_yaml(path, "hardware file", OptionError)
        known = [item.name for item in dataclasses.fields(cls) if item.name != "hosts"]
        if not isinstance(content, dict):
            raise OptionError(f"hardware file {path}: a mapping is expected; keys: {known}")
        for key, value in content.items():
            if key not in known:
                raise OptionError(f"hardware file {path}: unknown key '{key}'; known: {known}")
            kind = {"found": list, "limb": str}.get(key, dict)
            if value is not None and not isinstance(value, kind):
                what = "parameters by name" if kind is dict else f"a {kind.__name__}"
                raise OptionError(f"hardware file {path}: {key} must be {what}, got {value!r}")
        hardware = cls(**{key: value for key, value in content.items() if value is not None})
        hardware.hosts.update(_hosts(hardware, path))
        try:
            _ = hardware.limits
        except SettingError as error:
            raise OptionError(f"hardware file {path}: driver: {error}") from error
        named = {**hardware.tracker, **(hardware.poses or {}), **hardware.planner}
        for key, file in named.items():
            if key.endswith(("_map", "_file")) and file and not Path(file).exists():
                raise OptionError(
                    f"hardware file {path}: no file '{file}' ({key}), from the folder {Path.cwd()}"
                )
        port = str(hardware.driver.get("port", ""))
        elsewhere = "pressure_driver" in hardware.hosts or port.startswith("tcp://")
        if hardware.twin is None and not elsewhere and not (port and Path(port).exists()):
            raise OptionError(
                f"hardware file {path}: no serial device '{port}' (driver.port); is the valve "
                "board plugged in? `ls /dev/serial/by-id` shows what is there"
            )
        return hardware


def _hosts(hardware: Hardware, path: Path) -> dict[str, str]:
    """Return the nodes that are marked with `host`, and take the mark from their parameters.

    Raises:
        OptionError: parameters stand beside the mark, which nobody would hand over.
    """
    hosts = {}
    for key, node in MOVABLE.items():
        parameters = getattr(hardware, key) or {}
        if "host" not in parameters:
            continue
        hosts[node] = str(parameters.pop("host"))
        if parameters:
            raise OptionError(
                f"hardware file {path}: {key} is started on {hosts[node]}: give its parameters "
                f"({', '.join(parameters)}) there, and leave them out here"
            )
    return hosts


@dataclass(frozen=True)
class NodeSpec:
    """What is needed to start one node."""

    package: str
    executable: str
    parameters: dict[str, Any] = field(default_factory=dict)
    host: str = ""
    """Computer on which somebody else starts it; empty: it is started here."""


@dataclass(frozen=True)
class GraphSetup:
    """What a graph consists of.

    Attributes:
        bag: folder that the recorder makes.
        metadata: stored in the bag.
        seed: of the twin.
        run: of the same twin: its rest angles wander in each in a way of their own.
        limb: whose gravity and masses the twin gets; None: no loads.
        hardware: in place of the twin.
        board: protocol of the twin's board.
        planner: parameters of the planner; None for a graph without one.
        record_images: whether the bag holds the raw images, too.
        page: port of the operator's page; None for a graph without one.
        poses: simulated motion capture in place of the twin's camera.
        obstacles: in the twin's way.
    """

    bag: Path
    metadata: dict[str, Any]
    seed: int = 0
    run: int = 0
    limb: Limb | None = None
    hardware: Hardware | None = None
    board: str = "ezloop"
    planner: dict[str, Any] | None = None
    record_images: bool = False
    page: int | None = None
    poses: bool = False
    obstacles: Obstacles | None = None

    @property
    def rig(self) -> Hardware:
        """What is known of the hardware, or of the twin in its place."""
        return self.hardware or Hardware(twin={})

    @property
    def protocol(self) -> str:
        """Language of the twin's board."""
        return str(self.rig.driver.get("protocol", self.board))

    def nodes(self, port: str) -> list[NodeSpec]:
        """Return the nodes in the order in which they start; they stop in the reverse one.

        Args:
            port: where the emulated board is.
        """
        rig = self.rig
        language = {"protocol": self.protocol, **BOARD_PARAMETERS.get(self.protocol, {})}
        board = {"port_link": port, "seed": self.seed, **language}
        twin = {"seed": self.seed, "run": self.run, **_twin_loads(self.limb)}
        driver = {"port": port, **(language if rig.twin is not None else {}), **rig.driver}
        wiring, valves = driver.get("wiring"), 2 * driver.get("segment_count", 2)
        wired = {"wiring": order_of(wiring, valves)} if wiring else {}
        recorder = {
            "output": str(self.bag),
            "metadata": json.dumps(self.metadata | wired),
            "record_images": self.record_images,
            **rig.recorder,
        }
        poses = rig.poses
        specs = [
            NodeSpec("pressure_driver", "pressure_driver", driver),
            NodeSpec("der_planner", "recorder", recorder),
        ]
        if rig.twin is not None:
            specs.insert(0, NodeSpec("pressure_driver", "board_emulator", board))
            twin |= rig.twin
            if hoses := rig.twin.get("wiring"):
                board["wiring"] = ",".join(str(abs(chamber)) for chamber in hoses)
            if self.obstacles is not None:
                twin["pegs"] = self.obstacles.circles.ravel().tolist()
            camera = NodeSpec("apriltag_tracker", "synthetic_camera", {"seed": self.seed})
            if self.poses or poses is not None:
                form = {"form": "pose_array"}
                twin["rate"] = POSE_RATE
                poses = {**form, **(poses or {})}
                camera = NodeSpec(
                    "apriltag_tracker", "synthetic_poses", {"seed": self.seed, **form}
                )
            specs += [NodeSpec("der_planner", "limb_twin", twin), camera]
        if poses is not None:
            specs.append(NodeSpec("apriltag_tracker", "pose_tracker", dict(poses)))
        else:
            specs.append(NodeSpec("apriltag_tracker", "apriltag_tracker", dict(rig.tracker)))
        planner = {**(self.planner or {}), **rig.planner}
        if self.planner is not None:
            specs.append(NodeSpec("der_planner", "planner", planner))
        if self.page is not None:
            # The page draws with the planner's limb on the tracker's tags.
            shared = (
                "limb_file", "mounting", "payload", "payload_at", "path_speed", "path_acceleration",
            )  # fmt: skip
            page = {name: planner[name] for name in shared if name in planner}
            page |= {name: value for name, value in rig.tracker.items() if name == "tag_map"}
            page |= {"port": self.page, "token": PAGE_TOKEN}
            specs.append(NodeSpec("der_planner", "page", page))
        return [replace(spec, host=rig.hosts.get(spec.executable, "")) for spec in specs]


def _twin_loads(limb: Limb | None) -> dict[str, Any]:
    """Return the parameters by which the twin's node is mounted and loaded as a limb."""
    if limb is None:
        return {}
    parameters: dict[str, Any] = {"gravity": list(limb.gravity)}
    if limb.masses:
        parameters["masses"] = [item.mass for item in limb.masses]
        parameters["masses_at"] = [item.arc_length for item in limb.masses]
    return parameters


def board_line(board: str, folder: str) -> str:
    """Return where the twin's board is: a terminal in the network, others on a serial port."""
    if board != "festo":
        return str(Path(folder) / "board")
    with socket.create_server(("127.0.0.1", 0)) as free:
        return f"tcp://127.0.0.1:{free.getsockname()[1]}"


# Processes ---------------------------------------------------------------------------------------


def find_executable(package: str, executable: str) -> Path:
    """Return the file that ``ros2 run PACKAGE EXECUTABLE`` would start.

    Raises:
        NodeError: no prefix of AMENT_PREFIX_PATH has it.
    """
    folders = (str(prefix / "lib" / package) for prefix in installed_prefixes())
    found = shutil.which(executable, path=os.pathsep.join(folders))
    if found is None:
        raise NodeError(
            f"no executable '{executable}' in package '{package}': build the workspace with "
            "python3 scripts/workspace.py setup"
        )
    return Path(found)


def _die_with_parent() -> None:
    # An orchestrator that is killed must not leave a limb under pressure: the nodes then get the
    # signal on which the driver vents.
    _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


class NodeProcess:
    """One node in its own process group, its output in a log file.

    Args:
        package, executable: as for ``ros2 run``.
        parameters: values by name; written to a parameter file beside the log.
        remap: new names of topics by their old ones.
        folder: where the log and the parameter file go.
        environment: of the process; the caller's if None.
        name: of the log file; the executable's if empty.
    """

    def __init__(
        self,
        package: str,
        executable: str,
        parameters: Mapping[str, Any],
        folder: Path,
        remap: Mapping[str, str] | None = None,
        environment: Mapping[str, str] | None = None,
        name: str = "",
    ) -> None:
        self.name = name or executable
        self.executable = executable
        self.log = folder / f"{self.name}.log"
        folder.mkdir(parents=True, exist_ok=True)
        parameter_file = folder / f"{self.name}.yaml"
        parameter_file.write_text(
            yaml.safe_dump({"/**": {"ros__parameters": dict(parameters)}}, sort_keys=True)
        )
        command = [str(find_executable(package, executable)), "--ros-args"]
        if parameters:
            command += ["--params-file", str(parameter_file)]
        for old, new in (remap or {}).items():
            command += ["-r", f"{old}:={new}"]
        with self.log.open("wb") as output:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                preexec_fn=_die_with_parent,  # noqa: PLW1509 - it allocates nothing
                env=environment,
            )

    @property
    def pid(self) -> int:
        """Process id, also of the process group."""
        return self._process.pid

    @property
    def exit_code(self) -> int | None:
        """Exit code, or None while the process runs."""
        return self._process.poll()

    @property
    def alive(self) -> bool:
        """Whether the process runs."""
        return self.exit_code is None

    def last_words(self) -> str:
        """Return the end of the log, preferring what the node called an error."""
        text = self.log.read_text(errors="replace").splitlines()
        complaints = [line for line in text if line.startswith("error:")]
        return "\n".join((complaints or text)[-6:])

    def failure(self, what: str) -> NodeError:
        """Return the error that says what became of the process, e.g. that it "died"."""
        return NodeError(
            f"node '{self.name}' {what} ({_describe(self.exit_code)}). Its last words:\n"
            f"{self.last_words()}\nThe whole log: {self.log}"
        )

    def check(self) -> None:
        """Raise if the process has ended.

        Raises:
            NodeError: with the exit code, the last words and the log's path.
        """
        if not self.alive:
            raise self.failure("died")

    def signal(self, number: int) -> None:
        """Send a signal to the process group if it still runs."""
        if self.alive:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self.pid, number)

    def stop(self, timeout: float = 20.0) -> int:
        """End it with SIGTERM, after ``timeout`` seconds with SIGKILL; return the exit code."""
        self.signal(signal.SIGTERM)
        try:
            self._process.wait(timeout)
        except subprocess.TimeoutExpired:
            self.signal(signal.SIGKILL)
            self._process.wait()
        return int(self._process.returncode)


def _describe(code: int | None) -> str:
    if code is not None and code < 0:
        return f"killed by {signal.Signals(-code).name}"
    return f"exit code {code}"
