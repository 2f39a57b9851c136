"""Cutting recordings into epochs: nothing of the stream is lost, and every fix ends an epoch."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.recordings.navego import from_instantaneous
from jaxnav.checkup import checkup
from jaxnav.filters import gaps
from jaxnav.filters.catalogue import build
from jaxnav.filters.core import padded
from jaxnav.filters.cutting import cut_imu
from jaxnav.filters.epochs import bucket_size, cut_times, hide, outage_windows, pack, pad_to_bucket, stack_epochs
from jaxnav.filters.run import run_jit
from jaxnav.filters.standstill import constraint_samples, is_driving, stationary
from jaxnav.io.recording import recording
from jaxnav.maths import earth
from jaxnav.maths.units import TICK
from jaxnav.measurements import GNSS, MEASUREMENTS, NONHOLONOMIC, POSITION, SPEED, VELOCITY
from jaxnav.measurements.satellites import SATELLITE
from jaxnav.measurements.standstill import mean_rate
from jaxnav.types import DataError, Epoch, Fix, ImuLog, Samples
from tests.conftest import gnss, leaves_equal, told


def stream(n=200, rate=50.0, seed=0, first=100.0):
    """Irregular samples that cover first to about first + n / rate."""
    rng = np.random.default_rng(seed)
    dt = rng.uniform(0.7, 1.3, n) / rate
    return ImuLog(first + np.cumsum(dt), dt, rng.normal(size=(n, 3)), rng.normal(size=(n, 3)))


def fixes(t, size=3):
    t = np.asarray(t, float)
    value = 1e-2 * (t[:, None] + np.arange(size))  # a latitude, too, must be one in radians
    return Samples(t, value, np.full((t.size, size), 0.5), np.full((t.size, size), 0.1))


def integral(imu, t):
    """Of the gyro from the stream's start to t."""
    edges = np.concatenate([[imu.t[0] - imu.dt[0]], imu.t])
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(imu.gyro * imu.dt[:, None], 0)])
    return np.stack([np.interp(t, edges, column) for column in total.T], 1)


@pytest.mark.parametrize("stride", [1, 7])
def test_every_piece_of_the_stream_is_kept(stride):
    """Cut into epochs, and padded to a filter's stride."""
    imu = stream()
    t = np.array([100.31, 100.7123, imu.t[60], 101.9, 103.4])  # off the grid, on the grid, and an outage of 1.5 s
    packed = pack(imu, {"position": fixes(t)}, 0.5)
    dt, gyro, accel = (np.asarray(a) for a in jax.vmap(lambda imu: padded(imu, stride))(packed.epochs.imu))
    edges = np.concatenate([[packed.start], packed.t])
    np.testing.assert_allclose(dt.sum(1), np.diff(edges), atol=1e-9)
    np.testing.assert_allclose((gyro * dt[..., None]).sum(1), np.diff(integral(imu, edges), axis=0), atol=1e-9)
    assert packed.t[-1] == imu.t[-1] and packed.start == pytest.approx(imu.t[0] - imu.dt[0])
    assert set(t) <= set(packed.t) and dt.shape[1] % stride == 0
    assert np.diff(edges).max() < 0.5 + 1e-3
    # padding repeats the last sample at the end of the epoch
    last = (dt > 0).sum(1) - 1
    for e, i in enumerate(last):
        assert (dt[e, : i + 1] > 0).all() and not dt[e, i + 1 :].any()
        np.testing.assert_array_equal(gyro[e, i:], np.broadcast_to(gyro[e, i], gyro[e, i:].shape))
        np.testing.assert_array_equal(accel[e, i:], np.broadcast_to(accel[e, i], accel[e, i:].shape))


@pytest.mark.parametrize("block", [1, 3])
def test_a_long_stream_is_cut_in_blocks(block, monkeypatch):
    """Holes, split samples and fixes on a sample at the seams: the same numbers as in one piece."""
    rng = np.random.default_rng(block)
    dt = np.where(rng.random(400) < 0.05, 0.17, 0.01)
    t = np.cumsum(dt)
    imu = ImuLog(t, np.minimum(dt, 0.011), rng.normal(size=(400, 3)), rng.normal(size=(400, 3)))
    cuts = np.unique([*rng.uniform(0.05, t[-1], 40), *rng.choice(t[10:], 20), t[-1] - 0.5 * TICK])
    whole = cut_imu(imu, 0.02, cuts)
    monkeypatch.setattr("jaxnav.filters.cutting.BLOCK", block)
    for part, one in zip(cut_imu(imu, 0.02, cuts), whole, strict=True):
        np.testing.assert_array_equal(part, one)
    np.testing.assert_allclose(whole[0].sum(1), np.diff(cuts, prepend=0.02), atol=2 * TICK)


