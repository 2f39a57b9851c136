"""Naive numpy loops of strapdown, Kalman filter and GPID, written from the equations and not from the package.

Rotations are matrices (Rodrigues), epochs are loops, the full error dynamics are complex-step derivatives of the
nonlinear equations. States (dp ENU, dv ENU, phi ENU[, b_g, b_a]), x = estimate - truth; closed loop with reset.
"""

import numpy as np
from scipy.linalg import expm

A, F, RATE = 6378137.0, 1 / 298.257223563, 7.292115e-5
E2 = F * (2 - F)
GE, GP = 9.7803253359, 9.8321849378


def cross_matrix(v):
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def rotation(v):
    """Rodrigues' formula."""
    n = np.linalg.norm(v)
    if n < 1e-12:
        return np.eye(3) + cross_matrix(v)
    K = cross_matrix(v / n)
    return np.eye(3) + np.sin(n) * K + (1 - np.cos(n)) * K @ K


def radii(lat):
    w2 = 1 - E2 * np.sin(lat) ** 2
    return A * (1 - E2) / w2**1.5, A / np.sqrt(w2)


def gravity(lat, h):
    s2 = np.sin(lat) ** 2
    k = (A * (1 - F) * GP) / (A * GE) - 1
    return GE * (1 + k * s2) / np.sqrt(1 - E2 * s2) * (1 - 2 * h / A)


def earth_rate(lat):
    return RATE * np.array([0 * lat, np.cos(lat), np.sin(lat)])


def transport(lat, h, v):
    m, n = radii(lat)
    return np.array([-v[1] / (m + h), v[0] / (n + h), v[0] * np.tan(lat) / (n + h)])


def metres(lla):
    """East, north, up for a change of lat, lon, h: matrix."""
    m, n = radii(lla[0])
    return np.array([[0, (n + lla[2]) * np.cos(lla[0]), 0], [m + lla[2], 0, 0], [0, 0, 1.0]])


def root(value):
    """(3, 3) of a number, one an axis, or itself."""
    return np.asarray(value) if np.ndim(value) == 2 else np.diag(np.broadcast_to(value, 3))


class Strapdown:
    """Local level navigation: C body to ENU, v ENU, lla."""

    def __init__(self, lla, v, C, n):
        self.lla, self.v, self.C = np.array(lla, float), np.array(v, float), np.array(C, float)
        self.b_g, self.b_a, self.n = np.zeros(3), np.zeros(3), n
        self.w0, self.f0 = np.zeros(3), np.zeros(3)

    def advance(self, dt, gyro, accel):
        """One sample; returns mean C and mean specific force in ENU."""
        w, f = gyro - self.b_g, accel - self.b_a
        turn = w * dt + np.cross(self.w0, w) * dt**2 / 12  # coning
        dv = f * dt + np.cross(w, f) * dt**2 / 2 + np.cross(w, np.cross(w, f)) * dt**3 / 6
        dv = dv + (np.cross(self.w0, f) + np.cross(self.f0, w)) * dt**2 / 12  # sculling
        self.w0, self.f0 = w, f
        lat, h = self.lla[0] + 0.5 * dt * self.v[1] / A, self.lla[2] + 0.5 * dt * self.v[2]  # half-way
        g, ie = np.array([0, 0, -gravity(lat, h)]), earth_rate(lat)

        def fall(v):
            return dt * (g - np.cross(2 * ie + transport(lat, h, v), v))

        level0 = dt * (ie + transport(lat, h, self.v))
        push = self.C @ dv
        push = push - np.cross(level0, push) / 2 + np.cross(level0, np.cross(level0, push)) / 12
        half = self.v + 0.5 * (push + fall(self.v))
        level = dt * (ie + transport(lat, h, half))
        dv_n = push + fall(half)
        mean = self.v + dv_n / 2
        m, n = radii(lat)
        dlat, dlon = mean[1] * dt / (m + h), mean[0] * dt / ((n + h) * np.cos(lat))
        before = self.C
        self.C = rotation(-level) @ self.C @ rotation(turn)
        self.v, self.lla = self.v + dv_n, self.lla + [dlat, dlon, mean[2] * dt]
        C = (before + self.C) / 2
        return C, C @ f

    def remove(self, x):
        """Take the estimated error out."""
        self.lla = self.lla - np.linalg.solve(metres(self.lla), x[:3])
        self.v = self.v - x[3:6]
        self.C = rotation(-x[6:9]) @ self.C
        if self.n == 15:
            self.b_g, self.b_a = self.b_g - x[9:12], self.b_a - x[12:15]


