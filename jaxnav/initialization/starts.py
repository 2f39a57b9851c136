"""A run from one of several starts: the most probable one, by programs that recordings share."""

import math
from functools import partial
from typing import NamedTuple

import jax
import numpy as np

from jaxnav.filters import epochs as ep
from jaxnav.filters.compiler import require_memory
from jaxnav.filters.core import Filter
from jaxnav.filters.run import CHUNK, in_chunks, joined, run_in_chunks
from jaxnav.initialization.bank import bank_jit, most_probable_start
from jaxnav.initialization.parked import spread_again
from jaxnav.types import Epoch, Info, Nav, Params


class Chosen(NamedTuple):
    """The start that was taken, of several."""

    best: int = 0
    heading_deg: float = math.nan  # nan where there was one
    probability: float = 1.0


def execute(filt: Filter, params: Params, navs: Nav, epochs: Epoch, parked: int = 0) -> tuple[Info, Chosen]:
    """Run from ``navs``; of several starts the most probable one.

    Epochs are padded to sizes that recordings share, or cut into such, so that the compiled program is found again.

    Args:
        filt: the filter.
        params: its parameters.
        navs: (B, ...) starts.
        epochs: (E, ...) of the recording.
        parked: epochs before the vehicle moves off; headings of several starts are spread once more there.

    Returns:
        The run (E, ...), and the start that was taken.
    """
    E, K = epochs.imu.dt.shape
    n, m = filt.model.n_states, filt.model.n_channels
    starts = navs.t.shape[0]
    whole = starts if E <= CHUNK else 1  # runs that are kept
    require_memory(
        8.0 * E * (whole * (2 * n**2 + 2 * m**2 + 100) + 14 * K), f"a run of {E:,} epochs from {starts} starts"
    )
    at = lambda i, navs: jax.tree.map(lambda a: a[i], navs)
    if starts == 1:
        return run_in_chunks(filt, params, at(0, navs), epochs), Chosen()
    size = ep.bucket_size(E), ep.bucket_size(K)  # of a part of the run as well: one program
    from_best = _best_of_long if E > CHUNK else partial(_best_of_short, size)
    best, probability, info = from_best(filt, params, navs, epochs)
    again = spread_again(filt, params, at(slice(parked), info), starts) if 1 < parked < E else None
    if again is None:
        return info, Chosen(best, 360.0 * best / starts, probability)
    second, probability, later = from_best(filt, *again, jax.tree.map(lambda a: a[parked:], epochs))
    best = (best + second) % starts  # the hypothesis that had that heading when it moved off
    about = Chosen(best, 360.0 * best / starts, probability)
    return jax.tree.map(lambda a, b: np.concatenate([a[:parked], b]), info, later), about


def _best_of_short(
    size: tuple[int, int], filt: Filter, params: Params, navs: Nav, epochs: Epoch
) -> tuple[int, float, Info]:
    """Return the most probable start, its probability and its run (E, ...), by one program for all starts."""
    E = epochs.imu.dt.shape[0]
    bank = jax.device_get(bank_jit(filt, params, navs, ep.pad_epochs(epochs, *size)))
    best = int(bank.best)
    return best, float(bank.probability[best]), jax.tree.map(lambda a: a[best][:E], bank.info)


def _best_of_long(filt: Filter, params: Params, navs: Nav, epochs: Epoch) -> tuple[int, float, Info]:
    """Return the same of a long run: one run at a time, of which one is kept."""
    best, probability = most_probable_start(filt, params, navs, epochs)
    nav = jax.tree.map(lambda a: a[best], navs)
    return best, probability, joined(in_chunks(filt, params, nav, epochs), epochs.imu.dt.shape[0])
