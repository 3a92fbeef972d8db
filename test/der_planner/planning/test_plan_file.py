"""Plans as files: what is read back, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
import yaml
from limbs import with_segments

from der_planner.limb import Limb
from der_planner.planning import Motion, PlanningError, Start, plan
from der_planner.planning.plan_file import learned_plan, read_plan, write_plan


@pytest.fixture(scope="module")
def bent():
    """Return a plan of a limb that rests bent, which begins where another motion is left.

    One of its numbers was computed by numpy.
    """
    motion = Motion.named("asynchronous", amplitude=0.3, period=3.0, cycles=1)
    start = Start(np.array([0.1, 0.05]), np.zeros(2), np.zeros(2), np.array([500.0, 100.0]))
    limb = with_segments(Limb.default(), rest_curvature=np.float64(0.3))
    return plan(limb, motion, method="projected", start=start)


def test_a_plan_is_read_back_whole(bent, tmp_path):
    beyond = np.arange(2.0 * len(bent.time)).reshape(-1, 2)
    bent = replace(bent, chambers_beyond=beyond)
    write_plan(bent, tmp_path / "kept" / "a.yaml", about={"runs": 3})
    again = read_plan(tmp_path / "kept" / "a.yaml")
    arrays = ("time", "differential_pressure", "tip_reference", "tip_predicted", "chambers_beyond")
    for name in arrays:
        assert np.array_equal(getattr(again, name), getattr(bent, name))
    assert again.limb.to_mapping() == bent.limb.to_mapping()
    assert np.allclose(again.bend_angles, bent.bend_angles, atol=1e-9)
    assert np.array_equal(again.reference.start.bend_angles, bent.reference.start.bend_angles)
    assert np.array_equal(again.reference.rest, bent.reference.rest)
    for name in ("motion", "model", "method", "amplitude", "period", "cycles"):
        assert getattr(again, name) == getattr(bent, name)
    assert [path.name for path in (tmp_path / "kept").iterdir()] == ["a.yaml"]


def test_a_plan_of_another_limb_load_or_name_is_not_played(bent, tmp_path):
    write_plan(bent, tmp_path / "a.yaml")
    assert learned_plan(tmp_path, "a", replace(bent.limb, name="renamed")).motion == "asynchronous"
    with pytest.raises(PlanningError, match=r"another masses\[0\]"):
        learned_plan(tmp_path, "a", bent.limb.carrying(0.02))
    stronger = replace(bent.limb.segments[1], moment_gain=1e-5)
    swapped = replace(bent.limb, segments=(bent.limb.segments[0], stronger))
    with pytest.raises(PlanningError, match=r"another segments\[1\].moment_gain"):
        learned_plan(tmp_path, "a", swapped)
    with pytest.raises(PlanningError, match=r"no learned plan '\.\./a' .* only: a"):
        learned_plan(tmp_path, "../a", bent.limb)
    with pytest.raises(PlanningError, match="set the planner's learned_plans"):
        learned_plan("", "a", bent.limb)


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("limb", None, "expected a mapping"),
        ("schema_version", 7, "schema_version 1"),
        ("tip_predicted_m", [[0.0, 0.0]], "tip_predicted_m must be finite"),
        ("differential_pressure_pa", [[0.0, 1e9]], "beyond the limb's limits"),
        ("differential_pressure_pa", [[0.0, 2e4], [0.0, -2e4]], "beyond the limb's limits"),
    ],
)
def test_a_damaged_plan_is_refused_by_name(bent, tmp_path, key, value, said):
    path = tmp_path / "a.yaml"
    write_plan(bent, path)
    content = yaml.safe_load(path.read_text())
    if key == "differential_pressure_pa":
        value = (value * len(bent.time))[: len(bent.time)]
    content[key] = value
    path.write_text(yaml.safe_dump(content))
    with pytest.raises(PlanningError, match=said):
        read_plan(path)
    path.write_text("a: [")
    with pytest.raises(PlanningError, match=r"the plan .*a\.yaml is not valid YAML"):
        read_plan(path)
