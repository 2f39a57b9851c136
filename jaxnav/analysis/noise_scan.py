"""IMU noise, latency and sd of the fixes by a likelihood scan: the default where no datasheet is named.

A datasheet knows nothing of vibration, mounting and a receiver's latency. Three numbers make up for most of it: a
factor on the white noise of the gyros (g), one on that of the accelerometers (a), and the latency of the fixes (d).
They belong together, since a latency that is not modelled passes for noise. Maximised is

    J(g, a, d) = N mean(log p(nu_k)) - (log10(g / a) / 0.5)^2 / 2 - (log10(g a) / 3)^2 / 2 - (d / 0.1 s)^2 / 2

with nu_k the innovations of the plain filter of 15 states over a part of the recording with motion. p is a Student t,
so that a receiver fault is no noise of the IMU. N counts stretches of `CORRELATION_S` and not fixes: errors of a
receiver are correlated. The priors say that vibration reaches both sensors, and that a datasheet may be right. A coarse
grid of one common factor and the latency comes first, then boxes of 3 x 3 x 3 points about the best one; the quadratic
fit to the last box gives the maximum.

A receiver's stated sd may be off, of positions by a factor p and of velocities by v. Likelihood alone takes correlated
fixes for precise ones, so that both are chosen by innovations and hidden fixes together,

    J(p, v) = N (mean(log p(nu_k)) + mean(log p(y_j))) - (log10(p) / 0.5)^2 / 2 - (log10(v) / 0.5)^2 / 2

with y_j the position residuals of fixes in hidden windows, among the points whose drift over these windows is at most
1.05 times that with the stated sd. The latency shows better with them, and is chosen once more.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.analysis.plots import base as plots
from jaxnav.analysis.windows import hidden_windows, position_noise
from jaxnav.checkup.findings import finding
from jaxnav.filters import epochs as ep
from jaxnav.filters.catalogue import build
from jaxnav.filters.core import Filter, Step
from jaxnav.filters.parameters import datasheet_states, history_for, strong
from jaxnav.filters.programs import stored
from jaxnav.filters.run import prepare, run, student_nll
from jaxnav.initialization.bank import most_probable
from jaxnav.initialization.initialize import Initialization, ground_velocity, initialize
from jaxnav.maths import linalg
from jaxnav.measurements import GNSS
from jaxnav.states.grades import GRADES
from jaxnav.states.table import BIASES
from jaxnav.types import Epoch, Finding, Nav, Noise, Params, Recording

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COMMON = np.arange(-0.5, 4.0, 0.5)  # log10 of the common factor, coarse grid
LATENCIES = np.arange(-1, 8) / 10  # s, coarse grid
LATENCIES_PER_CALL = 3  # latencies by one call of the compiled function
COARSE_BOX, FINE_BOX = np.array([0.5, 0.5, 0.05]), np.array([0.25, 0.25, 0.025])
"""Steps of a box: log10 of the gyro and of the accelerometer factor, s."""
SQUARE = np.stack(np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0], indexing="ij"), -1).reshape(9, 2)
MAX_COARSE_BOXES = 5  # coarse ones
RATIO_SD, COMMON_SD, LATENCY_SD = 0.5, 1.5, 0.1  # decades, decades, s
CORRELATION_S = 10.0  # s, between independent innovations
SCANNED_S, WARM_UP_S = 180.0, 20.0  # s, of the part that counts at most; before it, to settle
MIN_FIXES = 20  # that count
MOVING_MPS, PARKED_S = 1.0, 30.0  # ground speed of motion; s at rest from which on the scan begins later
MARGIN_S = 15.0  # s, before the first motion
SCALES = np.arange(-1.25, 1.0, 0.25)  # log10 of the factor on the positions' stated sd, coarse grid
SCALE_STEP = 0.25  # of a box: log10 of the factors on the sd of positions and velocities
SCALE_SD = 0.5  # decades
WINDOW_S, PHASES = 10.0, LATENCIES_PER_CALL  # hidden windows: length, runs with windows in other places
SHORT_S, MIN_WINDOWS = 5.0, 8  # length where eight of `WINDOW_S` do not fit; number
MAX_DRIFT_RATIO = 1.05  # of the drift over hidden windows, up to which other sd are taken
MIN_GAIN = 1.0  # of J, from which on other sd are taken


VIBRATION_FACTOR = 300.0  # factor on the datasheet above which noise is vibration, a wrong unit or another grade


class NoiseScan(NamedTuple):
    """Result of a scan."""

    gyro: float = 1.0  # factor on the white noise of the gyros
    accel: float = 1.0  # on that of the accelerometers
    latency: float = 0.0  # s
    position: float = 1.0  # factor on the stated sd of positions
    velocity: float = 1.0  # on that of velocities
    gain: float = 0.0  # of J / N, the penalized log-likelihood of a fix, over factors of 1 and no latency
    coarse: np.ndarray = np.zeros((0, 0))  # (L, C) J of the coarse grid, latency by common factor, 0 at its maximum
    grid: tuple[np.ndarray, np.ndarray] = (np.zeros(0), np.zeros(0))  # (L,) s and (C,) factors of it
    part: tuple[float, float] = (0.0, 0.0)  # s, interval of the fixes that count
    fixes: int = 0

    def applied(self, params: Params) -> Params:
        """Return parameters with this noise, latency and sd of the fixes.

        Args:
            params: parameters of a filter with the measurements of the scan.
        """
        mounting = params.mounting._replace(time_offset=params.mounting.time_offset + self.latency)
        return _scaled(params._replace(mounting=mounting), self.gyro, self.accel, self.position, self.velocity)

    @property
    def findings(self) -> list[Finding]:
        """Return the findings of the scan."""
        if not self.fixes:
            return [finding("noise.datasheet", limit=MIN_FIXES)]
        scale = f"; sd of positions {self.position:.2g}, of velocities {self.velocity:.2g} times the stated"
        found = finding(
            "noise.scan", gyro=self.gyro, accel=self.accel, size=abs(self.latency),
            side="late" if self.latency >= 0 else "early", gain=self.gain, fixes=self.fixes, first=self.part[0],
            last=self.part[1], scale=scale if (self.position, self.velocity) != (1.0, 1.0) else "",
        )  # fmt: skip
        most = max(self.gyro, self.accel)
        return [found] + (
            [finding("noise.vibration", value=most, limit=VIBRATION_FACTOR)] if most > VIBRATION_FACTOR else []
        )

    def metrics(self) -> dict[str, float]:
        """Return the chosen values, as in metrics.json."""
        names = ("gyro", "accel", "latency", "gain", "position", "velocity")
        return {"latency_s" if name == "latency" else name: getattr(self, name) for name in names}

    def figure(self) -> "Figure":
        """Draw J over common factor and latency, and the chosen point."""
        latencies, factors = self.grid
        fig = plots.figure(6, 4)
        ax = fig.subplots()
        plots.dress(ax, "noise scan", "factor on the datasheet's white noise", "latency of the fixes, s")
        shown = np.maximum(self.coarse, -50.0)
        mesh = ax.pcolormesh(factors, latencies, shown, shading="nearest", cmap="viridis")
        ax.plot([self.gyro, self.accel], [self.latency] * 2, "w-", lw=1)
        ax.plot(self.gyro, self.latency, "w>", label="gyro")
        ax.plot(self.accel, self.latency, "ws", label="accelerometer")
        ax.set_xscale("log")
        ax.legend(fontsize=8, facecolor="0.4", labelcolor="w")
        fig.colorbar(mesh, label="log-likelihood below the maximum (tempered)")
        return fig


# ---------------------------------------------------------------------------- the objective


@partial(stored, static_argnums=(0,))
def _fit(
    filt: Filter, params: Params, nav: Nav, epochs: Epoch, counted: jax.Array, hidden: jax.Array, factors: jax.Array
) -> jax.Array:
    """Return how well L x P runs fit (3, L, P): two mean log-likelihoods, of a fix and of a hidden fix, and drift^2.

    Args:
        filt: the filter.
        params: its parameters, with factors of 1.
        nav: initial navigation.
        epochs: (L, E, ...), with the fixes moved by a latency each, or with other windows hidden.
        counted: (L, E) bool, epochs with innovations that count.
        hidden: (L, E) bool, epochs with hidden positions that count; their mean horizontal error squared is drift^2.
        factors: (P, 4) on the white noise of gyros and accelerometers, on the stated sd of positions and velocities.
    """

    def record(step: Step, along: None) -> tuple[jax.Array, jax.Array, jax.Array]:
        info = step.info
        nll = student_nll(info.nis, info.valid.sum(), info.valid.size) + 0.5 * info.log_det
        return jnp.where(info.ok, -nll, -jnp.inf), info.residual[:3], info.P[:3, :3]

    def one(epochs: Epoch, counted: jax.Array, hidden: jax.Array, factor: jax.Array) -> jax.Array:
        scaled = _scaled(params, *factor)
        density, y, P = run(filt, scaled, nav, epochs, record)
        S = P + position_noise(scaled, epochs.fix.sd[:, :3])
        nis = jax.vmap(linalg.normalized)(y, S)
        far = -student_nll(nis, jnp.asarray(3), 3) - 0.5 * jax.vmap(linalg.log_determinant)(S)
        mean = lambda value, mask: jnp.where(mask, value, 0.0).sum() / jnp.maximum(mask.sum(), 1)
        return jnp.stack([mean(density, counted), mean(far, hidden), mean((y[:, :2] ** 2).sum(1), hidden)])

    runs = jax.vmap(jax.vmap(one, (None, None, None, 0)), (0, 0, 0, None))(epochs, counted, hidden, factors)
    return jnp.moveaxis(runs, -1, 0)


def _scaled(params: Params, gyro: Any, accel: Any, *sd: Any) -> Params:
    """Return parameters with factors on the IMU's white noise and on the stated sd of positions and velocities."""
    noise, fixes = Noise(params.noise.gyro * gyro, params.noise.accel * accel), dict(params.measurements)
    for row, factor in zip(GNSS, sd, strict=True):
        if row.name in fixes:
            theta = fixes[row.name]
            fixes[row.name] = theta._replace(scale=jnp.asarray(theta.scale) * factor)
    return params._replace(noise=noise, measurements=fixes)


