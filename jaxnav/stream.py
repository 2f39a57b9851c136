"""The same filter sample by sample, for a live vehicle.

A fix belongs to its time and not to its arrival. The stream keeps the states after the last fixes, the samples and the
fixes of the last ``lag`` seconds; a late arrival is put into its place, and the epochs after it are run
again, as `jaxnav.filters.epochs.pack` would have cut them. Order and delay of arrivals make no difference, and the
solution is that of a batch but for rounding (1e-13). Between two fixes
navigation of *now* is predicted from the last epoch's end.
"""

import io
import json
import math
from bisect import bisect_right
from collections import Counter
from functools import partial
from operator import itemgetter
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxnav.filters import epochs as ep
from jaxnav.filters import gaps
from jaxnav.filters.catalogue import with_history
from jaxnav.filters.core import Filter, FilterState
from jaxnav.filters.cutting import cut_imu
from jaxnav.filters.lanes import relative_variance, slow_errors
from jaxnav.filters.parameters import history_for
from jaxnav.filters.run import require_params, require_x64
from jaxnav.initialization.initialize import Initialization
from jaxnav.maths import rotations
from jaxnav.maths.trees import structure
from jaxnav.maths.units import TICK
from jaxnav.measurements import MEASUREMENTS, layout
from jaxnav.measurements.measurement import along_track
from jaxnav.now import Now
from jaxnav.states import table
from jaxnav.types import DataError, Epoch, Fix, Imu, ImuLog, Json, Params, nearest

SAME_EPOCH_S = 2 * TICK  # s: fixes that are as near are of one epoch
MAX_AHEAD_S = 10.0  # s: a fix that is farther ahead of the samples was stamped by another clock
SPREAD_SAMPLES = 400  # samples of the spread by which a hole is judged
VERSION = 7  # of the format of `to_bytes`
PLACES = np.cumsum([1, 3, 3, 3, 9, 3, 1, 4, 3, 3])  # where the fields of `Now` begin in a report, behind the first


class Committed(NamedTuple):
    """The filter at the end of an epoch."""

    t: float  # s
    anchor: float  # s, end of the last epoch that a fix ended: from here epochs without one are counted
    empty: int  # of such epochs since then
    state: FilterState


@partial(jax.jit, static_argnums=0)
def _advance(filt: Filter, params: Params, state: FilterState, epoch: Epoch, once: int) -> FilterState:
    """Return the state after an epoch, in a loop of one step.

    XLA writes the body of a loop as it does in `jaxnav.filters.run.run`, so that both round alike; for a loop of known
    length it would keep the body alone.
    """
    only = jax.tree.map(lambda a: jnp.asarray(a)[None], epoch)
    one = lambda i, s: filt.advance(params, s, jax.tree.map(lambda a: a[i], only)).after
    return lax.fori_loop(0, once, one, state)


@partial(jax.jit, static_argnums=0)
def _predict(filt: Filter, params: Params, state: FilterState, imu: Imu) -> tuple[FilterState, jax.Array]:
    """Return the state after samples (k,), and a report (114,), the fields of `Now` one after the other."""
    state = filt.predict(params, state, imu)
    nav, _, P = filt.model.report(jax.tree.map(lambda a: a[-1], state.past), state.x, state.P)
    rph = rotations.to_rph(rotations.to_dcm(nav.q))
    biases = table.layout(table.chosen(filt.model.states)).get("gyro_bias")
    drift = jnp.zeros(3) if biases is None else jnp.sqrt(jnp.diag(P)[biases])
    sd = jnp.sqrt(jnp.concatenate([jnp.diag(P)[:9], relative_variance(P, slow_errors(filt))]))
    finite = jnp.isfinite(nav.pos).all() & jnp.isfinite(rph).all() & jnp.isfinite(sd).all() & state.ok
    first = (nav.t[None], nav.pos, nav.vel, rph, sd, finite[None].astype(float))
    return state, jnp.concatenate([*first, nav.q, nav.omega, drift, P[:9, :9].ravel()])


