"""SCENARIOS: what is simulated, by name; frozen, hashable and printable. Units are in the names of the fields."""

from typing import NamedTuple


class Scenario(NamedTuple):
    """One simulated case; everything static, what is random comes from the key of `jaxnav.simulation.simulate`."""

    name: str = "urban"
    duration_s: float = 300.0
    standstill_s: float = 20.0  # at the start
    imu_rate_hz: float = 50.0  # a multiple of the GNSS rate
    gnss_rate_hz: float = 1.0
    start_deg_m: tuple[float, float, float] = (48.2, 16.37, 180.0)  # latitude, longitude, height
    speed_max_mps: float = 20.0
    grade: str = "adis16465"  # of the IMU, in `jaxnav.sensors.grades.GRADES`
    gyro_scale_sd_ppm: float = 0.0
    accel_scale_sd_ppm: float = 0.0
    lever_arm_m: tuple[float, float, float] = (0.3, -0.2, -1.2)  # IMU -> antenna, body FRD
    position_sd_m: tuple[float, float, float] = (2.0, 2.0, 4.0)  # ENU
    velocity_sd_mps: tuple[float, float, float] = (0.1, 0.1, 0.15)  # ENU
    outages_s: tuple[tuple[float, float], ...] = ((90.0, 100.0), (160.0, 175.0), (240.0, 260.0))  # start < t <= end
    random_outages: int = 0  # this many more from the key, after the standstill
    random_outage_s: tuple[float, float] = (10.0, 20.0)  # shortest and longest
    prior_position_sd_m: tuple[float, float, float] = (2.0, 2.0, 4.0)  # ENU, of the start given to the filter
    prior_velocity_sd_mps: tuple[float, float, float] = (0.1, 0.1, 0.1)  # ENU
    prior_tilt_sd_deg: float = 0.5
    prior_heading_sd_deg: float = 3.0


SCENARIOS: dict[str, Scenario] = {
    s.name: s
    for s in (
        Scenario(),
        Scenario(name="urban_short", duration_s=80.0, standstill_s=5.0, imu_rate_hz=25.0, outages_s=((50.0, 60.0),)),
    )
}


def describe(scenario: Scenario) -> str:
    """The scenario in lines of ``field = value``."""
    width = max(map(len, scenario._fields))
    return "\n".join(f"{name:{width}} = {value}" for name, value in scenario._asdict().items())
