"""IMU noise, latency and sd of the fixes by a likelihood scan: the default where no datasheet is named.

A datasheet knows nothing of vibration, mounting and a receiver's latency. Three numbers make up for most of it: a
factor on the white noise of the gyros (g), one on that of the accelerometers (a), and the latency of the fixes (d).
They belong together, since a latency that is not modelled passes for noise. Maximised is

    J(g, a, d) = N mean(log p(nu_k)) - (log10(g / a) / 0.5)^2 / 2 - (log10(g a) / 3)^2 / 2 - ((d - d0) / s)^2 / 2

with nu_k the innovations of the plain filter of 15 states over a part of the recording with motion. p is a Student t,
so that a receiver fault is no noise of the IMU. N counts stretches of `CORRELATION_S` and not fixes: errors of a
receiver are correlated. The priors say that vibration reaches both sensors, and that a datasheet may be right; d0 and s
are the delay that alignments all along the part show and its sd, else 0 and 0.1 s. A coarse grid of one common factor
and the latency comes first, then one of the common factor with and without the datasheet's scale errors
(`jaxnav.states.sensitivity`), since turns that they make wrong pass for white noise: they stay unless innovations and
hidden fixes together are far likelier without them, or drift far less. Boxes of 3 x 3 x 3 points about the best one
follow; the quadratic fit to the last box gives the maximum.

What a receiver states of its positions is split between white noise and slow errors, by
`jaxnav.analysis.receiver_errors`, and the sd of velocities has a factor v. Likelihood alone takes correlated fixes for
precise ones, so that share h and correlation time tau of each, level and up, are chosen by innovations and hidden fixes
together,

    J(v, p, h, tau) = N (mean(log p(nu_k)) + mean(log p(y_j)))
                      - (log10(v) / 0.5)^2 / 2 - (log10(p) / 0.3)^2 / 2 - prior(h, tau)

with y_j the position residuals of fixes in hidden windows, among the points whose drift over these windows is at most
1.05 times that with the stated sd. A factor p on the stated sd of positions is one unless the fixes ask for more, or
the sd is that of a table without one. Where this gains less than one over the usual share and time, these are assumed.
The latency shows better with them, and is chosen once more.

All of it is taken if it drifts at most 1.02 times as far over the hidden windows as the datasheet, else without what it
says of the fixes, whose stated errors are white then and have the usual slow ones on top, else latency and scale errors
alone, else the datasheet.
"""

import math
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np

