"""Tables as people write them."""

import numpy as np
import pytest

from jaxnav.io import sheet as sheet_module
from jaxnav.io.sheet import dated, form_of, numbers, open_sheet, times
from jaxnav.io.units import factor
from jaxnav.maths.units import DEG
from jaxnav.types import DataError


@pytest.mark.parametrize(
    ("text", "a", "b", "words"),
    [
        ("a,b\n1.5,2\n-3.5,4\n", [1.5, -3.5], [2, 4], None),
        ("a;b\n1,5;2\n-3,5;4\n", [1.5, -3.5], [2, 4], "decimal points"),
        ("a\tb\n1,5e-1\t2\n-3,5\t4\n", [0.15, -3.5], [2, 4], "decimal points"),
        ("sep=;\na;b\n1.5;2\n-3.5;4\n", [1.5, -3.5], [2, 4], None),
        (
            "made by X\nrate,30,Hz\na,b\n1.5,2\n-3.5,4\n0.5,6\n1,1\n",
            [1.5, -3.5, 0.5, 1],
            [2, 4, 6, 1],
            "2 lines before",
        ),
        ("a,b\n[m],[s]\n1.5,2\n-3.5,4\n", [1.5, -3.5], [2, 4], "line of units"),
        ("a b\n1.5 2\n-3.5 4\n", [1.5, -3.5], [2, 4], None),
    ],
)
def test_tables_as_people_write_them(tmp_path, text, a, b, words):
    (tmp_path / "x.csv").write_text(text)
    sheet = open_sheet(tmp_path / "x.csv")
    np.testing.assert_array_equal(numbers(sheet, "a"), a)
    np.testing.assert_array_equal(numbers(sheet, "b"), b)
    assert words is None and not sheet.notes or words is not None and any(words in str(note) for note in sheet.notes)


ROWS = [f"{1_600_000_000_123_456_789 + 5_000_000 * k},{k * 0.005!r},{k % 7},-{k}e-3" for k in range(400)]
HEAD = "stamp,t,count,a"


@pytest.mark.parametrize(
    ("head", "change", "quick"),
    [
        (HEAD, None, True),
        (f"# made by X\n{HEAD}", None, True),
        (f"made by X\nrate,30,Hz\n{HEAD}\nns,s,,m", None, True),
        ("sep=;\n" + HEAD.replace(",", ";"), lambda rows: [r.replace(",", ";") for r in rows], True),
        (HEAD.replace(",", " "), lambda rows: [r.replace(",", "   ") for r in rows], True),
        (HEAD, lambda rows: [*rows[:250], "", *rows[250:]], False),
        (HEAD, lambda rows: [*rows[:250], "# a comment", *rows[250:]], False),
        (HEAD, lambda rows: [*rows[:250], "1,2,3", *rows[250:]], False),
        (HEAD, lambda rows: [*rows[:250], "1600000001000000000,,3,4", *rows[250:]], False),
        (HEAD, lambda rows: [*rows[:250], "1600000001000000000.5,1,3,4", *rows[250:]], False),
        (HEAD, lambda rows: [*rows[:-1], rows[-1] + ",text"], False),
        ("a,a,b,c", None, False),
    ],
)
def test_a_long_table_of_numbers_is_read_quickly_to_the_same_columns(tmp_path, monkeypatch, head, change, quick):
    monkeypatch.setattr(sheet_module, "MIN_QUICK", 300)
    file = tmp_path / "long.csv"
    file.write_text("\n".join([head, *(change(ROWS) if change else ROWS)]) + "\n")
    found = sheet_module._numbers_only(file.read_bytes(), str(file), None, None)
    assert (found is not None) == quick
    sheet = open_sheet(file)
    monkeypatch.setattr(sheet_module, "MIN_QUICK", 10**9)
    slow = open_sheet(file)
    assert (sheet.notes, sheet.twice, list(sheet.columns)) == (slow.notes, slow.twice, list(slow.columns))
    np.testing.assert_array_equal(sheet.lines, slow.lines)
    for name in slow.columns if not slow.twice else ():
        np.testing.assert_array_equal(numbers(sheet, name), numbers(slow, name))
    if quick:
        assert [sheet.columns[str(k)].dtype.kind for k in (1, 2, 3, 4)] == ["i", "f", "i", "f"]
        np.testing.assert_array_equal(times(sheet, "stamp", "ns", 10**9), times(slow, "stamp", "ns", 10**9))


