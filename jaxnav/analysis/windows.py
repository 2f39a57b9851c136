"""Hidden windows: how far a filter drifts without fixes that are there, all along a recording."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.filters import epochs as ep
from jaxnav.filters.core import Filter
from jaxnav.filters.programs import stored
from jaxnav.filters.run import run
from jaxnav.measurements import Measurement
from jaxnav.types import Epoch, Info, Nav, Params

RECEIVER_ERROR = "gnss_position_error"  # state that a measured position has more than the true one


class Windows(NamedTuple):
    """W windows in P runs: start < t <= start + length, in which no fix of the receiver is used."""

    hidden: np.ndarray  # (P, E) bool
    phase: np.ndarray  # (W,) int, the run
    start: np.ndarray  # (W,) s
    end: np.ndarray  # (W,) int, the window's last epoch with a position, where the drift is measured
    satellites: int = 0  # the highest ones that a window keeps


def hidden_windows(
    packed: ep.Packed, length: float, every: float, phases: int = 1, settle: float = 30.0, guard: float = 0.0
) -> Windows:
    """Windows of ``length`` s, ``every`` s, from ``settle`` s after the start on; each phase shifted by an equal part.

    ``guard``: s left at the end of the data. Windows without a position to measure the drift by are left out.
    """
    t, there = packed.t, np.asarray(packed.epochs.fix.valid)[:, :2].all(1)
    hidden, phase, begin, end = np.zeros((phases, t.size), bool), [], [], []
    for p in range(phases):
        for start in np.arange(packed.start + settle + p * every / phases, t[-1] - guard - length, every):
            inside = ep.within(t, [(start, start + length)])
            known = np.flatnonzero(inside & there)
            if known.size and t[known[-1]] > start + 0.5 * length:
                hidden[p] |= inside
                phase.append(p)
                begin.append(start)
                end.append(known[-1])
    return Windows(hidden, np.array(phase, int), np.array(begin), np.array(end, int))


def drift(
    filt: Filter, params: Params, nav: Nav, epochs: Epoch, windows: Windows, measurements: tuple[Measurement, ...]
) -> tuple[np.ndarray, Info]:
    """Return the written position minus the fix at each window's end, and the runs.

    Through the measurement model of a position, the first three channels, but without a receiver's error that the
    filter estimates: that is no part of the position that it writes.

    Args:
        filt: the filter.
        params: its parameters.
        nav: the start.
        epochs: (E, ...) of the recording.
        windows: the hidden windows.
        measurements: the filter's, the position first.

    Returns:
        (W, 3) m, ENU, inf where the run failed; and the runs (P, E, ...).
    """
    hide = lambda h: ep.hide(epochs, h, measurements, windows.satellites).fix.valid
    info = phases(filt, params, nav, epochs, jnp.stack([hide(h) for h in windows.hidden]))
    residual = np.asarray(info.residual)[windows.phase, windows.end, :3]
    if RECEIVER_ERROR in info.nav.errors:
        residual = residual - np.asarray(info.nav.errors[RECEIVER_ERROR])[windows.phase, windows.end]
    ok = np.asarray(info.ok)[windows.phase, windows.end]
    return np.where(ok[:, None], residual, np.inf), info


@partial(stored, static_argnums=(0,))
def phases(filt: Filter, params: Params, nav: Nav, epochs: Epoch, valid: jax.Array) -> Any:
    """Return the runs (P, E, ...) with each row of ``valid`` (P, E, m) in place of the fixes' ``valid``."""
    one = lambda v: run(filt, params, nav, epochs._replace(fix=epochs.fix._replace(valid=v)))
    return jax.vmap(one)(valid)


def position_noise(params: Params, sd: jax.Array) -> jax.Array:
    """Return covariances (A, 3, 3) m^2, ENU, of the white noise of positions with stated ``sd`` (A, 3) m."""
    scale = jnp.asarray(params.measurements["position"].scale)
    size = jnp.linalg.norm(scale, axis=-1) if scale.ndim == 2 else jnp.broadcast_to(scale, (3,))
    return jax.vmap(jnp.diag)((size * sd) ** 2)
