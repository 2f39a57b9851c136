"""What every row of STATES and MEASUREMENTS owes every frame: the tables are iterated, nothing is named here.

Those of satellites, which need auxiliary values: tests/measurements/test_satellites.py.
"""

from functools import cache, partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav import FILTERS, GNSS, MEASUREMENTS, STATES, build
from jaxnav.filters.border import KEYS, NAMES
from jaxnav.filters.error_model import error_model
from jaxnav.filters.parameters import UNITS, datasheet_params
from jaxnav.filters.run import initial_nav, negative_log_likelihood, run
from jaxnav.maths import earth, rotations
from jaxnav.measurements.measurement import Kinematics, layout, value_channels
from jaxnav.simulate.scenarios import SCENARIOS
from jaxnav.simulate.simulation import matched_params, simulate_jit
from jaxnav.states.grades import GRADES
from jaxnav.states.state import Reading
from jaxnav.states.table import BIASES, chosen, zeros
from jaxnav.strapdown.frames import FRAMES
from jaxnav.types import Epoch, Fix, Imu, Nav, Params

ALL = tuple(each for each in MEASUREMENTS.values() if not each.auxiliary)
OF_SATELLITES = {name for each in MEASUREMENTS.values() for name in each.needs}
MORE = tuple(name for name in STATES if name not in {*BIASES, *OF_SATELLITES})
EVERY = (*BIASES, *MORE)
#: errors as of a fix: their third order is negligible and their first stands clear of rounding in latitude
MOTION_SIZES = np.repeat([3.0, 0.3, 1e-3], 3)
EPOCHS = 12
GAP, PUSH = 0.1, np.array([3.0, -2.0, 0.5])  # s and m/s^2 between two samples of the past


def sizes(names=EVERY) -> np.ndarray:
    """Of every state one that is a hundredth of its default sd."""
    own = [np.full(s.size, 0.01 * np.max(s.defaults.sd)) for s in chosen(names)]
    return np.concatenate([MOTION_SIZES, *own])


@pytest.fixture(scope="module")
def drive():
    """Some epochs of a drive in town; the truth has every error of the sensors."""
    scenario = SCENARIOS["urban_short"]
    sim = simulate_jit(jax.random.key(5), scenario)
    cut = lambda tree: jax.tree.map(lambda a: a[20 : 20 + EPOCHS], tree)
    start = jax.tree.map(lambda a: a[19], sim.truth)
    return scenario, start._replace(errors={}), cut(sim.epochs)


def wider(epochs: Epoch, measurements=ALL) -> Epoch:
    """The same epochs with the channels of all measurements, of which the further ones are never there."""
    m = sum(each.size for each in measurements) - 6
    pad = lambda a, v: jnp.concatenate([a, jnp.full((a.shape[0], m), v, a.dtype)], axis=1)
    f = epochs.fix
    return epochs._replace(fix=Fix(pad(f.value, 0.0), pad(f.sd, 1.0), pad(f.corr, 0.0), pad(f.valid, False)))


@cache
def program(frame: str, states=(), measurements=GNSS):
    filt = build("ekf15", measurements, cov_stride=5, frame=frame, states=states)
    return filt, jax.jit(partial(run, filt))


def silent(params: Params) -> Params:
    """Further states that are known to be zero."""
    still = {
        name: p._replace(sd=jnp.zeros(()), driving_noise=jnp.zeros(()))
        for name, p in params.states.items()
        if name in MORE
    }
    return params._replace(states=params.states | still)


def close(a, b, rtol) -> None:
    a, b = np.asarray(a), np.asarray(b)
    np.testing.assert_allclose(a, b, rtol=0, atol=rtol * max(np.abs(b).max(), 1e-300))


