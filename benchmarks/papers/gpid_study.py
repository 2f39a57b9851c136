"""Runs of the GPID benchmark: filters and their parameters, errors by part of the hour, and the loss for tuning."""

from collections.abc import Callable
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.filters.core import Filter, make_filter
from jaxnav.filters.error_model import error_model
from jaxnav.filters.feedback import reset
from jaxnav.filters.papers.gpid import gpid, gpid_params
from jaxnav.filters.parameters import change, datasheet_params
from jaxnav.filters.run import run
from jaxnav.maths import earth, rotations, units
from jaxnav.simulate.scenarios import Scenario
from jaxnav.simulate.simulation import Simulated, simulate
from jaxnav.states.grades import GRADES
from jaxnav.strapdown.fast import local_level
from jaxnav.types import Info, Nav, Params

PARTS = {"before": (0, 600), "in": (600, 1100), "after": (1100, 1600), "rest": (1600, 3600)}  # s
COLUMNS = (
    "roll_deg", "pitch_deg", "yaw_deg", "latitude_deg", "longitude_deg", "altitude_m", "east_m", "north_m",
    "ve_mps", "vn_mps", "vu_mps", "tilt_deg", "heading_deg",
)  # fmt: skip
SCHEMES = {"kf": (0.0, 0.0), "scheme_1": (1.0, 0.0), "scheme_2": (1.5, 3.0)}  # printed ki, kd; the KF has none
SCORED = ("tilt_deg", "heading_deg", "horizontal_m", "altitude_m")  # scores of tuning, in logarithms
# of the paper: columns of `COLUMNS`, and its numbers
TABLE3 = {
    "kf": (0.0665, 0.0683, 0.1538),
    "scheme_1": (0.0176, 0.0188, 0.0441),
    "scheme_2": (0.0159, 0.0169, 0.0402),
}
TABLE4 = {"kf": (10.6e-5, 18.8e-5, 61.39), "scheme_1": (4.25e-5, 5.58e-5, 16.49), "scheme_2": (2.61e-5, 3.95e-5, 11.04)}
TABLES = {
    "table3": (("roll_deg", "pitch_deg", "yaw_deg"), TABLE3),
    "table4": (("latitude_deg", "longitude_deg", "altitude_m"), TABLE4),
}


@cache
def paper_filter(stride: int) -> Filter:
    """The paper's nine states in their simplified form with the GPID rule, which is the KF where ki = kd = 0."""
    return make_filter(local_level.propagate, error_model(states=(), form="simple"), gpid(), reset, stride)


def fitted_params(ki: float = 0.0, kd: float = 0.0) -> Params:
    """The configuration nearest to the paper's tables, found by search, not stated in the paper.

    Process noise 444 (gyro) and 87 (accelerometer) times Table 1, sd of velocity 0.59 and of vertical position 26
    times the receiver's; integral and derivative on the position states.
    """
    params = datasheet_params(
        GRADES["tactical"],
        (10.0,) * 3,
        (1.0,) * 3,
        0.8 * units.DEG,
        0.8 * units.DEG,
        rule=gpid_params(ki, kd),
        states=(),
    )
    return change(
        params,
        {
            "noise.gyro": 1.29e-4,
            "noise.accel": 0.0435,
            "measurements.position.scale": (1.0, 1.0, 26.4),
            "measurements.velocity.scale": (0.586,) * 3,
        },
    )


def deviation(info: Info, truth: Nav) -> jax.Array:
    """Estimate minus truth of every epoch, (E, 13): `COLUMNS` in order; tilt and heading are of the rotation."""
    enu = jax.vmap(earth.enu_difference)(info.nav.pos, truth.pos)
    degrees = (info.nav.pos - truth.pos)[:, :2] / units.DEG
    rph = jax.vmap(lambda q: rotations.to_rph(rotations.to_dcm(q)))
    turn = jnp.remainder(rph(info.nav.q) - rph(truth.q) + jnp.pi, 2 * jnp.pi) - jnp.pi
    phi = jax.vmap(lambda a, b: rotations.log(rotations.multiply(a, rotations.conjugate(b))))(info.nav.q, truth.q)
    tilt = jnp.sqrt(phi[:, 0] ** 2 + phi[:, 1] ** 2 + 1e-24)
    columns = (turn / units.DEG, degrees, enu[:, 2:], enu[:, :2], info.nav.vel - truth.vel)
    return jnp.concatenate([*columns, jnp.stack([tilt, phi[:, 2]], 1) / units.DEG], 1)


