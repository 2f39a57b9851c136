"""Recipes are run and not only read: from a file to a solution without a setting about the start."""

import math

import numpy as np
import pytest

from benchmarks.recordings import check, start, wild
from jaxnav import build, navigate, read
from jaxnav.maths import earth

QUICK = ("comma2k19", "kitti", "ekf2_replay")


def run(name: str) -> dict:
    found = wild.one(name, wild.sources()[name], None)
    assert found["ran"], found.get("why")
    assert found["lines"] <= 10 and found["start"]["how"].startswith("starts at t = ")
    assert all(math.isfinite(value) for value in found["nis"].values())
    return found


@pytest.mark.full
@pytest.mark.parametrize("name", QUICK)
def test_a_recipe_gives_a_solution(data_dir, name):
    found = run(name)
    if name == "comma2k19":  # its columns are what the recipe says
        assert found["drift_rms_m"] < 2.0
    if name == "kitti":  # a hole of 1.9 s at its begin is coasted through
        assert any("gap(s) of over" in note for note in found["notes"])
    if name == "ekf2_replay":  # it hovers: the heading is a compass's
        assert "by the magnetometer" in found["start"]["how"]


def test_a_flight_is_where_the_onboard_filter_had_it(data_dir):
    """EKF2's own states of a replay: attitude within 2 deg, position within 1 m.

    EKF2 was not told the declination, so that its north is the magnetic one.
    """
    states = np.genfromtxt(data_dir / "ecl_replay" / "iris_gps_ekf2_states.csv", delimiter=",", skip_header=1)
    t, (w, x, y, z), ned = 1e-6 * states[:, 0], states[:, 1:5].T, states[:, 8:11]
    tilt = np.column_stack([np.arctan2(2 * (w * x + y * z), 1 - 2 * (x**2 + y**2)), np.arcsin(2 * (w * y - z * x))])
    yaw = np.unwrap(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2)))
    rec = read(wild.sources()["ekf2_replay"])
    ekf = build("ekf15", ("position", "velocity", "magnetometer"), cov_stride=10)
    sol = navigate(rec, ekf, ekf.params("consumer"))
    at = lambda a: np.column_stack([np.interp(sol.t, t, column) for column in a.T])
    assert np.degrees(np.abs(sol.rph[:, :2] - at(tilt)).max()) < 2.0
    declination = float(sol.params.measurements["magnetometer"].declination)
    assert np.degrees(declination) == pytest.approx(3.4, abs=0.2)
    assert np.degrees(np.abs(sol.rph[:, 2] - declination - np.interp(sol.t, t, yaw)).max()) < 2.0
    apart = earth.enu_path(sol.lla, sol.lla[0]) - at(ned[:, [1, 0, 2]] * [1.0, 1.0, -1.0])
    assert np.abs(apart - np.median(apart, axis=0)).max() < 1.0  # from an origin that the replay does not tell


SCRIPT = """
import jaxnav, tuning

rec = jaxnav.read("drive.bag")
ekf = jaxnav.build("ekf15", states=("gyro_scale",), measurements=("position", "velocity", "barometer"))
params = ekf.params("consumer")
sol = jaxnav.navigate(rec, ekf, params)
smooth = jaxnav.navigate(rec, ekf, params, smooth=True)
fit = tuning.tune(rec, ekf, params, free=("noise", "timing"))
print(fit)
sol = jaxnav.navigate(rec, ekf, fit.params)
"""


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_the_documented_commands_run(data_dir, capsys):
    """A fixed wing with a barometer: filter, smoother, tuning, and the tuned filter."""
    space: dict = {}
    exec(SCRIPT.replace("drive.bag", str(wild.sources()["px4_fixed_wing"])), space)
    assert "predicts by" in capsys.readouterr().out and space["sol"].ok.all() and space["smooth"].ok.all()
    assert (space["smooth"].sd[:, 8] < space["sol"].sd[:, 8].max()).all()


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
