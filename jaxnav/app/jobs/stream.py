"""`jaxnav stream`: the solution as data arrive, from standard input or from a recording in real time."""

import heapq
import sys
import time
from collections import deque
from collections.abc import Iterator
from typing import IO, Any, NamedTuple

import numpy as np

from jaxnav.app import prepare
from jaxnav.app.config import Config
from jaxnav.app.results import Outcome, stderr
from jaxnav.app.sources import load, scenario_of
from jaxnav.initialization.initialize import Initialization
from jaxnav.io.solution import COLUMNS, SD_COLUMNS, row_of
from jaxnav.maths.units import DEG
from jaxnav.measurements import MEASUREMENTS
from jaxnav.stream import Now, Stream
from jaxnav.types import DataError, ImuLog, Params, Recording, Samples

RETRY_INTERVAL_S = 1.0  # s of data between two tries to start
TIMED = 100_000  # last samples whose times are reported
MEMORY_S = 120.0  # s of data that initialization may use
SURE_HEADING_SD, MAX_WAIT_S = 10.0 * DEG, 60.0  # sd of a sure heading; s after which another is taken, too


class Event(NamedTuple):
    """A line of input: a sample, or a fix."""

    t: float  # s
    name: str  # imu, or a measurement
    values: tuple[float, ...]  # gyro, accel; or value, then sd


class Waiting:
    """Data before navigation has started."""

    def __init__(self, config: Config, lever_arm: np.ndarray):
        self.config, self.lever_arm, self.tried, self.count = config, lever_arm, -np.inf, 0
        self.events: list[Event] = []  # of the last `MEMORY_S` seconds

    def add(self, event: Event) -> Initialization | None:
        """Return the initialization, once the data give it with one heading."""
        self.events.append(event)
        self.count += 1
        if event.name == "imu" or event.t < self.tried + RETRY_INTERVAL_S:
            return None
        self.tried = event.t
        self.events = [each for each in self.events if each.t > event.t - MEMORY_S]
        rec = self.recording()
        try:
            begin = prepare.initialization_of(self.config, rec, params_of(self.config, rec)) if rec else None
        except DataError:  # too little so far
            return None
        if begin is None or begin.navs.t.shape[0] != 1:
            return None
        sure = float(begin.prior.attitude[2]) < SURE_HEADING_SD or event.t > self.events[0].t + MAX_WAIT_S
        return begin if sure else None

    def recording(self) -> Recording | None:
        """Return the data as a recording; None where there are none."""
        imu = np.array([(e.t, *e.values) for e in self.events if e.name == "imu"])
        aiding = {}
        for name in dict.fromkeys(e.name for e in self.events if e.name != "imu"):
            rows = np.array([(e.t, *e.values) for e in self.events if e.name == name])
            size = MEASUREMENTS[name].size
            value, sd = rows[:, 1 : 1 + size], rows[:, 1 + size : 1 + 2 * size]
            aiding[name] = Samples(rows[:, 0], value, sd, np.zeros_like(value))
        if len(imu) < 10 or "position" not in aiding:
            return None
        step = np.diff(imu[:, 0], prepend=imu[0, 0] - np.median(np.diff(imu[:, 0])))
        return Recording("stream", ImuLog(imu[:, 0], step, imu[:, 1:4], imu[:, 4:]), aiding, None, self.lever_arm)


def params_of(config: Config, rec: Recording) -> Params:
    """Return the filter's parameters by the configuration."""
    return prepare.base_params(config, prepare.grade_of(config, scenario_of(config)), rec.lever_arm)


