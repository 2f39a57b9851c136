"""FILTERS: every filter by name; tests, benchmarks, the command line and the docs iterate this one table."""

from collections.abc import Callable
from typing import Any, NamedTuple

from jaxnav.error_models import local_level as local_level_errors
from jaxnav.filters.combinators import only
from jaxnav.filters.core import Filter, make_filter
from jaxnav.filters.feedback import reset
from jaxnav.filters.gpid import gpid, gpid_params, literal_params
from jaxnav.filters.kalman import kalman
from jaxnav.measurements import GNSS, Measurement
from jaxnav.mechanizations import local_level


class Entry(NamedTuple):
    """One filter of the catalogue."""

    n_states: int
    rule: Callable[[], Any]
    theta: Callable[[], Any]  # default parameters of the rule
    tunable: dict[str, str]  # leaves of theta worth tuning -> name of their transform in `tuning.transforms`
    citation: str
    form: str = "full"  # of the error model


_ANSARI = "Ansari et al. 2024, IJE 37(06) 1127-1135"
FILTERS: dict[str, Entry] = {
    "ekf15": Entry(15, kalman, lambda: (), {}, "Groves 2013, chapter 14"),
    "ekf9": Entry(9, kalman, lambda: (), {}, "Groves 2013, chapter 14, without bias states"),
    "kf9_simple": Entry(9, kalman, lambda: (), {}, f"{_ANSARI}, eqs. 9-15, the paper's standard KF", "simple"),
    "gpid": Entry(
        9, gpid, lambda: gpid_params(0.003, 0.1), {"ki": "log", "kd": "log"}, f"{_ANSARI}, on position states"
    ),
    "gpid15": Entry(
        15, gpid, lambda: gpid_params(0.003, 0.1, 15), {"ki": "log", "kd": "log"}, f"{_ANSARI}, with bias states"
    ),
    "gpid_literal": Entry(
        9, gpid, lambda: literal_params(1.0, 0.0), {"ki": "log", "kd": "log"}, f"{_ANSARI}, scheme 1 as printed",
        "simple",
    ),
}  # fmt: skip


def build(
    name: str, measurements: tuple[Measurement, ...] = GNSS, cov_stride: int = 1, history: int = 2, feedback=reset
) -> Filter:
    """The named filter in the local level frame (see `jaxnav.filters.core.make_filter` for the options).

    A paper's rule sees the receiver's channels; constraints get a plain Kalman update after it.

    Raises:
        ValueError: no such filter, or a constraint before a receiver's measurement.
    """
    if name not in FILTERS:
        raise ValueError(f"no filter {name!r}; known are {', '.join(FILTERS)}")
    entry = FILTERS[name]
    model = local_level_errors.error_model(entry.n_states, entry.form, measurements)
    rule = entry.rule()
    pseudo = [each.pseudo for each in measurements]
    if pseudo != sorted(pseudo):
        raise ValueError(f"constraints come after the receiver's: {[each.name for each in measurements]}")
    if any(pseudo) and rule is not kalman():
        rule = only(rule, sum(each.size for each in measurements if not each.pseudo))
    return make_filter(local_level.propagate, model, rule, feedback, cov_stride, history)
