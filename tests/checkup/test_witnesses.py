"""Witnesses: heights, speeds and headings that part, and the errors that each sensor has anyway."""

import numpy as np
import pytest

from jaxnav.checkup.table import CHECKS
from jaxnav.checkup.witnesses import headings
from jaxnav.maths.units import DEG
from jaxnav.types import ImuLog, Recording, Samples


def column(t: np.ndarray, value: np.ndarray, sd: float) -> Samples:
    return Samples(t, value, np.full(value.shape, sd), np.zeros(value.shape))


def test_heights_that_part_are_said_and_weather_is_not():
    """A height that rises by 40 m in a minute; a climb of 300 m with 7 % of temperature and 6 m of weather."""
    rng, t = np.random.default_rng(1), np.arange(0.0, 400.0)
    imu = ImuLog(t, np.ones(t.size), np.zeros((t.size, 3)), np.zeros((t.size, 3)))
    hill = 10.0 * np.sin(t / 40.0)
    climb = 300.0 * t / 400.0
    cases = (
        ("barometer.parts", hill + 40 * np.clip((t - 100) / 60, 0, 1), hill),
        ("barometer", climb, 0.93 * climb - 6),
    )
    for code, height, said in cases:
        lla = np.column_stack([np.full(t.size, 0.8), np.full(t.size, 0.2), height + rng.normal(size=t.size)])
        aiding = {"position": column(t, lla, 1.0), "barometer": column(t, said[:, None], 0.3)}
        (found,) = CHECKS["barometer"].answer(Recording("flight", imu, aiding, None, np.zeros(3)))
        assert found.code == code
    assert found.warns is False


def rolling(ground: np.ndarray, wheels: np.ndarray, sd: float = 0.1) -> list[str]:
    """Codes of the check of wheel speeds (K,) m/s, of one wheel and of both sides, against velocities of a receiver."""
    t = np.arange(float(ground.size))
    velocity = np.column_stack([ground, np.zeros((ground.size, 2))]) + sd * np.random.default_rng(2).normal(
        size=(ground.size, 3)
    )
    imu = ImuLog(t, np.ones(t.size), np.zeros((t.size, 3)), np.zeros((t.size, 3)))
    turn = 0.4 * np.sin(t / 9.0)  # m/s, between both sides
    each = {"speed": wheels[:, None], "wheels": np.column_stack([wheels + turn, wheels - turn])}
    found = []
    for name, value in each.items():
        aiding = {"velocity": column(t, velocity, sd), name: column(t, value, 0.1)}
        found.append([f.code for f in CHECKS["speed"].answer(Recording("road", imu, aiding, None, np.zeros(3)))])
    assert found[0] == found[1]
    return found[0]


def test_speeds_that_part_are_said_and_slip_is_not():
    """A receiver that is dragged off by 2 m/s for a minute; wheels of 3 % and a slip of 0.2 m/s."""
    t = np.arange(300.0)
    true = 8.0 + 5.0 * np.sin(t / 15.0)
    slip = np.where((t > 100) & (t < 160), 0.2, 0.0)
    dragged = np.where((t > 200) & (t < 260), 2.0, 0.0)
    assert rolling(true, 1.03 * true + slip) == ["speed"]
    assert rolling(true + dragged, 1.03 * true + slip) == ["speed.parts"]
    assert rolling(true + dragged, 1.03 * true + slip, sd=0.6) == ["speed"]  # as that receiver is


def test_noise_of_a_slow_receiver_makes_no_scale():
    """At 1 m/s with velocities of 0.7 m/s: what is fast enough to be compared is noise."""
    t = np.arange(300.0)
    assert rolling(1.0 + 0.1 * np.sin(t), 1.0 + 0.1 * np.sin(t), sd=0.7) == []


@pytest.fixture(scope="module")
def turning():
    """A body that yaws, pitches and rolls in a field of 50 uT: t, rph, gyro and field."""
    t = np.arange(0.0, 300.0, 0.1)
    rph = np.column_stack([0.3 * np.sin(t / 3), 0.2 * np.sin(t / 4), 0.5 * t + np.sin(t / 7)])
    roll, pitch, heading = rph.T
    rates = np.gradient(rph, t, axis=0).T
    gyro = np.column_stack(
        [
            rates[0] - np.sin(pitch) * rates[2],
            np.cos(roll) * rates[1] + np.sin(roll) * np.cos(pitch) * rates[2],
            -np.sin(roll) * rates[1] + np.cos(roll) * np.cos(pitch) * rates[2],
        ]
    )
    north, east, down = 20.0, 4.0, 45.0
    x, y = np.cos(heading) * north + np.sin(heading) * east, -np.sin(heading) * north + np.cos(heading) * east
    x, z = np.cos(pitch) * x - np.sin(pitch) * down, np.sin(pitch) * x + np.cos(pitch) * down
    y, z = np.cos(roll) * y + np.sin(roll) * z, -np.sin(roll) * y + np.cos(roll) * z
    return t, rph, gyro, np.column_stack([x, y, z])


def test_headings_that_part_are_said(turning):
    """A solution whose heading goes off by 68 deg; declination and hard iron do not matter, iron above half does."""
    t, rph, gyro, field = turning
    lost = rph + np.column_stack([0 * t, 0 * t, 68 * DEG * np.clip((t - 100) / 50, 0, 1)])
    imu = ImuLog(t, np.full(t.size, 0.1), gyro, np.zeros((t.size, 3)))

    def said(rph, iron, sd=1.0 * DEG, field=field):
        aiding = {"magnetometer": column(t, field + iron, 1.0)}
        return headings(Recording("ring", imu, aiding, None, np.zeros(3)), t, rph, sd)

    iron = np.array([5.0, -8.0, 3.0])
    (found,) = said(lost, iron)
    assert found.code == "compass.parts" and found.value == pytest.approx(68.0, abs=3.0) and found.warns
    assert said(rph, iron) == [] and said(lost, iron, sd=6.0 * DEG) == []
    assert said(lost, 20.0 * iron) == []
    shaken = field + np.random.default_rng(5).normal(0.0, 15.0, field.shape)  # by moving iron
    assert said(lost, iron, field=field[:, ::-1]) == said(lost, iron, field=shaken) == []
    assert headings(Recording("bare", imu, {}, None, np.zeros(3)), t, rph, 1.0) == []
