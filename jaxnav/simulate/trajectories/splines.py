"""Piecewise polynomials: made on the host by scipy, evaluated in jax."""

import math
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

if TYPE_CHECKING:  # a seventh of a second that a command without a route need not wait for
    from scipy.interpolate import BSpline


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


def from_scipy(spline: "BSpline") -> Spline:
    """Return a scipy B-spline with values (c,) or () as a table of Taylor polynomials at the start of every piece."""
    inner = np.unique(spline.t[spline.k : spline.c.shape[0] + 1])
    starts = inner[:-1]
    taylor = [spline.derivative(d)(starts) / math.factorial(d) for d in range(spline.k, 0, -1)] + [spline(starts)]
    return Spline(starts, np.stack([a.reshape(starts.size, -1) for a in taylor], 1), float(inner[-1]))
