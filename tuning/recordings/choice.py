"""Choice of `tune`: the best prediction among the candidates that do no harm."""

from collections.abc import Mapping

import numpy as np

from tuning.recordings.report import Trial
from tuning.recordings.validation import drifts_less

MAX_VALIDATION_RATIO = 1.25  # times the datasheet's drift that the few windows of validation may show by chance


def choose(trials: Mapping[str, Trial], parts: Mapping[str, np.ndarray], blocks: np.ndarray) -> str:
    """Return the candidate that predicts the validation part best, of those that do no harm; else the datasheet.

    The scan's numbers, three by likelihood, compete with the datasheet and must not drift more; all others, of many
    numbers, compete with the better of both and must drift less by more than chance.

    Args:
        trials: the candidates.
        parts: masks (W,) of the windows.
        blocks: (W,) which windows are drawn together.
    """
    best, seen = "datasheet", parts["training"] | parts["validation"]
    if "auto" in trials and trials["auto"].nll < trials[best].nll and does_no_harm(trials["auto"], trials[best]):
        best = "auto"
    limit = trials[best]
    better = lambda t: (
        t.nll < limit.nll and does_no_harm(t, limit) and drifts_less(limit.drift[seen], t.drift[seen], blocks[seen])
    )
    passed = {name: t.nll for name, t in trials.items() if better(t)}
    return min(passed, key=lambda name: passed[name]) if passed else best


def does_no_harm(trial: Trial, other: Trial) -> bool:
    """Return whether it drifts less than another, and on the few windows of validation not much more."""
    ratios = np.array(trial.ratios) / np.array(other.ratios)
    return bool(max(ratios[:2]) < 1.0 and max(ratios[2:]) < MAX_VALIDATION_RATIO)
