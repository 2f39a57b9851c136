"""The data of the package: NamedTuples with shape, unit and frame on every field.

Two kinds. *Traced* types hold jax arrays and flow through jit, vmap and grad (`Imu`, `Fix`, `Epoch`, `Nav`,
`Noise`, `Mounting`, `Prior`, `Params`, `Info`). *Host* types hold numpy arrays and come from readers
(`ImuLog`, `Samples`, `Track`, `Recording`); `jaxnav.filters.epochs.pack` turns them into epochs.

Frames: ``n`` local level ENU, ``b`` body FRD (forward, right, down). A specific force at rest is (0, 0, -g) in b.
"""

import difflib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, NamedTuple, TypeAlias, TypeVar

import jax
import numpy as np

Row = TypeVar("Row")
Array: TypeAlias = Any
"""Of jax while it is traced, of numpy on the host; the remark next to a field states its shape."""
Tree: TypeAlias = Any
"""A pytree of arrays: parameters of a rule, its memory, free numbers of a tuning."""
Json: TypeAlias = dict[str, Any]
"""An object of JSON or a table of TOML."""

# ---------------------------------------------------------------------------- errors that a user can act on


class DataError(ValueError):
    """Input that cannot be used: names the file and line, field, or run and time (exit code 3)."""


class FilterError(ValueError):
    """A result that must not be used, such as a filter that stopped being finite (exit code 1)."""


class ConfigError(ValueError):
    """A configuration that cannot be used: names the key and the nearest known one (exit code 2)."""


class Severity(StrEnum):
    """How much a finding matters."""

    INFO = "info"
    WARNING = "warning"


@dataclass(frozen=True)
class Finding:
    """A remark of a check, a run or a tuning: data first, a sentence second (`jaxnav.findings`)."""

    code: str  # "nis.high": stable, a row of `jaxnav.kinds.KINDS`
    severity: Severity
    subject: str = ""  # stream and channel, sensor and axis, or state
    value: float | None = None
    limit: float | None = None
    unit: str = ""  # of both
    message: str = ""  # quantity, value, limit
    causes: tuple[str, ...] = ()  # likely ones
    actions: tuple[str, ...] = ()  # settings or commands
    setting: str = ""  # that would take the value

    def __str__(self) -> str:
        return self.message

    @property
    def warns(self) -> bool:
        """Is something wrong, or does it look so?"""
        return self.severity is not Severity.INFO


Note = str | Finding
"""A remark of a reader; in words where it is one of a format alone."""


def nearest(name: str, known: Iterable[str]) -> str:
    """Return ``did you mean X?``, or the list of known names."""
    known = list(known)
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    return f"did you mean {close[0]}?" if close else f"known are {', '.join(known)}"


class Table(dict[str, Row]):
    """Rows by name. Users add theirs at run time; the table knows those that came with the library."""

    def __init__(self, rows: Mapping[str, Row]):
        super().__init__(rows)
        self._first = dict(rows)

    @classmethod
    def named(cls, *rows: Row) -> "Table[Row]":
        """Return the table of rows that have a ``name``."""
        return cls({row.name: row for row in rows})  # type: ignore[attr-defined]

    def is_built_in(self, name: str) -> bool:
        """Return whether the row of this name came with the library."""
        return name in self._first and self[name] is self._first[name]


# ---------------------------------------------------------------------------- traced: inputs of a filter


class Imu(NamedTuple):
    """IMU samples: means over each sample's interval, which is increments divided by dt. Leading axis k or none."""

    dt: jax.Array  # (k,) s; 0 marks padding
    gyro: jax.Array  # (k, 3) rad/s, body FRD with respect to inertial space
    accel: jax.Array  # (k, 3) m/s^2, specific force, body FRD


class Fix(NamedTuple):
    """Measurements at the end of one epoch, all channels side by side in the order the error model was made with.

    Finite, ``sd > 0``; a missing channel is ``valid = False`` with any value, nan too. Channels of a position are east,
    north, up, its value is latitude, longitude, height: with ``valid = (False, True, True)`` the longitude is missing.
    """

    value: jax.Array  # (m,) rad, m, m/s, rad/s: see `jaxnav.measurements`
    sd: jax.Array  # (m,) standard deviation: ENU m or m/s for GNSS
    corr: jax.Array  # (m,) correlation of channel i with the next channel of its block of three (cyclic: EN, NU, UE)
    valid: jax.Array  # (m,) bool
    auxiliary: Any = {}  # (s, a) by measurement: finite values of its channels that its model reads; of one: (s, a)


class Epoch(NamedTuple):
    """IMU samples since the last fix, and the fix that ends them."""

    imu: Any  # Imu (k, ...), or the result of `jaxnav.filters.run.prepare` for a filter
    fix: Fix  # (m,)
    gap: Any = None  # (2,) root PSD that the noise of gyro and accelerometer has more, where samples are missing
    auxiliary: Json = {}  # () each, by name of `jaxnav.measurements.auxiliary.AUXILIARY`


