"""Adapters: rows by a contract, in three frames; runs, smoother, stream and gradients go through them."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from jaxnav import build
from jaxnav.filters.adapters import ADAPTERS
from jaxnav.filters.adapters.adapter import Adapted, Adapter, Window, constrained, times
from jaxnav.filters.adapters.mlp_noise import features
from jaxnav.filters.adapters.window_constraints import DILATIONS, SD, convolved, latest
from jaxnav.filters.catalogue import changed, rows
from jaxnav.filters.epochs import hide, pack
from jaxnav.filters.parameters import change
from jaxnav.filters.run import prepare, run, run_jit
from jaxnav.filters.smoother import smooth_jit
from jaxnav.initialization.initialize import Initialization
from jaxnav.strapdown.frames import FRAMES
from jaxnav.stream import Stream
from jaxnav.types import Epoch, Fix, Imu
from tests.conftest import all_finite, leaves_equal
from tests.test_stream import feed

NAMES = ("position", "velocity", "nonholonomic")
CHOSEN = rows(NAMES)
EPOCHS = 12


@pytest.fixture(scope="module")
def epochs(case) -> Epoch:
    """Twelve epochs of a second, the fourth and fifth without a fix."""
    packed = pack(case.imu, case.aiding, 1.0, CHOSEN)
    first = jax.tree.map(lambda a: a[:EPOCHS], packed.epochs)
    return hide(first, np.isin(np.arange(EPOCHS), (3, 4)), CHOSEN)


def moved(theta, size: float = 0.3):
    """Return parameters of an adapter that are not zero, each another one."""
    leaves, tree = jax.tree.flatten(theta)
    rng = np.random.default_rng(1)
    return jax.tree.unflatten(tree, [a + size * jnp.asarray(rng.normal(size=a.shape)) for a in leaves])


def filter_of(adapter, frame: str = "local_level", stride: int = 5):
    return build("ekf15", NAMES, stride, frame=frame, adapter=adapter)


def constant(factor=1.0, noise=1.0) -> Adapter:
    """Return an adapter of one factor on all sd and of one on the noise."""
    return Adapter(lambda theta, memory, window: (memory, Adapted(times(window.fix, factor), noise)), lambda: ())


@pytest.mark.full
@pytest.mark.parametrize("name", ADAPTERS)
def test_an_adapter_of_the_table(case, epochs, name):
    """It is finite with its own parameters and with others, and these matter; shapes are checked."""
    filt = filter_of(name)
    params = filt.params("consumer")
    first = run_jit(filt, params, case.nav, epochs)
    other = run_jit(filt, params._replace(adapter=moved(params.adapter)), case.nav, epochs)
    assert all_finite(first) and bool(first.ok.all()) and bool(other.ok.all())
    assert float(jnp.abs(first.nav.pos - other.nav.pos).max()) > 1e-9
    with pytest.raises(ValueError, match="params.adapter is tuple"):
        run_jit(filt, params._replace(adapter=()), case.nav, epochs)
    wrong = jax.tree.map(lambda a: jnp.zeros((*a.shape, 2)), params.adapter)
    with pytest.raises(ValueError, match=r"params.adapter.*has shape"):
        run_jit(filt, params._replace(adapter=wrong), case.nav, epochs)


def test_names_of_adapters_are_checked():
    with pytest.raises(ValueError, match="no adapter 'mlp_nois': did you mean mlp_noise"):
        build("ekf15", adapter="mlp_nois")
    with pytest.raises(ValueError, match="window_constraints needs the measurement nonholonomic"):
        build("ekf15", adapter="window_constraints")


@pytest.mark.full
def test_an_untrained_network_is_the_plain_filter(case, epochs):
    plain, learned = filter_of(""), filter_of("mlp_noise")
    params = learned.params("consumer")
    expected = run_jit(plain, params._replace(adapter=()), case.nav, epochs)
    leaves_equal(run_jit(learned, params, case.nav, epochs), expected, rtol=1e-12, atol=1e-12)


def test_untrained_constraints_are_those_of_a_constant_sd(case, epochs):
    """The same as nonholonomic in every epoch, with the sd of the paper."""
    plain, learned = filter_of(""), filter_of("window_constraints")
    params = learned.params("consumer")
    at = slice(6, 8)
    fix = jax.vmap(lambda fix: constrained(fix, at, 0.0, jnp.array(SD)))(epochs.fix)
    expected = run_jit(plain, params._replace(adapter=()), case.nav, epochs._replace(fix=fix))
    leaves_equal(run_jit(learned, params, case.nav, epochs), expected, rtol=1e-12, atol=1e-12)


@pytest.mark.full
def test_factors_on_sd_and_noise_are_those_of_the_parameters(case, epochs):
    params = filter_of("").params("consumer")
    expected = run_jit(filter_of(""), params, case.nav, epochs._replace(fix=epochs.fix._replace(sd=3 * epochs.fix.sd)))
    found = run_jit(filter_of(constant(3.0)), params, case.nav, epochs)
    known = np.asarray(epochs.fix.valid).any(1)
    for a, b in zip(found[:5], expected[:5], strict=True):
        leaves_equal(jax.tree.map(lambda x: x[known], a), jax.tree.map(lambda x: x[known], b), rtol=1e-12, atol=1e-12)
    noisier = change(params, {"noise.gyro": 2 * params.noise.gyro, "noise.accel": 5 * params.noise.accel})
    found = run_jit(filter_of(constant(noise=jnp.array([2.0, 5.0]))), params, case.nav, epochs)
    leaves_equal(found, run_jit(filter_of(""), noisier, case.nav, epochs), rtol=1e-12, atol=1e-12)


@pytest.mark.full
def test_a_hidden_fix_is_not_seen(case, epochs):
    """Other values in missing channels change nothing but their residuals, which are those of the plain filter."""
    curious = Adapter(
        lambda theta, seen, window: (
            window.fix.value.sum() + window.fix.sd.sum(), Adapted(times(window.fix, 1 + jnp.abs(jnp.sin(seen))))
        ),
        lambda: (), lambda: jnp.zeros(()),
    )  # fmt: skip
    filt, fix = filter_of(curious), epochs.fix
    params, missing = filter_of("").params("consumer"), ~np.asarray(fix.valid)
    changed = fix._replace(sd=jnp.where(missing, 7.0, fix.sd), value=jnp.where(missing, 0.3, fix.value))
    found = [run_jit(filt, params, case.nav, epochs._replace(fix=each)).nav for each in (fix, changed)]
    leaves_equal(*found)
    filt = filter_of("mlp_noise")
    start = filt.params("consumer")
    plain = run_jit(filter_of(""), start._replace(adapter=()), case.nav, epochs)
    leaves_equal(run_jit(filt, start, case.nav, epochs).residual, plain.residual, rtol=1e-9, atol=1e-9)


@pytest.mark.full
@pytest.mark.parametrize("name", ADAPTERS)
def test_prepared_epochs_and_batches_are_the_same(case, epochs, name):
    filt = filter_of(name)
    params = filt.params("consumer")
    params = params._replace(adapter=moved(params.adapter))
    one = run_jit(filt, params, case.nav, epochs)
    prepared = run_jit(filt, params, case.nav, prepare(filt, epochs))  # there biases enter in first order
    leaves_equal(prepared.nav, one.nav, rtol=1e-9, atol=1e-4)
    two = jax.tree.map(lambda a: jnp.stack([jnp.asarray(a)] * 2), params)
    batch = jax.vmap(lambda p: run(filt, p, case.nav, epochs))(two)
    leaves_equal(jax.tree.map(lambda a: a[1], batch.nav), one.nav, rtol=1e-9, atol=1e-9)


@pytest.mark.full
@pytest.mark.parametrize(("name", "frame"), [*zip(itertools.cycle(ADAPTERS), FRAMES)])
def test_gradients_through_the_filter(case, epochs, name, frame):
    """A derivative along a random direction of all weights against a central difference."""
    filt = build("ekf9", NAMES, 5, frame=frame, adapter=name)
    params = filt.params("consumer")
    theta = moved(params.adapter)
    truth = jnp.asarray(case.truth.vel[20::20][:EPOCHS])
    score = jax.jit(
        lambda theta: jnp.square(run(filt, params._replace(adapter=theta), case.nav, epochs).nav.vel - truth).mean()
    )
    direction = jax.tree.map(lambda a: jnp.ones_like(a) / a.size, theta)
    slope = sum(jnp.vdot(g, d) for g, d in zip(*map(jax.tree.leaves, (jax.grad(score)(theta), direction)), strict=True))
    step = 1e-4
    ahead, back = (score(jax.tree.map(lambda a, d, s=s: a + s * step * d, theta, direction)) for s in (1, -1))
    np.testing.assert_allclose(slope, (ahead - back) / (2 * step), rtol=1e-4)
    assert abs(float(slope)) > 1e-7


@pytest.mark.full
@pytest.mark.parametrize("name", ADAPTERS)
def test_the_smoother_ends_where_the_filter_ends(case, epochs, name):
    filt = filter_of(name)
    params = filt.params("consumer")
    params = params._replace(adapter=moved(params.adapter))
    info, smoothed = smooth_jit(filt, params, case.nav, epochs)
    leaves_equal(info.nav, run_jit(filt, params, case.nav, epochs).nav, rtol=1e-9, atol=1e-9)
    last = lambda tree: jax.tree.map(lambda a: a[-1], tree)
    np.testing.assert_allclose(last(smoothed.nav).pos, last(info.nav).pos, rtol=1e-12)
    assert bool((jnp.trace(smoothed.P, axis1=1, axis2=2)[:-1] <= jnp.trace(info.P, axis1=1, axis2=2)[:-1]).all())


@pytest.mark.full
@pytest.mark.parametrize("name", ADAPTERS)
def test_a_stream_is_the_batch(case, name):
    """Late fixes too: the adapter's memory goes back with the state."""
    filt = filter_of(name)
    params = filt.params("consumer")
    params = params._replace(adapter=moved(params.adapter, 0.1))
    begin = Initialization(jax.tree.map(lambda a: jnp.asarray(a)[None], case.nav), params.prior, 0.0)
    packed = pack(case.imu, case.aiding, 1.0, CHOSEN, start=0.0, stop=10.5)
    batch = run_jit(changed(filt, history=2), begin.apply_to(params), case.nav, packed.epochs)
    stream = Stream(filt, params, begin, rate=20.0, lag=3.0)
    rec = type("Rec", (), {"imu": case.imu, "aiding": case.aiding})
    order = [(t, "", i, t) for i, t in enumerate(case.imu.t) if t < 10.5]
    order += [(t, n, i, t + 1.3 * (i % 2)) for n in NAMES[:2] for i, t in enumerate(case.aiding[n].t) if t < 9.5]
    feed(stream, rec, [row[:3] for row in sorted(order, key=lambda row: (row[3], row[1]))])
    ends = {round(each.t, 6): each.state for each in stream.kept}
    found = [(i, ends[round(float(t), 6)]) for i, t in enumerate(packed.t) if round(float(t), 6) in ends]
    assert len(found) >= 3
    for i, state in found:
        np.testing.assert_allclose(np.asarray(state.past.vel[-1]), batch.nav.vel[i], rtol=1e-9, atol=1e-12)


