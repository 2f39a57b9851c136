"""`jaxnav stream`: the solution as data arrive, from standard input or from a recording in real time."""

import heapq
import json
import socket
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from functools import partial
from typing import IO, NamedTuple

import numpy as np

from jaxnav.app import prepare
from jaxnav.app.config import Config
from jaxnav.app.results import Outcome, stderr
from jaxnav.app.sources import load, scenario_of
from jaxnav.app.verb import Job
from jaxnav.io.solution import COLUMNS, SD_COLUMNS, row_of
from jaxnav.io.units import UNITS
from jaxnav.live import Live
from jaxnav.maths.axes import rotation
from jaxnav.measurements import MEASUREMENTS
from jaxnav.now import Now
from jaxnav.types import ConfigError, DataError, Json, Recording, nearest

TIMED = 100_000  # last samples whose times are reported
NAMES = [*COLUMNS, *SD_COLUMNS]


def _cells(now: Now) -> list[float]:
    return row_of(now.t, now.lla, now.vel, now.rph, now.sd)


FORMATS: dict[str, tuple[str, Callable[[Now], str]]] = {
    "csv": (",".join(NAMES), lambda now: ",".join(map(repr, _cells(now)))),
    "jsonl": ("", lambda now: json.dumps(dict(zip(NAMES, _cells(now), strict=True)))),
    "nmea": ("", lambda now: now.gga()),
}
"""Formats of the rows, each with its first line, "" where it has none."""


class Lines(NamedTuple):
    """Axes and units of lines; by default the library's."""

    axes: np.ndarray = np.eye(3)  # the sensor's to forward, right, down
    rate: float = 1.0  # of gyro, to rad/s
    acceleration: float = 1.0  # to m/s^2
    angle: float = 1.0  # of latitude and longitude, to rad

    def event(self, t: float, name: str, values: tuple[float, ...]) -> "Event":
        """Return the event of a line's numbers."""
        if name == "imu":
            gyro, accel = self.axes @ values[:3] * self.rate, self.axes @ values[3:] * self.acceleration
            values = (*gyro.tolist(), *accel.tolist())
        elif name == "position":
            values = (self.angle * values[0], self.angle * values[1], *values[2:])
        return Event(t, name, values)


def lines_of(axes: str | None, units: str | None) -> Lines:
    """Return axes and units as the command line names them: ``"flu"``, ``"deg/s,g,deg"`` in any order.

    Raises:
        ConfigError: axes or a unit that is not known, or two units of one kind.
    """
    found: dict[str, float] = {}
    kinds = ("rate", "acceleration", "angle")
    every = {unit: (kind, size) for kind in kinds for unit, size in UNITS[kind].items()}
    for unit in [word.strip() for word in (units or "").split(",") if word.strip()]:
        if unit not in every:
            raise ConfigError(f"--units: no unit {unit} of rates, accelerations or angles: {nearest(unit, every)}")
        kind, size = every[unit]
        if kind in found:
            raise ConfigError(f"--units {units}: two units of one {kind}")
        found[kind] = size
    try:
        return Lines(np.eye(3) if axes is None else rotation(axes), **found)
    except DataError as error:
        raise ConfigError(f"--axes: {error}") from error


class Event(NamedTuple):
    """A line of input: a sample, or a fix."""

    t: float  # s
    name: str  # imu, or a measurement
    values: tuple[float, ...]  # gyro, accel; or value, then sd


def run(job: Job) -> Outcome:
    """Stream a recording, or lines of standard input: rows to standard output, all words to standard error."""
    args = job.args
    lines = None if args.source or args.data else sys.stdin
    meaning = lines_of(args.axes, args.units) if args.axes or args.units else None
    outcome = stream(job.config, args.speed, args.every, lines, form=args.format, meaning=meaning, port=args.udp)
    print(outcome.text, file=sys.stderr)
    return outcome._replace(text="", failed=not outcome.metrics["ok"])


def stream(
    config: Config, speed: float, every: float, lines: IO[str] | None = None, out: IO[str] | None = None,
    form: str = "csv", meaning: Lines | None = None, port: int | None = None,
) -> Outcome:  # fmt: skip
    """Write a row of the solution every so many seconds of data: of [data] source, or of ``lines`` where there are any.

    ``speed``: of a recording, as a multiple of real time; 0 is as fast as possible. ``form``: one of `FORMATS`.
    ``meaning``: of ``lines``. ``port``: of this machine, to which a row goes by UDP instead of to ``out``.

    Raises:
        ConfigError: axes or units of a recording, which names its own; no port.
        DataError: data that cannot be used; ends without a start.
    """
    out = sys.stdout if out is None else out
    bad: list[str] = []
    head, written = FORMATS[form]
    if lines is None:
        rec = load(config)
        if meaning is not None:
            raise ConfigError("--axes, --units: of lines of standard input; of a recording [data] options.axes")
        arm, events = rec.lever_arm, paced(played(rec), speed)
    else:
        arm, events = np.zeros(3), parsed(lines, bad, meaning or Lines())
    params = prepare.base_params(config, prepare.grade_of(config, scenario_of(config)), arm)
    live = Live(
        prepare.filter_of(config, prepare.measurements_of(config)),
        params,
        initialization=partial(prepare.initialization_of, config),
        interval=config.filter.interval_s,
    )
    taken: deque[float] = deque(maxlen=TIMED)
    begin, rows, due, count = time.perf_counter(), 0, -np.inf, 0
    with sink(out, port) as put:
        for event in events:
            count += 1
            waits, moment = live.stream is None, time.perf_counter()
            now = feed(live, event)
            if now is None:
                continue
            if waits:
                stderr(live.how)
                if head:
                    put(head)
            elif event.name == "imu":
                taken.append(time.perf_counter() - moment)
            if now.t >= due:
                put(written(now))
                rows, due = rows + 1, now.t + every
    if live.stream is None:
        raise DataError(f"no start in {count} lines: too little motion, or no position")
    refused = dict(live.refused)
    if bad:
        refused[f"lines that are none, such as {bad[0]!r}"] = len(bad)
    text = [f"{rows} rows", *(f"{n} not used: {why}" for why, n in refused.items())]
    result: Json = {"rows": rows, "refused": refused, "ok": live.stream.now.ok}
    if taken:
        median, most = (1e3 * float(np.quantile(taken, q)) for q in (0.5, 0.99))
        result |= {"push_ms_median": median, "push_ms_p99": most}
        text.append(f"a sample takes {median:.2f} ms (99 %: {most:.2f} ms)")
    return Outcome(result, "\n".join(text), {"stream": time.perf_counter() - begin})


@contextmanager
def sink(out: IO[str], port: int | None) -> Iterator[Callable[[str], object]]:
    """Yield what writes a row: to a stream, or by UDP to a port of this machine."""
    if port is None:
        yield partial(print, file=out, flush=True)
        return
    if not 0 < port < 65536:
        raise ConfigError(f"--udp: no port {port}, expected 1 to 65535")
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as udp:
        yield lambda row: udp.sendto(f"{row}\n".encode(), ("127.0.0.1", port))


def feed(live: Live, event: Event) -> Now | None:
    """Put one event into the live filter, and return navigation after it."""
    if event.name == "imu":
        return live.push_imu(event.t, event.values[:3], event.values[3:])
    size = MEASUREMENTS[event.name].size
    return live.push(event.name, event.t, event.values[:size], event.values[size:])


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


def parsed(lines: IO[str], bad: list[str], meaning: Lines = Lines()) -> Iterator[Event]:
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
        yield meaning.event(numbers[0], cells[0], numbers[1:])
