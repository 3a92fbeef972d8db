"""Masses and mountings of a limb: its file, its checks, the meaning of a tilt."""

import dataclasses

import numpy as np
import pytest

from der_planner.limb import GRAVITY, CalibratedRange, Limb, LimbError, Load, PointMass, gravity_of

LIMB = Limb.default()


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
    assert LIMB.loaded(Load(0.02, 0.1, "hanging")) == LIMB.mounted("hanging").carrying(0.02, 0.1)
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
