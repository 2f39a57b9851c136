"""FILTERS: every filter by name; tests, benchmarks, the command line and the docs iterate this one table."""

from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Any, Literal, NamedTuple

import numpy as np

from jaxnav.filters.adapters import ADAPTERS
from jaxnav.filters.adapters.adapter import Adapter
from jaxnav.filters.core import Filter, make_filter
from jaxnav.filters.error_model import ErrorModel, error_model
from jaxnav.filters.feedback import observer, open_loop, poles, reset
from jaxnav.filters.papers.fuzzy_combined import combined_params, fuzzy_combined
from jaxnav.filters.papers.fwekf import fwekf, fwekf_literal, fwekf_params
from jaxnav.filters.papers.gip_kf import gip_kf, gip_kf_params, literal
from jaxnav.filters.papers.gpid import gpid, gpid_params, literal_params
from jaxnav.filters.parameters import datasheet_params, grade_of
from jaxnav.filters.rule import Feedback, Rule
from jaxnav.filters.rules.adaptive import fading, fading_params, iae, iae_params, sage_husa, sage_husa_params
from jaxnav.filters.rules.combinators import only
from jaxnav.filters.rules.kalman import kalman
from jaxnav.filters.rules.receiver import receiver, receiver_params
from jaxnav.filters.rules.robust import BLOCK, gate, gate_params, huber, huber_params, student_t, student_t_params
from jaxnav.filters.rules.satellites import gate_satellites
from jaxnav.filters.spec import FilterSpec
from jaxnav.measurements import GNSS, MEASUREMENTS, Measurement, layout
from jaxnav.states.grades import Grade
from jaxnav.states.table import BIASES, STATES
from jaxnav.strapdown.frames import FRAMES
from jaxnav.types import Params, Table, nearest


class Entry(NamedTuple):
    """One filter of the catalogue."""

    states: tuple[str, ...]  # optional ones that it has by itself
    rule: Callable[[tuple[Measurement, ...]], Rule]  # for the measurements that it corrects by, see ``sees``
    theta: Callable[[], Any]  # default parameters of the rule
    tunable: dict[str, str]  # leaves of theta worth tuning -> name of their transform in `tuning.fit.transforms`
    citation: str
    form: str = "full"  # of the error model
    frame: str = "local_level"  # of the paper, a key of FRAMES
    feedback: Feedback = reset
    feedback_theta: Callable[[], Any] = lambda: ()  # default parameters of the feedback
    accepts_extra_states: bool = False  # a paper's rule is defined for the paper's states alone
    sees: Literal["receiver", "data", "all"] = "receiver"  # measurements that its rule corrects by; others get Kalman's
    named: dict[str, str] = {}  # further leaves that are free by name alone: ``rule.NAME``, never with the group


def each(make: Callable[[], Rule]) -> Callable[[tuple[Measurement, ...]], Rule]:
    """Return the rule of an entry that is the same for any measurements."""
    return lambda rows: make()


def by_block(make: Callable[..., Rule], rule: Callable[[], Rule]) -> Callable[[tuple[Measurement, ...]], Rule]:
    """Return the rule of an entry that tests the channels of each measurement together, around another rule."""

    def of(rows: tuple[Measurement, ...]) -> Rule:
        sizes = tuple(row.size for row in rows)
        return make(rule()) if set(sizes) <= {BLOCK} else make(rule(), sizes)

    return of


def watching(rows: tuple[Measurement, ...]) -> Rule:
    """Return the rule of hypotheses of a receiver, by the places of its position and velocity."""
    places = {name: s for name, s in layout(rows).items() if name in ("position", "velocity")}
    if "position" not in places:
        raise ValueError(f"a rule that watches the receiver needs its position, not {[m.name for m in rows]}")
    return receiver(places["position"].start, places["velocity"].start if "velocity" in places else None)


_FUZZY = {"system.centres": "identity", "system.widths": "identity", "system.consequents": "identity"}
_COMBINED = {
    f"{part}.{leaf}": "identity" for part in ("fade", "adapt") for leaf in ("centres", "widths", "consequents")
}
_FWEKF = "Fuzzy weighted EKF for GPS/INS, eqs. 1-33"
ROBUST: dict[str, tuple[Callable[..., Rule], Callable[[], Any], dict[str, str], str]] = {
    "gate": (gate, gate_params, {}, "chi-square gate by block, with recovery; Groves 2013, section 17.3"),
    "huber": (huber, huber_params, {"knee": "log"}, "Huber 1964, per channel"),
    "student": (student_t, student_t_params, {"dof": "log"}, "Agamennoni et al. 2012, by block"),
    "sage_husa": (sage_husa, sage_husa_params, {}, "Sage & Husa 1969, R only, positive form"),
    "iae": (iae, iae_params, {"floor": "log"}, "Mohamed & Schwarz 1999, R only"),
    "fading": (fading, fading_params, {"tau": "log"}, "Sorenson & Sacks 1971"),
}
"""Rules made of a rule: constructor, default parameters, the parameters to tune, citation."""


