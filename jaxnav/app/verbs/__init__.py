"""The verbs of the command line, a row each: ``jaxnav VERB``."""

from jaxnav.app.verb import Verb
from jaxnav.app.verbs import (
    allan,
    bakeoff,
    check,
    compare,
    completion,
    config,
    convert,
    data,
    demo,
    filter,
    info,
    map,
    mc,
    simulate,
    solve,
    stream,
    tune,
)

ROWS = (
    demo, solve, check, map, convert, simulate, filter, stream, tune, bakeoff, mc, compare, allan, config, completion,
    info, data,
)  # fmt: skip
VERBS: dict[str, Verb] = {row.VERB.name: row.VERB for row in ROWS}
