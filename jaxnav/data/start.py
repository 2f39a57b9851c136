"""Where navigation starts: levelling at rest, heading from the course, and unknown heading as a bank of hypotheses."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import logsumexp

from jaxnav.analysis.metrics import negative_log_likelihood
from jaxnav.filters.core import Filter
from jaxnav.filters.run import run
from jaxnav.maths import rotations
from jaxnav.types import DataError, Epoch, ImuLog, Info, Nav, Params, Samples


def level(imu: ImuLog, start: float, stop: float) -> tuple[float, float]:
    """Roll and pitch (rad) from the mean specific force between two times, at rest.

    An accelerometer bias b tilts it by b / g, 1 mrad for 1 mg.

    Raises:
        DataError: no sample between the times.
    """
    inside = (imu.t > start) & (imu.t <= stop)
    if not inside.any():
        raise DataError(f"imu: no sample in {start:.3f} to {stop:.3f} s to level with")
    roll, pitch = levelled(jnp.asarray(np.average(imu.accel[inside], axis=0, weights=imu.dt[inside])))
    return float(roll), float(pitch)


def levelled(force: jax.Array) -> jax.Array:
    """Roll and pitch (2,) rad that a mean specific force (3,) m/s^2, body FRD, shows at rest."""
    fx, fy, fz = force
    return jnp.stack([jnp.arctan2(-fy, -fz), jnp.arctan2(fx, jnp.hypot(fy, fz))])


def course(velocity: Samples, min_speed: float, after: float = -np.inf) -> tuple[float, float]:
    """Time (s) and course over ground (rad from north, clockwise) of the first velocity faster than ``min_speed``.

    And than three times its own sd. It is the heading of a vehicle that does not slip and drives forward.

    Raises:
        DataError: never that fast.
    """
    speed, sd = np.hypot(velocity.value[:, 0], velocity.value[:, 1]), velocity.sd[:, :2].max(1)
    fast = (speed >= min_speed) & (speed > 3 * sd) & (velocity.t >= after)
    if not fast.any():
        raise DataError(
            f"velocity: never faster than {min_speed:g} m/s and 3 sd after {after:g} s, no course to start from"
        )
    i = int(np.argmax(fast))
    return float(velocity.t[i]), float(np.arctan2(velocity.value[i, 0], velocity.value[i, 1]))


class Bank(NamedTuple):
    """Filters that started with different headings."""

    info: Info  # (B, E, ...)
    probability: jax.Array  # (B,) of each heading, given all innovations of the span
    best: jax.Array  # () index of the most probable


def heading_bank(filt: Filter, params: Params, navs: Nav, epochs: Epoch) -> Bank:
    """Unknown heading: run the filter from each of ``navs`` (B, ...) and weigh them by likelihood (a Gaussian sum).

    One linear filter cannot start with a heading sd of 100 deg, many that start 20 or 30 deg apart can, one of which
    is near enough. Give each a heading prior of about their spacing. They differ once the vehicle accelerates.
    """
    info = jax.vmap(run, (None, None, 0, None))(filt, params, navs, epochs)
    nll = jnp.sum(jax.vmap(jax.vmap(negative_log_likelihood))(info), axis=1)
    score = jnp.where(info.ok[:, -1], -nll, -jnp.inf)
    return Bank(info, jnp.exp(score - logsumexp(score)), jnp.argmax(score))


def with_headings(nav: Nav, headings: np.ndarray) -> Nav:
    """A level start (local level frame) turned to each heading (B,), rad: Nav with a leading axis B."""
    roll_pitch = rotations.to_rph(rotations.to_dcm(nav.q))[:2]

    def turned(heading):
        rph = jnp.concatenate([roll_pitch, heading[None]])
        return nav._replace(q=rotations.from_dcm(rotations.from_rph(rph)))

    return jax.vmap(turned)(jnp.asarray(headings, float))