class Study(NamedTuple):
    """C candidates over S seeds."""

    squares: np.ndarray  # (S, C, 4, 13) mean square of each part of the hour
    series: np.ndarray  # (C, E, 13) errors of the first seed
    track: np.ndarray  # (C + 1, E, 2) lat, lon rad of the first seed, the truth last
    ok: np.ndarray  # (S, C) bool, finite to the end
    nis: np.ndarray  # (S, C) mean


@partial(jax.jit, static_argnums=0)
def hours(scenario: Scenario, keys: jax.Array) -> Simulated:
    """One hour a key, (S, ...)."""
    return jax.lax.map(partial(simulate, scenario=scenario), keys)


@partial(jax.jit, static_argnums=0)
def _runs(filt: Filter, params: Params, sims: Simulated):
    def seed(sim):
        def candidate(p):
            info = run(filt, p, sim.initial, sim.epochs)
            e = deviation(info, sim.truth)
            rate = e.shape[0] // PARTS["rest"][1]  # of the fixes, Hz
            squares = jnp.stack([jnp.mean(e[a * rate : b * rate] ** 2, 0) for a, b in PARTS.values()])
            return squares, e, info.nav.pos[:, :2], info.ok[-1], info.nis.mean()

        return *jax.vmap(candidate)(params), sim.truth.pos[None, :, :2]

    squares, e, track, ok, nis, truth = jax.lax.map(seed, sims, batch_size=4)
    return squares, e[0], jnp.concatenate([track[0], truth[0]]), ok, nis


def study(filt: Filter, params: list[Params], sims: Simulated) -> Study:
    """All candidates on all seeds; runs of an hour."""
    stacked = jax.tree.map(lambda *a: jnp.stack(a), *params)
    return Study(*(np.asarray(a) for a in _runs(filt, stacked, sims)))


def rms(squares: np.ndarray, part: str | None = None) -> dict[str, np.ndarray]:
    """Root mean squares by name, each (S, C), over one part or the whole hour; horizontal_m is of both axes."""
    lengths = np.diff(list(PARTS.values()))[:, 0]
    weights = lengths if part is None else lengths * (np.array(list(PARTS)) == part)
    mean = np.einsum("p,scpq->scq", weights / weights.sum(), squares)
    table = dict(zip(COLUMNS, np.sqrt(np.moveaxis(mean, -1, 0)), strict=True))
    return table | {"horizontal_m": np.hypot(table["east_m"], table["north_m"])}


def score(squares: np.ndarray) -> np.ndarray:
    """Mean logarithm of tilt, heading, horizontal and altitude RMS over the hour and all seeds, (C,)."""
    table = rms(squares)
    return np.mean([0.5 * np.log(np.mean(table[name] ** 2, axis=0)) for name in SCORED], axis=0)


@cache
def loss(filt: Filter) -> Callable[..., jax.Array]:
    """`score` as a differentiable ``(params, *batches of hours) -> ()``, mean over the batches."""

    def squares(params: Params, sim: Simulated) -> jax.Array:
        e = deviation(run(filt, params, sim.initial, sim.epochs), sim.truth)
        column = lambda name: jnp.mean(e[:, COLUMNS.index(name)] ** 2)
        horizontal = column("east_m") + column("north_m")
        return jnp.stack([column("tilt_deg"), column("heading_deg"), horizontal, column("altitude_m")])

    def total(params: Params, *batches: Simulated) -> jax.Array:
        means = [jnp.mean(jax.vmap(squares, (None, 0))(params, sims), 0) for sims in batches]
        return jnp.mean(0.5 * jnp.log(jnp.stack(means)))

    return total


def keys_of(seed: int, purpose: int, count: int) -> jax.Array:
    """Keys of one purpose (0 scores, 1 trains), which never meet."""
    root = jax.random.fold_in(jax.random.key(seed), purpose)
    return jax.vmap(partial(jax.random.fold_in, root))(np.arange(count))


def as_row(values: np.ndarray) -> dict[str, Any]:
    """Mean and sd over seeds of a (S,) array."""
    return {"ours": float(values.mean()), "sd": float(values.std(ddof=1)) if values.size > 1 else 0.0}
