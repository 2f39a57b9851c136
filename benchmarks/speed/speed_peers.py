"""Other packages on the workload of the speed benchmark: each is left out, with a notice, where it is not installed.

python-ins does all of it. filterpy, kalman-py, dynamax and cuthbert are Kalman filters without navigation: they get
Phi and Q of every sample ready made, and their covariance is compared with ours. The latter two know no sample without
a measurement: between fixes theirs says next to nothing.
"""

import importlib
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from benchmarks.speed import speed_plain
from benchmarks.speed.speed_plain import noise_of, prior_sd
from jaxnav.filters.run import track
from jaxnav.maths import rotations, units
from jaxnav.states.table import BIASES
from jaxnav.types import Epoch, Nav, Params
from tests import reference

NOTHING = 1e9  # sd of a measurement that says nothing, in units of a real one's


def found(name: str) -> Any:
    """The module, or None and a notice."""
    try:
        return importlib.import_module(name)
    except ImportError:
        print(f"{name.split('.')[0]} is not installed: its rows are left out (extras oracle and compare)")
        return None


# ---------------------------------------------------------------------------- a plain numpy loop


def error_dynamics(lla: np.ndarray, v: np.ndarray, C: np.ndarray, f: np.ndarray, n: int) -> np.ndarray:
    """F of the full error dynamics, (n, n)."""
    lat, _, h = lla
    m, p = reference.radii(lat)
    rn, re, tan = m + h, p + h, np.tan(lat)
    ie, en, skew = reference.earth_rate(lat), reference.transport(lat, h, v), reference.cross_matrix
    level = np.array([[0, 1 / rn, 0], [-1 / re, 0, 0], [-tan / re, 0, 0]])
    north = reference.RATE / rn * np.array([0, -np.sin(lat), np.cos(lat)])
    turn = np.array([0, 0, v[0] / (re * rn) * (1 + tan**2)])
    up = np.array([v[1] / rn**2, -v[0] / re**2, -v[0] * tan / re**2])
    F = np.zeros((n, n))
    F[0, :3] = v[2] / re - v[1] * tan / rn, v[0] * tan / rn, -v[0] / re
    F[1, 1:3] = v[2] / rn, -v[1] / rn
    F[0:3, 3:6] = np.eye(3)
    F[3:6, 0:3] = skew(v) @ np.stack([np.zeros(3), 2 * north + turn, up], 1)
    F[5, 2] += 2 * reference.gravity(lat, 0.0) / reference.A
    F[3:6, 3:6] = -skew(2 * ie + en) - skew(v) @ level
    F[3:6, 6:9] = -skew(f)
    F[6:9, 0:3] = -np.stack([np.zeros(3), north + turn, up], 1)
    F[6:9, 3:6] = level
    F[6:9, 6:9] = -skew(ie + en)
    if n == 15:
        F[6:9, 9:12] = F[3:6, 12:15] = -C
    return F


def numpy_loop(n: int, params: Params, nav: Nav, epochs: Epoch) -> Callable[[], np.ndarray]:
    """Sample by sample with dense matrices, like the nested scan; positions at the epochs, (E, 3)."""
    imu, fix = (jax.tree.map(np.asarray, part) for part in (epochs.imu, epochs.fix))
    start = np.asarray(nav.pos), np.asarray(nav.vel), np.asarray(rotations.to_dcm(nav.q))
    noise, variance = noise_of(params), np.asarray(prior_sd(params, n)) ** 2
    sides = [0.0, noise.accel, noise.gyro, noise.gyro_bias, noise.accel_bias]
    G = np.diag(np.concatenate([np.broadcast_to(np.asarray(sd), 3) ** 2 for sd in sides])[:n])
    scale = np.concatenate([np.broadcast_to(np.asarray(a), 3) for a in (noise.position_scale, noise.velocity_scale)])
    H, eye = np.eye(6, n), np.eye(n)

    def call() -> np.ndarray:
        state, P, out = reference.Strapdown(*start, n), np.diag(variance), []
        for e in range(len(imu.dt)):
            for dt, gyro, accel in zip(imu.dt[e], imu.gyro[e], imu.accel[e], strict=True):
                C, f = state.advance(dt, gyro, accel)
                FT = error_dynamics(state.lla, state.v, C, f, n) * dt
                Phi = eye + FT + 0.5 * FT @ FT
                P = Phi @ P @ Phi.T + G * dt
            R, value = np.diag((scale * fix.sd[e]) ** 2), fix.value[e]
            nu = np.concatenate([reference.metres(state.lla) @ (state.lla - value[:3]), state.v - value[3:]])
            K = np.linalg.solve(H @ P @ H.T + R, H @ P).T
            A = eye - K @ H
            x = K @ nu
            state.remove(x)
            turned = np.eye(n)
            turned[6:9, 6:9] = reference.rotation(-0.5 * x[6:9])
            P = turned @ (A @ P @ A.T + K @ R @ K.T) @ turned.T
            out.append(state.lla.copy())
        return np.stack(out)

    return call


