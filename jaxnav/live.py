"""A live filter from the first sample on: it waits until the data show where to start, then it is a `Stream`.

Data before the start are kept for two minutes, and those behind it are replayed when it is found.
"""

import math
from collections import Counter, deque
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxnav.filters.core import Filter
from jaxnav.initialization.initialize import KNOWN_HEADING_SD, Initialization, initialize, timed
from jaxnav.measurements import MEASUREMENTS
from jaxnav.now import Now
from jaxnav.stream import SAME_EPOCH_S, Stream, checked_fix, checked_sample
from jaxnav.types import DataError, ImuLog, Params, Recording, Samples, nearest

RETRY_INTERVAL_S = 1.0  # s of data between two tries to start
MEMORY_S = 120.0  # s of data that initialization may use
MAX_WAIT_S = 60.0  # s after which a heading of a larger sd than `KNOWN_HEADING_SD` is taken, too
MIN_SAMPLES = 10  # of the IMU, before a start is tried
MAX_DELAY_SD, DELAY_WAIT_S = 0.03, 15.0  # s, of a known delay; s of data after which another is waited for no longer
USUAL_DELAY_SD = 0.1  # s, of a delay that nothing shows


class Arrival(NamedTuple):
    """A sample, a measurement or an auxiliary value."""

    t: float  # s
    name: str  # imu, or that of the others
    values: tuple[Any, ...]  # gyro, accel, dt; or value, sd, corr