@pytest.mark.parametrize(
    ("text", "names", "rows"),
    [
        ('t,x,note\n1,2,"a, b"\n3,4,""\n', ["t", "x", "note"], 2),  # a comma in quotes
        ('t;x;note\n1;2;"a; b"\n3;4;c\n', ["t", "x", "note"], 2),
        ('t,date,"Gyro [rad/s]",1,2\n0.1,2024-06-01,5,6,7\n0.2,2024-06-01,5,6,7\n',
         ["t", "date", "Gyro [rad/s]", "1", "2"], 2),
        ("0.1,RTK,fix,N/A,x\n0.2,RTK,fix,5,x\n0.3,RTK,fix,5,x\n", [], 3),  # data, the first with a mark for none
        ("0.1,RTK,fix,,x\n0.2,RTK,fix,5,x\n0.3,RTK,fix,5,x\n", [], 3),
    ],
)  # fmt: skip
def test_cells_and_headers(tmp_path, text, names, rows):
    (tmp_path / "a.csv").write_text(text)
    sheet = open_sheet(tmp_path / "a.csv")
    assert len(sheet.columns["2"]) == rows
    assert [key for key in sheet.columns if not key.isdigit()] == [name for name in names if not name.isdigit()]
    if names and names[-1] == "note":
        assert sheet.columns["note"][0] in ("a, b", "a; b")
    if "Gyro [rad/s]" in names:
        assert numbers(sheet, "1").tolist() == [6.0, 6.0] and numbers(sheet, "2").tolist() == [7.0, 7.0]


@pytest.mark.parametrize(
    ("unit", "cells", "expected"),
    [
        ("%d.%m.%Y %H:%M:%S.%f", ["01.06.2024 10:00:00.25", "01.06.2024 10:00:01"], [1717236000.25, 1717236001.0]),
        ("%m/%d/%Y %H:%M:%S", ["06/01/2024 10:00:00", "x"], [1717236000.0, np.nan]),
        ("%d-%b-%Y %H:%M:%S", ["01-Jun-2024 10:00:00", "01-Jun-2024 10:00:02"], [1717236000.0, 1717236002.0]),
        ("%H%M%S.%f", ["000102.5", "235959"], [62.5, 86399.0]),
        ("%Y-%m-%d %H:%M:%S%z", ["2024-06-01 12:00:00+0200", ""], [1717236000.0, np.nan]),
    ],
)  # fmt: skip
def test_dates_by_a_pattern(tmp_path, unit, cells, expected):
    (tmp_path / "a.csv").write_text("\n".join(["time,x", *(f"{cell},1" for cell in cells)]) + "\n")
    np.testing.assert_allclose(times(open_sheet(tmp_path / "a.csv"), "time", unit), expected, atol=1e-6)


def test_hours_minutes_seconds_of_a_long_file(tmp_path):
    """Whose zeros at the front a parser of numbers would lose."""
    stamps = [f"{k // 3600:02d}{k // 60 % 60:02d}{k % 60:02d}" for k in range(5000)]
    (tmp_path / "a.csv").write_text("\n".join(["time,x", *(f"{cell},1" for cell in stamps)]) + "\n")
    np.testing.assert_array_equal(times(open_sheet(tmp_path / "a.csv"), "time", "%H%M%S"), np.arange(5000.0))


@pytest.mark.parametrize(("said", "number"), [
    ("2 deg/s", 2.0), ("1/2 deg/s", 0.5), ("2.5e-1 deg/s", 0.25), ("1/131.072 deg/s", 2**-17 * 1e3),
])  # fmt: skip
def test_a_unit_takes_a_multiple(said, number):
    assert factor({"unit": said}, "unit", "rate", "x") == pytest.approx(number * DEG, rel=1e-15)


@pytest.mark.parametrize("said", ["0 deg/s", "2deg/s", "1/0 deg/s", "-2 deg/s", "2", "2 deg"])
def test_multiples_that_are_none(said):
    with pytest.raises(DataError, match="or a multiple such as '1/131 deg/s'"):
        factor({"unit": said}, "unit", "rate", "x")