# ---------------------------------------------------------------------------- python-ins


def python_ins(params: Params, nav: Nav, epochs: Epoch, time_step: float) -> Callable[[], np.ndarray] | None:
    """`run_feedback_filter` with 15 states, and scale factors and misalignment where ``params`` have them.

    Positions before the next epoch begins, (E - 1, 3) rad and m.
    """
    filters, pd = found("pyins.filters"), found("pandas")
    if filters is None or pd is None:
        return None
    sensor, measurements = found("pyins.inertial_sensor"), found("pyins.measurements")
    strapdown, util = found("pyins.strapdown"), found("pyins.util")
    to_pyins, ned = np.array([1 / units.DEG, 1 / units.DEG, 1.0]), np.array([1, 0, 2])
    flip = np.array([1.0, 1.0, -1.0])
    dt, gyro, accel = (np.asarray(a).reshape(-1, *a.shape[2:]) for a in epochs.imu)
    time = np.round(np.concatenate([[0.0], np.cumsum(dt)]), 6)
    readings = np.concatenate([np.zeros((1, 6)), np.concatenate([gyro, accel], 1) * dt[:, None]])
    log = pd.DataFrame(readings, index=time, columns=util.GYRO_COLS + util.ACCEL_COLS)
    increments = strapdown.compute_increments_from_imu(log, "increment")
    t = time[epochs.imu.dt.shape[1] :: epochs.imu.dt.shape[1]]
    seen = np.asarray(epochs.fix.valid).all(1)
    value, sd = np.asarray(epochs.fix.value)[seen], np.asarray(epochs.fix.sd[0])
    aiding = [
        measurements.Position(pd.DataFrame(value[:, :3] * to_pyins, t[seen], util.LLA_COLS), sd[:3][ned]),
        measurements.NedVelocity(pd.DataFrame(value[:, 3:][:, ned] * flip, t[seen], util.VEL_COLS), sd[3:][ned]),
    ]
    begin = track(jax.tree.map(lambda a: a[None], nav))
    pva = np.concatenate([begin.lla[0] * to_pyins, begin.vel[0][ned] * flip, begin.rph[0] / units.DEG])
    noise, prior = noise_of(params), [np.broadcast_to(sd, 3) for sd in params.prior[:3]]
    biases = [params.states[name].sd for name in BIASES]
    sd_of = lambda name: np.max(params.states[name].sd) if name in params.states else 0.0
    matrix = lambda a, b: np.where(np.eye(3, dtype=bool), sd_of(a), sd_of(b))
    model = lambda bias, white, walk, a, b: sensor.EstimationModel(*map(np.max, (bias, white, walk)), matrix(a, b))

    def call() -> np.ndarray:
        result = filters.run_feedback_filter(
            pd.Series(pva, util.TRAJECTORY_COLS, name=0.0), float(prior[0][0]), float(prior[1][0]),
            float(prior[2][0]) / units.DEG, float(prior[2][2]) / units.DEG, increments,
            model(biases[0], noise.gyro, noise.gyro_bias, "gyro_scale", "gyro_misalignment"),
            model(biases[1], noise.accel, noise.accel_bias, "accel_scale", "accel_misalignment"),
            aiding, time_step,
        )  # fmt: skip
        return result.trajectory.loc[t[:-1], util.LLA_COLS].to_numpy() / to_pyins

    return call


# ---------------------------------------------------------------------------- Kalman filters without navigation


class Given(NamedTuple):
    """The error dynamics of a drive, ready made."""

    Phi: jax.Array  # (N, n, n) of every sample
    Q: jax.Array  # (n, n)
    P0: jax.Array  # (n, n)
    H: jax.Array  # (6, n)
    sd: jax.Array  # (6,) of a fix
    sds: jax.Array  # (N, 6) of the measurement after every sample: a fix, or nothing
    k: int  # samples up to each fix


def given(n: int, params: Params, nav: Nav, epochs: Epoch) -> Given:
    """Along one run without corrections."""
    first = speed_plain.initial(params, nav, n)

    def sample(s, imu):
        s, Phi, Q = speed_plain.transition(noise_of(params), s, imu)
        return s, (Phi, Q)

    E, k = epochs.imu.dt.shape
    _, (Phi, Q) = jax.jit(partial(lax.scan, sample))(first, jax.tree.map(lambda a: jnp.concatenate(a), epochs.imu))
    sd, measured = epochs.fix.sd[0], (jnp.arange(E * k) + 1) % k == 0
    sds = jnp.where(measured[:, None], 1.0, NOTHING) * sd
    return Given(Phi, Q[0], first.P, jnp.eye(6, n), sd, sds, k)