@pytest.mark.full
@pytest.mark.parametrize("frame", FRAMES)
def test_a_window_shows_where_the_epoch_begins(case, epochs, frame):
    """Navigation and its covariance are those that the epoch before reported; ages grow where fixes are hidden."""
    seen = lambda theta, memory, window: ((window.nav.pos, window.P[:3, :3], window.age), Adapted(window.fix))
    nothing = lambda: (jnp.zeros(3), jnp.zeros((3, 3)), jnp.zeros(8))
    filt = filter_of(Adapter(seen, lambda: (), nothing), frame)
    state, step = filt.init(filt.params("consumer"), case.nav), jax.jit(filt.advance)
    last, ages = None, []
    for i in range(7):
        done = step(filt.params("consumer"), state, jax.tree.map(lambda a, i=i: a[i], epochs))
        pos, P, age = done.after.adapter
        if last is not None:
            np.testing.assert_allclose(pos, last.nav.pos, rtol=1e-13)
            np.testing.assert_allclose(P, last.P[:3, :3], rtol=1e-6)
        state, last = done.after, done.info
        ages.append(float(age[0]))
    np.testing.assert_allclose(ages, [1.0, 1.0, 1.0, 1.0, 2.0, 3.0, 1.0], rtol=1e-9)


def test_a_fix_of_another_shape_is_refused(case, epochs):
    wrong = Adapter(lambda theta, memory, window: (memory, Adapted(window.fix._replace(sd=jnp.ones(3)))), lambda: ())
    with pytest.raises(ValueError, match=r"the adapter's fix has sd of shape \(3,\), expected \(8,\)"):
        run(filter_of(wrong), filter_of("").params("consumer"), case.nav, epochs)


