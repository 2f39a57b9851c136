"""Paired gain: its ratio, its interval's coverage, and blocks."""

import numpy as np
import pytest

from tuning.recordings.validation import block_ratio, paired_gain


def test_gain_is_the_ratio_of_the_rms_and_the_interval_holds_it():
    rng = np.random.default_rng(0)
    after = rng.normal(size=200)
    before = 2.0 * after + 0.1 * rng.normal(size=200)
    g = paired_gain(before, after)
    assert g.gain == pytest.approx(np.sqrt(np.mean(before**2) / np.mean(after**2)))
    assert g.low < g.gain < g.high and 1.9 < g.low and g.high < 2.1  # paired: far narrower than either RMS


def test_interval_covers_no_gain_in_95_percent_of_repeats():
    rng = np.random.default_rng(1)
    inside = 0
    for _ in range(200):
        a, b = rng.normal(size=(2, 60))
        g = paired_gain(a, b, draws=500)
        inside += g.low <= 1 <= g.high
    assert 180 <= inside <= 199


def test_blocks_widen_the_interval_of_repeated_windows():
    rng = np.random.default_rng(2)
    a, b = np.abs(rng.normal(size=(2, 20)))
    alone, copied = paired_gain(a, b), paired_gain(np.tile(a, 5), np.tile(b, 5), blocks=np.tile(np.arange(20), 5))
    assert copied.low == pytest.approx(alone.low) and copied.high == pytest.approx(alone.high)
    naive = paired_gain(np.tile(a, 5), np.tile(b, 5))
    assert naive.high - naive.low < 0.6 * (copied.high - copied.low)


@pytest.mark.parametrize(
    ("before", "after", "blocks", "says"),
    [
        ([1.0, 2.0], [1.0], None, "one length"),
        ([1.0, np.nan], [1.0, 1.0], None, "finite"),
        ([1.0, 2.0], [1.0, 1.0], [0, 0], "two blocks"),
    ],
)
def test_bad_input_is_named(before, after, blocks, says):
    with pytest.raises(ValueError, match=says):
        paired_gain(np.array(before), np.array(after), None if blocks is None else np.array(blocks))


def test_a_gain_by_chance_is_none():
    """Of errors that only scatter, 97 of 100 intervals hold one; a gain of a fifth in every block is one."""
    rng, blocks = np.random.default_rng(0), np.arange(24) // 3
    draws = [np.abs(rng.normal(size=(2, 24))) for _ in range(400)]
    assert np.mean([block_ratio(a, b, blocks).high < 1.0 for a, b in draws]) < 0.04
    found = block_ratio(draws[0][0], 0.8 * draws[0][0], blocks)
    assert found == pytest.approx((0.8, 0.8, 0.8), abs=1e-4)
    assert block_ratio(draws[0][0], np.full(24, np.inf), blocks).low > 1e3
    assert block_ratio(draws[0][0], draws[0][1], np.zeros(24)).high == np.inf
