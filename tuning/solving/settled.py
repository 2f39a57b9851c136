"""Findings after a solution: what it has corrected, no command that has just run, no consequence of a known cause."""

from collections.abc import Iterable
from dataclasses import replace

from jaxnav.filters.border import name_of, user_value
from jaxnav.filters.lanes import RECEIVER_ERROR
from jaxnav.filters.parameters import get, has
from jaxnav.findings import finding, line
from jaxnav.kinds import KINDS
from jaxnav.states.installation import LEVER_ARM_ERROR
from jaxnav.types import Finding, Params

DELAY = "mounting.time_offset"
LATE = ("time.late", "velocity.latency")  # findings on a delay, whose value is one
CHECKED, TUNED = "jaxnav check", "jaxnav tune"
CONSEQUENCES = (
    "nis.high", "nis.low", "nis.overall", "innovations.correlated", "state.unexpected", "noise.harm", "noise.vibration",
    "tune.fault", "gyro.bias", "accel.bias", "time.late", "time.drift", "motion.misfit", "solve.jump",
)  # fmt: skip
EXCLUSIONS: dict[str, tuple[str, ...]] = {
    **{code: CONSEQUENCES for code, kind in KINDS.items() if kind.breaks_solution},
    "solve.inflated": ("nis.low",),  # sd are too small where there are no fixes, and not too large
    "nis.high": ("nis.overall",),
    "solve.fault": ("tune.fault",),
}
"""Findings that another one explains, or that contradict it."""
ESTIMATED = {"lever_arm": LEVER_ARM_ERROR.name}
"""States of the filter that make up for a finding."""


def settled(findings: Iterable[Finding], params: Params, tuned: bool) -> list[Finding]:
    """Return the findings that a person still needs.

    Args:
        findings: of the check and of the run.
        params: of the solution.
        tuned: it was tuned.
    """
    kept = [_now(f, params, tuned) for f in findings]
    kept = [f for f in kept if ESTIMATED.get(f.code) not in params.states]
    codes = {f.code for f in kept}
    gone = {loser for winner, losers in EXCLUSIONS.items() if winner in codes for loser in losers}
    return [f for f in kept if f.code not in gone]


def _now(f: Finding, params: Params, tuned: bool) -> Finding:
    """Return a finding as it is after the run: a delay that is taken into account, actions that are still open."""
    if f.code in LATE and f.value is not None:
        leaf = _taken(f, params)
        if leaf:
            name, value = name_of(leaf), float(user_value(leaf, get(params, leaf)))
            return finding("solve.applied", name, value, why=line(f).split(";")[0])
    ran = (CHECKED, *((TUNED,) if tuned else ()))
    actions = [action.removesuffix(f", or {TUNED}") if tuned else action for action in f.actions]
    actions = [action for action in actions if not action.startswith(ran)]
    if RECEIVER_ERROR in params.states:
        actions = [action for action in actions if RECEIVER_ERROR not in action]
    return replace(f, actions=tuple(actions))


def _taken(f: Finding, params: Params) -> str:
    """Return the latency or clock offset that corrects most of a delay; "" where there is none."""
    assert f.value is not None
    stream = "velocity" if f.code == "velocity.latency" else f.subject
    own = f"measurements.{stream}.latency"
    each = {own: float(get(params, own)) if has(params, own) else 0.0}
    if f.code != "velocity.latency":  # that one is against the position
        each[DELAY] = float(params.mounting.time_offset)
    leaf = max(each, key=lambda name: abs(each[name]))
    return leaf if abs(sum(each.values()) - f.value) < 0.5 * abs(f.value) else ""