def _robust(states: tuple[str, ...], name: str) -> Entry:
    """Return a robust Kalman filter."""
    make, theta, tunable, citation = ROBUST[name]
    return Entry(
        states,
        by_block(make, kalman) if name == "gate" else each(lambda: make(kalman())),
        theta,
        tunable,
        citation,
        accepts_extra_states=True,
        sees="data" if name == "gate" else "receiver",
    )


_ANSARI = "Ansari et al. 2024, IJE 37(06) 1127-1135"
_GPID = {"ki": "signed", "kd": "signed"}
_GIP_KF = "Journal of Control (English Edition) 1(1), 2022, 49-57"
_GIP_TUNABLE = {"log_rl": "identity"}  # only its ratios to R_m matter
_GIP_NAMED = {"log_rm": "identity", "rl_lower": "identity", "rm_lower": "identity"}
FILTERS: Table[Entry] = Table(
{
    "ekf15": Entry(BIASES, each(kalman), lambda: (), {}, "Groves 2013, chapter 14", accepts_extra_states=True),
    "ekf9": Entry(
        (), each(kalman), lambda: (), {}, "Groves 2013, chapter 14, no bias states", accepts_extra_states=True,
    ),
    "kf9_simple": Entry((), each(kalman), lambda: (), {}, f"{_ANSARI}, eqs. 9-15, the paper's standard KF", "simple"),
    "gpid": Entry((), each(gpid), lambda: gpid_params(0.003, 0.1), _GPID, f"{_ANSARI}, on position states"),
    "gpid15": Entry(BIASES, each(gpid), lambda: gpid_params(0.003, 0.1, 15), _GPID, f"{_ANSARI}, with bias states"),
    "gpid15_gate": Entry(
        BIASES, by_block(gate, gpid), lambda: gate_params(rule=gpid_params(0.003, 0.1, 15)),
        {f"rule.{name}": kind for name, kind in _GPID.items()}, f"{_ANSARI}, with bias states, behind a gate",
        sees="data",
    ),
    "gpid_literal": Entry(
        (), each(gpid), lambda: literal_params(1.0, 0.0), _GPID, f"{_ANSARI}, scheme 1 as printed", "simple",
    ),
    "gipkf": Entry(
        (), each(gip_kf), gip_kf_params, _GIP_TUNABLE, f"{_GIP_KF}, model error to the accelerometers",
        "simple", "tangent", named=_GIP_NAMED,
    ),
    "gipkf_mix": Entry(
        (), each(gip_kf), lambda: gip_kf_params(kappa=0.01), _GIP_TUNABLE | {"kappa": "log"},
        f"{_GIP_KF}, and attitude corrections to the gyros", "simple", "tangent", named=_GIP_NAMED,
    ),
    "gipkf_learning": Entry(
        (), each(gip_kf), lambda: gip_kf_params(growth=0.02, unlearnt=(0.02, 1e-3)),
        _GIP_TUNABLE | {"growth": "log", "unlearnt": "log"}, f"{_GIP_KF}, weights that change as biases are learnt",
        "simple", "tangent", named=_GIP_NAMED,
    ),
    "gipkf_literal": Entry(
        (), each(literal), gip_kf_params, _GIP_TUNABLE, f"{_GIP_KF}, as printed, open loop",
        "simple", "tangent", open_loop, named=_GIP_NAMED,
    ),
    "gipkf_literal_shift": Entry(
        (), each(literal), gip_kf_params, _GIP_TUNABLE, f"{_GIP_KF}, as printed, both past states shifted at a reset",
        "simple", "tangent", named=_GIP_NAMED,
    ),
    "fwekf": Entry((), each(fwekf), fwekf_params, _FUZZY, _FWEKF, "full", "inertial", observer, poles),
    "fwekf15": Entry(
        BIASES, each(fwekf), fwekf_params, _FUZZY, f"{_FWEKF}, with bias states", "full", "inertial", observer, poles
    ),
    "fwekf_literal": Entry(
        (), each(fwekf_literal), lambda: fwekf_params(0.9), _FUZZY, f"{_FWEKF}, weights and table as printed", "full",
        "inertial", observer, poles,
    ),
    "fwekf_combined": Entry(
        (), each(fuzzy_combined), combined_params, _COMBINED, "this package: fading or a new R, by fuzzy rules", "full",
        "inertial", observer, poles,
    ),
    "ekf15_receiver": Entry(
        BIASES, watching, receiver_params, {"wrong": "log", "well": "log", "late": "log"},
        "hypotheses of the receiver by Blom & Bar-Shalom 1988", accepts_extra_states=True, sees="all",
    ),
    **{f"ekf{n}_{name}": _robust(states, name) for n, states in ((9, ()), (15, BIASES)) for name in ROBUST},
}
)  # fmt: skip


