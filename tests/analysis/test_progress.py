"""Progress where nobody watches: lines, rarely, and none of a short job; what compiles is said."""

import io
import time

import jax
import jax.numpy as jnp
import pytest

from jaxnav.analysis import progress


def steps(capsys, monkeypatch, every: float, show: bool = True) -> str:
    monkeypatch.setattr(progress, "LOG_INTERVAL_S", every)
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


def test_an_estimate_leaves_the_first_step_out(monkeypatch):
    """Twenty seconds of compiling and then one second a step: eight steps are eight seconds more."""
    now = [0.0]
    bar = progress.Bar(total=11, unit="step", file=io.StringIO(), smoothing=0)
    bar._time, bar.start_t, bar.last_print_t = lambda: now[0], 0.0, 0.0
    for seconds in (20.0, 1.0, 1.0):
        now[0] += seconds
        bar.update()
    about = bar.format_dict
    assert (about["n"], about["elapsed"]) == (3, 2.0)
    assert about["rate"] is None or about["rate"] == pytest.approx(1.0)
    assert "<00:08" in bar.format_meter(**about)
    bar.close()


def test_compiling_is_said_once_and_waiting_is_not(capsys, monkeypatch):
    monkeypatch.setattr(progress, "SILENT_COMPILING_S", 0.02)
    monkeypatch.setattr(progress, "POLL_INTERVAL_S", 0.01)
    with progress.compiling(True):
        time.sleep(0.1)
    assert capsys.readouterr().err == ""

    def large(x):
        for i in range(300):
            x = jnp.sin(x) @ jnp.cos(x + i)
        return x

    for show, times in ((True, 1), (False, 0)):
        with progress.compiling(show):
            jax.jit(lambda x: large(x))(jnp.eye(3))
        assert capsys.readouterr().err.count("compiling (first time") == times
