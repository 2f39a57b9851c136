"""Tables as people write them."""

import numpy as np
import pytest

from jaxnav.io.sheet import numbers, open_sheet


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
