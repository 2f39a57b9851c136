"""Navigation at a time, as a live filter gives it: for ROS, for receivers of NMEA, as offsets from a place."""

from functools import reduce
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from jaxnav.maths import earth
from jaxnav.maths.units import DEG

FLIP = Rotation.from_quat([1.0, 0.0, 0.0, 0.0])  # FRD <-> FLU
DAY_S, UNKNOWN_QUALITY = 86400, 6  # s; "estimated", of a sentence GGA


class Odometry(NamedTuple):
    """Fields of nav_msgs/Odometry of ROS: pose of the body FLU in ENU, twist in FLU."""

    position: np.ndarray  # (3,) m, ENU of the origin
    orientation: np.ndarray  # (4,) quaternion x, y, z, w, FLU -> ENU
    pose_covariance: np.ndarray  # (36,) m^2 and rad^2, row by row: position and rotation about the axes of ENU
    linear: np.ndarray  # (3,) m/s, FLU
    angular: np.ndarray  # (3,) rad/s, FLU
    twist_covariance: np.ndarray  # (36,) (m/s)^2 and (rad/s)^2, row by row; of angular rates that of the gyros' biases


class Now(NamedTuple):
    """Navigation at a time; angles in rad, ENU and FRD as everywhere."""

    t: float  # s
    lla: np.ndarray  # (3,) lat rad, lon rad, height m
    vel: np.ndarray  # (3,) m/s, ENU
    rph: np.ndarray  # (3,) rad, roll, pitch, heading
    sd: np.ndarray  # (9,) position m, velocity m/s, attitude rad, each in E, N, U
    sd_relative: np.ndarray  # (3,) m, ENU, of position from second to second, without a receiver's slow error
    ok: bool  # False from the first time on at which the filter was not finite
    q: np.ndarray  # (4,) unit quaternion, scalar first, body FRD -> ENU
    rate: np.ndarray  # (3,) rad/s, of the body, FRD, without the gyros' biases
    rate_sd: np.ndarray  # (3,) rad/s, of these biases; 0 where the filter has none
    P: np.ndarray  # (9, 9) covariance of position m, velocity m/s, attitude rad, each in E, N, U

    def enu(self, origin: np.ndarray) -> np.ndarray:
        """Return the position (3,) m, ENU.

        Args:
            origin: (3,) rad, rad, m, a near place that it is counted from.
        """
        return earth.enu_path(self.lla[None], np.asarray(origin, float))[0]

    def odometry(self, origin: np.ndarray) -> Odometry:
        """Return the fields of nav_msgs/Odometry.

        Args:
            origin: (3,) rad, rad, m, of the frame of the pose, at most some 10 km away.
        """
        turn = Rotation.from_quat(np.roll(self.q, -1)) * FLIP  # FLU -> ENU
        C, v = turn.as_matrix(), self.vel
        pose = self.P[np.ix_([0, 1, 2, 6, 7, 8], [0, 1, 2, 6, 7, 8])]
        cross = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
        rows = np.hstack([C.T, C.T @ cross])  # d(C' v) = C' (dv + [v x] phi)
        twist = np.zeros((6, 6))
        twist[:3, :3] = rows @ self.P[3:, 3:] @ rows.T
        twist[3:, 3:] = np.diag(self.rate_sd**2)
        return Odometry(self.enu(origin), turn.as_quat(), pose.ravel(), C.T @ v, FLIP.apply(self.rate), twist.ravel())

    def gga(self, quality: int = UNKNOWN_QUALITY, separation: float = 0.0, time: float | None = None) -> str:
        """Return a sentence GGA of NMEA 0183, of an integrated navigator (talker IN), without its line end.

        Satellites and HDOP are not known, and stay empty.

        Args:
            quality: of the fix, 1 autonomous, 2 differential, 4 and 5 RTK, 6 estimated.
            separation: m, of the geoid above the ellipsoid; with 0 the height is that above the ellipsoid.
            time: s of the day, UTC; None is ``t`` taken for UTC.
        """
        cs = round(100 * ((self.t if time is None else time) % DAY_S)) % (100 * DAY_S)
        clock = f"{cs // 360000:02d}{cs // 6000 % 60:02d}{cs // 100 % 60:02d}.{cs % 100:02d}"
        lat, lon = (_minutes(a, width) for a, width in zip(self.lla[:2] / DEG, (2, 3), strict=True))
        north, east = "NS"[int(self.lla[0] < 0)], "EW"[int((self.lla[1] + np.pi) % (2 * np.pi) < np.pi)]
        body = (
            f"INGGA,{clock},{lat},{north},{lon},{east},{quality},,,{self.lla[2] - separation:.3f},M,"
            f"{separation:.3f},M,,"
        )
        return f"${body}*{reduce(lambda a, b: a ^ b, body.encode()):02X}"


def _minutes(angle: float, width: int) -> str:
    """Return degrees as ddmm.mmmmmmm, longitudes within half a turn."""
    total = round(abs((angle + 180.0) % 360.0 - 180.0) * 60e7)
    degrees, minutes = divmod(total, 60 * 10**7)
    return f"{degrees:0{width}d}{minutes / 1e7:010.7f}"
