"""`jaxnav solve`: an answer, its files, and a run that reproduces it without searching."""

import json
import re

import jax
import numpy as np
import pytest

from jaxnav.app import cli
from jaxnav.app.config import resolve
from jaxnav.app.jobs import solve
from jaxnav.app.sources import load
from jaxnav.io import write_recording
from jaxnav.simulate.scenarios import SCENARIOS
from jaxnav.simulate.simulation import simulate_jit, to_recording
from tuning.solving.corrections import turned

SETTINGS = (
    "data.options.duration_s=150.0", "data.options.imu_rate_hz=50.0", "data.options.outages_s=[]",
    "data.options.sensors={speed = 0.03}", "data.options.position_sd_m=[2.0, 2.0, 3.0]",
    "data.options.velocity_sd_mps=[0.3, 0.3, 0.3]",
)  # fmt: skip


@pytest.fixture(scope="module")
def solved(tmp_path_factory):
    out = tmp_path_factory.mktemp("solve") / "out"
    sets = [word for setting in SETTINGS for word in ("--set", setting)]
    assert cli.main(["solve", "urban_short", "--fast", "--quiet", "--out", str(out), *sets]) == 0
    return out, json.loads((out / "metrics.json").read_text())


@pytest.mark.full
def test_it_writes_solution_parameters_and_a_report_that_begins_with_the_verdict(solved):
    out, found = solved
    for name in ("solution.csv", "solution.kml", "solution.geojson", "tuned.toml", "run.json"):
        assert (out / name).stat().st_size > 100, name
    assert not list(out.glob("*.png"))  # the report shows the run
    page = (out / "report.html").read_text()
    body = page[page.rindex("<body>") :]
    words = re.sub("<[^>]*>", "", body)  # without the explanations of their terms
    assert re.search(r"position good to [\d.]+ m, [\d.]+ m from second to second; NIS/dof", words[:600])
    assert re.search(r'<abbr tabindex="0" title="[^"]+">NIS/dof</abbr>', body[:2000])
    assert f'<p class="verdict">{found["verdict"]}</p>' in body[:400]
    for part in (
        "Hidden fixes of the test part",
        "this solution",
        "prefers-color-scheme: dark",
        "after 5 s without fixes",
    ):
        assert part in page or "after 10 s without fixes" in page, part


@pytest.mark.full
def test_wheel_speeds_are_taken_and_drift_less(solved):
    _, found = solved
    taken = {name for row in found["measurements"] if row["taken"] for name in row["names"]}
    assert "speed" in taken
    codes = {(f["code"], f["subject"]) for f in found["findings"]}
    assert ("solve.measurement", "speed") in codes
    left = {" and ".join(row["names"]) for row in found["measurements"] if not row["taken"]}
    assert {subject for code, subject in codes if code == "solve.left_out"} == left
    (row,) = [row for row in found["measurements"] if row["names"] == ["speed"]]
    assert row["drift_ratio"] < 0.6 and row["gain"] > 0
    assert found["drift_m"]["solution"] < found["drift_m"]["datasheet"]
    assert found["drift_ratio"] == pytest.approx(found["drift_m"]["solution"] / found["drift_m"]["datasheet"])


@pytest.mark.full
def test_a_recording_with_z_up_is_read_again_by_the_setting(tmp_path):
    """What run.json states is what was solved."""
    scenario = SCENARIOS["urban_short"]._replace(duration_s=120.0, imu_rate_hz=50.0)
    rec = to_recording(simulate_jit(jax.random.key(3), scenario), scenario)
    write_recording(tmp_path / "up", turned(rec, "flu"))
    config = resolve([("test", {"data": {"source": str(tmp_path / "up")}})])
    found = solve.corrected(config, load(config))
    assert found.settings == {"data.options.axes": "flu"}
    np.testing.assert_allclose(found.recording.imu.gyro, rec.imu.gyro, atol=1e-12)
    assert solve.with_options(config, found.settings).data.options == {"axes": "flu"}
    stated = solve.with_options(config, {"data.options.axes": "frd"})
    assert solve.corrected(stated, load(stated)).settings == {}


@pytest.mark.full
def test_the_run_reproduces_it_without_searching(solved, tmp_path):
    out, _ = solved
    assert cli.main(["filter", "--config", str(out / "run.json"), "--quiet", "--out", str(tmp_path / "again"),
                     "--set", "out.figures=none"]) == 0  # fmt: skip
    first, again = (np.genfromtxt(p / "solution.csv", delimiter=",", names=True) for p in (out, tmp_path / "again"))
    assert first.dtype == again.dtype
    for name in first.dtype.names:
        np.testing.assert_allclose(first[name], again[name], rtol=1e-9, atol=1e-9)


@pytest.mark.full
def test_an_interrupted_run_keeps_the_answer_so_far(tmp_path, capsys, monkeypatch):
    def stops(*args):
        raise KeyboardInterrupt

    monkeypatch.setattr("tuning.solving.solve._untuned", stops)
    out, again = tmp_path / "out", tmp_path / "again"
    sets = [word for setting in SETTINGS for word in ("--set", setting)]
    assert cli.main(["solve", "urban_short", "--fast", "--out", str(out), *sets]) == 130
    assert f"the best answer so far is in {out}" in capsys.readouterr().err
    assert "not tested yet: noise by likelihood" in (out / "report.html").read_text()
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]
    assert cli.main(["filter", "--config", str(out / "run.json"), "--quiet", "--out", str(again)]) == 0
    first, second = (np.genfromtxt(p / "solution.csv", delimiter=",", names=True) for p in (out, again))
    for name in first.dtype.names:
        np.testing.assert_allclose(first[name], second[name], rtol=1e-9, atol=1e-9)


@pytest.mark.full
def test_a_limit_is_a_time(capsys, tmp_path):
    assert cli.main(["solve", "urban_short", "--time", "0", "--out", str(tmp_path / "out")]) == 2
    assert "--time must be seconds above 0, got 0" in capsys.readouterr().err
