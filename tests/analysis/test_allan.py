"""Allan deviation against closed forms, and simulated IMUs' noise figures read off it."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.analysis.allan import (
    Allan,
    GaussMarkov,
    Line,
    ReadOff,
    allan_deviation,
    at_least_rounding,
    gauss_markov_variance,
    read_off,
    regular,
)
from jaxnav.app import cli, config
from jaxnav.app.jobs.allan import grade
from jaxnav.io import write_recording
from jaxnav.maths.units import DEG_PER_HOUR, DEG_PER_SQRT_HOUR, G0, UG
from jaxnav.reading.read import read
from jaxnav.simulate.imu import corrupt
from jaxnav.states.grades import Grade
from jaxnav.types import DataError, Imu, ImuLog, Recording, Samples


def simulated(grade: Grade, n: int, dt: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Gyro and accelerometer (n, 3) of an IMU that rests level."""
    force = jnp.tile(jnp.array([0.0, 0.0, -G0]), (n, 1))
    still = Imu(jnp.full(n, dt), jnp.zeros((n, 3)), force)
    out, _ = jax.jit(lambda key: corrupt(key, still, dt, grade))(jax.random.key(seed))
    return np.asarray(out.gyro), np.asarray(out.accel)


def pooled(curve: Allan) -> Allan:
    """Axes that are alike as one: the mean of their variances."""
    axes = curve.deviation.shape[1]
    return Allan(curve.tau, np.sqrt(np.mean(curve.deviation**2, axis=1, keepdims=True)), axes * curve.edf)


# ---------------------------------------------------------------------------- the curve


def test_against_the_definition():
    """Half the mean squared difference of neighbouring cluster means, over every overlapping pair."""
    x = np.random.default_rng(0).normal(size=(200, 2)) + 5.0
    curve = allan_deviation(x, 0.5)
    for m in (1, 3, 10):
        means = np.stack([x[i : i + m].mean(0) for i in range(200 - m + 1)])
        expected = np.sqrt(0.5 * np.mean((means[m:] - means[:-m]) ** 2, axis=0))
        i = int(np.argmin(np.abs(curve.tau - 0.5 * m)))
        assert curve.tau[i] == 0.5 * m
        np.testing.assert_allclose(curve.deviation[i], expected, rtol=1e-10)


def test_ramp_and_constant():
    """A ramp of rate r has deviation r tau / sqrt(2), a constant none, however large."""
    t = 0.1 * np.arange(1000)
    curve = allan_deviation(np.stack([0.3 * t, np.full(1000, 1e3)], 1), 0.1)
    np.testing.assert_allclose(curve.deviation[:, 0], 0.3 * curve.tau / np.sqrt(2), rtol=1e-9)
    assert np.abs(curve.deviation[:, 1]).max() < 1e-9


def processes(n: int, axes: int, dt: float, rng: np.random.Generator):
    """White noise, random walk and Gauss-Markov noise (n, axes) with their Allan variances."""
    N, K, sd, time = 0.7, 0.2, 0.5, 2.0
    white = N / np.sqrt(dt) * rng.normal(size=(n, axes))
    walk = K * np.sqrt(dt) * np.cumsum(rng.normal(size=(n, axes)), axis=0)
    decay = np.exp(-dt / time)
    drive = rng.normal(size=(n, axes))
    gm = np.empty_like(drive)
    gm[0] = drive[0]
    for i in range(1, n):
        gm[i] = decay * gm[i - 1] + np.sqrt(1 - decay**2) * drive[i]
    # a walk that is held over a sample has K^2 (tau / 3 + dt^2 / (6 tau)); Gauss-Markov noise likewise at first
    yield white, lambda tau: N**2 / tau
    yield walk, lambda tau: K**2 * (tau / 3 + dt**2 / (6 * tau))
    yield sd * gm, lambda tau: gauss_markov_variance(tau, sd, time) + 2 * sd**2 / time * dt**2 / (6 * tau)


def test_closed_forms_within_their_confidence():
    """Relative errors of the variance have the sd that the degrees of freedom promise, or less: edf is cautious."""
    for data, variance in processes(4000, 60, 0.05, np.random.default_rng(1)):
        curve = allan_deviation(data, 0.05)
        z = (curve.deviation**2 / variance(curve.tau)[:, None] - 1) / np.sqrt(2 / curve.edf)[:, None]
        assert np.abs(z.mean(1)).max() < 5 / np.sqrt(60)
        late = curve.tau > 0.3
        assert 0.4 < np.sqrt(np.mean(z[late] ** 2)) < 1.3


