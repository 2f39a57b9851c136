"""Tables as people write them."""

import numpy as np
import pytest

from jaxnav.io import sheet as sheet_module
from jaxnav.io.sheet import numbers, open_sheet, times


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
    assert words is None and not sheet.notes or words is not None and any(words in note for note in sheet.notes)


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
