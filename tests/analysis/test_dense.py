"""The solution at every sample: the filter's between its fixes, the smoother's at them, and no worse in between."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from jaxnav import build, initialize, navigate
from jaxnav.analysis import metrics
from jaxnav.filters.parameters import earliest, later
from jaxnav.filters.run import initial_nav
from jaxnav.maths import earth
from jaxnav.simulate.scenarios import URBAN_SHORT
from jaxnav.simulate.simulation import simulate_jit, to_recording


@pytest.fixture(scope="module")
def runs():
    """A drive, filtered and smoothed, at the ends of epochs and at every sample; truth at the IMU's rate."""
    what = URBAN_SHORT._replace(duration_s=70.0)
    rec = to_recording(simulate_jit(jax.random.key(5), what), what)
    fine = what._replace(gnss_rate_hz=what.imu_rate_hz)  # the same drive, its truth at every sample
    truth = to_recording(simulate_jit(jax.random.key(5), fine), fine).truth
    ekf = build("ekf15", cov_stride=5)
    params = ekf.params("adis16465")
    params = params._replace(mounting=params.mounting._replace(lever_arm=rec.lever_arm))
    begin = initialize(rec, params)
    found = {}
    for smooth in (False, True):
        sol = navigate(rec, ekf, params, initialization=begin, smooth=smooth)
        found[smooth] = sol, *sol.at_imu_rate()
    return rec, truth, found


@pytest.mark.full
@pytest.mark.parametrize("smooth", [False, True])
def test_every_sample_has_its_navigation_and_epochs_end_as_before(runs, smooth):
    rec, _, found = runs
    sol, track, sd = found[smooth]
    own = rec.imu.t[(rec.imu.t > sol.initialization.t + 1e-6) & (rec.imu.t <= sol.t[-1] + 1e-6)]
    np.testing.assert_allclose(track.t, own, atol=1e-9)
    ends = np.searchsorted(track.t, sol.t - 1e-6)
    np.testing.assert_allclose(track.t[ends], sol.t, atol=1e-9)
    np.testing.assert_allclose(track.lla[ends], sol.lla, atol=1e-13)
    np.testing.assert_allclose(track.vel[ends], sol.vel, atol=1e-9)
    np.testing.assert_allclose(sd[ends], sol.sd, rtol=1e-6)
    assert sd.shape == (track.t.size, 9) and (sd > 0).all()


def test_between_fixes_the_filter_is_the_mechanization(runs):
    """No jump but at a fix; and an outage's drift is that of the filter."""
    _, _, found = runs
    sol, track, _ = found[False]
    step = np.diff(track.vel, axis=0)
    at_fix = np.isin(np.round(track.t[1:], 6), np.round(sol.t, 6))
    assert np.abs(step[~at_fix]).max() < 0.4 and np.abs(step[at_fix]).max() > 2 * np.median(np.abs(step[~at_fix]))


def test_smoothed_samples_are_as_good_as_smoothed_epochs(runs):
    _, truth, found = runs
    errors = {}
    for smooth, (sol, track, sd) in found.items():
        error = np.asarray(metrics.errors(track, truth).position)
        ends = np.searchsorted(track.t, sol.t - 1e-6)
        errors[smooth] = np.sqrt(np.mean(error[:, :2] ** 2)), np.sqrt(np.mean(error[ends, :2] ** 2))
        assert np.mean(np.abs(error[:, :2]) < 3 * sd[:, :2]) > 0.97
    assert errors[True][0] < 0.6 * errors[False][0]
    for smooth, (every, at_ends) in errors.items():  # the filter's are older between fixes, the smoother's are not
        assert every == pytest.approx(at_ends, rel=0.05 if smooth else 0.25)


def test_a_rule_without_a_way_back_is_refused(runs):
    rec, _, found = runs
    gpid = build("gpid15")
    with pytest.raises(ValueError, match="cannot be smoothed"):
        from jaxnav.analysis.dense import dense

        dense(gpid, gpid.params("consumer"), initial_nav(rec.aiding["position"].value[0]), found[False][0].epochs, True)


