"""Piecewise polynomials: made on the host by scipy, evaluated in jax."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.interpolate import BSpline, PPoly


class Spline(NamedTuple):
    """A spline of K pieces and degree d with c components."""

    knots: np.ndarray  # (K,) start of every piece
    coefficients: np.ndarray  # (K, d + 1, c) highest power first
    stop: float  # end of the last piece

    def __call__(self, t: jax.Array) -> jax.Array:
        """Values (c,) at one time; outside, the first and the last are held."""
        t = jnp.clip(t, self.knots[0], self.stop)
        i = jnp.maximum(jnp.searchsorted(jnp.asarray(self.knots), t, side="right") - 1, 0)
        row, u = jnp.asarray(self.coefficients)[i], t - jnp.asarray(self.knots)[i]
        value = row[0]
        for k in range(1, row.shape[0]):
            value = value * u + row[k]
        return value


def from_scipy(spline: BSpline) -> Spline:
    """A scipy B-spline with values (c,) as a table of polynomials."""
    pieces = PPoly.from_spline(spline)
    real = np.diff(pieces.x) > 0  # repeated knots at the ends are no pieces
    c = pieces.c.reshape(*pieces.c.shape[:2], -1)[:, real]
    return Spline(pieces.x[:-1][real], np.moveaxis(c, 1, 0), float(pieces.x[1:][real][-1]))
