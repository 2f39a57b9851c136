"""Pseudoranges and range rates: rows by finite differences, closed forms, the clock's growth, restart and the gate."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav import build, initial_nav
from jaxnav.filters.error_model import error_model
from jaxnav.filters.parameters import datasheet_params
from jaxnav.filters.rule import Innovation
from jaxnav.filters.rules.kalman import kalman
from jaxnav.filters.rules.satellites import THRESHOLD, gate_satellites
from jaxnav.filters.run import run
from jaxnav.maths import earth, rotations
from jaxnav.maths.units import DEG
from jaxnav.measurements import MEASUREMENTS
from jaxnav.measurements.measurement import layout
from jaxnav.measurements.satellites import CONSTELLATION, SATELLITE, SatelliteParams, weight
from jaxnav.states import table
from jaxnav.states.grades import GRADES
from jaxnav.states.receiver_clock import SLOTS
from jaxnav.states.table import BIASES, chosen, zeros
from jaxnav.strapdown.frames import FRAMES
from jaxnav.types import Epoch, Fix, Imu, Nav

ROWS = (MEASUREMENTS["pseudorange"], MEASUREMENTS["range_rate"])
STATES = (*BIASES, "lever_arm_error", "clock_offset", *ROWS[0].needs)
C = 299792458.0


def sky(nav: Nav, n: int = SLOTS, seed: int = 0) -> np.ndarray:
    """Auxiliary values (n, a) of satellites over a place, at 26,600 km and 3.9 km/s."""
    rng = np.random.default_rng(seed)
    azimuth, elevation = 2 * np.pi * np.arange(n) / n, rng.uniform(10, 85, n) * DEG
    u = np.stack([np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)], 1)
    to_ecef = np.asarray(earth.axes(nav.pos[0], nav.pos[1]))
    position = np.asarray(earth.lla_to_ecef(nav.pos)) + 2.2e7 * u @ to_ecef.T
    across = np.cross(position, rng.normal(size=(n, 3)))
    velocity = 3900.0 * across / np.linalg.norm(across, axis=1, keepdims=True)
    number = CONSTELLATION * np.array([0, 3, 4, 5, 1])[np.arange(n) % 5] + 1 + np.arange(n)
    rest = np.stack([elevation, rng.uniform(25, 50, n), np.zeros(n)], 1)
    return np.column_stack([number, position, velocity, rest])


def fix_of(value, auxiliary, valid=None, m=2 * SLOTS) -> Fix:
    valid = jnp.ones(m, bool) if valid is None else jnp.asarray(valid)
    table = jnp.asarray(auxiliary)
    return Fix(jnp.asarray(value), jnp.ones(m), jnp.zeros(m), valid, {row.name: table for row in ROWS})


def difference(model, estimate: Nav, truth: Nav) -> jax.Array:
    """x with truth = retract(estimate, x), local level."""
    estimate, truth = (
        model.report(n, jnp.zeros(model.n_states), jnp.eye(model.n_states))[0] for n in (estimate, truth)
    )
    phi = rotations.log(rotations.multiply(estimate.q, rotations.conjugate(truth.q)))
    own = [estimate.errors[name] - truth.errors[name] for name in STATES]
    dp = earth.enu_difference(estimate.pos, truth.pos)
    return jnp.concatenate([dp, estimate.vel - truth.vel, phi, *own])


#: latitude, velocity m/s, roll deg, body rate rad/s, specific force m/s^2
PLACES = {
    "rest": (48.0, (0.0, 0.0, 0.0), 0.0, (0.0, 0.0, 0.0), (0.0, 0.0, -9.8)),
    "turn": (48.0, (20.0, -10.0, 0.0), 0.0, (0.0, 0.0, 0.5), (1.0, 11.0, -9.8)),
    "pole": (89.9, (60.0, -45.0, 5.0), 5.0, (0.1, 0.05, -0.2), (1.0, -2.0, -9.8)),
    "bank": (-35.0, (150.0, 90.0, 5.0), 50.0, (0.05, 0.1, 0.1), (1.0, -2.0, -15.0)),
}
STEP, DT = 20, 0.01  # samples between the measurement and the end of the epoch, s


@cache
def program(frame: str):
    """(nav, samples, age) -> found and true derivative by the error at the start, (m, n) each, and their steps."""
    model, propagate = error_model(frame, STATES, measurements=ROWS), FRAMES[frame].propagate
    h = np.concatenate([np.repeat([1.0, 0.1, 1e-3], 3), [1e-3] * 3, [1e-2] * 3, [0.1] * 3, [1e-3], np.ones(5 + SLOTS)])
    params = datasheet_params(GRADES["consumer"], states=STATES)
    params = params._replace(mounting=params.mounting._replace(lever_arm=jnp.array([1.0, -2.0, -1.5])))
    last = lambda past: jax.tree.map(lambda a: a[-1], past)
    halved = lambda a: (a[h.size :] - a[: h.size]).T / (2 * h)

    def navigate(nav, imu, x):
        start = model.retract(model.enter(nav._replace(errors=zeros(STATES))), x)
        end = propagate(start, None, imu, 1, jnp.arange(STEP))[0]
        # the clock's bias at the end is not that at the start; a filter holds its estimate over the samples before
        bias = end.errors["receiver_clock_bias"] + end.errors["receiver_clock_drift"] * DT * STEP
        return end._replace(errors=end.errors | {"receiver_clock_bias": bias})

    @jax.jit
    def both(nav, imu, fix, age):
        late = {row.name: params.measurements[row.name]._replace(latency=age) for row in ROWS}
        observe = lambda past: model.observe(params._replace(measurements=late), past, fix)[:2]
        end = navigate(nav, imu, jnp.zeros(h.size))
        moved = jax.lax.map(lambda x: navigate(nav, imu, x), jnp.concatenate([np.diag(h), -np.diag(h)]))
        J = jax.jacfwd(lambda x: model.report(last(end), x, jnp.eye(h.size))[1])(jnp.zeros(h.size))
        ends = jax.lax.map(lambda past: difference(model, last(end), last(past)), moved)
        x = jnp.linalg.solve(J, -halved(ends))
        return observe(end)[1] @ x, halved(jax.lax.map(lambda past: observe(past)[0], moved))

    return both, h


@pytest.mark.full
@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("frame", FRAMES)
def test_rows_are_derivatives(frame, place):
    """d y / d(error at the start) = H d(error at the end) / d(error at the start), at once and by an age."""
    lat, vel, roll, omega, force = PLACES[place]
    both, h = program(frame)
    nav = initial_nav([lat * DEG, -1.3, 900.0], vel, [roll * DEG, 0.1, 2.0], azimuth=0.3)
    imu = Imu(jnp.full(STEP, DT), jnp.tile(jnp.array(omega), (STEP, 1)), jnp.tile(jnp.array(force), (STEP, 1)))
    fix = fix_of(np.full(2 * SLOTS, 2.2e7), sky(nav))
    at_once = {"pseudorange": 1e-4, "range_rate": 1e-3}
    for age, floor in ((0.0, 1e-4), (0.12, 1e-2)):
        found, true = (np.asarray(a) for a in both(nav, imu, fix, jnp.asarray(age)))
        for name, channels in layout(ROWS).items():
            error, effect = (np.abs(a[channels] * h).max(0) for a in (found - true, true))
            worst = error / np.maximum(effect, floor * effect.max())
            assert worst.max() < (0.02 if age else at_once[name]), (name, age, worst.argmax(), worst.max())
        assert np.abs(true[:, 9:]).max(0).all() or place == "rest"


@pytest.mark.full
def test_a_range_is_distance_clock_and_slow_error():
    nav = initial_nav([0.8, 0.1, 100.0], [8.0, -3.0, 1.0], [0.1, 0.0, 2.0])
    there = sky(nav)
    off = there[:, 1:4] - np.asarray(earth.lla_to_ecef(nav.pos))
    distance = np.linalg.norm(off, axis=1)
    velocity = np.asarray(earth.axes(nav.pos[0], nav.pos[1])) @ np.asarray(nav.vel)
    rate = np.sum(off / distance[:, None] * (there[:, 4:7] - velocity), 1)
    errors = {"receiver_clock_bias": [7.0], "receiver_clock_drift": [0.3], "inter_system_bias": [1.0, 2.0, 3.0],
              "range_error": np.arange(SLOTS)}  # fmt: skip
    more = np.array([0.0, 1.0, 2.0, 3.0, 0.0])[np.arange(SLOTS) % 5]  # of GPS, Galileo, BeiDou, GLONASS, QZSS
    nav = nav._replace(errors={k: jnp.asarray(v, float) for k, v in errors.items()})
    model = error_model("local_level", ROWS[0].needs, measurements=ROWS)
    params = datasheet_params(GRADES["consumer"], states=ROWS[0].needs)
    past = jax.tree.map(lambda a: jnp.stack([a, a]), nav)
    value = np.concatenate([distance + 7.0 + more + np.arange(SLOTS), rate + 0.3])
    y, _, R = model.observe(params, past, fix_of(value, there))
    np.testing.assert_allclose(y, 0.0, atol=1e-6)
    sd = weight(params.measurements["pseudorange"], there[:, 7], there[:, 8])
    np.testing.assert_allclose(np.sqrt(np.diag(R))[:SLOTS], sd)
    one = SatelliteParams(1.0, 0.5, 20.0, 0.0)
    assert float(weight(one, 90 * DEG, 25.0)) == pytest.approx(10 * np.hypot(1.0, 0.5))


@pytest.mark.full
def test_a_clock_bias_grows_by_its_drift():
    """Phi, Q and d of bias and drift over an epoch against the closed form of a twice integrated white noise."""
    names = ("receiver_clock_bias", "receiver_clock_drift")
    model = error_model("local_level", names, measurements=ROWS)
    params = datasheet_params(GRADES["consumer"], states=names)
    nav = initial_nav([0.8, 0.1, 100.0])._replace(errors={names[0]: jnp.ones(1), names[1]: jnp.full(1, 0.7)})
    filt = build("ekf9", ROWS, states=())
    T, k = 0.5, 10
    imu = Imu(jnp.full(k, T / k), jnp.zeros((k, 3)), jnp.tile(jnp.array([0, 0, -9.8]), (k, 1)))
    assert filt.model.states == (*names, "inter_system_bias", "range_error")
    _, points = FRAMES["local_level"].propagate(nav, None, imu, 1)
    Phi, Q, d = model.discretize(params, points, imu.dt, None)
    np.testing.assert_allclose(Phi[9:, 9:], [[1.0, T], [0.0, 1.0]], atol=1e-12)
    np.testing.assert_allclose(d[9:], [-0.7 * T, 0.0], atol=1e-12)
    b, f = (float(params.states[name].driving_noise) ** 2 for name in names)
    exact = [[b * T + f * T**3 / 3, f * T**2 / 2], [f * T**2 / 2, f * T]]
    np.testing.assert_allclose(Q[9:, 9:], exact, rtol=1e-12)


def epochs_of(nav: Nav, E: int, auxiliary: np.ndarray, value: np.ndarray, valid: np.ndarray) -> Epoch:
    """At rest, one fix of satellites every 0.2 s; auxiliary (E, s, a)."""
    k = 2
    force = -np.array([0.0, 0.0, float(earth.gravity(nav.pos[0], nav.pos[2]))])
    imu = Imu(jnp.full((E, k), 0.1), jnp.zeros((E, k, 3)), jnp.asarray(np.tile(force, (E, k, 1))))
    m = value.shape[1]
    table = jnp.asarray(auxiliary)
    fix = Fix(jnp.asarray(value), jnp.ones((E, m)), jnp.zeros((E, m)), jnp.asarray(valid), {
        "pseudorange": table, "range_rate": table,
    })  # fmt: skip
    return Epoch(imu, fix)


def at_rest(E: int = 30, seed: int = 3):
    """Epochs of a standing receiver with a clock; pseudoranges with 1 m of noise."""
    rng = np.random.default_rng(seed)
    nav = initial_nav([0.8, 0.1, 100.0])
    there = np.tile(sky(nav, seed=seed), (E, 1, 1))
    there[..., 4:7] = 0.0
    distance = np.linalg.norm(there[0, :, 1:4] - np.asarray(earth.lla_to_ecef(nav.pos)), axis=1)
    clock = 5.0 + 0.5 * 0.2 * np.arange(1, E + 1)
    spread = np.asarray(weight(SatelliteParams(1.0, 0.5, 20.0, 0.0), there[0, :, 7], there[0, :, 8]))
    ranges = distance + clock[:, None] + spread * rng.normal(size=(E, SLOTS))
    rates = 0.5 + 0.05 * spread * rng.normal(size=(E, SLOTS))
    return nav, there, np.concatenate([ranges, rates], 1), np.ones((E, 2 * SLOTS), bool)


@cache
def solver():
    filt = build("ekf15", ROWS)
    return filt, jax.jit(partial(run, filt))


@pytest.mark.full
def test_a_new_satellite_starts_its_error_anew():
    nav, there, value, valid = at_rest()
    filt, solve = solver()
    params = filt.params("consumer")
    place = table.layout(chosen(filt.model.states))["range_error"]
    i = place.start + 4
    plain = solve(params, nav, epochs_of(nav, 30, there, value, valid))
    there[20, 4, SATELLITE.index("restart")] = 1.0
    epochs = epochs_of(nav, 30, there, value, valid)
    other = solve(params, nav, epochs)
    np.testing.assert_array_equal(plain.P[:20], other.P[:20])
    np.testing.assert_array_equal(plain.nav.errors["range_error"][:20], other.nav.errors["range_error"][:20])
    assert float(plain.P[20, i, i]) < float(other.P[20, i, i]) and bool(other.ok.all())
    # predicted: an estimate of zero with the prior's sd, independent of all others
    states, _ = jax.lax.scan(partial(filt.step, params), filt.init(params, nav), jax.tree.map(lambda a: a[:20], epochs))
    step = jax.jit(filt.advance)(params, states, jax.tree.map(lambda a: a[20], epochs))
    row = np.zeros(filt.model.n_states)
    slow = params.states["range_error"]
    row[i] = float(slow.driving_noise) ** 2 * float(slow.tau) / 2  # as of a process that has run for long
    np.testing.assert_allclose(step.predicted.P[i], row, atol=1e-12)
    assert not np.asarray(step.predicted.past.errors["range_error"])[:, 4].any()
    assert np.asarray(step.predicted.past.errors["range_error"])[:, 3].all()
    assert not float(step.predicted.x[i]) and float(step.predicted.x[i - 1])
    # the transition says the same, so that a smoother goes back over it
    Phi, Q, _ = step.transition
    np.testing.assert_allclose(Phi @ step.before.P @ Phi.T + Q, step.predicted.P, atol=1e-9)
    one = jax.tree.map(lambda a: a[20], epochs)
    streamed, _ = jax.jit(filt.correct)(params, filt.predict(params, states, one.imu), one.fix)
    np.testing.assert_allclose(streamed.P, step.after.P, rtol=1e-9, atol=1e-12)


@pytest.mark.full
def test_a_hole_in_the_sky_leaves_a_filter_finite_and_satellites_one_by_one_count():
    nav, there, value, valid = at_rest()
    filt, solve = solver()
    params = filt.params("consumer")
    value = np.where(valid, value, np.nan)
    valid[10:20] = False
    valid[10:20, :3] = True  # three satellites
    value[~valid] = np.nan
    found = solve(params, nav, epochs_of(nav, 30, there, value, valid))
    assert bool(found.ok.all()) and np.isfinite(found.nis).all()
    assert np.asarray(found.valid).sum(1).tolist() == valid.sum(1).tolist()
    slope = jax.grad(lambda p: jnp.sum(run(filt, p, nav, epochs_of(nav, 30, there, value, valid)).nis))(params)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slope))
    assert float(slope.measurements["pseudorange"].floor_sd) != 0 and float(slope.states["range_error"].sd) != 0


def test_one_faulty_satellite_is_left_out_for_as_long_as_it_lasts():
    nav, there, value, valid = at_rest(E=50)
    filt, solve = solver()
    params = filt.params("consumer")
    value[5:, 2] += 100.0
    found = solve(params, nav, epochs_of(nav, 50, there, value, valid))
    assert not np.asarray(found.used)[5:, 2].any()
    others = np.delete(np.asarray(found.used)[:, :SLOTS], 2, axis=1)
    assert others.mean() > 0.98
    assert np.abs(np.asarray(earth.enu_path(np.asarray(found.nav.pos), np.asarray(nav.pos)))[-1, :2]).max() < 3.0


def innovation(nu, P, R, T=0.3) -> Innovation:
    m = len(nu)
    return Innovation(jnp.asarray(nu), jnp.eye(m), jnp.diag(jnp.asarray(R)), jnp.asarray(P), jnp.ones(m, bool),
                      jnp.asarray(T), jnp.zeros(m))  # fmt: skip


def test_mostly_rejected_satellites_are_a_wrong_filter():
    rule = gate_satellites(kalman(), (0, 1, 2, 3))
    memory = rule.init(4, 4)
    nu = np.array([30.0, 20.0, 40.0, 0.1])
    for _ in range(3):
        c = rule.correct((), memory, innovation(nu, 0.01 * np.eye(4), np.ones(4)))
        assert np.asarray(c.used).tolist() == [False, False, False, True]
        memory = c.memory
    c = rule.correct((), memory, innovation(nu, 0.01 * np.eye(4), np.ones(4)))  # after 1.2 s
    assert np.asarray(c.used).all() and np.abs(np.asarray(c.delta)[:3]).min() > 10.0
    assert float(c.memory.rejected) == 0.0
    few = innovation(nu[:1], 0.01 * np.eye(1), np.ones(1))
    one = gate_satellites(kalman(), (0,))
    state = one.init(1, 1)
    for _ in range(10):  # a single satellite outvotes nobody
        c = one.correct((), state, few)
        state = c.memory
    assert not bool(c.used.any())
    assert pytest.approx(10.83, abs=0.01) == THRESHOLD


def test_papers_filters_take_no_satellites():
    with pytest.raises(ValueError, match="has the states of its paper"):
        build("gpid15", ("position", "velocity", "pseudorange"))
    with pytest.raises(ValueError, match="the rule is for fixes"):
        build("ekf15_huber", ("pseudorange",))


def test_the_likelihood_gives_a_rejected_satellite_a_tail_of_its_own():
    """Its value by the parts, its score by finite differences, and the others as if it were not there."""
    from jaxnav.filters.run import gated_nll, negative_log_likelihood, student_nll
    from jaxnav.types import Info
    from tuning.recordings.evidence import gated_terms

    rng = np.random.default_rng(4)
    m, alone = 5, np.array([False, False, True, True, True])
    root = rng.normal(size=(2, m, m))
    nu, S = jnp.asarray(rng.normal(size=m) + [0, 0, 0, 30.0, 0]), jnp.asarray(root[0] @ root[0].T + np.eye(m))
    valid, used = jnp.array([1, 1, 1, 1, 0], bool), jnp.array([1, 1, 1, 0, 0], bool)
    nu, S = jnp.where(valid, nu, 0.0), jnp.where(valid[:, None] & valid, S, jnp.eye(m))

    def info_of(nu, S, valid, used):
        blank = dict.fromkeys(Info._fields)
        nis = nu @ jnp.linalg.solve(S, nu)
        return Info(**(blank | {"nu": nu, "S": S, "valid": valid, "used": used, "nis": nis,
                               "log_det": jnp.linalg.slogdet(S)[1]}))  # fmt: skip

    found = gated_nll(info_of(nu, S, valid, used), alone)
    kept = jnp.array([0, 1, 2])
    rest = info_of(nu[kept], S[jnp.ix_(kept, kept)], valid[kept], used[kept])
    tail = student_nll(nu[3] ** 2 / S[3, 3], jnp.asarray(1), 1) + 0.5 * jnp.log(S[3, 3])
    np.testing.assert_allclose(found, negative_log_likelihood(rest) + tail, rtol=1e-12)
    dnu, dS = jnp.asarray(rng.normal(size=(1, m))), jnp.asarray(root[1] + root[1].T)[None]
    dnu, dS = jnp.where(valid, dnu, 0.0), jnp.where(valid[:, None] & valid, dS, 0.0)
    one = (np.asarray(a)[None] for a in (nu, S, valid, used, dnu, dS))
    value, score, fisher = (a[0] for a in gated_terms(*one, alone))
    np.testing.assert_allclose(value, found, rtol=1e-12)
    step = 1e-6
    moved = lambda h: gated_nll(info_of(nu + h * dnu[0], S + h * dS[0], valid, used), alone)
    np.testing.assert_allclose(score[0], (moved(step) - moved(-step)) / (2 * step), rtol=1e-6)
    assert float(fisher[0, 0]) > 0


def test_fixes_of_the_same_signals_are_compared_alone():
    compared = lambda *names: np.flatnonzero(build("ekf15", names).model.compared).tolist()
    assert compared("position", "velocity", "pseudorange") == [0, 1, 2]
    assert compared("position", "velocity", "range_rate") == [3, 4, 5]
    assert compared("position", "velocity", "pseudorange", "range_rate") == list(range(6))
    assert compared("position", "velocity") == []