def test_an_adapter_that_fails_ends_the_run_and_says_so(case, epochs):
    broken = Adapter(
        lambda theta, n, window: (n + 1, Adapted(times(window.fix, jnp.where(n > 5, jnp.nan, 1.0)))),
        lambda: (), lambda: jnp.zeros((), int),
    )  # fmt: skip
    info = run_jit(filter_of(broken), filter_of("").params("consumer"), case.nav, epochs)
    assert np.asarray(info.ok).tolist() == [True] * 6 + [False] * 6 and all_finite(info.nav)


# ---------------------------------------------------------------------------- the networks


def test_a_convolution_is_that_of_jax():
    rng = np.random.default_rng(0)
    seen, weights, biases = (jnp.asarray(rng.normal(size=s)) for s in ((15, 6), (5, 6, 4), (4,)))
    for dilation in DILATIONS:
        held = jnp.concatenate([jnp.repeat(seen[:1], 4 * dilation, 0), seen])
        expected = (
            lax.conv_general_dilated(
                held[None],
                weights[::-1],
                (1,),
                "VALID",
                rhs_dilation=(dilation,),
                dimension_numbers=("NWC", "WIO", "NWC"),
            )[0]
            + biases
        )
        np.testing.assert_allclose(convolved(seen, dilation, weights, biases), expected, rtol=1e-12)


