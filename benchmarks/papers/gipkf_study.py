"""The outage study: simulated drives whose GNSS is hidden by masks, scoring at the ends of outages, tuning by gradient.

A drive is simulated once with every fix. Outages are drawn at new places for every step of training, and once for the
drives that are scored. All filters are scored by the distance of the IMU's true position at the end of an outage.
"""

from functools import cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.analysis import metrics
from jaxnav.filters.core import Filter
from jaxnav.filters.run import run
from jaxnav.maths import earth, rotations
from jaxnav.simulate import gnss
from jaxnav.simulate.scenarios import Scenario
from jaxnav.simulate.simulation import simulate
from jaxnav.states.motion import A
from jaxnav.types import Epoch, Info, Nav, Params
from tuning.fit.optimizers import adam
from tuning.fit.train import fit
from tuning.fit.transforms import Spec, join

LENGTHS = (10.0, 11.0, 22.0)  # s
SAMPLES = 10  # of the IMU in an epoch
EARLIEST, LATEST = np.array([150.0, 230.0, 310.0]), np.array([205.0, 285.0, 370.0])  # s, of an outage's start
SETTLED = 60.0  # s after the start: errors outside of outages count from then on
OUTSIDE = 0.3  # weight of the error outside of outages in training
BATCH, LAST = 12, 20  # drives of a training step; iterates of the mean


def reset_balanced(theta, retract, nav: Nav, x: jax.Array, T: jax.Array):
    """`jaxnav.filters.feedback.reset` of 15 states, to second order where a tilt stands for accelerometer bias.

    Levelled on biased accelerometers, navigation starts with a tilt and a bias that balance in body axes:
    C_est' g + b_est = C' g + b. Corrected to first order, they leave g phi^2 / 2 in the vertical bias: for 16 mg 1 to
    10 mm/s^2, when the covariance has that bias to less than 1. Here the balance is kept.
    """
    up = jnp.zeros(3).at[1].set(earth.gravity(nav.origin.lla[0], nav.origin.lla[2]))  # force that supports the IMU
    bend = rotations.to_dcm(rotations.exp(x[A])) @ up - up - jnp.cross(x[A], up)
    after = retract(nav, x)
    return (
        after._replace(
            errors=after.errors | {"accel_bias": after.errors["accel_bias"] - rotations.to_dcm(nav.q).T @ bend}
        ),
        jnp.zeros_like(x),
        None,
    )


class Drives(NamedTuple):
    """Simulated drives side by side."""

    initial: Nav  # (B, ...)
    epochs: Epoch  # (B, E, k, ...), every fix there
    truth: Nav  # (B, E, ...)


@partial(jax.jit, static_argnums=0)
def drive(scenario: Scenario, keys: jax.Array) -> Drives:
    """One drive a key (B,), one after the other."""

    def one(key):
        sim = simulate(key, scenario)
        return Drives(sim.initial, sim.epochs, sim.truth)

    return jax.lax.map(one, keys)


def draw(key: jax.Array, count: int) -> jax.Array:
    """Random outages of ``count`` drives, (count, 3, 2) s; on whole seconds, where the fixes are."""
    begin = jnp.floor(EARLIEST + (LATEST - EARLIEST + 1) * jax.random.uniform(key, (count, 3), float))
    return jnp.stack([begin, begin + np.array(LENGTHS)], -1)


def horizontal(nav: Nav, truth: Nav) -> jax.Array:
    """Error of position squared in the horizontal, m^2, ()."""
    return jnp.sum(metrics.position_error(nav, truth.pos)[:2] ** 2)


def hide(epochs: Epoch, t: jax.Array, windows: jax.Array) -> tuple[Epoch, jax.Array, jax.Array]:
    """One drive with the fixes of its windows (W, 2) hidden, which epochs those are (E,), and each one's last (W,)."""
    hidden = gnss.inside(t, windows)
    fix = epochs.fix._replace(valid=epochs.fix.valid & ~hidden[:, None])
    last = jax.vmap(lambda w: jnp.sum(t <= w[1] + 1e-6) - 1)(windows)
    return epochs._replace(fix=fix), hidden, last


def loss(filt: Filter, params: Params, drives: Drives, windows: jax.Array) -> jax.Array:
    """Mean over the lengths of the log RMS error at the end, and a share of that outside of outages, ()."""

    def one(initial, epochs, truth, windows):
        epochs, hidden, last = hide(epochs, truth.t, windows)
        error = jax.vmap(horizontal)(run(filt, params, initial, epochs).nav, truth)
        outside = ~hidden & (truth.t > truth.t[0] + SETTLED)
        return error[last], jnp.sum(jnp.where(outside, error, 0.0)) / jnp.sum(outside)

    ends, outside = jax.vmap(one)(*drives, windows)
    return 0.5 * (jnp.mean(jnp.log(ends.mean(0) + 1e-2)) + OUTSIDE * jnp.log(outside.mean() + 1e-2))


