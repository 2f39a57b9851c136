"""What a job leaves: a folder that is whole or not there, and text that others can read."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from jaxnav.analysis.tables import cell, table
from jaxnav.app import results
from jaxnav.app.results import staged
from jaxnav.io.json import to_json


def test_the_current_folder_can_be_the_output(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with staged(Path("."), "filter") as folder:
        (folder / "run.json").write_text("{}")
    assert Path("run.json").exists()


def test_staged_never_deletes_outside(tmp_path):
    (tmp_path / "precious").write_text("x")
    out = tmp_path / "out"
    out.mkdir()
    files = ["../precious", "old.csv", "run.json", 3, ".."]
    (out / "run.json").write_text(json.dumps({"verb": "filter", "files": files}))
    (out / "old.csv").write_text("")
    with staged(out, "filter") as folder:
        (folder / "run.json").write_text("{}")
    assert (tmp_path / "precious").exists() and [p.name for p in out.iterdir()] == ["run.json"]


def test_a_file_that_appears_during_the_run_is_kept(tmp_path):
    out = tmp_path / "out"
    with staged(out, "filter") as folder:
        (folder / "solution.csv").write_text("ours")
        (folder / "run.json").write_text("{}")
        out.mkdir()
        (out / "solution.csv").write_text("theirs")
    assert (out / "solution.csv").read_text() == "ours" and (out / "solution.csv.kept").read_text() == "theirs"


def test_json_is_strict_and_tables_align():
    assert (
        to_json({"a": float("nan"), "b": np.float64("inf"), "c": np.arange(2)})
        == '{"a": null, "b": "inf", "c": [0, 1]}'
    )
    assert cell(1234.5) == "1.23e+03" or cell(1234.5) == "1230"
    assert len({len(line) for line in table(["a", "b"], [["x", 1.0], ["long", 22.25]]).splitlines()[1:]}) == 1


@pytest.mark.parametrize("before", [False, True])
def test_killed_while_results_are_moved_it_can_be_run_again(tmp_path, monkeypatch, before):
    """A new folder is there as a whole or not at all; one that is written again says that it is not whole."""

    def run(text):
        with results.staged(tmp_path / "out", "filter") as folder:
            (folder / "a.csv").write_text(text)
            (folder / "b.csv").write_text(text)
            (folder / "run.json").write_text(json.dumps({"verb": "filter", "files": ["a.csv", "b.csv", "run.json"]}))

    class Killed(BaseException):
        """As by a signal that nothing hears."""

    def replace(a, b):
        if Path(a).name == "b.csv":
            raise Killed
        return real(a, b)

    if before:
        run("old")
    real = os.replace
    monkeypatch.setattr(os, "replace", replace)
    if before:
        with pytest.raises(Killed):
            run("new")
        about = json.loads((tmp_path / "out" / "run.json").read_text())
        assert about["stopped"] == "while it was written" and "b.csv" in about["files"]
    else:
        run("new")  # nothing to replace one by one
    monkeypatch.setattr(os, "replace", real)
    run("again")
    assert {p.name: p.read_text()[:5] for p in (tmp_path / "out").glob("*.csv")} == {"a.csv": "again", "b.csv": "again"}
    assert json.loads((tmp_path / "out" / "run.json").read_text())["files"] == ["a.csv", "b.csv", "run.json"]
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="only Linux tells the dead from the living")
def test_a_killed_process_that_nobody_waited_for_is_dead(tmp_path):
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    left = tmp_path / f".out.{child.pid}.tmp"
    left.mkdir()
    with results.staged(tmp_path / "out", "mc"):
        assert left.exists()  # it is at work
    child.kill()
    deadline = time.monotonic() + 10
    while results._alive(child.pid) and time.monotonic() < deadline:
        time.sleep(0.01)
    with results.staged(tmp_path / "out", "mc"):
        assert not left.exists()
    child.wait()
