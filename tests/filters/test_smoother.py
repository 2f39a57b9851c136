"""The smoother against a batch least-squares solution of the same linear problem, and against the truth."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from jaxnav.analysis import metrics
from jaxnav.filters.catalogue import build
from jaxnav.filters.core import make_filter
from jaxnav.filters.epochs import hide, pad_epochs
from jaxnav.filters.error_model import error_model
from jaxnav.filters.feedback import open_loop
from jaxnav.filters.parameters import get, put
from jaxnav.filters.rules.kalman import kalman
from jaxnav.filters.run import run
from jaxnav.filters.smoother import keep, reach_of, smooth, smooth_jit
from jaxnav.maths import linalg, rotations
from jaxnav.strapdown.frames import FRAMES
from jaxnav.types import Epoch


def turned_by(x: np.ndarray) -> np.ndarray:
    """J (n, n) of a correction by x (n,), written out."""
    J = np.eye(x.size)
    J[6:9, 6:9] = Rotation.from_rotvec(-0.5 * x[6:9]).as_matrix()
    return J


def batch(filt, params, nav, epochs: Epoch) -> tuple[np.ndarray, np.ndarray]:
    """Errors e_k after each epoch's feedback, all of them in one least squares, and the sd once they are taken out.

    e-_{k+1} = Phi e_k + d + w, nu = H e-_{k+1} + v, e_{k+1} = J (e-_{k+1} - what was fed back).
    """
    state, steps = filt.init(params, nav), []
    transition, correct, observe = jax.jit(filt.transition), jax.jit(filt.correct), jax.jit(filt.model.observe)
    P0 = np.asarray(state.P)
    for i in range(epochs.fix.sd.shape[0]):
        epoch = jax.tree.map(lambda a, i=i: a[i], epochs)
        predicted, moved = transition(params, state, epoch.imu)
        y, H, R = observe(params, predicted.past, epoch.fix)
        rows = np.asarray(epoch.fix.valid)
        after, info = correct(params, predicted, epoch.fix)
        fed = np.asarray(info.x) - np.asarray(after.x)
        valid = np.asarray(y)[rows], np.asarray(H)[rows], np.asarray(R)[np.ix_(rows, rows)]
        steps.append((*map(np.asarray, moved), *valid, fed))
        state = after
    # every error is a sum of what nobody knows: the error at the start and each epoch's w, together u with covariance C
    n, K = P0.shape[0], len(steps)
    C = block_diag(P0, *(step[1] for step in steps))
    carried, fed_so_far = np.hstack([np.eye(n), np.zeros((n, n * K))]), np.zeros(n)
    errors, offsets, told, values, R = [], [], [], [], []
    for k, (Phi, _, d, y, H, cov, fed) in enumerate(steps):
        carried = Phi @ carried
        carried[:, (k + 1) * n : (k + 2) * n] = np.eye(n)
        fed_so_far = Phi @ fed_so_far - d
        if len(y):
            told.append(H @ carried)
            values.append(y + H @ fed_so_far)
            R.append(cov)
        J = turned_by(fed)
        carried, fed_so_far = J @ carried, J @ (fed_so_far + fed)
        errors.append(carried.copy())
        offsets.append(fed_so_far)
    M, z = np.vstack(told), np.concatenate(values)
    S = M @ C @ M.T + block_diag(*R)
    e, sd = [], []
    for F, off in zip(errors, offsets, strict=True):
        cross = F @ C @ M.T
        e.append(cross @ np.linalg.solve(S, z) - off)
        J = turned_by(e[-1])
        sd.append(np.sqrt(np.diag(J @ (F @ C @ F.T - cross @ np.linalg.solve(S, cross.T)) @ J.T)))
    return np.array(e), np.array(sd)


@pytest.mark.full
def test_it_is_the_batch_solution_of_the_same_linear_problem(case):
    """To 1e-10 of a standard deviation, with fixes hidden for a while; covariance too."""
    filt = build("ekf15", cov_stride=5)
    epochs = jax.tree.map(lambda a: a[:20], case.packed.epochs)
    epochs = hide(epochs, (np.arange(20) > 7) & (np.arange(20) < 13))
    _, smoothed = smooth_jit(filt, case.params, case.nav, epochs)
    expected, sd = batch(filt, case.params, case.nav, epochs)
    np.testing.assert_allclose(np.asarray(smoothed.x) / sd, expected / sd, atol=1e-10)
    mine = np.sqrt(np.asarray(jax.vmap(jnp.diag)(smoothed.P)))
    np.testing.assert_allclose(mine / sd, 1.0, atol=1e-10)


@pytest.mark.full
def test_error_that_is_not_fed_back_is_carried(case):
    """In open loop, likewise: the estimate that stays is part of what is smoothed."""
    frame = FRAMES["local_level"]
    filt = make_filter(frame.fast, error_model(), kalman(), open_loop, 5)
    epochs = jax.tree.map(lambda a: a[:12], case.packed.epochs)
    epochs = hide(epochs, (np.arange(12) > 4) & (np.arange(12) < 9))
    forward, _ = run(filt, case.params, case.nav, epochs, keep)
    assert float(jnp.abs(forward.a).max()) > 0
    _, smoothed = smooth_jit(filt, case.params, case.nav, epochs)
    expected, sd = batch(filt, case.params, case.nav, epochs)
    np.testing.assert_allclose(np.asarray(smoothed.x + forward.a) / sd, expected / sd, atol=1e-10)


def errors(info, truth_pos, truth_vel):
    position = np.asarray(jax.vmap(metrics.position_error)(info.nav, truth_pos))
    return position, np.asarray(info.nav.vel) - truth_vel


def test_it_is_nearer_to_the_truth_and_knows_how_near(case):
    """A minute with twenty seconds hidden: less drift inside, a covariance that holds, and never a larger one."""
    filt = build("ekf15", cov_stride=5)
    at = np.searchsorted(case.truth.t, case.packed.t - 1e-6)
    hidden = (np.arange(60) > 25) & (np.arange(60) < 46)
    epochs = hide(case.packed.epochs, hidden)
    filtered, smoothed = smooth_jit(filt, case.params, case.nav, epochs)
    truth = jnp.asarray(case.truth.lla[at]), case.truth.vel[at]
    (fp, _), (sp, _) = errors(filtered, *truth), errors(smoothed, *truth)
    inside = np.flatnonzero(hidden)
    assert np.sqrt((sp[inside] ** 2).mean()) < 0.5 * np.sqrt((fp[inside] ** 2).mean())
    P = np.asarray(smoothed.P)
    assert min(np.linalg.eigvalsh(p / np.outer(s := np.sqrt(np.diag(p)), s)).min() for p in P) > 0
    sd_s, sd_f = (np.sqrt(np.asarray(jax.vmap(jnp.diag)(i.P))) for i in (smoothed, filtered))
    assert (sd_s <= sd_f * (1 + 1e-6)).all() and (np.abs(sp) < 4.5 * sd_s[:, :3]).all()
    np.testing.assert_allclose(smoothed.P[-1], filtered.P[-1], rtol=1e-12)
    np.testing.assert_array_equal(smoothed.nu, filtered.nu)
    # residuals are of smoothed navigation: against the fixes that were hidden
    fix = np.asarray(case.packed.epochs.fix.value)
    off = np.asarray(jax.vmap(metrics.position_error)(smoothed.nav, fix[:, :3]))
    np.testing.assert_allclose(smoothed.residual[:, :3], off, atol=2e-3)
    np.testing.assert_allclose(smoothed.residual[:, 3:6], np.asarray(smoothed.nav.vel) - fix[:, 3:6], atol=2e-3)


@pytest.mark.full
@pytest.mark.parametrize("frame", ["tangent", "inertial"])
def test_frames_smooth_alike(case, frame):
    epochs = jax.tree.map(lambda a: a[:15], case.packed.epochs)
    epochs = hide(epochs, (np.arange(15) > 5) & (np.arange(15) < 11))
    a, b = (smooth_jit(build("ekf15", frame=f, cov_stride=5), case.params, case.nav, epochs)[1]
            for f in ("local_level", frame))  # fmt: skip
    apart = np.asarray(jax.vmap(lambda p, q: metrics.position_error(p, q.pos))(a.nav, b.nav))
    turn = jax.vmap(lambda p, q: rotations.log(rotations.multiply(p, rotations.conjugate(q))))(a.nav.q, b.nav.q)
    sd = np.sqrt(np.asarray(jax.vmap(jnp.diag)(a.P)))
    assert np.abs(apart).max() < 0.03 * sd[:, :3].max() and np.abs(turn).max() < 0.03 * sd[:, 6:9].max()
    np.testing.assert_allclose(np.sqrt(np.asarray(jax.vmap(jnp.diag)(b.P)))[:, :9], sd[:, :9], rtol=0.03)


@pytest.mark.full
def test_a_fixed_lag_is_the_smoother_of_what_came_so_far(case):
    """Of each epoch by the fixes of the next three seconds: as if the recording ended there; none and all are known."""
    filt, epochs = build("ekf15", cov_stride=5), jax.tree.map(lambda a: a[:12], case.packed.epochs)
    t = np.asarray(case.packed.t[:12])
    reach, most = reach_of(t, 3.0)
    assert most == 3 and reach.tolist() == [*range(3, 12), 11, 11, 11]
    filtered, late = smooth_jit(filt, case.params, case.nav, epochs, reach, most)
    for k in (0, 4, 8, 10):
        cut = pad_epochs(jax.tree.map(lambda a, k=k: a[: reach[k] + 1], epochs), *epochs.imu.dt.shape)  # one program
        _, whole = smooth_jit(filt, case.params, case.nav, cut)
        np.testing.assert_allclose(late.nav.pos[k], whole.nav.pos[k], atol=1e-13)
        np.testing.assert_allclose(late.P[k], whole.P[k], rtol=1e-7, atol=1e-14)
    none = smooth_jit(filt, case.params, case.nav, epochs, *reach_of(t, 0.0))[1]
    np.testing.assert_allclose(none.nav.pos, filtered.nav.pos, atol=1e-14)
    every = smooth_jit(filt, case.params, case.nav, epochs, *reach_of(t, 1e3))[1]
    np.testing.assert_allclose(every.P, smooth_jit(filt, case.params, case.nav, epochs)[1].P, rtol=1e-7, atol=1e-14)


def test_a_rule_without_a_way_back_is_refused(case):
    for name in ("gpid", "gipkf"):
        with pytest.raises(ValueError, match="smoothing is for Kalman, robust, adaptive and fading rules"):
            smooth(build(name), case.params, case.nav, case.packed.epochs)
    assert all(build(name).supports_smoothing for name in ("ekf15", "ekf9", "ekf15_gate", "ekf15_huber", "fwekf15"))


@pytest.mark.full
def test_the_record_costs_a_plain_run_nothing(case):
    filt = build("ekf9", cov_stride=5)
    epochs = jax.tree.map(lambda a: a[:5], case.packed.epochs)
    forward, info = run(filt, case.params, case.nav, epochs, keep)
    plain = run(filt, case.params, case.nav, epochs)
    np.testing.assert_allclose(info.nav.pos, plain.nav.pos, rtol=1e-14)
    assert forward.Phi.shape == (5, 9, 9)


@pytest.mark.full
def test_gradients_go_through_it(case):
    """Normalised errors at hidden fixes, by noise and lever arm: central differences."""
    filt = build("ekf15", cov_stride=5)
    hidden = (np.arange(30) > 10) & (np.arange(30) < 22)
    epochs = hide(jax.tree.map(lambda a: a[:30], case.packed.epochs), hidden)
    fix_sd = case.packed.epochs.fix.sd[:30, :3]
    leaves = ("noise.accel", "measurements.velocity.scale", "mounting.lever_arm")

    def score(moved):
        params = put(case.params, "noise.accel", 30 * case.params.noise.accel)  # so much that it is seen in 12 s
        for name, d in zip(leaves, moved, strict=True):
            params = put(params, name, get(params, name) + d * (0.1 if "lever" in name else get(params, name)))
        info = smooth(filt, params, case.nav, epochs)[1]
        z2 = jax.vmap(linalg.normalized)(info.residual[:, :3], info.P[:, :3, :3] + jax.vmap(jnp.diag)(fix_sd**2))
        return jnp.sum(jnp.where(hidden, z2, 0.0))

    value, slope = jax.jit(score), jax.jit(jax.jacfwd(score))
    mine, step = np.asarray(slope(jnp.zeros(3))), 1e-3
    for i in range(3):
        off = jnp.zeros(3).at[i].set(step)
        assert mine[i] == pytest.approx(float(value(off) - value(-off)) / (2 * step), rel=1e-4)
    back = np.asarray(jax.jit(jax.grad(score))(jnp.zeros(3)))
    np.testing.assert_allclose(back, mine, rtol=1e-6)