@jax.jit
def covariance(g: Given) -> jax.Array:
    """The last covariance, by Joseph's form: the packages are compared with it."""

    def sample(P, x):
        Phi, sd = x
        P, R = Phi @ P @ Phi.T + g.Q, jnp.diag(sd**2)
        K = jnp.linalg.solve(g.H @ P @ g.H.T + R, g.H @ P).T
        A = jnp.eye(P.shape[0]) - K @ g.H
        return A @ P @ A.T + K @ R @ K.T, None

    return lax.scan(sample, g.P0, (g.Phi, g.sds))[0]


def sampled(name: str, make: Callable[..., Any]) -> Callable[[Given], Callable[[], Any] | None]:
    """The last covariance by a package that predicts sample by sample, and takes fixes where there are some, like ours.

    ``make`` gives its filter, of the package, F, Q, R and P0.
    """

    def of(g: Given) -> Callable[[], Any] | None:
        package = found(name)
        if package is None:
            return None
        Phi, Q, P0, R = (np.asarray(a) for a in (g.Phi, g.Q, g.P0, jnp.diag(g.sd**2)))

        def call() -> np.ndarray:
            kf, z = make(package, Phi[0], Q, R, P0.copy()), np.zeros(6)
            for i in range(len(Phi)):
                kf.predict(F=Phi[i])
                if (i + 1) % g.k == 0:
                    kf.update(z)
            return kf.P

        return call

    return of


def filterpy(package: Any, F: np.ndarray, Q: np.ndarray, R: np.ndarray, P0: np.ndarray) -> Any:
    """A filter of filterpy."""
    kf = package.KalmanFilter(dim_x=len(P0), dim_z=6)
    kf.P, kf.Q, kf.R, kf.H = P0, Q, R, np.eye(6, len(P0))
    return kf


def kalman_py(package: Any, F: np.ndarray, Q: np.ndarray, R: np.ndarray, P0: np.ndarray) -> Any:
    """A filter of kalman-py by numpy: with JAX it has one F for all samples."""
    return package.KalmanFilter(F, np.eye(6, len(P0)), Q, R, np.zeros(len(P0)), P0)


def dynamax(g: Given) -> Callable[[], Any] | None:
    """The last covariance by `lgssm_filter`."""
    package = found("dynamax.linear_gaussian_ssm.inference")
    if package is None:
        return None
    n = len(g.P0)
    first = g.Phi[0] @ g.P0 @ g.Phi[0].T + g.Q  # it begins with a measurement
    filt = jax.jit(lambda Phi, sds: package.lgssm_filter(package.ParamsLGSSM(
        package.ParamsLGSSMInitial(jnp.zeros(n), first),
        package.ParamsLGSSMDynamics(Phi, jnp.zeros(n), jnp.zeros((n, 0)), g.Q),
        package.ParamsLGSSMEmissions(g.H, jnp.zeros(6), jnp.zeros((6, 0)), jax.vmap(jnp.diag)(sds**2)),
    ), jnp.zeros((len(g.Phi), 6))).filtered_covariances)  # fmt: skip
    return lambda: filt(g.Phi, g.sds)[-1]


def cuthbert(g: Given) -> Callable[[], Any] | None:
    """The last covariance by the square-root filter, one sample after the other."""
    package = found("cuthbert")
    if package is None:
        return None
    kalman = importlib.import_module("cuthbert.gaussian.kalman")
    n, root = len(g.P0), jnp.sqrt(g.Q)  # both diagonal
    filt = kalman.build_filter(
        jnp.zeros(n), jnp.sqrt(g.P0), lambda x: (x[0], jnp.zeros(n), root),
        lambda x: (g.H, jnp.zeros(6), jnp.diag(x[1]), jnp.zeros(6)),
    )  # fmt: skip
    run = jax.jit(lambda inputs: package.filter(filt, inputs, filt.init_prepare(), parallel=False).chol_cov)

    def call() -> jax.Array:
        U = run((g.Phi, g.sds))[-1]
        return U @ U.T

    return call


KALMAN = {
    "filterpy": sampled("filterpy.kalman", filterpy), "kalman-py": sampled("kalman_py", kalman_py),
    "dynamax": dynamax, "cuthbert": cuthbert,
}  # fmt: skip
