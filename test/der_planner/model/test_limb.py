"""A limb: its declaration, from which checks, file, page and fit follow; masses and mountings."""

import dataclasses
import math
from dataclasses import replace

import numpy as np
import pytest
import yaml

from der_planner.identification.terms import COLUMN, TERMS, to_limb, values_of
from der_planner.limb import (
    DEFAULT_LIMB_FILE,
    GRAVITY,
    CalibratedRange,
    Limb,
    LimbError,
    Load,
    Pneumatics,
    PointMass,
    Segment,
    declarations,
    gravity_of,
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


@pytest.mark.parametrize(
    ("part", "name", "value", "reason"),
    [
        ("segments", "bending_stiffness", 17_500.0, r"segments\[0\] would bend by .* N·m²"),
        ("segments", "moment_gain", 9.1e-3, r"segments\[0\] would bend by .* N·m/Pa"),
        ("segments", "mass_per_length", 1066.0, "weighs .* give mass_per_length in kg/m"),
        ("masses", "mass", 8.0, "weighs 8.* masses in kg"),
        ("pneumatics", "pressure_limit", 24.0, "would bend by .* pressure_limit in Pa"),
        ("pneumatics", "slew_limit", 9.0, "more than 60 s: give .* slew_limit in Pa/s"),
        ("pneumatics", "time_constant", 150.0, "more than 60 s: give time_constant"),
    ],
)
def test_a_limb_file_in_other_units_is_refused(tmp_path, part, name, value, reason):
    content = yaml.safe_load(DEFAULT_LIMB_FILE.read_text(encoding="utf-8"))
    content["masses"] = [{"arc_length": 0.2, "mass": 0.008}]
    (content[part] if part == "pneumatics" else content[part][0])[name] = value
    (tmp_path / "limb.yaml").write_text(yaml.safe_dump(content))
    with pytest.raises(LimbError, match=reason):
        Limb.from_yaml(tmp_path / "limb.yaml")


def test_free_text_and_long_text_of_a_limb_file_are_read_back(tmp_path):
    text = {"length": "tape measure", "note": "two lines\nlength: 3\ngravity: none"}
    limb = replace(LIMB, provenance=text, name="gravity: 3\nsegments:\n- length: 1")
    limb = replace(limb, calibrated=CalibratedRange(free_level=" ".join(52 * ["-1.234e-05"])))
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


def test_masses_survive_the_limb_file(tmp_path):
    limb = LIMB.carrying(0.02).carrying(0.005, at=0.1, name="tag: 3").mounted("hanging")
    limb.to_yaml(tmp_path / "limb.yaml")
    assert Limb.from_yaml(tmp_path / "limb.yaml") == limb
    assert limb.masses == (PointMass(LIMB.length, 0.02, "payload"), PointMass(0.1, 0.005, "tag: 3"))
    text = (tmp_path / "limb.yaml").read_text()
    assert "- arc_length: 0.244  # [m] distance from the clamp along the limb\n" in text


def test_a_file_without_masses_has_none_and_a_wrong_one_is_named(tmp_path):
    LIMB.to_yaml(tmp_path / "limb.yaml")
    text = (tmp_path / "limb.yaml").read_text()
    for wrong, said in (
        ("masses: 3", "masses must be a list of mappings"),
        ("masses: [3]", r"masses\[0\] must be a mapping"),
        ("masses: [{arc_length: 0.1}]", r"masses\[0\]\.mass is missing"),
        ("masses: [{arc_length: 0.1, mass: a}]", r"masses\[0\]\.mass must be a number"),
        ("masses: [{arc_length: 0.1, mass: -1}]", r"masses\[0\]\.mass must be at least 0 kg"),
        ("masses: [{arc_length: 0.5, mass: 1}]", r"masses\[0\]\.arc_length must be at most"),
        ("masses: [{place: 0.5, mass: 1}]", r"unknown key masses\[0\]\.place"),
    ):
        (tmp_path / "limb.yaml").write_text(text.replace("masses: []", wrong))
        with pytest.raises(LimbError, match=said):
            Limb.from_yaml(tmp_path / "limb.yaml")
    (tmp_path / "limb.yaml").write_text(text.replace("masses: []\n", ""))
    assert Limb.from_yaml(tmp_path / "limb.yaml") == LIMB


def test_a_payload_of_nothing_changes_nothing_and_one_off_the_limb_is_refused():
    assert LIMB.carrying(0.0) is LIMB
    with pytest.raises(LimbError, match=r"at most the limb's length of 0\.244 m, got 0\.3"):
        LIMB.carrying(0.01, at=0.3)
    with pytest.raises(LimbError, match=r"at least 0 kg, got -0\.01"):
        LIMB.carrying(-0.01)
    with pytest.raises(LimbError, match="payload of 20 kg is 77 times the limb's mass: give kg"):
        LIMB.carrying(20.0)
    base = dataclasses.replace(LIMB, base_length=0.02)
    assert base.carrying(0.01).masses[0].arc_length == pytest.approx(0.264)
    assert LIMB.carrying(0.01, 0.1).carrying(0.02).payload == (0.02, 0.0)
    assert base.carrying(0.01).for_model("pcc").masses == base.carrying(0.01).masses


def test_a_load_mounts_the_limb_and_hangs_its_payload_on():
    assert LIMB.loaded(Load()) is LIMB
    assert LIMB.loaded(Load(0.02)).payload == (0.02, 0.0)
    hung = LIMB.loaded(Load(0.02, 0.1, "hanging"))
    assert hung == LIMB.mounted("hanging").carrying(0.02, 0.1)
    assert hung.payload == (0.02, 0.1)
    # A calibrated limb is a little shorter or longer than the place that was measured.
    assert LIMB.loaded(Load(0.02, 0.2465)) == LIMB.carrying(0.02)
    with pytest.raises(LimbError, match="mounting 'upside' is unknown"):
        LIMB.loaded(Load(mounting="upside"))


def test_a_limb_weighs_what_the_scale_says_with_its_fittings():
    limb = dataclasses.replace(LIMB, base_length=0.01, connector_length=0.004)
    limb = limb.carrying(0.045, 0.13, name="valve")
    heavier = limb.weighing(0.36)
    assert heavier.mass == pytest.approx(0.36)
    assert heavier.masses == limb.masses
    factors = [
        new.mass_per_length / old.mass_per_length
        for new, old in zip(heavier.segments, limb.segments, strict=True)
    ]
    assert factors == pytest.approx([(0.36 - 0.045) / (limb.mass - 0.045)] * 2)
    for wrong in (0.045, 0.0, -0.3, float("nan"), float("inf")):
        with pytest.raises(LimbError, match=r"more than the 0\.045 kg of its masses"):
            limb.weighing(wrong)
    with pytest.raises(LimbError, match="times what the limb file says"):
        limb.weighing(360.0)


def test_what_sits_on_the_stiff_base_weighs_and_moves_nothing():
    limb = dataclasses.replace(LIMB, base_length=0.01, connector_length=0.005)
    limb = limb.carrying(0.03, at=0.008, name="valve").carrying(0.02)
    density = LIMB.segments[0].mass_per_length
    assert limb.mass == pytest.approx(density * (0.244 + 0.01 + 0.005) + 0.05)
    assert limb.moving_mass == pytest.approx(density * (0.244 + 0.005) + 0.02)


def test_a_limb_remembers_the_mounting_that_its_numbers_were_found_in(tmp_path):
    assert LIMB.mounted("hanging").other_mounting == ""  # nothing was found or declared before
    found = dataclasses.replace(LIMB, calibrated=CalibratedRange((1e4, 1e4), (0.5, 0.5)))
    tilted = found.mounted("10")
    assert "the mounting is 10°, the limb was calibrated as horizontal" in tilted.other_mounting
    assert "as horizontal" in tilted.mounted("hanging").other_mounting
    assert tilted.mounted("180").other_mounting == found.mounted("0").other_mounting == ""
    tilted.to_yaml(tmp_path / "limb.yaml")
    assert Limb.from_yaml(tmp_path / "limb.yaml") == tilted
    declared = LIMB.mounted("hanging").mounted("sideways")
    assert "the limb was declared as hanging: sideways is taken" in declared.other_mounting
    with pytest.raises(LimbError, match=r"calibrated\.gravity must be three numbers"):
        dataclasses.replace(LIMB, calibrated=CalibratedRange(gravity=(1.0, 2.0)))


def test_mountings_say_where_gravity_points():
    assert gravity_of("hanging") == (GRAVITY, 0.0, 0.0)
    assert gravity_of("standing") == (-GRAVITY, 0.0, 0.0)
    assert gravity_of("horizontal") == (0.0, 0.0, 0.0)
    np.testing.assert_allclose(gravity_of("90"), gravity_of("sideways"), atol=1e-15)
    np.testing.assert_allclose(gravity_of("10"), (0.0, -1.7035, 0.0), atol=1e-4)
    np.testing.assert_allclose(gravity_of("-10.0"), (0.0, 1.7035, 0.0), atol=1e-4)
    assert LIMB.mounted("0").gravity == pytest.approx((0.0, 0.0, 0.0))
    assert not any(gravity_of("180.0"))
    for wrong in ("upside down", "nan", "inf", "", "370", "-181"):
        with pytest.raises(LimbError, match="choose horizontal, hanging, standing, sideways"):
            gravity_of(wrong)
