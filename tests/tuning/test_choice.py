"""Which candidate wins, and which windows may judge."""

from types import SimpleNamespace

import numpy as np
import pytest

from jaxnav.filters.standstill import Standing
from jaxnav.initialization.initialize import initialize
from tuning.recordings import faults
from tuning.recordings.choice import choose
from tuning.recordings.experiment import experiments_of
from tuning.recordings.report import Trial, ratios


def test_the_datasheet_stays_unless_all_is_better():
    part = np.repeat([0, 1, 2], [8, 4, 2])
    parts, blocks = {"training": part == 0, "validation": part == 1}, np.arange(14) // 2
    before = 4.0 + np.sin(np.arange(14.0))
    own = lambda *by: before * np.array([1.0, *by])[part + 1]  # training, validation, test
    trial = lambda after, nll=0.0: Trial(SimpleNamespace(), SimpleNamespace(), after, ratios(before, after, parts), nll)
    chosen = lambda **trials: choose({"datasheet": trial(before, 1.0)} | trials, parts, blocks)
    half = trial(0.5 * before)
    assert half.ratios == pytest.approx((0.5,) * 4, rel=2e-3)
    assert chosen(tuned=half) == "tuned"
    assert (
        chosen(tuned=trial(own(0.1, 1.1, 0.1))) == "tuned"
    )  # better in training, a little worse in validation: by chance
    some = before * np.repeat([0.2, 1.2, 0.3, 1.2, 0.9, 1.1, 1.0], 2)
    assert max(trial(some).ratios[:2]) < 0.95 and chosen(tuned=trial(some)) == "datasheet"  # no more than chance
    assert chosen(auto=trial(some)) == "auto"  # three numbers by likelihood need none
    assert chosen(tuned=trial(own(0.1, 1.3, 0.1))) == "datasheet"
    assert chosen(tuned=half, slow=trial(0.9 * before, -1.0)) == "slow"  # predicts best
    assert chosen(tuned=trial(1.01 * before, -9.0)) == "datasheet"  # and drifts more
    assert chosen(tuned=trial(0.5 * before, 1.1)) == "datasheet"  # predicts worse
    assert chosen(tuned=trial(np.where(before > 0, np.inf, 0.0))) == "datasheet"
    few = np.arange(14) % 2  # windows that keep one satellite, and none
    mixed = before * np.where(few, 1.2, 0.1)
    assert max(trial(mixed).ratios) < 0.9
    assert ratios(before, mixed, parts, few) == pytest.approx((1.2,) * 4, rel=2e-3)  # the worse of both
    better = trial(0.8 * before, -1.0)
    assert chosen(auto=half, tuned=better) == "auto"  # predicts better and drifts more
    assert chosen(auto=half, tuned=trial(0.4 * before, -1.0)) == "tuned"
    assert chosen(auto=trial(1.2 * before, -0.5), tuned=better) == "tuned"  # auto does harm


@pytest.mark.full
def test_a_part_with_a_receiver_fault_is_named_and_does_not_judge(rec, ekf):
    """Positions 40 m off for 3 s: windows that touch them are left out of that part alone."""
    p = rec.aiding["position"]
    begin = p.t[-1] - 3.5
    moved = p.value + np.where((p.t > begin) & (p.t < begin + 3.0), 40.0 / 6.4e6, 0.0)[:, None] * [1.0, 0.0, 0.0]
    bad = rec._replace(aiding=rec.aiding | {"position": p._replace(value=moved)})
    start = initialize(bad, ekf.params("adis16465"))
    (experiment,) = experiments_of([bad], ekf, [start], Standing(), window=5.0)
    run = experiment.score(ekf, ekf.params("adis16465"))
    used, windows = run.used, run.used.windows
    suspect = faults.suspect_windows([run])
    kept, findings = faults.without_faults(used.parts, suspect, windows.start)
    assert [(f.code, f.subject) for f in findings] == [("tune.fault", "test")]
    assert kept["test"].sum() < used.parts["test"].sum()
    near = (windows.start < begin + 19.0) & (windows.start > begin - 15.0)
    assert not suspect[~near].any()