class Live:
    """A filter that is fed from the first sample on, and starts by itself.

    ``filt``: as of `jaxnav.build`. ``params``: its parameters, with the lever arm. ``initialization``: of the data so
    far, such as ``partial(jaxnav.initialize, heading="course")``; a start with one heading is waited for. ``interval``:
    s, length of epochs without a fix; 0 is the median of the position's. ``more``: of `Stream`.
    """

    def __init__(
        self,
        filt: Filter,
        params: Params,
        *,
        initialization: Callable[[Recording, Params], Initialization] = initialize,
        interval: float = 0.0,
        **more: Any,
    ):
        self.filt, self.params, self.initialization = filt, params, initialization
        self.interval, self.more, self.last, self.tried = interval, more, -math.inf, -math.inf  # s, of the IMU
        self.waiting: deque[Arrival] = deque()  # of the last `MEMORY_S` seconds, as they came
        self.stream: Stream | None = None  # from the start on
        self.how = ""  # it started
        self._refused: Counter[str] = Counter()

    @property
    def refused(self) -> Counter[str]:
        """Unused data, by stream and reason."""
        return self._refused + (Counter() if self.stream is None else self.stream.refused)

    def push_imu(self, t: float, gyro: Any, accel: Any, dt: float | None = None) -> Now | None:
        """Add an IMU sample and return navigation at its time; None before the start.

        Args:
            t: s, end of the sample's interval.
            gyro: (3,) rad/s, mean angular rate, body FRD.
            accel: (3,) m/s^2, mean specific force, body FRD.
            dt: s, length of the interval; None is the time since the last sample.
        """
        if self.stream is not None:
            return self.stream.push_imu(t, gyro, accel, dt)
        row, wrong = checked_sample(t, gyro, accel, dt, self.last)
        if wrong:
            self._refused[wrong] += 1
            return None
        self.last = float(t)
        self._keep(Arrival(self.last, "imu", (row[1:4], row[4:7], dt)))
        return None

    def push(self, name: str, t: float, value: Any, sd: Any, corr: Any = None) -> Now | None:
        """Add a measurement at its time and return the present navigation; None before the start.

        Measurements that the filter lacks may help to start it, and are counted in `refused`.

        Args:
            name: a measurement, such as "position", or an auxiliary value of the filter.
            t: s, time of validity, on the IMU's clock.
            value: (size,) in the units of `Samples`: positions in rad, rad, m.
            sd: (size,) standard deviation, ENU m of a position.
            corr: (size,) correlations as in `Fix`; None is none.

        Raises:
            ValueError: a name that no measurement has.
        """
        if name not in MEASUREMENTS and name not in self.filt.model.reads:
            raise ValueError(f"no measurement {name!r}: {nearest(name, MEASUREMENTS)}")
        taken = name in self.filt.model.measurements or name in self.filt.model.reads
        if not taken:
            self._refused[f"{name}: the filter takes none"] += 1
        if self.stream is not None:
            return self.stream.push(name, t, value, sd, corr) if taken else self.stream.now
        fix: tuple[Any, ...] = (value, sd, corr)
        if name in MEASUREMENTS:
            fix, wrong = checked_fix(name, t, value, sd, corr, self.last if self.last > -math.inf else math.inf)
            if not wrong and any(e.name == name and abs(e.t - t) <= SAME_EPOCH_S for e in self.waiting):
                wrong = f"{name}: there already"
            if wrong:
                self._refused[wrong] += 1
                return None
        self._keep(Arrival(float(t), name, fix))
        if self.last < self.tried + RETRY_INTERVAL_S:
            return None
        self.tried = self.last
        return self._start()

    def _keep(self, arrival: Arrival) -> None:
        """Keep an arrival, and drop what is older than `MEMORY_S`."""
        self.waiting.append(arrival)
        while self.waiting[0].t < min(arrival.t, self.last if self.last > -math.inf else arrival.t) - MEMORY_S:
            self.waiting.popleft()

    def _start(self) -> Now | None:
        """Start if the data so far allow it, and replay those behind the start."""
        rec = self.recording()
        found = None if rec is None else self._begin(rec)
        if rec is None or found is None:
            return None
        begin, params, delay_sd = found
        interval = self.interval or float(np.median(np.diff(rec.aiding["position"].t)))
        options = {"rate": 1 / float(np.median(rec.imu.dt)), "delay_sd": delay_sd, **self.more}
        self.how, self.stream = begin.how, Stream(self.filt, params, begin, interval=interval, **options)
        for t, name, values in self.waiting:
            if name == "imu" and t > begin.t:
                self.stream.push_imu(t, *values)
            elif name in self.filt.model.reads or (name in self.filt.model.measurements and t > begin.t):
                self.stream.push(name, t, *values)
        self.waiting.clear()
        return self.stream.now

    def _begin(self, rec: Recording) -> tuple[Initialization, Params, float] | None:
        """Return a start with one sure heading, parameters with the delay that it shows, and its sd, s; or None."""
        params, waited = self.params, self.tried - self.waiting[0].t
        try:
            begin = self.initialization(rec, params)
            found = None if timed(params) else begin.alignment
            if found is not None and found.is_late:
                late = params.mounting._replace(time_offset=jnp.asarray(found.delay, float))
                params = params._replace(mounting=late)
                begin = self.initialization(rec, params)
        except DataError:  # too little so far
            return None
        sure = float(begin.prior.attitude[2]) < KNOWN_HEADING_SD or waited > MAX_WAIT_S
        late_sd = 0.0 if found is None else float(found.sd[9])
        timely = late_sd < MAX_DELAY_SD or waited > DELAY_WAIT_S
        known = begin, params, min(late_sd, USUAL_DELAY_SD)
        return known if begin.navs.t.shape[0] == 1 and sure and timely else None

    def recording(self) -> Recording | None:
        """Return the data before the start as a recording; None where there is too little."""
        rows = [each for each in self.waiting if each.name == "imu"]
        fixes = sorted((each for each in self.waiting if each.name in MEASUREMENTS), key=lambda each: each.t)
        aiding = {}
        for name in {each.name: None for each in fixes}:
            own = [each for each in fixes if each.name == name]
            columns = (np.array(column) for column in zip(*(each.values for each in own), strict=True))
            aiding[name] = Samples(np.array([each.t for each in own]), *columns)
        if len(rows) < MIN_SAMPLES or "position" not in aiding:
            return None
        t = np.array([each.t for each in rows])
        gyro, accel, dt = (list(column) for column in zip(*(each.values for each in rows), strict=True))
        usual = np.diff(t, prepend=t[0] - np.median(np.diff(t)))
        step = np.array([b if a is None else a for a, b in zip(dt, usual, strict=True)])
        imu = ImuLog(t, step, np.array(gyro), np.array(accel))
        return Recording("live", imu, aiding, None, np.asarray(self.params.mounting.lever_arm))