def test_the_window_holds_the_last_samples():
    memory, samples = jnp.arange(15.0)[:, None], jnp.arange(15.0, 35.0)[:, None]
    for count in (0, 3, 20):
        dt = jnp.where(jnp.arange(20) < count, 0.1, 0.0)
        np.testing.assert_allclose(latest(memory, samples, dt)[:, 0], np.arange(count, count + 15.0))


def test_constraints_are_within_the_bounds_of_the_paper():
    """Eq. 18: from 10^-1.5 to 10^1.5 times the sd, whatever the network says."""
    adapter = ADAPTERS["window_constraints"].make(CHOSEN)
    theta = adapter.theta()
    fix = Fix(jnp.zeros(8), jnp.ones(8), jnp.zeros(8), jnp.zeros(8, bool))
    imu = Imu(jnp.full(20, 0.01), jnp.zeros((20, 3)), jnp.tile(jnp.array([0.0, 0.0, -9.8]), (20, 1)))
    window = Window(imu, None, None, None, fix)  # type: ignore[arg-type]
    for z, factor in ((100.0, 10**1.5), (-100.0, 10**-1.5), (0.0, 1.0)):
        out = {"weights": theta["out"]["weights"], "biases": jnp.full(2, z)}
        _, adapted = adapter.adapt(theta | {"out": out}, adapter.memory(), window)
        np.testing.assert_allclose(adapted.fix.sd[6:], factor * np.array(SD), rtol=1e-9)
        assert adapted.fix.valid.tolist() == [False] * 6 + [True] * 2


def test_padding_is_no_part_of_the_features(case, epochs):
    blocks = (slice(0, 3), slice(3, 6))
    epoch = jax.tree.map(lambda a: jnp.asarray(a[2]), epochs)
    more = lambda a, n=7: jnp.concatenate([a, jnp.repeat(a[-1:], n, 0)])
    imu = Imu(jnp.concatenate([epoch.imu.dt, jnp.zeros(7)]), more(epoch.imu.gyro), more(epoch.imu.accel))
    at = lambda imu: features(Window(imu, case.nav, None, jnp.ones(8), epoch.fix), blocks)  # type: ignore[arg-type]
    np.testing.assert_allclose(at(imu), at(epoch.imu), rtol=1e-12)
