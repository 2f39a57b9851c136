"""Tuned noise in the words of other software comes back to the numbers that it was."""

import re

import numpy as np
import pytest

from jaxnav.app.config import read_params
from jaxnav.filters.parameters import datasheet_params, get
from jaxnav.maths import units
from jaxnav.measurements import MEASUREMENTS
from jaxnav.states.grades import GRADES
from jaxnav.types import ConfigError, Fix
from tests.conftest import told
from tuning.recordings.export import (
    EKF2_STEP,
    EKF3_STEP,
    ONE_CORRELATION_TIME,
    StatedSd,
    ardupilot_parm,
    kfgins_yaml,
    navego_fields,
    px4_params,
    robot_localization_yaml,
    sd_by_stream,
    stated_sd,
)
from tuning.recordings.targets import TARGETS, read_settings, write_exports

GRADE = GRADES["adis16465"]

FILES = [target.settings for target in TARGETS.values()]


def noise(gyro, accel, gyro_bias, accel_bias, **others):
    """Parameters of these densities, biases that walk."""
    both = {"gyro_tau": np.inf, "accel_tau": np.inf} | others
    return told(datasheet_params(GRADE), gyro=gyro, accel=accel, gyro_bias=gyro_bias, accel_bias=accel_bias, **both)


def test_a_filter_of_positions_alone_is_written_with_the_defaults_of_a_velocity(tmp_path):
    both = noise(1e-4, 1e-3, 1e-6, 1e-5)
    write_exports(tmp_path, "", both, StatedSd())
    first = [(tmp_path / name).read_text() for name in FILES]
    write_exports(tmp_path, "", both._replace(measurements={"position": both.measurements["position"]}), StatedSd())
    assert [(tmp_path / name).read_text() for name in FILES] == first


def fields(text: str) -> dict[str, np.ndarray]:
    """Numbers by name of every line that has some."""
    lines = [re.split(r"[:=]", line.partition("#")[0], maxsplit=1) for line in text.splitlines()]
    numbers = {line[0].strip(): re.findall(r"Inf|[-+\d.]+(?:e[-+]?\d+)?", line[1].split("[")[-1]) for line in lines}
    return {name: np.array([float(v) for v in values]) for name, values in numbers.items() if values}


def test_kfgins_block_has_the_tuned_datasheet_of_the_grade():
    """The grade's own figures are 0.1 deg/sqrt(h), 0.1 m/s/sqrt(h), 25 deg/h, 200 mGal, 1 h."""
    drive = np.sqrt(2 / GRADE.tau)
    made = noise(GRADE.arw, np.full(3, GRADE.vrw), GRADE.gyro_instability * drive, GRADE.accel_instability * drive,
                 gyro_tau=3600.0)  # fmt: skip
    got = fields(kfgins_yaml(made, (300.0, 200.0)))
    expected = {"arw": 0.1, "vrw": 0.1, "gbstd": 25.0, "abstd": 200.0, "gsstd": 300.0, "asstd": 200.0, "corrtime": 1.0}
    assert list(got) == list(expected)
    for name, value in expected.items():
        np.testing.assert_allclose(got[name], value, rtol=1e-5)


def test_a_random_walk_keeps_its_drive():
    got = fields(kfgins_yaml(noise(1e-4, 1e-3, 2e-7, 3e-6)))
    T = float(got["corrtime"][0]) * units.HOUR
    np.testing.assert_allclose(got["gbstd"] * units.DEG_PER_HOUR * np.sqrt(2 / T), 2e-7, rtol=1e-5)
    np.testing.assert_allclose(got["abstd"] * units.MGAL * np.sqrt(2 / T), 3e-6, rtol=1e-5)


def test_navego_fields_are_si_and_north_east_down():
    made = noise([1e-4, 2e-4, 3e-4], 1e-3, 2e-7, 3e-6, gyro_tau=200.0, position_scale=[1.0, 2.0, 3.0])
    text = navego_fields(made)
    got = fields(text)
    np.testing.assert_allclose(got["imu.arw"], [1e-4, 2e-4, 3e-4])
    np.testing.assert_allclose(got["imu.gb_psd"], 2e-7)
    np.testing.assert_allclose(got["imu.gb_dyn"], 2e-6)  # q sqrt(T / 2)
    assert np.isinf(got["imu.ab_corr"]).all() and got["imu.ab_dyn"][0] == pytest.approx(3e-6)
    np.testing.assert_allclose(got["gnss.stdm"], [2.0, 1.0, 3.0])