from jaxnav.analysis.boxes import CUBE, climb, vertex
from jaxnav.analysis.plots import base as plots
from jaxnav.analysis.receiver_errors import WHITE, ReceiverErrors, best_errors, on_top, receiver, stated
from jaxnav.analysis.windows import hidden_windows
from jaxnav.checkup.motion import delay_of
from jaxnav.filters import epochs as ep
from jaxnav.filters.catalogue import FILTERS, build, with_states
from jaxnav.filters.core import Filter
from jaxnav.filters.lanes import RECEIVER_ERROR, LaneRecord, lanes, padded_shape, ready, repeated, stacked, taken
from jaxnav.filters.parameters import datasheet_states, history_for, strong
from jaxnav.filters.scores import innovation_nll, marginal_nll, masked_mean, position_noise, residual_nll
from jaxnav.findings import finding
from jaxnav.initialization.bank import most_probable
from jaxnav.initialization.initialize import Initialization, ground_velocity, initialize, timed
from jaxnav.measurements import GNSS
from jaxnav.states.grades import GRADES
from jaxnav.states.table import BIASES
from jaxnav.types import Epoch, Finding, Noise, Params, Recording, sample_rows

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COMMON = np.arange(-0.5, 4.0, 0.5)  # log10 of the common factor, coarse grid
LATENCIES = np.arange(-1, 8) / 10  # s, coarse grid where no alignment knows the delay
LATENCY_STEP = 0.05  # s, of the grid about a known delay
DELAY_SD_FACTOR, MIN_DELAY_SD = 5.0, 0.02  # on the sd of alignments' delays, which is of their model; s
COARSE_BOX, FINE_BOX = np.array([0.5, 0.5, 0.05]), np.array([0.25, 0.25, 0.025])
"""Steps of a box: log10 of the gyro and of the accelerometer factor, s."""
SCALES = np.array([-9.0, 0.0])  # log10 of the factor on scale errors: none, as stated
NO_SCALE, MAX_SCALE_DRIFT = 6.0, 1.25  # of J that none must gain; drift over that with none, up to which they stay
RATIO_SD, COMMON_SD, LATENCY_SD = 0.5, 1.5, 0.1  # decades, decades, s
CORRELATION_S, WHITENED_S = 10.0, 4.0  # s, between independent innovations; where slow errors are part of the model
SCANNED_S, WARM_UP_S = 180.0, 20.0  # s, of the part that counts at most; before it, to settle
MIN_FIXES = 20  # that count
MOVING_MPS, PARKED_S = 1.0, 30.0  # ground speed of motion; s at rest from which on the scan begins later
UP = 2  # channel of the height
MARGIN_S = 15.0  # s, before the first motion
RECEIVER_S, MAX_EPOCHS = 400.0, 640  # s and epochs at most of the part by which a receiver's errors are found
WINDOW_LENGTHS_S, PHASES = (10.0, 5.0, 3.0), 3  # hidden windows: the first length of which `MIN_WINDOWS` fit; runs
MIN_WINDOWS = 8
MAX_HARM_RATIO = 1.02  # of the datasheet's drift over hidden windows, up to which the scan is taken


VIBRATION_FACTOR = 300.0  # factor on the datasheet above which noise is vibration, a wrong unit or another grade


