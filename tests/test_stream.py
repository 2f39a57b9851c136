"""A filter sample by sample is the batch, in whatever order things arrive, and nothing brings it down."""

import os
import subprocess
import sys
import textwrap

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxnav import build, initialize, mounting, navigate
from jaxnav.filters import epochs as ep
from jaxnav.filters.catalogue import changed
from jaxnav.filters.run import run_jit
from jaxnav.initialization.initialize import Initialization
from jaxnav.measurements import GNSS
from jaxnav.simulate.scenarios import URBAN_SHORT
from jaxnav.simulate.simulation import simulate_jit, to_recording
from jaxnav.stream import Stream, _advance, _predict
from jaxnav.types import DataError


def driven():
    """A recording with an outage, where it can start, a filter and its parameters."""
    what = URBAN_SHORT._replace(duration_s=60.0, gnss=URBAN_SHORT.gnss._replace(outages_s=((30.0, 36.0),)))
    rec = to_recording(simulate_jit(jax.random.key(2), what), what)
    ekf = build("ekf15", cov_stride=5)
    params = ekf.params("consumer", install=mounting(rec.lever_arm))
    return rec, ekf, params, initialize(rec, params)


drive = pytest.fixture(scope="module", name="drive")(driven)


def events(rec, begin, names=("position", "velocity")):
    """Everything in the order of its time: samples (t, None, i), fixes (t, name, i)."""
    rows = [(t, "", i) for i, t in enumerate(rec.imu.t) if t > begin]
    rows += [(t, name, i) for name in names for i, t in enumerate(rec.aiding[name].t) if t > begin]
    return sorted(rows, key=lambda row: (row[0], row[1]))


def feed(stream, rec, rows):
    """Push them; navigation after each."""
    for t, name, i in rows:
        if name:
            s = rec.aiding[name]
            stream.push(name, t, s.value[i], s.sd[i], s.corr[i])
        else:
            stream.push_imu(t, rec.imu.gyro[i], rec.imu.accel[i], rec.imu.dt[i])
    return stream


def same(a, b):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)


