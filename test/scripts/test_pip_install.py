"""`pip install ./src/der_planner` gives the rod and the planner, without ROS, from few packages.

The package is built and installed by pip into a folder of its own, without network. A new virtual
environment sees that folder and, linked beside it, exactly the packages that the installed metadata
require (and theirs): what is not declared cannot be imported.
"""

import os
import shutil
import subprocess
import sys
import venv
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parent.parent.parent
NAME = "der_planner"

USE = """
import importlib.util, sys
import numpy as np
from der_planner.control import Feedback, Learner
from der_planner.limb import Limb
from der_planner.planning import Motion, plan
from der_planner.rod import Rod

limb = Limb.default()
rod = Rod.from_limb(limb)
state = rod.straight_state()
for _ in range(10):
    state = rod.step(state, [8e3, -5e3], 0.01)
assert 0.001 < np.abs(rod.tip(state)[1]) < 0.2, rod.tip(state)
motion = Motion.named("same_direction", amplitude=0.3, period=4.0, cycles=1)
for model, method in (("der", "optimal"), ("pcc", "paper")):
    made = plan(limb, motion, model=model, method=method)
    error = np.linalg.norm(made.tip_predicted - made.tip_reference, axis=1)
    assert made.differential_pressure.shape == (len(made.time), 2)
    assert error.mean() < 5e-3, (model, error.mean())
away = "rclpy elastica mcap rosbags matplotlib cv2 nicegui pressure_driver"
for name in away.split():
    assert importlib.util.find_spec(name) is None, name
print("planned from", sys.modules["der_planner"].__file__)
"""


def _declared(package: str, folder: Path) -> set[str]:
    """Return the names of the packages that an installed one needs, directly or through others."""
    first = next(iter(metadata.distributions(name=package, path=[str(folder)])))
    found: set[str] = set()
    open_ends = list(first.requires or ())
    while open_ends:
        wanted = Requirement(open_ends.pop())
        needed = wanted.marker is None or wanted.marker.evaluate({"extra": ""})
        if needed and wanted.name.lower() not in found:
            found.add(wanted.name.lower())
            open_ends += metadata.distribution(wanted.name).requires or ()
    return found


def _link(package: str, folder: Path) -> None:
    """Make the files of an installed package visible in a folder."""
    distribution = metadata.distribution(package)
    for top in {file.parts[0] for file in distribution.files or ()}:
        place = folder / top
        if top not in ("..", "__pycache__") and not place.exists():
            place.symlink_to(Path(str(distribution.locate_file(top))))


def _keep_compiled_kernels(installed: Path) -> None:
    """Copy numba's caches of the workspace: the sources are the same, to compile takes minutes."""
    source = ROOT / "src" / NAME / NAME
    for path in installed.rglob("*.py"):
        times = (source / path.relative_to(installed)).stat()
        os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))
    for cache in source.rglob("__pycache__"):
        if any(cache.glob("*.nbi")):
            shutil.copytree(cache, installed / cache.relative_to(source), dirs_exist_ok=True)


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder into which pip has installed the package, and nothing else."""
    folder = tmp_path_factory.mktemp("pip")
    skip = shutil.ignore_patterns("__pycache__", "*.egg-info")
    shutil.copytree(ROOT / "src" / NAME, folder / "source", ignore=skip)
    command = [
        sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--no-deps",
        "--no-build-isolation", "--no-compile", "--target", folder / "site", folder / "source",
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder / "site"


def test_the_installed_package_plans_and_steps_in_a_clean_environment(installed, tmp_path):
    needed = _declared(NAME, installed)
    for package in needed:
        _link(package, installed)
    _keep_compiled_kernels(installed / NAME)
    venv.create(tmp_path / "venv", with_pip=False)
    python = tmp_path / "venv" / "bin" / "python"
    clean = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    done = subprocess.run(
        [python, "-c", f"import sys\nsys.path.append({str(installed)!r})\n{USE}"],
        env=clean, cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert str(installed) in done.stdout


def test_the_required_packages_are_few_and_the_rest_are_extras(installed):
    found = next(iter(metadata.distributions(name=NAME, path=[str(installed)])))
    wanted = [Requirement(text) for text in found.requires or ()]
    plain = {each.name for each in wanted if each.marker is None}
    assert plain == {"numpy", "scipy", "numba", "PyYAML", "piqp", "threadpoolctl"}
    extras = set(found.metadata.get_all("Provides-Extra"))
    assert extras >= {"twin", "recording", "evaluation", "page", "studies"}
    for name in extras:
        assert any(each.marker and each.marker.evaluate({"extra": name}) for each in wanted), name
