"""Simulated vehicles that are not the library's: random courses of a kind, through python-ins' IMU."""

from typing import NamedTuple

import numpy as np

from jaxnav.states.grades import GRADES
from jaxnav.types import ImuLog, Recording, Samples, Track

RATE, SPAN = 100.0, 70.0  # Hz, s


class Vehicle(NamedTuple):
    """How a vehicle moves: amplitudes of sums of three sines with random periods."""

    turn: float  # rad/s
    speed: tuple[float, float]  # m/s, mean and amplitude
    climb: float  # m/s
    periods: tuple[float, float] = (12.0, 30.0)  # s, of the speed
    banked: bool = False
    crab: float = 0.0  # rad, of velocity to heading
    sway: float = 0.03  # rad, of roll and pitch
    steps: float = 0.0  # m/s, of speed at 1.9 Hz
    current: float = 0.0  # m/s, sd of a constant horizontal velocity on top
    straight: float = 0.0  # share of the time without a turn
    circle: float = 0.0  # rad/s, mean rate of turn
    sideways: float = 0.0  # rate of the crab angle over that of the heading


VEHICLES = {
    "car": Vehicle(0.25, (9.0, 6.0), 0.3),
    "aircraft": Vehicle(0.3, (24.0, 4.0), 2.5, (15.0, 40.0), True, 0.1),
    "walk": Vehicle(0.25, (1.3, 0.4), 0.05, (6.0, 20.0), steps=0.2),
    "robot": Vehicle(0.4, (0.7, 0.6), 0.05, (6.0, 20.0)),
    "ship": Vehicle(0.03, (6.0, 1.5), 0.3, (30.0, 60.0), sway=0.08, current=1.0),
    "train": Vehicle(0.02, (22.0, 8.0), 0.1, (40.0, 90.0), sway=0.01),
    "bus": Vehicle(0.06, (7.0, 6.0), 0.2, (20.0, 40.0)),
    "mower": Vehicle(0.5, (0.8, 0.3), 0.02, (6.0, 20.0), sway=0.05),
    "glider": Vehicle(0.35, (28.0, 3.0), 2.0, (15.0, 40.0), True),
    "jet": Vehicle(0.12, (180.0, 20.0), 15.0, (15.0, 40.0), True),
    "helicopter": Vehicle(0.2, (15.0, 10.0), 3.0, (10.0, 30.0), False, 0.5, 0.1),
}
MOTIONS = tuple(VEHICLES)
VEHICLES |= {
    "coach": Vehicle(0.25, (9.0, 7.0), 0.2, (20.0, 40.0), straight=0.8),
    "thermal": Vehicle(0.1, (28.0, 3.0), 2.0, (15.0, 40.0), True, circle=0.3),
    "steep": Vehicle(0.25, (30.0, 3.0), 2.0, (15.0, 40.0), True, circle=0.4),  # banks by 50 deg
    "quadrotor": Vehicle(0.3, (5.0, 3.0), 1.0, (6.0, 20.0), sway=0.1, circle=0.2, sideways=1.0),
    "table": Vehicle(0.0, (0.0, 0.0), 0.0, sway=0.0),
}


START = 12.0  # s, that a parked vehicle takes to its speed


def motion(
    kind: str, rng: np.random.Generator, t: np.ndarray, rest: tuple[float, float] = (0.0, 0.0)
) -> tuple[np.ndarray, np.ndarray]:
    """Return velocity NED (N, 3) m/s and roll, pitch, heading (N, 3) rad of a random course; at ``rest`` between, s."""
    own = VEHICLES[kind]
    wave = lambda low, high, n=3: sum(
        np.sin(2 * np.pi * t / rng.uniform(low, high) + rng.uniform(0, 6.3)) / n for _ in range(n)
    )
    first, rate = rng.uniform(0, 2 * np.pi), own.turn * wave(8, 25) + own.circle
    if own.straight:
        when = wave(30, 80)
        rate = rate * np.clip(10 * (when - np.quantile(when, own.straight)), 0.0, 1.0)
    go = np.ones_like(t)
    if rest[1] > rest[0]:
        ease = lambda x: np.clip(x, 0, 1) ** 2 * (3 - 2 * np.clip(x, 0, 1))
        go = ease((t - rest[1]) / START) + (ease((rest[0] - t) / START) if rest[0] > 0 else 0.0)
    rate = rate * go
    heading = first + np.cumsum(rate) / RATE
    speed = own.speed[0] + own.speed[1] * wave(*own.periods) + own.steps * np.sin(2 * np.pi * 1.9 * t)
    climb = own.climb * wave(10, 30) * go
    speed = speed * go
    rate = np.gradient(heading, t)
    roll = np.arctan(speed * rate / 9.8) if own.banked else own.sway * wave(3, 12) * go
    pitch = np.arcsin(np.clip(climb / np.maximum(speed, 5.0), -0.5, 0.5)) + own.sway * wave(3, 12) * go
    crab = own.crab * wave(10, 30) if own.crab else own.sideways * (heading - first)
    drift = own.current * rng.normal(size=2) if own.current else np.zeros(2)
    vel = np.stack([speed * np.cos(heading + crab) + drift[0], speed * np.sin(heading + crab) + drift[1], -climb], 1)
    return vel, np.stack([roll, pitch, heading], 1)