def test_gauss_markov_variance_limits():
    assert gauss_markov_variance(1e-4, 2.0, 5.0) == pytest.approx(2 * 4 * 1e-4 / (3 * 5), rel=1e-4)
    assert gauss_markov_variance(1e6, 2.0, 5.0) == pytest.approx(2 * 4 * 5 / 1e6, rel=1e-4)
    x = np.linspace(0.5, 5.0, 4501)
    assert x[np.argmax(gauss_markov_variance(x, 1.0, 1.0))] == pytest.approx(1.89, abs=0.01)
    around = gauss_markov_variance(np.array([1e-3 * (1 - 1e-9), 1e-3 * (1 + 1e-9)]), 1.0, 1.0)
    assert around[0] == pytest.approx(around[1], rel=1e-5)  # series and closed form meet


@pytest.mark.parametrize("x, dt", [(np.ones(5), 1.0), (np.ones(50), 0.0), (np.r_[np.ones(50), np.nan], 1.0)])
def test_bad_samples_are_refused(x, dt):
    with pytest.raises(ValueError, match="x must"):
        allan_deviation(x, dt)


# ---------------------------------------------------------------------------- what is read off

MEMS = Grade(0.2 * DEG_PER_SQRT_HOUR, 60 * UG, 0.1, 0.1, 20 * DEG_PER_HOUR, 100 * UG, 5.0, "made up: a quick bias")


def check(found, arw, sd, tau, tolerance, hump_tolerance):
    assert found.N.value == pytest.approx(arw, rel=tolerance)
    assert found.gauss_markov.sd == pytest.approx(sd, rel=hump_tolerance)
    assert found.gauss_markov.tau == pytest.approx(tau, rel=hump_tolerance)


def test_simulated_imu_is_recovered():
    """ARW, VRW and both Gauss-Markov biases from 100 minutes at 10 Hz, three axes as one."""
    gyro, accel = simulated(MEMS, 60_000, 0.1, 0)
    for data, white, sd in ((gyro, MEMS.arw, MEMS.gyro_instability), (accel, MEMS.vrw, MEMS.accel_instability)):
        check(read_off(pooled(allan_deviation(data, 0.1))), white, sd, MEMS.tau, 0.03, 0.12)


@pytest.mark.slow
def test_simulated_imu_is_recovered_within_5_percent():
    """The same from two hours at 100 Hz, four IMUs as one; the white noise also from every axis alone."""
    runs = [simulated(MEMS, 720_000, 0.01, seed) for seed in range(4)]
    for i, white, sd in ((0, MEMS.arw, MEMS.gyro_instability), (1, MEMS.vrw, MEMS.accel_instability)):
        curve = allan_deviation(np.concatenate([run[i] for run in runs], axis=1), 0.01)
        check(read_off(pooled(curve)), white, sd, MEMS.tau, 0.05, 0.05)
        for axis in range(12):
            assert read_off(curve, axis).N.value == pytest.approx(white, rel=0.05)


def test_white_noise_and_walk_by_their_slopes():
    """N and K, and the bottom between them: a curve of known processes, without any scatter."""
    tau = np.geomspace(0.01, 3000, 110)
    N, K = 0.3, 0.01
    curve = Allan(tau, np.sqrt(N**2 / tau + K**2 * tau / 3)[:, None], 1e5 / tau)
    found = read_off(curve)
    assert found.N.value == pytest.approx(N, rel=0.01) and found.K.value == pytest.approx(K, rel=0.03)
    assert found.B.value == pytest.approx(np.sqrt(2 * N * K / np.sqrt(3)) / 0.6643, rel=0.02)
    assert found.N.stop < found.B.start < found.B.stop < found.K.start and found.gauss_markov is None


def test_flicker_floor():
    """A flat floor under white noise is B; nothing rises, nothing falls again."""
    tau = np.geomspace(0.01, 1000, 110)
    found = read_off(Allan(tau, np.sqrt(0.1**2 / tau + 0.6643**2 * 0.05**2)[:, None], 1e5 / tau))
    assert found.B.value == pytest.approx(0.05, rel=0.05) and found.K is None and found.gauss_markov is None


