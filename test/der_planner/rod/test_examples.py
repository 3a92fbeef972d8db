"""The examples of the page on the rod alone beside known values, and compiled kernels."""

import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from der_planner.limb import Limb
from der_planner.model.bending import bend_angles
from der_planner.rod import Rod
from der_planner.rod.compile import drop_stale_caches

FOLDER = Path(__file__).resolve().parents[3] / "src" / "der_planner" / "examples"
PAGE = FOLDER.parents[2] / "docs" / "guide" / "rod_alone.md"


def example(name: str):
    spec = importlib.util.spec_from_file_location(f"example_{name}", FOLDER / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_cantilever_converges_to_the_elastica():
    cantilever = example("cantilever")
    exact = cantilever.elastica_tip()
    assert exact == pytest.approx(-66.38e-3, abs=1e-5)
    errors = [cantilever.rod_tip(nodes, "ghost") - exact for nodes in (21, 41, 81)]
    assert abs(errors[0]) < 0.005 * abs(exact)
    orders = np.log2(np.abs(errors[:-1]) / np.abs(errors[1:]))
    np.testing.assert_allclose(orders, 2.0, atol=0.2)
    first_order = [cantilever.rod_tip(nodes, "inside") - exact for nodes in (21, 41)]
    assert np.log2(first_order[0] / first_order[1]) == pytest.approx(1.0, abs=0.15)


@pytest.mark.slow
def test_the_frequencies_converge_to_the_beams():
    vibration = example("vibration")
    beam = vibration.beam_frequencies(3)
    # 1.8751, 4.6941 and 7.8548 are in every textbook
    roots = 1.8751 * np.sqrt(beam / beam[0])
    np.testing.assert_allclose(roots, [1.8751, 4.6941, 7.8548], rtol=1e-4)
    errors = []
    for nodes in (21, 41):
        found, damping = vibration.rod_frequencies(nodes, 3)
        errors.append(np.abs(found / beam - 1))
        np.testing.assert_allclose(damping, vibration.DAMPING / 2, rtol=1e-6)
    assert errors[0].max() < 0.025
    np.testing.assert_allclose(np.log2(errors[0] / errors[1]), 2.0, atol=0.3)


@pytest.mark.parametrize("nodes", [24, 48])
def test_a_twisted_ring_becomes_unstable_at_michells_twist(nodes):
    ring = example("twisted_ring")
    rod, state = ring.ring(nodes, ring.CRITICAL)
    force = rod.internal_force(state)[rod.free]
    np.testing.assert_allclose(force, 0.0, atol=1e-7)  # the plane ring stays an equilibrium
    assert np.exp(1j * bend_angles(rod, state.q)) == pytest.approx(1.0, abs=1e-9)
    assert ring.critical_twist(nodes) == pytest.approx(1.0, abs=8.0 / nodes**2)


def test_the_page_names_every_example():
    named = set(re.findall(r"examples/(\w+)\.py", PAGE.read_text()))
    assert named == {path.stem for path in FOLDER.glob("*.py")}


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