def test_a_smoothed_position_moves_by_its_velocity(runs):
    """From sample to sample, over the ends of epochs, too: the error is carried through them and does not jump."""
    _, _, found = runs
    track = found[True][1]
    where, dt = earth.enu_path(track.lla, track.lla[0]), np.diff(track.t)[:, None]
    off = np.diff(where, axis=0) - 0.5 * (track.vel[1:] + track.vel[:-1]) * dt
    assert np.abs(off[:, :2]).max() < 0.02


def test_at_the_imus_time_a_delay_is_a_distance_along_the_track(runs, tmp_path):
    """An unknown 0.02 s are 0.02 v; by the clock of the fixes positions do not know of it."""
    _, _, found = runs
    sol = replace(found[False][0], delay_sd=0.02)
    track, sd = sol.at_imu_time(sol.trace.track, sol.sd)
    np.testing.assert_allclose(sd[:, :3] ** 2 - sol.sd[:, :3] ** 2, (0.02 * sol.vel) ** 2, atol=1e-9)
    np.testing.assert_array_equal(sd[:, 3:], sol.sd[:, 3:])
    np.testing.assert_array_equal(track.t, sol.imu_time(sol.t))
    for base, stated in (("imu", sd), ("fixes", sol.sd)):
        sol.write(tmp_path / f"{base}.csv", base=base)
        names = (tmp_path / f"{base}.csv").read_text().splitlines()[0].split(",")
        rows = np.loadtxt(tmp_path / f"{base}.csv", delimiter=",", skiprows=1)
        np.testing.assert_allclose(rows[:, names.index("sd_e_m")], stated[:, 0], atol=2e-3)


def test_at_the_imus_time_a_clocks_rate_is_a_distance_that_grows_from_halfway(runs):
    """An unknown 100 ppm are 3.5 ms of the track at either end of 70 s."""
    _, _, found = runs
    sol = replace(found[False][0], clock_rate_sd=1e-4)
    _, sd = sol.at_imu_time(sol.trace.track, sol.sd)
    away = 1e-4 * (sol.t - float(sol.trace.info.nav.origin.t[0]))
    assert away[-1] == pytest.approx(3.5e-3, rel=0.03)
    np.testing.assert_allclose(sd[:, :3] ** 2 - sol.sd[:, :3] ** 2, (away[:, None] * sol.vel) ** 2, atol=1e-9)


@pytest.mark.full
def test_fixes_that_are_early_give_the_solution_of_fixes_in_time(runs):
    """Stamps of fixes 11 samples before the IMU's and the delay stated: to rounding, at the IMU's stamps."""
    rec, _, found = runs
    step = float(np.median(rec.imu.dt))
    early = {name: samples._replace(t=samples.t - 11 * step) for name, samples in rec.aiding.items()}
    params = found[False][0].params
    stated = later(params, -11 * step)
    right, got = (
        navigate(each, build("ekf15", cov_stride=5), theta, smooth=True)
        for each, theta in ((rec, params), (rec._replace(aiding=early), stated))
    )
    assert got.recording.early == pytest.approx(11 * step) and right.recording.early == 0.0
    at = got.imu_time(got.t)
    n = min(at.size, right.t.size) - 2  # the last fix has no IMU behind it
    np.testing.assert_allclose(at[:n], right.imu_time(right.t)[:n], atol=1e-9)
    np.testing.assert_allclose(got.lla[:n], right.lla[:n], atol=1e-10)
    np.testing.assert_allclose(got.rph[:n], right.rph[:n], atol=1e-5)
    assert float(got.stated_params.mounting.time_offset) == pytest.approx(-11 * step)
    assert earliest(got.params, float(np.ptp(rec.imu.t))) == pytest.approx(0.0, abs=1e-12)