def test_slope_behind_a_hump_is_no_white_noise():
    """Gauss-Markov noise alone falls with -1/2 far behind its hump; it would be read as N = sd sqrt(2 time)."""
    tau = np.geomspace(0.1, 1000, 80)
    found = read_off(Allan(tau, np.sqrt(gauss_markov_variance(tau, 0.5, 2.0))[:, None], 1e5 / tau))
    assert found.N is None
    assert found.gauss_markov == pytest.approx((0.5, 2.0), rel=1e-3)


def test_record_that_ends_on_its_way_down_has_no_bottom():
    """It levels out at the last points only."""
    tau = np.geomspace(0.01, 100, 80)
    bend = 0.1 / np.sqrt(np.minimum(tau, 45.0)) * tau**-0.01
    assert read_off(Allan(tau, bend[:, None], 1e5 / tau)).B is None


def test_a_term_that_the_data_lack_is_none():
    """White noise alone has no bottom, no walk and no hump; an axis that puts out nothing has no figures."""
    curve = allan_deviation(np.random.default_rng(2).normal(size=(40_000, 3)), 0.1)
    for axis in range(3):
        found = read_off(curve, axis)
        assert found.N.value == pytest.approx(np.sqrt(0.1), rel=0.02)
        assert found[1:] == (None, None, None)
    assert read_off(allan_deviation(np.zeros(1000), 0.1)) == (None, None, None, None)


# ---------------------------------------------------------------------------- recordings


def log(n=3000, dt=0.02, jitter=0.0, seed=0) -> ImuLog:
    rng = np.random.default_rng(seed)
    steps = dt * (1 + jitter * rng.uniform(-1, 1, n))
    gyro = 0.1 * DEG_PER_SQRT_HOUR / np.sqrt(steps[:, None]) * rng.normal(size=(n, 3))
    accel = 50 * UG / np.sqrt(steps[:, None]) * rng.normal(size=(n, 3)) - [0, 0, G0]
    return ImuLog(np.cumsum(steps), steps, gyro, accel)


def test_irregular_steps_keep_every_integral():
    imu = log(jitter=0.3)
    gyro, accel, dt = regular(imu)
    span = dt * len(gyro)
    inside = imu.t <= span
    assert abs((gyro * dt).sum(0) - (imu.gyro * imu.dt[:, None])[inside].sum(0)).max() < 1e-4
    found = read_off(allan_deviation(gyro, dt))
    assert found.N.value == pytest.approx(0.1 * DEG_PER_SQRT_HOUR, rel=0.1)
    with pytest.raises(DataError, match="gap of 2.0.* s at t = "):
        regular(imu._replace(t=imu.t + 2.0 * (imu.t > 30)))


@pytest.mark.parametrize("share, at_least", [(0.1, 1.0), (0.14, 1.0), (1.0, 0.95)])
def test_noise_below_the_resolution_is_not_taken_as_shown(share, at_least):
    """White noise of ``share`` steps about the middle between two readings' borders: eight times too small at 0.14."""
    step, dt = 1e-3, 0.01
    true = share * step * np.sqrt(dt)
    x = step * np.round(share * np.random.default_rng(3).normal(size=(60_000, 1)))
    curve = allan_deviation(x, dt)
    shown = read_off(curve)
    found = at_least_rounding(shown, curve.deviation[0, 0], step, dt)
    assert found.N.value >= at_least * true and found.N.value < 3 * true
    assert (found == shown) is (share == 1.0)


def test_an_axis_without_white_noise_in_its_curve_is_not_taken_for_coarse():
    """Vibration hides the slope of white noise: the reading moves over many steps, and its noise stays unknown."""
    step, dt = 1e-3, 0.01
    x = step * np.round(50 * np.sin(0.7 * np.arange(20_000)))[:, None]
    curve = allan_deviation(x, dt)
    shown = read_off(curve)._replace(N=None)
    assert at_least_rounding(shown, curve.deviation[0, 0], step, dt).N is None


@pytest.fixture
def recording(tmp_path):
    """A minute at rest, then two seconds in which somebody lifts the unit."""
    imu = log(3100)
    imu.gyro[3000:] += 0.5 * np.sin(np.arange(100) / 5)[:, None]
    fix = Samples(np.arange(1.0, 61.0), np.tile([0.8, 0.3, 100.0], (60, 1)), np.ones((60, 3)), np.zeros((60, 3)))
    write_recording(tmp_path / "rec", Recording("bench", imu, {"position": fix}, None, np.zeros(3)))
    return tmp_path / "rec"


