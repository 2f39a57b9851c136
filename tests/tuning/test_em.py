"""EM: its score is the likelihood's derivative, its steps never go down, and the sizes of white noise come out."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from jaxnav.data.epochs import hide
from jaxnav.filters.catalogue import build
from jaxnav.filters.parameters import get, put
from jaxnav.filters.run import negative_log_likelihood, run
from tuning.em import check, em, expected
from tuning.transforms import IDENTITY, LOG, believed, join, split, tied

SPEC = {
    "noise.gyro": tied(LOG), "noise.accel": tied(LOG), "states.gyro_bias.drive": tied(LOG),
    "measurements.position.scale": tied(LOG, (0, 0, 1)), "measurements.velocity.scale": tied(LOG),
}  # fmt: skip


@pytest.fixture(scope="module")
def job(case):
    """The free numbers three times too large, likelihood and E step; half a minute of it has no fixes."""
    filt, start = build("ekf15", cov_stride=5), case.params
    for name in SPEC:
        start = put(start, name, 3.0 * get(start, name))
    epochs = hide(case.packed.epochs, (np.arange(60) > 20) & (np.arange(60) < 36))
    flat, back = ravel_pytree(split(SPEC, start))
    at = lambda r: join(SPEC, back(r), start)
    inform = jax.jit(lambda r: expected(filt, at, r, case.nav, epochs))
    return flat, inform, epochs, jax.jit(lambda r: nll(run(filt, at(r), case.nav, epochs)))


def nll(info):
    return jnp.sum(jnp.where(info.valid.any(-1), jax.vmap(negative_log_likelihood)(info), 0.0))


def test_the_score_is_the_derivative_of_the_likelihood(job):
    """By central differences; what is left is that feedback moves the path that the filter is linear about."""
    flat, inform, _, value = job
    found, step = inform(flat), 1e-4
    for i, mine in enumerate(np.asarray(found.score)):
        off = jnp.zeros_like(flat).at[i].set(step)
        slope = float(value(flat + off) - value(flat - off)) / (2 * step)
        assert mine == pytest.approx(slope, rel=2e-3, abs=2e-3)
    assert float(found.nll) == pytest.approx(float(value(flat)), rel=1e-10)


def test_every_draw_is_counted_once(job):
    """Of fixes as many as were used; of what moves the IMU as many as its noise has directions in an epoch."""
    flat, inform, epochs, _ = job
    draws = dict(zip(sorted(SPEC), np.split(np.asarray(inform(flat).draws), [2, 3, 4, 5]), strict=True))
    used = np.asarray(epochs.fix.valid).sum(0)
    np.testing.assert_allclose(draws["measurements.position.scale"], [used[0] + used[1], used[2]], rtol=1e-9)
    np.testing.assert_allclose(draws["measurements.velocity.scale"], used[3:].sum(), rtol=1e-9)
    # an acceleration noise moves velocity and position in three axes; a rate's turns, and what turning does to both
    assert draws["noise.accel"] == 6 * 60 and 3 * 60 < draws["noise.gyro"] <= 9 * 60


def test_no_step_goes_down_and_the_fixes_noise_is_found(job):
    flat, inform, _, _ = job
    values = [float(inform(flat).nll)]
    found = em(inform, flat, 12, report=lambda i, r, at: values.append(float(at.nll)))
    assert len(values) == 12 and (np.diff(values) < 0).all() and not found.done
    scales = np.exp(np.asarray(found.flat))[:3]
    assert np.abs(scales - 1.0).max() < 0.35  # 45 fixes tell a scale to a tenth
    assert np.abs(np.asarray(found.at.score)[:3]).max() < 3.0  # of 500 at the start


def test_ctrl_c_keeps_what_it_has(job):
    def stop(i, r, at):
        raise KeyboardInterrupt

    flat, inform, _, _ = job
    found = em(inform, flat, 12, report=stop)
    assert found.interrupted and float(found.at.nll) < float(inform(flat).nll)


def test_what_em_has_no_step_for_is_named(case):
    for spec, words in (
        ({"mounting.time_offset": LOG}, "not mounting.time_offset"),
        ({"noise.gyro": IDENTITY}, "not noise.gyro"),
        ({"states.gyro_bias.sd": LOG}, "not states.gyro_bias.sd"),
        ({"noise.gyro": believed(LOG, 1.0, 1.0)}, "noise.gyro has one"),
    ):
        with pytest.raises(ValueError, match=words):
            check(spec, case.params)
    check({"measurements.nonholonomic.sd": LOG, "measurements.barometer.sd_scale": LOG}, case.params)
    with pytest.raises(ValueError, match="ekf9 and ekf15"):
        check({"noise.gyro": LOG}, case.params._replace(rule=jnp.ones(1)))
