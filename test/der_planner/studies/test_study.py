"""What a study's file says, and what its table, keys and indices are."""

import numpy as np
import pytest

from der_planner.limb import Limb
from der_planner.studies.factors import StudyError
from der_planner.studies.report import sobol_indices
from der_planner.studies.study import SHIPPED, Draw, Spread, Study, rows
from der_planner.studies.tasks import with_errors

GOOD = {"task": "run", "factors": "{seed: [3, 4], period: [2, 3.5]}"}


def study(tmp_path, **parts) -> Study:
    path = tmp_path / "my.yaml"
    path.write_text("\n".join(f"{key}: {value}" for key, value in {**GOOD, **parts}.items()))
    return Study.read(path)


@pytest.mark.parametrize("path", sorted(SHIPPED.glob("*.yaml")), ids=lambda path: path.stem)
def test_shipped_studies(path):
    found = Study.read(path.stem)
    assert found.about
    assert found.plots
    assert len({row.key for row in found.rows}) == len(found.rows) >= 100


def test_a_key_depends_on_what_the_row_does_alone(tmp_path):
    """Not on its place, the study's name, what is kept, or how a number is written."""
    first = study(tmp_path)
    other = study(
        tmp_path, name="other", keep="[mean_error_m]", factors="{period: [3.5, 2, 9], seed: 3.0}"
    )
    mine = {row.key: dict(row.values) for row in first.rows}
    theirs = {row.key: dict(row.values) for row in other.rows}
    shared = set(mine) & set(theirs)
    assert {tuple(sorted(mine[key].items())) for key in shared} == {
        (("period", 2.0), ("seed", 3)),
        (("period", 3.5), ("seed", 3)),
    }
    assert all(mine[key] == theirs[key] for key in shared)
    limb = tmp_path / "limb.yaml"
    Limb.default().to_yaml(limb)
    assert {row.key for row in study(tmp_path, limb="limb.yaml").rows}.isdisjoint(mine)


def test_names_that_yaml_takes_for_something_else(tmp_path):
    """Off and no are not False, and a mounting may be a number of degrees."""
    factors = "{feedback: [off, on], payload_known: [no], mounting: [hanging, 30, -12.5]}"
    found = study(tmp_path, factors=factors)
    assert found.grid == {
        "feedback": ["off", "on"],
        "payload_known": ["no"],
        "mounting": ["hanging", "30", "-12.5"],
    }
    with pytest.raises(StudyError, match=r"mounting must be one of horizontal.*or degrees"):
        study(tmp_path, factors="{mounting: upside}")


@pytest.mark.parametrize(
    ("parts", "expected"),
    [
        ({"task": "fly"}, "task must be one of run, model, identification, got 'fly'"),
        ({"factors": "{sead: 1}"}, r"factors.sead is unknown .*known: seed"),
        ({"factors": "{period: 0.1}"}, "factors.period must be a number from 0.5 to 600, got 0.1"),
        ({"factors": "{motion: waltz}"}, "factors.motion must be one of asynchronous"),
        ({"factors": "{period: {low: 3, high: 2}}", "draw": "{count: 2}"}, "period.low must be"),
        ({"factors": "{period: {low: 2, high: 3}}"}, "draw.count is missing: period"),
        ({"factors": "{seed: {low: 2, high: 3}}", "draw": "{count: 2}"}, "only numbers are drawn"),
        ({"factors": "{period: {low: 2, high: 3}}", "draw": "{count: 3}"}, "power of two.*choose"),
        ({"keep": "[error_cm]"}, "keep: unknown column 'error_cm'; known: mean_error_m"),
        ({"plots": "[{kind: lines, x: period}]"}, r"plots\[0\].y is missing"),
        ({"plots": "[{kind: scatter, x: age, y: max_error_m}]"}, r"plots\[0\].x: no column 'age'"),
        ({"plots": "[{kind: indices, of: max_error_m}]"}, "indices need draw.method saltelli"),
        ({"limb": "nothing.yaml"}, "limb: cannot read limb file"),
        ({"colour": "red"}, "unknown key 'colour'; known: name, about, task"),
    ],
)
def test_mistakes_name_the_key(tmp_path, parts, expected):
    with pytest.raises(StudyError, match=f"(?s)my.yaml: .*{expected}"):
        study(tmp_path, **parts)


