"""Short forms of the recovery benchmarks, and the likelihood surface of a tuning job."""

import json

import numpy as np
import pytest

from benchmarks.recordings import navego
from benchmarks.simulated import recover


@pytest.mark.full
def test_simulated_noise_comes_back_from_ten_times_too_much(tmp_path):
    path = tmp_path / "r.json"
    recover.main(["--data", "simulated", "--quick", "--json", str(path)])
    r = json.loads(path.read_text())
    well = {name: p for name, p in r["parameters"].items() if p["well"]}
    assert len(well) == 6
    repeats = [(p["truth"], i) for p in well.values() for i in p["repeats"]]
    inside = [i["low"] <= truth <= i["high"] for truth, i in repeats]
    assert len(inside) == 24 and np.mean(inside) > 0.8
    true, start = np.array(r["rmse_true"]), np.array(r["rmse_start"])
    tuned = np.array(r["rmse_tuned"])
    assert (start / true > 1.2).all() and (np.median(tuned / true, axis=0) < 1.05).all()
    for name in ("measurements.position.scale[0]", "measurements.velocity.scale[0]"):
        assert well[name]["identified"] == 1.0


@pytest.mark.slow
@pytest.mark.parametrize("imu", ["imu1", "imu2"])
def test_navego_noise_comes_back(data_dir, tmp_path, imu):
    path = tmp_path / "r.json"
    recover.main(["--imu", imu, "--json", str(path)])
    r = json.loads(path.read_text())
    for key in navego.KEYS:
        assert r["rmse_tuned"][key] < 1.1 * r["rmse_true"][key], key
    assert all(0.95 < value < 1.05 for value in r["innovation_rms"])
    assert set(next(iter(r["parameters"].values()))) >= {"value", "low", "high", "truth", "unit"}
