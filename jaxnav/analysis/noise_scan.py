"""IMU noise, latency and sd of the fixes by a likelihood scan: the default where no datasheet is named.

A datasheet knows nothing of vibration, mounting and a receiver's latency. Three numbers make up for most of it: a
factor on the white noise of the gyros (g), one on that of the accelerometers (a), and the latency of the fixes (d).
They belong together, since a latency that is not modelled passes for noise. Maximised is

    J(g, a, d) = N mean(log p(nu_k)) - (log10(g / a) / 0.5)^2 / 2 - (log10(g a) / 3)^2 / 2 - ((d - d0) / s)^2 / 2

with nu_k the innovations of the plain filter of 15 states over a part of the recording with motion. p is a Student t,
so that a receiver fault is no noise of the IMU. N counts stretches of `CORRELATION_S` and not fixes: errors of a
receiver are correlated. The priors say that vibration reaches both sensors, and that a datasheet may be right; d0 and s
are the delay that alignments all along the part show and its sd, else 0 and 0.1 s. A coarse
grid of one common factor and the latency comes first, then boxes of 3 x 3 x 3 points about the best one; the quadratic
fit to the last box gives the maximum.

A receiver's stated sd may be off, of positions by a factor p and of velocities by v. Likelihood alone takes correlated
fixes for precise ones, so that both are chosen by innovations and hidden fixes together,

    J(p, v) = N (mean(log p(nu_k)) + mean(log p(y_j))) - (log10(p) / 0.5)^2 / 2 - (log10(v) / 0.5)^2 / 2

with y_j the position residuals of fixes in hidden windows, among the points whose drift over these windows is at most
1.05 times that with the stated sd. The latency shows better with them, and is chosen once more.

All of it is taken if it drifts at most 1.02 times as far over the hidden windows as the datasheet, else without the
factors on the fixes, else the latency alone, else the datasheet.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.analysis.plots import base as plots
from jaxnav.analysis.windows import hidden_windows
from jaxnav.checkup.findings import finding
from jaxnav.checkup.motion import delay_of
from jaxnav.filters import epochs as ep
from jaxnav.filters.catalogue import build
from jaxnav.filters.lanes import LaneRecord, lanes, padded_shape, ready, repeated, stacked, taken
from jaxnav.filters.parameters import datasheet_states, history_for, strong
from jaxnav.filters.scores import innovation_nll, masked_mean, position_noise, residual_nll
from jaxnav.initialization.bank import most_probable
from jaxnav.initialization.initialize import Initialization, ground_velocity, initialize
from jaxnav.measurements import GNSS
from jaxnav.states.grades import GRADES
from jaxnav.states.table import BIASES
from jaxnav.types import Epoch, Finding, Noise, Params, Recording

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COMMON = np.arange(-0.5, 4.0, 0.5)  # log10 of the common factor, coarse grid
LATENCIES = np.arange(-1, 8) / 10  # s, coarse grid where no alignment knows the delay
LATENCY_STEP = 0.05  # s, of the grid about a known delay
DELAY_SD_FACTOR, MIN_DELAY_SD = 5.0, 0.02  # on the sd of alignments' delays, which is of their model; s
COARSE_BOX, FINE_BOX = np.array([0.5, 0.5, 0.05]), np.array([0.25, 0.25, 0.025])
"""Steps of a box: log10 of the gyro and of the accelerometer factor, s."""
SQUARE = np.stack(np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0], indexing="ij"), -1).reshape(9, 2)
CUBE = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3, indexing="ij"), -1).reshape(27, 3)
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
WINDOW_LENGTHS_S, PHASES = (10.0, 5.0, 3.0), 3  # hidden windows: the first length of which `MIN_WINDOWS` fit; runs
MIN_WINDOWS = 8
MAX_DRIFT_RATIO = 1.05  # of the drift over hidden windows, up to which other sd are taken
MAX_HARM_RATIO = 1.02  # of the datasheet's drift over hidden windows, up to which the scan is taken
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
    drift_ratio: float = math.nan  # drift over hidden windows, over the datasheet's
    harm: float = math.nan  # the same of the maximum of J, which was not taken where it exceeds `MAX_HARM_RATIO`

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
        harm = []
        if self.harm > MAX_HARM_RATIO:
            plain = self.gyro == self.accel == 1.0
            kept = "the datasheet's noise" if plain else "its noise with the stated sd of the fixes"
            kept += " and this delay" if plain and self.latency else ""
            harm = [finding("noise.harm", value=self.harm, limit=MAX_HARM_RATIO, kept=kept)]
        return [found, *harm] + (
            [finding("noise.vibration", value=most, limit=VIBRATION_FACTOR)] if most > VIBRATION_FACTOR else []
        )

    def metrics(self) -> dict[str, float]:
        """Return the chosen values, as in metrics.json."""
        names = ["gyro", "accel", "latency", "gain", "position", "velocity"]
        names += [name for name in ("drift_ratio", "harm") if math.isfinite(getattr(self, name))]
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


class Delay(NamedTuple):
    """Delay of the fixes before the scan."""

    mean: float = 0.0  # s
    sd: float = LATENCY_SD  # s, of the prior
    free: bool = True  # False: it is stated, and stays

    def grid(self) -> np.ndarray:
        """Return the delays of the coarse grid, (9,) s: about a known one on either side, else rather late ones."""
        known = self.sd < LATENCY_SD
        return self.mean + (LATENCY_STEP * np.arange(-4, 5) if known else LATENCIES) if self.free else np.zeros(1)


def known_delay(rec: Recording, params: Params, end: float, outages: Sequence[Any]) -> Delay:
    """Return what alignments up to ``end`` s say of the delay of the fixes, with an sd that allows for their models.

    ``outages``: (start, end) s, windows whose fixes are hidden.
    """
    if _timed(params):
        return Delay(0.0, LATENCY_SD, False)
    seen = lambda s: ep.sample_rows(s, (s.t <= end) & ~ep.within(s.t, outages))
    found = delay_of(rec._replace(aiding={m.name: seen(rec.aiding[m.name]) for m in GNSS if m.name in rec.aiding}))
    if found is None or DELAY_SD_FACTOR * found[1] >= LATENCY_SD:
        return Delay()
    return Delay(found[0], max(DELAY_SD_FACTOR * found[1], MIN_DELAY_SD))


def _scaled(params: Params, gyro: Any, accel: Any, *sd: Any) -> Params:
    """Return parameters with factors on the IMU's white noise and on the stated sd of positions and velocities."""
    noise, fixes = Noise(params.noise.gyro * gyro, params.noise.accel * accel), dict(params.measurements)
    for row, factor in zip(GNSS, sd, strict=True):
        if row.name in fixes:
            theta = fixes[row.name]
            fixes[row.name] = theta._replace(scale=jnp.asarray(theta.scale) * factor)
    return params._replace(noise=noise, measurements=fixes)