def simulated(
    kind: str,
    grade: str,
    with_velocity: bool,
    rng: np.random.Generator,
    sd: float | None = None,
    span: float = SPAN,
    fix_hz: float = 5.0,
    late: float | None = None,
    rest: tuple[float, float] = (0.0, 0.0),
) -> tuple[Recording, float]:
    """Return a recording of ``span`` s with truth, and the latency of its fixes (s).

    Args:
        kind: a row of `VEHICLES`.
        grade: "consumer" or "tactical", or another of the library's.
        with_velocity: fixes have a velocity of sd 0.1 m/s.
        rng: of course, biases and noise.
        sd: of the positions, m; None is 1.5 with velocities and 0.03 without.
        span: s.
        fix_hz: rate of the fixes.
        late: latency of the fixes, s; None draws one up to 0.3.
        rest: begin and end of a standstill, s.
    """
    from pyins import sim

    t = np.arange(round(span * RATE) + 1) / RATE
    vel, rph = motion(kind, rng, t, rest)
    lla0 = (rng.uniform(-60, 60), rng.uniform(-180, 180), 300.0)
    frame, imu = sim.generate_imu(t, lla0, np.degrees(rph), vel, sensor_type="increment")
    dt, g = np.full(t.size - 1, 1 / RATE), GRADES[grade]
    skew = 3e-3 if grade == "consumer" else 2e-4  # scale errors and misalignment, sd
    skewed = lambda a: a @ (np.eye(3) + skew * rng.normal(size=(3, 3)))
    noise = lambda root, turn_on: root * np.sqrt(RATE) * rng.normal(size=(dt.size, 3)) + turn_on * rng.normal(size=3)
    gyro = skewed(imu.iloc[1:, :3].to_numpy() * RATE) + noise(g.arw, g.gyro_turn_on)
    accel = skewed(imu.iloc[1:, 3:].to_numpy() * RATE) + noise(g.vrw, g.accel_turn_on)
    lla = np.column_stack([np.radians(frame.lat), np.radians(frame.lon), frame.alt])
    enu = np.column_stack([frame.VE, frame.VN, -frame.VD])
    truth = Track(t, lla, enu, np.radians(frame[["roll", "pitch", "heading"]].to_numpy()))
    draw_state, sd = rng.uniform(0, 0.3), sd or (1.5 if with_velocity else 0.03)
    late = draw_state if late is None else late
    k = np.arange(0.5, span, 1 / fix_hz)
    at = lambda a: np.column_stack([np.interp(k - late, t, c) for c in a.T])
    metres = np.array([6.37e6, 6.37e6 * np.cos(lla[0, 0]), 1.0])
    err = sd * rng.normal(size=(k.size, 3))
    position = Samples(k, at(lla) + err[:, [1, 0, 2]] / metres, np.full((k.size, 3), sd), np.zeros((k.size, 3)))
    aiding = {"position": position}
    if with_velocity:
        noisy = at(enu) + 0.1 * rng.normal(size=(k.size, 3))
        aiding["velocity"] = Samples(k, noisy, np.full((k.size, 3), 0.1), np.zeros((k.size, 3)))
    return Recording(f"{kind}, {grade}", ImuLog(t[1:], dt, gyro, accel), aiding, truth, np.zeros(3)), late
