"""Kernels come from the cache of an earlier process, and never from sources that have changed."""

import subprocess
import sys

import pytest

from der_planner.limb import Limb
from der_planner.rod import Rod
from der_planner.rod.compile import drop_stale_caches

COUNT = """
from der_planner.limb import Limb
from der_planner.rod import Rod
from der_planner.rod.planar import step_kernel as planar
from der_planner.rod.spatial import step_kernel as spatial
for plane in ("xy", None):
    Rod.from_limb(Limb.default(), plane=plane).warm_up()
kernels = (planar.simulate, planar.newton, spatial.simulate)
print(sum(sum(kernel.stats.cache_misses.values()) for kernel in kernels))
print(sum(sum(kernel.stats.cache_hits.values()) for kernel in kernels))
"""


@pytest.mark.slow
def test_a_second_process_compiles_nothing():
    for plane in ("xy", None):
        Rod.from_limb(Limb.default(), plane=plane).warm_up()
    result = subprocess.run(
        [sys.executable, "-c", COUNT], capture_output=True, text=True, check=True
    )
    misses, hits = map(int, result.stdout.split())
    assert misses == 0
    assert hits >= 3


def test_changed_sources_drop_the_cache(tmp_path):
    source = tmp_path / "some_kernel.py"
    cache = tmp_path / "__pycache__"
    cache.mkdir()
    index = cache / "some_kernel.function-3.py311.nbi"
    source.write_text("one")
    drop_stale_caches(tmp_path)
    index.touch()
    drop_stale_caches(tmp_path)
    assert index.exists()
    source.write_text("two")
    drop_stale_caches(tmp_path)
    assert not index.exists()
