"""What tuning minimises, on made-up innovations; and the loop that minimises it."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from scipy.stats import multivariate_normal, multivariate_t

from jaxnav.types import Info
from tuning.fit import objectives
from tuning.fit.status import Status
from tuning.fit.train import fit
from tuning.fit.transforms import LOG, scaled

E, M = 6, 4


@pytest.fixture
def info():
    """Six epochs of four channels: the second has none, the third misses two."""
    rng = np.random.default_rng(0)
    A = rng.normal(size=(E, M, M))
    S = A @ A.transpose(0, 2, 1) + 0.5 * np.eye(M)
    nu = rng.normal(size=(E, M))
    valid = np.ones((E, M), bool)
    valid[1], valid[2, 1:3] = False, False
    both = valid[:, :, None] & valid[:, None]
    S, nu = np.where(both, S, np.eye(M)), np.where(valid, nu, 0.0)
    nis = np.einsum("ei,eij,ej->e", nu, np.linalg.inv(S), nu)
    residual = jnp.asarray(rng.normal(size=(E, M)) * 10)
    empty = jnp.zeros(E)
    return Info(empty, empty, empty, *map(jnp.asarray, (nu, S)), residual, jnp.asarray(valid), jnp.asarray(valid),
                jnp.asarray(nis), jnp.ones(E, bool), jnp.linalg.slogdet(jnp.asarray(S))[1])  # fmt: skip


def test_innovation_nll_is_the_gaussian_density_of_what_was_measured(info):
    keep = np.array([True, True, True, False, True, True])
    expected = []
    for e in np.flatnonzero(keep & np.asarray(info.valid.any(1))):
        v = np.asarray(info.valid[e])
        nu, S = np.asarray(info.nu[e])[v], np.asarray(info.S[e])[np.ix_(v, v)]
        expected.append(-multivariate_normal(np.zeros(v.sum()), S).logpdf(nu))
    assert len(expected) == 4
    assert objectives.innovation_nll(info, jnp.asarray(keep)) == pytest.approx(np.mean(expected), rel=1e-12)


def test_an_epoch_that_the_rule_rejects_is_scored_by_a_student_t(info):
    """Its density by scipy; an outlier of 500 m no longer costs a thousand epochs."""
    keep = np.array([True, False, False, False, False, False])
    some = info._replace(used=info.used.at[0, :2].set(False))
    expected = -float(multivariate_t(np.zeros(M), np.asarray(info.S[0]), df=4).logpdf(np.asarray(info.nu[0])))
    assert float(objectives.innovation_nll(some, jnp.asarray(keep))) == pytest.approx(expected, rel=1e-12)
    out = some._replace(nis=some.nis.at[0].set(15_000.0))
    assert objectives.innovation_nll(out, jnp.asarray(keep)) < 50


def test_masked_epochs_do_not_enter(info):
    """Held-out epochs may hold anything finite, and have no gradient."""
    keep = jnp.array([True, True, True, False, True, True])
    other = info._replace(nu=info.nu.at[3].set(1e6), nis=info.nis.at[3].set(1e12), S=info.S.at[3].set(1e6 * jnp.eye(M)))
    assert objectives.innovation_nll(other, keep) == objectives.innovation_nll(info, keep)
    g = jax.grad(lambda nis: objectives.innovation_nll(info._replace(nis=nis), keep))(info.nis)
    np.testing.assert_allclose(g, np.array([1, 0, 1, 0, 1, 1]) * 0.5 / 4)
    assert objectives.innovation_nll(info, jnp.zeros(E, bool)) == 0.0
    assert objectives.masked_mean(jnp.array([1.0, 2.0, 6.0]), jnp.array([True, False, True])) == 3.5


def test_rmse_per_axis_with_both_kinds_of_mask():
    error = jnp.array([[3.0, 1.0], [4.0, 100.0], [50.0, 2.0]])
    rows = jnp.array([True, True, False])
    np.testing.assert_allclose(objectives.rmse(error, rows), [np.sqrt(12.5), np.sqrt(5000.5)])
    cells = jnp.array([[True, True], [True, False], [False, True]])
    np.testing.assert_allclose(objectives.rmse(error, cells), [np.sqrt(12.5), np.sqrt(2.5)])
    np.testing.assert_array_equal(objectives.rmse(error, jnp.zeros(3, bool)), [0, 0])
    for e, keep in ((jnp.zeros((3, 2)), rows), (error, jnp.zeros(3, bool))):
        assert np.isfinite(jax.grad(lambda e, keep=keep: objectives.rmse(e, keep).sum())(e)).all()


def test_outage_error_and_drift(info):
    ends, keep = jnp.array([1, 4, 5]), jnp.array([True, True, False])
    distance = np.hypot(info.residual[ends, 0], info.residual[ends, 1])  # horizontal, of the hidden second too
    np.testing.assert_allclose(objectives.outage_error(info, ends), distance)
    rms = np.sqrt(np.mean(distance[:2] ** 2))
    assert objectives.drift(info, ends, keep) == pytest.approx(np.log(rms), abs=1e-6)
    assert objectives.log_mean_drift(info, ends, keep) == pytest.approx(np.log(distance[:2]).mean(), abs=1e-3)
    still = info._replace(residual=jnp.zeros((E, M)))
    for score in (objectives.drift, objectives.log_mean_drift):
        assert np.isfinite(score(still, ends, keep))
        g = jax.grad(lambda r, score=score: score(info._replace(residual=r), ends, keep))(still.residual)
        assert np.isfinite(g).all()
        g = np.asarray(jax.grad(lambda r, score=score: score(info._replace(residual=r), ends, keep))(info.residual))
        assert not g[5].any() and g[1, :2].all() and not g[:, 2:].any()
    assert np.isfinite(
        jax.grad(lambda r: objectives.outage_error(info._replace(residual=r), ends).sum())(still.residual)
    ).all()


def test_consistency_is_a_chi_square_value_of_one_degree_a_channel():
    rng, n, runs = np.random.default_rng(1), 400, 300
    S = np.diag([4.0, 0.25])

    def score(nu):
        info = made(nu, np.broadcast_to(S, (n, 2, 2)))
        return objectives.consistency(info, jnp.ones(n, bool))

    nu = rng.normal(size=(runs, n, 2)) * np.sqrt(np.diag(S))
    scores = np.asarray(jax.vmap(score)(jnp.asarray(nu))) * n / 2 * 2  # two channels
    assert scores.mean() == pytest.approx(2.0, rel=0.25) and scores.var() == pytest.approx(4.0, rel=0.5)
    assert score(jnp.asarray(3 * nu[0])) == pytest.approx(np.log(9) ** 2, rel=0.1)
    ratio, count = objectives.channel_nis(made(jnp.asarray(nu[0]), np.broadcast_to(S, (n, 2, 2))), jnp.arange(n) < 100)
    np.testing.assert_allclose(ratio, (nu[0, :100] ** 2 / np.diag(S)).mean(0))
    np.testing.assert_array_equal(count, [100, 100])


def made(nu, S, valid=None):
    valid = jnp.ones(nu.shape, bool) if valid is None else valid
    empty = jnp.zeros(nu.shape[0])
    done = jnp.ones(nu.shape[0], bool)
    return Info(empty, empty, empty, nu, jnp.asarray(S), nu, valid, valid, empty, done, jnp.linalg.slogdet(S)[1])


def test_whiteness_of_white_and_of_an_autoregression():
    rng, n = np.random.default_rng(2), 30000
    e = rng.normal(size=n)
    ar = np.zeros(n)
    for i in range(1, n):
        ar[i] = 0.6 * ar[i - 1] + e[i]
    S = np.broadcast_to(np.eye(1) * 9, (n, 1, 1))
    keep = jnp.ones(n, bool)
    white, coloured = (objectives.whiteness(made(jnp.asarray(a)[:, None], S), keep) for a in (e, ar))
    assert white == pytest.approx(1 / n, rel=1.5)
    assert coloured == pytest.approx(np.mean(0.36 ** np.arange(1, 6)), rel=0.1)
    half = jnp.asarray((np.arange(n) % 2 == 0)[:, None])  # every other epoch only: lags 2 and 4 are left
    gaps = objectives.whiteness(made(jnp.where(half, jnp.asarray(ar)[:, None], 0.0), S, half), keep)
    assert gaps == pytest.approx((0.36**2 + 0.36**4) / 5, rel=0.15)
    g = jax.grad(lambda nu: objectives.whiteness(made(nu, S), keep))(jnp.zeros((n, 1)))
    assert np.isfinite(g).all()


def test_error_consistency_needs_errors_of_the_size_that_P_says():
    rng, n = np.random.default_rng(3), 4000
    A = rng.normal(size=(3, 3))
    P = A @ A.T
    error = rng.normal(size=(n, 3)) @ A.T
    many = jnp.broadcast_to(jnp.asarray(P), (n, 3, 3))
    keep = jnp.ones(n, bool)
    assert objectives.error_consistency(jnp.asarray(error), many, keep) < 0.01
    assert objectives.error_consistency(jnp.asarray(2 * error), many, keep) == pytest.approx(np.log(4) ** 2, rel=0.1)


FROZEN = {
    "innovation_nll": lambda info, keep: objectives.innovation_nll(info, keep),
    "drift": lambda info, keep: objectives.drift(info, jnp.arange(E), keep),
    "log_mean_drift": lambda info, keep: objectives.log_mean_drift(info, jnp.arange(E), keep),
    "channel_nis": lambda info, keep: objectives.channel_nis(info, keep)[0].sum(),
    "consistency": lambda info, keep: objectives.consistency(info, keep),
    "whiteness": lambda info, keep: objectives.whiteness(info, keep, 2),
}


@pytest.mark.parametrize("name", FROZEN)
def test_a_run_that_froze_is_never_better(info, name):
    """Zero innovations of epochs that do not measure would look good; before the failure all is as it was."""
    ok, score = jnp.arange(E) < 4, FROZEN[name]
    still = lambda a: jnp.where(ok.reshape(-1, *[1] * (a.ndim - 1)), a, 0)
    frozen = info._replace(nu=still(info.nu), residual=still(info.residual), nis=still(info.nis), ok=ok,
                           S=jnp.where(ok[:, None, None], info.S, jnp.eye(M)), valid=still(info.valid) > 0)  # fmt: skip
    assert np.isinf(score(frozen, jnp.ones(E, bool))) and np.isfinite(score(info, jnp.ones(E, bool)))
    assert np.isinf(score(frozen, jnp.arange(E) > 3))  # nothing but frozen epochs
    assert score(frozen, ok) == score(info, ok)
    for keep in (ok, jnp.ones(E, bool)):
        slopes = jax.grad(lambda nu, r, keep=keep: score(frozen._replace(nu=nu, residual=r), keep), (0, 1))(
            frozen.nu, frozen.residual
        )
        assert all(np.isfinite(slope).all() for slope in slopes)


def test_a_frozen_stretch_of_the_drive_counts_only_where_it_is_weighed():
    from benchmarks.recordings.drive import over_stretches

    values = jnp.array([1.0, jnp.inf, 3.0])
    assert over_stretches(jnp.array([1.0, 0.0, 1.0]), values) == 2.0
    assert np.isinf(over_stretches(jnp.ones(3), values))


def test_tail_is_the_mean_of_the_worst():
    values = jnp.array([3.0, 1.0, 10.0, 7.0, 5.0, 1e9])
    weight = jnp.array([1.0, 1.0, 1.0, 1.0, 1.0, 0.0])  # the last was set aside
    assert objectives.tail(0.4)(values, weight) == pytest.approx((10 + 7) / 2)
    assert objectives.tail(0.5)(values, weight) == pytest.approx((10 + 7 + 0.5 * 5) / 2.5)
    assert objectives.tail(0.0)(values, weight) == 10.0
    assert objectives.tail(1.0)(values, weight) == pytest.approx(26 / 5)
    np.testing.assert_allclose(jax.grad(objectives.tail(0.4))(values, weight), [0, 0, 0.5, 0.5, 0, 0])
    assert objectives.log_mean(values, weight) == pytest.approx(np.log(values[:5]).mean())
    with pytest.raises(ValueError, match="share"):
        objectives.tail(1.5)


# ------------------------------------------------------------------------------------------------ training


def params():
    from jaxnav.filters.parameters import datasheet_params
    from jaxnav.states.grades import GRADES

    return datasheet_params(GRADES["tactical"])


def loss(p):
    """Least at gyro = 1e-3 and time_offset = 0.02."""
    return (jnp.log(p.noise.gyro) - jnp.log(1e-3)) ** 2 + ((p.mounting.time_offset - 0.02) / 0.01) ** 2


SPEC = {"noise.gyro": LOG, "mounting.time_offset": scaled(0.01)}


def test_fit_finds_the_minimum_and_touches_nothing_else():
    start = params()
    found = fit(loss, SPEC, start, 150, optax.adam(0.2))
    assert found.status is Status.ITERATION_LIMIT and len(found.history) == 151
    assert float(found.params.noise.gyro) == pytest.approx(1e-3, rel=1e-2)
    assert float(found.params.mounting.time_offset) == pytest.approx(0.02, abs=1e-4)
    assert found.loss == min(row["loss"] for row in found.history) and found.loss == pytest.approx(
        float(loss(found.params))
    )
    assert found.history[0]["params"]["noise.gyro"] == pytest.approx(float(start.noise.gyro))
    frozen = found.params._replace(
        noise=found.params.noise._replace(gyro=start.noise.gyro),
        mounting=found.params.mounting._replace(time_offset=start.mounting.time_offset),
    )
    jax.tree.map(np.testing.assert_array_equal, frozen, start)


def test_fit_keeps_the_best_by_validation_and_the_start_counts():
    start = params()
    upward = fit(loss, SPEC, start, 5, optax.sgd(-0.01))  # walks uphill
    assert upward.loss == upward.history[0]["loss"]
    assert float(upward.params.noise.gyro) == pytest.approx(float(start.noise.gyro), rel=1e-12)
    judged = fit(loss, SPEC, start, 60, optax.adam(0.2), validation=lambda p: (p.mounting.time_offset - 0.01) ** 2)
    assert judged.loss == min(row["validation"] for row in judged.history)
    assert float(judged.params.mounting.time_offset) == pytest.approx(0.01, abs=1e-3)


def test_fit_refuses_a_start_that_is_not_finite_and_survives_a_step_that_is_not():
    with pytest.raises(ValueError, match="the loss of the starting parameters is nan"):
        fit(lambda p: p.noise.gyro * jnp.nan, SPEC, params(), 3)
    found = fit(
        lambda p: jnp.where(p.mounting.time_offset > 0.004, jnp.nan, loss(p)), SPEC, params(), 20, optax.adam(0.2)
    )
    assert np.isfinite(found.loss) and np.isfinite(np.asarray(found.params.noise.gyro))
