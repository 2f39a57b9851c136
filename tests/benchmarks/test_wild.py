"""Recipes are run and not only read: from a file to a solution without a setting about the start."""

import math

import pytest

from benchmarks import check, start, wild

QUICK = ("comma2k19", "kitti", "ekf2_replay")


def run(name: str) -> dict:
    found = wild.one(name, wild.sources()[name], None)
    assert found["ran"], found.get("why")
    assert found["lines"] <= 10 and found["start"]["how"].startswith("starts at t = ")
    assert all(math.isfinite(value) for value in found["nis"].values())
    return found


@pytest.mark.parametrize("name", QUICK)
def test_a_recipe_gives_a_solution(data_dir, name):
    found = run(name)
    if name == "comma2k19":  # its columns are what the recipe says
        assert found["drift_rms_m"] < 2.0
    if name == "kitti":  # a hole of 1.9 s at its begin is coasted through
        assert any("coasted through" in note for note in found["notes"])
    if name == "ekf2_replay":  # it hovers: the heading is one of twelve
        assert "12 hypotheses" in found["start"]["how"]


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(set(wild.sources()) - set(QUICK)))
def test_every_recording_gives_a_solution(data_dir, name):
    run(name)


@pytest.mark.slow
def test_starts_are_as_sure_as_they_say():
    found = start.study(64, seed=1)
    assert 0.7 < found["nees"] < 1.4 and found["inside"] > 0.9


@pytest.mark.slow
def test_damages_are_named(data_dir, tmp_path, capsys):
    check.main(["--quick"])
    named = int(capsys.readouterr().out.split(" of 25 damages named")[0].split()[-1])
    assert named >= 21