class Origin(NamedTuple):
    """Where and when a frame that does not travel along was fixed; local level navigation only hands it on."""

    lla: jax.Array  # (3,) lat rad, lon rad, h m
    azimuth: jax.Array  # () rad, of the frame's horizontal first axis, clockwise from north
    t: jax.Array  # () s


class Nav(NamedTuple):
    """Navigation state; one type for every mechanization, which defines ``pos``, ``vel`` and ``q``.

    Local level: pos = (lat rad, lon rad, h m), vel ENU m/s, q body -> ENU. A filter is initialized with it and
    reports it, in any frame.
    """

    t: jax.Array  # () s since the start of the run
    pos: jax.Array  # (3,) units of the frame
    vel: jax.Array  # (3,) m/s
    q: jax.Array  # (4,) unit quaternion, scalar first, body -> axes of the frame
    omega: jax.Array  # (3,) rad/s, last body rate, the sensors' errors taken out
    force: jax.Array  # (3,) m/s^2, last specific force, body, likewise
    origin: Origin
    errors: dict[str, jax.Array]  # (size,) estimates by name of `jaxnav.states.STATES`: measured minus true
    auxiliary: dict[str, jax.Array] = {}  # () each, of the epoch, for the states of the filter that read it


class ErrorInputs(NamedTuple):
    """Path of an epoch for the error dynamics: b points, each one sample or the mean over several."""

    nav: Nav  # (b, ...) when each has passed
    C: jax.Array  # (b, 3, 3) body -> axes of the frame, at its middle
    force: jax.Array  # (b, 3) m/s^2, mean specific force in the axes of the frame
    gyro: jax.Array  # (b, 3) rad/s, mean body rate, the sensors' errors taken out
    accel: jax.Array  # (b, 3) m/s^2, mean specific force, body, likewise


class Forcing(NamedTuple):
    """A rate and an acceleration in the axes of the error state: observer feedback, or a model error to absorb."""

    omega: jax.Array | np.ndarray  # (3,) rad/s
    accel: jax.Array | np.ndarray  # (3,) m/s^2


# ---------------------------------------------------------------------------- traced: parameters

Leaf: TypeAlias = Any
"""A parameter: an array, and in a row of a table the plain number or the `jaxnav.maths.units.Unit` of one."""


class Noise(NamedTuple):
    """White noise of the inertial sensors, root PSD, body.

    One number for all axes, or one an axis, or a lower triangular root L (3, 3) for noise that is correlated between
    the axes: L L' is then the spectral density, and the norms of the rows of L are the root PSDs of the axes.
    """

    gyro: Leaf  # (), (3,) or (3, 3) rad/s/sqrt(Hz), angular random walk
    accel: Leaf  # (), (3,) or (3, 3) m/s^2/sqrt(Hz), velocity random walk
    scale: Leaf = 0.0  # (), sd of scale errors and misalignment of both sensors, see `jaxnav.states.sensitivity`


class StateParams(NamedTuple):
    """Prior and process of one of `jaxnav.states.STATES`: a first-order Gauss-Markov process, in units of the state.

    Each leaf broadcasts to the state's axes. ``tau = inf`` is a random walk, ``driving_noise = 0`` a constant.
    """

    sd: Leaf  # () or (size,) at the start
    driving_noise: Leaf  # (), (size,) or a root (size, size) as in `Noise`; per sqrt(s), root PSD of the driving noise
    tau: Leaf  # () or (size,) s


class Mounting(NamedTuple):
    """Geometry and timing of the installation: tunable like any other parameter."""

    lever_arm: Leaf  # (3,) m, IMU -> GNSS antenna, body FRD
    time_offset: Leaf  # () s, GNSS time = IMU stamp + time_offset at the stamp origin.t of `Nav`
    clock_drift: Leaf  # () s/s, by which that offset grows from then on
    vehicle: Leaf  # (2,) rad, pitch and yaw of the vehicle's axes in the body's: its nose is not the IMU's
    wheel_arm: Leaf  # (3,) m, IMU -> point where nonholonomic and wheel speed hold, body FRD


class Prior(NamedTuple):
    """Initial standard deviations, each of which broadcasts to its axes, and their correlations."""

    position: Leaf  # () or (3,) m, ENU
    velocity: Leaf  # () or (3,) m/s, ENU
    attitude: Leaf  # () or (3,) rad, rotation about E, N (tilts) and U (heading)
    # (12, 12) lower root of the correlations of velocity, attitude, gyro and accelerometer bias; None: there are none
    correlated: Leaf = None


