"""Stretches of a recording in which the receiver is at fault, which a filter may have followed without a word.

A receiver that is dragged off, jumps and comes back, or becomes noisy contradicts the IMU where the fault begins and
where it ends; in between its fixes agree with each other. Fixes of such a stretch are left out if those *before and
after* it are then far likelier:

    sum over the other fixes of (nll with all fixes - nll without those of the stretch) >= 20

in nats, a fix counting for the seconds it stands for, at most one, and if navigation without them contradicts one of
their positions. Of several stretches the one with the largest gain is taken, in which a fix that is left out counts as
a usual one and half a nat; then a second one, or a part of the first is used again. Leaving out good fixes makes the
later ones less likely, and a manoeuvre is no fault, for which nothing is gained elsewhere.

Candidates begin and end where innovations are far larger than usual, or some time before or after, for a fault may
begin too slowly to show. A jump that stays is a fault before or after it, which only another witness could tell. It is
said, and no stretch is left out unless that is likelier than all fixes with those behind it moved back. Where it is
likelier by less than 20 nats both are said.
"""

from collections.abc import Sequence
from itertools import combinations, product
from typing import Any, NamedTuple

import numpy as np

from jaxnav.filters import epochs as ep
from jaxnav.filters.lanes import LaneRecord, lanes, repeated, taken
from jaxnav.filters.scores import innovation_nll, nis_by_epoch, normalized, position_noise
from jaxnav.findings import finding
from jaxnav.maths import earth
from jaxnav.maths.units import TICK
from jaxnav.measurements import MEASUREMENTS
from jaxnav.types import Finding, Recording, sample_rows
from tuning.recordings.experiment import Scored

Stretch = tuple[float, float]  # begin < t <= end, s

MIN_RATIO = 4.0  # times the median of NIS/dof, of a change
APART_S, MAX_CHANGES = 4.0, 6  # s between changes, and how many are looked at, those of the largest innovations
SPANS_S = (10.0, 40.0)  # s, of stretches that begin or end at a change
STEPS_S = (6.0, 2.0, 1.0)  # s, of the search about the best one
MAX_STRETCH_S, MAX_SHARE = 150.0, 0.5  # s; of the recording
MIN_GAIN = 20.0  # nats, of the fixes that are used either way; of all, where fixes are used again
LOST = 0.5  # nats, that a fix which is left out is worse than a usual one
HIDDEN_S, LEAST_FIXES = 6.0, 2  # s hidden after a jump, and the first fixes of them, which show it
MAX_SIGMAS = 2.5  # stated sd of positions, beyond which a jump contradicts them
ROUNDS = 8  # of moves, each a stretch more or a part of one less


def changes_of(t: np.ndarray, record: LaneRecord) -> np.ndarray:
    """Return times (s) of epochs whose innovations are far larger than usual, each the largest about it.

    Args:
        t: (E,) s, inf where an epoch was added.
        record: (P, E, ...) runs.
    """
    ratio = nis_by_epoch(record).min(0)  # of the runs that see it
    ratio = np.where(np.isfinite(ratio) & np.isfinite(t), ratio, 0.0)
    ratio[ratio < MIN_RATIO * max(1.0, float(np.median(ratio[ratio > 0])))] = 0.0
    found: list[float] = []
    while ratio.any() and len(found) < MAX_CHANGES:
        found.append(float(t[np.argmax(ratio)]))
        ratio[np.abs(t - found[-1]) < APART_S] = 0.0
    return np.sort(found)


def candidates_of(changes: np.ndarray, interval: float) -> list[Stretch]:
    """Return stretches that begin or end at changes (s); fixes come every ``interval`` s.

    A fault's first fix shows its begin, and the first one after it its end.
    """
    between = list(combinations(changes - interval, 2))
    before = [(end - span, end) for end in changes - interval for span in SPANS_S]
    return between + before + [(end, end + span) for end, span in product(changes - interval, SPANS_S)]


class Jump(NamedTuple):
    """A change of the positions that the IMU contradicts and that stays: they are wrong before or after it."""

    t: float  # s, of the first fix behind it
    offset: np.ndarray  # (3,) m, ENU
    gain: float  # of all fixes, with those behind it moved back, over that of larger jumps

    @property
    def size(self) -> float:
        """Its length, m."""
        return float(np.linalg.norm(self.offset))


