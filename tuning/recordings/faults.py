"""Parts of a recording in which the receiver is at fault: fixes that no candidate explains as it explains the others.

A fault in one part would choose the winner: the candidate that bears it best gains more there than any can elsewhere.
Normalised innovations by the candidates that are not tuned show it, relative to the median of each, so that noise that
is set too low everywhere is no fault. An epoch is suspect if its innovation, or those of `BLOCK_S` s about it, are
too large by all of them; so is a window with a suspect epoch, or with a last hidden fix that far from all predictions.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from jaxnav.filters.lanes import LaneRecord
from jaxnav.filters.scores import nis_by_epoch, normalized, position_noise
from jaxnav.findings import finding
from jaxnav.types import Finding
from tuning.recordings.experiment import Scored

BLOCK_S = 10.0  # s
MAX_BLOCK_RATIO = 4.0  # times a candidate's median of NIS/dof, of a block, and at least that
MAX_EPOCH_RATIO = 30.0  # times, of one epoch
AROUND_S = 5.0  # s, about a suspect epoch
MAX_LEFT_OUT_SHARE = 0.5  # of a part's windows, beyond which none is left out: a frequent deviation is no fault
MIN_SUSPECTS = 2  # suspect epochs or windows of a part that are worth a finding


def suspect_epochs(t: np.ndarray, infos: Sequence[LaneRecord]) -> np.ndarray:
    """Return the epochs (E,) that no candidate explains.

    Args:
        t: (E,) s, inf where an epoch was added.
        infos: (P, E, ...) runs of each candidate.
    """
    suspect = np.isfinite(t)
    block = np.where(suspect, np.floor((np.where(suspect, t, 0.0) - t[0]) / BLOCK_S), -1).astype(int)
    for info in infos:
        ratio = nis_by_epoch(info).min(0)  # of the runs that see it
        there = np.isfinite(ratio) & (block >= 0)
        sums, counts = (np.bincount(block[there], w, block.max() + 1) for w in (ratio[there], None))
        mean = sums / np.maximum(counts, 1)
        usual = max(1.0, float(np.median(mean[counts > 0])) if (counts > 0).any() else 1.0)
        high = there & ((ratio > MAX_EPOCH_RATIO * usual) | (mean[np.maximum(block, 0)] > MAX_BLOCK_RATIO * usual))
        suspect = suspect & high
    return np.asarray(suspect)


def suspect_windows(scored: Sequence[Scored]) -> np.ndarray:
    """Return the windows (W,) of a recording that judge nothing.

    Args:
        scored: each candidate that is not tuned.
    """
    used = scored[0].used
    windows, t = used.windows, used.t
    times = t[suspect_epochs(t, [s.info for s in scored])]
    near = [np.any((times > s - AROUND_S) & (times < t[e] + AROUND_S)) for s, e in zip(windows.start, windows.end)]
    lost = np.ones(len(windows.end), bool)
    sd = np.asarray(used.packed.epochs.fix.sd)[windows.end, :3]
    for s in scored:
        at = windows.phase, windows.end
        square = normalized(s.info.residual[at], s.info.P[at] + position_noise(s.params, sd)) / 3
        lost &= square > MAX_EPOCH_RATIO * max(1.0, float(np.median(square)))
    return np.array(near, bool) | lost


def without_faults(
    parts: Mapping[str, np.ndarray], suspect: np.ndarray, windows: np.ndarray
) -> tuple[dict[str, np.ndarray], list[Finding]]:
    """Return the parts without suspect windows, and a finding for each part that has some.

    Args:
        parts: masks (W,) of the windows.
        suspect: (W,) bool.
        windows: (W,) s, their starts.
    """
    kept, findings = dict(parts), []
    for name, mask in parts.items():
        bad = mask & suspect
        if bad.sum() < MIN_SUSPECTS:
            continue
        leave = bad.sum() <= MAX_LEFT_OUT_SHARE * mask.sum()
        if leave:
            kept[name] = mask & ~suspect
        first, last = windows[bad].min(), windows[bad].max()
        done = "are left out" if leave else "too many to be left out"
        findings.append(
            finding("tune.fault", name, float(bad.sum()), of=int(mask.sum()), first=first, last=last, done=done)
        )
    return kept, findings