def test_fixes_stand_at_the_end_of_their_epoch():
    imu, t = stream(), np.array([100.31, 100.7123, 101.9])
    packed = pack(imu, {"position": fixes(t), "velocity": fixes(t[1:] + 4e-7)}, 0.5)  # closer than a tick: one time
    fix = jax.tree.map(np.asarray, packed.epochs.fix)
    rows = np.searchsorted(packed.t, t - TICK)
    np.testing.assert_array_equal(packed.t[rows], t)
    np.testing.assert_array_equal(fix.valid[rows], [[True] * 3 + [False] * 3, [True] * 6, [True] * 6])
    assert fix.valid.sum() == 15  # and nowhere else
    np.testing.assert_array_equal(fix.value[rows, 0], 1e-2 * t)
    np.testing.assert_array_equal(fix.corr[rows, 0], 0.1)
    assert np.isfinite(fix.value).all() and (fix.sd > 0).all()


def test_a_fix_within_a_tick_of_a_sample_makes_no_sliver():
    imu = stream()
    packed = pack(imu, {"position": fixes(imu.t[[40, 80]] + [4e-7, -4e-7])}, 1.0)
    dt = np.asarray(packed.epochs.imu.dt)
    assert dt[dt > 0].min() > 1e-5
    assert dt.sum() == pytest.approx(imu.t[-1] - packed.start, abs=1e-9)
    assert np.asarray(packed.epochs.fix.valid).sum() == 6


def test_an_outage_is_cut_into_epochs_of_the_nominal_interval():
    imu = stream(400, 50.0)
    cuts = cut_times(imu, {"position": fixes([100.5, 101.5, 105.2])}, 1.0)
    np.testing.assert_allclose(cuts[:6], [100.5, 101.5, 102.5, 103.5, 104.5, 105.2])
    late = cut_times(imu, {"position": fixes([101.0, 102.0009, 103.0])}, 1.0, start=100.0)
    np.testing.assert_allclose(late[:3], [101.0, 102.0009, 103.0])  # a millisecond late is no outage
    np.testing.assert_allclose(cut_times(imu, {}, 1.0, start=100.0, stop=103.5), [101, 102, 103, 103.5])
    outside = {"position": fixes([99, 100.0, 102.0, 300.0])}
    np.testing.assert_allclose(cut_times(imu, outside, 1.0, 100.0, 102.0), [101, 102])


def test_a_span_inside_the_stream():
    imu = stream()
    packed = pack(imu, {"position": fixes([101.0, 102.0, 103.0])}, 1.0, start=100.555, stop=102.3)
    assert packed.start == 100.555 and packed.t[-1] == 102.3
    edges = np.concatenate([[packed.start], packed.t])
    np.testing.assert_allclose(packed.epochs.imu.dt.sum(1), np.diff(edges), atol=1e-9)
    turn = (packed.epochs.imu.gyro * packed.epochs.imu.dt[..., None]).sum(1)
    np.testing.assert_allclose(turn, np.diff(integral(imu, edges), axis=0), atol=1e-9)


def test_a_hole_in_the_stream_is_bridged_by_the_mean_of_its_sides(monkeypatch):
    imu = stream(rate=50.0)
    keep = np.r_[0:80, 110:200]  # about 0.6 s
    cut = ImuLog(*(a[keep] for a in imu))
    monkeypatch.setattr(gaps, "MIN_GAP_S", 1.0)  # longer holes are coasted through, see test_gaps.py
    packed = pack(cut, {"position": fixes([imu.t[50], imu.t[95], imu.t[150]])}, 1.0)  # one of them within the hole
    assert packed.epochs.imu.dt.sum() == pytest.approx(imu.t[-1] - imu.t[0] + imu.dt[0])
    dt, gyro = np.asarray(packed.epochs.imu.dt), np.asarray(packed.epochs.imu.gyro)
    bridge = (dt > 0.1).nonzero()
    assert len(bridge[0]) == 2  # split at the fix
    np.testing.assert_allclose(gyro[bridge], np.tile(0.5 * (imu.gyro[79] + imu.gyro[110]), (2, 1)))


