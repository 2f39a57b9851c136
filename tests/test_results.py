"""What a job leaves: a folder that is whole or not there, and text that others can read."""

import json
from pathlib import Path

import numpy as np

from jaxnav.jobs.results import cell, staged, table, to_json


def test_the_current_folder_can_be_the_output(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with staged(Path(".")) as folder:
        (folder / "run.json").write_text("{}")
    assert Path("run.json").exists()


def test_staged_never_deletes_outside(tmp_path):
    (tmp_path / "precious").write_text("x")
    out = tmp_path / "out"
    out.mkdir()
    (out / "run.json").write_text(json.dumps({"files": ["../precious", "old.csv", "run.json", 3, ".."]}))
    (out / "old.csv").write_text("")
    with staged(out) as folder:
        (folder / "run.json").write_text("{}")
    assert (tmp_path / "precious").exists() and [p.name for p in out.iterdir()] == ["run.json"]


def test_json_is_strict_and_tables_align():
    assert (
        to_json({"a": float("nan"), "b": np.float64("inf"), "c": np.arange(2)})
        == '{"a": null, "b": "inf", "c": [0, 1]}'
    )
    assert cell(1234.5) == "1.23e+03" or cell(1234.5) == "1230"
    assert len({len(line) for line in table(["a", "b"], [["x", 1.0], ["long", 22.25]]).splitlines()[1:]}) == 1
