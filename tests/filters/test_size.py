"""Size of a compiled epoch in equations of its jaxpr: what a user waits for is XLA, and its work goes with them."""

from collections import Counter
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav import build, initial_nav
from jaxnav.filters.core import Filter
from jaxnav.filters.run import negative_log_likelihood, prepare, run
from jaxnav.types import Epoch, Fix, Imu, Nav

SAMPLES, EPOCHS = 100, 2
MAX_FORWARD, MAX_GRADIENT = 3900, 11_500  # equations of ekf15 at a stride of 10


def epochs_of(filt: Filter) -> tuple[Nav, Epoch]:
    """Return a start and two epochs of a vehicle that hovers."""
    m = filt.model.n_channels
    side = lambda value, *shape: jnp.broadcast_to(jnp.asarray(value, float), shape)
    imu = Imu(side(0.01, EPOCHS, SAMPLES), side(0.01, EPOCHS, SAMPLES, 3), side([0, 0, -9.8], EPOCHS, SAMPLES, 3))
    fix = Fix(side(0.1, EPOCHS, m), side(1.0, EPOCHS, m), side(0.0, EPOCHS, m), jnp.ones((EPOCHS, m), bool))
    return initial_nav([0.5, 0.2, 10.0]), Epoch(imu, fix)


def counted(jaxpr: Any, into: Counter, around: str = "") -> Counter:
    """Count the equations of a jaxpr by the innermost function of the package; nested ones once, calls not."""
    for eqn in jaxpr.eqns:
        inner = [p for p in jax.tree.leaves(list(eqn.params.values())) if hasattr(p, "eqns") or hasattr(p, "jaxpr")]
        for each in inner:
            counted(getattr(each, "jaxpr", each), into, place(eqn) or around)
        if not inner:
            into[place(eqn) or around] += 1
    return into


def place(eqn: Any) -> str:
    """Return file and function that an equation stands in, nothing where jax traced it before."""
    for frame in eqn.source_info.traceback.frames:
        if "/jaxnav/" in frame.file_name:
            return f"{frame.file_name.rsplit('/jaxnav/', 1)[1]} {frame.function_name}"
    return ""


@cache
def sizes(name: str = "ekf15", stride: int = 10, **options: Any) -> tuple[Counter, Counter]:
    """Return the equations of an epoch and of the gradient of a run's likelihood by all parameters."""
    filt = build(name, cov_stride=stride, **options)
    params = filt.params("consumer")
    nav, epochs = epochs_of(filt)
    epochs = prepare(filt, epochs)
    one = jax.tree.map(lambda a: a[0], epochs)
    state = filt.init(params, nav)
    forward = jax.make_jaxpr(filt.step)(params, state, one)
    loss = lambda params: jax.vmap(negative_log_likelihood)(run(filt, params, nav, epochs)).sum()
    gradient = jax.make_jaxpr(jax.grad(loss))(params)
    return counted(forward.jaxpr, Counter()), counted(gradient.jaxpr, Counter())


def table(forward: Counter, gradient: Counter, rows: int = 45) -> str:
    """Return the functions with the most equations, forward and in the gradient."""
    lines = [f"{'all':60s} {forward.total():6d} {gradient.total():6d}"]
    names = sorted({*forward, *gradient}, key=lambda n: -(3 * forward[n] + gradient[n]))[:rows]
    return "\n".join(lines + [f"{name:60s} {forward[name]:6d} {gradient[name]:6d}" for name in names])


def test_an_epoch_and_its_gradient_stay_small():
    """The table by function shows where a growth comes from."""
    forward, gradient = sizes()
    print(table(forward, gradient))
    assert forward.total() <= MAX_FORWARD and gradient.total() <= MAX_GRADIENT, table(forward, gradient)
    assert np.isfinite(forward.total())
