"""Camera and tracker on another computer: two network namespaces, and a clock that is off."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from domain import own_domain

from der_planner.experiment.processes import find_executable
from der_planner.limb import DEFAULT_LIMB_FILE
from der_planner.results import evaluate_run, load_run

ROOT = Path(__file__).resolve().parent.parent.parent
SEED = 3
RIG = """
driver: {{port: {port}, protocol: ezloop}}
tracker: {{host: camera-pc}}
remap: {{camera/image_raw: /overhead/image, camera/camera_info: /overhead/info}}
limb: {limb}
"""
CLOCK = """
#define _GNU_SOURCE
#include <dlfcn.h>
#include <stdlib.h>
#include <time.h>

/* The wall clock: 30 ms ahead when the process starts, and 50 ppm fast. */
int clock_gettime(clockid_t which, struct timespec *time) {
  static int (*real)(clockid_t, struct timespec *);
  static long long start;
  if (!real) real = (int (*)(clockid_t, struct timespec *))dlsym(RTLD_NEXT, "clock_gettime");
  int failed = real(which, time);
  if (failed || which != CLOCK_REALTIME) return failed;
  long long now = time->tv_sec * 1000000000LL + time->tv_nsec;
  if (!start) start = now;
  now += 30000000 + (now - start) / 20000;
  time->tv_sec = now / 1000000000LL;
  time->tv_nsec = now % 1000000000LL;
  return 0;
}
"""
# Shared memory would pass between the namespaces, as it does not between computers.
ALONE = 'mount --bind "$0" /dev/shm && exec "$@"'
pytestmark = pytest.mark.graph


def ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True)


class Computers:
    """Two network namespaces with a cable between them, and the processes in each."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.names = [f"limb{os.getpid()}{side}" for side in "ab"]
        self.running: list[subprocess.Popen[bytes]] = []

    def connect(self) -> None:
        one, other = self.names
        for name in self.names:
            ip("netns", "add", name)
        ip("link", "add", one, "netns", one, "type", "veth", "peer", "name", other, "netns", other)
        for place, name in enumerate(self.names):
            ip("-n", name, "link", "set", "lo", "up")
            ip("-n", name, "addr", "add", f"10.77.0.{place + 1}/24", "dev", name)
            ip("-n", name, "link", "set", name, "up")
            ip("-n", name, "route", "add", "224.0.0.0/4", "dev", name)

    def command(self, place: int, *words: str | Path) -> list[str]:
        """Return a command that runs on one of the computers."""
        memory = self.folder / f"memory_{place}"
        memory.mkdir(exist_ok=True)
        inside = ("ip", "netns", "exec", self.names[place], "sh", "-c", ALONE, memory)
        return [*map(str, (*inside, *words))]

    @property
    def environment(self) -> dict[str, str]:
        domain = {"ROS_DOMAIN_ID": str(own_domain(__file__))}
        return {**os.environ, **domain, "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}

    def start(
        self, place: int, package: str, node: str, *words: str, env: dict[str, str] | None = None
    ) -> None:
        """Start a node on one of the computers."""
        command = self.command(place, find_executable(package, node), "--ros-args", *words)
        with (self.folder / f"{node}.log").open("wb") as log:
            self.running.append(
                subprocess.Popen(
                    command,
                    env={**self.environment, **(env or {})},
                    stdout=log,
                    stderr=subprocess.STDOUT,
                )
            )

    def experiment(self, rig: Path, out: Path, *words: str) -> subprocess.CompletedProcess[str]:
        script = ROOT / "scripts" / "run_experiment.py"
        played = ("--models", "der", "--method", "paper", "--period", "3", "--cycles", "1")
        given = (sys.executable, script, "--hardware", rig, "--out", out, "--no-report")
        return subprocess.run(
            self.command(0, *given, *played, *words),
            env=self.environment,
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )

    def close(self) -> None:
        for process in self.running:
            process.send_signal(signal.SIGTERM)
        for process in self.running:
            process.wait(20)
        for name in self.names:
            subprocess.run(["ip", "netns", "del", name], check=False, capture_output=True)


@pytest.fixture
def computers(tmp_path: Path) -> Iterator[Computers]:
    made = Computers(tmp_path)
    if shutil.which("ip") is None:
        pytest.skip("needs the command ip (iproute2)")
    try:
        made.connect()
    except subprocess.CalledProcessError as error:
        made.close()
        pytest.skip(f"no network namespaces can be made here: {error.stderr.decode().strip()}")
    yield made
    made.close()


def test_a_clock_that_is_off_on_the_other_computer_forbids_feedback_and_nothing_else(
    computers: Computers, tmp_path: Path
):
    source, shim = tmp_path / "clock.c", tmp_path / "clock.so"
    source.write_text(CLOCK)
    compiler = ("c++", "-x", "c", "-shared", "-fPIC", source, "-o", shim, "-ldl")
    subprocess.run(compiler, check=True)
    port, rig = tmp_path / "board", tmp_path / "rig.yaml"
    rig.write_text(RIG.format(port=port, limb=DEFAULT_LIMB_FILE))
    seed = ("-p", f"seed:={SEED}")
    computers.start(0, "pressure_driver", "board_emulator", "-p", f"port_link:={port}", *seed)
    computers.start(0, "der_planner", "limb_twin", *seed)
    seen = [
        word
        for end in ("image_raw:=/overhead/image", "camera_info:=/overhead/info")
        for word in ("-r", f"camera/{end}")
    ]
    computers.start(1, "apriltag_tracker", "synthetic_camera", *seed, *seen)
    off = {"LD_PRELOAD": str(shim)}
    computers.start(1, "apriltag_tracker", "apriltag_tracker", *seen, env=off)

    run = computers.experiment(rig, tmp_path / "out", "--feedback")
    assert run.returncode == 1
    assert "waiting for apriltag_tracker on camera-pc" in run.stderr
    said = re.search(r"warning: apriltag_tracker: .* computer is (\S+) ms ahead of", run.stderr)
    assert float(said[1]) == pytest.approx(30.0, abs=10.0)
    assert "not armed: feedback needs clocks that agree within 10 ms" in run.stderr
    assert "chrony" in run.stderr
    played = evaluate_run(load_run(tmp_path / "out/bags/same_direction_der_paper_trial1"))
    assert played.valid_fraction > 0.9
    offset, uncertainty = re.search(
        r"/limb/apriltag_tracker \+(\S+) ± (\S+) ms", played.extra["clocks"]
    ).groups()
    assert float(offset) == pytest.approx(33.0, abs=3.0 + float(uncertainty))
