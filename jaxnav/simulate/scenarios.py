"""SCENARIOS: simulated cases by name; frozen, hashable and printable. Units are in the names of the fields.

A scenario holds groups: how the vehicle moves, its IMU, its receiver, the receiver's faults, and the start that a
filter is given. No two of its fields have the same name, so that one can be set by its name alone.
"""

import math
from typing import Any, NamedTuple

from jaxnav.maths.units import DEG_PER_HOUR, MG
from jaxnav.simulate.faults import Burst, Constant, Fault, GaussMarkov, Ramp, White
from jaxnav.simulate.gnss import Receiver
from jaxnav.simulate.imu import ImuErrors
from jaxnav.simulate.sky import Sky
from jaxnav.simulate.trajectories import Circle, LaunchMove, Urban
from jaxnav.types import Json


class InitialErrors(NamedTuple):
    """Initial values of a filter: the truth plus errors of these sizes, biases zero; or an alignment at rest."""

    prior_position_sd_m: tuple[float, float, float] = (2.0, 2.0, 4.0)  # ENU
    prior_velocity_sd_mps: tuple[float, float, float] = (0.1, 0.1, 0.1)  # ENU
    prior_tilt_sd_deg: float = 0.5
    prior_heading_sd_deg: float = 3.0
    fixed_errors: bool = False  # the errors are `PATTERN` times these sizes in every run, not drawn
    # s at rest before the run: roll and pitch then come from the mean specific force, accelerometer bias and all, and
    # the tilt's sd above is their expected error
    alignment_s: float = 0.0
    calibrate_gyro: bool = False  # the gyro's mean over the alignment, less the Earth's rate, is the start's bias


PATTERN = (1.0, -1.0, 0.5)  # E, N, U


class Scenario(NamedTuple):
    """One simulated case; everything static, random values come from the key of `simulation.simulate`."""

    name: str = "urban"
    duration_s: float = 300.0  # alignment included
    imu_rate_hz: float = 50.0  # a multiple of the GNSS rate
    gnss_rate_hz: float = 1.0
    start_deg_m: tuple[float, float, float] = (48.2, 16.37, 180.0)  # latitude, longitude, height
    motion: Any = Urban()  # one of `jaxnav.simulate.trajectories.MOTIONS`
    imu: ImuErrors = ImuErrors()
    gnss: Receiver = Receiver()
    faults: tuple[Fault, ...] = ()
    start: InitialErrors = InitialErrors()
    # other sensors of one run (`jaxnav.simulate.readings.with_equipment`): names of measurements and the sd of
    # their noise in SI, read at every fix's time and in outages; names of further states, drawn from their priors
    sensors: tuple[tuple[str, float], ...] = ()
    sensor_states: tuple[str, ...] = ()
    sky: Sky | None = None  # satellites of one run, for tight coupling; measured at every epoch, in outages too


# ---------------------------------------------------------------------------- drives in town

_ROOF = Receiver(lever_arm_m=(0.3, -0.2, -1.2))
URBAN = Scenario(gnss=_ROOF._replace(outages_s=((90.0, 100.0), (160.0, 175.0), (240.0, 260.0))))
URBAN_SHORT = Scenario(
    name="urban_short",
    duration_s=80.0,
    imu_rate_hz=25.0,
    motion=Urban(standstill_s=5.0),
    gnss=_ROOF._replace(outages_s=((50.0, 60.0),)),
)
TRAFFIC = URBAN._replace(name="urban_traffic", motion=Urban(traffic=0.6))
# a receiver that integrates its velocity, with an additional error of minutes
INTEGRATING = Scenario(
    name="urban_integrating",
    imu_rate_hz=20.0,
    motion=Urban(standstill_s=10.0),
    gnss=_ROOF._replace(
        position_sd_m=(0.3, 0.3, 0.3),
        velocity_sd_mps=(0.05, 0.05, 0.05),
        slow_position_sd_m=1.5,
        integrates_velocity=True,
    ),
)

# a street: houses of 30 deg on both sides, and by turns a few satellites or none
STREET = Scenario(
    name="street", duration_s=240.0, imu_rate_hz=50.0, gnss_rate_hz=2.0, motion=Urban(standstill_s=10.0),
    gnss=_ROOF._replace(position_sd_m=(4.0, 4.0, 8.0)),
    sky=Sky(house_deg=30.0, street_deg=30.0, few=tuple(
        (60.0 + 30.0 * i, 75.0 + 30.0 * i, k) for i, k in enumerate((5, 3, 1, 0, 2, 4))
    )),
)  # fmt: skip

# ---------------------------------------------------------------------------- Ansari et al. 2024: an hour on a circle

_FAULT = (600.0, 1100.0)
_SIZES = (50.0,) * 3, (0.5,) * 3  # Table 2, m and m/s; the paper says nothing of axes, signs or course in time
READINGS: dict[str, tuple[Fault, ...]] = {
    "no_fault": (),
    "constant": (Constant(*_FAULT, *_SIZES),),
    "velocity": (Constant(*_FAULT, velocity_mps=_SIZES[1]),),
    "white": (White(*_FAULT, *_SIZES),),
    "gauss_markov": (GaussMarkov(*_FAULT, *_SIZES, tau_s=60.0),),
    "ramp": (Ramp(*_FAULT, *_SIZES),),
}
"""Ways to read the GNSS fault of Ansari et al. 2024, section 5 and Table 2."""