class NoiseScan(NamedTuple):
    """Result of a scan."""

    gyro: float = 1.0  # factor on the white noise of the gyros
    accel: float = 1.0  # on that of the accelerometers
    scale: float = 1.0  # on the noise of scale errors, 0 or 1
    latency: float = 0.0  # s
    latency_sd: float = 0.0  # s, 0 where it is stated
    receiver: ReceiverErrors = ReceiverErrors()  # errors of its positions and velocities
    assumed: np.ndarray = np.zeros(2, bool)  # (2,) level, up: usual slow errors, the recording does not show them
    gain: float = 0.0  # of J / N, the penalized log-likelihood of a fix, over factors of 1 and no latency
    coarse: np.ndarray = np.zeros((0, 0))  # (L, C) J of the coarse grid, latency by common factor, 0 at its maximum
    grid: tuple[np.ndarray, np.ndarray] = (np.zeros(0), np.zeros(0))  # (L,) s and (C,) factors of it
    part: tuple[float, float] = (0.0, 0.0)  # s, interval of the fixes that count
    fixes: int = 0
    drift_ratio: float = math.nan  # drift over hidden windows, over the datasheet's
    harm: float = math.nan  # the same of the maximum of J, which was not taken where it exceeds `MAX_HARM_RATIO`

    def extended(self, filt: Filter, params: Params) -> tuple[Filter, Params]:
        """Return filter and parameters with the state of slow errors, if the receiver has some and the filter takes it.

        Their share and time are not in these parameters yet, see `applied`.

        Args:
            filt: the filter.
            params: its parameters.
        """
        known = RECEIVER_ERROR in filt.model.states or "position" not in filt.model.measurements
        takes = filt.spec is not None and FILTERS[filt.spec.name].accepts_extra_states
        if not takes or known or not self.receiver.share.any():
            return filt, params
        filt = with_states(filt, RECEIVER_ERROR)
        return filt, params._replace(states=filt.params().states | params.states)

    def applied(self, params: Params) -> Params:
        """Return parameters with this noise, latency and errors of the receiver.

        Args:
            params: parameters of a filter with the measurements of the scan; slow errors are those of its state.
        """
        mounting = params.mounting._replace(time_offset=params.mounting.time_offset + self.latency)
        factors = self.gyro, self.accel, self.scale
        noise = Noise(*(a * factor for a, factor in zip(params.noise, factors, strict=True)))
        return self.receiver.applied(params._replace(mounting=mounting, noise=noise))

    @property
    def findings(self) -> list[Finding]:
        """Return the findings of the scan."""
        share, tau = self.receiver.share, self.receiver.tau
        slow = [
            finding("noise.slow", axis, float(share[k]), ratio=float(tau[k]))
            for k, axis in enumerate(("horizontal", "vertical"))
            if self.assumed[k]
        ]
        if not self.fixes:
            return [finding("noise.datasheet", limit=MIN_FIXES), *slow]
        scale = ""
        if share.any():
            scale = f"; of a position's stated variance {share[0]:.2g} is slow over {tau[0]:.0f} s"
            scale += f" (upwards {share[1]:.2g}, {tau[1]:.0f} s)"
        if not self.scale:
            scale += "; no scale errors of the sensors"
        if self.receiver.position != 1.0:
            scale += f"; sd of positions {self.receiver.position:.2g} times the stated"
        if self.receiver.velocity != 1.0:
            scale += f"; sd of velocities {self.receiver.velocity:.2g} times the stated"
        found = finding(
            "noise.scan", gyro=self.gyro, accel=self.accel, size=abs(self.latency),
            side="late" if self.latency >= 0 else "early", gain=self.gain, fixes=self.fixes, first=self.part[0],
            last=self.part[1], scale=scale,
        )  # fmt: skip
        most = max(self.gyro, self.accel)
        harm = []
        if self.harm > MAX_HARM_RATIO:
            plain = self.gyro == self.accel == 1.0
            kept = "the datasheet's noise" if plain else "its noise with the stated sd of the fixes"
            kept += " and this delay" if plain and self.latency else ""
            harm = [finding("noise.harm", value=self.harm, limit=MAX_HARM_RATIO, kept=kept)]
        return [found, *slow, *harm] + (
            [finding("noise.vibration", value=most, limit=VIBRATION_FACTOR)] if most > VIBRATION_FACTOR else []
        )

    def metrics(self) -> dict[str, float]:
        """Return the chosen values, as in metrics.json."""
        tested = [name for name in ("drift_ratio", "harm") if math.isfinite(getattr(self, name))]
        names = ["gyro", "accel", "scale", "gain", *tested]
        r = self.receiver
        slow = {
            "slow_share": r.share[0],
            "slow_share_up": r.share[1],
            "slow_tau_s": r.tau[0],
            "slow_tau_up_s": r.tau[1],
        }
        found = {name: getattr(self, name) for name in names} | {"latency_s": self.latency}
        found |= {"position": r.position, "velocity": r.velocity}
        return found | {name: float(value) for name, value in slow.items()}

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
        """Return the delays of the coarse grid, (5,) or (9,) s: about a known one on either side, else rather late."""
        known = self.sd < LATENCY_SD
        return self.mean + (LATENCY_STEP * np.arange(-2, 3) if known else LATENCIES) if self.free else np.zeros(1)


def known_delay(rec: Recording, params: Params, end: float, outages: Sequence[Any]) -> Delay:
    """Return what alignments up to ``end`` s say of the delay of the fixes, with an sd that allows for their models.

    ``outages``: (start, end) s, windows whose fixes are hidden.
    """
    if timed(params):
        return Delay(0.0, LATENCY_SD, False)
    seen = lambda s: sample_rows(s, (s.t <= end) & ~ep.within(s.t, outages))
    found = delay_of(rec._replace(aiding={m.name: seen(rec.aiding[m.name]) for m in GNSS if m.name in rec.aiding}))
    if found is None or DELAY_SD_FACTOR * found[1] >= LATENCY_SD:
        return Delay()
    return Delay(found[0], max(DELAY_SD_FACTOR * found[1], MIN_DELAY_SD))