class _Search:
    """Gains without the fixes of stretches of one run, or with those of a part of a stretch again."""

    def __init__(self, scored: Scored) -> None:
        self.scored, self.t = scored, scored.used.t
        self.rows = tuple(MEASUREMENTS[name] for name in scored.filter.model.measurements)
        self.fixes = np.isfinite(self.t) & np.asarray(scored.used.epochs.fix.valid).any(1)
        times = self.t[self.fixes]
        self.interval, self.begin, self.end = float(np.median(np.diff(times))), float(times[0]), float(times[-1])
        self.left_out: list[Stretch] = []

    def after(self, move: Stretch) -> list[Stretch] | None:
        """Return the stretches with one more, or without a part of one; None where that is none or too long."""
        a, b = float(max(move[0], self.begin)), float(min(move[1], self.end))
        if b - a < self.interval / 2:
            return None
        others = [(c, d) for c, d in self.left_out if d <= a or b <= c]
        if len(others) == len(self.left_out):
            longest = min(MAX_STRETCH_S, MAX_SHARE * (self.end - self.begin) - sum(d - c for c, d in others))
            return sorted([*others, (a, b)]) if b - a <= longest else None
        within = [(c, d) for c, d in self.left_out if c <= a and b <= d]
        if not within:
            return None
        ((c, d),) = within
        return sorted(others + [each for each in ((c, a), (b, d)) if each[1] - each[0] > self.interval / 2])

    def __call__(self, tried: Sequence[Sequence[Stretch]]) -> tuple[np.ndarray, LaneRecord]:
        """Return gains (T,) over the present stretches, and the record without these and without each of ``tried``."""
        scored, used = self.scored, self.scored.used
        masks = np.array([ep.within(self.t, each) for each in (self.left_out, *tried)])
        valid = np.stack([np.asarray(ep.hide(used.epochs, mask, self.rows).fix.valid) for mask in masks])
        many = lambda tree: repeated(tree, len(masks))
        record = lanes(scored.filter, many(scored.params), many(used.nav), used.epochs, valid)
        nll = innovation_nll(record)
        usual = float(np.median(nll[0][self.fixes & ~masks[0]])) + LOST
        cost = np.where(masks, usual, nll)  # of fixes that are left out
        more = masks[1:] & ~masks[0]
        known = self.fixes & ~more
        rest = np.where(known, cost[0] - cost[1:], 0.0).sum(1) * min(1.0, self.interval)
        total = np.where(self.fixes, cost[0] - cost[1:], 0.0).sum(1) * min(1.0, self.interval)
        worth = np.where(more.any(1), rest, total) >= MIN_GAIN
        return np.where(worth & self.contradicted(more, record), total, -np.inf), record

    def contradicted(self, more: np.ndarray, record: LaneRecord) -> np.ndarray:
        """Return which stretches (T,) have a position that navigation without them contradicts; True of none.

        Args:
            more: (T, E) bool, epochs of the stretches.
            record: (1 + T, E, ...) with all fixes, and without each.
        """
        fix = self.scored.used.epochs.fix
        noise = position_noise(self.scored.params, np.asarray(fix.sd)[:, :3])
        known = more & np.asarray(fix.valid)[:, :3].all(1)
        square = normalized(record.residual[1:], record.P[1:] + noise) / 3
        return ~more.any(1) | (np.where(known, square, 0.0).max(1) > self.limit(record))

    def limit(self, record: LaneRecord) -> float:
        """Return the normalised square from which on a fix contradicts navigation, by the first run of a record."""
        usual = nis_by_epoch(taken(record, 0))[self.fixes]
        return MIN_RATIO * max(1.0, float(np.median(usual[np.isfinite(usual)])))

    def moved_back(self, tried: Sequence[Sequence[Jump]]) -> np.ndarray:
        """Return the gains (T,) of all fixes with the positions behind some jumps moved back."""
        scored, used = self.scored, self.scored.used
        value, known = np.asarray(used.epochs.fix.value), np.asarray(used.epochs.fix.valid)[:, :3].all(1)
        place: Any = value[known][0, :3]
        metres = np.asarray(earth.metres_per_radian(place))
        moved = [value.copy() for _ in range(1 + len(tried))]
        for each, jumps in zip(moved[1:], tried, strict=True):
            for jump in jumps:
                each[self.t >= jump.t - TICK, :3] -= jump.offset[[1, 0, 2]] / metres
        count = len(moved)
        cuts = repeated(used.epochs, count)
        cuts = cuts._replace(fix=cuts.fix._replace(value=np.stack(moved)))
        valid = np.repeat(np.asarray(used.epochs.fix.valid)[None], count, 0)
        many = lambda tree: repeated(tree, count)
        record = lanes(scored.filter, many(scored.params), many(used.nav), cuts, valid, np.arange(count))
        nll = np.where(self.fixes, innovation_nll(record), 0.0).sum(1) * min(1.0, self.interval)
        return np.where(np.isfinite(nll[1:]), nll[0] - nll[1:], -np.inf)

    def best(self, moves: Sequence[Stretch]) -> tuple[list[Stretch], float, LaneRecord] | None:
        """Return the best of some moves, after a search about it: stretches, gain and record."""
        found, move = None, (0.0, 0.0)
        for step in (0.0, *STEPS_S):
            if found is not None:
                ends = (-step, 0.0, step)
                moves = [move, *((move[0] + i, move[1] + j) for i, j in product(ends, ends))]
            each = {m: after for m in moves if (after := self.after(m)) is not None}
            if not each:
                return found
            gain, record = self(list(each.values()))
            k = int(np.argmax(gain))
            if not np.isfinite(gain[k]):
                return found
            move = list(each)[k]
            found = each[move], float(gain[k]), taken(record, slice(k + 1, k + 2))
        return found


