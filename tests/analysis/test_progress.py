"""Progress where nobody watches: lines, rarely, and none of a short job."""

import pytest

from jaxnav.analysis import progress


def steps(capsys, monkeypatch, every: float, show: bool = True) -> str:
    monkeypatch.setattr(progress, "QUIET", every)
    bar = progress.bar(4, "step", show, 1)
    for _ in range(3):
        bar.set_postfix(loss="0.5", refresh=False)
        bar.update()
    bar.close()
    said = capsys.readouterr()
    assert said.out == ""
    return said.err


def test_lines_in_a_log(capsys, monkeypatch):
    said = steps(capsys, monkeypatch, 0.0).splitlines()
    assert said[-1].startswith("4/4 steps [") and "loss=0.5" in said[-1] and "\r" not in "".join(said)


@pytest.mark.parametrize("every, show", [(30.0, True), (0.0, False)])
def test_short_or_quiet_jobs_say_nothing(capsys, monkeypatch, every, show):
    assert steps(capsys, monkeypatch, every, show) == ""