@pytest.mark.full
@pytest.mark.parametrize("frame", FRAMES)
def test_states_that_are_zero_and_channels_that_are_not_there_change_nothing(frame, drive):
    scenario, start, epochs = drive
    own = matched_params(scenario)
    filt, solve = program(frame, MORE, ALL)
    params = filt.params(scenario.imu.grade)
    known = own._replace(states=silent(params).states | own.states, measurements=params.measurements | own.measurements)
    plain, full = program(frame)[1](own, start, epochs), solve(known, start, wider(epochs))
    for name in ("pos", "vel", "q"):
        close(getattr(full.nav, name), getattr(plain.nav, name), 1e-12)
    close(full.P[:, :15, :15], plain.P, 1e-12)
    close(full.nu[:, :6], plain.nu, 1e-12)
    close(full.nis, plain.nis, 1e-12)
    assert not np.asarray(full.P[:, 15:]).any() and not np.asarray(full.nu[:, 6:]).any()


@pytest.mark.full
@pytest.mark.parametrize(
    "frame", [name if name == "local_level" else pytest.param(name, marks=pytest.mark.slow) for name in FRAMES]
)
def test_gradients_are_finite_and_values_do_not_compile_again(frame, drive):
    """Those of every epoch with respect to the parameters and to the state before it: of all that it leaves behind."""
    scenario, start, epochs = drive
    chex.clear_trace_counter()
    filt = program(frame, MORE, ALL)[0]
    params = filt.params(scenario.imu.grade)
    epochs = wider(epochs)

    floats = lambda tree: [leaf for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    total = lambda tree: sum(jnp.sum(leaf) for leaf in floats(tree))

    @jax.jit
    @chex.assert_max_traces(1)
    def slope(params, state, epoch):
        def left(params, state):
            step = filt.advance(params, state, epoch)
            return negative_log_likelihood(step.info) + total(step.after), step.after

        return jax.grad(left, (0, 1), has_aux=True, allow_int=True)(params, state)

    for factor in (1.0, 1.3):
        scaled = jax.tree.map(lambda a, f=factor: f * a, params)
        state = jax.tree.map(jnp.asarray, filt.init(scaled, start))
        for i in range(EPOCHS):
            found, state = slope(scaled, state, jax.tree.map(lambda a, i=i: a[i], epochs))
            assert all(np.isfinite(leaf).all() for leaf in floats(found))
    begin = jax.jit(jax.grad(lambda params: total(filt.init(params, start))))(params)
    assert all(np.isfinite(leaf).all() for leaf in floats(begin))
    for name, place in layout_of().items():
        seen = STATES[name].enters is not None
        assert not seen or np.diag(found[1].P)[place].any()  # what enters a sensor matters


def a_nav(seed: int = 0) -> Nav:
    rng = np.random.default_rng(seed)
    nav = initial_nav([0.8, -1.3, 900.0], [60.0, -45.0, 5.0], [0.2, -0.3, 2.0], t=3.0, azimuth=0.3)
    draw = lambda scale: jnp.asarray(rng.normal(size=3) * scale)
    return nav._replace(omega=draw(0.1), force=draw(1.0) - jnp.array([0, 0, 9.8]), errors=zeros(EVERY))


def an_imu(k: int, T: float) -> Imu:
    rng = np.random.default_rng(1)
    gyro, accel = np.tile(rng.normal(size=3) * 0.1, (k, 1)), np.tile(rng.normal(size=3) * 2 - [0, 0, 9.8], (k, 1))
    return Imu(jnp.full(k, T / k), jnp.asarray(gyro), jnp.asarray(accel))


def difference(model, estimate: Nav, truth: Nav) -> jax.Array:
    """x with truth = retract(estimate, x), in local level: the inverse of `retract`, written out."""
    estimate, truth = (
        model.report(n, jnp.zeros(model.n_states), jnp.eye(model.n_states))[0] for n in (estimate, truth)
    )
    phi = rotations.log(rotations.multiply(estimate.q, rotations.conjugate(truth.q)))
    dp = earth.enu_difference(estimate.pos, truth.pos)
    optional = [estimate.errors[name] - truth.errors[name] for name in EVERY]
    return jnp.concatenate([dp, estimate.vel - truth.vel, phi, *optional])


@pytest.mark.full
@pytest.mark.parametrize("stride, bound", [(1, 1e-4), (10, 1e-2)])
@pytest.mark.parametrize(
    "frame, form",
    [(frame, form) for frame, home in FRAMES.items() for form in ("propagate", "fast") if getattr(home, form)],
)
def test_the_transition_is_the_derivative_of_the_mechanization(frame, form, stride, bound):
    model, propagate = error_model(frame, EVERY, measurements=ALL), getattr(FRAMES[frame], form)
    params, imu = datasheet_params(GRADES["consumer"], states=EVERY), an_imu(10, 0.1)
    # what is forgotten goes by the transition alone: the mechanization holds every estimate
    lasting = {name: p._replace(tau=jnp.full_like(p.tau, jnp.inf)) for name, p in params.states.items()}
    params = params._replace(states=lasting)
    h = sizes()

    @jax.jit
    def columns(nav):
        nav = model.enter(nav)
        end, path = propagate(nav, None, imu, stride)
        Phi = model.discretize(params, path, imu.dt.reshape(-1, stride).sum(1), None)[0]

        def ends(x):
            return propagate(model.retract(nav, x), None, imu, stride)[0]

        def column(e):
            return (difference(model, end, ends(h * e)) - difference(model, end, ends(-h * e))) / (2 * h @ e)

        J = jax.jacfwd(lambda x: model.report(end, x, jnp.eye(h.size))[1])(jnp.zeros(h.size))
        return Phi, J, jax.lax.map(column, jnp.eye(h.size)).T

    Phi, J, exact = (np.asarray(a) for a in columns(a_nav()))
    # each column against its own size, in units of the sizes of error
    D = h / h[:, None]
    error, change = np.abs((J @ Phi - exact) * D).max(0), np.abs(exact * D).max(0)
    worst = dict(zip(range(h.size), error / change, strict=True))
    assert max(worst.values()) < bound, worst
    moved = np.abs(exact[:6, 9:]).max(0)
    for name, s in layout_of().items():
        assert STATES[name].enters is None or moved[s.start - 9 : s.stop - 9].max() > 0, name  # each does something


def layout_of() -> dict[str, slice]:
    from jaxnav.states import table

    return table.layout(chosen(EVERY))


@pytest.mark.parametrize("frame", FRAMES)
def test_retract_and_observe_are_derivatives(frame):
    """The residual of the estimate minus that of the truth is H x; retract takes out what a difference measures."""
    model = error_model(frame, EVERY, measurements=ALL)
    params, h = datasheet_params(GRADES["consumer"], states=EVERY), sizes()
    params = params._replace(mounting=params.mounting._replace(
        lever_arm=jnp.array([1.0, -2.0, -1.5]), vehicle=jnp.array([0.03, -0.05]), wheel_arm=jnp.array([-1.0, 0.7, 1.2])
    ))  # fmt: skip
    rng = np.random.default_rng(8)
    m = model.n_channels
    places = layout(ALL)
    value = rng.normal(size=m)

    @jax.jit
    def both(nav, x0):
        value_ = jnp.asarray(value).at[places["position"]].set(nav.pos)
        before = nav._replace(t=nav.t - GAP, pos=earth.move(nav.pos, -GAP * nav.vel), vel=nav.vel - GAP * PUSH)
        past = jax.tree.map(lambda a, b: jnp.stack([a, b]), model.enter(before), model.enter(nav))
        nav = model.enter(nav)
        fix = Fix(value_, jnp.full(m, 0.5), jnp.zeros(m), jnp.ones(m, bool))

        def seen(x):
            """Every sample of the past without the error x: what the sensors read is what it is."""
            moved = jax.vmap(lambda nav: model.retract(nav, x))(past)
            one = jax.tree.map(lambda a: a[-1], past)
            readings = {"gyro": one.omega, "accel": one.force}
            for state in chosen(EVERY):
                if state.enters:
                    w = readings[state.enters]
                    M = (
                        jnp.eye(3)
                        if state.effect is None
                        else state.effect(Reading(w, {"gyro": one.force, "accel": one.omega}[state.enters]))
                    )
                    place = layout_of()[state.name]
                    readings[state.enters] = w + M @ x[place]
            both = lambda w: jnp.stack([w, w])
            moved = moved._replace(omega=both(readings["gyro"]), force=both(readings["accel"]))
            return model.observe(params, moved, fix)[0]

        y, H, R = model.observe(params, past, fix)
        fine = 1e-3 * h
        J = jax.lax.map(lambda e: (seen(-fine * e) - seen(fine * e)) / (2 * fine @ e), jnp.eye(h.size)).T
        back = difference(model, nav, model.retract(nav, x0))
        K = jax.jacfwd(lambda x: model.report(nav, x, jnp.eye(h.size))[1])(jnp.zeros(h.size))
        return H, J, back, K @ x0, R

    x0 = jnp.asarray(0.01 * h * rng.normal(size=h.size))
    H, J, back, x0_enu, R = (np.asarray(a) for a in both(a_nav(6), x0))
    np.testing.assert_allclose(back / h, x0_enu / h, rtol=0, atol=1e-5)
    assert np.linalg.eigvalsh(R).min() > 0
    for name, place in places.items():
        error, size = np.abs((H - J)[place] * h).max(), np.abs(J[place] * h).max()
        assert error <= 1e-6 * size, (name, error / size)
    for name in EVERY:
        seen = any(name in each.states for each in ALL) or STATES[name].enters == "gyro"
        assert not seen or np.abs(H[:, layout_of()[name]]).max() > 0, name


@pytest.mark.full
@pytest.mark.parametrize("row", ALL, ids=lambda row: row.name)
def test_an_entry_of_a_value_is_shown_by_its_channel(row):
    """d y / d value has one entry a row: in the channel that `Measurement.shows` names, the same one without it."""
    params, size = datasheet_params(GRADES["consumer"]), row.size
    nav = initial_nav([0.8, -1.3, 900.0], [8.0, -3.0, 1.0], np.array([0.2, -0.1, 1.0]))
    kin = Kinematics(nav.pos, nav.vel, rotations.to_dcm(nav.q))
    value = nav.pos if row.name == "position" else jnp.full(size, 0.3)
    fix = lambda value: Fix(value, jnp.ones(size), jnp.zeros(size), jnp.ones(size, bool))
    y = lambda value: row.observe(params.measurements[row.name], params.mounting, nav, kin, fix(value)).y
    seen = np.abs(np.asarray(jax.jacfwd(y)(value))).T > 0  # (entry, channel)
    shows = np.eye(size, dtype=bool)[value_channels([row])]
    assert seen.any() or not row.has_data
    np.testing.assert_array_equal(seen, shows & seen.any())  # some constraints have no value


def test_a_misspelt_name_is_an_error_that_names_the_nearest():
    for call, near in (
        (lambda: build("ekf51"), "ekf15"),
        (lambda: build("ekf15", states=("gyro_scal",)), "did you mean gyro_scale"),
        (lambda: build("ekf15", ("position", "velocty")), "did you mean velocity"),
        (lambda: build("ekf15").params("consumr"), "did you mean consumer"),
        (lambda: build("gpid", states=("gyro_scale",)), "has the states of its paper"),
        (lambda: build("ekf15", states=("gyro_bias",)), "comes twice"),
        (lambda: build("ekf15", ("position", "position")), "comes twice"),
    ):
        with pytest.raises(ValueError, match=near):
            call()


def test_every_row_says_what_it_is():
    for name, state in STATES.items():
        assert state.name == name and state.size == len(state.axes) >= 1
        assert state.enters in ("gyro", "accel", None)
        assert state.effect is None or state.effect(Reading(jnp.ones((4, 3)), jnp.ones((4, 3)))).shape == (
            4,
            3,
            state.size,
        )
        assert all(unit.suffix for unit in state.units)
    for name, each in MEASUREMENTS.items():
        assert each.name == name and each.size == len(each.channels)
        assert type(each.units) is type(each.defaults)
        assert set(each.states) <= set(STATES)
        # what has a logarithm is freed as noise: it must be one
        assert all(leaf.endswith(("sd", "sd_scale", "scale")) for leaf, unit in each.units._asdict().items()
                   if unit.step is None), name  # fmt: skip
    assert len(KEYS) == len(NAMES) == len(UNITS)
    assert {e.accepts_extra_states for e in FILTERS.values()} == {True, False}