def test_correlated_noise_is_told_by_axis_and_a_comment_says_so():
    L = np.array([[3.0, 0, 0], [4.0, 3.0, 0], [0, 0, 2.0]])
    made = noise(1e-4 * L, 1e-3, 2e-7, 3e-6, position_scale=L)
    for text, mark in ((kfgins_yaml(made), "#"), (navego_fields(made), "%")):
        first, _, rest = text.partition("\n")
        names = "gyro, position_scale" if mark == "%" else "gyro"
        assert first == f"{mark} correlations between the axes are left out of {names}"
        sd = fields(rest)["arw" if mark == "#" else "imu.arw"] * (units.DEG_PER_SQRT_HOUR if mark == "#" else 1.0)
        np.testing.assert_allclose(sd, [3e-4, 5e-4, 2e-4], rtol=1e-5)
    np.testing.assert_allclose(fields(rest)["gnss.stdm"], [5.0, 3.0, 2.0])
    assert "correlations" not in kfgins_yaml(noise(np.diag([1e-4, 2e-4, 3e-4]), 1e-3, 2e-7, 3e-6))


def settings(text: str) -> dict[str, float]:
    """Numbers by key of an autopilot's file."""
    lines = [line.partition("#")[0].replace("param set", "").replace(",", " ").split() for line in text.splitlines()]
    return {line[0]: float(line[1]) for line in lines if len(line) == 2}


@pytest.mark.parametrize("made, step, keys", [
    (px4_params, EKF2_STEP, ("EKF2_GYR_NOISE", "EKF2_ACC_NOISE", "EKF2_GYR_B_NOISE", "EKF2_ACC_B_NOISE")),
    (ardupilot_parm, EKF3_STEP, ("EK3_GYRO_P_NSE", "EK3_ACC_P_NSE", "EK3_GBIAS_P_NSE", "EK3_ABIAS_P_NSE")),
])  # fmt: skip
def test_an_autopilots_steps_add_up_to_the_density(made, step, keys):
    """N predictions of variance (s dt)^2 give what white noise of root PSD q does in N dt."""
    densities = (3e-4, 2e-3, 1e-5, 4e-4)
    found, T = settings(made(noise(*densities))), 60.0
    for key, q in zip(keys, densities, strict=True):
        assert T / step * (found[key] * step) ** 2 == pytest.approx(q**2 * T, rel=1e-5)


def test_delays_floors_and_what_has_no_counterpart():
    params = noise(1e-4, 1e-3, 1e-6, 1e-5, time_offset=0.02, position_latency=0.1, velocity_latency=0.2,
                   clock_drift=3e-4, position_scale=2.0, lever_arm=[0.5, -0.1, -1.2])  # fmt: skip
    px4, ardu = (settings(made(params, StatedSd(1.5))) for made in (px4_params, ardupilot_parm))
    assert px4["EKF2_GPS_DELAY"] == ardu["GPS_DELAY_MS"] == pytest.approx(170.0)  # the mean of 120 and 220 ms
    assert px4["EKF2_GPS_P_NOISE"] == ardu["EK3_POSNE_M_NSE"] == pytest.approx(3.0)
    assert [px4[f"EKF2_GPS_POS_{a}"] for a in "XYZ"] == [0.5, -0.1, -1.2]
    for text in (px4_params(params), ardupilot_parm(params)):
        assert "no counterpart: velocity is +0.100 s later than position, a clock drift of 300 ppm" in text
    assert "everything has a counterpart" in px4_params(noise(1e-4, 1e-3, 1e-6, 1e-5))


