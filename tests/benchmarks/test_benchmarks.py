"""Short forms of the benchmarks on recorded data: the bars that the README quotes."""

import json

import numpy as np
import pytest

from benchmarks.__main__ import main
from benchmarks.recordings import drive, navego, umn


def result(tmp_path, benchmark, *options):
    path = tmp_path / "result.json"
    benchmark.main([*options, "--json", str(path)])
    return json.loads(path.read_text())


@pytest.mark.full
def test_navego_lands_on_the_figures_of_an_independent_filter(data_dir, tmp_path):
    r = result(tmp_path, navego)
    for key, reference in navego.REFERENCE.items():
        assert r["rmse"][key] == pytest.approx(reference, rel=0.15), key
    assert all(0.95 < value < 1.05 for value in r["innovation_rms"]) and len(r["innovation_rms"]) == 6
    assert r["rmse_samples_as_means"]["heading_deg"] < r["rmse"]["heading_deg"]


@pytest.mark.full
def test_umn_flight_from_an_unknown_heading(data_dir, tmp_path):
    r = result(tmp_path, umn)
    assert not r["diverged"]
    assert max(r["roll_deg"], r["pitch_deg"], r["heading_deg"]) < 3.0
    assert sum(r["heading_probability"]) == pytest.approx(1.0)


@pytest.mark.full
def test_drive_untuned_on_the_mended_log_is_below_the_authors_filter(data_dir):
    rec = drive.recording()
    params = drive.parameters(-0.21)
    params = params._replace(noise=params.noise._replace(gyro=10 * params.noise.gyro, accel=10 * params.noise.accel))
    data = drive.cut(rec, True, drive.START)
    r = drive.evaluate(data, True, {0: params}, float(rec.aiding["position"].t[-1]))
    rms, median, worst, vertical = drive.AUTHOR["with constraints"]
    assert len(r["per_window"]) == 89
    assert r["horizontal_rms_m"] < rms and r["horizontal_median_m"] < median
    assert r["horizontal_max_m"] < worst and r["vertical_rms_m"] < vertical
    assert r["outside_rms_m"] < 0.055
    errors = np.array([w["horizontal_m"] for w in r["per_window"]])
    assert r["horizontal_rms_m"] == pytest.approx(np.sqrt(np.mean(errors**2)))
    starts = np.array([w["start_s"] for w in r["per_window"]])
    assert set(np.diff(np.unique(starts))) == {5.0} and starts.min() == 60.0


def test_training_stretches_keep_clear_of_the_windows_that_they_score():
    for block in range(4):
        edges = np.concatenate([[0.0], drive.BLOCKS, [600.0]])
        first, last = edges[block] - drive.OUTAGE / 2, edges[block + 1] + drive.OUTAGE / 2  # windows by their middle
        for other in set(range(4)) - {block}:
            assert drive.PIECES[other] >= last or drive.PIECES[other] + drive.PIECE <= first


def test_unknown_benchmark_and_absent_data(monkeypatch, tmp_path, capsys):
    assert main(["nothing"]) == 2
    monkeypatch.setenv("JAXNAV_DATA_DIR", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert main(["navego"]) == 3
    assert "navego_synthetic" in capsys.readouterr().err
