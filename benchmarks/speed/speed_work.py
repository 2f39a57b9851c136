"""The workload of the speed benchmark, the forms that are compared on it, and how they are timed.

A drive in town at 100 Hz with a fix of position and velocity every second. The filter takes biases as random walks:
as all rivals do.
"""

import statistics
import time
from collections.abc import Callable
from functools import cache, lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.speed import speed_plain
from benchmarks.speed.speed_plain import Noise
from jaxnav.filters.catalogue import build
from jaxnav.filters.core import Filter
from jaxnav.filters.run import initial_nav, prepare, run
from jaxnav.simulate.scenarios import Scenario
from jaxnav.simulate.simulation import Simulated, matched_params, simulate
from jaxnav.states.table import BIASES
from jaxnav.types import Epoch, Fix, Imu, Info, Nav, Params
from tuning.fit.objectives import innovation_nll

RATE = 100  # Hz
TURN, LONG, PAUSE = 0.1, 1.0, 0.01  # s, see `turn`
SIDE, TURNS = 256, 64  # runs side by side, at most; of larger batches, in turns
SEED, DISTINCT = 0, 8  # batches repeat so many runs, or one where it is long: cost does not depend on the numbers
SCENARIO = Scenario("speed", duration_s=60.0, imu_rate_hz=float(RATE))
PARAMS: Callable[[], Params] = cache(lambda: matched_params(SCENARIO))


BESIDES = {24: ("gyro_scale", "accel_scale", "lever_arm_error")}
"""States beyond the two biases, by how many there are in all."""


class Form(NamedTuple):
    """One way to write the filter: of a number of states, functions of (noise, nav, epochs)."""

    label: str
    forward: Callable[[int], Callable]  # n -> the solution of one run
    loss: Callable[[int], Callable]  # n -> its innovation NLL
    ours: bool = False
    ready: Callable[[int], Filter] | None = None  # n -> the filter that its epochs are prepared for, if they are


def forward(filt: Filter) -> Callable[[Noise, Nav, Epoch], Info]:
    """One run of a filter of the package, with the noise as an argument."""
    states = filt.params().states | PARAMS().states
    params = PARAMS()._replace(states={name: states[name] for name in (*BIASES, *filt.model.states)})
    return lambda noise, nav, epochs: run(filt, speed_plain.with_noise(params, noise), nav, epochs)


def solution(filt: Filter) -> Callable[[Noise, Nav, Epoch], speed_plain.Solution]:
    """Result of the plain forms."""

    def call(noise: Noise, nav: Nav, epochs: Epoch) -> speed_plain.Solution:
        info = forward(filt)(noise, nav, epochs)
        return speed_plain.Solution(info.nav.pos, info.nav.vel, info.nu, info.S)

    return call


def likelihood(filt: Filter) -> Callable[[Noise, Nav, Epoch], jax.Array]:
    """Innovation NLL of one run."""
    one = forward(filt)
    return lambda noise, nav, epochs: innovation_nll(one(noise, nav, epochs), jnp.ones(epochs.fix.valid.shape[0], bool))


def _ours(label: str, prepared: bool = False, **options: Any) -> Form:
    make = lambda n: build(f"ekf{min(n, 15)}", states=BESIDES.get(n, ()), **options)
    return Form(label, lambda n: solution(make(n)), lambda n: likelihood(make(n)), True, make if prepared else None)


def _nested(label: str, checkpoint: bool = False, order: int = 2) -> Form:
    make = lambda n: speed_plain.nested(n, PARAMS(), checkpoint, order)
    return Form(label, make, lambda n: speed_plain.likelihood(make(n)))


NAIVE = Form("naive scan", lambda n: speed_plain.naive(n, PARAMS()), lambda n: None)
NESTED, CHECKPOINT = _nested("nested scan"), _nested("nested, checkpoint", True)
FIRST, FIRST_CHECKPOINT = _nested("first order", order=1), _nested("first order, checkpoint", True, 1)
VARIANTS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("stride 1", {"cov_stride": 1}),
    ("stride 10", {"cov_stride": 10}),
    ("stride 10, prepared", {"cov_stride": 10, "prepared": True}),
)
"""Ours: label and options of `build`. Prepared: the state-free part was summed up before, and is not timed again."""
OURS = tuple(_ours(label, **options) for label, options in VARIANTS)


# ---------------------------------------------------------------------------- data


@lru_cache(maxsize=4)
def drives(seconds: int) -> Simulated:
    """The runs of all batches, fields (runs, ...)."""
    keys = jax.random.split(jax.random.key(SEED), DISTINCT if seconds <= 60 else 1)
    scenario = SCENARIO._replace(duration_s=float(seconds))
    return jax.jit(jax.vmap(partial(simulate, scenario=scenario)))(keys)


@lru_cache(maxsize=4)
def arguments(seconds: int, runs: int) -> tuple[Noise, Nav, Epoch]:
    """Arguments of a form; fields (runs, ...), or of one run without that axis."""
    some = drives(seconds)
    take = 0 if runs == 1 else np.arange(runs) % some.hidden.shape[0]
    return speed_plain.noise_of(PARAMS()), *jax.tree.map(lambda a: a[take], (some.initial, some.epochs))


