"""A recording from arrays, for data in no file that `jaxnav.io` reads."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from jaxnav.io.checks import check_recording
from jaxnav.measurements import MEASUREMENTS, with_data
from jaxnav.types import DataError, ImuLog, Recording, Samples, Track, nearest, require_double, sample_rows

Stream = Samples | Sequence[ArrayLike]


def recording(
    imu: ImuLog | Sequence[ArrayLike],
    *,
    name: str = "recording",
    lever_arm: ArrayLike = (0.0, 0.0, 0.0),
    truth: Track | None = None,
    notes: str = "",
    **streams: Stream,
) -> Recording:
    """Return a checked recording from arrays.

    ``recording((t, gyro, accel), position=(t, lla, sd), velocity=(t, enu, sd))``. Rows that a numpy mask hides are left
    out.

    Args:
        imu: `ImuLog`, or times (N,) s at the end of each sample, rates (N, 3) rad/s and specific force (N, 3) m/s^2,
            body FRD, means over the sample; a step is then the time since the sample before.
        name: of the recording, for messages and figures.
        lever_arm: (3,) m, IMU -> antenna, body FRD.
        truth: true trajectory, where known.
        notes: remarks for the user, one per line.
        **streams: by name of a measurement with data (`jaxnav.measurements.MEASUREMENTS`): `Samples`, or times (K,) s,
            values (K, s) and sd (K, s) or one number for all; positions in rad, rad, m, with sd in ENU m.

    Raises:
        DataError: an unknown stream, or unusable data; names the stream, the row and the problem.

    Five seconds at rest on the equator, with a fix each second:

    >>> t, fixes = np.arange(1, 501) / 100, np.arange(1.0, 6.0)
    >>> rec = recording(
    ...     (t, np.zeros((500, 3)), np.tile([0.0, 0.0, -9.78], (500, 1))), position=(fixes, np.zeros((5, 3)), 1.0)
    ... )
    >>> rec.imu.dt.sum(), rec.aiding["position"].sd.shape
    (np.float64(5.0), (5, 3))
    """
    known = {name: row.size for name, row in with_data().items()}
    known |= {name: row.size for name, row in MEASUREMENTS.items() if row.auxiliary}
    for stream in streams:
        if stream not in known:
            raise DataError(f"no measurement takes a stream {stream!r}: {nearest(stream, known)}")
    aiding = {stream: _samples(stream, data, known[stream]) for stream, data in streams.items()}
    return check_recording(Recording(name, _imu(imu), aiding, truth, np.asarray(lever_arm, float), notes))


def _imu(imu: ImuLog | Sequence[ArrayLike]) -> ImuLog:
    if isinstance(imu, ImuLog):
        return ImuLog(*(_filled(a) for a in imu))
    if len(imu) != 3:
        raise DataError(f"imu: expected (t, gyro, accel), got {len(imu)} arrays")
    t, gyro, accel = (_filled(a) for a in imu)
    if t.ndim != 1 or t.size < 2:
        raise DataError(f"imu: t must be (N,) with N > 1, got {t.shape}")
    step = np.diff(t)
    return ImuLog(t, np.concatenate([[np.median(step)], step]), gyro, accel)


def _samples(name: str, data: Any, size: int) -> Samples:
    if isinstance(data, Samples):
        require_double(name, data.value)
        numbers = Samples(_filled(data.t), _filled(data.value), _filled(data.sd), _filled(data.corr), *data[4:])
        return _unmasked(numbers, *data[:4])
    if len(data) not in (3, 4):
        raise DataError(f"{name}: expected (t, value, sd) or (t, value, sd, corr), got {len(data)} arrays")
    require_double(name, data[1])
    t, value = (_filled(a) for a in data[:2])
    if value.ndim == 1 and size == 1:
        value = value[:, None]
    try:
        sd = np.broadcast_to(_filled(data[2]), value.shape)
    except ValueError as error:
        raise DataError(
            f"{name}: sd must be one number, ({size},) or {value.shape}, got {np.shape(data[2])}"
        ) from error
    corr = np.zeros(value.shape) if len(data) == 3 else _filled(data[3])
    return _unmasked(Samples(t, value, np.array(sd), corr), *data)


def _filled(a: Any) -> np.ndarray:
    """Return float64, nan where a numpy mask hides an entry."""
    return np.ma.filled(np.ma.asarray(a, float), np.nan) if np.ma.isMaskedArray(a) else np.asarray(a, float)


def _unmasked(samples: Samples, *given: Any) -> Samples:
    """Return the samples without the rows that a mask of one of their arrays hides."""
    keep = np.ones(samples.t.shape, bool)
    for a in given:
        if np.ma.isMaskedArray(a) and np.ndim(a):
            keep &= ~np.ma.getmaskarray(a).reshape(len(a), -1).any(axis=1)
    return sample_rows(samples, keep)