class _Cut(NamedTuple):
    """Epochs of a latency: the fixes are moved by it before the recording is cut."""

    packed: ep.Packed
    stamp: np.ndarray  # (E,) s, end of each epoch by the fixes' clock
    seen: np.ndarray  # (E, m) bool
    counted: np.ndarray  # (E,) bool, epochs with fixes that count


class _Objective:
    """J over one part of a recording; a point is log10 of factors on gyros and accelerometers, and the latency in s."""

    def __init__(
        self, rec: Recording, params: Params, begin: Initialization, end: float, outages: Sequence[Any], delay: Delay
    ) -> None:
        self.rec, self.begin, self.end, self.outages, self.delay = rec, begin, end, outages, delay
        self.rows = tuple(m for m in GNSS if m.name in rec.aiding)
        states = datasheet_states(GRADES["consumer"], BIASES) | params.states
        fixes = {m.name: strong(m.defaults) for m in self.rows} | params.measurements  # a filter may take ranges alone
        self.params = begin.apply_to(params._replace(states=states, measurements=fixes, rule=(), feedback=()))
        rate, span = 1 / float(np.median(rec.imu.dt)), float(np.ptp(rec.imu.t))
        self.filt = build("ekf15", self.rows, 5, history_for(self.params, rate, span))
        self.first = begin.t + min(WARM_UP_S, 0.25 * (end - begin.t))
        self.effective = (end - self.first) / CORRELATION_S
        self.scales = np.zeros(2)  # log10 of the factors on the stated sd of positions and velocities
        self.cuts, self.shape = dict[float, _Cut](), (0, 0)
        self.prepared: dict[float, Epoch] = {}
        self.nav = taken(begin.navs, 0)
        packed = self.at(delay.mean).packed
        self.nav = most_probable(self.filt, self.params, begin.navs, packed.epochs)

    def at(self, latency: float) -> _Cut:
        """Return the epochs of a latency, cut once."""
        latency = round(float(latency), 6)
        if latency not in self.cuts:
            moved = {m.name: s._replace(t=s.t - latency) for m in self.rows for s in [self.rec.aiding[m.name]]}
            packed = ep.pack_recording(self.rec._replace(aiding=moved), self.rows, self.begin.t, 0.0, self.end)
            packed = packed._replace(
                epochs=ep.hide(packed.epochs, ep.within(packed.t + latency, self.outages), self.rows)
            )
            seen = np.asarray(packed.epochs.fix.valid)
            self.cuts[latency] = _Cut(packed, packed.t + latency, seen, (packed.t > self.first) & seen.any(1))
            size, samples = np.maximum(self.shape, padded_shape(packed.epochs)).tolist()
            if (size, samples) != self.shape:
                self.shape, self.prepared = (size, samples), {}
        return self.cuts[latency]

    def ready(self, latency: float) -> Epoch:
        """Return the prepared epochs of a latency, all of one shape."""
        if latency not in self.prepared:
            packed = self.cuts[latency].packed
            self.prepared[latency] = ready(self.filt, self.params, self.nav, packed.epochs, self.shape)
        return self.prepared[latency]

    def candidate(self, point: np.ndarray) -> Params:
        """Return the parameters of a point (5,), behind the latency log10 of the factors on the fixes' sd."""
        return _scaled(self.params, *(10.0 ** point[[0, 1, 3, 4]]))

    def run(self, points: np.ndarray, hidden: Sequence[Sequence[Any]] = ((),)) -> tuple[LaneRecord, np.ndarray]:
        """Run points (P, 5) with each of some sets of windows (H) hidden: the record and what is hidden.

        The record is (H P, E, ...), the mask (H P, E).
        """
        latencies = np.round(points[:, 2], 6)
        each, cut = np.unique(latencies, return_inverse=True)
        cuts = [self.at(latency) for latency in each]
        epochs = jax.tree.map(lambda *a: np.stack(a), *(self.ready(float(latency)) for latency in each))
        wide = lambda mask: np.pad(mask, [(0, self.shape[0] - len(mask))] + [(0, 0)] * (mask.ndim - 1))
        masks = np.array([[wide(ep.within(c.stamp, windows)) for c in cuts] for windows in hidden])
        mask = masks[:, cut].reshape(-1, self.shape[0])
        seen = np.tile(np.array([wide(c.seen) for c in cuts])[cut], (len(hidden), 1, 1)) & ~mask[:, :, None]
        params = stacked([self.candidate(point) for point in points])
        params = jax.tree.map(lambda a: np.tile(a, (len(hidden), *[1] * (a.ndim - 1))), params)
        record = lanes(self.filt, params, repeated(self.nav, len(seen)), epochs, seen, np.tile(cut, len(hidden)))
        return record, mask

    def counted(self, points: np.ndarray) -> np.ndarray:
        """Return the epochs whose fixes count at each point, (P, E)."""
        rows = [self.at(latency).counted for latency in points[:, 2]]
        return np.array([np.pad(row, (0, self.shape[0] - row.size)) for row in rows])

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Return J (P,) at points (P, 3)."""
        points = np.round(points, 6)
        record, _ = self.run(np.column_stack([points, np.tile(self.scales, (len(points), 1))]))
        mean = masked_mean(-innovation_nll(record), self.counted(points))
        noise = ((points[:, 0] - points[:, 1]) / RATIO_SD) ** 2 + (points[:, :2].mean(1) / COMMON_SD) ** 2
        off = (points[:, 2] - self.delay.mean) / self.delay.sd
        return self.effective * mean - 0.5 * noise - 0.5 * off**2

    def windows(self) -> list[list[tuple[float, float]]]:
        """Return hidden windows in `PHASES` sets, of the longest length that enough fit of; none where too few fit."""
        cut = self.at(self.delay.mean)
        packed = cut.packed._replace(t=cut.stamp)
        for length in WINDOW_LENGTHS_S:
            found = hidden_windows(packed, length, PHASES * length, PHASES, self.first - packed.start)
            if found.start.size >= MIN_WINDOWS:
                return [[(a, a + length) for a in found.start[found.phase == p]] for p in range(PHASES)]
        return []

    def fit(self, points: np.ndarray, hidden: Sequence[Sequence[Any]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return how well points (P, 5) fit with some sets of windows (H) hidden.

        Mean log-likelihood of a fix and of a hidden fix, and the RMS of the hidden fixes' horizontal residuals, m;
        (P,) each.
        """
        record, mask = self.run(points, hidden)
        tiled = lambda a: np.tile(a, (len(hidden), *[1] * (a.ndim - 1)))
        counted = tiled(self.counted(points))
        fixes = [self.ready(float(latency)).fix for latency in np.round(points[:, 2], 6)]
        there = tiled(np.array([np.asarray(fix.valid)[:, :3].all(1) for fix in fixes]))
        noise = [
            position_noise(self.candidate(p), np.asarray(fix.sd)[:, :3]) for p, fix in zip(points, fixes, strict=True)
        ]
        far = -residual_nll(record.residual, record.P + tiled(np.array(noise)))
        square = (record.residual[..., :2] ** 2).sum(-1)
        far, square = (np.where(record.ok, a, worst) for a, worst in ((far, -np.inf), (square, np.inf)))
        known = there & mask & counted
        by_phase = lambda values, mask: masked_mean(values, mask).reshape(len(hidden), -1).mean(0)
        return by_phase(-innovation_nll(record), counted & ~mask), by_phase(far, known), by_phase(square, known) ** 0.5

    def best_scales(self, point: np.ndarray, hidden: Sequence[Sequence[Any]]) -> np.ndarray:
        """Return the factors on the stated sd of positions and velocities (2,), log10; zeros for none.

        Args:
            point: (3,) the chosen one.
            hidden: sets of windows.
        """
        if not len(hidden):
            return np.zeros(2)

        def at(scales: np.ndarray, most: float = np.inf) -> tuple[np.ndarray, np.ndarray]:
            """Return points (P, 4), J being -inf where the drift exceeds ``most`` m, and the drift (P,) m."""
            near, far, drift = self.fit(np.column_stack([np.tile(point, (len(scales), 1)), scales]), hidden)
            J = self.effective * (near + far) - 0.5 * ((scales / SCALE_SD) ** 2).sum(1)
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

    def harmless(self, point: np.ndarray, hidden: Sequence[Sequence[Any]]) -> tuple[np.ndarray, float, float]:
        """Return the first of some points that does no harm, its drift over the datasheet's, and that of the first.

        Tried are ``point`` (5,), the same with the stated sd of the fixes, its delay alone, and the datasheet.
        """
        if not len(hidden):
            return point, math.nan, math.nan
        tried = np.stack([point, point * [1, 1, 1, 0, 0], point * [0, 0, 1, 0, 0], np.zeros(5)])
        drift = self.fit(tried, hidden)[2]
        ratio = drift / drift[-1]
        i = int(np.argmax(ratio <= MAX_HARM_RATIO))
        return tried[i], float(ratio[i]), float(ratio[0])

    def box(self, centre: np.ndarray, steps: np.ndarray) -> np.ndarray:
        """Return the 3 x 3 x 3 points about ``centre`` (27, 3) with their J, (27, 4)."""
        points = centre + steps * CUBE
        return np.column_stack([points, self(points)])


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
    delay = known_delay(rec, params, end, outages)
    objective = _Objective(rec, params, begin, end, outages, delay)
    fixes = int(objective.at(delay.mean).counted.sum())
    if fixes < MIN_FIXES:
        return NoiseScan()
    latencies = delay.grid()
    steps = np.array([1.0, 1.0, float(delay.free)])
    common = np.tile(COMMON, latencies.size)
    coarse = objective(np.column_stack([common, common, np.repeat(latencies, COMMON.size)]))
    coarse = coarse.reshape(latencies.size, COMMON.size)
    i, j = np.unravel_index(np.argmax(coarse), coarse.shape)
    centre = np.array([COMMON[j], COMMON[j], latencies[i]])
    centre, _ = _climb(partial(objective.box, steps=steps * COARSE_BOX), centre)
    points = objective.box(centre, steps * FINE_BOX)
    found = _vertex(points, centre, steps * FINE_BOX)
    hidden = objective.windows()
    if not _stated_scale(params):
        objective.scales = objective.best_scales(found, hidden)
    if objective.scales.any() and delay.free:
        timing = np.array([0.0, 0.0, COARSE_BOX[2]])
        centre, points = _climb(partial(objective.box, steps=timing), found)
        found = _vertex(points, centre, timing)
    point, ratio, harm = objective.harmless(np.concatenate([found, objective.scales]), hidden)
    datasheet = coarse[np.argmin(np.abs(latencies)), np.argmin(np.abs(COMMON))]
    gain = float(points[:, 3].max() - datasheet) / objective.effective
    gyro, accel, position, velocity = map(float, 10.0 ** point[[0, 1, 3, 4]])
    return NoiseScan(
        gyro, accel, float(point[2]), position, velocity, gain, coarse - coarse.max(), (latencies, 10.0**COMMON),
        (objective.first, end), fixes, ratio, harm,
    )  # fmt: skip


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