class _Objective:
    """J over one part of a recording; epochs of a latency are cut once."""

    def __init__(
        self, rec: Recording, params: Params, begin: Initialization, end: float, outages: Sequence[Any]
    ) -> None:
        self.rec, self.begin, self.end, self.outages = rec, begin, end, outages
        self.rows = tuple(m for m in GNSS if m.name in rec.aiding)
        states = datasheet_states(GRADES["consumer"], BIASES) | params.states
        fixes = {m.name: strong(m.defaults) for m in self.rows} | params.measurements  # a filter may take ranges alone
        self.params = begin.apply_to(params._replace(states=states, measurements=fixes, rule=(), feedback=()))
        rate, span = 1 / float(np.median(rec.imu.dt)), float(np.ptp(rec.imu.t))
        self.filt = build("ekf15", self.rows, 5, history_for(self.params, rate, span))
        self.first = begin.t + min(WARM_UP_S, 0.25 * (end - begin.t))
        self.effective = (end - self.first) / CORRELATION_S
        packed = self._packed(0.0)
        E, K = packed.epochs.imu.dt.shape
        self.size: tuple[int, ...] = ep.bucket_size(E + 2), ep.bucket_size(K + 1)  # other latencies need a little more
        self.nav = most_probable(self.filt, self.params, begin.navs, packed.epochs)
        self.cuts: dict[float, tuple[Epoch, np.ndarray]] = {}
        self.scales = np.zeros(2)  # log10 of the factors on the stated sd of positions and velocities

    def _packed(self, latency: float) -> ep.Packed:
        moved = {m.name: s._replace(t=s.t - latency) for m in self.rows for s in [self.rec.aiding[m.name]]}
        packed = ep.pack_recording(self.rec._replace(aiding=moved), self.rows, self.begin.t, 0.0, self.end)
        hidden = ep.within(packed.t, self.outages)
        return packed._replace(epochs=ep.hide(packed.epochs, hidden, self.rows))

    def at(self, latency: float) -> tuple[Epoch, np.ndarray]:
        """Return the epochs (E, ...) of a latency, and which of their fixes count (E,)."""
        if latency not in self.cuts:
            packed = self._packed(latency)
            counted = (packed.t > self.first) & np.asarray(packed.epochs.fix.valid).any(1)
            self.cuts[latency] = packed.epochs, counted
            size = map(ep.bucket_size, packed.epochs.imu.dt.shape)
            self.size = tuple(max(a, b) for a, b in zip(self.size, size, strict=True))
        return self.cuts[latency]

    def __call__(self, latencies: np.ndarray, logs: np.ndarray) -> np.ndarray:
        """Return J (L, P) at every latency (L,), s, with every pair of factors (P, 2), log10."""
        latencies, logs = np.round(latencies, 6), np.round(logs, 6)
        parts = [self.at(float(latency)) for latency in latencies]
        epochs = ep.stack_epochs([ep.pad_epochs(epochs, *self.size) for epochs, _ in parts])
        counted = np.stack([np.pad(c, (0, self.size[0] - c.size)) for _, c in parts])
        mean = self.fit(epochs, counted, np.zeros_like(counted), logs, np.tile(self.scales, (len(logs), 1)))[0]
        noise = ((logs[:, 0] - logs[:, 1]) / RATIO_SD) ** 2 + (logs.mean(1) / COMMON_SD) ** 2
        return self.effective * mean - 0.5 * noise - 0.5 * (latencies[:, None] / LATENCY_SD) ** 2

    def fit(
        self, epochs: Epoch, counted: np.ndarray, hidden: np.ndarray, logs: np.ndarray, scales: np.ndarray
    ) -> np.ndarray:
        """Return `_fit` (3, L, P) of factors on the noise (P, 2) and on the fixes' sd (P, 2), log10."""
        factors = 10.0 ** np.column_stack([logs, scales])
        return np.asarray(_fit(self.filt, self.params, self.nav, prepare(self.filt, epochs), counted, hidden, factors))

    def best_scales(self, gyro: float, accel: float, latency: float) -> np.ndarray:
        """Return the factors on the stated sd of positions and velocities (2,), log10; zeros for none.

        Args:
            gyro: log10 of the chosen factor.
            accel: likewise.
            latency: the chosen one, s.
        """
        packed, (epochs, counted) = self._packed(round(latency, 6)), self.at(round(latency, 6))
        length = WINDOW_S if self.end - self.first >= 8 * WINDOW_S else SHORT_S
        windows = hidden_windows(packed, length, PHASES * length, PHASES, self.first - packed.start)
        if windows.start.size < MIN_WINDOWS:
            return np.zeros(2)
        there = np.asarray(packed.epochs.fix.valid)[:, :3].all(1)
        wide = lambda mask: np.pad(mask, ((0, 0), (0, self.size[0] - counted.size)))
        runs = ep.stack_epochs([ep.pad_epochs(ep.hide(epochs, h, self.rows), *self.size) for h in windows.hidden])
        shown, known = wide(counted & ~windows.hidden), wide(there & windows.hidden)

        def at(scales: np.ndarray, most: float = np.inf) -> tuple[np.ndarray, np.ndarray]:
            """Return points (P, 4), J being -inf where the drift exceeds ``most`` m, and the drift (P,) m."""
            logs = np.tile([gyro, accel], (len(scales), 1))
            shown_nll, far, square = self.fit(runs, shown, known, logs, scales).mean(1)
            J = self.effective * (shown_nll + far) - 0.5 * ((scales / SCALE_SD) ** 2).sum(1)
            drift = np.sqrt(square)
            agreed = np.isfinite(J) & (drift <= most)
            return np.column_stack([scales, np.zeros(len(scales)), np.where(agreed, J, -np.inf)]), drift

        line, drift = at(np.column_stack([SCALES, np.zeros_like(SCALES)]))
        stated = int(np.argmin(np.abs(SCALES)))
        most = MAX_DRIFT_RATIO * drift[stated]
        first = line[np.argmax(np.where(drift <= most, line[:, 3], -np.inf)), :3]
        steps = SCALE_STEP * np.array([1.0, float(len(self.rows) > 1), 0.0])
        centre, points = _climb(lambda centre: at(centre[:2] + steps[:2] * SQUARE, most)[0], first)
        if points[:, 3].max() < line[stated, 3] + MIN_GAIN:
            return np.zeros(2)
        return _vertex(points, centre, steps)[:2]

    def box(self, centre: np.ndarray, steps: np.ndarray) -> np.ndarray:
        """Return the 3 x 3 x 3 points about ``centre`` (27, 3) with their J, (27, 4)."""
        logs = centre[:2] + steps[:2] * SQUARE
        latencies = centre[2] + steps[2] * np.array([-1.0, 0.0, 1.0])
        J = self(latencies, logs)
        return np.column_stack([np.tile(logs, (3, 1)), np.repeat(latencies, 9), J.reshape(-1)])


