"""The notebooks of the docs run from top to bottom."""

import json
from pathlib import Path

import pytest

NOTEBOOKS = sorted((Path(__file__).parents[1] / "docs" / "notebooks").glob("*.ipynb"))


def cells(path: Path) -> list[str]:
    found = json.loads(path.read_text())["cells"]
    assert all(not cell.get("outputs") for cell in found), "outputs are made, not kept"
    return ["".join(cell["source"]) for cell in found if cell["cell_type"] == "code"]


def test_there_are_four():
    assert [path.stem for path in NOTEBOOKS] == ["first_filter", "learn_noise", "tune_a_recording", "write_a_rule"]
    for path in NOTEBOOKS:
        for text in cells(path):
            compile(text, path.name, "exec")


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_it_runs(path, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    space: dict = {}
    for text in cells(path):
        exec(text, space)
    said = capsys.readouterr().out
    if path.stem == "write_a_rule":  # the rule that doubts outliers is nearer to the truth
        kalman, mine = (float(line.split("'median': ")[1].split(",")[0]) for line in said.splitlines())
        assert mine < kalman
    if path.stem == "learn_noise":
        assert space["ratio"] < 0.8
        assert "of 32 unseen runs" in said
    if path.stem == "tune_a_recording":
        assert "position.scale" in said and "observations" in said
