"""A sky of satellites over a simulated run: circular orbits, a mask, blocked sectors, a clock, slow range errors.

Ranges are the corrected ones of `jaxnav.measurements.satellites`, by the model that filters them.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxnav.filters.parameters import datasheet_states
from jaxnav.maths import earth
from jaxnav.maths.units import DEG
from jaxnav.measurements.satellites import PSEUDORANGE, RANGE_RATE, weight
from jaxnav.simulate.gnss import inside
from jaxnav.simulate.processes import gauss_markov, normal
from jaxnav.simulate.readings import expected
from jaxnav.simulate.scenarios import Scenario
from jaxnav.simulate.simulation import Simulated, matched_params
from jaxnav.simulate.sky import Sky
from jaxnav.states.grades import GRADES
from jaxnav.states.receiver_clock import SLOTS
from jaxnav.types import Fix, Params

RADIUS, INCLINATION, PLANES = 26_560e3, 55.0 * DEG, 6  # m, rad, of GPS
MU = 3.986005e14  # m^3/s^2
FIX_SATELLITES = 4
CN0_ZENITH, CN0_HORIZON = 50.0, 36.0  # dB-Hz


def orbits(sky: Sky, t: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return positions and velocities (E, N, 3) m, m/s of the satellites in ECEF at t (E,) s."""
    i = np.arange(sky.satellites)
    node = 2 * np.pi * (i % PLANES) / PLANES
    first = 2 * np.pi * (i // PLANES) / max(1, -(-sky.satellites // PLANES)) + 0.35 * (i % PLANES)
    rate = math.sqrt(MU / RADIUS**3)
    u, turned = first + rate * t[:, None], node - earth.RATE * t[:, None]
    su, cu, si, ci = jnp.sin(u), jnp.cos(u), math.sin(INCLINATION), math.cos(INCLINATION)
    sn, cn = jnp.sin(turned), jnp.cos(turned)
    position = RADIUS * jnp.stack([cu * cn - su * ci * sn, cu * sn + su * ci * cn, su * si], -1)
    along = RADIUS * rate * jnp.stack([-su * cn - cu * ci * sn, -su * sn + cu * ci * cn, cu * si], -1)
    spin = earth.RATE * jnp.stack([position[..., 1], -position[..., 0], jnp.zeros_like(su)], -1)
    return position, along + spin


def seen(sky: Sky, t: jax.Array, azimuth: jax.Array, elevation: jax.Array) -> jax.Array:
    """Return which satellites are seen, (E, N) bool."""
    across = jnp.abs(jnp.sin(azimuth - sky.street_deg * DEG))
    houses = jnp.arctan(jnp.tan(sky.house_deg * DEG) * across)
    there = elevation > jnp.maximum(sky.mask_deg * DEG, houses)
    order = jnp.argsort(jnp.argsort(jnp.where(there, -elevation, jnp.inf), axis=1), axis=1)
    for start, end, count in sky.few:
        there &= ~inside(t, jnp.array([[start, end]]))[:, None] | (order < count)
    return there


def slots(there: jax.Array, elevation: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the satellite of each slot (E, SLOTS) int, -1 for none yet, and where another one has taken it.

    A satellite keeps its slot until it sets and another one needs it; the highest get the slots.
    """

    def advance(held: jax.Array, now: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        up, height = now
        has = (held[:, None] == jnp.arange(up.size)).any(0)
        new = up & ~has
        rank = jnp.where(new, jnp.argsort(jnp.argsort(jnp.where(new, -height, jnp.inf))), up.size)
        free = (held < 0) | ~up[jnp.maximum(held, 0)]
        place = jnp.where(free, jnp.cumsum(free) - 1, -1)
        match = place[:, None] == rank
        taken = match.any(1)
        return jnp.where(taken, match.argmax(1), held), (jnp.where(taken, match.argmax(1), held), taken)

    return lax.scan(advance, jnp.full(SLOTS, -1), (there, elevation))[1]


def clock(key: jax.Array, params: Params, t: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return bias (E,) m and drift (E,) m/s of a receiver's clock at t (E,) s, by its states' priors."""
    bias, drift = params.states["receiver_clock_bias"], params.states["receiver_clock_drift"]
    first, steps = normal(key, (2,)), normal(jax.random.fold_in(key, 1), (t.size, 3))
    T = t[1] - t[0]
    walk = drift.driving_noise * jnp.sqrt(T) * steps[:, 0]
    rate = drift.sd * first[0] + jnp.cumsum(walk)
    # integral of the walk within an epoch: correlated with its end, by sqrt(3) / 2
    within = T * (0.5 * walk + drift.driving_noise * jnp.sqrt(T / 12) * steps[:, 1])
    start = jnp.concatenate([drift.sd * first[:1], rate[:-1]])
    grown = start * T + within + bias.driving_noise * jnp.sqrt(T) * steps[:, 2]
    return bias.sd * first[1] + jnp.cumsum(grown), rate


def with_sky(key: jax.Array, sim: Simulated, scenario: Scenario) -> Simulated:
    """Return the run with the satellites of the scenario, by the defaults of their measurements and states."""
    assert scenario.sky is not None
    params = matched_params(scenario)
    states = datasheet_states(GRADES[scenario.imu.grade], PSEUDORANGE.needs)
    return with_satellites(key, sim, params._replace(states=params.states | states), scenario.sky)


def with_satellites(key: jax.Array, sim: Simulated, params: Params, sky: Sky) -> Simulated:
    """Return the run with pseudoranges and range rates behind its channels; a fix needs four satellites.

    Noise is that of ``params``: weights of the measurements, clock and range errors by their states. Channels are those
    of `PSEUDORANGE` and `RANGE_RATE`; the truth has the errors of clock and slots.
    """
    t = sim.truth.t
    position, velocity = orbits(sky, t)
    lla = sim.truth.pos
    to_ecef = jax.vmap(earth.axes)(lla[:, 0], lla[:, 1])
    off = position - jax.vmap(earth.lla_to_ecef)(lla)[:, None]
    enu = jnp.einsum("eni,eij->enj", off, to_ecef)
    azimuth = jnp.arctan2(enu[..., 0], enu[..., 1])
    elevation = jnp.arctan2(enu[..., 2], jnp.linalg.norm(enu[..., :2], axis=-1))
    there = seen(sky, t, azimuth, elevation)
    held, taken = slots(there, elevation)
    at = jnp.maximum(held, 0)
    of_slot = lambda a: jnp.take_along_axis(a, at.reshape(*at.shape, *[1] * (a.ndim - 2)), 1)
    valid = of_slot(there) & (held >= 0)
    slow = params.states["range_error"]
    T, tau = t[1] - t[0], slow.tau
    errors = (
        slow.driving_noise * jnp.sqrt(tau / 2) * gauss_markov(normal(key, (t.size, sky.satellites + SLOTS)), T, tau)
    )
    empty = errors[:, sky.satellites :]  # of slots without a satellite so far
    bias, drift = clock(jax.random.fold_in(key, 1), params, t)
    truth = sim.truth._replace(
        errors=sim.truth.errors
        | {
            "receiver_clock_bias": bias[:, None],
            "receiver_clock_drift": drift[:, None],
            "inter_system_bias": jnp.zeros((t.size, 3)),
            "range_error": jnp.where(held >= 0, of_slot(errors), empty),
        }
    )
    cn0 = CN0_HORIZON + (CN0_ZENITH - CN0_HORIZON) * jnp.sin(elevation)
    number = 1.0 + at.astype(float)
    columns = [number[..., None], of_slot(position), of_slot(velocity), of_slot(elevation)[..., None]]
    table = jnp.concatenate([*columns, of_slot(cn0)[..., None], taken[..., None].astype(float)], -1)
    fix = sim.epochs.fix
    fixes = [fix._replace(valid=fix.valid & (valid.sum(1) >= FIX_SATELLITES)[:, None])]
    for i, row in enumerate((PSEUDORANGE, RANGE_RATE)):
        theta = params.measurements[row.name]
        value = expected(row, params, truth, valid, table)
        noise = weight(theta, of_slot(elevation), of_slot(cn0)) * normal(jax.random.fold_in(key, 2 + i), value.shape)
        value = value + noise
        if i == 0:
            value = value + _faults(sky, t, at, of_slot(elevation), elevation[0])
        fixes.append(Fix(value, jnp.ones_like(value), jnp.zeros_like(value), valid))
    fix = jax.tree.map(lambda *a: jnp.concatenate(a, 1), *(f._replace(auxiliary={}) for f in fixes))
    fix = fix._replace(auxiliary=sim.epochs.fix.auxiliary | {row.name: table for row in (PSEUDORANGE, RANGE_RATE)})
    return sim._replace(epochs=sim.epochs._replace(fix=fix), truth=truth)


def _faults(sky: Sky, t: jax.Array, satellite: jax.Array, elevation: jax.Array, first: jax.Array) -> jax.Array:
    """Return what reflections and a fault add to pseudoranges (E, SLOTS) m."""
    reflected = (elevation < 30 * DEG) & (jnp.mod(t, 60.0) < 20.0)[:, None]
    since = t - sky.faulty_from_s
    size = jnp.where(since > 0, sky.fault_m + sky.fault_mps * jnp.where(since > 0, since, 0.0), 0.0)
    faulty = satellite == jnp.argmax(first)
    return jnp.where(reflected, sky.multipath_m, 0.0) + jnp.where(faulty, size[:, None], 0.0)
