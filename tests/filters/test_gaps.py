"""Holes in an IMU's stream are filled, the covariance says so, and the rest of the log says how much."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.simulated import pauses
from jaxnav.checkup.inertial import gap_findings
from jaxnav.filters import gaps
from jaxnav.filters.catalogue import build
from jaxnav.filters.epochs import gap_noise, pack
from jaxnav.filters.run import run_jit
from jaxnav.types import ImuLog


def log(span=200.0, rate=50.0, seed=0):
    """Rates and forces that walk about with a time of some seconds."""
    rng, n = np.random.default_rng(seed), round(span * rate)
    white = rng.normal(size=(n, 6))
    values = np.zeros((n, 6))
    for i in range(1, n):
        values[i] = 0.995 * values[i - 1] + white[i] * np.repeat([0.002, 0.01], 3)
    values[:, 5] -= 9.8
    t = np.arange(1, n + 1) / rate
    return ImuLog(t, np.full(n, 1 / rate), values[:, :3], values[:, 3:])


def without(imu: ImuLog, begin: float, end: float) -> ImuLog:
    return ImuLog(*(a[(imu.t <= begin) | (imu.t > end)] for a in imu))


@pytest.mark.parametrize("length", [0.5, 3.0, 12.0])
def test_a_fill_misses_about_what_it_says(length):
    """Over many holes: what the fill gets wrong of the turn and the push, against the noise that it states."""
    imu, ratios = log(), []
    for begin in np.linspace(20.0, 170.0, 30):
        filled, holes = gaps.fill(without(imu, begin, begin + length))
        assert holes.begin.size == 1 and holes.end[0] - holes.begin[0] == pytest.approx(length, abs=0.03)
        missed = []
        for true, made in ((imu.gyro, filled.gyro), (imu.accel, filled.accel)):
            total = lambda a, d: (a * d[:, None]).sum(0)
            missed.append(total(true, imu.dt) - total(made, filled.dt))
        ratios.append([np.mean(m**2) / (n**2 * length) for m, n in zip(missed, holes.noise[0], strict=True)])
    assert 0.3 < np.mean(ratios) < 3.0
    np.testing.assert_allclose(filled.dt.sum(), imu.dt.sum(), rtol=1e-9)
    assert np.all(np.diff(filled.t) > 0)


def test_the_noise_of_a_hole_grows_with_its_length():
    """A hole longer than a quarter of the log cannot be tried in it: what is missed is taken to grow in proportion."""
    imu, none = log(40.0), np.zeros(0)
    longest = 0.25 * (40.0 - 2 * gaps.SIDE_S - 0.02)
    missed = [
        gaps._noise(gaps._Log(imu), imu, length, none, none) * np.sqrt(length) for length in (longest, 2 * longest)
    ]
    np.testing.assert_allclose(missed[1], 2 * missed[0], rtol=0.05)


def test_an_epoch_gets_the_noise_of_a_hole_for_its_share_of_it():
    """From 2 to 3.5 s, in epochs of half a second, two seconds and one second."""
    holes = gaps.Holes(np.array([2.0]), np.array([3.5]), np.array([[0.1, 2.0]]))
    found = np.asarray(gap_noise(holes, 1.5, np.array([2.0, 2.5, 4.5, 5.5])))
    np.testing.assert_allclose(found, np.sqrt([0.0, 1.0, 0.5, 0.0])[:, None] * [0.1, 2.0], atol=1e-12)


def test_a_log_without_holes_is_itself():
    imu = log(20.0)
    filled, holes = gaps.fill(imu)
    assert filled is imu and gap_findings(holes) == []
    short = without(imu, 10.0, 10.1)
    assert gaps.fill(short)[0] is short  # bridged as ever
    (found,) = gap_findings(gaps.holes(without(imu, 5.0, 7.0)))
    assert found.code == "imu.gaps" and found.value == pytest.approx(2.0, abs=0.02) and found.limit == 0.2


def test_a_turn_about_one_axis_is_no_third_of_it():
    """A vehicle turns about its vertical: the noise of a hole is that of its heading, not the mean of three axes."""
    imu = log()
    imu.gyro[:, :2] *= 1e-3
    noise = gaps._noise(gaps._Log(imu), imu, 3.0, np.zeros(0), np.zeros(0))
    level = ImuLog(imu.t, imu.dt, np.repeat(imu.gyro[:, 2:], 3, axis=1), imu.accel)
    assert noise[0] == pytest.approx(gaps._noise(gaps._Log(level), level, 3.0, np.zeros(0), np.zeros(0))[0], rel=1e-9)


@pytest.mark.full
def test_heading_behind_a_pause_is_as_wrong_as_it_says():
    """A minute without anything, in four drives: errors of the size of the sd, and right a minute later."""
    drives = [pauses.drive(seed, 270.0, 20.0) for seed in range(4)]
    error, sd = np.array([pauses.headings(rec, 140.0, 200.0) for rec in drives]).transpose(2, 0, 1)
    z = error / sd
    assert np.median(sd[:, 0]) > 40.0 and np.median(sd[:, -1]) < 3.0 and np.abs(error[:, -1]).max() < 6.0
    assert np.sqrt(np.mean(z**2)) < 2.0 and np.abs(z[:, :2]).max() < 2.5, z  # 2.8 by the mean of three axes
    found = [f for rec in drives for f in gap_findings(gaps.holes(pauses.paused(rec, 140.0, 200.0).imu))]
    assert sum(f.code == "imu.pause" and f.warns for f in found) >= 3  # one drive turns little
    assert all(f.value == pytest.approx(60.0, abs=0.1) for f in found)


@pytest.mark.full
def test_a_gap_of_any_length_is_coasted_and_the_covariance_knows(case):
    """Fixes go on: the run stays finite, its position is less sure in the gap, and right again after it."""
    imu, aiding = case.imu, case.aiding
    whole = pack(imu, aiding, 1.0)
    assert whole.epochs.gap is None
    cut = pack(without(imu, 20.0, 35.0), aiding, 1.0)
    assert cut.epochs.gap.shape == (cut.t.size, 2)
    loud = np.asarray(cut.epochs.gap)[:, 0] > 0
    assert loud[20:35].all() and not loud[:20].any() and not loud[35:].any()
    filt = build("ekf15")
    a, b = (run_jit(filt, case.params, case.nav, p.epochs) for p in (whole, cut))
    assert bool(b.ok.all())
    sd = lambda info: np.sqrt(np.asarray(jax.vmap(jnp.diag)(info.P)))
    assert (sd(b)[22:34, :3] > 1.2 * sd(a)[22:34, :3]).all() and (sd(b)[34, 6:9] > 2 * sd(a)[34, 6:9]).all()
    np.testing.assert_allclose(b.P[:20], a.P[:20], rtol=1e-9)