def stream(
    config: Config, speed: float, every: float, lines: IO[str] | None = None, out: IO[str] | None = None
) -> Outcome:
    """Write a row of the solution every so many seconds of data: of [data] source, or of ``lines`` where there are any.

    ``speed``: of a recording, as a multiple of real time; 0 is as fast as possible.

    Raises:
        DataError: data that cannot be used; ends without a start.
    """
    out = sys.stdout if out is None else out
    bad: list[str] = []
    if lines is None:
        rec = load(config)
        arm, events = rec.lever_arm, paced(played(rec), speed)
    else:
        arm, events = np.zeros(3), parsed(lines, bad)
    waiting, live, due = Waiting(config, arm), None, -np.inf
    taken: deque[float] = deque(maxlen=TIMED)
    begin, rows = time.perf_counter(), 0
    for event in events:
        if live is None:
            found = waiting.add(event)
            if found is None:
                continue
            stderr(found.how)
            live = started(config, waiting, found)
            print(",".join([*COLUMNS, *SD_COLUMNS]), file=out, flush=True)
        else:
            moment = time.perf_counter()
            feed(live, event)
            if event.name == "imu":
                taken.append(time.perf_counter() - moment)
        if live.now.t >= due:
            print(line(live.now), file=out, flush=True)
            rows, due = rows + 1, live.now.t + every
    if live is None:
        raise DataError(f"no start in {waiting.count} lines: too little motion, or no position")
    refused = dict(live.refused)
    if bad:
        refused[f"lines that are none, such as {bad[0]!r}"] = len(bad)
    text = [f"{rows} rows", *(f"{n} not used: {why}" for why, n in refused.items())]
    result: dict[str, Any] = {"rows": rows, "refused": refused, "ok": live.now.ok}
    if taken:
        median, most = (1e3 * float(np.quantile(taken, q)) for q in (0.5, 0.99))
        result |= {"push_ms_median": median, "push_ms_p99": most}
        text.append(f"a sample takes {median:.2f} ms (99 %: {most:.2f} ms)")
    return Outcome(result, "\n".join(text), {"stream": time.perf_counter() - begin})


def started(config: Config, waiting: Waiting, begin: Initialization) -> Stream:
    """Return the stream from the start on, with the data after it."""
    rec = waiting.recording()
    assert rec is not None
    measurements = prepare.measurements_of(config)
    chosen = [m for m in measurements if not m.columns or m.name in rec.aiding]
    filt = prepare.filter_of(config, chosen)
    interval = config.filter.interval_s or float(np.median(np.diff(rec.aiding["position"].t)))
    rate = 1 / float(np.median(rec.imu.dt))
    live = Stream(filt, params_of(config, rec), begin, interval=interval, rate=rate)
    for event in waiting.events:
        if event.t > begin.t:
            feed(live, event)
    return live


def feed(live: Stream, event: Event) -> None:
    """Put one event into the stream; events that its filter does not use are counted."""
    if event.name == "imu":
        live.push_imu(event.t, event.values[:3], event.values[3:])
    elif event.name in live.slices:
        size = MEASUREMENTS[event.name].size
        live.push(event.name, event.t, event.values[:size], event.values[size:])
    else:
        live.refused[f"{event.name}: the filter takes none"] += 1


def played(rec: Recording) -> Iterator[Event]:
    """Return a recording's samples and fixes in the order of their times."""
    imu = rec.imu
    streams = [_events("imu", imu.t, imu.gyro, imu.accel)]
    streams += [_events(name, s.t, s.value, s.sd) for name, s in rec.aiding.items() if name in MEASUREMENTS]
    return heapq.merge(*streams, key=lambda e: (e.t, e.name))


def _events(name: str, t: np.ndarray, *values: np.ndarray) -> Iterator[Event]:
    for i in range(t.size):
        yield Event(float(t[i]), name, tuple(x for a in values for x in a[i].tolist()))


def paced(events: Iterator[Event], speed: float) -> Iterator[Event]:
    """Each at its time, so many times faster; 0: at once."""
    begin, first = time.monotonic(), None
    for event in events:
        first = event.t if first is None else first
        if speed > 0:
            time.sleep(max(0.0, (event.t - first) / speed - (time.monotonic() - begin)))
        yield event


def parsed(lines: IO[str], bad: list[str]) -> Iterator[Event]:
    """Lines ``imu,t,gyro x 3,accel x 3`` and ``position,t,lat,lon,h,sd x 3`` (rad, m, ENU); others go to ``bad``."""
    for text in lines:
        cells = text.strip().split(",")
        if cells == [""] or text.startswith("#"):
            continue
        size = 6 if cells[0] == "imu" else 2 * MEASUREMENTS[cells[0]].size if cells[0] in MEASUREMENTS else -1
        try:
            numbers = tuple(map(float, cells[1:]))
        except ValueError:
            numbers = ()
        if size < 0 or len(numbers) != size + 1:
            bad.append(text.strip()[:60])
            continue
        yield Event(numbers[0], cells[0], numbers[1:])


def line(now: Now) -> str:
    """Return a row of the solution."""
    return ",".join(map(repr, row_of(now.t, now.lla, now.vel, now.rph, now.sd)))