@pytest.mark.full
def test_it_is_the_batch(drive):
    """At every epoch, those without a fix in the outage among them; nothing is compiled on the way.

    To rounding: this suite compiles without most optimizations. As users run it, it is to 1e-13, see below.
    """
    rec, ekf, params, begin = drive
    sol = navigate(rec, ekf, params, initialization=begin)
    stream, seen = Stream(ekf, params, begin, rate=25.0), {}
    compiled = _advance._cache_size(), _predict._cache_size()
    packed, nav = ep.pack_recording(rec, GNSS, begin.t), jax.tree.map(lambda a: a[0], begin.navs)
    batch = run_jit(
        stream.filter, begin.apply_to(params), nav, ep.pad_to_bucket(packed.epochs), lambda step, _: step.after
    )
    for row in events(rec, begin.t):
        feed(stream, rec, [row])
        for each in stream.kept:
            seen[round(each.t, 6)] = each.state
    rows = [i for i, t in enumerate(packed.t) if round(float(t), 6) in seen]
    assert len(rows) >= packed.t.size - 1  # the last epoch ends with the data
    for i in rows:
        mine, its = seen[round(float(packed.t[i]), 6)], jax.tree.map(lambda a, i=i: np.asarray(a[i]), batch)
        np.testing.assert_allclose(mine.past.pos, its.past.pos, rtol=1e-14)
        for a, b in zip(jax.tree.leaves(mine), jax.tree.leaves(its), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-11 * max(1.0, np.abs(b).max()))
    assert compiled == (_advance._cache_size(), _predict._cache_size())
    assert stream.now.t == pytest.approx(sol.t[-1]) and stream.now.ok and not stream.refused
    np.testing.assert_allclose(stream.now.lla, sol.lla[-1], rtol=1e-12)
    np.testing.assert_allclose(stream.now.sd, sol.sd[-1], rtol=1e-9)
    np.testing.assert_allclose(stream.now.sd_relative, sol.sd_relative[-1], rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("emitters", ["", "--xla_cpu_use_fusion_emitters=false"], ids=["library", "command line"])
def test_it_is_the_batch_but_for_the_last_digits(emitters):
    """In a separate process, compiled as users' programs are; equal to the bit on some processors."""
    env = os.environ | {"XLA_FLAGS": emitters, "JAX_PLATFORMS": "cpu"}
    code = """
        import jax, numpy as np, jaxnav
        jaxnav.enable_x64()
        from tests import test_stream as t
        rec, ekf, params, begin = t.driven()
        stream, ends = t.Stream(ekf, params, begin, rate=25.0), {}
        for row in t.events(rec, begin.t):
            t.feed(stream, rec, [row])
            ends |= {round(each.t, 6): each.state for each in stream.kept}
        packed, nav = t.ep.pack_recording(rec, t.GNSS, begin.t), jax.tree.map(lambda a: a[0], begin.navs)
        epochs = t.ep.pad_to_bucket(packed.epochs)
        batch = t.run_jit(stream.filter, begin.apply_to(params), nav, epochs, lambda step, _: step.after)
        rows = [i for i, when in enumerate(packed.t) if round(float(when), 6) in ends]
        assert len(rows) >= packed.t.size - 1, len(rows)
        for i in rows:
            mine, its = ends[round(float(packed.t[i]), 6)], jax.tree.map(lambda a: a[i], batch)
            for a, b in zip(jax.tree.leaves(mine), jax.tree.leaves(its), strict=True):
                np.testing.assert_allclose(a, b, rtol=0, atol=1e-13 * max(1.0, float(np.abs(b).max())))
    """
    subprocess.run([sys.executable, "-c", textwrap.dedent(code)], env=env, check=True, timeout=300)


@pytest.mark.full
def test_late_fixes_in_any_order_end_where_those_on_time_do(drive):
    rec, ekf, params, begin = drive
    rows = events(rec, begin.t)
    rng, late = np.random.default_rng(0), 0.9
    arrival = [t + (late * rng.random() if name else 0.0) for t, name, _ in rows]
    shuffled = [rows[i] for i in np.argsort(arrival, kind="stable")]
    on_time, delayed = (feed(Stream(ekf, params, begin), rec, order) for order in (rows, shuffled))
    assert shuffled != rows and not delayed.refused
    assert on_time.kept[-1].t == delayed.kept[-1].t
    same(on_time.kept[-1].state, delayed.kept[-1].state)


@pytest.mark.full
def test_a_restart_from_bytes_goes_on_to_the_bit(drive):
    rec, ekf, params, begin = drive
    rows = events(rec, begin.t)
    middle = len(rows) // 2 + 7  # between two fixes
    whole = feed(Stream(ekf, params, begin), rec, rows)
    first = feed(Stream(ekf, params, begin), rec, rows[:middle])
    first.push_imu(0.0, [0.0] * 3, [0.0] * 3)
    again = Stream.from_bytes(first.to_bytes(), ekf, params, begin)
    same(again.now, first.now)
    assert again.refused == {"imu: not later than the one before": 1}
    feed(again, rec, rows[middle:])
    same(again.now, whole.now)
    same(again.kept[-1].state, whole.kept[-1].state)
    quick = Stream(
        ekf, params._replace(mounting=params.mounting._replace(time_offset=jax.numpy.asarray(0.1))), begin, rate=25.0
    )
    feed(quick, rec, rows[:middle])  # its history is another
    back = Stream.from_bytes(quick.to_bytes(), ekf, quick.params, begin)
    same(back.now, quick.now)
    assert (back.rate, back.filter) == (25.0, quick.filter)
    data = first.to_bytes()
    for bad in (b"", data[: len(data) // 2], b"x" * 100):
        with pytest.raises(DataError, match="the bytes are no stream"):
            Stream.from_bytes(bad, ekf, params, begin)
    network = params._replace(adapter={"weights": np.zeros(2)})
    with pytest.raises(DataError, match="another filter"):
        Stream.from_bytes(data, ekf, network, begin)
    for field in ({"states": ("gyro_scale",)}, {"cov_stride": 10}, {"name": "ekf15_fading"}):
        other = changed(ekf, **field)
        with pytest.raises(DataError, match="another filter"):
            Stream.from_bytes(data, other, other.params("consumer"), begin)


@pytest.mark.full
def test_all_fields_of_now_are_of_one_state(drive):
    """Quaternion and angles, sd and covariance with the delay's, rates of the last sample without the bias."""
    rec, ekf, params, begin = drive
    stream = feed(Stream(ekf, params, begin, delay_sd=0.05), rec, events(rec, begin.t)[:900])
    now, state = stream.now, stream.ahead
    turn = Rotation.from_quat(now.q, scalar_first=True).as_matrix()[[1, 0, 2]] * [[1], [1], [-1]]  # FRD -> NED
    np.testing.assert_allclose(Rotation.from_matrix(turn).as_euler("ZYX")[::-1], now.rph, atol=1e-12)
    np.testing.assert_allclose(np.sqrt(np.diag(now.P)), now.sd, rtol=1e-12)
    plain = np.asarray(state.P)[:9, :9]
    np.testing.assert_allclose(now.P[:3, :3] - plain[:3, :3], 0.05**2 * np.outer(now.vel, now.vel), atol=1e-12)
    np.testing.assert_array_equal(now.P[3:, 3:], plain[3:, 3:])
    i = int(np.searchsorted(rec.imu.t, now.t - 1e-6))
    np.testing.assert_allclose(now.rate, rec.imu.gyro[i] - np.asarray(state.past.errors["gyro_bias"])[-1], atol=1e-9)
    np.testing.assert_allclose(now.rate_sd, np.sqrt(np.diag(state.P)[9:12]), rtol=1e-12)


def test_its_memory_does_not_grow(drive):
    rec, ekf, params, begin = drive
    stream, sizes = Stream(ekf, params, begin, lag=0.5), []
    for row in events(rec, begin.t):
        feed(stream, rec, [row])
        sizes.append((len(stream.kept), len(stream.samples), len(stream.fixes)))
    assert np.max(sizes, 0)[0] <= 4 and np.max(sizes, 0)[1] <= 460 and np.max(sizes, 0)[2] <= 8


def test_a_hole_is_coasted_and_the_covariance_says_so(drive):
    rec, ekf, params, begin = drive
    lost = lambda row: row[1] == "" and 40.0 < row[0] <= 43.0
    whole, holed = (
        feed(Stream(ekf, params, begin), rec, [r for r in events(rec, begin.t) if r[0] <= 43.3 and not skip(r)])
        for skip in (lambda row: False, lost)
    )
    assert len(holed.holes) == 1 and holed.now.t == whole.now.t
    start, end, *noise = holed.holes[0]
    assert (start, end) == pytest.approx((40.0, 43.0), abs=0.02)
    np.testing.assert_array_equal(holed._epoch(41.0, 42.0, False).gap, noise)
    np.testing.assert_array_equal(holed._epoch(end + 0.1, end + 0.2, False).gap, 0.0)
    assert np.linalg.norm(holed.now.sd[3:6]) > 1.5 * np.linalg.norm(whole.now.sd[3:6]) and holed.now.ok


def test_nothing_that_comes_in_brings_it_down(drive):
    """Not finite, repeated, back in time, jumps, much at once: no exception, no NaN, and the sd says what is known."""
    rec, ekf, params, begin = drive
    stream, rng = Stream(ekf, params, begin), np.random.default_rng(3)
    rows, i = events(rec, begin.t), 0
    pool = [np.nan, np.inf, -np.inf, 1e300, 0.0]
    for _ in range(200):
        feed(stream, rec, rows[i : i + 6])
        t, kind = stream.t, rng.integers(7)
        i += 6
        if kind == 0:
            stream.push_imu(t + 0.01, rng.choice(pool[:3], 3), [0.0, 0.0, -9.8])
        elif kind == 1:
            stream.push_imu(float(rng.choice([np.nan, t, t - 1.0, -1e9])), [0.0] * 3, [0.0, 0.0, -9.8])
        elif kind == 2:
            stream.push("position", t, [rng.choice(pool[:3]), 0.3, 100.0], 1.0)
        elif kind == 3:
            stream.push("velocity", float(t + rng.normal()), [0.0] * 3, float(rng.choice([0.0, -1.0, np.nan])))
        elif kind == 4:
            stream.push("velocity", t - 1e3, [1.0] * 3, 0.1)
        elif kind == 5:
            stream.push("position", t + 1e6, rec.aiding["position"].value[0], 1.0)
        else:
            i += int(rng.integers(40))  # samples and fixes that never come
        now = stream.now
        assert all(np.isfinite(a).all() for a in (now.t, now.lla, now.vel, now.rph, now.sd)) and (now.sd > 0).all()
    assert stream.now.ok and len(stream.refused) >= 5 and sum(stream.refused.values()) > 80
    assert any("ahead of the IMU" in why for why in stream.refused) and len(stream.fixes) < 20
    for bad, words in ((("speed", 1.0, [1.0], 1.0), "takes no 'speed'"), (("position", 1.0, [1.0], 1.0), "3 channels")):
        with pytest.raises(ValueError, match=words):
            stream.push(*bad)


@pytest.mark.full
def test_a_start_that_is_not_one_is_refused(drive):
    rec, ekf, params, begin = drive
    bank = Initialization(jax.tree.map(lambda a: np.repeat(a, 12, 0), begin.navs), begin.prior, begin.t)
    with pytest.raises(ValueError, match="12 headings"):
        Stream(ekf, params, bank)
    with pytest.raises(ValueError, match="interval must be positive"):
        Stream(ekf, params, begin, interval=0.0)
