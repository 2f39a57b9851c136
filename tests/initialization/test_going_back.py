"""A smoother's solution begins with the recording: attitude goes back from where a filter could start."""

from functools import partial
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.simulated.vehicles import simulated
from jaxnav.analysis.evaluate import ned_errors
from jaxnav.filters.catalogue import build
from jaxnav.filters.run import initial_nav
from jaxnav.initialization.going_back import gone_back
from jaxnav.initialization.initialize import Initialization, initialize
from jaxnav.maths import earth, rotations
from jaxnav.navigation import navigate
from jaxnav.types import ImuLog, Recording, Samples

EKF = build("ekf15", cov_stride=10)
PARAMS = EKF.params("consumer")


@pytest.fixture(scope="module")
def rec():
    found, _ = simulated("car", "consumer", True, np.random.default_rng(4), span=80.0, late=0.0)
    return found


def smoothed(rec, **options):
    return navigate(rec, EKF, PARAMS, smooth=True, **options)


@pytest.mark.full
def test_it_begins_with_the_first_fix(rec):
    sol = smoothed(rec)
    begin = initialize(rec, PARAMS)
    assert begin.t > rec.aiding["position"].t[0] + 8.0  # where a filter starts
    assert sol.t[0] <= rec.aiding["position"].t[1] + 1e-6 and "smoothed from t = " in sol.initialization.how
    error, sd = ned_errors(sol.trace, rec.truth)
    early = sol.t < begin.t
    z = np.sqrt(((error / sd)[early] ** 2).mean(0))
    assert (z[:6] < 2.0).all() and z[8] < 3.0  # position, velocity, heading
    assert np.abs(error[early, :2]).max() < 1.5 and sd[early, 8].max() < 2.0  # deg


@pytest.mark.full
def test_a_turning_gyro_on_a_turning_earth_goes_back_to_its_begin():
    """A vehicle turns by 3 deg/s for 100 s; without the Earth's rate it would be 0.3 deg off."""
    t, lla = np.arange(1, 10001) * 0.01, np.array([0.8, 0.2, 100.0])
    rph = np.stack([0.1 + 0 * t, -0.2 + 0 * t, 0.05 * t], 1)
    C = np.stack([np.asarray(rotations.from_rph(row)) for row in rph])  # body -> ENU
    steps = np.einsum("nji,njk->nik", C[:-1], C[1:])
    rate = Rotation.from_matrix(steps).as_rotvec() / 0.01
    spin = np.asarray(earth.earth_rate(lla[0]))
    gyro = np.vstack([rate[:1], rate]) + np.einsum("nji,j->ni", C, spin)
    imu = ImuLog(t, np.full(t.size, 0.01), gyro, np.zeros((t.size, 3)))
    k = np.arange(1.0, 100.0)
    fix = Samples(k, np.tile(lla, (k.size, 1)), np.ones((k.size, 3)), np.zeros((k.size, 3)))
    rec = Recording("turn", imu, {"position": fix, "velocity": fix._replace(value=0 * fix.value)}, None, np.zeros(3))
    nav = jax.tree.map(lambda a: np.asarray(a)[None], initial_nav(lla, rph=rph[-1]))
    smoothed = SimpleNamespace(nav=nav, P=1e-8 * np.eye(15)[None])
    begin = Initialization(nav, PARAMS.prior, 100.0, earliest=0.0)
    found = gone_back(rec, PARAMS, begin, smoothed, 100.0)
    assert found.t == 1.0
    at = np.asarray(rotations.to_dcm(found.navs.q[0]))
    assert Rotation.from_matrix(at.T @ C[99]).magnitude() < 3e-5  # rad
    wide = SimpleNamespace(nav=nav, P=np.eye(15)[None])
    assert gone_back(rec, PARAMS, begin, wide, 100.0) is None  # a heading that fixes never show


@pytest.mark.full
def test_bad_first_fixes_are_not_gone_back_to(rec):
    p = rec.aiding["position"]
    off = np.where(p.t < p.t[0] + 3.0, 200.0, 0.0)[:, None] / np.asarray(earth.metres_per_radian(p.value[0]))
    bad = rec._replace(aiding=rec.aiding | {"position": p._replace(value=p.value + off * [1.0, 1.0, 0.0])})
    sol = smoothed(bad)
    assert sol.t[0] > p.t[0] + 3.0 and np.abs(ned_errors(sol.trace, rec.truth)[0][:, :2]).max() < 3.0


@pytest.mark.full
def test_it_goes_back_no_further_than_asked(rec):
    sol = smoothed(rec, initialization=partial(initialize, t_start=20.0))
    assert 20.0 <= sol.t[0] < 22.0
    left_out = smoothed(rec, outages=[(0.0, 6.0)])
    assert 6.0 < left_out.t[0] < 8.0


@pytest.mark.full
def test_all_starts_of_a_recording_share_one_program(rec):
    """Runs from an alignment, from a stated heading and from the begin have parameters of the same shapes and types."""
    aligned = initialize(rec, PARAMS)
    stated = initialize(rec, PARAMS, heading=0.3)
    nav = jax.tree.map(lambda a: np.asarray(a)[:1], aligned.navs)
    back = gone_back(rec, PARAMS, aligned, SimpleNamespace(nav=nav, P=1e-8 * np.eye(15)[None]), aligned.t)
    assert aligned.states and not stated.states and back is not None
    kinds = [str(jax.tree.map(jax.typeof, begin.apply_to(PARAMS))) for begin in (aligned, stated, back)]
    assert kinds[0] == kinds[1] == kinds[2]
