"""Run a filter over epochs: one nested scan, pure, to be jitted, vmapped and differentiated."""

import itertools
from collections.abc import Callable, Iterator
from functools import cache, partial
from typing import Any, Protocol

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from scipy.special import gammaln

from jaxnav.filters.core import Filter, FilterState, Step
from jaxnav.filters.epochs import bucket_size, pad_epochs, pad_to_bucket
from jaxnav.filters.parameters import UNITS, datasheet_params, get, has
from jaxnav.filters.programs import stored
from jaxnav.maths import linalg, rotations
from jaxnav.states.table import STATES
from jaxnav.types import DataError, Epoch, Imu, Info, Nav, Origin, Params, Track, Tree

FREEDOM = 4.0  # of the Student t that stands for outliers in a likelihood


def require_x64(*trees: Any) -> None:
    """Refuse float32: latitude in float32 steps by 0.4 m.

    Args:
        *trees: parameters, navigation, epochs.

    Raises:
        DataError: some leaf is a float of less than 64 bits.
    """
    for leaf in jax.tree.leaves(trees):
        dtype = jnp.result_type(leaf)
        if jnp.issubdtype(dtype, jnp.floating) and dtype != jnp.float64:
            raise DataError(f"positions need float64, got {dtype}: call jaxnav.enable_x64() before anything else")


def require_shapes(filt: Filter, nav: Nav, epochs: Epoch) -> None:
    """Refuse a start and epochs that are not those of one run of this filter, before an error from inside a scan.

    Raises:
        ValueError: names the field.
    """
    imu, fix, m = epochs.imu, epochs.fix, filt.model.n_channels
    E = jnp.shape(fix.valid)[0] if jnp.ndim(fix.valid) else 0
    if missing := set(filt.model.reads) - set(epochs.auxiliary):
        raise ValueError(f"epochs.auxiliary has no {', '.join(sorted(missing))}, which states of the filter read")
    expected: dict[str, tuple[Any, tuple[Any, ...]]] = {
        "nav.pos": (nav.pos, (3,)),
        "nav.vel": (nav.vel, (3,)),
        "nav.q": (nav.q, (4,)),
    }
    channels = {name: leaf for name, leaf in fix._asdict().items() if name != "auxiliary"}
    expected |= {f"epochs.fix.{name}": (leaf, (E, m)) for name, leaf in channels.items()}
    for name, size, values in filt.model.auxiliary:
        expected[f"epochs.fix.auxiliary[{name!r}]"] = (fix.auxiliary.get(name, np.zeros(0)), (E, size, values))
    expected |= {f"epochs.auxiliary.{name}": (leaf, (E,)) for name, leaf in epochs.auxiliary.items()}
    if isinstance(imu, Imu):
        sizes = {"dt": (E, None), "gyro": (E, None, 3), "accel": (E, None, 3)}
        expected |= {f"epochs.imu.{name}": (getattr(imu, name), size) for name, size in sizes.items()}
    for name, (leaf, shape) in expected.items():
        try:
            chex.assert_shape(leaf, shape)
        except AssertionError as error:
            of = f"{E} epochs of a filter with the {m} channels of {', '.join(filt.model.measurements)}"
            found = f"{name} has shape {jnp.shape(leaf)}, expected {shape}"
            raise ValueError(f"{found}: {of}; of many runs, vmap") from error
    try:
        chex.assert_type(fix.valid, bool)
    except AssertionError as error:
        raise ValueError(f"epochs.fix.valid must be bool, got {fix.valid.dtype}") from error


