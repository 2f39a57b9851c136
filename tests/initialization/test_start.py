"""Starting values: levelling, course, and the heading that a drive reveals."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.filters import run as run_module
from jaxnav.filters.catalogue import build
from jaxnav.filters.parameters import datasheet_params
from jaxnav.filters.run import track
from jaxnav.initialization.bank import heading_bank, most_probable_start, with_headings
from jaxnav.initialization.initialize import coarse_leveling, course
from jaxnav.initialization.starts import execute
from jaxnav.maths import rotations
from jaxnav.maths.units import DEG
from jaxnav.types import DataError, ImuLog, Samples
from tests.conftest import GRADE


def resting(roll, pitch, heading=1.0, bias=0.0, n=200, noise=0.0):
    C = np.asarray(rotations.from_rph(jnp.array([roll, pitch, heading])))
    force = C.T @ [0, 0, 9.81] + bias
    rng = np.random.default_rng(0)
    dt = rng.uniform(0.005, 0.015, n)
    return ImuLog(np.cumsum(dt), dt, np.zeros((n, 3)), force + noise * rng.normal(size=(n, 3)))


@pytest.mark.parametrize("roll, pitch", [(0.0, 0.0), (0.3, -0.2), (-2.9, 0.1), (1.2, 1.4), (0.0, -1.5)])
def test_level_recovers_the_tilt(roll, pitch):
    np.testing.assert_allclose(coarse_leveling(resting(roll, pitch), 0.0, 10.0), [roll, pitch], rtol=0, atol=1e-12)


def test_level_averages_between_the_times():
    imu = resting(0.1, 0.2, noise=0.05)
    np.testing.assert_allclose(coarse_leveling(imu, 0.0, 10.0), [0.1, 0.2], atol=2e-3)
    shaken = imu._replace(accel=np.where((imu.t > 1.0)[:, None], 50.0, imu.accel))
    assert coarse_leveling(shaken, 0.0, 1.0) == coarse_leveling(imu, 0.0, 1.0)
    roll, _ = coarse_leveling(resting(0.0, 0.0, bias=np.array([0.0, 9.81e-3, 0.0])), 0.0, 10.0)
    assert roll == pytest.approx(-1e-3, abs=1e-8)  # 1 mrad for 1 mg
    uneven = imu._replace(accel=np.tile([0.0, 0.0, -9.81], (200, 1)), dt=np.where(np.arange(200) < 100, 0.001, 0.009))
    uneven.accel[:100, 1] = -1.0  # a tenth of the time
    assert coarse_leveling(uneven, 0.0, 10.0)[0] == pytest.approx(np.arctan2(0.1, 9.81), rel=1e-12)
    with pytest.raises(DataError, match="no sample in 50.000 to 60.000 s to level with"):
        coarse_leveling(imu, 50.0, 60.0)


def test_course_is_that_of_the_first_fast_enough_velocity():
    value = np.array([[0.1, 0.1, 0.0], [0.0, 0.9, 5.0], [-3.0, 3.0, 0.0], [1.0, 0.0, 0.0]])
    velocity = Samples(np.arange(4.0), value, np.full((4, 3), 0.1), np.zeros((4, 3)))
    assert course(velocity, 0.5, after=2.5) == (3.0, pytest.approx(np.pi / 2))  # east
    assert course(velocity, 1.0) == (2.0, pytest.approx(-np.pi / 4))  # north west; climbing is not driving
    noisy = velocity._replace(sd=np.full((4, 3), 1.3))
    assert course(noisy, 0.5)[0] == 2.0  # the others may be noise
    with pytest.raises(DataError, match="never faster than 9 m/s"):
        course(velocity, 9.0)


def test_with_headings_turns_and_keeps_the_level(case):
    headings = np.array([-3.0, 0.0, 2.0])
    nav = case.nav._replace(q=rotations.from_dcm(rotations.from_rph(jnp.array([0.1, -0.2, 0.5]))))
    navs = with_headings(nav, headings)
    rph = track(navs).rph
    np.testing.assert_allclose(rph, np.stack([np.full(3, 0.1), np.full(3, -0.2), headings], 1), atol=1e-14)
    np.testing.assert_array_equal(navs.pos, np.broadcast_to(nav.pos, (3, 3)))


def test_heading_bank_picks_the_true_heading(case):
    """Eight hypotheses 45 deg apart, none of them exact: the nearest wins within 15 s and is right at the end."""
    epochs = jax.tree.map(lambda a: a[:15], case.packed.epochs)
    truth = case.truth.rph[0, 2]
    headings = truth + 0.2 + np.arange(8) * np.pi / 4 - 3 * np.pi / 4
    params = datasheet_params(GRADE, heading_sd=25 * DEG)
    bank = jax.jit(heading_bank, static_argnums=0)(
        build("kf9_simple"), params, with_headings(case.nav, headings), epochs
    )
    assert int(bank.best) == 3
    assert bank.probability.sum() == pytest.approx(1.0) and bank.probability[3] > 0.9
    end = np.asarray(track(jax.tree.map(lambda a: a[:, -1], bank.info.nav)).rph[:, 2])
    assert abs(np.remainder(end[3] - case.truth.rph[300, 2] + np.pi, 2 * np.pi) - np.pi) < 1.5 * DEG


def test_headings_of_a_long_run_are_given_up_when_they_are_lost(case, monkeypatch):
    """The choice of the whole bank by chunks; runs that are lost end, the one that wins is the bank's."""
    monkeypatch.setattr("jaxnav.filters.run.CHUNK", 5)
    monkeypatch.setattr("jaxnav.initialization.starts.CHUNK", 5)
    epochs = jax.tree.map(lambda a: a[:15], case.packed.epochs)
    headings = case.truth.rph[0, 2] + 0.2 + np.arange(8) * np.pi / 4 - 3 * np.pi / 4
    params, filt = datasheet_params(GRADE, heading_sd=25 * DEG), build("kf9_simple")
    navs = with_headings(case.nav, headings)
    navs = navs._replace(vel=navs.vel.at[1].set(1e200))  # a run that fails
    bank = jax.jit(heading_bank, static_argnums=0)(filt, params, navs, epochs)
    best, probability = most_probable_start(filt, params, navs, epochs)
    assert best == 3 and probability == pytest.approx(float(bank.probability[3]), abs=1e-9)
    counts, one = [], run_module.in_chunks
    count = lambda *args: (counts.append(info.ok.size) or info for info in one(*args))
    monkeypatch.setattr("jaxnav.initialization.bank.in_chunks", count)
    most_probable_start(filt, params, navs, epochs)
    assert 8 * 5 <= sum(counts) < 8 * 15
    info, about = execute(filt, params, navs, epochs)
    assert about.best == 3 and info.ok.shape == (15,)
    np.testing.assert_allclose(info.P, bank.info.P[3], rtol=1e-6, atol=1e-12)


@pytest.mark.full
def test_a_hypothesis_that_fails_is_none(case):
    """A run that stops being finite has no innovations from there on, which would be the most likely of all."""
    epochs = jax.tree.map(lambda a: a[:5], case.packed.epochs)
    navs = with_headings(case.nav, case.truth.rph[0, 2] + np.array([0.0, 0.1]))
    navs = navs._replace(vel=navs.vel.at[1].set(1e200))
    params = datasheet_params(GRADE, heading_sd=25 * DEG)
    bank = jax.jit(heading_bank, static_argnums=0)(build("kf9_simple"), params, navs, epochs)
    assert not bank.info.ok[1].all() and int(bank.best) == 0 and float(bank.probability[1]) == 0.0
