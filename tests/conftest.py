"""Float64 for every test, no compilation cache on disk, and one small simulated drive that many tests share."""

import gc
import os
import warnings
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

with warnings.catch_warnings():  # the compiler warns of the oracle's escape sequences when it is first imported
    warnings.simplefilter("ignore")
    from pyins import filters as _filters  # noqa: F401
    from pyins import sim

from jaxnav.analysis import progress  # noqa: E402
from jaxnav.app.cli import COLLECT  # noqa: E402
from jaxnav.filters import programs  # noqa: E402
from jaxnav.filters.compiler import clear_caches_if_needed, enable_x64, fast_compiler  # noqa: E402

# a program of a test runs once or twice: passes of XLA that take long and make it faster are left out
SLOW_PASSES = (
    "simplify-while-loops", "while-loop-invariant-code-motion", "while-loop-constant-sinking", "reshape-mover",
    "simplify-conditional", "tree_reduction_rewriter",
)  # fmt: skip
os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_disable_hlo_passes={','.join(SLOW_PASSES)}".strip()
fast_compiler()
enable_x64()
gc.set_threshold(COLLECT)
progress.SILENT_COMPILING_S = float("inf")  # what compiles goes with the machine, and is no part of what a test expects
jax.config.update("jax_enable_compilation_cache", False)
jax.config.update("jax_disable_most_optimizations", True)  # the suite's time is compilation

from jaxnav.filters.epochs import Packed, pack  # noqa: E402
from jaxnav.filters.parameters import change, datasheet_params  # noqa: E402
from jaxnav.filters.run import initial_nav  # noqa: E402
from jaxnav.maths.units import DEG  # noqa: E402
from jaxnav.states.grades import Grade  # noqa: E402
from jaxnav.states.transition import assemble  # noqa: E402
from jaxnav.types import ImuLog, Nav, Params, Samples, Track  # noqa: E402

GRADE = Grade(2e-4, 2e-3, 1e-3, 2e-2, 1e-4, 2e-3, 100.0, "made up for tests: a good MEMS unit")


def pytest_addoption(parser) -> None:
    """``--row NAME``: the tests of one row of a table, such as a state, a measurement, a filter or a finding."""
    parser.addoption("--row", metavar="NAME", help="run only the tests of this row of a table")


def pytest_collection_modifyitems(config, items) -> None:
    """Keep the tests of the row."""
    row = config.getoption("--row")
    if row is not None:
        of_row = lambda item: row in getattr(item, "callspec", SimpleNamespace(id="")).id.split("-")
        kept = [item for item in items if of_row(item)]
        config.hook.pytest_deselected(items=[item for item in items if item not in kept])
        items[:] = kept


def pytest_runtest_teardown(item, nextitem) -> None:
    """Between modules, keep nothing on disk, and drop compiled functions of a process that has collected many."""
    if nextitem is None or nextitem.path != item.path:
        programs.keep_in(None)
        clear_caches_if_needed(resident=1.6 * 2**30)  # two workers share a laptop


class Case(NamedTuple):
    """A drive without sensor errors, and what a filter needs to run on it."""

    imu: ImuLog  # noise free, 20 Hz
    truth: Track  # at the start and after every sample
    aiding: dict[str, Samples]  # position and velocity with noise of a seed, 1 Hz
    packed: Packed
    nav: Nav  # at the true start
    params: Params  # 15 states, matched to GRADE


def simulate_drive(duration: float = 60.0, rate: float = 20.0, lla0=(50.0, 12.0, 200.0)) -> tuple[ImuLog, Track]:
    """An accelerating and turning drive by python-ins, an independent simulator: exact increments, truth."""
    t = np.arange(round(duration * rate) + 1) / rate
    speed = 12 + 6 * np.sin(2 * np.pi * t / 25)
    heading = 0.5 + 1.2 * np.sin(2 * np.pi * t / 40) + 0.02 * t
    ned = np.stack([speed * np.cos(heading), speed * np.sin(heading), 0.3 * np.sin(2 * np.pi * t / 17)], 1)
    rph = np.stack([0.05 * np.sin(2 * np.pi * t / 9), 0.03 * np.sin(2 * np.pi * t / 13), heading], 1)
    frame, imu = sim.generate_imu(t, lla0, np.rad2deg(rph), ned, sensor_type="increment")
    dt = np.diff(t)
    readings = imu.to_numpy()[1:] / dt[:, None]
    values = frame[["lat", "lon", "alt"]].to_numpy() * [DEG, DEG, 1.0]
    return ImuLog(t[1:], dt, readings[:, :3], readings[:, 3:]), Track(t, values, ned[:, [1, 0, 2]] * [1, 1, -1], rph)


