"""The consistency benchmark's cells, and the filter in two of them."""

import pytest

from benchmarks.simulated.consistency import SHORT, cells, study

CELLS = {cell.name: cell for cell in cells()}


def test_every_cell_has_a_name_and_the_short_form_is_part_of_them():
    assert len(CELLS) == 108 and set(SHORT) <= set(CELLS)
    assert CELLS["consumer 2cm 0.5s 3/20 car"].worst_allowed > CELLS["consumer 2m 0.5s 3/20 car"].worst_allowed


@pytest.mark.full
def test_late_precise_fixes_and_large_attitude_errors_leave_the_filter_consistent():
    """16 runs: with first-order rows of late fixes alone ANEES was above 100, without second order above 2."""
    found = study(CELLS["consumer 2cm 0.5s 1/5 car"], 16, 0)
    assert 0.8 < found["anees"] < 1.4 and 0.9 < found["anis"] < 1.1
    assert len(found["anees_by_run"]) == 16
