"""The Kalman filter's rule: with the error models of this package, an extended Kalman filter."""

from functools import cache

from jaxnav.filters.rule import Correction, Innovation, Rule
from jaxnav.maths import linalg
from jaxnav.types import Tree


def correct(theta: Tree, memory: Tree, z: Innovation) -> Correction:
    """Optimal gain, Joseph form; no parameters."""
    K, P = linalg.update(z.P, z.H, z.R, z.inverse)
    return Correction(K @ z.nu, P, memory, z.valid)


@cache
def kalman() -> Rule:
    """Without memory."""
    return Rule(lambda n, m: (), correct, supports_smoothing=True)