def require_params(filt: Filter, params: Params) -> None:
    """Refuse parameters that are not this filter's, before they end in an error from inside a trace.

    States and measurements that the filter lacks are allowed: parameters of a larger filter fit a smaller one.

    Args:
        filt: the filter.
        params: parameters of one run; the shape of a leaf is that of ``filt.params()``, or () for all axes, or as
            `jaxnav.types.Noise` and `StateParams` have it.

    Raises:
        ValueError: fields that are missing, of another type or shape, and the call that makes the right ones.
    """
    if not isinstance(params, Params):
        raise ValueError(f"params is {type(params).__name__}, expected jaxnav.Params: {_MAKE}")
    if missing := _missing(filt, params):
        raise ValueError(f"params has no {', '.join(missing)}, which the filter takes: {_MAKE}")
    expected = _expected(filt.params)
    known = ("rule", "adapter") if filt.name else ("adapter",)  # of a rule in place of the filter's nothing is known
    for part in known if expected is not None else ():
        given, taken = getattr(params, part), getattr(expected, part)
        try:
            chex.assert_trees_all_equal_structs(given, taken)
        except AssertionError as error:
            raise ValueError(f"params.{part} is {_kind(given)}, the filter takes {_kind(taken)}: {_MAKE}") from error
    fitting = Params(
        params.noise,
        params.prior._replace(correlated=None),
        {name: params.states[name] for name in filt.model.states},
        {name: params.measurements[name] for name in filt.model.measurements},
        params.mounting,
        params.rule,
        adapter=params.adapter,
    )
    for path, leaf in jax.tree_util.tree_flatten_with_path(fitting)[0]:
        name = jax.tree_util.keystr(path, simple=True, separator=".")
        shapes = _shapes(expected, name)
        if shapes and jnp.shape(leaf) not in shapes:
            raise ValueError(f"params.{name} has shape {jnp.shape(leaf)}, expected {' or '.join(map(str, shapes))}")


_MAKE = 'filt.params("consumer") makes those of the filter'


@cache
def _expected(make: Callable[..., Params]) -> Params | None:
    """Return shapes of the parameters of a filter of the catalogue; None for a rule of unknown parameters."""
    return None if make is datasheet_params else jax.eval_shape(make)


def _missing(filt: Filter, params: Params) -> list[str]:
    """Names of states and measurements that the filter has and ``params`` has not."""
    groups = (
        ("states", filt.model.states, params.states),
        ("measurements", filt.model.measurements, params.measurements),
    )
    return [f"{group}[{name!r}]" for group, names, has in groups for name in names if name not in has]


def _kind(theta: Tree) -> str:
    """Return the type of parameters of a rule or an adapter, and its fields."""
    fields = ", ".join(getattr(theta, "_fields", theta if isinstance(theta, dict) else ()))
    return f"{type(theta).__name__}({fields})"


def _shapes(expected: Params | None, name: str) -> list[tuple[int, ...]]:
    """Shapes that the leaf of a dotted name may have; empty where nothing is known of it."""
    group, *rest = name.split(".")
    if group in ("noise", "prior"):
        return [(), (3,)] + [(3, 3)] * (group == "noise")
    if group == "states":
        size = STATES[rest[0]].size if rest[0] in STATES else None
        return [(), (size,)] + [(size, size)] * (rest[1] == "driving_noise") if size else []
    if group == "mounting":
        return [UNITS[name].shape]
    if expected is None or not has(expected, name):
        return []
    root = [(3, 3)] * (name in UNITS and UNITS[name].root)
    one = [()] * (group != "adapter")
    return list(dict.fromkeys([*one, jnp.shape(get(expected, name)), *root]))


@partial(stored, static_argnums=(0,))
def prepare(filt: Filter, epochs: Epoch) -> Epoch:
    """Compute the state-free part of epochs, once for many runs of a filter.

    In local level, at a stride of 2 to 10, that is most of the work at every sample; then biases enter in first
    order (`jaxnav.strapdown.fast.local_level.preintegrate`).

    Args:
        filt: the filter; only filters of the same stride and history take the result.
        epochs: of one run (E, ...) or many (B, E, ...).
    """
    return filt.prepare(epochs) if epochs.fix.valid.ndim == 2 else jax.vmap(filt.prepare)(epochs)


class Record(Protocol):
    """Record of an epoch, made during a run."""

    def __call__(self, step: Step, along: Tree, /) -> Any:
        """Return a pytree of the epoch; ``along`` is the epoch's element of the argument of that name of `run`."""

    def __hash__(self) -> int: ...


def keep_info(step: Step, along: Tree) -> Info:
    """Return the record of a plain run."""
    return step.info