def test_verb(recording, tmp_path, monkeypatch, capsys):
    """Table, JSON with the unit in every name, and a figure; the motion at the end is cut off by --stop."""
    monkeypatch.setenv("JAXNAV_CACHE_DIR", "")
    out = tmp_path / "out"
    assert cli.main(["allan", "--data", str(recording), "--stop", "60", "--out", str(out)]) == 0
    text = capsys.readouterr().out
    assert "N deg/√h" in text and "at rest" not in text
    found = json.loads((out / "metrics.json").read_text())
    assert found["gyro_x"]["N_deg_per_sqrt_hour"] == pytest.approx(0.1, rel=0.1)
    assert found["accel_z"]["N_ug_per_sqrt_hz"] == pytest.approx(50, rel=0.1)
    assert found["gyro_y"]["gauss_markov_tau_s"] is None and len(found["accel_curve"]["deviation"]) == 3
    assert (out / "allan.png").stat().st_size > 20_000
    # what tuning starts from: the figures of the axes, and how far from them it may look
    layer = config.read_params(out / "grade.toml")
    assert layer["noise"]["gyro_deg_per_sqrt_hour"] == pytest.approx([0.1] * 3, rel=0.1)
    assert layer["noise"]["accel_ug_per_sqrt_hz"] == pytest.approx([50] * 3, rel=0.1)
    assert 2.0 <= layer["tune"]["prior"]["noise.gyro"] < 2.3
    assert "states" not in layer  # no drift shows in a minute
    assert config.resolve([("", layer)]).noise.gyro_deg_per_sqrt_hour is not None

    args = ["allan", "--data", str(recording), "--set", "out.figures=none", "--out", str(out)]
    assert cli.main([*args, "--set", "filter.standing_gyro_sd_deg_per_s=0.1"]) == 0
    assert "longest rest is --start 0.0 --stop 60.0" in capsys.readouterr().out
    assert cli.main([*args, "--start", "100"]) == 3
    assert "samples between data.start and data.stop" in capsys.readouterr().err


def test_a_coarse_axis_is_named(recording, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("JAXNAV_CACHE_DIR", "")
    rec = read(recording)
    step = 10 * rec.imu.gyro[:3000, 1].std()
    rec.imu.gyro[:, 1] = step * np.round(rec.imu.gyro[:, 1] / step + 0.3)
    write_recording(tmp_path / "coarse", rec)
    out = tmp_path / "out"
    assert cli.main(["allan", "--data", str(tmp_path / "coarse"), "--stop", "60", "--out", str(out)]) == 0
    found = json.loads((out / "metrics.json").read_text())
    assert [(f["code"], f["subject"]) for f in found["findings"]] == [("imu.quantized", "gyro y")]
    assert "gyro y is read in steps" in capsys.readouterr().out
    N = step * np.sqrt(0.02 / 12) / DEG_PER_SQRT_HOUR
    assert found["gyro_y"]["N_deg_per_sqrt_hour"] == pytest.approx(N, rel=0.01)


def test_a_grade_drives_its_bias_by_what_the_curve_shows():
    """A walk's root PSD as it is; a Gauss-Markov process of sd s and time T: s sqrt(2 / T); a missing axis as usual."""
    curve = Allan(np.array([1.0, 1000.0]), np.ones((2, 3)), np.array([1e6, 8.0]))
    walk = ReadOff(Line(1e-4, 1.0, 10.0), None, Line(1e-6, 100.0, 1000.0), None)
    hump = ReadOff(Line(2e-4, 1.0, 10.0), None, None, GaussMarkov(1e-4, 200.0))
    blank = ReadOff(None, None, None, None)
    found = grade({"gyro": (curve, [walk, hump, blank]), "accel": (curve, [blank] * 3)})
    driven = np.array([1e-6, 1e-4 * np.sqrt(2 / 200.0)])
    values = np.array(found["states"]["gyro_bias"]["driving_noise_deg_per_hour_per_sqrt_s"]) * DEG_PER_HOUR
    np.testing.assert_allclose(values, [*driven, np.sqrt(driven.prod())], rtol=1e-4)
    assert list(found["states"]) == ["gyro_bias"] and not any(key.startswith("accel") for key in found["noise"])
    # 8 to 100 degrees of freedom far out are 7 to 25 %, beside a factor 2
    assert 2.0 <= found["tune"]["prior"]["states.gyro_bias.driving_noise"] < 2.1
