"""A polled log is mended: places and values of lost samples, even clock, less random walk."""

import numpy as np
import pytest

from jaxnav.io import polling

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


def test_the_best_place_is_where_the_least_squares_values_leave_least(log):
    """All candidates side by side are what each of them is by itself, and by least squares in dense matrices."""
    sensor, index = log
    values = sensor[index][:400]
    repeated = polling.repeats(values)
    low, high = 200, 208
    model = polling._nearby_model(values, repeated, low - 10, high + 10)
    candidates = np.arange(low, high)[~repeated[low:high]]
    lost = [low - 3]
    costs = polling._costs(values, repeated, model, lost, candidates, low, high)
    window = np.arange(low - 2 * polling.ORDER, high + polling.ORDER)
    window = window[~repeated[window]]
    for cost, candidate in zip(costs, candidates, strict=True):
        where = np.searchsorted(window, [*lost, candidate], side="right")
        x = np.insert(values[window] - model.mean, where, 0.0, axis=0)
        missing = np.insert(np.zeros(window.size, bool), where, True)
        left = [polling._solve(x[:, c], missing, model.taps[c])[1] / model.sd[c] ** 2 for c in range(6)]
        assert cost == pytest.approx(sum(left), rel=1e-6)
