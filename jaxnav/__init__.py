"""INS/GNSS navigation in JAX, differentiable from the sensor to the score.

Glossary
--------
Frames: ``e`` ECEF, ``n`` local level ENU (east, north, up), ``b`` body FRD (forward, right, down), ``i`` inertial.
``C_nb`` and ``q_nb`` (scalar first) take b to n; a suffix names the axes: ``v_n``, ``f_b``, ``w_ie_n``.
Units: SI and radians; degrees, deg/h, mg only in files, plots and the command line, with the unit in the name
(`jaxnav.maths.units`). Time in seconds. Noise as sd or root PSD, never as variance.
Specific force: reading of an accelerometer; at rest (0, 0, -g) in FRD.
Error state: x = estimate - truth; ``truth = retract(estimate, x)``; C_est = exp([phi x]) C_true.
Epoch: the IMU samples since the last fix, and the fix that ends them. Innovation: y - H x. NIS, NEES: innovation and
error squared in units of their covariance, chi-square distributed if the filter is consistent.

A filter is mechanization x error model x rule x feedback (`jaxnav.filters.core.make_filter`); `FILTERS` lists the ones
with a name, `build` makes them, `run` runs them over `pack`ed epochs. Parameters are a pytree (`Params`), so that a run
can be vmapped over seeds and candidates and differentiated; the package ``tuning`` does that. Importing changes no
setting of jax: call `enable_x64()` first, and `fast_compiler()`, `cache()` if a first answer shall come sooner.
"""

import importlib
from importlib import metadata
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jaxnav.analysis.noise_scan import NoiseScan, scan_noise
    from jaxnav.filters.adapters import ADAPTERS
    from jaxnav.filters.adapters.adapter import Adapted, Adapter, Window
    from jaxnav.filters.catalogue import FILTERS, build
    from jaxnav.filters.compiler import cache, clear_caches_if_needed, enable_x64, fast_compiler
    from jaxnav.filters.core import Filter, make_filter
    from jaxnav.filters.epochs import Packed, cut_times, hide, outage_windows, pack, stack_epochs
    from jaxnav.filters.parameters import datasheet_params, mounting
    from jaxnav.filters.rule import Correction, Innovation, Rule
    from jaxnav.filters.run import initial_nav, prepare, require_params, require_x64, run, run_jit, track
    from jaxnav.filters.smoother import smooth
    from jaxnav.filters.spec import FilterSpec
    from jaxnav.filters.standstill import constraint_samples, stationary
    from jaxnav.initialization.bank import heading_bank, with_headings
    from jaxnav.initialization.initialize import coarse_leveling, course, initialize
    from jaxnav.io.recording import recording
    from jaxnav.io.weights import read_weights, write_weights
    from jaxnav.live import Live
    from jaxnav.measurements import (
        GNSS,
        MEASUREMENTS,
        NONHOLONOMIC,
        POSITION,
        SPEED,
        VELOCITY,
        ZERO_RATE,
        ZERO_VELOCITY,
    )
    from jaxnav.navigation import Solution, navigate
    from jaxnav.now import Now, Odometry
    from jaxnav.reading.read import read
    from jaxnav.simulate.keys import Purpose, run_keys
    from jaxnav.simulate.scenarios import SCENARIOS, Scenario
    from jaxnav.simulate.simulation import matched_params, simulate_runs, to_recording
    from jaxnav.states import STATES, State
    from jaxnav.states.grades import GRADES, Grade
    from jaxnav.stream import Stream
    from jaxnav.types import (
        ConfigError,
        DataError,
        Epoch,
        FilterError,
        Finding,
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
    from tuning.solving.solve import Solved, solve

# Imported when first asked for: the command line is there, and can be stopped, before jax is.
_HOMES = {
    "navigation": "Solution navigate",
    "analysis.noise_scan": "NoiseScan scan_noise",
    "live": "Live",
    "now": "Now Odometry",
    "stream": "Stream",
    "filters.epochs": "Packed cut_times hide outage_windows pack stack_epochs",
    "reading.read": "read",
    "io.recording": "recording",
    "initialization.bank": "heading_bank with_headings",
    "initialization.initialize": "coarse_leveling course initialize",
    "filters.adapters": "ADAPTERS",
    "filters.adapters.adapter": "Adapted Adapter Window",
    "filters.catalogue": "FILTERS build",
    "filters.compiler": "cache enable_x64 fast_compiler clear_caches_if_needed",
    "filters.core": "Filter make_filter",
    "filters.parameters": "datasheet_params mounting",
    "filters.rule": "Correction Innovation Rule",
    "filters.run": "initial_nav prepare require_params require_x64 run run_jit track",
    "filters.smoother": "smooth",
    "filters.spec": "FilterSpec",
    "filters.standstill": "constraint_samples stationary",
    "measurements": "GNSS MEASUREMENTS NONHOLONOMIC POSITION SPEED VELOCITY ZERO_RATE ZERO_VELOCITY",
    "io.weights": "read_weights write_weights",
    "simulate.keys": "Purpose run_keys",
    "simulate.scenarios": "SCENARIOS Scenario",
    "simulate.simulation": "matched_params simulate_runs to_recording",
    "states": "STATES State",
    "states.grades": "GRADES Grade",
    "types": "ConfigError DataError Epoch FilterError Finding Fix Imu ImuLog Info Mounting Nav Noise Params Prior "
    "Recording Samples StateParams Track",
}
_HOME = {name: f"jaxnav.{home}" for home, names in _HOMES.items() for name in names.split()}
_HOME |= dict.fromkeys(("Solved", "solve"), "tuning.solving.solve")  # the one interface that tunes
_FOLDERS = (
    "analysis", "app", "checkup", "filters", "initialization", "io", "maths", "measurements", "simulate", "states",
    "strapdown", "types",
)  # fmt: skip
__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    """Return a public name, a folder of the package, or its version."""
    if name in _HOME:
        value = getattr(importlib.import_module(_HOME[name]), name)
        globals()[name] = value
        return value
    if name in _FOLDERS:
        return importlib.import_module(f"jaxnav.{name}")
    if name == "__version__":
        return metadata.version("jaxnav")
    raise AttributeError(f"module 'jaxnav' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, *_FOLDERS})
