"""A sky over a simulated run: orbits, slots, the clock, and filters whose covariance is right under it."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav import build
from jaxnav.analysis import metrics
from jaxnav.filters.parameters import datasheet_states
from jaxnav.filters.run import run
from jaxnav.maths import earth
from jaxnav.measurements.satellites import PSEUDORANGE, SATELLITE
from jaxnav.simulate.satellites import clock, orbits, seen, slots, with_sky
from jaxnav.simulate.scenarios import SCENARIOS, Scenario
from jaxnav.simulate.simulation import matched_params, simulate, to_recording
from jaxnav.simulate.sky import Sky
from jaxnav.states.grades import GRADES
from jaxnav.states.receiver_clock import SLOTS

STREET = SCENARIOS["street"]
SHORT = STREET._replace(
    duration_s=100.0, imu_rate_hz=20.0, gnss_rate_hz=1.0,
    sky=STREET.sky._replace(few=((30.0, 45.0, 3), (60.0, 75.0, 1), (85.0, 95.0, 0))),
)  # fmt: skip
OPEN = SHORT._replace(sky=Sky())


def test_orbits_are_circles_that_the_velocity_follows():
    t = jnp.array([0.0, 100.0, 100.5, 101.0])
    position, velocity = (np.asarray(a) for a in orbits(Sky(), t))
    np.testing.assert_allclose(np.linalg.norm(position, axis=-1), 26_560e3, rtol=1e-12)
    np.testing.assert_allclose(velocity[2], position[3] - position[1], atol=1e-3)
    assert np.unique(position[0].round(-3), axis=0).shape[0] == 30


def test_houses_few_satellites_and_the_mask():
    azimuth, elevation = jnp.zeros((1, 4)), jnp.radians(jnp.array([[5.0, 20.0, 40.0, 80.0]]))
    at = lambda sky, t=0.0, azimuth=azimuth: np.asarray(seen(sky, jnp.array([t]), azimuth, elevation))[0].tolist()
    assert at(Sky()) == [False, True, True, True]
    houses = Sky(house_deg=50.0, street_deg=0.0)
    assert at(houses) == [False, True, True, True]  # along the street
    assert at(houses, azimuth=azimuth + 0.5 * jnp.pi) == [False, False, False, True]
    few = Sky(few=((10.0, 20.0, 1),))
    assert at(few, 15.0) == [False, False, False, True] and at(few, 25.0) == [False, True, True, True]


def test_slots_are_kept_while_a_satellite_is_up():
    there = np.ones((4, 16), bool)
    there[1:3, 2] = False
    elevation = np.tile(np.linspace(1.2, 0.2, 16), (4, 1))
    held, taken = (np.asarray(a) for a in slots(jnp.asarray(there), jnp.asarray(elevation)))
    assert sorted(held[0]) == list(range(SLOTS)) and taken[0].all()
    assert taken[1:].sum() == 1 and held[1, np.flatnonzero(taken[1])[0]] == 14  # the next one takes the slot
    assert (held[3] == held[2]).all()  # and keeps it


def test_a_clock_has_the_spread_of_its_states():
    params = matched_params(OPEN)
    params = params._replace(states=datasheet_states(GRADES["consumer"], PSEUDORANGE.needs))
    t = jnp.arange(1.0, 21.0)
    bias, drift = jax.vmap(lambda k: clock(k, params, t))(jax.random.split(jax.random.key(0), 4000))
    b, f = (float(params.states[f"receiver_clock_{n}"].driving_noise) ** 2 for n in ("bias", "drift"))
    free = np.asarray(bias - bias[:, :1] - (t - t[0]) * drift[:, :1])[:, -1]
    T = 19.0
    assert np.var(free) == pytest.approx(b * T + f * T**3 / 3, rel=0.1)
    one = np.asarray(bias[:, 1] - bias[:, 0] - drift[:, 0])  # a second of it
    assert np.var(one) == pytest.approx(b + f / 3, rel=0.08)
    assert np.var(np.asarray(drift - drift[:, :1])[:, -1]) == pytest.approx(f * T, rel=0.1)


@cache
def runs(scenario: Scenario, n: int):
    """Errors (n, E, 9 + k), covariances and infos of a tightly coupled filter on runs of a scenario."""
    names = ("position", "velocity", "pseudorange", "range_rate")
    filt = build("ekf15", names, cov_stride=10)
    own = matched_params(scenario)
    params = filt.params(scenario.imu.grade)
    params = params._replace(prior=own.prior, mounting=own.mounting, states=params.states | own.states)
    # of clock and range errors the start knows what their states say; one constellation has no bias to another
    still = params.states["inter_system_bias"]._replace(sd=jnp.asarray(1e-3))
    params = params._replace(states=params.states | {"inter_system_bias": still})

    @jax.jit
    def one(key):
        sim = with_sky(key, simulate(key, scenario), scenario)
        info = run(filt, params, sim.initial, sim.epochs)
        x = jax.vmap(metrics.state_error)(info.nav, sim.truth)
        more = [info.nav.errors[name] - sim.truth.errors[name] for name in filt.model.states]
        return jnp.concatenate([x, *more], 1), info.P, info.valid, info.used, info.ok, sim.epochs.fix.valid

    return filt, jax.lax.map(one, jax.random.split(jax.random.key(7), n))


@pytest.mark.full
def test_the_covariance_of_31_states_is_right_in_a_street():
    """ANEES within its bounds and 94 to 96 % inside the 95 %, with satellites that come and go."""
    filt, (x, P, valid, used, ok, seen_) = runs(SHORT, 40)
    assert bool(ok.all())
    counts = np.asarray(valid)[:, :, 6 : 6 + SLOTS].sum(-1)
    assert counts.min() == 0 and {1, 3} <= set(np.unique(counts)) and counts.max() >= 5
    keep = [i for i in range(x.shape[-1]) if not 17 <= i < 20]  # all but the bias between systems
    x, P = np.asarray(x)[:, 20::10][..., keep], np.asarray(P)[:, 20::10][..., keep, :][..., keep]
    nees = np.einsum("rei,reij,rej->re", x, np.linalg.inv(P), x) / len(keep)
    # runs are independent, epochs of one are not: bounds by the spread over the runs
    mean, spread = nees.mean(), nees.mean(1).std() / np.sqrt(len(nees))
    assert len(keep) == 31 and abs(mean - 1) < 3 * spread + 0.03, (mean, spread)
    inside = np.abs(x) < 1.96 * np.sqrt(np.diagonal(P, axis1=2, axis2=3))
    assert 0.935 < inside.mean() < 0.965, inside.mean()
    assert np.asarray(used)[:, :, 6:].sum() > 0.99 * np.asarray(valid)[:, :, 6:].sum()
    assert not np.asarray(valid)[:, :, :6].any() and np.asarray(seen_)[:, :, :6].any()  # fixes are compared alone


@pytest.mark.full
def test_a_faulty_satellite_moves_an_open_sky_solution_by_less_than_a_metre():
    """100 m at once: the gate leaves it out, however long it lasts, and a finding names it."""
    short = OPEN._replace(duration_s=60.0)
    filt, (x, *_) = runs(short, 3)
    sky = Sky(faulty_from_s=30.0, fault_m=100.0)
    _, (y, P, valid, used, ok, _) = runs(short._replace(sky=sky), 3)
    effect = np.linalg.norm(np.asarray(y - x)[..., :2], axis=-1)
    assert bool(ok.all()) and effect.max() < 1.0, effect.max()
    place = slice(6, 6 + SLOTS)
    out = np.asarray(valid & ~used)[:, 32:, place]
    assert (out.sum(-1) >= 1).all() and out.sum(-1).mean() < 1.2


@pytest.mark.full
def test_a_recording_of_a_street_has_its_satellites(tmp_path):
    from jaxnav.io import canonical

    sim = with_sky(jax.random.key(1), simulate(jax.random.key(1), SHORT), SHORT)
    rec = to_recording(sim, SHORT)
    stream = rec.aiding["pseudorange"]
    assert stream.auxiliary.shape == (stream.t.size, SLOTS, len(SATELLITE)) and stream.t.size == 90  # none in ten
    assert rec.aiding["position"].t.size < 75
    canonical.write_recording(tmp_path / "street", rec)
    again = canonical.read_recording(tmp_path / "street")
    found = again.aiding["pseudorange"]
    np.testing.assert_array_equal(found.value.sum(1), stream.value.sum(1))
    north = earth.enu_path(rec.aiding["position"].value, rec.truth.lla[0])
    assert np.abs(north).max() < 2000.0
