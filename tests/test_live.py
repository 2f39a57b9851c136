"""A live filter that is fed from the first sample on: it waits, starts by itself, and is the stream from there on."""

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.simulated.vehicles import simulated
from jaxnav import Live, Stream, build, initialize
from jaxnav.live import USUAL_DELAY_SD
from tests.test_stream import driven, events, feed, same


@pytest.fixture(scope="module")
def drive():
    return driven()


@pytest.mark.full
def test_it_is_the_stream_from_its_start_on(drive):
    rec, ekf, params, _ = drive
    begins = []
    keep = lambda rec, params: begins.append(initialize(rec, params)) or begins[-1]
    live = feed(Live(ekf, params, initialization=keep, interval=0.2, rate=50.0), rec, events(rec, -np.inf))
    assert "starts at t = " in live.how and not live.waiting and len(begins) > 1
    begin = begins[-1]
    unknown = live.stream.delay_sd
    alone = Stream(ekf, params, begin, interval=0.2, rate=50.0, delay_sd=unknown)
    same(feed(alone, rec, events(rec, begin.t)).now, live.stream.now)
    known = feed(Stream(ekf, params, begin, interval=0.2, rate=50.0), rec, events(rec, begin.t)).now
    assert 0.0 < unknown <= USUAL_DELAY_SD  # s, which are so many metres along the track
    np.testing.assert_allclose(live.stream.now.sd[:3] ** 2 - known.sd[:3] ** 2, (unknown * known.vel) ** 2, atol=1e-9)
    assert alone.now.t == pytest.approx(rec.imu.t[-1]) and alone.now.ok


@pytest.mark.full
def test_the_delay_that_the_start_shows_is_taken_into_account():
    rec, late = simulated("aircraft", "tactical", True, np.random.default_rng(1), span=30.0, late=0.3)
    ekf = build("ekf15", cov_stride=5)
    live = feed(Live(ekf, ekf.params("tactical")), rec, events(rec, -np.inf))
    assert float(live.stream.params.mounting.time_offset) == pytest.approx(late, abs=0.05)
    stated = ekf.params("tactical")
    stated = stated._replace(mounting=stated.mounting._replace(time_offset=jnp.asarray(0.1)))
    live = feed(Live(ekf, stated), rec, events(rec, -np.inf))
    assert float(live.stream.params.mounting.time_offset) == 0.1 and live.stream.delay_sd == 0.0


def test_before_the_start_there_is_no_navigation_and_nothing_brings_it_down(drive):
    """Data that a stream refuses are refused before its start, by the same words."""
    _, ekf, params, _ = drive
    live, here = Live(ekf, params), (0.8, 0.2, 100.0)
    assert live.push("position", -0.05, here, 1.0) is None  # before any sample of the IMU
    for i in range(40):
        assert live.push_imu(0.1 * i, (0, 0, 0), (0, 0, -9.81)) is None
        assert live.push("position", 0.1 * i, here, 1.0) is None
    nan = float("nan")
    live.push_imu(1.0, (0, 0, 0), (0, 0, -9.81))
    live.push_imu(9.0, (nan, 0, 0), (0, 0, -9.81))
    for t, value, sd in ((nan, here, 1.0), (3.95, here, 0.0), (1e9, here, 1.0), (3.9, here, 1.0)):
        assert live.push("position", t, value, sd) is None
    assert live.push("speed", 3.0, 1.0, 0.1) is None
    assert dict(live.refused) == {
        "imu: not later than the one before": 1, "imu: not finite": 1, "speed: the filter takes none": 1,
        "position: not finite, or an sd that is not positive": 2, "position: more than 10 s ahead of the IMU": 1,
        "position: there already": 1,
    }  # fmt: skip
    for wrong, error in (
        (lambda: live.push("positon", 1.0, here, 1.0), "no measurement 'positon'.*position"),
        (lambda: live.push("position", 1.0, here[:2], 1.0), "position has 3 channels, got 2"),
        (lambda: live.push_imu(9.0, (0, 0), (0, 0, -9.81)), "a sample has 3 rates"),
    ):
        with pytest.raises(ValueError, match=error):
            wrong()


def test_waiting_data_are_of_two_minutes(drive):
    """An hour of an IMU alone at rest, and of fixes alone."""
    _, ekf, params, _ = drive
    samples, fixes = Live(ekf, params), Live(ekf, params)
    for i in range(3600):
        samples.push_imu(float(i), (0, 0, 0), (0, 0, -9.81))
        fixes.push("position", float(i), (0.8, 0.2, 100.0), 1.0)
    assert len(samples.waiting) <= 122 and len(fixes.waiting) <= 122
