"""Maxima of functions of many points side by side: boxes of points, and a quadratic fit to the last box."""

from collections.abc import Callable

import numpy as np

SQUARE = np.stack(np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0], indexing="ij"), -1).reshape(9, 2)
CUBE = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3, indexing="ij"), -1).reshape(27, 3)
MAX_BOXES = 5  # of a climb


def climb(box: Callable[[np.ndarray], np.ndarray], centre: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the centre (3,) of a box with the maximum in its middle, or of the last tried, and its points (n, 4)."""
    for _ in range(MAX_BOXES):
        points = box(centre)
        best = points[np.argmax(points[:, 3]), :3]
        if np.allclose(best, centre):
            break
        centre = best
    return centre, points


def vertex(points: np.ndarray, centre: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Return the maximum (3,) of the quadratic fit to a box (n, 4), within it; the best point where there is none."""
    free = steps > 0
    u = (points[:, :3] - centre)[:, free] / steps[free]
    i, j = np.triu_indices(free.sum())
    A = np.column_stack([np.ones(len(u)), u, u[:, i] * u[:, j]])
    if not np.isfinite(points).all():
        return points[np.argmax(points[:, 3]), :3]
    c = np.linalg.lstsq(A, points[:, 3], rcond=None)[0]
    H = np.zeros((free.sum(),) * 2)
    H[i, j] = c[1 + free.sum() :]
    H = H + H.T
    if np.linalg.eigvalsh(H).max() >= 0:
        return points[np.argmax(points[:, 3]), :3]
    found = centre.copy()
    found[free] += steps[free] * np.clip(-np.linalg.solve(H, c[1 : 1 + free.sum()]), -1.0, 1.0)
    return found