def build(
    name: str | FilterSpec,
    measurements: Sequence[Measurement | str] = GNSS,
    cov_stride: int = 1,
    history: int = 2,
    feedback: Feedback | None = None,
    frame: str = "",
    fast: bool = True,
    states: Sequence[str] = (),
    adapter: str | Adapter = "",
    rule: Rule | None = None,
) -> Filter:
    """Return a filter of the catalogue, by its spec or by the fields of one.

    A paper's rule is applied to the receiver's fixes, a gate to every measurement with data; the others get a Kalman
    update after it. States that a measurement needs, as pseudoranges a receiver clock, are added.

    >>> filt = build("ekf15", measurements=("position", "velocity", "barometer"), states=("barometer_bias",))
    >>> filt.model.states
    ('gyro_bias', 'accel_bias', 'barometer_bias')
    >>> build(filt.spec.replace(history=9)).spec.history
    9

    Args:
        name: a key of `FILTERS`, or a whole spec in place of all arguments.
        measurements: rows of `MEASUREMENTS` or their names, the receiver's first.
        cov_stride: IMU samples per point of the error dynamics, see `jaxnav.filters.core.make_filter`.
        history: samples of navigation kept for late measurements.
        feedback: in place of the filter's; its parameters are in `Params.feedback`.
        frame: in place of the filter's, a key of `FRAMES`.
        fast: navigate by the frame's fast form where it has one; the plain form gives the same.
        states: optional states in addition to the filter's, names of `jaxnav.states.STATES`.
        adapter: a part that sets noise and measurements of every epoch, or its name in `ADAPTERS`; none where empty.
        rule: in place of the filter's; its parameters are in `Params.rule`.

    Raises:
        ValueError: no such filter, frame, state, measurement or adapter, a receiver's measurement that does not come
            first, states for a paper's rule, or a state that no measurement of the filter observes.
        TypeError: a spec with further arguments.
    """
    of = lambda name: FilterSpec(
        name, tuple(measurements), tuple(states), cov_stride, history, frame, fast, rule, feedback, adapter
    )
    if isinstance(name, str):
        return _build(_whole(of(name)))
    if of("") != FilterSpec("", GNSS):
        raise TypeError("a spec is whole: change it by spec.replace(...)")
    return _build(_whole(name))


def changed(filt: Filter, **fields: Any) -> Filter:
    """Return a filter of the catalogue with other fields of its spec; one composed by `make_filter` stays as it is."""
    return filt if filt.spec is None else build(filt.spec.replace(**fields))


def with_history(filt: Filter, samples: int) -> Filter:
    """Return the filter with a history of so many samples; one of other functions stays as it is."""
    if filt.spec is not None:
        return changed(filt, history=samples)
    return filt if filt.made is None else make_filter(*filt.made._replace(history=samples))._replace(params=filt.params)


def with_states(filt: Filter, *names: str) -> Filter:
    """Return a filter of the catalogue with further states; it is the same where it has them."""
    more = tuple(name for name in names if name not in filt.model.states)
    return filt if filt.spec is None else changed(filt, states=(*filt.spec.states, *more))


def _whole(spec: FilterSpec) -> FilterSpec:
    """Return a spec with its frame and all its states by name; of filters that are equal it is equal."""
    if spec.name not in FILTERS:
        raise ValueError(f"no filter {spec.name!r}: {nearest(spec.name, FILTERS)}")
    entry, given = FILTERS[spec.name], rows(spec.measurements)
    frame = spec.frame or entry.frame
    if frame not in FRAMES:
        raise ValueError(f"no frame {frame!r}: {nearest(frame, FRAMES)}")
    needed = [state for each in given for state in each.needs]
    states = tuple(dict.fromkeys(s for s in (*spec.states, *needed) if s in spec.states or s not in entry.states))
    if states and not entry.accepts_extra_states:
        raise ValueError(f"{spec.name} has the states of its paper, not {', '.join(states)}: use ekf9 or ekf15")
    others = [not each.receiver for each in given]
    if others != sorted(others):
        raise ValueError(f"constraints come after the receiver's: {[each.name for each in given]}")
    named = tuple(m.name if MEASUREMENTS.get(m.name) is m else m for m in given)
    return spec.replace(measurements=named, states=states, frame=frame)


