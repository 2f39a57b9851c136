"""Writers of a solution: degrees and north, east, down on this side of the border; whole files or nothing."""

import json
import os
from xml.sax.saxutils import escape

import numpy as np

from jaxnav.io.checks import ned_to_enu
from jaxnav.io.files import FilePath, atomic_write, format_csv
from jaxnav.io.formats.kfgins import write_kfgins_nav
from jaxnav.io.formats.rtklib import write_pos
from jaxnav.maths.axes import lla_to_local
from jaxnav.maths.gps_time import GPS_EPOCH
from jaxnav.maths.units import DEG
from jaxnav.types import DataError, Json, Samples, Track

FORMATS = ("csv", "kml", "pos", "nav", "geojson", "tum")

COLUMNS = "t_s lat_deg lon_deg h_m vn_mps ve_mps vd_mps roll_deg pitch_deg heading_deg".split()
SD_COLUMNS = "sd_n_m sd_e_m sd_d_m sd_vn_mps sd_ve_mps sd_vd_mps sd_tilt_n_deg sd_tilt_e_deg sd_heading_deg".split()


def write_solution(path: FilePath, track: Track, format: str, sd: np.ndarray | None = None) -> None:
    """Write a track as "csv", "kml", "geojson", "pos" (RTKLIB, which needs ``sd``), "nav" (KF-GINS) or "tum" (evo).

    ``sd`` (N, 9): position m, velocity m/s, attitude rad, each about or along E, N, U: the roots of the diagonal of P.
    """
    if format == "csv":
        write_csv(path, track, sd)
    elif format == "kml":
        write_kml(path, track)
    elif format == "geojson":
        write_geojson(path, track)
    elif format == "tum":
        write_tum(path, track)
    elif format == "nav":
        write_kfgins_nav(path, track)
    elif format == "pos":
        if sd is None:
            raise DataError(f"{os.fspath(path)}: a .pos solution needs standard deviations, got none")
        sd = _check_sd(path, track, sd)
        none = np.zeros_like(track.vel)
        streams = Samples(track.t, track.lla, sd[:, :3], none), Samples(track.t, track.vel, sd[:, 3:6], none)
        # no earlier time can be written in GPST: seconds that are no date count from its start
        write_pos(path, *streams, t0=0.0 if track.t[0] >= GPS_EPOCH else GPS_EPOCH)
    else:
        raise DataError(f"{os.fspath(path)}: format must be one of {', '.join(FORMATS)}, got {format!r}")


def write_csv(path: FilePath, track: Track, sd: np.ndarray | None = None) -> None:
    """Time, position, velocity, attitude, then their sd if given (as in `write_solution`), every float to the last bit.

    The attitude's sd are rotations about north, east and down. Unknown angles are written as nan.
    """
    blocks, names = [_in_degrees(track)], list(COLUMNS)
    if sd is not None:
        blocks.append(_sd_in_degrees(_check_sd(path, track, sd)))
        names += SD_COLUMNS
    atomic_write(path, format_csv(names, np.hstack(blocks)))


def row_of(t: float, lla: np.ndarray, vel: np.ndarray, rph: np.ndarray, sd: np.ndarray) -> list[float]:
    """One row of `write_csv`, with its sd."""
    track = Track(np.array([t]), lla[None], vel[None], rph[None])
    return [*_in_degrees(track)[0].tolist(), *_sd_in_degrees(sd[None])[0].tolist()]


def _in_degrees(track: Track) -> np.ndarray:
    lla = track.lla / np.array([DEG, DEG, 1.0])
    return np.hstack([track.t[:, None], lla, ned_to_enu(track.vel), track.rph / DEG])


def _sd_in_degrees(sd: np.ndarray) -> np.ndarray:
    return sd[:, [1, 0, 2, 4, 3, 5, 7, 6, 8]] / np.array([1.0] * 6 + [DEG] * 3)


def write_kml(path: FilePath, track: Track, fixes: Samples | None = None, name: str = "solution") -> None:
    """Write a KML line of the track, and if given the position fixes as points."""
    places = [f"<Placemark><name>{escape(name)}</name><LineString><altitudeMode>absolute</altitudeMode>"]
    places += ["<coordinates>", *_coordinates(track.lla), "</coordinates></LineString></Placemark>"]
    if fixes is not None:
        places.append("<Placemark><name>fixes</name><MultiGeometry>")
        places += [f"<Point><coordinates>{point}</coordinates></Point>" for point in _coordinates(fixes.value)]
        places.append("</MultiGeometry></Placemark>")
    head = '<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="http://www.opengis.net/kml/2.2"><Document>\n'
    atomic_write(path, head + "\n".join(places) + "\n</Document></kml>\n")


def write_geojson(path: FilePath, track: Track, fixes: Samples | None = None, name: str = "solution") -> None:
    """GeoJSON (RFC 7946): the track as a line of lon, lat in degrees and height in m; if given the fixes as points."""
    features = [_feature("LineString", track.lla, {"name": name, "t_s": track.t.tolist()})]
    if fixes is not None:
        features.append(_feature("MultiPoint", fixes.value, {"name": "fixes", "t_s": fixes.t.tolist()}))
    atomic_write(path, json.dumps({"type": "FeatureCollection", "features": features}) + "\n")


def _feature(kind: str, lla: np.ndarray, properties: Json) -> Json:
    places = [[round(lon / DEG, 10), round(lat / DEG, 10), round(h, 4)] for lat, lon, h in lla.tolist()]
    return {"type": "Feature", "properties": properties, "geometry": {"type": kind, "coordinates": places}}


def write_tum(path: FilePath, track: Track) -> None:
    """TUM: ``t x y z qx qy qz qw``, metres east, north, up from the first row, body FLU -> ENU as ROS and evo mean it.

    Raises:
        DataError: no attitude in some row, since the format has no gap.
    """
    if np.isnan(track.rph).any():
        raise DataError(f"{os.fspath(path)}: a TUM trajectory needs roll, pitch and heading, got nan")
    roll, pitch, heading = track.rph.T
    # FLU in ENU: forward up is a negative pitch, and the yaw counts from east to north
    (sr, sp, sy), (cr, cp, cy) = (f(np.stack([roll, -pitch, np.pi / 2 - heading]) / 2) for f in (np.sin, np.cos))
    q = [sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy]
    q.append(cr * cp * cy + sr * sp * sy)
    rows = np.column_stack([track.t, lla_to_local(track.lla, track.lla[0]), *q]).tolist()
    template = "%.9f %.6f %.6f %.6f %.12f %.12f %.12f %.12f"
    atomic_write(path, "".join(template % tuple(row) + "\n" for row in rows))


def _coordinates(lla: np.ndarray) -> list[str]:
    return [f"{lon / DEG:.9f},{lat / DEG:.9f},{h:.3f}" for lat, lon, h in lla.tolist()]


def _check_sd(path: FilePath, track: Track, sd: np.ndarray) -> np.ndarray:
    if np.shape(sd) != (len(track.t), 9):
        raise DataError(f"{os.fspath(path)}: sd must have shape {(len(track.t), 9)}, got {np.shape(sd)}")
    return np.asarray(sd)