def simple_dynamics(lla, v, C, f, n):
    """Paper, eqs. 9-13: dp' = dv, dv' = -f x phi, and levelling by velocity; biases enter through C."""
    lat, _, h = lla
    m, p = radii(lat)
    M = np.zeros((15, 15))
    M[0:3, 3:6] = np.eye(3)
    M[3:6, 6:9] = -cross_matrix(f)
    M[6:9, 3:6] = [[0, 1 / (m + h), 0], [-1 / (p + h), 0, 0], [-np.tan(lat) / (p + h), 0, 0]]
    M[6:9, 9:12] = M[3:6, 12:15] = -C
    return M[:n, :n]


def full_dynamics(lla, v, C, f, n):
    """Complex-step derivative of x' = d/dt (estimate - truth) by x, of the nonlinear equations themselves."""
    lat, _, h = lla

    def velocity_rate(lla, v, f_n):
        w = 2 * earth_rate(lla[0]) + transport(lla[0], lla[2], v)
        return f_n - np.cross(w, v) + np.array([0, 0, -gravity(lla[0], lla[2])])

    def position_rate(lla, v):
        m, p = radii(lla[0])
        return np.array([v[1] / (m + lla[2]), v[0] / ((p + lla[2]) * np.cos(lla[0])), v[2]])

    M, rate = metres(lla), position_rate(lla, v)
    M_rate = metres(lla + 1e-30j * rate).imag / 1e-30
    w_in = earth_rate(lat) + transport(lat, h, v)
    columns = []
    for i in range(15):
        x = np.zeros(15, complex)
        x[i] = 1e-30j
        d_lla = np.linalg.solve(M, x[:3])
        t_lla, t_v = lla - d_lla, v - x[3:6]
        # truth: C_t = exp(-phi) C, with the sensors' true specific force f - b_a error: C_t (f_b + x_ba)
        turn = np.eye(3) - np.array(cross_matrix(x[6:9]))
        t_f = turn @ (f + C @ x[12:15])
        dp = M @ (rate - position_rate(t_lla, t_v)) + M_rate @ d_lla
        dv = velocity_rate(lla, v, f) - velocity_rate(t_lla, t_v, t_f)
        t_in = earth_rate(t_lla[0]) + transport(t_lla[0], t_lla[2], t_v)
        phi = -(w_in - t_in) - np.cross(w_in, x[6:9]) - C @ x[9:12]
        columns.append(np.concatenate([dp, dv, phi, np.zeros(6)]).imag / 1e-30)
    return np.stack(columns, 1)[:n, :n]


def predict(P, points, noise, dynamics):
    """P over the samples (dt, C, f, lla, v) of an epoch: fast dynamics step by step, slow ones half before, half after.

    White noise exactly (Van Loan 1978), with the simple dynamics after each sample (eq. 29); noise of the biases as if
    attitude and specific force were constant.
    """
    n = len(P)
    dts, Cs, fs, llas, vs = (np.array(a) for a in zip(*points, strict=True))
    fast = np.zeros((15, 15))
    fast[0:3, 3:6] = fast[3:6, 6:9] = fast[3:6, 12:15] = fast[6:9, 9:12] = 1
    fast = fast[:n, :n]
    mean = (np.average(a, axis=0, weights=dts) for a in (llas, vs, Cs, fs))
    half = (1 - fast) * dynamics(*mean, n) * dts.sum() / 2
    slow = np.eye(n) + half + half @ half / 2
    before, P, Phi, lumped = P, slow @ P @ slow.T, np.eye(n), dynamics is simple_dynamics
    for dt, C, f, lla, v in points:
        F, G = fast * dynamics(lla, v, C, f, n), np.zeros((n, n))
        for s, L in ((slice(3, 6), C @ root(noise["accel"])), (slice(6, 9), C @ root(noise["gyro"]))):
            G[s, s] = L @ L.T
        loan = expm(np.block([[-F, G], [0 * F, F.T]]) * dt)
        step = loan[n:, n:].T
        P, Phi = step @ P @ step.T + (dt * G if lumped else step @ loan[:n, n:]), step @ Phi
    if n == 15:
        for share in 0.5 + np.array([-0.5, 0.5]) / np.sqrt(3):  # Gauss
            for states, sd, orders in (
                (slice(9, 12), "gyro_bias", [3, 2, 1, 0, 0]),
                (slice(12, 15), "accel_bias", [2, 1, 1, 0, 0]),
            ):
                late = Phi[:, states] * share ** np.repeat(orders, 3)[:, None] @ root(noise[sd])
                P = P + late @ late.T * dts.sum() / 2
    P = slow @ P @ slow.T
    if not lumped:
        total = slow @ Phi @ slow
        reduced, Q = second_order(total, before, dts.sum())
        P += reduced @ before @ reduced.T - total @ before @ total.T
        P[:6, :6] += Q
    return P


