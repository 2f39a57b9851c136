"""Searches of `tune` and what they leave on the disk."""

import numpy as np
import pytest

from tuning.fit import checkpoint
from tuning.recordings.search import Checkpoints, search


def test_a_search_that_was_killed_goes_on_from_its_best_and_a_finished_one_is_not_searched_again(tmp_path, job):
    """What is on the disk after each evaluation is all that the next process has."""
    mine, said = job[0](), []
    kept = Checkpoints(tmp_path, identity="job")
    whole, status = search("tuned", mine, mine.flat, [], said.append, kept)
    stored = checkpoint.load(tmp_path / "tuned.npz", mine.flat, "job")
    np.testing.assert_array_equal(stored.tree, whole)
    assert stored.head["status"] == status.value == "converged"
    assert "evaluation 0" in said[1]  # the start

    def kill(line):
        if "evaluation 1" in line:
            raise SystemExit

    with pytest.raises(SystemExit):
        search("tuned", mine, mine.flat, [], kill, kept)
    assert checkpoint.load(tmp_path / "tuned.npz", mine.flat, "job").head["status"] is None
    history = []
    again, _ = search("tuned", mine, mine.flat, history, said.append, kept._replace(resume=True))
    np.testing.assert_allclose(again, whole, atol=0.3)
    assert history and "goes on from" in " ".join(said)
    history.clear()
    same, _ = search("tuned", mine, mine.flat, history, said.append, kept._replace(resume=True))
    np.testing.assert_array_equal(same, again)
    assert not history
    with pytest.raises(checkpoint.CheckpointError):
        search("tuned", mine, mine.flat, [], said.append, kept._replace(resume=True, identity="another"))