class Stream:
    """A filter that is fed as data comes.

    ``filt``: as of `jaxnav.build`. ``params``: its parameters. ``begin``: as of `jaxnav.initialize`, with one heading.
    ``interval``: s, length of epochs without a fix, as `navigate` takes it. ``lag``: s, how late a fix may come.
    ``rate``: Hz of the IMU, for which its programs are compiled. ``span``: s of running that the history for latencies
    is to cover. ``delay_sd``: s, of the delay between the clocks of IMU and fixes, see `Solution.at_imu_time`.

    Raises:
        ValueError: a start with several headings; params in float32.
    """

    def __init__(
        self, filt: Filter, params: Params, begin: Initialization, *, interval: float = 1.0, lag: float = 1.0,
        rate: float = 100.0, span: float = 3600.0, delay_sd: float = 0.0,
    ):  # fmt: skip
        if begin.navs.t.shape[0] != 1:
            raise ValueError(
                f"a stream needs one start, got {begin.navs.t.shape[0]} headings: wait until there has been motion"
            )
        if not (math.isfinite(interval) and interval > 0 and math.isfinite(lag) and lag >= 0):
            raise ValueError(f"interval must be positive and lag not negative, got {interval} s and {lag} s")
        if filt.model.auxiliary:
            names = ", ".join(name for name, *_ in filt.model.auxiliary)
            raise ValueError(f"a stream takes fixes and no {names}: use navigate, or a filter without them")
        self.params = begin.apply_to(params)
        require_x64(self.params)
        require_params(filt, self.params)
        self.filter = with_history(filt, history_for(self.params, rate, span))
        self.interval, self.lag, self.rate, self.span, self.delay_sd = interval, lag, rate, span, delay_sd
        self.usual = 4 * math.ceil((rate * interval + 2) / 4)  # samples of an epoch, its ends cut into two
        self.slices = layout(tuple(MEASUREMENTS[name] for name in filt.model.measurements))
        self.refused: Counter[str] = Counter()  # unused data, by stream and reason
        nav = jax.tree.map(lambda a: a[0], begin.navs)
        first = Committed(begin.t, begin.t, 0, jax.jit(self.filter.init)(self.params, nav))
        self.kept = [first]  # epochs' ends, oldest first
        self.samples: list[tuple[float, ...]] = []  # t, dt, gyro, accel of the last seconds
        self.fixes: list[tuple[float, str, np.ndarray, np.ndarray, np.ndarray]] = []  # t, name, value, sd, corr
        self.auxiliary: dict[str, list[tuple[float, float]]] = {name: [] for name in filt.model.reads}  # t, value
        self.holes: list[tuple[float, float, float, float]] = []  # begin, end, root PSD of gyro and accelerometer
        self.t = begin.t  # s, of the last sample
        for size in (self.usual, 1):  # every program is compiled now, not at the first sample or fix
            self._present(first.state, _nothing(size))
        jax.block_until_ready(_advance(self.filter, self.params, first.state, self._epoch(begin.t, begin.t, False), 1))

    # ------------------------------------------------------------------------ arrival of data

    def push_imu(self, t: float, gyro: Any, accel: Any, dt: float | None = None) -> Now:
        """Add an IMU sample and return navigation at its time.

        A sample that is not finite, or not later than the last one, changes nothing and is counted in `refused`. A hole
        is bridged by the mean of the last half second, with a larger covariance.

        Args:
            t: s, end of the sample's interval.
            gyro: (3,) rad/s, mean angular rate, body FRD.
            accel: (3,) m/s^2, mean specific force, body FRD.
            dt: s, length of the interval; None is the time since the last sample.

        Returns:
            Navigation at ``t``.
        """
        row, wrong = checked_sample(t, gyro, accel, dt, self.t)
        if wrong:
            self.refused[wrong] += 1
            return self.now
        usual = t - self.t if dt is None else dt
        if t - usual - self.t > gaps.MIN_GAP_S or (dt is None and usual > gaps.MIN_GAP_S):
            usual = self._bridge(t, usual if dt is not None else None)
        else:
            usual = min(usual, t - self.t) if dt is None else usual
        self._sample(t, usual, row[1:4], row[4:7])
        if not self._due():
            one: Any = (np.array([t - self.seen]), row[None, 1:4], row[None, 4:7])
            self._present(self.ahead, Imu(*one))
        return self.now

    def push(self, name: str, t: float, value: Any, sd: Any, corr: Any = None) -> Now:
        """Add a measurement at its time, early, late or twice, and return the present navigation.

        An auxiliary value that states of the filter read comes the same way; it is held from then on, and epochs that
        have run stay as they are. Data older than the stream's memory, or not finite, change nothing and are counted in
        `refused`.

        Args:
            name: a measurement of the filter, such as "position", or an auxiliary value.
            t: s, time of validity, on the IMU's clock.
            value: (size,) in the units of `Samples`: positions in rad, rad, m.
            sd: (size,) standard deviation, ENU m of a position.
            corr: (size,) correlations as in `Fix`; None is none.

        Returns:
            Navigation at the last sample.

        Raises:
            ValueError: a measurement that the filter lacks, or of another size.
        """
        if name in self.auxiliary:
            if math.isfinite(t) and np.isfinite(value).all():
                self.auxiliary[name].append((float(t), float(np.ravel(value)[0])))
                self.auxiliary[name].sort()
            else:
                self.refused[f"{name}: not finite"] += 1
            return self.now
        if name not in self.slices:
            raise ValueError(f"the filter takes no {name!r}: {nearest(name, self.slices)}")
        (y, spread, both), wrong = checked_fix(name, t, value, sd, corr, self.t)
        if wrong:
            self.refused[wrong] += 1
        elif t <= self.kept[0].t + SAME_EPOCH_S:
            self.refused[f"{name}: older than the last {self.lag:g} s"] += 1
        elif any(n == name and abs(s - t) <= SAME_EPOCH_S for s, n, *_ in self.fixes):
            self.refused[f"{name}: there already"] += 1
        else:
            self.fixes.append((float(t), name, y, spread, both))
            self.fixes.sort(key=lambda each: each[0])
            if t <= self.t + TICK:
                self._again(t)
        return self.now

    # ------------------------------------------------------------------------ epochs

    def _sample(self, t: float, dt: float, gyro: np.ndarray, accel: np.ndarray) -> None:
        self.samples.append((float(t), float(dt), *map(float, gyro), *map(float, accel)))
        self.t = float(t)

    def _bridge(self, t: float, dt: float | None) -> float:
        """Fill the hole before a sample that lasts ``dt``; returns how long it lasts."""
        recent = np.array(self.samples[-SPREAD_SAMPLES:]).reshape(-1, 8)
        usual = dt if dt is not None else float(np.median(recent[:, 1])) if recent.size else gaps.MIN_GAP_S
        usual = min(usual, t - self.t)
        begin, end = self.t, t - usual
        if end - begin > TICK and recent.size:
            side = recent[recent[:, 0] > begin - gaps.SIDE_S]
            spread = np.sqrt(recent[:, 2:].reshape(-1, 2, 3).var(0).mean(-1))
            noise = spread * math.sqrt(end - begin)  # as if it stayed that wrong for as long as the hole lasts
            noise[0] = min(noise[0], gaps.MAX_HIDDEN_TURN / math.sqrt(end - begin))
            self.holes.append((begin, end, float(noise[0]), float(noise[1])))
            self._sample(end, end - begin, *np.split(side[:, 2:].mean(0), 2))
        return usual

    def _again(self, t: float) -> None:
        """Run the epochs again from before a fix at ``t`` on."""
        while len(self.kept) > 1 and self.kept[-1].t > t - SAME_EPOCH_S:
            self.kept.pop()
        last = self.kept[-1]
        fill = _empty_before(t - last.anchor, self.interval)
        while len(self.kept) > 1 and last.empty > fill and last.t > last.anchor:  # the fix needs no extra epoch
            self.kept.pop()
            last = self.kept[-1]
        self._run()

    def _due(self) -> bool:
        """Run the epochs that the last sample completes; return whether there were any."""
        last = self.kept[-1]
        fix = any(last.t + SAME_EPOCH_S < t <= self.t + TICK for t, *_ in self.fixes)
        empty = self.t >= last.anchor + (last.empty + 2) * self.interval
        if fix or empty:
            self._run()
        return fix or empty

    def _run(self) -> None:
        """Every epoch that is complete after the last one kept, then navigation of now."""
        while (cut := self._next()) is not None:
            end, fixed = cut
            last = self.kept[-1]
            state = _advance(self.filter, self.params, last.state, self._epoch(last.t, end, fixed), 1)
            anchor, count = (end, 0) if fixed else (last.anchor, last.empty + 1)
            self.kept.append(Committed(end, anchor, count, state))
        self._forget()
        last = self.kept[-1]
        left, state = self._between(last.t, self.t), last.state
        count = int(np.count_nonzero(left.dt))
        size = self.usual if count > 1 else 1
        for first in range(0, max(count, 1), size):
            part: Any = (a[first : first + size] for a in left)
            self._present(state, Imu(*part))
            state = self.ahead

    def _next(self) -> tuple[float, bool] | None:
        """End of the next epoch, and whether a fix ends it; None where it is not complete."""
        last = self.kept[-1]
        times = [t for t, *_ in self.fixes if last.t + SAME_EPOCH_S < t <= self.t + TICK]
        following = last.anchor + (last.empty + 1) * self.interval
        if times:
            if last.empty < _empty_before(times[0] - last.anchor, self.interval):
                return following, False
            return times[0], True
        return (following, False) if self.t >= following + self.interval else None

    def _epoch(self, begin: float, end: float, fixed: bool) -> Epoch:
        """Return samples and fixes of one epoch, as `jaxnav.filters.epochs.pack` cuts them."""
        imu = self._between(begin, end)
        m = max(s.stop for s in self.slices.values())
        value, sd, corr, valid = np.zeros(m), np.ones(m), np.zeros(m), np.zeros(m, bool)
        for t, name, y, spread, both in self.fixes if fixed else ():
            if abs(t - end) <= SAME_EPOCH_S:
                place = self.slices[name]
                value[place], sd[place], corr[place], valid[place] = y, spread, both, True
        found = np.array(self.holes).reshape(-1, 4)
        held = gaps.Holes(found[:, 0], found[:, 1], found[:, 2:])
        gap = np.asarray(ep.gap_noise(held, begin, np.array([end])))[0] if self.holes else np.zeros(2)
        fix: Any = (value, sd, corr, valid)
        return Epoch(imu, Fix(*fix), gap, {name: self._held(name, end) for name in self.auxiliary})

    def _held(self, name: str, end: float) -> np.ndarray:
        """Return the last auxiliary value before the end of an epoch, as `jaxnav.filters.epochs.pack`; 0 for none."""
        known = self.auxiliary[name]
        last = max(bisect_right(known, end + TICK, key=itemgetter(0)) - 1, 0)
        return np.array(known[last][1] if known else 0.0)

    def _between(self, begin: float, end: float) -> Imu:
        """Return the samples between two times, padded to a multiple of the usual number: each size is compiled."""
        first = bisect_right(self.samples, begin + TICK, key=itemgetter(0))
        rows = [row for row in self.samples[first:] if row[0] - row[1] < end - TICK]
        if not rows or end <= begin + TICK:
            return _nothing(self.usual)
        table = np.array(rows)
        log = ImuLog(table[:, 0], table[:, 1], table[:, 2:5], table[:, 5:8])
        dt, gyro, accel = (a[0] for a in cut_imu(log, begin, np.array([end])))
        more = -dt.size % self.usual
        hold = lambda a: np.concatenate([a, np.repeat(a[-1:], more, 0)])
        samples: Any = (np.concatenate([dt, np.zeros(more)]), hold(gyro), hold(accel))
        return Imu(*samples)

    def _present(self, state: FilterState, imu: Imu) -> None:
        """Predict, and keep the report."""
        self.ahead, reported = _predict(self.filter, self.params, state, imu)
        self.seen, now = self.t, _now(np.asarray(reported), self.delay_sd)
        self.now = now if now.ok else getattr(self, "now", now)._replace(ok=False)  # the last that was finite

    def _forget(self) -> None:
        """Drop data that no fix can need any more."""
        oldest = self.t - self.lag
        while len(self.kept) > 1 and self.kept[1].t <= oldest:
            self.kept.pop(0)
        begin = self.kept[0].t
        self.fixes = [each for each in self.fixes if each[0] > begin - SAME_EPOCH_S]
        self.holes = [each for each in self.holes if each[1] > begin]
        for known in self.auxiliary.values():
            del known[: max(bisect_right(known, begin, key=itemgetter(0)) - 1, 0)]
        first = bisect_right(self.samples, begin + TICK, key=itemgetter(0))
        del self.samples[: max(0, min(first, len(self.samples) - SPREAD_SAMPLES))]

    # ------------------------------------------------------------------------ a restart

    def to_bytes(self) -> bytes:
        """Everything that `from_bytes` needs to go on as if nothing had happened."""
        arrays: Json = {f"state_{i}": np.stack(leaves) for i, leaves in enumerate(zip(*self._leaves(), strict=True))}
        arrays["kept"] = np.array([(c.t, c.anchor, c.empty) for c in self.kept])
        arrays["samples"] = np.array(self.samples).reshape(-1, 8)
        arrays["holes"] = np.array(self.holes).reshape(-1, 4)
        arrays["now"] = np.concatenate([np.ravel(a) for a in self.now]).astype(float)
        about = {
            "version": VERSION, "t": self.t, "interval": self.interval, "lag": self.lag, "rate": self.rate,
            "span": self.span, "delay_sd": self.delay_sd, "refused": self.refused,
            **_about(self.filter, self.params),
            "fixes": [(t, name, *(a.tolist() for a in rest)) for t, name, *rest in self.fixes],
            "auxiliary": self.auxiliary,
        }  # fmt: skip
        arrays["about"] = np.frombuffer(json.dumps(about).encode(), np.uint8)
        out = io.BytesIO()
        np.savez(out, **arrays)
        return out.getvalue()

    def _leaves(self) -> list[list[np.ndarray]]:
        states = [*(c.state for c in self.kept), self.ahead]
        return [[np.asarray(leaf) for leaf in jax.tree.leaves(state)] for state in states]

    @classmethod
    def from_bytes(cls, data: bytes, filt: Filter, params: Params, begin: Initialization) -> "Stream":
        """Restore a stream from `to_bytes`; it continues equal to the bit.

        Args:
            data: bytes of a stream with the same filter.
            filt: the filter.
            params: its parameters.
            begin: the initialization of the stream.

        Raises:
            DataError: bytes of something else, or of a stream of another filter.
        """
        try:
            with np.load(io.BytesIO(data), allow_pickle=False) as found:
                about = json.loads(bytes(found["about"]))
                rows = {key: found[key] for key in found.files if key != "about"}
            own = {"version": VERSION} | _about(filt, params)
            if any(about[key] != own[key] for key in own):
                raise DataError("the bytes are of a stream with another filter")
            options = {key: about[key] for key in ("interval", "lag", "rate", "span", "delay_sd")}
            stream = cls(filt, params, begin, **options)
            leaves, tree = jax.tree.flatten(stream.kept[0].state)
            stacks = [rows[f"state_{i}"] for i in range(len(leaves))]
            if any(stack.shape[1:] != np.shape(leaf) for stack, leaf in zip(stacks, leaves, strict=True)):
                raise DataError("the bytes are of a stream with another filter")
            stream.t = about["t"]
            stream.refused = Counter(about["refused"])
            stream.fixes = [(t, name, *map(np.array, rest)) for t, name, *rest in about["fixes"]]
            stream.auxiliary = {name: [(t, v) for t, v in rows] for name, rows in about["auxiliary"].items()}
            stream.samples = [tuple(row) for row in rows["samples"].tolist()]
            stream.holes = [tuple(row) for row in rows["holes"].tolist()]
            count = len(rows["kept"]) + 1
            states = [jax.tree.unflatten(tree, [jnp.asarray(s[k]) for s in stacks]) for k in range(count)]
            stream.kept = [Committed(t, a, int(n), s) for (t, a, n), s in zip(rows["kept"].tolist(), states)]
            stream.ahead, stream.seen, stream.now = states[-1], stream.t, _now(rows["now"])
        except DataError:
            raise
        except Exception as error:  # any error of a damaged archive
            raise DataError(f"the bytes are no stream of jaxnav: {error}") from error
        return stream