def _build(spec: FilterSpec) -> Filter:
    entry, chosen, home = FILTERS[spec.name], rows(spec.measurements), FRAMES[spec.frame]
    model = error_model(spec.frame, (*entry.states, *spec.states), entry.form, chosen)
    quick = spec.fast and home.fast is not None
    mechanize, preintegrate = (home.fast, home.preintegrate) if quick else (home.propagate, None)
    part, feedback = _adapter(spec.adapter, chosen), spec.feedback or entry.feedback
    rule = _rule(entry, chosen, spec.rule)
    built = make_filter(mechanize, model, rule, feedback, spec.cov_stride, spec.history, preintegrate, part)
    return _named(built, spec, part)


@cache
def _named(built: Filter, spec: FilterSpec, part: Adapter | None) -> Filter:
    return built._replace(params=partial(_params, spec, built.model, part), spec=spec)


def is_built_in(spec: FilterSpec) -> bool:
    """Return whether all rows that a spec names came with the library: its sources say what the filter computes."""
    names = [m for m in spec.measurements if isinstance(m, str)]
    if len(names) < len(spec.measurements) or not isinstance(spec.adapter, str):
        return False
    used: list[tuple[Table[Any], Sequence[str]]] = [
        (FILTERS, [spec.name]),
        (FRAMES, [spec.frame]),
        (MEASUREMENTS, names),
        (STATES, (*FILTERS[spec.name].states, *spec.states)),
        (ADAPTERS, [spec.adapter] if spec.adapter else []),
    ]
    return all(table.is_built_in(name) for table, names in used for name in names)


def _params(
    spec: FilterSpec, model: ErrorModel, part: Adapter | None, grade: str | Grade = "consumer", **known: Any
) -> Params:
    """`Filter.params` of a filter of the catalogue."""
    entry = FILTERS[spec.name]
    given = {"rule": entry.theta() if spec.rule is None else (), "feedback": entry.feedback_theta()} | known
    found = datasheet_params(grade_of(grade), states=model.states, measurements=model.measurements, **given)
    return found if part is None else found._replace(adapter=part.theta())


def _adapter(adapter: str | Adapter, chosen: tuple[Measurement, ...]) -> Adapter | None:
    """Return an adapter, or that of a name for these measurements; None of no name."""
    if isinstance(adapter, Adapter) or not adapter:
        return adapter or None
    if adapter not in ADAPTERS:
        raise ValueError(f"no adapter {adapter!r}: {nearest(adapter, ADAPTERS)}")
    row = ADAPTERS[adapter]
    if missing := set(row.needs) - {each.name for each in chosen}:
        raise ValueError(f"{adapter} needs the measurement {', '.join(sorted(missing))}: add it to the filter's")
    return row.make(chosen)


def _rule(entry: Entry, chosen: tuple[Measurement, ...], given: Rule | None) -> Rule:
    """Return the entry's rule or a given one, behind a gate of satellites where there are any."""
    rule, ranges = _rule_of_fixes(entry, chosen, given), [bool(each.auxiliary) for each in chosen]
    if not any(ranges):
        return rule
    return gate_satellites(rule, tuple(np.flatnonzero(np.repeat(ranges, [each.size for each in chosen])).tolist()))


def _rule_of_fixes(entry: Entry, chosen: tuple[Measurement, ...], given: Rule | None) -> Rule:
    """Return the entry's rule, or a given one, on the measurements that it sees; the others get a Kalman update."""
    sees = entry.sees if given is None else "receiver"
    by_data = lambda row: not row.auxiliary and (row.receiver or (sees == "data" and bool(row.columns)))
    seen = [sees == "all" or by_data(row) for row in chosen]
    mine = tuple(row for row, see in zip(chosen, seen, strict=True) if see)
    if not mine:
        if given is None and (sees == "data" or entry.rule(()) is kalman()):
            return kalman()
        raise ValueError(f"the rule is for fixes, and none is in {[m.name for m in chosen]}: use ekf15 or ekf15_gate")
    rule = entry.rule(mine) if given is None else given
    if all(seen) or rule is kalman():
        return rule
    return only(rule, tuple(np.flatnonzero(np.repeat(seen, [each.size for each in chosen])).tolist()))


def rows(measurements: Sequence[Measurement | str]) -> tuple[Measurement, ...]:
    """Return rows of `MEASUREMENTS`, some of which are given by name.

    Raises:
        ValueError: a name that is not in `MEASUREMENTS`, or a measurement that comes twice.
    """
    for each in measurements:
        if isinstance(each, str) and each not in MEASUREMENTS:
            raise ValueError(f"no measurement {each!r}: {nearest(each, MEASUREMENTS)}")
    found = tuple(MEASUREMENTS[each] if isinstance(each, str) else each for each in measurements)
    if len({each.name for each in found}) < len(found):
        raise ValueError(f"a measurement comes twice in {[each.name for each in found]}")
    return found
