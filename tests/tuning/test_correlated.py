"""Noise that is correlated between axes: gradients in its unconstrained numbers, and its recovery by likelihood."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from jaxnav.filters.catalogue import build
from jaxnav.filters.epochs import pack
from jaxnav.filters.parameters import datasheet_params, put
from jaxnav.filters.run import prepare, run
from tests.conftest import GRADE, gnss, simulate_drive, start
from tuning import uncertainty
from tuning.fit.objectives import innovation_nll
from tuning.fit.transforms import factor, join, split
from tuning.likelihood import information, runs_of
from tuning.recordings import scoring

EVERY, RATE, VRW = 4, 20.0, 0.3  # samples a fix; Hz; m/s^2/sqrt(Hz), large enough to show between two fixes
FIX = np.array([[1.0, 0, 0], [0.8, 0.6, 0], [0, 0, 1.0]])  # east and north of a fix's position are alike in 0.8
FORCE = VRW * np.array([[1.0, 0, 0], [-0.6, 0.8, 0], [0, 0, 1.0]])  # forward and right of the accelerometers in -0.6
SPEC = {"noise.accel": factor(3), "measurements.position.scale": factor(3)}


@pytest.fixture(scope="module")
def problem():
    """Information and likelihoods by the unconstrained numbers; the truth's and those of a start; their tree."""
    imu, truth = simulate_drive(40.0, RATE, (1.0, 0.5, 200.0))
    rng = np.random.default_rng(5)
    imu = imu._replace(accel=imu.accel + rng.normal(size=imu.accel.shape) @ FORCE.T * np.sqrt(RATE))
    aiding = gnss(truth, EVERY, rng)
    position, seen = aiding["position"], truth.lla[EVERY::EVERY]
    error = (rng.normal(size=seen.shape) * position.sd) @ FIX.T  # m, ENU
    metres = np.array([6.38e6, 6.39e6 * np.cos(seen[0, 0]), 1.0])  # of lat, lon, h
    aiding["position"] = position._replace(value=seen + error[:, [1, 0, 2]] / metres)
    packed = pack(imu, aiding, EVERY / RATE)
    filt, nav, params = build("kf9_simple", cov_stride=EVERY), start(truth), datasheet_params(GRADE)
    exact = put(put(params, "noise.accel", jnp.asarray(FORCE)), "measurements.position.scale", jnp.asarray(FIX))
    begin = put(params, "noise.accel", jnp.asarray(VRW / 2))
    raw, back = ravel_pytree(split(SPEC, begin))
    E = packed.t.size

    solve = lambda r: run(filt, join(SPEC, back(r), params), nav, packed.epochs)
    keep, block = jnp.ones(E, bool), np.arange(E) // 10
    many = lambda tree: jax.tree.map(lambda a: jnp.asarray(a)[None], tree)
    runs = runs_of(filt, params, many(nav), many(prepare(filt, packed.epochs)), keep[None], block[None])
    inform = lambda r: information(runs, SPEC, params, r)
    nll = jax.jit(lambda rs: jax.lax.map(lambda r: E * innovation_nll(solve(r), keep), rs))
    return inform, nll, ravel_pytree(split(SPEC, exact))[0], raw, back


@pytest.mark.full
def test_gradient_in_the_numbers_of_a_root(problem):
    inform, nll, exact, _, _ = problem
    at, h = exact + 0.3 * np.cos(np.arange(12)), 1e-4
    score = np.asarray(inform(at).score)
    above, below = (np.asarray(nll(at + step * np.eye(12))) for step in (h, -h))
    np.testing.assert_allclose(score, (above - below) / (2 * h), rtol=0, atol=1e-5 * np.abs(score).max())
    assert np.abs(score).min() > 1e-3 * np.abs(score).max()


@pytest.mark.full
def test_correlations_of_sensors_and_fixes_come_back(problem):
    inform, nll, exact, raw, back = problem
    found = scoring.maximise(inform, raw)
    cov = uncertainty.covariance(np.asarray(found.best.fisher), np.asarray(found.best.blocks))
    rows = {i.name: i for i in uncertainty.intervals(SPEC, back(found.raw), cov)}
    expected = {"measurements.position.scale[1,0]": 0.8, "noise.accel[1,0]": -0.6,
                "measurements.position.scale[0]": 1.0,
                "noise.accel[0]": VRW, "noise.accel[1]": VRW}  # fmt: skip
    for name, value in expected.items():
        assert rows[name].low < value < rows[name].high and rows[name].identified, name
    assert rows["measurements.position.scale[1,0]"].low > 0.7 and rows["noise.accel[1,0]"].high < -0.35
    assert all(abs(rows[f"{leaf}[2,{j}]"].value) < 0.2 for leaf in SPEC for j in (0, 1))  # of up and down none
    best, true, begun = nll(jnp.stack([found.raw, exact, raw]).repeat(4, 0))[::4]
    assert best < true < begun - 100