def still(seconds: int, runs: int) -> tuple[Noise, Nav, Epoch]:
    """The same shapes at rest and free of errors, made without the simulator, which takes long to compile."""
    shape = (seconds, RATE) if runs == 1 else (runs, seconds, RATE)
    side = lambda value, *s: np.broadcast_to(np.asarray(value), s)
    lead, lla = shape[:-1], (0.8, 0.3, 200.0)
    imu = Imu(side(1 / RATE, *shape), side(np.zeros(3), *shape, 3), side([0.0, 0.0, -9.81], *shape, 3))
    fix = Fix(side([*lla, 0.0, 0.0, 0.0], *lead, 6), side([2.0] * 3 + [0.1] * 3, *lead, 6), side(0.0, *lead, 6),
              side(True, *lead, 6))  # fmt: skip
    nav = jax.tree.map(lambda a: side(a, *lead[:-1], *a.shape), initial_nav(lla))
    return speed_plain.noise_of(PARAMS()), *jax.tree.map(jnp.asarray, (nav, Epoch(imu, fix)))


# ---------------------------------------------------------------------------- timing


Rounds = dict[str, list[float]]  # seconds of each call, one of every round


class Executable(NamedTuple):
    """A form, compiled for some arguments and ready to be called with them."""

    call: Callable[[], Any]
    seconds: float  # processor time of tracing and compiling
    temp: int  # bytes of temporary memory, as the compiler says


def release() -> None:
    """Drop compiled programs: a process can map only so many functions, fewer than all tables need."""
    executable.cache_clear()
    jax.clear_caches()


def over_runs(one: Callable, runs: int) -> Callable:
    """Of a function of one run (noise, nav, epochs) that of a batch; the function itself where a run is alone.

    Not more than `SIDE` runs go side by side, for with more their states leave the processor's cache; of more, `TURNS`
    at a time, for processors share the next cache and two of them with more runs each are in each other's way.
    """
    if runs == 1:
        return one
    if runs <= SIDE:
        return jax.vmap(one, (None, 0, 0))
    return lambda noise, *given: jax.lax.map(lambda run: one(noise, *run), given, batch_size=TURNS)


def slope(loss: Callable, runs: int) -> Callable:
    """Value and gradient in the noise of a likelihood, its mean over a batch."""
    return jax.value_and_grad(lambda *arguments: jnp.mean(over_runs(loss, runs)(*arguments)))


def inputs(form: Form, n: int, noise: Noise, nav: Nav, epochs: Epoch) -> tuple[Noise, Nav, Epoch]:
    """Arguments of the form from a run's data."""
    return noise, nav, epochs if form.ready is None else prepare(form.ready(n), epochs)


@cache
def executable(form: Form, n: int, seconds: int, runs: int, gradient: bool = False) -> Executable:
    """The form for these sizes, or its gradient; not run yet."""
    function = slope(form.loss(n), runs) if gradient else over_runs(form.forward(n), runs)
    given = inputs(form, n, *arguments(seconds, runs))
    start = time.process_time()
    compiled = jax.jit(function).lower(*given).compile()
    taken = time.process_time() - start
    return Executable(partial(compiled, *given), taken, compiled.memory_analysis().temp_size_in_bytes)


def settled() -> float:
    """Processor seconds of this process once it rests: garbage of a call is collected after its result."""
    now = time.process_time()
    for _ in range(100):
        time.sleep(PAUSE)
        before, now = now, time.process_time()
        if now - before < 0.1 * PAUSE:
            break
    return now


def turn(call: Callable[[], Any]) -> float:
    """Processor seconds of a call, repeated for `TURN` seconds at least.

    Unless a call takes `LONG`, one that is not counted goes ahead: after a rival's it takes up to ten times as long.
    The turn ends when the process rests, so that garbage of a call counts for it.
    """
    for counted in (False, True):
        start, done = time.process_time(), 0
        while not done or (counted and time.process_time() - start < TURN):
            jax.block_until_ready(call())
            done += 1
        spent = (settled() - start) / done
        if spent > LONG:
            break
    return spent


def interleaved(calls: dict[str, Callable[[], Any]], repeats: int) -> Rounds:
    """Processor seconds of each call, round by round; they take turns, so that a change of speed hits all alike."""
    taken: Rounds = {name: [] for name in calls}
    for _ in range(repeats):
        for name, call in calls.items():
            taken[name].append(turn(call))
    return taken


def quotient(a: list[float], b: list[float]) -> float:
    """Median over the rounds of a / b: a machine that now runs at full speed and now at half favours neither."""
    return statistics.median(x / y for x, y in zip(a, b, strict=True))


def exponent(size: Any, cost: Any) -> float:
    """The p of cost ~ size^p, by least squares in logarithms."""
    return float(np.polyfit(np.log(size), np.log(cost), 1)[0])


def metres(lla: Any, reference: Any) -> np.ndarray:
    """East, north and up in m from a near reference, (..., 3), of positions (..., 3) rad and m."""
    d, lat = np.asarray(lla) - np.asarray(reference), np.asarray(reference)[..., 0]
    return np.stack([d[..., 1] * 6.38e6 * np.cos(lat), d[..., 0] * 6.37e6, d[..., 2]], -1)


def distance(lla: Any, reference: Any) -> float:
    """The largest distance between positions (E, 3), m."""
    return float(np.linalg.norm(metres(lla, reference), axis=-1).max())


def rms(lla: Any, reference: Any) -> list[float]:
    """Root mean square error of positions (E, 3) in m: east, north, up."""
    return np.sqrt(np.mean(metres(lla, reference) ** 2, axis=0)).tolist()


def table(taken: Rounds, steps: dict[str, int] | int, to: str) -> dict[str, dict]:
    """Rows of a table: microseconds per IMU sample and run, and the ratio to one of them, less being faster.

    Both are medians over the rounds, the ratio that of values of the same round.
    """
    each = lambda name: steps if isinstance(steps, int) else steps[name]
    us = {name: [1e6 * s / each(name) for s in seconds] for name, seconds in taken.items()}
    return {
        name: {"us_per_step": statistics.median(v), "ratio_to": to, "ratio": quotient(v, us[to])}
        for name, v in us.items()
    }