def gnss(truth: Track, every: int, rng: np.random.Generator) -> dict[str, Samples]:
    """Position (2, 2, 3 m) and velocity (0.1 m/s) at the antenna, which here is the IMU."""
    at = slice(every, None, every)
    K = truth.t[at].size
    sd, sdv = np.tile([2.0, 2.0, 3.0], (K, 1)), np.full((K, 3), 0.1)
    metres = np.stack([1 / (6.39e6 * np.cos(truth.lla[at, 0])), np.full(K, 1 / 6.38e6), np.ones(K)], 1)
    error = rng.normal(size=(K, 3)) * sd * metres
    zero = np.zeros((K, 3))
    return {
        "position": Samples(truth.t[at], truth.lla[at] + error[:, [1, 0, 2]], sd, zero),
        "velocity": Samples(truth.t[at], truth.vel[at] + rng.normal(size=(K, 3)) * sdv, sdv, zero),
    }


def start(truth: Track) -> Nav:
    return initial_nav(truth.lla[0], truth.vel[0], truth.rph[0])


@pytest.fixture(scope="session")
def case() -> Case:
    imu, truth = simulate_drive()
    aiding = gnss(truth, 20, np.random.default_rng(3))
    return Case(imu, truth, aiding, pack(imu, aiding, 1.0), start(truth), datasheet_params(GRADE))


@pytest.fixture(scope="session")
def fine_case() -> Case:
    """The same drive near latitude and longitude zero, where a float resolves 1e-11 m and not 1e-9 m."""
    imu, truth = simulate_drive(lla0=(1.0, 0.5, 200.0))
    aiding = gnss(truth, 20, np.random.default_rng(4))
    return Case(imu, truth, aiding, pack(imu, aiding, 1.0), start(truth), datasheet_params(GRADE))


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of recorded data sets; tests that need it are skipped where it is not."""
    folder = os.environ.get("JAXNAV_DATA_DIR")
    if not folder or not Path(folder).is_dir():
        pytest.skip("recorded data not found: set JAXNAV_DATA_DIR to the folder that holds the data sets")
    return Path(folder)


def leaves_equal(a, b, atol: float = 0.0, rtol: float = 0.0) -> None:
    """Every leaf of two trees agrees within atol + rtol |b|; 0 means bit for bit, which only one program promises."""
    same = partial(np.testing.assert_allclose, rtol=rtol, atol=atol)
    jax.tree.map(lambda x, y: same(np.asarray(x), np.asarray(y)), a, b)


def all_finite(tree) -> bool:
    return all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(tree))


#: short names of parameters, for `told`
LEAVES = {
    "gyro": "noise.gyro", "accel": "noise.accel",
    "gyro_bias": "states.gyro_bias.driving_noise",
    "accel_bias": "states.accel_bias.driving_noise",
    "gyro_tau": "states.gyro_bias.tau", "accel_tau": "states.accel_bias.tau",
    "gyro_bias_sd": "states.gyro_bias.sd", "accel_bias_sd": "states.accel_bias.sd",
    "position_scale": "measurements.position.scale", "velocity_scale": "measurements.velocity.scale",
    "position_latency": "measurements.position.latency", "velocity_latency": "measurements.velocity.latency",
    "zero_velocity": "measurements.zero_velocity.sd", "zero_rate": "measurements.zero_rate.sd",
    "nonholonomic": "measurements.nonholonomic.sd", "speed": "measurements.speed.sd_scale",
    "speed_scale": "measurements.speed.scale",
    **{name: f"mounting.{name}" for name in ("lever_arm", "time_offset", "clock_drift", "vehicle", "wheel_arm")},
    **{f"{name}_sd": f"prior.{name}" for name in ("position", "velocity", "attitude")},
}  # fmt: skip


def told(params: Params, **values) -> Params:
    """The parameters with these values, in SI, by short name."""
    return change(params, {LEAVES[name]: value for name, value in values.items()})


def dynamics_15(blocks) -> np.ndarray:
    """F (15, 15) of a frame's blocks with both biases as random walks."""
    F = np.zeros((15, 15))
    motion = {k: v for k, v in blocks.items() if k[1] not in ("gyro", "accel")}
    F[:9, :9] = assemble(motion)
    F[3:6, 12:15], F[6:9, 9:12] = blocks["velocity", "accel"], blocks["attitude", "gyro"]
    return F