class _Cut(NamedTuple):
    """Epochs of a latency: the fixes are moved by it before the recording is cut."""

    packed: ep.Packed
    stamp: np.ndarray  # (E,) s, end of each epoch by the fixes' clock
    seen: np.ndarray  # (E, m) bool
    counted: np.ndarray  # (E,) bool, epochs with fixes that count


class _Objective:
    """J over one part of a recording; a point is log10 of factors on gyros and accelerometers, and the latency in s."""

    def __init__(
        self, rec: Recording, params: Params, begin: Initialization, end: float, outages: Sequence[Any], delay: Delay,
        reach: float,
    ) -> None:  # fmt: skip
        self.rec, self.begin, self.end, self.outages, self.delay = rec, begin, end, outages, delay
        self.rows = tuple(m for m in GNSS if m.name in rec.aiding)
        states = datasheet_states(GRADES["consumer"], (*BIASES, RECEIVER_ERROR)) | params.states
        fixes = {m.name: strong(m.defaults) for m in self.rows} | params.measurements  # a filter may take ranges alone
        plain = params._replace(states=states, measurements=fixes, rule=(), feedback=(), adapter=())
        self.params = begin.apply_to(plain)
        rate, span = 1 / float(np.median(rec.imu.dt)), float(np.ptp(rec.imu.t))
        history = history_for(self.params, rate, span, reach + delay.mean)
        self.filt = build("ekf15", self.rows, 5, history, states=(RECEIVER_ERROR,))
        self.first = begin.t + min(WARM_UP_S, 0.25 * (end - begin.t))
        self.effective = (end - self.first) / CORRELATION_S
        position = rec.aiding["position"]
        inside = (position.t > begin.t) & (position.t <= end)
        self.sd = np.median(np.asarray(position.sd)[inside if inside.any() else slice(None)], 0)
        self.fixes, self.scale, self.stated = WHITE, 0.0, stated_scale(params)
        self.assumed_sd = bool(np.all(position.sd == [column.sd for column in self.rows[0].columns]))
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
        """Return the parameters of a point (10,): as above, the numbers of `receiver`, log10 on scale errors."""
        factors = 10.0 ** point[[0, 1, 9]]
        noise = Noise(*(a * factor for a, factor in zip(self.params.noise, factors, strict=True)))
        params = self.params._replace(noise=noise)
        return params if self.stated else receiver(point[3:9], self.sd).applied(params)

    def run(self, points: np.ndarray, hidden: Sequence[Sequence[Any]] = ((),)) -> tuple[LaneRecord, np.ndarray]:
        """Run points (P, 10) with each of some sets of windows (H) hidden: the record and what is hidden.

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

    def completed(self, points: np.ndarray, scales: np.ndarray | None = None) -> np.ndarray:
        """Return points (P, 3) with the errors of the fixes, and with scale errors (P,) or the chosen ones, (P, 10)."""
        scales = np.full(len(points), self.scale) if scales is None else scales
        return np.column_stack([points, np.tile(self.fixes, (len(points), 1)), scales])

    def __call__(self, points: np.ndarray, scales: np.ndarray | None = None) -> np.ndarray:
        """Return J (P,) at points (P, 3)."""
        points, each = np.unique(self.completed(np.round(points, 6), scales), axis=0, return_inverse=True)
        record, _ = self.run(points)
        mean = masked_mean(-innovation_nll(record), self.counted(points))
        return (self.effective * mean - self.penalty(points))[each.ravel()]

    def choose_scale(self, centre: np.ndarray, hidden: Sequence[Sequence[Any]]) -> np.ndarray:
        """Choose the scale errors, and return ``centre`` (3,) with the common factor that goes with them.

        Both with the common factor of the largest J; by innovations and hidden fixes together.

        Args:
            centre: (3,) the best point so far.
            hidden: sets of windows; without any scale errors stay.
        """
        if not (float(self.params.noise.scale) > 0 and len(hidden)):
            return centre
        common, scales = np.tile(COMMON, SCALES.size), np.repeat(SCALES, COMMON.size)
        J = self(np.column_stack([common, common, np.full(common.size, centre[2])]), scales)
        best = COMMON[J.reshape(SCALES.size, COMMON.size).argmax(1)]
        points = self.completed(np.column_stack([best, best, np.full(best.size, centre[2])]), SCALES)
        fit, drift = self.fit(points, hidden)
        total = np.where(
            drift <= MAX_SCALE_DRIFT * drift.min(), self.effective * fit.sum(1) - self.penalty(points), -np.inf
        )
        k = int(np.argmax(total))
        self.scale = float(SCALES[k])
        return np.array([best[k], best[k], centre[2]])

    def penalty(self, points: np.ndarray) -> np.ndarray:
        """Return minus the log of the prior density (P,) of noise, latency and scale errors at points (P, 10)."""
        noise = ((points[:, 0] - points[:, 1]) / RATIO_SD) ** 2 + (points[:, :2].mean(1) / COMMON_SD) ** 2
        off = (points[:, 2] - self.delay.mean) / self.delay.sd
        return 0.5 * (noise + off**2) + NO_SCALE * (points[:, 9] == SCALES[0])

    def windows(self) -> list[list[tuple[float, float]]]:
        """Return hidden windows in `PHASES` sets, of the longest length that enough fit of; none where too few fit."""
        cut = self.at(self.delay.mean)
        packed = cut.packed._replace(t=cut.stamp)
        for length in WINDOW_LENGTHS_S:
            found = hidden_windows(packed, length, PHASES * length, PHASES, self.first - packed.start)
            if found.start.size >= MIN_WINDOWS:
                return [[(a, a + length) for a in found.start[found.phase == p]] for p in range(PHASES)]
        return []

    def fit(self, points: np.ndarray, hidden: Sequence[Sequence[Any]]) -> tuple[np.ndarray, np.ndarray]:
        """Return how well points (P, 10) fit with some sets of windows (H) hidden.

        Mean log-likelihood of a fix and of a hidden fix together, of all channels but the height and of the height
        (P, 2), and the RMS of the hidden fixes' horizontal residuals (P,) m.
        """
        record, mask = self.run(points, hidden)
        tiled = lambda a: np.tile(a, (len(hidden), *[1] * (a.ndim - 1)))
        counted = tiled(self.counted(points))
        fixes = [self.ready(float(latency)).fix for latency in np.round(points[:, 2], 6)]
        there = tiled(np.array([np.asarray(fix.valid)[:, :3].all(1) for fix in fixes]))
        noise = [
            position_noise(self.candidate(p), np.asarray(fix.sd)[:, :3]) for p, fix in zip(points, fixes, strict=True)
        ]
        known, C = there & mask & counted, record.P + tiled(np.array(noise))
        by_phase = lambda values, mask: masked_mean(values, mask).reshape(len(hidden), -1).mean(0)
        channels = np.arange(record.nu.shape[-1])
        total = []
        for near, far in ((channels[channels != UP], [0, 1]), ([UP], [UP])):
            y = np.where(record.ok, -residual_nll(record.residual[..., far], C[..., far, :][..., far]), -np.inf)
            total.append(by_phase(-marginal_nll(record, near), counted & ~mask) + by_phase(y, known))
        square = np.where(record.ok, (record.residual[..., :2] ** 2).sum(-1), np.inf)
        return np.stack(total, 1), by_phase(square, known) ** 0.5

    def best_receiver(self, point: np.ndarray, hidden: Sequence[Sequence[Any]]) -> tuple[np.ndarray, np.ndarray]:
        """Return the numbers (6,) of the receiver's errors by `best_errors`, and which slow ones are assumed (2,).

        Args:
            point: (3,) the chosen one.
            hidden: sets of windows; without any the usual errors are assumed.
        """
        if not len(hidden):
            return stated(self.sd), np.ones(2, bool)
        weight = CORRELATION_S / WHITENED_S * self.effective

        def score(numbers: np.ndarray, phases: int | None) -> np.ndarray:
            points = [np.tile(point, (len(numbers), 1)), numbers, np.full(len(numbers), self.scale)]
            fit, drift = self.fit(np.column_stack(points), hidden[:phases])
            return np.column_stack([weight * fit, drift])

        return best_errors(score, self.sd, self.assumed_sd, len(self.rows) > 1)

    def harmless(self, point: np.ndarray, hidden: Sequence[Sequence[Any]]) -> tuple[np.ndarray, float, float]:
        """Return the first of some points that does no harm, its drift over the datasheet's, and that of the first.

        Tried are ``point`` (10,), the same with the stated errors of the fixes as white noise and slow ones on top, of
        that its delay and scale errors, its scale errors, neither, and the datasheet.
        """
        if not len(hidden):
            return point, math.nan, math.nan
        alone = np.array([0.0, 0.0, point[2]])
        firsts = (point[:3], point[9]), (alone, point[9]), (np.zeros(3), point[9]), (np.zeros(3), 0.0)
        safe, none = WHITE if self.stated else on_top(self.sd), np.concatenate([np.zeros(3), WHITE, [0.0]])
        tried = np.stack([point, *(np.concatenate([first, safe, [scale]]) for first, scale in firsts), none])
        drift = self.fit(tried, hidden)[1]
        ratio = drift / drift[-1]
        i = int(np.argmax(ratio <= MAX_HARM_RATIO))
        return tried[i], float(ratio[i]), float(ratio[0])

    def latency_sd(self, points: np.ndarray, centre: np.ndarray, off: float) -> float:
        """Return the sd, s, of a latency by the curvature of J at the points (n, 4) of a box about ``centre`` (3,).

        In it stretches of `WHITENED_S` count, as where slow errors are part of the model. ``off``: s, from the maximum.
        """
        if not self.delay.free:
            return 0.0
        t, J = points[np.isclose(points[:, :2], centre[:2]).all(1)][:, 2:].T
        prior = 1.0 / self.delay.sd**2
        curvature = -2.0 * np.polyfit(t - centre[2], J, 2)[0] if np.isfinite(J).all() else 0.0
        information = prior + max(curvature - prior, 0.0) * CORRELATION_S / WHITENED_S
        return float(np.hypot(1.0 / np.sqrt(information), off))

    def box(self, centre: np.ndarray, steps: np.ndarray) -> np.ndarray:
        """Return the 3 x 3 x 3 points about ``centre`` (27, 3) with their J, (27, 4)."""
        points = centre + steps * CUBE
        return np.column_stack([points, self(points)])


# ---------------------------------------------------------------------------- the scan


def scan_noise(
    rec: Recording,
    params: Params,
    *,
    initialization: Initialization | None = None,
    stop: float | None = None,
    outages: Sequence[Sequence[float]] = (),
    reach: float = 0.0,
) -> NoiseScan:
    """Choose the IMU's white noise, the latency and the sd of the fixes by the likelihood of the innovations.

    Args:
        rec: the recording, with positions.
        params: parameters with the datasheet's noise, such as ``filt.params("consumer")``, and the lever arm (m, body
            FRD). A latency that they state or estimate and a scale of the fixes that they state stay.
        initialization: by default `jaxnav.initialize`; after a long standstill the scan begins later.
        stop: s, end of the interval that the scan may use.
        outages: (start, end) s, windows whose fixes are hidden.
        reach: s, of its filter's history beyond the known delay: runs with as much share its program.

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
    objective_to = lambda end: _Objective(rec, params, begin, end, outages, delay, reach)
    objective = objective_to(end)
    fixes = int(objective.at(delay.mean).counted.sum())
    if fixes < MIN_FIXES:
        if objective.stated:
            return NoiseScan()
        numbers, assumed = objective.best_receiver(np.zeros(3), [])
        return NoiseScan(receiver=receiver(numbers, objective.sd), assumed=assumed)
    latencies = delay.grid()
    steps = np.array([1.0, 1.0, float(delay.free)])
    common = np.tile(COMMON, latencies.size)
    coarse = objective(np.column_stack([common, common, np.repeat(latencies, COMMON.size)]))
    coarse = coarse.reshape(latencies.size, COMMON.size)
    i, j = np.unravel_index(np.argmax(coarse), coarse.shape)
    hidden, assumed = objective.windows(), np.zeros(2, bool)
    centre = objective.choose_scale(np.array([COMMON[j], COMMON[j], latencies[i]]), hidden)
    centre, _ = climb(partial(objective.box, steps=steps * COARSE_BOX), centre)
    points = objective.box(centre, steps * FINE_BOX)
    found = vertex(points, centre, steps * FINE_BOX)
    if not objective.stated:
        seconds = min(RECEIVER_S, MAX_EPOCHS / max(fixes / (end - objective.first), 1e-3))
        later = min(objective.first + seconds, last)
        wide = objective_to(later) if later > end else objective
        wide.scale = objective.scale
        objective.fixes, assumed = wide.best_receiver(found, wide.windows())
    if objective.fixes is not WHITE and delay.free:
        timing = np.array([0.0, 0.0, COARSE_BOX[2]])
        centre, points = climb(partial(objective.box, steps=timing), found)
        found = vertex(points, centre, timing)
    point, ratio, harm = objective.harmless(objective.completed(found[None])[0], hidden)
    datasheet = coarse[np.argmin(np.abs(latencies)), np.argmin(np.abs(COMMON))]
    gain = float(points[:, 3].max() - datasheet) / objective.effective
    gyro, accel, scale = map(float, np.where(point[[0, 1, 9]] > SCALES[0], 10.0 ** point[[0, 1, 9]], 0.0))
    latency_sd = objective.latency_sd(points, centre, float(found[2] - point[2]))
    white = point[4] == WHITE[1]
    assumed |= bool(np.array_equal(point[3:9], on_top(objective.sd)))
    errors = ReceiverErrors(velocity=float(10.0 ** point[3])) if white else receiver(point[3:9], objective.sd)
    return NoiseScan(
        gyro, accel, scale, float(point[2]), latency_sd, errors, assumed & (not white), gain, coarse - coarse.max(),
        (latencies, 10.0**COMMON), (objective.first, end), fixes, ratio, harm,
    )  # fmt: skip


