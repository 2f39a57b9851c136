"""Finished runs once more, one by one or side by side."""

import csv
import json
import shutil

import numpy as np
import pytest

from jaxnav.app import cli
from jaxnav.app.jobs import compare


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A run, and the same 30 m further east and turned by 2 deg, at other times, by another seed."""
    folder = tmp_path_factory.mktemp("runs")
    argv = ["filter", "--data", "urban_short", "--quiet", "--set", "filter.cov_stride=25", "--set", "out.figures=none"]
    assert cli.main([*argv, "--out", str(folder / "a")]) == 0
    shutil.copytree(folder / "a", folder / "b")
    with open(folder / "a" / "solution.csv", newline="") as lines:
        rows = list(csv.DictReader(lines))
    for row in rows:
        row["lon_deg"] = float(row["lon_deg"]) + np.degrees(30.0 / (6388838.0 * np.cos(np.radians(48.2))))
        row["heading_deg"] = (float(row["heading_deg"]) + 2.0 + 180.0) % 360.0 - 180.0
    with open(folder / "b" / "solution.csv", "w", newline="") as lines:
        out = csv.DictWriter(lines, list(rows[0]))
        out.writeheader()
        out.writerows(rows[::2])
    about = json.loads((folder / "b" / "run.json").read_text())
    about["config"]["seed"], about["metrics"]["nis_per_dof"] = 1, 2 * about["metrics"]["nis_per_dof"]
    (folder / "b" / "run.json").write_text(json.dumps(about))
    return folder


@pytest.mark.full
def test_runs_side_by_side_show_what_differs_and_how_far_they_are_apart(runs, tmp_path, capsys):
    assert cli.main(["compare", str(runs / "a"), str(runs / "b"), "--out", str(tmp_path / "c")]) == 0
    said = capsys.readouterr().out
    found = json.loads((tmp_path / "c" / "run.json").read_text())["metrics"]
    assert found["settings"] == {"seed": ["0.0", "1.0"]} and list(found["figures"]) == ["nis_per_dof"]
    assert "2.00" in said and "b from a: horizontally 30" in said
    assert (tmp_path / "c" / "compare.png").stat().st_size > 10_000
    difference = compare.difference_from(*(compare.load(runs / name) for name in "ab"))
    np.testing.assert_allclose(difference["horizontal_m"][::2], 30.0, atol=0.05)
    np.testing.assert_allclose(difference["height_m"][::2], 0.0, atol=1e-6)
    np.testing.assert_allclose(difference["heading_deg"][::2], 2.0, atol=1e-6)


def test_a_finished_run_says_again_what_it_said(runs, capsys):
    assert cli.main(["compare", str(runs / "a")]) == 0
    said = capsys.readouterr().out
    assert "ekf15 on urban_short, from t = " in said and "seed 0" in said and "solution.csv" in said


def test_no_run_or_runs_of_two_verbs_are_refused(runs, tmp_path, capsys):
    (tmp_path / "run.json").write_text("{}")
    for folders, words in (([tmp_path, runs / "a"], "holds no run of jaxnav"),):
        assert cli.main(["compare", *map(str, folders), "--out", str(tmp_path / "out")]) == 3
        assert words in capsys.readouterr().err
    assert cli.main(["compare", str(tmp_path / "absent")]) == 3
    assert cli.main(["compare", str(runs / "a"), str(runs / "b"), "--out", str(runs / "a")]) == 3
