"""Slots, the receiver's clock, and single-point solutions."""

import numpy as np
import pytest

from jaxnav.gnss.ranges import CLOCK_STEP, Ranges, name, number, ranges_of, selected, slots, streams, without_clock
from jaxnav.gnss.single_point import single_point
from jaxnav.measurements.satellites import PSEUDORANGE, RANGE_RATE, SATELLITE, weight
from jaxnav.states.receiver_clock import RANGE_ERROR, SLOTS
from jaxnav.types import DataError
from tests.gnss.sky import TOKYO, overhead, ranges_at


def joined(parts: list[Ranges]) -> Ranges:
    return Ranges(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def drive(seen: list[list[int]]) -> Ranges:
    """An epoch a second with these of twenty satellites each."""
    sky = overhead(TOKYO, 20)
    return joined([selected(ranges_at(TOKYO, sky, t=float(t)), np.array(own)) for t, own in enumerate(seen)])


def test_names_and_numbers():
    for each in ("G05", "J02", "E36", "C63", "R24", "S33"):
        assert name(number(each)) == each
    with pytest.raises(DataError, match="satellite 'X05'"):
        number("X05")
    with pytest.raises(DataError, match="expected one of"):
        number("G")


def test_a_satellite_keeps_its_slot_and_a_new_one_takes_the_one_free_for_longest():
    first = list(range(12))
    ranges = drive([first, first, first[1:], first[1:] + [15], first])
    slot = slots(ranges)
    of = {(t, s): i for t, s, i in zip(ranges.t.tolist(), ranges.satellite.tolist(), slot.tolist(), strict=True)}
    for s in first[1:]:
        assert len({of[float(t), s + 1] for t in range(5)}) == 1
    assert of[3.0, 16] not in {of[0.0, s + 1] for s in first}  # an empty one, not that of satellite 1
    assert of[4.0, 1] == of[0.0, 1]
    found = streams(ranges)["pseudorange"]
    restart = found.auxiliary[..., SATELLITE.index("restart")]
    assert restart.sum(1).tolist() == [12, 0, 0, 1, 0]
    assert found.valid.sum(1).tolist() == [12, 12, 11, 12, 12]


def test_the_highest_satellites_are_kept_and_a_reused_slot_starts_again():
    ranges = drive([list(range(20)), list(range(6, 20)), list(range(20))])
    slot = slots(ranges)
    kept = ranges.elevation[(ranges.t == 0) & (slot >= 0)]
    left = ranges.elevation[(ranges.t == 0) & (slot < 0)]
    assert kept.size == SLOTS and kept.min() >= left.max()
    restart = streams(ranges)["pseudorange"].auxiliary[1, :, SATELLITE.index("restart")]
    before = set(ranges.satellite[(ranges.t == 0) & (slot >= 0)])
    assert restart.sum() == len(set(range(7, 21)) - before)


def test_streams_and_rows_are_inverse():
    ranges = drive([list(range(9)), list(range(2, 11))])
    ranges = ranges._replace(range_rate=np.where(ranges.satellite == 4, np.nan, ranges.range_rate))
    again = ranges_of(streams(ranges))
    order = lambda r: selected(r, np.lexsort((r.satellite, r.t)))
    for a, b in zip(order(ranges), order(again), strict=True):
        np.testing.assert_array_equal(a, b)


def test_the_clock_is_taken_out_of_ranges_and_rates_alike():
    """Kilometres, a drift and two steps of a millisecond; a spread of 1 m is left."""
    t = np.arange(0.0, 300.0)
    rng = np.random.default_rng(3)
    clock = 4000.0 + 80.0 * t + 0.01 * t**2 - CLOCK_STEP * ((t > 100) + 3.0 * (t > 220))
    sky = overhead(TOKYO, 8)
    ranges = joined([ranges_at(TOKYO, sky, t=at, clock=c) for at, c in zip(t, clock, strict=True)])
    ranges = ranges._replace(range_rate=80.0 + 0.02 * ranges.t)
    bias = np.append(np.nan, (clock + rng.normal(size=t.size))[1:])
    left, note = without_clock(ranges, t, bias)
    distance = np.tile(np.linalg.norm(sky - TOKYO, axis=1), t.size)
    assert np.abs(left.pseudorange - distance).max() < 3.0
    assert np.abs(left.range_rate).max() < 0.6
    assert "2 steps" in str(note[0])
    # what is taken out of the ranges is the integral of what is taken out of the rates
    out, rate = (ranges.pseudorange - left.pseudorange)[::8], (ranges.range_rate - left.range_rate)[::8]
    steps = np.diff(out)
    whole = np.abs(steps) < 0.5 * CLOCK_STEP
    np.testing.assert_allclose(steps[whole], 0.5 * (rate[1:] + rate[:-1])[whole], atol=1e-3)
    assert without_clock(ranges, t, np.full(t.size, np.nan))[1] == ()


def test_single_points_are_exact_and_bear_one_fault():
    sky = overhead(TOKYO, 9)
    ranges = ranges_at(TOKYO, sky)
    found = single_point(ranges)
    np.testing.assert_allclose(found.position[0], TOKYO, atol=1e-5)
    np.testing.assert_allclose([found.clock[0], *found.velocity[0]], [100.0, 0.0, 0.0, 0.0], atol=1e-5)
    position, velocity = found.samples()
    assert position.t[0] == pytest.approx(1.0 - 100.0 / 299792458.0, abs=1e-12) and velocity.t.size == 1
    off = ranges.pseudorange.copy()
    off[3] += 200.0
    assert np.linalg.norm(single_point(ranges._replace(pseudorange=off)).position[0] - TOKYO) < 12.0
    assert not single_point(selected(ranges, np.arange(3))).t.size


def test_a_further_constellation_has_a_clock_of_its_own():
    sky = overhead(TOKYO, 9)
    ranges = ranges_at(TOKYO, sky)
    galileo = np.arange(9) >= 6
    mixed = ranges._replace(satellite=ranges.satellite + 300 * galileo, pseudorange=ranges.pseudorange + 40.0 * galileo)
    np.testing.assert_allclose(single_point(mixed).position[0], TOKYO, atol=1e-4)
    few = selected(mixed, np.array([0, 1, 2, 6]))  # four satellites, five unknowns
    assert not single_point(few).t.size


@pytest.mark.parametrize("factor", [0.3, 1.0, 3.0])
def test_the_stated_covariance_is_that_of_the_errors(factor):
    """Noise of a multiple of the usual size over 400 epochs: NEES of position and velocity within its bounds."""
    rng = np.random.default_rng(5)
    sky = overhead(TOKYO, 9)
    one = ranges_at(TOKYO, sky)
    sd = np.hypot(weight(PSEUDORANGE.defaults, one.elevation, one.cn0, np), RANGE_ERROR.defaults.sd)
    sd_rate = weight(RANGE_RATE.defaults, one.elevation, one.cn0, np)
    noise = lambda sd: factor * sd * rng.normal(size=9)
    parts = [
        one._replace(t=one.t + k, pseudorange=one.pseudorange + noise(sd), range_rate=one.range_rate + noise(sd_rate))
        for k in range(400)
    ]
    found = single_point(joined(parts))
    nees = lambda off, cov: np.einsum("ei,eij,ej->e", off, np.linalg.inv(cov), off).mean() / 3
    low = 0.85 if factor <= 1.0 else 0.7  # robust weights of large residuals widen the covariance as well
    assert low < nees(found.position - TOKYO, found.cov) < 1.25  # Huber's weights take a little from the tails
    assert low < nees(found.velocity, found.velocity_cov) < 1.25