def second_order(Phi, P, T):
    """Phi with the reliable share of the heading's column, and what large attitude errors add to Q.

    White acceleration of the power of the rest of this column and of phi x w, w = Phi (phi / 2, s), by the quadratic
    forms x' A_i x of its rows.
    """
    n = len(P)
    w = Phi[3:6] * np.concatenate([np.zeros(6), np.full(3, 0.5), np.ones(n - 9)])
    forms = []
    for e in np.eye(3):
        A = np.zeros((n, n))
        A[6:9] = cross_matrix(e).T @ w  # e . (phi x w) = phi . (w x e)
        forms.append(0.5 * (A + A.T) @ P)
    moment = [[2 * np.trace(a @ b) + np.trace(a) * np.trace(b) for b in forms] for a in forms]
    cov, column, reduced = Phi[3:6, 6:] @ P[6:, 6:] @ Phi[3:6, 6:].T, Phi[3:6, 8], Phi.copy()
    wrong = np.trace(cross_matrix([0, 0, 1]) @ cov @ cross_matrix([0, 0, 1]).T)
    reliable = column @ column / (column @ column + wrong)
    reduced[:6, 8] *= reliable
    moment = np.array(moment) + np.outer(column, column) * (1 - reliable) ** 2 * P[8, 8]
    return reduced, np.kron([[T**3 / 3, T**2 / 2], [T**2 / 2, T]], 2 * 2.0 / T**2 * moment)


def run(imu, fixes, start, noise, prior_sd, dynamics=simple_dynamics, ki=0.0, kd=0.0, states=None):
    """Navigate, predict, correct; ``imu`` (dt, gyro, accel) of (E, k, ...), ``fixes`` (lla, sd, vel, sd, valid (E, 6)).

    ``states`` (n,): where integral and derivative act, as far as the channels that observe a
    state are there. Returns lists of (lla, v, C, x, P) after each epoch.
    """
    n = prior_sd.size
    nav = Strapdown(*start, n)
    P = np.diag(prior_sd**2)
    H = np.eye(6, n)
    states = np.ones(n) if states is None else states
    x_I, last, before, loop = np.zeros(n), np.zeros(6), np.zeros(6), np.zeros((n, 6))
    out = []
    for e in range(len(imu[0])):
        points = []
        for dt, gyro, accel in zip(imu[0][e], imu[1][e], imu[2][e], strict=True):
            points.append((dt, *nav.advance(dt, gyro, accel), nav.lla, nav.v))
        P = predict(P, points, noise, dynamics)
        lla, sd, vel, sdv, valid = (a[e] for a in fixes)
        x = np.zeros(n)
        if valid.any():
            y = np.concatenate([metres(nav.lla) @ (nav.lla - lla), nav.v - vel])
            R = np.diag(np.concatenate([sd, sdv]) ** 2)
            y, h, R = y[valid], H[valid], R[np.ix_(valid, valid)]  # a missing channel is not there at all
            K = P @ h.T @ np.linalg.inv(h @ P @ h.T + R)
            loop[:, valid] = np.abs(K * h.T)
            total = loop.sum(1)
            acting = np.where(total > 0, loop[:, valid].sum(1) / np.where(total > 0, total, 1), 1.0)
            rest, x_I = (1 - acting) * x_I, acting * (x_I + states * (ki * (K @ last[valid])))
            x_D = acting * states * (kd * (K @ (last - before)[valid]))
            x = K @ y + x_I + x_D
            x_I = x_I + rest
            before[valid] = last[valid]
            last[valid] = y - h @ x
            J = np.eye(n) - K @ h
            P = J @ P @ J.T + K @ R @ K.T
        nav.remove(x)
        turned = np.eye(n)  # the attitude's error has other axes after the correction
        turned[6:9, 6:9] = rotation(-0.5 * x[6:9])
        P = turned @ P @ turned.T
        out.append((nav.lla.copy(), nav.v.copy(), nav.C.copy(), x, P.copy()))
    return [np.stack(column) for column in zip(*out, strict=True)]
