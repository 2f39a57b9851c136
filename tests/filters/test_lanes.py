"""Lanes: each is the run of its candidate, by one program for any number of candidates and any length."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from jaxnav import build
from jaxnav.filters import lanes as module
from jaxnav.filters import scores
from jaxnav.filters.lanes import CHUNK, LANES, LaneRecord, lanes, ready, repeated, stacked
from jaxnav.filters.parameters import without_states
from jaxnav.filters.run import negative_log_likelihood, run
from tests.filters.test_size import epochs_of

FILTER, E = build("ekf9", cov_stride=5), CHUNK + 6


@pytest.fixture(scope="module")
def drive():
    """A start, 70 epochs of five samples with noise in them, and 18 candidates with a mask each."""
    rng = np.random.default_rng(0)
    nav, epochs = epochs_of(FILTER)
    epochs = jax.tree.map(lambda a: np.repeat(np.asarray(a)[:1], E, 0), epochs)
    imu = jax.tree.map(lambda a: a[:, :5], epochs.imu)
    imu = imu._replace(gyro=imu.gyro + 0.01 * rng.normal(size=imu.gyro.shape))
    value = np.array([0.5, 0.2, 10.0, 0.0, 0.0, 0.0]) + rng.normal(size=(E, 6)) * [1e-7, 1e-7, 1, 0.1, 0.1, 0.1]
    epochs = epochs._replace(imu=imu, fix=epochs.fix._replace(value=value))
    plain = FILTER.params("consumer")
    candidates = [
        plain._replace(noise=jax.tree.map(lambda a, f=f: a * f, plain.noise))
        for f in 10.0 ** rng.normal(size=LANES + 2)
    ]
    valid = rng.random((LANES + 2, E, 6)) < 0.7
    return nav, epochs, candidates, valid


@pytest.mark.full
def test_each_lane_is_the_run_of_its_candidate(drive):
    nav, epochs, candidates, valid = drive
    prepared = ready(FILTER, candidates[0], nav, epochs)
    assert prepared.fix.valid.shape[0] == 2 * CHUNK
    wide = np.pad(valid, ((0, 0), (0, CHUNK - 6), (0, 0)))
    record = lanes(FILTER, stacked(candidates), repeated(nav, len(candidates)), prepared, wide)
    for i in (0, 7, LANES - 1, LANES, LANES + 1):
        seen = epochs._replace(fix=epochs.fix._replace(valid=jnp.asarray(valid[i])))
        info = run(FILTER, candidates[i], nav, seen)
        for name in ("nu", "S", "valid", "used", "nis", "log_det", "ok"):
            np.testing.assert_allclose(getattr(record, name)[i, :E], getattr(info, name), rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(record.residual[i, :E], info.residual[:, :3], rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(record.P[i, :E], info.P[:, :3, :3], rtol=1e-7)
        np.testing.assert_allclose(record.velocity[i, :E], info.residual[:, 3:6], rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(record.velocity_P[i, :E], info.P[:, 3:6, 3:6], rtol=1e-7)
        nll = jax.vmap(negative_log_likelihood)(info)
        np.testing.assert_allclose(scores.innovation_nll(record, heavy=False)[i, :E], nll, rtol=1e-7, atol=1e-9)


@pytest.mark.full
def test_one_program_serves_any_number_of_candidates_and_any_length(drive, monkeypatch):
    nav, epochs, candidates, valid = drive
    traced = jax.jit(chex.assert_max_traces(module._chunk.jitted.__wrapped__, n=1), static_argnums=(0,))
    monkeypatch.setattr(module, "_chunk", traced)
    for count, size in ((2, 10), (LANES + 1, E), (LANES, CHUNK)):
        cut = jax.tree.map(lambda a, size=size: a[:size], epochs)
        prepared = ready(FILTER, candidates[0], nav, cut)
        mask = np.zeros((count, prepared.fix.valid.shape[0], 6), bool)
        mask[:, :size] = valid[:count, :size]
        assert lanes(FILTER, stacked(candidates[:count]), repeated(nav, count), prepared, mask).nu.shape[0] == count


@pytest.mark.full
def test_a_masked_measurement_is_no_measurement():
    """A filter with a barometer that gives nothing has the innovations of the one without, to the last bit but two.

    So it has with further states of sd zero, one of which enters its sensor.
    """
    nav, epochs = epochs_of(FILTER)
    more = build("ekf9", ("position", "velocity", "barometer"), 5, states=("barometer_bias", "gyro_bias"))
    wide = epochs._replace(fix=jax.tree.map(lambda a: np.concatenate([a, a[:, :1]], 1), epochs.fix))
    wide = wide._replace(fix=wide.fix._replace(valid=np.asarray(wide.fix.valid) & (np.arange(7) < 6)))
    found = []
    for filt, given in ((FILTER, epochs), (more, wide)):
        params = without_states(filt.params("consumer"), ())
        prepared = ready(filt, params, nav, given)
        found.append(lanes(filt, repeated(params, 1), repeated(nav, 1), prepared, np.asarray(prepared.fix.valid)[None]))
    plain, masked = found
    np.testing.assert_allclose(masked.nu[..., :6], plain.nu, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(masked.nis, plain.nis, rtol=1e-12)
    np.testing.assert_allclose(masked.log_det, plain.log_det, rtol=1e-12)
    assert not masked.nu[..., 6:].any()


@pytest.mark.full
@pytest.mark.parametrize("m", [1, 2, 6])
def test_a_fair_student_t_finds_the_sd_of_gaussian_residuals(m):
    """The most likely scale of 200,000 Gaussian residuals of unit variance is one; a plain t's is far below it."""
    y, at = np.random.default_rng(2).normal(size=(200_000, m)), np.exp(np.linspace(-0.5, 0.5, 41))
    total = [float(scores.residual_nll(y, np.broadcast_to(s * np.eye(m), (len(y), m, m))).mean()) for s in at]
    assert np.log(at[np.argmin(total)]) == pytest.approx(0.0, abs=0.026)
    total = [float(scores.student((y**2).sum(1) / s, m).mean()) + 0.5 * m * np.log(s) for s in at]
    assert np.log(at[np.argmin(total)]) < -0.15


def test_a_student_t_is_scipys():
    rng = np.random.default_rng(1)
    A = rng.normal(size=(4, 3, 3))
    C, y = A @ A.transpose(0, 2, 1) + np.eye(3), rng.normal(size=(4, 3)) * 3
    fair = C / scores.gaussian_scale(3)
    expected = [
        -stats.multivariate_t(np.zeros(3), S, df=scores.FREEDOM).logpdf(v) for S, v in zip(fair, y, strict=True)
    ]
    np.testing.assert_allclose(scores.residual_nll(y, C), expected, rtol=1e-12)
    lost = LaneRecord(*[np.zeros((1, 2))] * 11)._replace(valid=np.ones((1, 2, 3), bool), used=np.ones((1, 2, 3), bool),
                                                     ok=np.array([[True, False]]))  # fmt: skip
    assert np.isfinite(scores.innovation_nll(lost)).tolist() == [[True, False]]
