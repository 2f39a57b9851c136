"""Alignment in motion: python-ins' attitudes within their covariance, delays, and what cannot be seen."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import cholesky_banded
from scipy.spatial.transform import Rotation

from benchmarks.recordings.start import difference
from benchmarks.simulated.vehicles import simulated
from jaxnav.analysis.metrics import chi2_bounds
from jaxnav.filters.catalogue import build
from jaxnav.filters.error_model import error_model
from jaxnav.initialization import alignment
from jaxnav.initialization.alignment import AlignmentPrior, align, rotations_since
from jaxnav.initialization.differences import DRIVING_NOISE, differences, whitened
from jaxnav.initialization.initialize import aligned, correlation_root, initialize
from jaxnav.maths import rotations
from jaxnav.maths.units import DEG, G0
from jaxnav.states.grades import GRADES
from jaxnav.strapdown.frames import FRAMES
from jaxnav.types import ImuLog, Samples

RUNS = 6
BELIEVED = AlignmentPrior(0.5 * DEG, 0.2)


@pytest.mark.full
@pytest.mark.parametrize("kind", ["car", "aircraft", "walk", "robot"])
@pytest.mark.parametrize("velocity", [True, False], ids=["velocity", "positions"])
def test_attitude_biases_and_delay_lie_within_their_covariance(kind, velocity):
    """Six recordings each, velocity and attitude together: the mean of the normalised squares, nobody far outside."""
    rng, squares, delays, joint = np.random.default_rng(3), [], [], []
    params = build("ekf15").params("consumer")
    for _ in range(RUNS):
        rec, late = simulated(kind, "consumer", velocity, rng)
        found = initialize(rec, params)
        assert found.alignment is not None and found.navs.t.shape[0] == 1
        phi = difference(found, rec.truth)
        squares.append(phi @ np.linalg.solve(found.alignment.P[:3, :3], phi))
        delays.append((found.alignment.delay - late) / found.alignment.sd[9])
        true = np.array([np.interp(found.alignment.t, rec.truth.t, v) for v in rec.truth.vel.T])
        both = np.concatenate([found.alignment.vel - true, phi])
        joint.append(both @ np.linalg.solve(found.alignment.joint[:6, :6], both))
    loose = 1.6 if kind == "walk" else 1.0  # swaying hides what is slow
    assert np.mean(squares) < loose * chi2_bounds(3.0, RUNS, 0.99)[1]
    assert np.max(squares) < 40
    assert 1.5 < np.mean(joint) < loose * chi2_bounds(6.0, RUNS, 0.99)[1]
    # a period of the steps is a delay that fits as well: of a walk it is known but for that
    assert kind == "walk" or np.sqrt(np.mean(np.square(delays))) < 2.0


@pytest.mark.full
def test_misaligned_gyros_in_turns_widen_the_attitude():
    """A mower with fixes of centimetres: gravity at the tilt that its turns leave is what limits the start."""
    params, squares = build("ekf15").params("consumer"), []
    for seed in range(24):
        rng = np.random.default_rng([3, seed])
        rec, _ = simulated("mower", "consumer", False, rng, 0.03)
        found = initialize(rec, params, t_start=float(rng.uniform(0, 5)))
        phi = difference(found, rec.truth)
        squares.append(phi @ np.linalg.solve(found.alignment.P[:3, :3], phi))
    assert np.mean(squares) < chi2_bounds(3.0, 24, 0.99)[1]


def test_driving_noise_of_a_sway():
    """Attitudes spread evenly over -A to A about one axis: angle^2 = 1 - (sin A / A)^2."""
    A, n = 0.8, 4001
    back_and_forth = np.abs(np.linspace(-1, 1, n)) * 2 * A - A
    gyro = np.zeros((n - 1, 3))
    gyro[:, 2] = np.diff(back_and_forth) / 0.01
    imu = ImuLog(0.01 * np.arange(1, n), np.full(n - 1, 0.01), gyro, np.zeros((n - 1, 3)))
    angle = np.sqrt(1 - (np.sin(A) / A) ** 2)
    extra = 3e-3 * G0 * angle * np.sqrt(alignment.TURN_S)
    assert alignment.driving(imu, 3e-3) == pytest.approx(np.hypot(DRIVING_NOISE, extra), rel=1e-3)
    assert alignment.driving(imu, 0.0) == DRIVING_NOISE


def test_a_known_delay_is_not_found_again():
    rng = np.random.default_rng(1)
    rec, late = simulated("aircraft", "tactical", True, rng)
    params = build("ekf15").params("tactical")
    told = params._replace(
        measurements={
            name: theta._replace(latency=jnp.asarray(late)) if name in ("position", "velocity") else theta
            for name, theta in params.measurements.items()
        }
    )
    seen, known = (aligned(rec, p, 5.0, 20.0) for p in (params, told))
    assert seen.delay == pytest.approx(late, abs=4 * seen.sd[9]) and abs(known.delay) < 4 * known.sd[9]
    np.testing.assert_allclose(known.C, seen.C, atol=5e-3)


@pytest.mark.parametrize("positions", [False, True], ids=["velocity", "positions"])
def test_derivatives_by_biases_delay_and_arm_are_those_of_differences(positions):
    rec, _ = simulated("aircraft", "consumer", True, np.random.default_rng(4))
    fixes = alignment.within_margin(rec.aiding["position" if positions else "velocity"], 20.0, 40.0)
    imu, lla = alignment.window(rec.imu, 20.0, 40.0), rec.aiding["position"].value[0]
    seen = differences(fixes, positions, lla, 20.0)
    x, arm = np.array([0.01, -0.02, 0.015, 0.1, 0.05, -0.1, 0.05, 0.3, -0.2, 0.1]), np.array([1.0, 0.5, -2.0])
    C = Rotation.from_rotvec([0.3, -1.0, 0.5]).as_matrix()
    J, _ = alignment._linear(imu, seen, C, x, arm)
    for j in (*range(6), 7, 8, 9):  # the delay is differenced over 0.04 s
        step = 1e-6 * np.eye(10)[j]
        ahead, behind = (alignment._linear(imu, seen, C, x + sign * step, arm)[1] for sign in (1, -1))
        np.testing.assert_allclose(J[:, :, 3 + j], -(ahead - behind) / 2e-6, atol=2e-5)


@pytest.mark.parametrize("positions", [False, True], ids=["velocity", "positions"])
def test_covariances_of_differences_are_their_diagonals(positions):
    """Whitening by diagonals is that by the dense matrix, at uneven times and sd."""
    rng = np.random.default_rng(0)
    t = np.sort(rng.uniform(0, 30, 25))
    value = rng.normal(size=(25, 3)) * ([1e-6, 1e-6, 1.0] if positions else 1.0) + [0.8, 0.2, 100.0]
    fixes = Samples(t, value, rng.uniform(0.5, 2.0, (25, 3)), np.zeros((25, 3)))
    lla = np.array([0.8, 0.2, 100.0])
    seen = differences(fixes, positions, lla, 0.0, driving=0.3)
    sd = fixes.sd if positions else np.column_stack([fixes.sd[:, :2], np.minimum(fixes.sd[:, 2], 1.0)])
    weights = rng.normal(size=(len(seen.D), 4))
    below = lambda band: sum(np.diag(d[: d.size - k], -k) for k, d in enumerate(band))
    dense = lambda band: below(band) + np.tril(below(band), -1).T
    for a in range(3):
        C = seen.D @ np.diag(sd[:, a] ** 2) @ seen.D.T
        np.testing.assert_allclose(dense(seen.covariances[a]), C, rtol=1e-9, atol=1e-12)
        root = cholesky_banded(seen.covariances[a] + seen.drift, lower=True)
        L = np.linalg.cholesky(C + dense(seen.drift))
        np.testing.assert_allclose(whitened(root, weights), np.linalg.solve(L, weights), rtol=1e-8, atol=1e-9)


def test_a_bias_does_not_lead_to_another_heading():
    """A ship that hardly turns, with 1 deg/s on gyro z: from the first guess alone chi^2 is 4.4 and heading lost."""
    rec, _ = simulated("ship", "consumer", True, np.random.default_rng(1), span=60.0, late=0.0)
    grade = GRADES["consumer"]
    prior = AlignmentPrior(2 * grade.gyro_turn_on, 2 * grade.accel_turn_on)
    lla = rec.aiding["position"].value[0]
    found = align(rec.imu, rec.aiding["velocity"], False, lla, 10.5, 30.5, prior, np.zeros(3))
    assert found.chi2 < 1.5 and found.sd[2] < 10 * DEG


def standing(seconds=30.0, rate=100.0):
    """A tilted IMU at rest on the turning Earth, with a gyro bias."""
    t = np.arange(1, round(seconds * rate) + 1) / rate
    C = np.asarray(rotations.from_rph(jnp.asarray([0.1, -0.2, 2.0])))
    rng = np.random.default_rng(0)
    accel = np.tile(C.T @ [0, 0, 9.81], (t.size, 1)) + 0.02 * rng.normal(size=(t.size, 3))
    gyro = np.tile([2e-3, -1e-3, 3e-3], (t.size, 1)) + 1e-3 * rng.normal(size=(t.size, 3))
    k = np.arange(1.0, seconds)
    fixes = Samples(k, 0.05 * rng.normal(size=(k.size, 3)), np.full((k.size, 3), 0.05), np.zeros((k.size, 3)))
    return ImuLog(t, np.full(t.size, 1 / rate), gyro, accel), fixes


def test_at_rest_the_tilt_is_known_and_the_heading_is_not():
    imu, fixes = standing()
    found = align(imu, fixes, False, np.array([0.8, 0.1, 100.0]), 0.0, 30.0, BELIEVED, np.zeros(3))
    rph = np.asarray(rotations.to_rph(jnp.asarray(found.C)))
    np.testing.assert_allclose(rph[:2], [0.1, -0.2], atol=4 * found.sd[:2].max())
    assert found.sd[2] >= alignment.UNKNOWN_ATTITUDE_SD and found.sd[:2].max() < 2 * DEG
    assert (np.abs(found.gyro_bias - [2e-3, -1e-3, 3e-3]) < 4 * found.sd[3:6]).all()
    assert align(imu, fixes, False, np.zeros(3), 0.0, 3.0, BELIEVED, np.zeros(3)) is None  # too few fixes


def test_rotations_by_prefix_products_are_those_of_a_loop():
    rng = np.random.default_rng(0)
    gyro, dt = rng.normal(size=(37, 3)), rng.uniform(0.005, 0.02, 37)
    middle, ends = rotations_since(gyro, dt)
    C = np.eye(3)
    for w, d, half, end in zip(gyro, dt, middle, ends, strict=True):
        np.testing.assert_allclose(half, C @ Rotation.from_rotvec(0.5 * w * d).as_matrix(), atol=1e-13)
        C = C @ Rotation.from_rotvec(w * d).as_matrix()
        np.testing.assert_allclose(end, C, atol=1e-13)


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("states", [(), ("gyro_bias", "accel_bias"), ("accel_bias",)], ids=len)
def test_the_filter_starts_with_the_correlations_that_were_found(case, frame, states):
    rng = np.random.default_rng(2)
    W = rng.normal(size=(12, 15)) * np.repeat([0.3, 0.02, 0.003, 0.1], 3)[:, None]
    P = W @ W.T
    sd = np.sqrt(np.diag(P))
    root = correlation_root(P)
    np.testing.assert_allclose(root @ root.T, P / np.outer(sd, sd), atol=1e-7)
    params = build("ekf15").params("consumer")
    own = {"gyro_bias": sd[6:9], "accel_bias": sd[9:]}
    motion = {"velocity": jnp.asarray(sd[:3]), "attitude": jnp.asarray(sd[3:6]), "correlated": jnp.asarray(root)}
    known = params._replace(
        prior=params.prior._replace(**motion),
        states={name: params.states[name]._replace(sd=jnp.asarray(s)) for name, s in own.items()},
    )
    model = error_model(frame, states)
    nav = model.enter(case.nav._replace(errors={name: jnp.zeros(3) for name in own}))
    _, _, found = model.report(nav, jnp.zeros(model.n_states), model.covariance(known, nav))
    keep = [i for i in range(12) if i < 6 or ("gyro_bias", "accel_bias")[i // 9] in states]
    scale = np.outer(sd[keep], sd[keep])
    np.testing.assert_allclose(np.asarray(found)[3:, 3:] / scale, P[np.ix_(keep, keep)] / scale, atol=1e-6)
    assert np.abs(np.asarray(found)[:3, 3:]).max() < 1e-12


def test_fast_samples_are_put_together_by_their_means():
    """At 400 Hz three by three; nothing of what they turn and push is lost."""
    t = 0.0025 * np.arange(1, 1000)
    rng = np.random.default_rng(0)
    imu = ImuLog(t, np.full(t.size, 0.0025), rng.normal(size=(t.size, 3)), rng.normal(size=(t.size, 3)))
    found = alignment.window(imu, 0.0, t[-1])
    assert found.t.size == 333 and found.dt.sum() == pytest.approx(t[-1])
    for name in ("gyro", "accel"):
        own, all_of_it = getattr(found, name), getattr(imu, name).sum(0) * 0.0025
        np.testing.assert_allclose((own * found.dt[:, None]).sum(0), all_of_it, atol=1e-12)