def test_missing_files_and_yaml_that_is_none(tmp_path):
    with pytest.raises(StudyError, match=r"no shipped study of that name: there are accuracy"):
        Study.read("acuracy")
    (tmp_path / "bad.yaml").write_text("factors: [")
    with pytest.raises(StudyError, match=r"bad\.yaml is not valid YAML"):
        Study.read(tmp_path / "bad.yaml")


@pytest.mark.parametrize("method", ["random", "sobol"])
def test_draws_fill_the_ranges_and_repeat(method):
    spreads = {
        "even": Spread(-1.0, 3.0),
        "log": Spread(0.1, 10.0, "log"),
        "normal": Spread(5.0, 2.0, "normal"),
    }
    draw = Draw(method, 256, seed=3)
    table = rows({"name": ["a", "b"]}, spreads, draw)
    assert table == rows({"name": ["a", "b"]}, spreads, draw)
    assert table != rows({"name": ["a", "b"]}, spreads, Draw(method, 256, seed=4))
    assert len(table) == 512
    assert [row["name"] for row in table] == ["a"] * 256 + ["b"] * 256
    values = {name: np.array([row[name] for row in table]) for name in spreads}
    assert values["even"].mean() == pytest.approx(1.0, abs=0.2)
    assert np.log10(values["log"]).mean() == pytest.approx(0.0, abs=0.1)
    assert values["normal"].mean() == pytest.approx(5.0, abs=0.3)
    assert values["normal"].std() == pytest.approx(2.0, abs=0.3)


def test_indices_of_a_function_whose_indices_are_known(tmp_path):
    """Ishigami's function, sin a + 7 sin² b + 0.1 c⁴ sin a on (−π, π)³ (Saltelli 2000)."""
    names = ("moment_gain", "length", "damping")
    factors = ", ".join(f"error.{name}: {{low: -0.5, high: 0.5}}" for name in names)
    found = study(
        tmp_path,
        task="model",
        factors=f"{{{factors}}}",
        draw="{method: saltelli, count: 1024}",
        keep="[mean_error_m]",
    )
    kept = {}
    for row in found.rows:
        a, b, c = (2 * np.pi * value for value in row.values.values())
        result = np.sin(a) + 7 * np.sin(b) ** 2 + 0.1 * c**4 * np.sin(a)
        kept[row.key] = {**row.values, "mean_error_m": result, "error": None}
    indices = {each.factor: each for each in sobol_indices(found, kept, "mean_error_m")}
    known = {"moment_gain": (0.314, 0.558), "length": (0.442, 0.442), "damping": (0.0, 0.244)}
    for name, (first, total) in known.items():
        index = indices[f"error.{name}"]
        assert (index.first, index.total) == pytest.approx((first, total), abs=0.03)
        assert index.total_range[0] < index.total < index.total_range[1]
    kept[found.rows[7].key]["mean_error_m"] = None
    assert sobol_indices(found, kept, "mean_error_m") == ()


def test_errors_of_parameters():
    limb = Limb.default()
    row = {"error.moment_gain[1]": 0.2, "error.length": -0.1, "error.time_constant": 0.5}
    changed = with_errors(limb, {**row, "period": 3.0})
    for index, factor in ((0, 1.0), (1, 1.2)):
        mine, its = limb.segments[index], changed.segments[index]
        assert its.moment_gain == pytest.approx(factor * mine.moment_gain)
        assert its.length == pytest.approx(0.9 * mine.length)
        assert its.damping == mine.damping
    assert changed.pneumatics.time_constant == pytest.approx(1.5 * limb.pneumatics.time_constant)
    assert with_errors(limb, {"period": 3.0}) == limb
