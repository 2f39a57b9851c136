"""IMU grades by name, from their datasheets."""

from typing import NamedTuple

from jaxnav.maths import units


class Grade(NamedTuple):
    """An IMU in SI; root PSDs of white noise, sd and Gauss-Markov time of the biases."""

    arw: float  # rad/s/sqrt(Hz)
    vrw: float  # m/s^2/sqrt(Hz)
    gyro_turn_on: float  # rad/s, sd of the constant bias at switch-on
    accel_turn_on: float  # m/s^2
    gyro_instability: float  # rad/s, sd of the drifting part
    accel_instability: float  # m/s^2
    tau: float  # s, Gauss-Markov time of the drifting part
    source: str
    gyro_walk: float = 0.0  # rad/s/sqrt(s), root PSD of a random walk of the bias, from zero at switch-on
    accel_walk: float = 0.0  # m/s^2/sqrt(s)
    scale: float = 0.0  # sd of scale errors and misalignment, which a filter takes as noise


_d, _h = units.DEG_PER_SQRT_HOUR, units.DEG_PER_HOUR
GRADES: dict[str, Grade] = {
    "consumer": Grade(
        0.23 * _d, 70 * units.UG, 0.5 * units.DEG, 20 * units.MG, 20 * _h, 0.1 * units.MG, 1000.0,
        "rtklibexplorer/GNSS_IMU drive log: noise figures of its consumer MEMS; scale errors as MEMS have uncalibrated",
        scale=3000 * units.PPM,
    ),
    "adis16465": Grade(
        0.1 * _d, 0.1 * units.MPS_PER_SQRT_HOUR, 0.1 * units.DEG, 5 * units.MG, 25 * _h, 200 * units.MGAL, 3600.0,
        "tuned values of awesome-gins-datasets (i2Nav, Wuhan University)",
    ),
    "adis16488": Grade(
        0.3 * _d, 0.029 * units.MPS_PER_SQRT_HOUR, 0.2 * units.DEG, 16 * units.MG, 6.5 * _h, 0.1 * units.MG, 100.0,
        "NaveGo 1.4 synthetic data set, which follows the ADIS16488 datasheet",
    ),
    "adis16488a": Grade(
        0.26 * _d, 0.029 * units.MPS_PER_SQRT_HOUR, 0.2 * units.DEG, 16 * units.MG, 5.1 * _h, 0.07 * units.MG, 300.0,
        "ADIS16488A datasheet (Analog Devices): random walks, bias repeatability, in-run stability; its time assumed",
    ),
    "icm20602": Grade(
        0.2 * _d, 0.2 * units.MPS_PER_SQRT_HOUR, 1.0 * units.DEG, 25 * units.MG, 200 * _h, 1000 * units.MGAL, 3600.0,
        "tuned values of awesome-gins-datasets (i2Nav, Wuhan University); biases at switch-on assumed",
    ),
    "adis1640x_airframe": Grade(
        3.0 * _d, 0.03, 1.0 * units.DEG, 30 * units.MG, 0.02 * units.DEG, 5 * units.MG, 300.0,
        "ADIS1640x; white noise and drift widened for a small airframe that vibrates (UMN flight 75)",
    ),
    "tactical": Grade(
        0.001 * _d, 0.03 * units.MPS_PER_SQRT_HOUR, 0.01 * _h, 50 * units.UG, 0.0, 0.0, 3600.0,
        "Ansari et al. 2024, Table 1",
    ),
    "hg9900": Grade(
        0.002 * _d, 10 * units.UG, 0.0035 * _h, 25 * units.UG, 0.0, 0.0, 3600.0,
        "navigation grade: Honeywell HG9900 brochure N61-1638, which states no velocity random walk: 10 ug/sqrt(Hz)"
        " assumed",
    ),
    "fwekf": Grade(
        3e-5, 3e-4, 0.0, 0.0, 0.0, 0.0, 3600.0,
        "FWEKF paper, section 5: 3e-4 rad/s and 3e-3 m/s^2, read as the sd of a sample at 100 Hz",
    ),
}  # fmt: skip