CIRCLE = Scenario(
    name="gpid_circle",
    duration_s=3600.0,
    imu_rate_hz=10.0,
    start_deg_m=(30.0, 50.0, 1000.0),
    motion=Circle(10.0, 126.0),
    imu=ImuErrors("tactical", fixed_bias=True),
    gnss=Receiver(position_sd_m=(5.0, 5.0, 5.0), velocity_sd_mps=(0.1, 0.1, 0.1)),
    faults=READINGS["constant"],
    # result of levelling and gyrocompassing with these sensors
    start=InitialErrors((5.0, 5.0, 5.0), (0.1, 0.1, 0.1), prior_tilt_sd_deg=0.003, prior_heading_sd_deg=0.04),
)
# speed, turn rate and start of the configuration that comes nearest to the paper's tables
REPRO = CIRCLE._replace(
    name="gpid_repro",
    motion=Circle(33.5, 2 * math.pi / 0.0228),
    faults=READINGS["velocity"],
    start=CIRCLE.start._replace(prior_tilt_sd_deg=0.0, prior_heading_sd_deg=0.0),
)
_GPID = [
    base._replace(name=f"{base.name}_{reading}", faults=faults)
    for base in (CIRCLE, REPRO)
    for reading, faults in READINGS.items()
    if faults != base.faults
]

# ---------------------------------------------------------------------------- GIP-KF paper: outages of 10, 11 and 22 s

GIPKF = Scenario(
    name="gipkf_urban", duration_s=420.0, start_deg_m=(35.7, 51.4, 1200.0), imu_rate_hz=10.0,
    motion=Urban(standstill_s=45.0),  # 30 s of alignment and 15 s of the run
    imu=ImuErrors("adis16488a", gyro_scale_sd_ppm=2000.0, accel_scale_sd_ppm=1000.0),
    gnss=Receiver(
        position_sd_m=(3.0, 3.0, 5.0), velocity_sd_mps=(0.1, 0.1, 0.2),
        outages_s=((150.0, 160.0), (230.0, 241.0), (310.0, 332.0)), outage_shift_s=55.0,
    ),
    # 16 mg at rest tilt by 0.92 deg
    start=InitialErrors((3.0, 3.0, 5.0), (0.05, 0.05, 0.05), prior_tilt_sd_deg=0.92, prior_heading_sd_deg=2.0,
                alignment_s=30.0, calibrate_gyro=True),
)  # fmt: skip
_UNCALIBRATED = GIPKF._replace(name="gipkf_urban_uncalibrated", start=GIPKF.start._replace(calibrate_gyro=False))
_STRESS = GIPKF._replace(
    name="gipkf_urban_stress",
    imu=GIPKF.imu._replace(gyro_scale_sd_ppm=10000.0, accel_scale_sd_ppm=5000.0),
    gnss=GIPKF.gnss._replace(correlated_share=0.7, correlation_s=60.0, lever_arm_m=(1.5, 0.0, 0.0), latency_s=0.15),
)

# ---------------------------------------------------------------------------- FWEKF paper: alignment and launch

FWEKF = Scenario(
    name="fwekf",
    duration_s=40.0,
    imu_rate_hz=100.0,
    gnss_rate_hz=10.0,
    start_deg_m=(37.5, 127.0, 50.0),
    motion=LaunchMove(),
    imu=ImuErrors("fwekf"),
    gnss=Receiver(position_sd_m=(10.0, 10.0, 10.0), velocity_sd_mps=(0.2, 0.2, 0.2)),
    start=InitialErrors((10.0, 10.0, 10.0), (0.2, 0.2, 0.2), prior_tilt_sd_deg=1.0, prior_heading_sd_deg=1.0),
)
_SIDEWAYS = (30.0, 30.0, 0.0)  # m, E and N


def _biased(factor: float) -> ImuErrors:
    """With constant biases as large as the noise of a sample, times a factor."""
    gyro, accel = factor * 3e-4 / DEG_PER_HOUR, factor * 3e-3 / MG
    return FWEKF.imu._replace(gyro_bias_sd_deg_per_hour=gyro, accel_bias_sd_mg=accel)


_FWEKF = [
    FWEKF._replace(
        name="fwekf_noise_free",
        imu=FWEKF.imu._replace(imu_noise_factor=0.0),
        gnss=FWEKF.gnss._replace(gnss_noise_factor=0.0),
        start=FWEKF.start._replace(fixed_errors=True),
    ),
    FWEKF._replace(name="fwekf_jump", faults=(Constant(25.0, 28.0, _SIDEWAYS),)),
    FWEKF._replace(name="fwekf_step", faults=(Constant(30.0, math.inf, _SIDEWAYS),)),
    FWEKF._replace(name="fwekf_attitude", start=FWEKF.start._replace(prior_tilt_sd_deg=5.0, prior_heading_sd_deg=5.0)),
    FWEKF._replace(name="fwekf_bias", imu=_biased(1.0)),
    FWEKF._replace(name="fwekf_bias_10", imu=_biased(10.0)),
    FWEKF._replace(name="fwekf_burst", faults=(Burst(25.0, 32.0, 5.0),)),
]

SCENARIOS: dict[str, Scenario] = {
    s.name: s
    for s in (
        URBAN,
        URBAN_SHORT,
        TRAFFIC,
        INTEGRATING,
        STREET,
        CIRCLE,
        REPRO,
        *_GPID,
        GIPKF,
        _UNCALIBRATED,
        _STRESS,
        FWEKF,
        *_FWEKF,
    )
}


def describe(scenario: Scenario) -> str:
    """Return the scenario in lines of ``field = value``, a line for every field of a group."""
    lines: Json = {}
    for name, value in scenario._asdict().items():
        if hasattr(value, "_asdict"):
            kind = type(value).__name__
            lines |= {name: kind} | {f"{name}.{field}": inner for field, inner in value._asdict().items()}
        else:
            lines[name] = value
    width = max(map(len, lines))
    return "\n".join(f"{name:{width}} = {value}" for name, value in lines.items())
