"""A polled log is mended: places and values of lost samples, even clock, less random walk."""

import numpy as np
import pytest

from jaxnav.data import polling

RATE, SENSOR, VIBRATION = 100.0, 100.5, 31.0  # Hz: logger, sensor, what shakes


@pytest.fixture(scope="module")
def log():
    """A sensor at 100.5 Hz under vibration, read at 100 Hz by a logger that is late by 1 ms for half of the time."""
    rng = np.random.default_rng(3)
    n = 6000
    t = np.arange(n + 200) / SENSOR
    phase = np.cumsum(rng.normal(size=(6, t.size)), axis=1) * 0.02  # the vibration wanders a little
    sensor = np.cos(2 * np.pi * VIBRATION * t + phase + np.arange(6)[:, None]).T * np.linspace(1, 3, 6)
    sensor = sensor + 0.02 * rng.normal(size=sensor.shape) + np.linspace(-1, 1, 6)
    poll = np.arange(n) / RATE + 0.001 * (2 * np.arange(n) % 17 < 8) + 0.0021
    index = np.floor(poll * SENSOR).astype(int)
    return sensor, index


def test_every_lost_sample_is_found_near_its_place(log):
    sensor, index = log
    mended = polling.repair(sensor[index])
    assert polling.repeats(sensor[index]).sum() == (np.diff(index) == 0).sum() > 50
    lost = np.setdiff1d(np.arange(index[0], index[-1] + 1), index)
    found = index[mended.poll[mended.lost]] + 1  # the sensor's index that each inserted sample stands for
    assert abs(found.size - lost.size) <= 2  # the last burst may be cut off
    near = [np.abs(lost - f).min() <= 1 for f in found]
    assert np.mean(near) > 0.9
    assert np.mean(np.isin(found, lost)) > 0.7


def test_mended_stream_integrates_to_the_sensors_own(log):
    sensor, index = log
    mended = polling.repair(sensor[index])

    def integral(values, rate):
        total = np.cumsum(values - sensor.mean(0), axis=0) / rate
        t = np.arange(1, len(values) + 1) / rate
        return np.stack([np.interp(np.arange(2.0, 58.0, 2.0), t, c) for c in total.T], axis=1)

    own = integral(sensor[index[0] : index[-1] + 1], SENSOR)
    walk = lambda a: np.std(np.diff(a - own, axis=0))  # added to the integral every 2 s
    assert walk(integral(mended.values, SENSOR)) < walk(integral(sensor[index], RATE)) / 3
    assert not np.isnan(mended.values).any()


def test_a_log_without_repeats_is_left_alone():
    values = np.random.default_rng(0).normal(size=(500, 6))
    mended = polling.repair(values)
    np.testing.assert_array_equal(mended.values, values)
    assert not mended.lost.any()


def test_repeats_at_the_ends_of_a_log_and_in_short_ones():
    for seed in range(60):
        rng = np.random.default_rng(seed)
        values = rng.normal(size=(int(rng.integers(5, 120)), 6)).cumsum(axis=0)
        for i in [1, *np.flatnonzero(rng.uniform(size=len(values)) < 0.1), len(values) - 1]:
            values[i] = values[max(i - 1, 0)]
        assert np.isfinite(polling.repair(values).values).all()
