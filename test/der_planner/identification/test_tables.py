"""Tables of any lab: a map of columns, units, and pressures that are to be played."""

from dataclasses import replace

import numpy as np
import pytest

from der_planner.identification import CalibrationLog, ColumnMap, LogError, read_csv
from der_planner.identification.excitation import Excitation, read_excitation, write_excitation
from der_planner.identification.log import prepare
from der_planner.limb import Limb

COLUMNS = {
    "time": "t",
    "commanded": ("u",),
    "chambers": ("a", "b"),
    "angles": ("theta",),
    "pressure_unit": "hPa",
    "angle_unit": "deg",
    "angle_factor": 2.0,
    "rest_until": 0.25,
    "tags": ("px",),
}
ROWS = """t,u,a,b,theta,px
0.0,0,1002,1000,1.0,5.0
0.1,0,1002,1000,1.0,5.1
0.2,0,1002,1000,1.0,5.1
0.3,40,1022,1000,3.0,5.3
0.4,40,1042,1000,5.0,5.4
"""


@pytest.fixture
def table(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text(ROWS)
    return path


def test_units_zeros_factors_and_lost_tags(table):
    log = read_csv(table, ColumnMap(**COLUMNS))
    np.testing.assert_allclose(log.measured_differential[:, 0], [0, 0, 0, 2000, 4000])
    np.testing.assert_allclose(log.commanded_differential[:, 0], [0, 0, 0, 4000, 4000])
    expected = np.deg2rad([2.0, 2.0, np.nan, 6.0, 10.0])
    np.testing.assert_allclose(log.bend_angles[:, 0], expected)
    assert np.isnan(log.tip).all()


def test_stretches_are_left_out_and_gaps_are_bridged_up_to_a_length(table):
    log = read_csv(table, ColumnMap(**{**COLUMNS, "ignore": ((0.05, 0.15),)}))
    np.testing.assert_allclose(log.time, [0.0, 0.2, 0.3, 0.4])
    assert np.isfinite(log.resampled(0.05, 0.5).bend_angles).all()
    assert np.isnan(log.resampled(0.05, 0.15).bend_angles).any()


def test_wrong_maps_are_named(table):
    for change, match in (
        ({"angles": ("phi",)}, "no column 'phi'"),
        ({"chambers": ("a", "b", "u")}, "needs 1 differential pressures or 2 chambers"),
        ({"pressure_unit": "atm"}, "pressure_unit is 'atm'"),
    ):
        with pytest.raises(LogError, match=match):
            read_csv(table, ColumnMap(**{**COLUMNS, **change}))


def test_pressures_may_be_logged_as_differences(table):
    columns = ColumnMap(**{**COLUMNS, "chambers": ("u",), "rest_until": 0.0})
    log = read_csv(table, columns)
    np.testing.assert_allclose(log.measured_differential, log.commanded_differential)


@pytest.mark.parametrize(
    ("line", "named"),
    [
        ("chambers: a", "chambers is 'a', give a list"),
        ("angle_factor: two", "angle_factor is 'two', give a number"),
        ("ignore: [1, 2]", "ignore is .* pairs of times"),
        ("rest_until: soon", "rest_until is 'soon', give a time in s, or auto"),
        ("colour: red", "colour is unknown"),
    ],
)
def test_map_files_are_read_and_wrong_keys_and_values_are_named(tmp_path, line, named):
    path = tmp_path / "columns.yaml"
    given = {"time": "t", "commanded": "[u]", "chambers": "[a, b]", "angles": "[theta]"}
    path.write_text("".join(f"{key}: {value}\n" for key, value in given.items()))
    assert ColumnMap.from_yaml(path).chambers == ("a", "b")
    key, value = line.split(": ")
    path.write_text("".join(f"{k}: {v}\n" for k, v in {**given, key: value}.items()))
    with pytest.raises(LogError, match=named):
        ColumnMap.from_yaml(path)
    with pytest.raises(LogError, match="cannot read"):
        ColumnMap.from_yaml(tmp_path / "nothing.yaml")


@pytest.mark.parametrize(
    "written",
    [
        ROWS.replace("\n", "\r\n").encode(),
        b"\xef\xbb\xbf" + ROWS.encode(),
        ROWS.encode("utf-16"),
        ("# rig 3, Tuesday\n" + ROWS + "\n\n").encode(),
        ROWS.replace(",", ";").replace(".", ",").encode(),
        ROWS.replace(",", "\t").encode(),
        "\n".join(",".join(f'"{v}"' for v in row.split(",")) for row in ROWS.split()).encode(),
        "".join(f"{row},{'20' if n else 'T [°C]'}\n" for n, row in enumerate(ROWS.split())).encode(
            "cp1252"
        ),
        (ROWS + "0.5,40,10").encode(),
        ("# rig 3\n# " + ROWS).encode(),
        ROWS.replace(",", "   ").encode(),
        "".join(f"{row},{'on' if n else 'mode'}\n" for n, row in enumerate(ROWS.split())).encode(),
    ],
    ids=["crlf", "bom", "utf16", "comment", "semicolon", "tabs", "quotes", "cp1252", "cut-short",
         "savetxt", "blanks", "text"],
)  # fmt: skip
def test_tables_of_other_programs_are_read_alike(tmp_path, table, written):
    expected = read_csv(table, ColumnMap(**COLUMNS))
    (tmp_path / "other.csv").write_bytes(written)
    found = read_csv(tmp_path / "other.csv", ColumnMap(**COLUMNS))
    np.testing.assert_allclose(found.time, expected.time)
    np.testing.assert_allclose(found.measured_differential, expected.measured_differential)
    np.testing.assert_allclose(found.bend_angles, expected.bend_angles)


def test_rows_need_a_time_of_their_own(tmp_path, table):
    (tmp_path / "ms.csv").write_text(
        ROWS.replace("0.1,0,", ",0,").replace("0.3,40", "0.2,40").replace("0.4,40", "400,40")
    )
    log = read_csv(tmp_path / "ms.csv", ColumnMap(**{**COLUMNS, "time_unit": "ms"}))
    np.testing.assert_allclose(log.time, [0.0, 0.2e-3, 0.4])
    (tmp_path / "two.csv").write_text(ROWS + ROWS.split("\n", 1)[1])
    with pytest.raises(LogError, match=r"falls from 0\.4 s to 0 s: is it more than one run"):
        read_csv(tmp_path / "two.csv", ColumnMap(**COLUMNS))


@pytest.mark.parametrize(
    ("written", "said"),
    [
        ("t,u\n0,x\n1,2\n", r"could not convert string 'x' to float64 at row 0, column 2"),
        ("t,u\n0,1\n1,2,3\n", "the number of columns changed from 2 to 3 at row 2"),
        ("t,u\n0,1,2\n1,2,3\n", "have 3 columns, its header has 2"),
        ("t,u,u\n0,1,2\n1,2,3\n", "two columns 'u'"),
        ("t,u\n", "fewer than two rows"),
        ("PK\0\0 of a spreadsheet", "is no text: write it as CSV"),
    ],
)
def test_damaged_tables_are_refused(tmp_path, written, said):
    path = tmp_path / "bad.csv"
    path.write_text(written)
    with pytest.raises(LogError, match=said):
        read_csv(path, ColumnMap(**COLUMNS))


def lab_log(path, rest_from, rest_to):
    """A log that rests nearly, and only from one time to another; sensors read 2 hPa apart."""
    time = np.arange(0.0, 60.0, 0.1)
    resting = (time >= rest_from) & (time < rest_to)
    command = np.where(resting, 0.09, 50.0 + 40.0 * np.sin(time))
    drive = np.where(resting, 0.0, command)
    lines = [
        f"{t:.1f},{u:.3f},{1002 + d:.3f},1000" for t, u, d in zip(time, command, drive, strict=True)
    ]
    path.write_text("\n".join(["t,u,a,b", *lines]) + "\n")
    return path


@pytest.mark.parametrize("rest_until", [10.0, "auto", ""])
def test_each_log_finds_its_own_rest_even_if_it_is_not_exactly_zero(tmp_path, rest_until):
    """One map serves a log that rests first and one that rests last, at 0.09 hPa."""
    columns = ColumnMap(**{**COLUMNS, "angles": ("u",), "tags": (), "rest_until": rest_until})
    for name, begin, end in (("first", 0.0, 12.0), ("last", 45.0, 60.0)):
        log = read_csv(lab_log(tmp_path / f"{name}.csv", begin, end), columns)
        resting = (log.time > begin) & (log.time < end)
        np.testing.assert_allclose(log.measured_differential[resting], 0.0, atol=1e-6)
    never = lab_log(tmp_path / "never.csv", 70.0, 80.0)
    if not rest_until:  # nothing was asked for
        assert np.nanmean(read_csv(never, columns).measured_differential) > 2.0
        return
    with pytest.raises(LogError, match="no row at rest: its commands never come"):
        read_csv(never, columns)


def test_an_excitation_is_written_into_a_new_folder_and_read_back(tmp_path):
    pressure = np.array([[0.0, 1.5], [-2000.25, 7e3]])
    write_excitation(Excitation(pressure), tmp_path / "new" / "table.csv")
    read = read_excitation(tmp_path / "new" / "table.csv", 2)
    np.testing.assert_array_equal(read.differential_pressure, pressure)


def test_an_excitation_of_another_grid_or_limb_is_refused(tmp_path):
    path = tmp_path / "excitation.csv"
    for rows, said in (
        ("time_s,a,b\n0,0,0\n0.1,0,0\n", "must be 0, 0.05, 0.1"),
        ("time_s,a\n0,0\n0.05,0\n", "expected time_s and 2 pressures"),
    ):
        path.write_text(rows)
        with pytest.raises(LogError, match=said):
            read_excitation(path, 2)


LIMB = Limb.default()


def slow_log() -> CalibrationLog:
    """Return 30 s in which each segment bends slowly as its pressure says."""
    time = np.arange(0.0, 30.0, 0.05)
    pressure = np.stack([8e3 * np.sin(0.7 * time), 7e3 * np.sin(1.1 * time)], axis=1)
    bend = LIMB.static_gain * pressure
    tip = np.stack([0.24 - 0.02 * np.abs(bend).sum(axis=1), 0.1 * bend.sum(axis=1)], axis=1)
    return CalibrationLog(time, pressure.copy(), pressure, bend, tip)


DOORS = {
    "time in ms": (lambda log: {"time": 1e3 * log.time}, "a row every 50 s: give the time in sec"),
    "time in minutes": (lambda log: {"time": log.time / 3600.0}, "lasts 0.00832 s"),
    "degrees": (
        lambda log: {"bend_angles": np.degrees(log.bend_angles)},
        "give them in rad, or name angle_unit in columns.yaml",
    ),
    "hPa": (
        lambda log: {
            "measured_differential": 0.01 * log.measured_differential,
            "commanded_differential": 0.01 * log.commanded_differential,
        },
        r"name their unit in columns.yaml \(pressure_unit\)",
    ),
    "thousandths of Pa": (
        lambda log: {"measured_differential": 1e3 * log.measured_differential},
        "give them in Pa, or name pressure_unit in columns.yaml",
    ),
}


@pytest.mark.parametrize("door", DOORS)
def test_other_units_are_named(door):
    change, said = DOORS[door]
    log = slow_log()
    with pytest.raises(LogError, match=said):
        prepare(replace(log, **change(log)), LIMB, to_fit=False)


def test_milliseconds_of_a_fast_log_are_no_seconds():
    still = np.zeros((20_000, 2))
    log = CalibrationLog(np.arange(20e3), still, still, still, still)
    with pytest.raises(
        LogError, match=r"lasts 2e\+04 s, with a row every 1 s: give the time in sec"
    ):
        prepare(log, LIMB, to_fit=False)


@pytest.mark.parametrize("wrong", [lambda tip: tip[:, ::-1], lambda tip: tip * [1.0, -1.0]])
def test_tips_in_other_axes_than_the_limbs_are_refused(wrong):
    log = slow_log()
    prepare(log, LIMB)
    with pytest.raises(LogError, match="x points along the straight limb"):
        prepare(replace(log, tip=wrong(log.tip)), LIMB)


@pytest.mark.parametrize(("late", "said"), [(1.0, "1.00 s before"), (-1.0, "1.00 s after")])
def test_pressures_and_bends_of_two_clocks_are_said(late, said):
    log = slow_log()
    assert said in prepare(log.seen_earlier(-late), LIMB).warnings[-1]
    assert prepare(log.seen_earlier(-0.2 * late), LIMB).warnings == ()


def test_angles_that_stand_still_while_pressures_change_are_left_out_and_said():
    log = slow_log()
    whole, frozen = prepare(log, LIMB), log.time[200] - log.time
    lost = (frozen <= 0.0) & (frozen > -5.0)
    log.bend_angles[lost], log.tip[lost] = log.bend_angles[200], log.tip[200]
    prepared = prepare(log, LIMB)
    assert not whole.warnings
    assert f"{lost.sum() - 1} rows repeat the bend angles" in prepared.warnings[0]
    assert whole.usable.all()
    assert not prepared.usable[lost][5:-5].any()
    assert prepared.usable[~lost].all()


def test_single_impossible_numbers_are_left_out_and_said():
    log = slow_log()
    log.bend_angles[100, 0], log.measured_differential[200, 1] = 1e9, -1e9
    log.tip[300] = 1e9
    prepared = prepare(log, LIMB, to_fit=False)
    assert len(prepared.warnings) == 3
    assert "1 rows have tips that no such limb has" in prepared.warnings[2]
    assert np.abs(prepared.bend).max() < 1.0
    assert np.abs(prepared.pressure).max() < 1e4