class Params(NamedTuple):
    """Everything a tuner may change, one pytree."""

    noise: Noise
    prior: Prior
    states: dict[str, StateParams]  # of each optional state of the filter, by name
    measurements: Json  # of each of its measurements, by name: a NamedTuple of the measurement's
    mounting: Mounting
    rule: Any = ()  # theta of the rule, a NamedTuple
    feedback: Any = ()  # theta of the feedback
    adapter: Any = ()  # theta of the adapter, any tree


# ---------------------------------------------------------------------------- traced: outputs of a filter


class Info(NamedTuple):
    """The corrected solution and the innovation statistics, one row an epoch; local level in any frame."""

    nav: Nav  # (E, ...) corrected: retract(nav, x), at the end of the epoch
    P: jax.Array  # (E, n, n) covariance after the correction; position, velocity and attitude errors in ENU
    x: jax.Array  # (E, n) error state after the correction, before feedback; likewise
    nu: jax.Array  # (E, m) innovation, 0 on missing channels
    S: jax.Array  # (E, m, m) its covariance; identity rows on missing channels
    residual: jax.Array  # (E, m) estimate minus measurement before the correction, of hidden measurements too
    valid: jax.Array  # (E, m) bool, channels that had a measurement
    used: jax.Array  # (E, m) bool, those the rule accepted
    nis: jax.Array  # (E,) nu' S^-1 nu over the valid channels
    ok: jax.Array  # (E,) bool; False from the first epoch that was not finite on: the state is frozen there
    log_det: jax.Array  # (E,) log |S|


# ---------------------------------------------------------------------------- host: outputs of readers


class ImuLog(NamedTuple):
    """A recorded or simulated IMU stream: means over (t - dt, t]."""

    t: np.ndarray  # (N,) s, end of each sample's interval
    dt: np.ndarray  # (N,) s, length of the interval
    gyro: np.ndarray  # (N, 3) rad/s, body FRD
    accel: np.ndarray  # (N, 3) m/s^2, specific force, body FRD


class Samples(NamedTuple):
    """One stream of measurements of a named kind (see `jaxnav.measurements.MEASUREMENTS`)."""

    t: np.ndarray  # (K,) s, strictly increasing
    value: np.ndarray  # (K, s)
    sd: np.ndarray  # (K, s), > 0
    corr: np.ndarray  # (K, s), see `Fix.corr`; zeros where the axes are independent
    valid: np.ndarray | None = None  # (K, s) bool, channels that are there; None: all
    auxiliary: np.ndarray | None = None  # (K, s, a), see `Fix.auxiliary`; None where the measurement has none


class Track(NamedTuple):
    """A trajectory on the border between host and device: truth, or a solution."""

    t: np.ndarray  # (N,) s
    lla: np.ndarray  # (N, 3) lat rad, lon rad, height m
    vel: np.ndarray  # (N, 3) m/s, ENU
    rph: np.ndarray  # (N, 3) rad, roll, pitch, heading of FRD against NED; nan where not known


class Recording(NamedTuple):
    """One drive, flight or simulated run."""

    name: str
    imu: ImuLog
    aiding: dict[str, Samples]  # by measurement name: "position", "velocity", "speed", ...
    truth: Track | None
    lever_arm: np.ndarray  # (3,) m, IMU -> antenna, body FRD
    remarks: str = ""  # in words: of its user, of its format
    errors: tuple[np.ndarray, dict[str, np.ndarray]] | None = None  # simulated: t (N,) s, true states (N, size) by name
    findings: tuple[Finding, ...] = ()  # of its reader
    early: float = 0.0  # s by which the IMU's stamps were moved back, so that no fix is early (`not_early`)

    @property
    def notes(self) -> str:
        """Return remarks and findings of its reader, a sentence a line, each once: a written recording keeps them."""
        return "\n".join(dict.fromkeys([*self.remarks.splitlines(), *(f"{f}." for f in self.findings)]))


# ---------------------------------------------------------------------------- rows of a stream


def require_double(name: str, value: np.ndarray) -> None:
    """Refuse positions of less than 64 bits: a latitude in float32 has steps of up to 0.8 m.

    Raises:
        DataError: names the stream and the type.
    """
    dtype = np.asarray(value).dtype
    if name == "position" and dtype.kind == "f" and dtype.itemsize < 8:
        raise DataError(f"position: latitude and longitude must be float64, got {dtype}, which has steps of 0.8 m")


def sample_rows(samples: Samples, rows: np.ndarray | slice) -> Samples:
    """Return some rows of a stream, by a mask (K,), indices or a slice."""
    more = (None if a is None else a[rows] for a in (samples.valid, samples.auxiliary))
    return Samples(samples.t[rows], samples.value[rows], samples.sd[rows], samples.corr[rows], *more)