def jumps_of(scored: Scored) -> list[Jump]:
    """Return where positions jump and stay, against the IMU and by more than `MAX_SIGMAS` of their stated sd.

    Fixes of the next `HIDDEN_S` s are hidden: navigation contradicts the first ones by the jump. All fixes are likelier
    by `MIN_GAIN` with those behind it moved back by as much, as they are not after an outlier or within a slide.

    Args:
        scored: a filter and its parameters over a recording.
    """
    search = _Search(scored)
    changes = changes_of(search.t, scored.info)
    after = [(c - search.interval, c + HIDDEN_S) for c in changes if c + HIDDEN_S < search.end]
    if not after:
        return []
    _, record = search([[each] for each in after])
    fix = scored.used.epochs.fix
    valid, stated = np.asarray(fix.valid)[:, :3].all(1), np.asarray(fix.sd)[:, :3]
    square = normalized(record.residual, record.P + position_noise(scored.params, stated)) / 3
    limit, found = search.limit(record), dict[float, np.ndarray]()
    for k, stretch in enumerate(after, 1):
        rows = np.flatnonzero(ep.within(search.t, [stretch]) & valid)[:LEAST_FIXES]
        if rows.size < LEAST_FIXES or np.median(square[k, rows]) < limit:
            continue
        offset = -np.median(record.residual[k, rows], 0)
        if np.abs(offset / np.median(stated[rows], 0)).max() > MAX_SIGMAS:
            found[float(search.t[rows[0]])] = offset
    jumps: list[Jump] = []
    while found:
        each = [Jump(t, offset, 0.0) for t, offset in found.items()]
        gains = search.moved_back([[*jumps, jump] for jump in each]) - sum(jump.gain for jump in jumps)
        best = int(np.argmax(gains))
        if gains[best] < MIN_GAIN:
            break
        jumps.append(each[best]._replace(gain=float(gains[best])))
        del found[each[best].t]
    return sorted(jumps, key=lambda jump: jump.t)


def faulty_stretches(scored: Scored, jumps: Sequence[Jump] = ()) -> tuple[list[Stretch], float]:
    """Return the stretches of a recording whose fixes make the others far less likely, and the gain without them.

    None where a jump that stays makes all fixes about as likely: leaving out those of some time before or after it only
    makes it less unlikely.

    Args:
        scored: a filter and its parameters over a recording.
        jumps: that stay.
    """
    search, record, total, changes = _Search(scored), scored.info, 0.0, np.zeros(0)
    for _ in range(ROUNDS):
        changes = np.union1d(changes, changes_of(search.t, record))
        found = search.best(candidates_of(changes, search.interval))
        if found is None:
            break
        search.left_out, gain, record = found
        total += gain
    if total < max((jump.gain for jump in jumps), default=-np.inf):
        return [], 0.0
    return search.left_out, total


def as_likely(jumps: Sequence[Jump], gain: float) -> list[Jump]:
    """Return the jumps that are about as likely as stretches of a gain are to be at fault."""
    return [jump for jump in jumps if gain < jump.gain + MIN_GAIN]


def without(rec: Recording, stretches: Sequence[Stretch]) -> Recording:
    """Return the recording without the receiver's fixes of some stretches."""
    faulty = lambda name: name in MEASUREMENTS and MEASUREMENTS[name].receiver
    left = lambda s: sample_rows(s, ~ep.within(s.t, stretches))
    return rec._replace(aiding={name: left(s) if faulty(name) else s for name, s in rec.aiding.items()})


def finding_of(left_out: Sequence[Stretch], gain: float) -> Finding:
    """Return the finding on stretches that are left out."""
    words = ", ".join(f"{a:.1f} to {b:.1f} s" for a, b in left_out)
    return finding("solve.fault", "receiver", sum(b - a for a, b in left_out), words=words, gain=gain)


def finding_of_jump(jump: Jump) -> Finding:
    """Return the finding on a jump that stays."""
    return finding("solve.jump", "positions", jump.size, t=jump.t)
