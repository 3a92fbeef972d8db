"""Checks, limb files, their comments, the page and the fit follow from one declaration."""

import dataclasses
import math
from dataclasses import replace

import numpy as np
import pytest
import yaml

from der_planner.identification.terms import COLUMN, TERMS, to_limb, values_of
from der_planner.limb import (
    DEFAULT_LIMB_FILE,
    CalibratedRange,
    Limb,
    LimbError,
    Pneumatics,
    Segment,
    declarations,
)

LIMB = Limb.default()
DECLARED = [
    pytest.param(kind, name, id=f"{kind.__name__}.{name}")
    for kind in (Segment, Pneumatics)
    for name in declarations(kind)
]


def changed(kind: type, **change: float) -> Limb:
    if kind is Pneumatics:
        return replace(LIMB, pneumatics=replace(LIMB.pneumatics, **change))
    return replace(LIMB, segments=(LIMB.segments[0], replace(LIMB.segments[1], **change)))


def test_the_default_limb_file_is_what_is_written(tmp_path):
    computed = replace(LIMB, connector_length=np.float64(LIMB.connector_length))
    for limb in (LIMB, replace(computed, gravity=tuple(np.array(LIMB.gravity)))):
        limb.to_yaml(tmp_path / "limb.yaml")
        assert (tmp_path / "limb.yaml").read_bytes() == DEFAULT_LIMB_FILE.read_bytes()


@pytest.mark.parametrize("kind", [Segment, Pneumatics, CalibratedRange])
def test_every_field_is_declared_with_unit_meaning_and_choice(kind):
    assert list(declarations(kind)) == [item.name for item in dataclasses.fields(kind)]
    for declared in declarations(kind).values():
        assert declared.unit
        assert declared.text
        assert declared.choose


@pytest.mark.parametrize(("kind", "name"), DECLARED)
def test_a_value_out_of_range_is_refused_by_name_range_and_value(kind, name):
    declared = declarations(kind)[name]
    wrong = [math.nan, math.inf]
    if math.isfinite(declared.low):
        wrong.append(
            np.nextafter(declared.low, -math.inf) if declared.low_allowed else declared.low
        )
    if math.isfinite(declared.high):
        wrong.append(
            np.nextafter(declared.high, math.inf) if declared.high_allowed else declared.high
        )
    for value in wrong:
        with pytest.raises(LimbError) as refused:
            changed(kind, **{name: float(value)})
        where = "pneumatics" if kind is Pneumatics else "segments[1]"
        assert str(refused.value) == f"{where}.{name} must be {declared.range}, got {float(value)}"
        assert declared.unit in (*str(refused.value).replace(",", "").split(), "-")


def test_a_parameter_that_another_needs_may_not_be_zero():
    with pytest.raises(LimbError, match=r"segments\[1\]\.creep_time must be above 0 s where"):
        changed(Segment, creep_stiffness=1e-3)


def test_free_text_of_a_limb_file_takes_no_comments(tmp_path):
    text = {"length": "tape measure", "note": "two lines\nlength: 3\ngravity: none"}
    limb = replace(LIMB, provenance=text, name="gravity: 3\nsegments:\n- length: 1")
    limb.to_yaml(tmp_path / "limb.yaml")
    assert Limb.from_yaml(tmp_path / "limb.yaml") == limb


def test_an_older_limb_file_with_retired_keys_is_read(tmp_path):
    content = yaml.safe_load(DEFAULT_LIMB_FILE.read_text(encoding="utf-8"))
    content["pneumatics"] |= {"fill_rate": 9000.0, "minimum_supply": 0.0}
    (tmp_path / "old.yaml").write_text(yaml.safe_dump(content))
    assert Limb.from_yaml(tmp_path / "old.yaml") == LIMB
    content["pneumatics"]["filling"] = 1.0
    (tmp_path / "old.yaml").write_text(yaml.safe_dump(content))
    with pytest.raises(LimbError, match=r"unknown key pneumatics\.filling"):
        Limb.from_yaml(tmp_path / "old.yaml")


def test_the_fit_has_an_unknown_for_each_declaration_and_finds_its_value_again():
    declared = [item.fit for item in declarations(Segment).values() if item.fit]
    assert sorted(term.name for term in TERMS) == sorted(term.name for term in declared)
    rng = np.random.default_rng(3)
    low, high = (np.array([getattr(term, end) for term in TERMS]) for end in ("low", "high"))
    values = rng.uniform(0.6 * low + 0.4 * high, high, (2, len(TERMS)))
    values[:, [COLUMN[term.name] for term in TERMS if term.relative]] = 0.0
    np.testing.assert_allclose(values_of(to_limb(LIMB, values)), values, rtol=1e-12)


def test_units_of_the_fit_are_those_of_its_quantities():
    """Closed forms on the default limb: what an unknown is in terms of the segment's numbers."""
    values = values_of(LIMB, starts=True)
    values[:, COLUMN["cubic"]] = 0.1
    values[:, COLUMN["friction_pressure"]] = 300.0
    values[:, COLUMN["creep_pressure"]] = 500.0
    values[:, COLUMN["log_stiffness"]] = 0.2
    old, new = LIMB.segments[0], to_limb(LIMB, values).segments[0]
    stiffness = old.bending_stiffness * math.exp(0.2)
    assert new.bending_stiffness == pytest.approx(stiffness)
    assert new.moment_gain == pytest.approx(old.moment_gain * math.exp(0.2))
    assert new.cubic_stiffness == pytest.approx(0.1 * stiffness * old.length**2)
    assert new.friction_moment == pytest.approx(300.0 * new.moment_gain)
    assert new.friction_curvature == pytest.approx(0.1 / old.length)
    assert new.creep_stiffness == pytest.approx(500.0 * new.moment_gain * old.length)
