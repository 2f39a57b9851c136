"""INS/GNSS navigation in JAX, differentiable from the sensor to the score.

Glossary
--------
Frames: ``e`` ECEF, ``n`` local level ENU (east, north, up), ``b`` body FRD (forward, right, down), ``i`` inertial.
``C_nb`` and ``q_nb`` (scalar first) take b to n; a suffix names the axes: ``v_n``, ``f_b``, ``w_ie_n``.
Units: SI and radians; degrees, deg/h, mg only in files, plots and the command line, with the unit in the name
(`jaxnav.maths.units`). Time in seconds. Noise as sd or root PSD, never as variance.
Specific force: what an accelerometer senses; at rest (0, 0, -g) in FRD.
Error state: x = estimate - truth; ``truth = retract(estimate, x)``; C_est = exp([phi x]) C_true.
Epoch: the IMU samples since the last fix, and the fix that ends them. Innovation: y - H x. NIS, NEES: innovation and
error squared in units of their covariance, chi-square distributed if the filter is consistent.

A filter is mechanization x error model x rule x feedback (`jaxnav.filters.core.make_filter`); `FILTERS` lists the ones
with a name, `build` makes them, `run` runs them over `pack`ed epochs. Parameters are a pytree (`Params`), so that a run
can be vmapped over seeds and candidates and differentiated; the package ``tuning`` does that. Importing changes no
setting of jax: call `enable_x64()` first, and `fast_compiler()`, `cache()` if a first answer shall come sooner.
"""

from jaxnav.analysis.navigate import Solution, navigate
from jaxnav.data.epochs import Packed, constraint_samples, cut_times, hide, outage_windows, pack, stationary
from jaxnav.data.read import read
from jaxnav.data.recording import recording
from jaxnav.data.start import course, heading_bank, level, start, with_headings
from jaxnav.filters.catalogue import FILTERS, build
from jaxnav.filters.compiler import cache, enable_x64, fast_compiler, make_room
from jaxnav.filters.core import Correction, Filter, Innovation, Rule, make_filter
from jaxnav.filters.parameters import datasheet_params, mounting
from jaxnav.filters.run import initial_nav, prepare, require_x64, run, run_jit, track
from jaxnav.filters.smoother import smooth
from jaxnav.measurements import GNSS, MEASUREMENTS, NONHOLONOMIC, POSITION, SPEED, VELOCITY, ZERO_RATE, ZERO_VELOCITY
from jaxnav.states import STATES, State
from jaxnav.states.grades import GRADES, Grade
from jaxnav.types import (
    ConfigError,
    DataError,
    Epoch,
    Fix,
    Imu,
    ImuLog,
    Info,
    Mounting,
    Nav,
    Noise,
    Params,
    Prior,
    Recording,
    Samples,
    StateParams,
    Track,
)

__version__ = "0.1.0"

__all__ = [
    "ConfigError", "Correction", "DataError", "Epoch", "FILTERS", "Filter", "Fix", "GNSS", "GRADES", "Grade", "Imu",
    "ImuLog", "Info", "Innovation", "MEASUREMENTS", "Mounting", "NONHOLONOMIC", "Nav", "Noise", "POSITION", "Packed",
    "Params", "Prior", "Recording", "Rule", "SPEED", "STATES", "Samples", "Solution", "State", "StateParams", "Track",
    "VELOCITY", "ZERO_RATE", "ZERO_VELOCITY", "build", "cache", "constraint_samples", "course", "cut_times",
    "datasheet_params", "enable_x64", "fast_compiler", "heading_bank", "hide", "initial_nav", "level", "make_filter",
    "make_room", "mounting", "navigate", "outage_windows", "pack", "prepare", "read", "recording", "require_x64", "run",
    "run_jit", "smooth", "start", "stationary", "track", "with_headings",
]  # fmt: skip
