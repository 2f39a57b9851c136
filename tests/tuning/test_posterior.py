"""NUTS draws where the posterior is known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tuning.posterior import sample

pytest.importorskip("blackjax")


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_posterior_of_a_log_sd_and_a_mean():
    """Normal samples with flat priors on mean and log sd: their marginals are Student's and chi's."""
    n, s = 40, 2.0
    y = np.random.default_rng(0).normal(size=n)
    y = jnp.asarray((y - y.mean()) / y.std(ddof=1) * s + 1.0)

    def log_density(r):
        return -0.5 * jnp.sum(((y - r[0]) / jnp.exp(r[1])) ** 2) - n * r[1]

    cov = np.diag([s**2 / n, 1 / (2 * n)])
    got = sample(log_density, np.array([1.0, np.log(s)]), cov, 1500, jax.random.key(0))
    mean, precision = got.raw[:, 0], np.exp(-2 * got.raw[:, 1])
    assert mean.mean() == pytest.approx(1.0, abs=0.05) and precision.mean() == pytest.approx(1 / s**2, rel=0.05)
    assert mean.var() == pytest.approx(s**2 / n * (n - 1) / (n - 3), rel=0.2)
    assert precision.var() == pytest.approx(2 / (n - 1) / s**4, rel=0.25)
    assert got.divergent == 0 and got.acceptance > 0.6
