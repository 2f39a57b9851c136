"""`jaxnav stream`."""

import sys
from typing import TYPE_CHECKING

from jaxnav.app.verb import DATA, FILTER, MAP, PARAMS, Argument, Job, Verb

if TYPE_CHECKING:
    from jaxnav.app.results import Outcome


def run(job: Job) -> "Outcome":
    """See `jaxnav.app.jobs.stream`; rows go to standard output as they come, all words to standard error."""
    from jaxnav.app.jobs import stream

    args = job.args
    lines = None if args.source or args.data else sys.stdin
    meaning = stream.lines_of(args.axes, args.units) if args.axes or args.units else None
    outcome = stream.stream(job.config, args.speed, args.every, lines, form=args.format, meaning=meaning, port=args.udp)
    print(outcome.text, file=sys.stderr)
    return outcome._replace(text="", failed=not outcome.metrics["ok"])


VERB = Verb(
    "stream", "the solution as data arrive: from standard input, or from a recording in real time", run,
    (
        *DATA,
        MAP,
        FILTER,
        PARAMS,
        Argument("--speed", "multiple of real time (0: no wait)", value="X", type=float, more={"default": 0.0}),
        Argument("--every", "s of data between rows", value="S", type=float, more={"default": 1.0}),
        Argument("--format", "of the rows: csv, jsonl, nmea (GGA)", value="F",
                 more={"default": "csv", "choices": ("csv", "jsonl", "nmea")}),
        Argument("--axes", "of the IMU in lines of standard input, such as flu", value="AXES"),
        Argument("--units", "of those lines: of rates, accelerations, angles, such as deg/s,g,deg", value="U,U,U"),
        Argument("--udp", "send rows to this port of this machine", value="PORT", type=int),
    ),
    writes=lambda args: False,
)  # fmt: skip
