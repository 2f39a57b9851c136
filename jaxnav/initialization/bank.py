"""Unknown heading: starts that are turned to different headings, run side by side and weighed by likelihood."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import logsumexp
from scipy.special import softmax

from jaxnav.filters.core import Filter
from jaxnav.filters.lanes import lanes, ready, repeated, taken
from jaxnav.filters.programs import stored
from jaxnav.filters.run import in_chunks, negative_log_likelihood, run
from jaxnav.filters.scores import innovation_nll
from jaxnav.maths import earth, rotations
from jaxnav.types import Epoch, Info, Nav, Params


class Bank(NamedTuple):
    """Filters that started with different headings."""

    info: Info  # (B, E, ...)
    probability: jax.Array  # (B,) of each heading, given all innovations of the span
    best: jax.Array  # () index of the most probable


def heading_bank(filt: Filter, params: Params, navs: Nav, epochs: Epoch) -> Bank:
    """Run the filter from each of several headings and weigh the runs by likelihood (a Gaussian sum).

    One linear filter cannot start with a heading sd of 100 deg, many that start 20 or 30 deg from each other can:
    one of them is near enough. Their fits differ once the vehicle accelerates.

    Args:
        filt: the filter.
        params: its parameters, with a heading prior of about the spacing of the headings.
        navs: (B, ...) initial navigation of each heading.
        epochs: (E, ...) of one run.

    Returns:
        The runs with their probabilities.
    """
    info = jax.vmap(run, (None, None, 0, None))(filt, params, navs, epochs)
    score = jax.vmap(_score)(info)
    return Bank(info, jnp.exp(score - logsumexp(score)), jnp.argmax(score))


def with_headings(nav: Nav, headings: np.ndarray, arm: Any = None) -> Nav:
    """Return initial navigation with each of several headings, (B, ...).

    Args:
        nav: initial navigation in local level.
        headings: (B,) rad from north, clockwise.
        arm: (3,) m, IMU -> antenna, body FRD, where ``nav`` is at the antenna: the IMUs are then around it.
    """
    return _turned(nav, jnp.asarray(headings, float), jnp.zeros(3) if arm is None else jnp.asarray(arm, float))


@stored
def _turned(nav: Nav, headings: jax.Array, arm: jax.Array) -> Nav:
    roll_pitch = rotations.to_rph(rotations.to_dcm(nav.q))[:2]

    def one(heading: jax.Array) -> Nav:
        C = rotations.from_rph(jnp.concatenate([roll_pitch, heading[None]]))
        return nav._replace(q=rotations.from_dcm(C), pos=earth.move(nav.pos, -C @ arm))

    return jax.vmap(one)(headings)


bank_jit = stored(heading_bank, (0,))
"""`heading_bank`, compiled once for a filter and shapes."""


LOST = 1e-12  # of the most probable's, the probability below which a heading is given up in a long run


def most_probable_start(filt: Filter, params: Params, navs: Nav, epochs: Epoch) -> tuple[int, float]:
    """Return the most probable of several starts and its probability, in memory that does not grow with the run.

    The runs go side by side, `jaxnav.filters.run.CHUNK` epochs at a time, by the program that filters the recording;
    those of headings that are `LOST` end there.

    Args:
        filt: the filter.
        params: its parameters.
        navs: (B, ...) starts.
        epochs: (E, ...) of one run, on the host.
    """
    starts = navs.t.shape[0]
    score, running = np.zeros(starts), list(range(starts))
    runs = [in_chunks(filt, params, jax.tree.map(lambda a, i=i: a[i], navs), epochs) for i in range(starts)]
    while len(running) > 1:
        parts = [next(runs[i], None) for i in running]
        if parts[0] is None:
            break
        score[running] += [float(_score(info)) for info in parts]
        score[score < score.max() + np.log(LOST)] = -np.inf
        running = [i for i in running if np.isfinite(score[i])] or running
    best = int(np.argmax(score))
    return best, float(softmax(score)[best]) if np.isfinite(score[best]) else 1.0 / starts


@stored
def _score(info: Info) -> jax.Array:
    """Return the log-likelihood of the innovations of a run (E, ...), -inf of one that is not finite."""
    return jnp.where(info.ok[-1], -jax.vmap(negative_log_likelihood)(info).sum(), -jnp.inf)


def most_probable(filt: Filter, params: Params, navs: Nav, epochs: Epoch) -> Nav:
    """Return of several starts ``navs`` (B, ...) the one that the innovations of ``epochs`` (E, ...) speak for."""
    count, first = navs.t.shape[0], taken(navs, 0)
    if count == 1:
        return first
    prepared = ready(filt, params, first, epochs)
    valid = np.broadcast_to(prepared.fix.valid, (count, *prepared.fix.valid.shape))
    record = lanes(filt, repeated(params, count), navs, prepared, valid)
    return taken(navs, int(np.argmin(innovation_nll(record, heavy=False).sum(1))))