def _about(filt: Filter, params: Params) -> Json:
    """Return what a stream and the filter that goes on with it share."""
    spec = {} if filt.spec is None else filt.spec.replace(history=2).as_dict()
    rows = {"measurements": list(filt.model.measurements), "states": list(filt.model.states)}
    return {"filter": spec, **rows, "adapter": structure(params.adapter)}


def checked_sample(t: float, gyro: Any, accel: Any, dt: float | None, last: float) -> tuple[np.ndarray, str]:
    """Return a sample (7,), t (s), gyro (rad/s) and accel (m/s^2), and why it is refused, "" where it is not.

    Args:
        t: s, end of its interval.
        gyro: (3,) rad/s, body FRD.
        accel: (3,) m/s^2, body FRD.
        dt: s, its length, or None.
        last: s, the sample before.

    Raises:
        ValueError: other numbers of rates and forces.
    """
    row = np.array([t, *np.ravel(gyro), *np.ravel(accel)], float)
    if row.size != 7:
        raise ValueError(f"a sample has 3 rates and 3 forces, got {np.size(gyro)} and {np.size(accel)}")
    if not np.isfinite(row).all() or (dt is not None and not (math.isfinite(dt) and dt > 0)):
        return row, "imu: not finite"
    return row, "" if t > last + TICK else "imu: not later than the one before"