def test_data_that_cannot_be_packed_are_named():
    imu = stream()
    with pytest.raises(DataError, match=r"no measurement of the filter takes 'speed': known are position"):
        pack(imu, {"speed": fixes([101.0], 1)}, 1.0)
    with pytest.raises(DataError, match="the IMU covers 100.000 to 10"):
        pack(imu, {}, 1.0, start=99.0)
    with pytest.raises(DataError, match="which does not hold 102.000 to 101.000"):
        cut_times(imu, {}, 1.0, start=102.0, stop=101.0)
    with pytest.raises(DataError, match=r"velocity: the fix at t = 101.300000 s is not at the end of an epoch"):
        pack(imu, {"velocity": fixes([101.0, 101.3])}, 1.0, cuts=np.array([101.0, 102.0]))


def test_positions_in_float32_are_refused_wherever_they_come_in():
    """Steps of 0.8 m pass for motion: by `pack`, `recording` and the check."""
    imu, position = stream(), fixes([101.0, 102.0])
    coarse = position._replace(value=position.value.astype(np.float32))
    still = (imu.t, np.zeros((200, 3)), np.tile([0.0, 0.0, -9.8], (200, 1)))
    whole = recording(still, position=position)
    for call in (
        lambda: pack(imu, {"position": coarse}, 1.0),
        lambda: recording(still, position=coarse),
        lambda: recording(still, position=(coarse.t, coarse.value, 1.0)),
        lambda: checkup(whole._replace(aiding={"position": coarse}), quick=True),
    ):
        with pytest.raises(DataError, match="position: latitude and longitude must be float64, got float32"):
            call()
    velocity = position._replace(value=position.value.astype(np.float32))
    pack(imu, {"velocity": velocity}, 1.0)  # of a velocity that is enough


@pytest.mark.parametrize("apart", [1.2e-6, 1.9e-6, 2.5e-6])
def test_fixes_microseconds_apart_at_the_end(apart):
    t = np.array([101.0, 102.0])
    packed = pack(stream(), {"position": fixes(t), "velocity": fixes(t + apart)}, 1.0, stop=102.0 + apart)
    assert np.asarray(packed.epochs.fix.valid).sum() == 12  # none is lost
    assert packed.epochs.imu.dt.sum() == pytest.approx(102.0 + apart - packed.start, abs=3e-6)


def test_instantaneous_samples_become_means():
    t = np.arange(1, 101) * 0.01
    imu = ImuLog(t, np.full(100, 0.01), np.stack([t, t**2, 0 * t], 1), np.stack([0 * t, 3 * t, t], 1))
    mean = from_instantaneous(imu)
    np.testing.assert_allclose((mean.gyro * mean.dt[:, None]).sum(0), [(1 - 1e-4) / 2, (1 - 1e-6) / 3, 0], atol=2e-5)
    np.testing.assert_allclose(mean.accel[:, 1], 3 * (mean.t - 0.005))
    assert mean.t[0] == t[1]


@pytest.mark.parametrize("n, size", [(1, 1), (3, 3), (7, 7), (9, 10), (50, 56), (57, 64), (64, 64), (1000, 1024)])
def test_shared_sizes_are_few_and_near(n, size):
    assert bucket_size(n) == size
    assert len({bucket_size(k) for k in range(1, 10_001)}) < 60


@pytest.mark.full
@pytest.mark.parametrize("name", ["ekf15_gate", "gpid15"])
def test_padding_to_a_shared_size_changes_nothing(case, name):
    """Of values and of what a rule remembers; epochs and samples that were added last no time."""
    filt, epochs = build(name, cov_stride=5), jax.tree.map(lambda a: a[:50], case.packed.epochs)
    more = pad_to_bucket(epochs)
    assert more.imu.dt.shape == (56, 20) and not more.fix.valid[50:].any() and not more.imu.dt[50:].any()
    own = case.params._replace(rule=filt.params("consumer").rule)
    alone, among = run_jit(filt, own, case.nav, epochs), run_jit(filt, own, case.nav, more)
    leaves_equal(jax.tree.map(lambda a: a[:50], among), alone)
    assert among.ok.all()