def run(
    filt: Filter,
    params: Params,
    nav: Nav,
    epochs: Epoch,
    record: Record = keep_info,
    along: Tree = None,
) -> Any:
    """Filter all epochs of one run.

    Rematerialised per epoch: a gradient keeps one state an epoch instead of every sample's.

    Args:
        filt: the filter.
        params: its parameters.
        nav: navigation at the start, local level.
        epochs: fields (E, ...), as they come or by `prepare`.
        record: makes the record of each epoch.
        along: arrays (E, ...); ``record`` gets each epoch's element, such as the truth.

    Returns:
        The records, with a leading axis E: `Info` by default.

    Raises:
        DataError: float32 input (at trace time).
        ValueError: shapes that are not those of one run of this filter, or epochs that were prepared for a filter with
            another stride or history (at trace time).
    """
    require_x64(params, nav, epochs)
    require_params(filt, params)
    require_shapes(filt, nav, epochs)
    return resume(filt, params, filt.init(params, nav), epochs, record, along)[1]


def resume(
    filt: Filter, params: Params, state: FilterState, epochs: Epoch, record: Record = keep_info, along: Tree = None
) -> tuple[FilterState, Any]:
    """Filter the epochs that follow a state of the filter; arguments are not checked.

    Args:
        filt: the filter.
        params: its parameters.
        state: the state before them.
        epochs: fields (E, ...), as they come or by `prepare`.
        record: makes the record of each epoch.
        along: arrays (E, ...), see `run`.

    Returns:
        The state after them, and the records.
    """

    @jax.checkpoint
    def one(state: FilterState, i: jax.Array) -> tuple[FilterState, Any]:
        # looked up rather than scanned over: a scan under vmap first copies all its data, time to the front
        epoch, extra = jax.tree.map(lambda a: lax.dynamic_index_in_dim(a, i, keepdims=False), (epochs, along))
        step = filt.advance(params, state, epoch)
        return step.after, record(step, extra)

    return lax.scan(one, state, jnp.arange(epochs.fix.sd.shape[0]))


run_jit = stored(run, (0, 4))
"""`run`, compiled once for a filter and shapes."""
CHUNK = 1024  # epochs of one call of the program of `in_chunks`


@partial(stored, static_argnums=(0,))
def _begin(filt: Filter, params: Params, nav: Nav) -> FilterState:
    return filt.init(params, nav)


_resume = stored(resume, (0,))


def in_chunks(filt: Filter, params: Params, nav: Nav, epochs: Epoch) -> Iterator[Info]:
    """Yield the run of `run_in_chunks` by one program: (CHUNK, ...) each, the last one padded."""
    require_x64(params, nav, epochs)
    require_params(filt, params)
    require_shapes(filt, nav, epochs)
    E, K = np.shape(epochs.imu.dt)
    state = _begin(filt, params, nav)
    for i in range(0, E, CHUNK):
        part = pad_epochs(jax.tree.map(lambda a, i=i: a[i : i + CHUNK], epochs), CHUNK, bucket_size(K))
        state, info = _resume(filt, params, state, part)
        yield info


def run_in_chunks(filt: Filter, params: Params, nav: Nav, epochs: Epoch) -> Info:
    """Filter the epochs of one run, however many, by one program in constant memory beyond its arguments and result.

    Args:
        filt: the filter.
        params: its parameters.
        nav: navigation at the start, local level.
        epochs: fields (E, ...) on the host.

    Returns:
        The run (E, ...) on the host, that of `run`.

    Raises:
        DataError, ValueError: as `run`.
    """
    E = np.shape(epochs.imu.dt)[0]
    if E <= CHUNK:
        info = jax.device_get(run_jit(filt, params, nav, pad_to_bucket(epochs)))
        return jax.tree.map(lambda a: a[:E], info)
    return joined(in_chunks(filt, params, nav, epochs), E)


def joined(parts: Iterator[Info], size: int) -> Info:
    """Return the first ``size`` epochs of `in_chunks` on the host; no two copies of them are held at a time."""
    first = next(parts)
    whole = jax.tree.map(lambda a: np.empty((size, *a.shape[1:]), a.dtype), first)
    for i, part in enumerate(itertools.chain([first], parts)):
        rows = np.arange(i * CHUNK, min((i + 1) * CHUNK, size))
        jax.tree.map(lambda into, a, rows=rows: into.__setitem__(rows, np.asarray(a)[: rows.size]), whole, part)
    return whole


