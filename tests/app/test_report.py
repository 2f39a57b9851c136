"""report.html: whole in one file, with what the run said; without bokeh pictures stand in; a failure is a warning."""

import builtins
import html
import re

import matplotlib.figure
import pytest

from jaxnav.app import cli, report
from jaxnav.app.config import Config
from jaxnav.app.results import Card, CardRow, Outcome, Table


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    out = tmp_path_factory.mktemp("report") / "run"
    argv = ["filter", "--data", "urban_short", "--out", str(out), "--quiet", "--set", "filter.cov_stride=25"]
    assert cli.main([*argv, "--set", "filter.name=ekf15_gate"]) == 0
    return out


@pytest.mark.full
def test_one_file_without_a_network_says_what_the_run_said(run):
    page = (run / "report.html").read_text()
    assert len(page) < 5e6 and "report.html" in (run / "run.json").read_text()
    assert not re.search(r'^\s*<(script|link|img)[^>]*(src|href)\s*=\s*"?https?:', page, re.MULTILINE)
    for part in ("ekf15_gate on urban_short", "horizontal_m_in_outages", "filter.cov_stride", "jaxlib"):
        assert part in page
    for title in ("Track, m east and north", "Position error", "Innovations of velocity", "Gyro biases"):
        assert title in page


def test_without_bokeh_the_pictures_are_in_it(tmp_path, monkeypatch):
    real = builtins.__import__

    def missing(name, *args, **kwargs):
        if name.startswith("bokeh"):
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", missing)
    fig = matplotlib.figure.Figure()
    for name in ("errors", "nis", "trajectory"):
        fig.savefig(tmp_path / f"{name}.png")
    report.write(tmp_path, "filter", Config(), Outcome({}, "a <run> of 3 m", {}, layout=lambda: None))
    page = (tmp_path / "report.html").read_text()
    assert "data:image/png;base64," in page and "a &lt;run&gt; of 3 m" in page and "pip install bokeh" in page
    assert re.findall(r'alt="(\w+)"', page) == ["trajectory", "errors", "nis"]


def test_a_failed_figure_is_a_warning_and_parameters_are_a_table(tmp_path, capsys, monkeypatch):
    monkeypatch.undo()  # of conftest.py

    def fails():
        raise ValueError("no colour")

    rows = {"noise.gyro": {"value": 0.25, "low": 0.1, "high": 0.5, "datasheet": 0.2, "unit": "deg/sqrt(h)"}}
    report.write(tmp_path, "tune", Config(), Outcome({"parameters": rows}, "tuned", {"tune": 1.0}, layout=fails))
    assert "no picture of the run to zoom into: ValueError: no colour" in capsys.readouterr().err
    page = (tmp_path / "report.html").read_text()
    assert "<td>noise.gyro</td><td>0.25</td><td>0.1</td><td>0.5</td><td>0.2</td>" in page


def test_pictures_that_a_run_names_are_shown_with_the_interactive_figures(tmp_path):
    """The drift of a tune job; files of the run itself are what the interactive figures show."""
    figure = pytest.importorskip("bokeh.plotting").figure
    for name in ("outage_drift.png", "nis.png"):
        matplotlib.figure.Figure().savefig(tmp_path / name)
    report.write(tmp_path, "tune", Config(), Outcome({}, "tuned", {}, layout=figure, pictures=["outage_drift.png"]))
    page = (tmp_path / "report.html").read_text()
    assert re.findall(r'<img alt="([^"]*)"', page) == ["outage drift"] and "Bokeh" in page


def test_terms_of_the_answer_are_explained_where_they_come_first_and_at_the_end(tmp_path):
    row = CardRow("horizontal position on the Earth", "0.87 m", "94 % tested")
    why = "NIS/dof 1.00, 94 % of 80 hidden fixes <inside the stated 95 %>"
    table = Table("Drift over the test part", ("filter", "drift (m)"), [["datasheet", "3.1"], ["datasheet", "4"]])
    outcome = Outcome({}, "solved", {}, card=Card("consistent", "good", why, [row]), tables=[table])
    report.write(tmp_path, "solve", Config(), outcome)
    page = (tmp_path / "report.html").read_text()
    said = re.findall(r'<abbr tabindex="0" title="([^"]*)">([^<]*)</abbr>', page)
    answer = ["NIS/dof", "hidden fixes", "inside the stated 95 %"]
    terms = [*answer, "on the Earth", "stated (1 sd)", "datasheet", "test part"]
    assert [term for _, term in said] == [*answer, "stated (1 sd)", "on the Earth", "test part", "datasheet"]
    assert all(html.unescape(words) == report.TERMS[term] for words, term in said)
    assert re.findall("<dt>([^<]*)</dt>", page) == terms and "&lt;" in page and "<inside" not in page
    assert all(f"<dd>{html.escape(report.TERMS[term])}</dd>" in page for term in terms)


def test_a_run_without_an_answer_has_no_terms(run):
    page = (run / "report.html").read_text()
    assert "<abbr" not in page and "<h2>Terms</h2>" not in page