def checked_fix(name: str, t: float, value: Any, sd: Any, corr: Any, now: float) -> tuple[tuple[np.ndarray, ...], str]:
    """Return value, sd and correlations of a measurement, (size,) each, and why it is refused, "" where it is not.

    Args:
        name: a measurement.
        t: s, its time.
        value: (size,) in the units of `Samples`.
        sd: (size,), or one for all; None is 1.
        corr: (size,), None is 0.
        now: s, the last sample of the IMU.

    Raises:
        ValueError: another number of channels.
    """
    size = MEASUREMENTS[name].size
    if np.size(value) != size:
        raise ValueError(f"{name} has {size} channels, got {np.size(value)}")
    wide = lambda a, fill: np.full(size, fill) if a is None else np.broadcast_to(np.asarray(a, float), (size,))
    fix = np.ravel(np.asarray(value, float)), wide(sd, 1.0), wide(corr, 0.0)
    if not (math.isfinite(t) and np.isfinite(fix).all() and (fix[1] > 0).all()):
        return fix, f"{name}: not finite, or an sd that is not positive"
    return fix, "" if t <= now + MAX_AHEAD_S else f"{name}: more than {MAX_AHEAD_S:g} s ahead of the IMU"


def _nothing(size: int) -> Imu:
    """Return samples that last no time."""
    none: Any = (np.zeros(size), np.zeros((size, 3)), np.zeros((size, 3)))
    return Imu(*none)


def _now(a: np.ndarray, delay_sd: float = 0.0) -> Now:
    """Return navigation of a report; a delay's sd makes the position less certain along the track."""
    t, lla, vel, rph, sd, relative, ok, q, rate, rate_sd, P = np.split(a, PLACES)
    P = P.reshape(9, 9).copy()
    P[:3, :3] += delay_sd**2 * np.outer(vel, vel)
    return Now(float(t[0]), lla, vel, rph, along_track(sd, vel, delay_sd), relative, bool(ok[0]), q, rate, rate_sd, P)


def _empty_before(span: float, interval: float) -> int:
    """Epochs without a fix before one that comes ``span`` s after the last (`jaxnav.filters.epochs.cut_times`)."""
    return max(1, int(np.ceil(span / interval - 1e-3))) - 1
