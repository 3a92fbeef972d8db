"""What several tests of the running graph share."""

from __future__ import annotations

from pathlib import Path

import pytest

from der_planner.limb import DEFAULT_LIMB_FILE

RIG = """
driver: {{port: {port}, protocol: ezloop}}
remap: {{camera/image_raw: /overhead/image, camera/camera_info: /overhead/info}}
limb: {limb}
"""
SEED = 3
"""Seed of the twin that stands in for a rig."""


@pytest.fixture
def rig(graph, tmp_path: Path) -> Path:
    """A hardware file, and the rig that it names.

    To the program under test, a board on another process's port and a camera under another name are
    hardware.
    """
    port = tmp_path / "board"
    graph.start("pressure_driver", "board_emulator", port_link=str(port), seed=SEED)
    graph.start("der_planner", "limb_twin", seed=SEED)
    overhead = {"camera/image_raw": "/overhead/image", "camera/camera_info": "/overhead/info"}
    graph.start("apriltag_tracker", "synthetic_camera", remap=overhead, seed=SEED)
    graph.client.wait_ready(["board_emulator", "limb_twin"])
    path = tmp_path / "rig.yaml"
    path.write_text(RIG.format(port=port, limb=DEFAULT_LIMB_FILE))
    return path