def _climb(box: Callable[[np.ndarray], np.ndarray], centre: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the centre (3,) of a box with the maximum in its middle, or of the last tried, and its points (n, 4)."""
    for _ in range(MAX_COARSE_BOXES):
        points = box(centre)
        best = points[np.argmax(points[:, 3]), :3]
        if np.allclose(best, centre):
            break
        centre = best
    return centre, points


def _vertex(points: np.ndarray, centre: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Return the maximum (3,) of the quadratic fit to a box (n, 4), within it; the best point where there is none."""
    free = steps > 0
    u = (points[:, :3] - centre)[:, free] / steps[free]
    i, j = np.triu_indices(free.sum())
    A = np.column_stack([np.ones(len(u)), u, u[:, i] * u[:, j]])
    if not np.isfinite(points).all():
        return points[np.argmax(points[:, 3]), :3]
    c = np.linalg.lstsq(A, points[:, 3], rcond=None)[0]
    H = np.zeros((free.sum(),) * 2)
    H[i, j] = c[1 + free.sum() :]
    H = H + H.T
    if np.linalg.eigvalsh(H).max() >= 0:
        return points[np.argmax(points[:, 3]), :3]
    found = centre.copy()
    found[free] += steps[free] * np.clip(-np.linalg.solve(H, c[1 : 1 + free.sum()]), -1.0, 1.0)
    return found


# ---------------------------------------------------------------------------- the scan


def scan_noise(
    rec: Recording,
    params: Params,
    *,
    initialization: Initialization | None = None,
    stop: float | None = None,
    outages: Sequence[Sequence[float]] = (),
) -> NoiseScan:
    """Choose the IMU's white noise, the latency and the sd of the fixes by the likelihood of the innovations.

    Args:
        rec: the recording, with positions.
        params: parameters with the datasheet's noise, such as ``filt.params("consumer")``, and the lever arm (m, body
            FRD). A latency that they state or estimate and a scale of the fixes that they state stay.
        initialization: by default `jaxnav.initialize`; after a long standstill the scan begins later.
        stop: s, end of the interval that the scan may use.
        outages: (start, end) s, windows whose fixes are hidden.

    Returns:
        Factors on the root PSD of ``params.noise``, the latency (s), a factor on the stated sd of the fixes; factors
        of 1 where there are too few fixes.

    Raises:
        DataError: a recording that cannot be started from or cut.
    """
    begin = initialize(rec, params) if initialization is None else initialization
    last = min(np.inf if stop is None else stop, float(rec.aiding["position"].t[-1]), float(rec.imu.t[-1]))
    begin = _in_motion(rec, params, begin, last)
    end = min(begin.t + WARM_UP_S + SCANNED_S, last)
    objective = _Objective(rec, params, begin, end, outages)
    fixes = int(objective.at(0.0)[1].sum())
    if fixes < MIN_FIXES:
        return NoiseScan()
    latencies, free = (np.zeros(LATENCIES_PER_CALL), 0.0) if _timed(params) else (LATENCIES, 1.0)
    steps = np.array([1.0, 1.0, free])
    logs = np.stack([COMMON, COMMON], 1)
    coarse = np.concatenate(
        [objective(latencies[i : i + LATENCIES_PER_CALL], logs) for i in range(0, latencies.size, LATENCIES_PER_CALL)]
    )
    i, j = np.unravel_index(np.argmax(coarse), coarse.shape)
    centre = np.array([COMMON[j], COMMON[j], latencies[i]])
    centre, _ = _climb(partial(objective.box, steps=steps * COARSE_BOX), centre)
    points = objective.box(centre, steps * FINE_BOX)
    found = _vertex(points, centre, steps * FINE_BOX)
    if not _stated_scale(params):
        objective.scales = objective.best_scales(*found)
    if objective.scales.any() and free:
        timing = np.array([0.0, 0.0, COARSE_BOX[2]])
        centre, points = _climb(partial(objective.box, steps=timing), found)
        found = _vertex(points, centre, timing)
    gyro, accel, latency = map(float, found)
    datasheet = coarse[np.argmin(np.abs(latencies)), np.argmin(np.abs(COMMON))]
    gain = float(points[:, 3].max() - datasheet) / objective.effective
    grid = latencies, 10.0**COMMON
    position, velocity = (float(scale) for scale in 10.0**objective.scales)
    part, below = (objective.first, end), coarse - coarse.max()
    return NoiseScan(10**gyro, 10**accel, latency, position, velocity, gain, below, grid, part, fixes)


def _stated_scale(params: Params) -> bool:
    """Return whether parameters state how the fixes' sd are to be scaled."""
    scales = [theta.scale for theta in params.measurements.values() if hasattr(theta, "scale")]
    return any(not np.array_equal(scale, np.ones(np.shape(scale))) for scale in scales)


def _timed(params: Params) -> bool:
    """Return whether parameters state a latency or estimate one."""
    ages = [params.mounting.time_offset, *(t.latency for t in params.measurements.values() if hasattr(t, "latency"))]
    return any(float(age) != 0 for age in ages) or "clock_offset" in params.states


def _in_motion(rec: Recording, params: Params, begin: Initialization, last: float) -> Initialization:
    """Return the start, or a later one just before the first motion where the vehicle is parked for long."""
    velocity = ground_velocity(rec)
    speed = np.hypot(velocity.value[:, 0], velocity.value[:, 1])
    moving = (speed > np.maximum(MOVING_MPS, 3 * velocity.sd[:, :2].max(1))) & (velocity.t > begin.t)
    first = float(velocity.t[np.argmax(moving)]) if moving.any() else begin.t
    if first < begin.t + PARKED_S or last < first + PARKED_S:
        return begin
    return initialize(rec, params, t_start=first - MARGIN_S)