@pytest.mark.full
def test_recordings_of_different_lengths_run_as_one_batch(case):
    """Each as it runs alone; a hole of one is none of the other."""
    filt = build("ekf15", cov_stride=5)
    whole = case.packed.epochs
    short = jax.tree.map(lambda a: a[:30], whole)
    gap = np.zeros((30, 2))
    gap[4] = 1e-3, 1e-2
    both = stack_epochs([whole, short._replace(gap=gap)])
    E = whole.imu.dt.shape[0]
    assert both.imu.dt.shape[:2] == (2, E) and both.gap.shape == (2, E, 2) and not both.gap[0].any()
    info = jax.vmap(run_jit, (None, None, None, 0))(filt, case.params, case.nav, both)
    alone = [run_jit(filt, case.params, case.nav, e) for e in (whole, short._replace(gap=gap))]
    for i, (n, own) in enumerate(zip((E, 30), alone, strict=True)):
        np.testing.assert_allclose(info.nav.pos[i, :n], own.nav.pos, rtol=1e-13)
        np.testing.assert_allclose(info.P[i, :n], own.P, rtol=1e-9, atol=1e-18)
    assert not np.allclose(info.P[1, 5], alone[0].P[5], rtol=1e-3)  # the hole is felt
    with pytest.raises(ValueError, match=r"same measurements, got \[3, 6\]"):
        stack_epochs([whole, whole._replace(fix=jax.tree.map(lambda a: a[:, :3], whole.fix))])


def test_hide_takes_the_receiver_and_leaves_constraints():
    measurements = (POSITION, VELOCITY, NONHOLONOMIC, SPEED)
    imu, t = stream(), np.array([101.0, 102.0, 103.0])
    aiding = {m.name: fixes(t, m.size) for m in measurements}
    epochs = pack(imu, aiding, 1.0, measurements, start=100.0, stop=103.0).epochs
    hidden = hide(epochs, np.array([False, True, False]), measurements)
    np.testing.assert_array_equal(hidden.fix.valid, [[True] * 9, [False] * 6 + [True] * 3, [True] * 9])
    jax.tree.map(np.testing.assert_array_equal, hidden._replace(fix=epochs.fix), epochs)
    np.testing.assert_array_equal(hidden.fix.value, epochs.fix.value)


def test_outage_windows():
    t = np.arange(1.0, 21.0)
    inside, last = outage_windows(t, np.array([2.0, 10.5]), 3.0)
    np.testing.assert_array_equal(t[inside], [3, 4, 5, 11, 12, 13])  # after the start, up to and with the end
    np.testing.assert_array_equal(t[last], [5, 13])
    with pytest.raises(DataError, match="no epoch in the outage that starts at 30.000 s"):
        outage_windows(t, np.array([2.0, 30.0]), 3.0)


def test_stationary_looks_back_only():
    rate, n = 50.0, 1000
    t = np.arange(1, n + 1) / rate
    moving = ((t > 6) & (t <= 12))[:, None]
    rng = np.random.default_rng(1)
    accel = np.array([0, 0, -9.8]) + rng.normal(size=(n, 3)) * np.where(moving, 0.5, 0.01)
    gyro = np.array([0.02, 0, 0]) + rng.normal(size=(n, 3)) * np.where(moving, 0.05, 0.001)
    imu = ImuLog(t, np.full(n, 1 / rate), gyro, accel)
    at = np.array([0.5, 1.0, 3.0, 6.0, 6.5, 9.0, 12.5, 13.0, 20.0])
    expected = [
        False,
        True,
        True,
        True,
        False,
        False,
        False,
        True,
        True,
    ]  # bias is no turn; first: not covered
    np.testing.assert_array_equal(stationary(imu, at, 1.0, 0.05, 0.005), expected)
    # what nobody has seen is no standstill: a hole in the stream, and time after its end
    holed = ImuLog(*(a[(t <= 2.0) | (t > 2.9)] for a in imu))
    np.testing.assert_array_equal(stationary(holed, np.array([1.9, 2.95, 4.0]), 1.0, 0.05, 0.005), [True, False, True])
    assert not stationary(imu, np.array([20.5]), 1.0, 0.05, 0.005).any()
    # either sensor alone may object
    assert not stationary(imu._replace(gyro=gyro * 20), at, 1.0, 0.05, 0.005).any()
    assert not stationary(imu, at, 1.0, 0.01, 0.005).any()
    np.testing.assert_allclose(mean_rate(imu, np.array([3.0]), 1.0)[0], gyro[100:150].mean(0), rtol=1e-12)


