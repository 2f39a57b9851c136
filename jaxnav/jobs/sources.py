"""Where data comes from: simulated runs, public data sets, recordings at a path."""

import math
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav import io
from jaxnav.config import Config, nearest
from jaxnav.errors import ConfigError, DataError
from jaxnav.run import require_x64
from jaxnav.scenarios import SCENARIOS, Scenario
from jaxnav.sensors.gnss import antenna
from jaxnav.sensors.grades import GRADES, Grade
from jaxnav.sensors.imu import corrupt
from jaxnav.simulation import Simulated, simulate, sizes, to_recording
from jaxnav.types import Imu, Recording

TRAIN, VALIDATION, TEST, SINGLE = range(4)  # folded into the seed: runs of one kind never meet those of another


def key_of(seed: int, kind: int, run: int) -> jax.Array:
    """The key of a simulated run: of its seed, kind and number only."""
    return jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), kind), run)


def scenario_of(config: Config) -> Scenario | None:
    """The scenario that [data] names, with its options; None if the source is none.

    Raises:
        ConfigError: an unknown option, or one of the wrong type.
    """
    data = config.data
    if data.source not in SCENARIOS:
        return None
    scenario = SCENARIOS[data.source]
    for key, value in data.options.items():
        if key not in scenario._fields or key == "name":
            raise ConfigError(f"data.options.{key}: unknown for a scenario: {nearest(key, scenario._fields[1:])}")
        scenario = scenario._replace(**{key: _like(f"data.options.{key}", value, getattr(scenario, key))})
    if scenario.grade not in GRADES:
        raise ConfigError(f"data.options.grade: no IMU grade {scenario.grade!r}: {nearest(scenario.grade, GRADES)}")
    return scenario


def _like(name: str, value: Any, default: Any) -> Any:
    """``value`` with the type of ``default``: numbers, text, or tuples of them."""
    if isinstance(default, tuple) and isinstance(value, (list, tuple)):
        inner = default[0] if default else 0.0
        if isinstance(inner, tuple) or len(value) == len(default):
            return tuple(_like(name, v, inner) for v in value)
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if isinstance(default, float) and number:
        return float(value)
    if type(default) is type(value) and not isinstance(default, tuple):
        return value
    raise ConfigError(f"{name} must be like {default!r}, got {value!r}")


def simulated(config: Config, scenario: Scenario, keys: jax.Array) -> Simulated:
    """Runs of the scenario (leading axis of ``keys``), with [data]'s latency and IMU factor put in.

    Raises:
        ConfigError: a scenario that does not fit together.
    """
    try:
        _, k = sizes(scenario)
        latency = config.data.gnss_latency_s
        late = round(latency * scenario.imu_rate_hz)
        if abs(late - latency * scenario.imu_rate_hz) > 1e-6 or late >= k:
            raise ConfigError(f"data.gnss_latency_s must be whole IMU samples and less than an epoch, got {latency:g}")
        part = math.gcd(k, late)  # simulate fixes so often that one is exactly so old
        fast = scenario._replace(gnss_rate_hz=scenario.imu_rate_hz / part)
        return _simulated(fast, k // part, late // part, config.data.imu_worse_by, keys)
    except (ConfigError, DataError):
        raise
    except ValueError as error:
        raise ConfigError(f"data.options: {error}") from error


@partial(jax.jit, static_argnums=(0, 1, 2, 3))
def _simulated(fast: Scenario, every: int, by: int, factor: float, keys: jax.Array) -> Simulated:
    def one(key):
        sim = delay(reveal(simulate(fast, key), fast), every, by)
        return worsen(jax.random.fold_in(key, 99), sim, GRADES[fast.grade], factor, 1 / fast.imu_rate_hz)

    return jax.vmap(one)(keys)


def reveal(sim: Simulated, scenario: Scenario) -> Simulated:
    """Put the true position of the antenna in place of the fixes that an outage hides: what its end is scored by."""
    lla, _ = jax.vmap(antenna, (0, None))(sim.truth, jnp.asarray(scenario.lever_arm_m, float))
    fix = sim.epochs.fix
    value = fix.value.at[:, :3].set(jnp.where(sim.hidden[:, None], lla, fix.value[:, :3]))
    return sim._replace(epochs=sim.epochs._replace(fix=fix._replace(value=value)))


def delay(sim: Simulated, every: int, by: int) -> Simulated:
    """Every so many epochs as one, ended by the fix of ``by`` short epochs before."""
    if every == 1:
        return sim
    imu = Imu(*(a.reshape(-1, every * a.shape[1], *a.shape[2:]) for a in sim.epochs.imu))
    ends = slice(every - 1, None, every)
    fix = jax.tree.map(lambda a: a[every - 1 - by :: every], sim.epochs.fix)
    hidden = sim.hidden[ends]
    fix = fix._replace(valid=jnp.broadcast_to(~hidden[:, None], fix.valid.shape))
    truth = jax.tree.map(lambda a: a[ends], sim.truth)
    return sim._replace(epochs=sim.epochs._replace(imu=imu, fix=fix), truth=truth, hidden=hidden)


def worsen(key: jax.Array, sim: Simulated, grade: Grade, factor: float, dt: float) -> Simulated:
    """Add noise and drift until both have ``factor`` times the grade's sd; the turn-on biases stay."""
    if factor == 1.0:
        return sim
    more = math.sqrt(factor**2 - 1)
    extra = grade._replace(
        arw=more * grade.arw, vrw=more * grade.vrw, gyro_turn_on=0.0, accel_turn_on=0.0,
        gyro_instability=more * grade.gyro_instability, accel_instability=more * grade.accel_instability,
    )  # fmt: skip
    E, k = sim.epochs.imu.dt.shape
    flat = Imu(*(a.reshape(E * k, *a.shape[2:]) for a in sim.epochs.imu))
    flat, b_g, b_a = corrupt(key, flat, dt, extra)
    imu = Imu(*(a.reshape(E, k, *a.shape[1:]) for a in flat))
    last = np.arange(1, E + 1) * k - 1
    truth = sim.truth._replace(b_g=sim.truth.b_g + b_g[last], b_a=sim.truth.b_a + b_a[last])
    return sim._replace(epochs=sim.epochs._replace(imu=imu), truth=truth)


def load(config: Config) -> tuple[Recording, Simulated | None]:
    """The recording that [data] names, read or simulated.

    Raises:
        DataError: it is not there, or cannot be used.
    """
    data, scenario = config.data, scenario_of(config)
    require_x64(jnp.zeros((), float))
    if scenario is not None:
        sims = simulated(config, scenario, key_of(config.seed, SINGLE, 0)[None])
        sim = jax.tree.map(lambda a: a[0], sims)
        return to_recording(sim, scenario), sim
    if data.source in io.DATASETS:
        try:
            return io.load(data.source, **data.options), None
        except TypeError as error:
            raise ConfigError(f"data.options: {error}") from error
    if Path(data.source).exists():
        if data.options:
            raise ConfigError(
                f"data.options: {data.source} is a recording and takes none, got {', '.join(data.options)}"
            )
        return io.read_recording(data.source), None
    names = [*SCENARIOS, *io.DATASETS]
    raise DataError(f"{data.source}: no such file, scenario or data set: {nearest(data.source, names)}")
