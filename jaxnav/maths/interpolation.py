"""Linear interpolation of columns on the host, and their integrals."""

import numpy as np


def columns_at(t: np.ndarray, times: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Interpolate columns linearly; beyond the ends they are held.

    Args:
        t: (K,) times that are asked for.
        times: (N,) increasing, of the same unit.
        values: (N, a).

    Returns:
        (K, a), in the unit of ``values``.
    """
    return np.stack([np.interp(t, times, column) for column in values.T], 1)


def running(t: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the integral (K, c) of values (K, c) at times t (K,) from the first time on, by trapezoids."""
    from scipy.integrate import cumulative_trapezoid  # here: slow to import

    return np.asarray(cumulative_trapezoid(values, t, axis=0, initial=0))