def test_constraints_act_once_an_epoch():
    imu = stream()
    cuts = cut_times(imu, {}, 1.0, start=100.0, stop=103.0)
    chosen = [MEASUREMENTS[name] for name in ("position", "nonholonomic", "zero_velocity", "zero_rate")]
    made = constraint_samples(imu, cuts, chosen, np.array([True, False, True]), 0.5)
    assert set(made) == {"nonholonomic", "zero_velocity", "zero_rate"}
    np.testing.assert_array_equal(made["nonholonomic"].t, cuts)
    np.testing.assert_array_equal(made["zero_rate"].t, cuts[[0, 2]])
    np.testing.assert_array_equal(made["zero_rate"].value, mean_rate(imu, cuts[[0, 2]], 0.5))
    assert not made["zero_velocity"].value.any() and made["nonholonomic"].value.shape == (3, 2)
    assert set(constraint_samples(imu, cuts, chosen)) == {"nonholonomic"}


@pytest.mark.parametrize("latency", [0.0, 0.13, 2.5])
def test_a_late_fix_is_compared_with_the_state_when_it_held(case, latency):
    """Fixes stamped t that hold at t - latency, even 2 epochs before: the residual is the fix's own error."""
    imu, truth = case.imu, case.truth
    exact = gnss(truth, 1, np.random.default_rng(0))
    t = np.arange(3.0, 61.0)
    held = t - latency
    lla = np.stack([np.interp(held, truth.t, c) for c in truth.lla.T], 1)
    vel = np.stack([np.interp(held, truth.t, c) for c in truth.vel.T], 1)
    aiding = {
        name: Samples(t, value, exact[name].sd[: t.size], np.zeros((t.size, 3)))
        for name, value in (("position", lla), ("velocity", vel))
    }
    epochs = pack(imu, aiding, 1.0).epochs
    assert epochs.imu.dt.shape == (60, 20)
    known = told(case.params, position_latency=latency, velocity_latency=latency)
    filt = build("kf9_simple", history=64)
    info = run_jit(filt, known, case.nav, epochs)
    assert np.abs(info.residual[4:, :3]).max() < 0.02 and np.abs(info.residual[4:, 3:]).max() < 0.02
    error = np.asarray(jax.vmap(earth.enu_difference)(info.nav.pos, truth.lla[20::20]))
    assert np.abs(error).max() < 0.05
    if latency:  # and not knowing it costs the distance driven meanwhile
        blind = run_jit(filt, case.params, case.nav, epochs)
        error = np.asarray(jax.vmap(earth.enu_difference)(blind.nav.pos, truth.lla[20::20]))
        assert np.abs(error[:, :2]).max() > 5 * latency


def test_the_measurements_of_a_fix_are_in_the_order_of_the_model():
    packed = pack(stream(), {"velocity": fixes([101.0])}, 1.0, (VELOCITY, POSITION))
    assert np.asarray(packed.epochs.fix.valid)[:, :3].any() and not np.asarray(packed.epochs.fix.valid)[:, 3:].any()
    assert GNSS == (POSITION, VELOCITY)


def test_driving_is_what_noise_cannot_be():
    """Over half a metre a second and three standard deviations, by the nearest velocity within a second."""
    value = np.array([[1.6, 0, 9], [0, 2.1, 0], [0.4, 0, 0], [9.0, 0, 0]])
    sd = np.array([[0.5, 0.1, 0.1], [0.1, 0.5, 0.1], [0.01] * 3, [0.1] * 3])
    velocity = Samples(np.arange(1.0, 5.0), value, sd, np.zeros((4, 3)))
    assert is_driving(velocity, np.array([1.0, 2.2, 3.1, 4.4, 5.5])).tolist() == [False, True, False, True, False]


def test_a_hidden_window_may_keep_the_highest_satellites():
    rows = (MEASUREMENTS["position"], MEASUREMENTS["pseudorange"])
    E, s = 4, MEASUREMENTS["pseudorange"].size
    elevation = np.tile(np.linspace(0.2, 1.4, s), (E, 1))
    auxiliary = np.zeros((E, s, len(SATELLITE)))
    auxiliary[..., SATELLITE.index("elevation_rad")] = elevation
    valid = np.ones((E, 3 + s), bool)
    valid[:, -1] = False  # the highest is not there
    fix = Fix(*(jnp.zeros((E, 3 + s)) for _ in range(3)), jnp.asarray(valid), {"pseudorange": jnp.asarray(auxiliary)})
    hidden = np.array([False, True, True, False])
    left = lambda k: np.asarray(hide(Epoch(None, fix), hidden, rows, k).fix.valid)
    assert left(3)[1].nonzero()[0].tolist() == [3 + s - 4, 3 + s - 3, 3 + s - 2]
    assert left(0)[2].sum() == 0
    np.testing.assert_array_equal(left(3)[[0, 3]], valid[[0, 3]])
