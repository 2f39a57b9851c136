"""A vehicle that is parked first: its heading is unknown while it stands, and known soon after it moves off."""

import numpy as np
import pytest

from benchmarks.simulated.vehicles import simulated
from jaxnav.filters.catalogue import build
from jaxnav.initialization.parked import MAX_HYPOTHESIS_SD, moves_off, spread_again
from jaxnav.maths.units import DEG
from jaxnav.navigation import navigate

REST = 300.0  # s


@pytest.fixture(scope="module")
def parked():
    rec, _ = simulated(
        "car", "consumer", True, np.random.default_rng([2, 1]), span=REST + 90.0, late=0.0, rest=(0.0, REST)
    )
    return rec, navigate(rec, build("ekf15", cov_stride=10))


@pytest.mark.full
def test_heading_is_unknown_at_rest_and_consistent_in_motion(parked):
    rec, sol = parked
    true = np.interp(sol.t, rec.truth.t, np.unwrap(rec.truth.rph[:, 2]))
    error, sd = (sol.rph[:, 2] - true + np.pi) % (2 * np.pi) - np.pi, sol.sd[:, 8]
    still, after = (sol.t > 15.0) & (sol.t < REST - 1.0), sol.t > REST + 20.0
    assert sol.t[0] < 15.0 and sol.initialization.navs.t.shape[0] == 12
    assert sd[still].min() > 25 * DEG and sd[still][-1] > 0.8 * sd[still].max()  # it shows nothing
    assert sd[after].max() < 5 * DEG and np.sqrt(np.mean((error[after] / sd[after]) ** 2)) < 2.0
    assert np.diff(sol.t).min() > 0 and sol.ok.all()


@pytest.mark.full
def test_when_a_vehicle_moves_off(parked):
    rec, _ = parked
    assert moves_off(rec, 10.0) == pytest.approx(REST, abs=3.0)
    assert moves_off(rec, REST + 20.0) == pytest.approx(REST + 20.0, abs=1.3)
    still = rec._replace(aiding={n: s._replace(t=s.t, value=0 * s.value + s.value[:1]) for n, s in rec.aiding.items()})
    assert moves_off(still, 10.0) is None


@pytest.mark.full
def test_headings_are_spread_about_what_the_standstill_left(parked):
    """Position, tilt and biases stay, with their sd; a heading that is known is left alone."""
    import jax

    _, sol = parked
    k = int(np.searchsorted(sol.t, REST - 5.0))
    info = jax.tree.map(lambda a: np.asarray(a)[:k], sol.trace.info)
    filt, n = sol.filter, info.P.shape[-1]
    params, navs = spread_again(filt, sol.params, info, 12)
    sd = np.sqrt(np.diag(info.P[-1]))
    assert sd[8] > MAX_HYPOTHESIS_SD and float(params.prior.attitude[2]) == pytest.approx(np.pi / 6)
    np.testing.assert_allclose(params.states["gyro_bias"].sd, sd[9:12])
    np.testing.assert_allclose(np.asarray(navs.pos)[:, 2], info.nav.pos[-1][2], atol=0.1)
    assert len({round(float(q), 6) for q in np.asarray(navs.q)[:, 0]}) > 6
    known = info._replace(
        P=info.P * np.where(np.arange(n) == 8, 1e-2, 1.0)[:, None] * np.where(np.arange(n) == 8, 1e-2, 1.0)
    )
    assert spread_again(filt, sol.params, known, 12) is None