@cache
def objective(filt: Filter):
    """`loss` of a random minibatch with random outages, by the key that is a case."""

    def chance(params: Params, key: jax.Array, drives: Drives) -> jax.Array:
        pick, where = jax.random.split(key)
        count = drives.truth.t.shape[0]
        chosen = jax.random.choice(pick, count, (min(BATCH, count),), replace=False)
        some = jax.tree.map(lambda a: a[chosen], drives)
        return loss(filt, params, some, draw(where, chosen.size))

    return chance


def tune(
    filt: Filter, params: Params, spec: Spec, drives: Drives, key: jax.Array, steps: int, rate: float = 0.1
) -> tuple[Params, list[float]]:
    """Adam on minibatches with new outages; the mean of the last iterates, and the losses met."""
    found = fit(
        objective(filt), spec, params, steps, adam(steps, rate), arguments=(drives,),
        cases=lambda step: [jax.random.fold_in(key, step)[None]],
    )  # fmt: skip
    last = {name: np.array([row["params"][name] for row in found.history[1:][-LAST:]]) for name in spec}
    mean = {name: transform.inverse(jnp.asarray(last[name])).mean(0) for name, transform in spec.items()}
    return join(spec, mean, params), [row["loss"] for row in found.history]


class Scores(NamedTuple):
    """Results of the drives, (B, ...)."""

    ends: jax.Array  # (B, 3, 3) m, error at the end of each outage, ENU
    outside: jax.Array  # (B,) m, RMS of the horizontal error outside of outages
    whole: jax.Array  # (B,) m, of the whole drive
    nees: jax.Array  # (B, 2, 3) at the fix before each outage, and at its end
    ok: jax.Array  # (B,) bool


@partial(jax.jit, static_argnums=0)
def score(filt: Filter, params: Params, drives: Drives, windows: jax.Array) -> Scores:
    """Score one filter on drives with given outages (B, 3, 2)."""

    def one(initial, epochs, truth, windows):
        epochs, hidden, last = hide(epochs, truth.t, windows)
        info = run(filt, params, initial, epochs)
        error = jax.vmap(metrics.position_error)(info.nav, truth.pos)
        outside = ~hidden & (truth.t > truth.t[0] + SETTLED)
        squares = jnp.sum(error[:, :2] ** 2, 1)
        free = jnp.sqrt(jnp.sum(jnp.where(outside, squares, 0.0)) / outside.sum())
        looked = jnp.stack([last - np.array(LENGTHS, int), last])
        nees = jax.vmap(jax.vmap(consistency))(*jax.tree.map(lambda a: a[looked], (info, truth)))
        return Scores(error[last], free, jnp.sqrt(squares.mean()), nees, info.ok[-1])

    return jax.vmap(one)(*drives, windows)


def consistency(info: Info, truth: Nav) -> jax.Array:
    """Normalised error squared of position, velocity and attitude of one epoch, ().

    Not of the biases: a scale error, which no filter here knows, turns gravity into one.
    """
    phi = rotations.log(rotations.multiply(info.nav.q, rotations.conjugate(truth.q)))
    x = jnp.concatenate([metrics.position_error(info.nav, truth.pos), info.nav.vel - truth.vel, phi])
    return metrics.nees(x, info.P[:9, :9])


def summary(scores: Scores, rival: np.ndarray | None) -> dict:
    """The figures of one method on one set; ``rival`` (B, 3) m is who it wins or loses against, drive by drive."""
    ends = np.asarray(scores.ends)
    e = np.hypot(ends[..., 0], ends[..., 1])
    out: dict = {f"{length:g}": float(value) for length, value in zip(LENGTHS, metrics.rms(e), strict=True)}
    lengths = [f"{length:g}" for length in LENGTHS]
    out |= {f"median_{k}": float(v) for k, v in zip(lengths, np.median(e, 0), strict=True)}
    out |= {f"p90_{k}": float(v) for k, v in zip(lengths, np.quantile(e, 0.9, axis=0), strict=True)}
    if rival is not None:
        out["wins"] = float(np.mean(e < rival))
        out |= {f"wins_{k}": float(v) for k, v in zip(lengths, np.mean(e < rival, 0), strict=True)}
    out["axes_rms_ned"] = metrics.rms(ends)[:, [1, 0, 2]].tolist() if ends.ndim == 3 else None
    out["outside_rms"] = float(metrics.rms(np.asarray(scores.outside)))
    out["whole_rms"] = float(metrics.rms(np.asarray(scores.whole)))
    out |= {"all_finite": bool(np.asarray(scores.ok).all()), "per_seed": e.tolist()}
    return out


def line(name: str, r: dict) -> str:
    """One row of a table."""
    wins = f"{100 * r['wins']:5.0f} %" if "wins" in r else "      -"
    return (f"  {name:28} {r['10']:8.2f} {r['11']:8.2f} {r['22']:8.2f} {r['median_22']:8.2f} {r['p90_22']:8.2f}"
            f" {r['outside_rms']:8.2f} {wins}")  # fmt: skip


HEADER = f"  {'':28} {'10 s':>8} {'11 s':>8} {'22 s':>8} {'med 22':>8} {'p90 22':>8} {'outside':>8} {'wins':>7}"
