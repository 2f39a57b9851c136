"""Make the files of this folder: `python examples/make.py [FOLDER]`, two minutes of a simulated drive in town.

Its faults are those of real logs: the IMU is mounted forward, left, up, and stamped by the computer that logs it. Fixes
are stamped when they arrive, 0.13 s late, and their antenna is on the roof. Errors of positions last for minutes; in a
tunnel of 15 s there are none, and for 5 s reflections lead them 14 m astray.
"""

import sys
from datetime import UTC, datetime
from pathlib import Path

import jax
import numpy as np

import jaxnav
from jaxnav.maths.gps_time import GPS_EPOCH, WEEK, leap_seconds
from jaxnav.maths.units import DEG, G0
from jaxnav.simulate.faults import Constant
from jaxnav.simulate.gnss import Receiver
from jaxnav.simulate.imu import ImuErrors
from jaxnav.simulate.scenarios import Scenario
from jaxnav.simulate.simulation import simulate, to_recording
from jaxnav.simulate.trajectories import Urban
from jaxnav.types import Recording

SEED, BEGIN = 7, 1_748_779_200.0  # s since 1970, UTC: 2025-06-01, 12 o'clock
LATE, JITTER = 0.13, 0.004  # s, of the fixes in the table; their own messages have GPS time
ASTRAY = 55.0, 60.0  # s, of reflections
UNDULATION, SATELLITES = 44.0, 14  # m, of the geoid there; that the receiver uses
SCENARIO = Scenario(
    name="drive", duration_s=130.0, imu_rate_hz=50.0, gnss_rate_hz=5.0, motion=Urban(standstill_s=8.0),
    imu=ImuErrors("consumer", gyro_scale_sd_ppm=3000.0, accel_scale_sd_ppm=3000.0),
    gnss=Receiver(
        position_sd_m=(0.4, 0.4, 0.8), velocity_sd_mps=(0.1, 0.1, 0.1), slow_position_sd_m=0.8,
        slow_position_s=150.0, lever_arm_m=(0.3, -0.2, -1.2), outages_s=((85.0, 100.0),),
    ),
    faults=(Constant(*ASTRAY, (12.0, 8.0, 0.0)),),
)  # fmt: skip


def simulated() -> Recording:
    """Return the drive with its truth; times are seconds since its begin."""
    return to_recording(simulate(jax.random.key(SEED), SCENARIO), SCENARIO)


def write_csv(path: Path, header: str, columns: list[np.ndarray], formats: str) -> None:
    """Write a table, a format for each column."""
    np.savetxt(path, np.column_stack(columns), formats.split(), ",", header=header, comments="")


def write_tables(rec: Recording, folder: Path) -> None:
    """Write the IMU and the fixes as CSV files: units and axes as loggers have them."""
    imu = rec.imu
    flu = np.array([1.0, -1.0, -1.0])
    gyro, accel = imu.gyro * flu / DEG, imu.accel * flu / G0
    header = "time_s,gyro_x_dps,gyro_y_dps,gyro_z_dps,acc_x_g,acc_y_g,acc_z_g"
    write_csv(folder / "drive_imu.csv", header, [BEGIN + imu.t, *gyro.T, *accel.T], "%.3f " + "%.3f " * 3 + "%.4f " * 3)
    position, velocity = rec.aiding["position"], rec.aiding["velocity"]
    lat, lon, h = position.value.T
    east, north, up = velocity.value.T
    course = np.degrees(np.arctan2(east, north)) % 360
    header = "time_s,lat_deg,lon_deg,height_m,speed_mps,course_deg,climb_mps,acc_h_m,acc_v_m"
    sd = np.hypot(position.sd[:, [0, 2]], SCENARIO.gnss.slow_position_sd_m)
    late = LATE + JITTER * np.random.default_rng(SEED).normal(size=position.t.size)
    columns = [BEGIN + position.t + late, lat / DEG, lon / DEG, h, np.hypot(east, north), course, up, *sd.T]
    write_csv(folder / "drive_gnss.csv", header, columns, "%.3f %.7f %.7f %.2f %.2f %.1f %.2f %.2f %.2f")


def write_receiver(rec: Recording, folder: Path) -> None:
    """Write the fixes as a receiver's own messages: NAV-PVT of UBX; GGA, RMC and GST of NMEA."""
    import pynmeagps
    import pyubx2

    position, velocity = rec.aiding["position"], rec.aiding["velocity"]
    ubx, nmea = bytearray(), bytearray()
    for t, lla, sd, vel in zip(BEGIN + position.t, position.value, position.sd, velocity.value, strict=True):
        lat, lon, h = lla[0] / DEG, lla[1] / DEG, lla[2]
        level, up = np.hypot(sd[[0, 2]], SCENARIO.gnss.slow_position_sd_m)
        speed, course = float(np.hypot(*vel[:2])), float(np.degrees(np.arctan2(vel[0], vel[1])) % 360)
        utc = datetime.fromtimestamp(round(t, 3), UTC)
        tow = round(1000 * ((t + leap_seconds(t) - GPS_EPOCH) % WEEK))
        ubx += pyubx2.UBXMessage(
            "NAV", "NAV-PVT", pyubx2.GET, iTOW=tow, year=utc.year, month=utc.month, day=utc.day, hour=utc.hour,
            min=utc.minute, second=utc.second, validDate=1, validTime=1, fullyResolved=1, tAcc=20,
            nano=1000 * utc.microsecond, fixType=3, gnssFixOk=1, numSV=SATELLITES, lon=lon, lat=lat,
            height=round(1000 * h), hMSL=round(1000 * (h - UNDULATION)), hAcc=round(1000 * level),
            vAcc=round(1000 * up), velN=round(1000 * vel[1]), velE=round(1000 * vel[0]), velD=round(-1000 * vel[2]),
            gSpeed=round(1000 * speed), headMot=course, headAcc=2.0, pDOP=1.5,
            sAcc=round(1000 * SCENARIO.gnss.velocity_sd_mps[0]),
        ).serialize()  # fmt: skip
        about = {"time": utc.time(), "lat": lat, "NS": "N", "lon": lon, "EW": "E"}
        for name, fields in {
            "GGA": about | {"quality": 1, "numSV": SATELLITES, "HDOP": 0.8, "alt": round(h - UNDULATION, 2),
                            "altUnit": "M", "sep": UNDULATION, "sepUnit": "M"},
            "RMC": about | {"status": "A", "spd": round(speed * 3600 / 1852, 3), "cog": round(course, 2),
                            "date": utc.date(), "posMode": "A"},
            "GST": {"time": utc.time(), "stdLat": round(level, 2), "stdLong": round(level, 2), "stdAlt": round(up, 2)},
        }.items():  # fmt: skip
            nmea += pynmeagps.NMEAMessage("GN", name, pynmeagps.GET, hpnmeamode=1, **fields).serialize()
    (folder / "drive.ubx").write_bytes(ubx)
    (folder / "drive.nmea").write_bytes(nmea)


def main(folder: Path) -> None:
    """Write all files into a folder."""
    jaxnav.enable_x64()
    rec = simulated()
    write_tables(rec, folder)
    write_receiver(rec, folder)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent)