@pytest.mark.parametrize(("unit", "tick"), [("1/25600 s", 1 / 25600), ("39.0625 us", 1 / 25600), ("10 ms", 0.01)])
def test_ticks_of_any_length(tmp_path, unit, tick):
    (tmp_path / "a.csv").write_text("t,x\n25600,1\n51200,1\n")
    np.testing.assert_allclose(times(open_sheet(tmp_path / "a.csv"), "t", unit), np.array([25600, 51200]) * tick)
    with pytest.raises(DataError, match="time_unit: expected one of"):
        times(open_sheet(tmp_path / "a.csv"), "t", "0 s")


JSON = '{"t": 0.5, "imu": {"gyro": [1.5, 2]}, "mode": "RTK"}', '{"t": 1.5, "imu": {"gyro": [null, 4]}, "mode": "fix"}'


@pytest.mark.parametrize("text", ["\n".join(JSON) + "\n", f"[{','.join(JSON)}]", f'{{"rows": [{",".join(JSON)}]}}'])
def test_objects_of_json(tmp_path, text):
    """Lines, an array, or an array in an object; nested ones by dotted path."""
    (tmp_path / "a.json").write_text(text)
    sheet = open_sheet(tmp_path / "a.json")
    np.testing.assert_array_equal(numbers(sheet, "imu.gyro.0"), [1.5, np.nan])
    np.testing.assert_array_equal(numbers(sheet, "imu.gyro.1"), [2, 4])
    assert sheet.columns["mode"].tolist() == ["RTK", "fix"]


def test_lines_that_are_no_json(tmp_path):
    lines = [JSON[0]] * 50
    (tmp_path / "a.json").write_text("\n".join([*lines, JSON[0][:9]]))
    sheet = open_sheet(tmp_path / "a.json")
    assert len(sheet.columns["t"]) == 50 and "1 lines that are no JSON left out, first line 51" in str(sheet.notes[0])
    (tmp_path / "a.json").write_text("\n".join([*lines, "x", "y", "z", "w"]))
    with pytest.raises(DataError, match="a.json: line 51: expected a JSON object"):
        open_sheet(tmp_path / "a.json")
    (tmp_path / "a.json").write_text("[1, 2]")
    with pytest.raises(DataError, match="expected JSON objects"):
        open_sheet(tmp_path / "a.json")


def test_marks_inside_of_quotes_are_not_counted(tmp_path):
    """A semicolon in every note of a table with commas."""
    (tmp_path / "a.csv").write_text("t,x,note\n" + "".join(f'{k},2,"a; {k}"\n' for k in range(80)))
    sheet = open_sheet(tmp_path / "a.csv")
    assert len(sheet.columns["note"]) == 80 and sheet.columns["note"][7] == "a; 7"


@pytest.mark.parametrize("first", ["[Sensor data]", "{made by X}", "[" * 5000])
def test_a_text_that_begins_with_a_bracket_is_a_table(tmp_path, first):
    (tmp_path / "a.csv").write_text(first + "\nt,x\n" + "".join(f"{k},2\n" for k in range(60)))
    assert len(open_sheet(tmp_path / "a.csv").columns["x"]) == 60


def test_texts_of_times_have_one_form_or_none():
    """Day and month of 06/01/2024 10:00:00 may be either."""
    for texts, form in (
        (["10:00:00.5", "9:59:59"], "%H:%M:%S.%f"), (["01.06.2024 10:00:00.123456789"], "%d.%m.%Y %H:%M:%S.%f"),
        (["11:59:59.5 PM"], "%I:%M:%S.%f %p"), (["06/01/2024 11:59:59 AM"], "%m/%d/%Y %I:%M:%S.%f %p"),
        (["2024-06-01 10:00:00", "2024-06-01T10:00:01.5Z"], "iso"), (["06/01/2024 10:00:00"], ""),
        (["10:00:00", "25:00:00"], ""), ([], ""),
    ):  # fmt: skip
        assert form_of(texts) == form
    assert dated("00:00:01.2345678", "%H:%M:%S.%f") == pytest.approx(1.234567)