def initial_nav(
    lla: Any, vel: Any = (0.0, 0.0, 0.0), rph: Any = (0.0, 0.0, 0.0), t: Any = 0.0, azimuth: Any = 0.0
) -> Nav:
    """Return initial navigation in local level, with sensor errors of zero.

    Frames that do not travel along have their origin there and then.

    Args:
        lla: (3,) latitude rad, longitude rad, height m.
        vel: (3,) m/s, ENU.
        rph: (3,) rad, roll, pitch, heading of FRD against NED.
        t: s.
        azimuth: rad, of the first axis of such a frame, clockwise from north.

    Raises:
        DataError: a position in float32.
    """
    require_x64(lla)
    lla, vel, rph, t, azimuth = (jnp.asarray(v, float) for v in (lla, vel, rph, t, azimuth))
    zero = jnp.zeros(3)
    return Nav(t, lla, vel, _attitude(rph), zero, zero, Origin(lla, azimuth, t), {})


@stored
def _attitude(rph: jax.Array) -> jax.Array:
    return rotations.from_dcm(rotations.from_rph(rph))


@stored
def _angles(q: jax.Array) -> jax.Array:
    return jax.vmap(lambda q: rotations.to_rph(rotations.to_dcm(q)))(q)


def track(nav: Nav) -> Track:
    """Return a local level solution on the host.

    Args:
        nav: (E, ...) navigation in local level.
    """
    return Track(*(np.asarray(a) for a in (nav.t, nav.pos, nav.vel, _angles(nav.q))))


def first_failure(info: Info, t: np.ndarray) -> str | None:
    """Where a run stopped being finite, in words, or None; ``t`` (E,) are the epochs' times."""
    ok = np.asarray(info.ok)
    if ok.all():
        return None
    i = int(np.argmin(ok))
    return f"the filter stopped being finite at t = {t[i]:.3f} s (epoch {i} of {ok.size})"


def negative_log_likelihood(info: Info) -> jax.Array:
    """Return -log N(nu; 0, S) of one epoch's valid channels, (): the truth-free objective of tuning.

    An epoch with a rejected channel is scored by a Student t of the same S and `FREEDOM`: by a Gaussian a
    single outlier would outweigh all accepted fixes, and left out it would reward rejection.
    """
    # missing channels have nu = 0 and an identity row in S: they add nothing
    m = info.valid.sum()
    far = student_nll(info.nis, m, info.valid.shape[-1])
    near = 0.5 * (info.nis + m * jnp.log(2 * jnp.pi))
    return jnp.where((info.valid & ~info.used).any(), far, near) + 0.5 * info.log_det


def gated_nll(info: Info, alone: np.ndarray) -> jax.Array:
    """Return -log of the density of one epoch's innovations, (), where a gate tests channels ``alone`` (m,) bool.

    Each rejected channel is scored by a separate Student t, so that the others keep their weight.
    """
    out = info.valid & ~info.used & alone
    keep = info.valid & ~out
    nu, S = jnp.where(keep, info.nu, 0.0), jnp.where(keep[:, None] & keep, info.S, jnp.eye(keep.size))
    inverse, log_det = linalg.swept(S)
    rest = info._replace(nu=nu, S=S, valid=keep, nis=linalg.normalized(nu, S, inverse), log_det=log_det)
    variance = jnp.diag(info.S)
    single = student_nll(info.nu**2 / variance, jnp.asarray(1), 1) + 0.5 * jnp.log(variance)
    return negative_log_likelihood(rest) + jnp.sum(jnp.where(out, single, 0.0))


def student_nll(nis: jax.Array, m: jax.Array, most: int) -> jax.Array:
    """-log of a Student t of m channels, at most ``most``, and unit scale at a normalised square, ()."""
    return 0.5 * (FREEDOM + m) * jnp.log1p(nis / FREEDOM) + student_constant(m, most)


def student_constant(m: jax.Array, most: int) -> jax.Array:
    """Return minus the log of the constant that makes a Student t of m channels, at most ``most``, a density, ()."""
    n = np.arange(most + 1)
    every = gammaln(0.5 * FREEDOM) - gammaln(0.5 * (FREEDOM + n)) + 0.5 * n * np.log(FREEDOM * np.pi)
    return jnp.asarray(every)[m]