def usual_scan(rec: Recording, params: Params, latency: float) -> NoiseScan:
    """Return a scan that is not made: the datasheet's noise, usual errors of a receiver, and a latency.

    Args:
        rec: the recording, with positions.
        params: parameters of a filter; slow errors or scales of the fixes that they state stay.
        latency: s, of the fixes.
    """
    sd = np.median(np.asarray(rec.aiding["position"].sd), 0)
    return NoiseScan(latency=latency, receiver=ReceiverErrors() if stated_scale(params) else receiver(stated(sd), sd))


def stated_scale(params: Params) -> bool:
    """Return whether parameters state how the fixes' sd are to be scaled, or slow errors of the receiver."""
    if RECEIVER_ERROR in params.states:
        return True
    scales = [params.measurements[row.name].scale for row in GNSS if row.name in params.measurements]
    return any(not np.array_equal(scale, np.ones(np.shape(scale))) for scale in scales)


def _in_motion(rec: Recording, params: Params, begin: Initialization, last: float) -> Initialization:
    """Return the start, or a later one just before the first motion where the vehicle is parked for long."""
    velocity = ground_velocity(rec)
    speed = np.hypot(velocity.value[:, 0], velocity.value[:, 1])
    moving = (speed > np.maximum(MOVING_MPS, 3 * velocity.sd[:, :2].max(1))) & (velocity.t > begin.t)
    first = float(velocity.t[np.argmax(moving)]) if moving.any() else begin.t
    if first < begin.t + PARKED_S or last < first + PARKED_S:
        return begin
    return initialize(rec, params, t_start=first - MARGIN_S)