def test_stated_sd_are_medians_of_the_recordings():
    sd = np.tile([0.02, 0.03, 0.05, 0.4, 0.1, 0.2, 0.2], (5, 1))
    valid = np.ones((5, 7), bool)
    sd[0], valid[0] = 1e3, False  # no fix
    fix = Fix(np.zeros((5, 7)), sd, np.zeros((5, 7)), valid)
    names = ("position", "barometer", "velocity")
    by = sd_by_stream(fix, tuple(MEASUREMENTS[name] for name in names))
    assert {name: a.shape for name, a in by.items()} == {"position": (4, 3), "barometer": (4, 1), "velocity": (4, 3)}
    assert stated_sd(by) == StatedSd(0.03, 0.2) and stated_sd({"position": by["position"]}) == StatedSd(0.03)
    assert settings(px4_params(noise(1e-4, 1e-3, 1e-6, 1e-5, position_scale=2.0), StatedSd(0.03)))[
        "EKF2_GPS_P_NOISE"
    ] == pytest.approx(0.06)


def test_robot_localization_gets_the_variance_of_a_sample(tmp_path):
    text = robot_localization_yaml(noise(1e-4, 1e-3, 0.0, 0.0), imu_rate_hz=50.0)
    assert "angular_velocity_covariance_diagonal: [5e-07, 5e-07, 5e-07]" in text
    assert "linear_acceleration_covariance_diagonal: [5e-05, 5e-05, 5e-05]" in text
    write_exports(tmp_path, "a head", noise(1e-4, 1e-3, 1e-6, 1e-5), StatedSd())
    assert {p.name for p in tmp_path.iterdir()} == set(FILES)
    assert all(p.read_text()[2:8] == "a head" for p in tmp_path.iterdir())


@pytest.mark.parametrize("target", TARGETS.values(), ids=TARGETS)
def test_noise_that_is_written_is_read_back(target, tmp_path):
    """Each target's file, by its suffix and its words; where a filter has one number for three axes, the largest."""
    made = noise([1e-4, 2e-4, 3e-4], 1e-3, 2e-7, 3e-6)
    made = target.shaped(made)
    target.write_export(tmp_path, "a head", made, StatedSd())
    found = read_settings(tmp_path / target.settings)
    assert {"noise.gyro", "noise.accel"} <= set(found)
    for leaf, value in found.items():
        expected = np.asarray(get(made, leaf))
        if leaf.endswith("tau") and target.name == "kfgins":
            expected = ONE_CORRELATION_TIME
        expected = expected if np.size(value) > 1 else np.max(expected)
        np.testing.assert_allclose(value, np.broadcast_to(expected, np.shape(value)), rtol=2e-5, err_msg=leaf)


def test_settings_of_another_filter_are_parameters(tmp_path):
    made = noise(1e-4, 1e-3, 2e-7, 3e-6)
    (tmp_path / "mine.params").write_text(px4_params(made, StatedSd()))
    layer = read_params(tmp_path / "mine.params")
    assert layer["noise"]["gyro_deg_per_sqrt_hour"] == pytest.approx(1e-4 / units.DEG_PER_SQRT_HOUR, rel=1e-5)
    assert layer["states"]["accel_bias"]["tau_s"] == np.inf
    rows = [f"1\t1\t{key}\t{value:.9g}\t9" for key, value in settings(px4_params(made, StatedSd())).items()]
    (tmp_path / "table.params").write_text(
        "\n".join(["# MAV ID  COMPONENT ID  PARAM NAME  VALUE", *rows, "1\t1\tSYS_V\t1.2.3\t6"])
    )
    assert read_params(tmp_path / "table.params")["noise"] == pytest.approx(layer["noise"], rel=1e-6)
    plain = "\n".join(f"{key} {value:.9g}" for key, value in settings(ardupilot_parm(made, StatedSd())).items())
    (tmp_path / "plain.parm").write_text(plain)
    assert read_params(tmp_path / "plain.parm")["noise"] == pytest.approx(layer["noise"], rel=1e-5)
    (tmp_path / "other.params").write_text("param set EKF2_EN 1\n")
    with pytest.raises(ConfigError, match="no settings of another filter that are read: files like tuned_kf"):
        read_params(tmp_path / "other.params")
