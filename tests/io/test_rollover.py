"""Clocks that start again: times go on where a counter wraps, and one part of a log that was cut is read."""

import numpy as np
import pytest

from jaxnav.io.parts import ImuRows, Parts, Stream
from jaxnav.io.rollover import PERIODS, unrolled
from jaxnav.types import DataError

T = np.arange(1, 4001) / 100.0  # s of an IMU
FIX = np.arange(1.0, 41.0)


def parts_at(t, fix):
    """Parts with an IMU and positions at these times; values count the rows."""
    rows = lambda n, s: np.tile(np.arange(float(n))[:, None], (1, s))
    return Parts("log", ImuRows(t, rows(len(t), 3), rows(len(t), 3)), {"position": Stream(fix, rows(len(fix), 3))})


@pytest.mark.parametrize("before", [0.5, 20.005, 39.5])
@pytest.mark.parametrize("period", list(PERIODS.values())[:3] + [86400.0])
def test_times_go_on_where_a_counter_wraps(period, before):
    """In all streams, also in one that begins after the wrap."""
    at = lambda t: np.mod(t + period - before, period)
    made = unrolled(parts_at(at(T), at(FIX)))
    np.testing.assert_allclose(made.imu.t - T, np.full(T.size, made.imu.t[0] - T[0]), atol=1e-5)
    np.testing.assert_allclose(made.aiding["position"].t - FIX, np.full(40, made.imu.t[0] - T[0]), atol=1e-5)
    assert any("where the counter wraps" in str(note) for note in made.notes)


def test_a_counter_that_wraps_each_second():
    """Microseconds of a second."""
    made = unrolled(parts_at(np.mod(T, 1.0), np.mod(FIX + 0.3, 1.0)))
    np.testing.assert_allclose(np.diff(made.imu.t), 0.01, atol=1e-9)


@pytest.mark.parametrize("times", [
    np.r_[T[:100], 1e6, T[100:]], np.r_[T[:100], T[103:100:-1], T[104:]], np.r_[T[:100], T[50], T[100:]],
    np.r_[T[:100], np.nan, T[100:]], T,
])  # fmt: skip
def test_rows_out_of_order_are_no_wrap(times):
    np.testing.assert_array_equal(unrolled(parts_at(times, FIX)).imu.t, times)


def test_the_longest_part_of_a_log_that_was_switched_on_again():
    parts = parts_at(np.r_[T[:1000], T], np.r_[FIX[:10], FIX])
    made = unrolled(parts)
    np.testing.assert_array_equal(made.imu.t, T)
    np.testing.assert_array_equal(made.aiding["position"].value[:, 0], np.arange(10, 50))
    assert any("in parts of 10.0 s, 40.0 s: part 2 is read" in str(note) for note in made.notes)
    first = unrolled(parts, 1)
    assert len(first.imu.t) == len(first.imu.gyro) == 1000 and len(first.aiding["position"].t) == 10
    with pytest.raises(DataError, match="log: part: expected 1 to 2, got 3"):
        unrolled(parts, 3)
    with pytest.raises(DataError, match="does not start again, there is no part 2"):
        unrolled(parts_at(T, FIX), 2)
