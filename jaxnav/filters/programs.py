"""Traced programs on disk: a second process does not trace a function that it finds the program of.

jax's own cache keeps what was compiled (`jaxnav.filters.compiler.cache`), and finds it by the traced program; tracing a
filter takes ten times as long as reading both.
"""

import dataclasses
import functools
import hashlib
import logging
import os
import pickle
import tempfile
import time
import types
from collections.abc import Callable, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import export

from jaxnav.types import Json, Tree

LOG = logging.getLogger("jaxnav")
PACKAGES = ("jaxnav", "tuning")  # whose sources are part of a program's name
SETTINGS = (
    "jax_enable_x64",
    "jax_default_matmul_precision",
    "jax_debug_nans",
    "jax_disable_most_optimizations",
    "jax_numpy_dtype_promotion",
)
"""Settings of jax that a program depends on."""
PLAIN = (type(None), bool, int, float, str)
"""Types whose text is their value."""
OLD_S = 30 * 86_400.0  # programs of other sources that were not used for that long are removed
UNOPTIMIZED = {"xla_backend_optimization_level": 0}
_LOADED: list[dict[Any, Any]] = []  # programs in memory, of each stored function


class NotKept(Exception):
    """Why a function is traced in each process: a static argument without a description, or a step without export."""


class _Home:
    """Folder of the programs; None: none is kept."""

    folder: Path | None = None


def keep_in(folder: Path | None) -> None:
    """Keep programs of `stored` functions in ``folder``, that of one jaxlib and processor; None keeps none."""
    _Home.folder = folder


def clear() -> None:
    """Drop the programs in memory."""
    for programs in _LOADED:
        programs.clear()


def stored(function: Callable[..., Any], static_argnums: Sequence[int] = (), once: bool = False) -> Callable[..., Any]:
    """Return `jax.jit` of a function whose traced program is kept on disk, where `keep_in` has named a folder.

    Under a transformation of jax, with arrays on another device, or with a static argument that has no name (see
    `described`) it is `jax.jit` and nothing else. A constant of a module is that of the sources: who changes one at run
    time turns the cache off.

    Args:
        function: a function of this library.
        static_argnums: places of arguments that are no arrays; they are given by position.
        once: it runs once, so that half of the compilation is worth more than half of the run.
    """
    static, options = frozenset(static_argnums), UNOPTIMIZED if once else None
    plain = jax.jit(function, static_argnums=tuple(static))  # within another: options are the outermost's
    jitted = plain if options is None else jax.jit(function, static_argnums=tuple(static), compiler_options=options)
    programs: dict[Any, Program | None] = {}
    _LOADED.append(programs)

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        moving = [a for i, a in enumerate(args) if i not in static]
        leaves, tree = jax.tree.flatten((moving, kwargs))
        if _Home.folder is None or not all(map(_is_plain, leaves)):
            return jitted(*args, **kwargs)
        key = *(args[i] for i in sorted(static) if i < len(args)), tree, tuple(map(_kind, leaves))
        try:
            program = programs[key]
        except KeyError:  # another thread may drop all programs
            whole = lambda moving, kwargs: plain(*_merged(args, moving, static), **kwargs)
            program = programs[key] = _program(_Home.folder, function, key, whole, leaves, options)
        if program is None:
            return jitted(*args, **kwargs)
        return jax.tree.unflatten(program.tree, list(map(_uncommitted, program.call(*leaves))))

    call.jitted = jitted  # type: ignore[attr-defined]  # for a look at what is compiled
    return call


def _uncommitted(a: jax.Array) -> jax.Array:
    """Return an array of the CPU that is bound to no device, as the results of `jax.jit` are.

    Those of an exported program are bound, and a function that takes bound and free arrays by turns compiles twice.
    """
    return jax.device_put(np.asarray(a)) if a.committed and jax.default_backend() == "cpu" else a


class Program(NamedTuple):
    """A traced program of flat arguments and results."""

    call: Callable[..., list[jax.Array]]
    tree: Tree  # structure of its results


def _merged(args: Sequence[Any], moving: Sequence[Any], static: frozenset[int]) -> list[Any]:
    """Return ``args`` with other values of those that are not static."""
    rest = iter(moving)
    return [a if i in static else next(rest) for i, a in enumerate(args)]


def _program(
    home: Path,
    function: Callable[..., Any],
    key: tuple[Any, ...],
    whole: Callable[..., Any],
    leaves: list[Any],
    options: Json | None,
) -> Program | None:
    """Return the program of a file, or trace it and write the file; None where it cannot be kept."""
    try:
        path = _path(home, function, key)
        exported, out = _load(path) or _save(path, *_traced(whole, key[-2], leaves, function.__name__))
        return Program(jax.jit(exported.call, compiler_options=options), out)
    except NotKept as reason:
        LOG.debug("%s is traced in each process: %s", function.__qualname__, reason)
        return None


def _is_plain(leaf: Any) -> bool:
    """Return whether it is a value on the default device, of a dtype of numpy."""
    if not isinstance(leaf, jax.Array):
        return isinstance(leaf, np.ndarray | np.generic | bool | int | float | complex)
    if isinstance(leaf, jax.core.Tracer):
        return False
    return not jnp.issubdtype(leaf.dtype, jax.dtypes.extended) and leaf.devices() == _default_devices()


@functools.cache
def _default_devices() -> set[Any]:
    return {jax.devices()[0]}


def _kind(leaf: Any) -> tuple[Any, ...]:
    """Return shape, dtype and whether the dtype is weak."""
    return np.shape(leaf), jax.dtypes.canonicalize_dtype(jax.dtypes.result_type(leaf)), _is_weak(leaf)


def _is_weak(leaf: Any) -> bool:
    return bool(getattr(leaf, "weak_type", isinstance(leaf, bool | int | float | complex)))


# ---------------------------------------------------------------------------- files


def _path(home: Path, function: Callable[..., Any], key: tuple[Any, ...]) -> Path:
    """Return the file of a program, whose name is a digest of all that it depends on but jaxlib and the processor.

    Raises:
        NotKept: see `described`.
    """
    *static, tree, kinds = key
    versions = jax.__version__, metadata.version("optax")
    device = jax.default_backend(), jax.device_count(), os.environ.get("XLA_FLAGS", "")
    settings = [jax.config.values.get(name) for name in SETTINGS]
    named = f"{function.__module__}.{function.__qualname__}"
    whole = named, [described(s) for s in static], str(tree), str(kinds), versions, device, settings
    name = hashlib.blake2b(repr(whole).encode(), digest_size=16).hexdigest()
    return home / f"programs-{_sources()}" / name


@functools.cache
def _sources() -> str:
    """Return a digest of the sources of `PACKAGES`."""
    found, home = hashlib.blake2b(digest_size=8), Path(__file__).parents[2]
    for package in PACKAGES:
        for path in sorted((home / package).rglob("*.py")):
            found.update(str(path.relative_to(home)).encode() + path.read_bytes())
    return found.hexdigest()


def _traced(whole: Callable[..., Any], tree: Tree, leaves: list[Any], name: str) -> tuple[export.Exported, Any]:
    """Return the exported program of flat arguments, and the structure of its results.

    Errors of the function itself, such as arguments of a wrong shape, pass through.

    Raises:
        NotKept: it calls back into Python or another program that jax does not export.
    """
    structure = []

    def flat(*leaves: Any) -> list[Any]:
        found, out = jax.tree.flatten(whole(*jax.tree.unflatten(tree, leaves)))
        structure.append(out)
        return found

    flat.__name__ = name
    jitted = jax.jit(flat)
    jitted.trace(*leaves)  # jax keeps it for the export
    try:
        return export.export(jitted)(*leaves), structure[-1]
    except (NotImplementedError, ValueError) as error:  # of the export: those of the function came with the trace
        raise NotKept(str(error)) from error


def _load(path: Path) -> tuple[export.Exported, Any] | None:
    """Return the program of a file, None where there is none that this process can read."""
    try:
        data = path.read_bytes()
    except OSError:
        return None
    try:
        tree, program = pickle.loads(data)
        return export.deserialize(program), tree
    except Exception as error:  # of pickle or flatbuffers: a file that is cut is written again
        LOG.debug("%s is not readable: %s", path, error)
        return None


def _save(path: Path, program: export.Exported, tree: Tree) -> tuple[export.Exported, Any]:
    """Write a program, whole or not at all, and return it."""
    data = pickle.dumps((tree, bytes(program.serialize())))
    try:
        if not path.parent.is_dir():
            path.parent.mkdir(parents=True, exist_ok=True)
            _remove_old(path.parent)
        os.utime(path.parent)
        with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as file:
            file.write(data)
        os.replace(file.name, path)
    except OSError as error:  # a full or read-only disk
        LOG.debug("%s is not kept: %s", path, error)
    return program, tree


def _remove_old(own: Path) -> None:
    """Remove the programs of other sources that were not used for long."""
    for folder in own.parent.glob("programs-*"):
        if folder != own and time.time() - folder.stat().st_mtime > OLD_S:
            for file in folder.iterdir():
                file.unlink(missing_ok=True)
            folder.rmdir()


# ---------------------------------------------------------------------------- names


def described(value: Any) -> str:
    """Return a static argument as text that is the same in every process.

    A filter is its spec, a function its name: their code is in the digest of the sources. What a function is to be
    computed with stands in a `functools.partial`.

    Raises:
        NotKept: a filter without a spec or with a row, rule or adapter of its user, a function that closes over values
            or is not of this library, an object of another kind.
    """
    from jaxnav.filters.catalogue import is_built_in  # which not every program needs
    from jaxnav.filters.core import Filter

    if isinstance(value, PLAIN):
        return repr(value)
    if isinstance(value, Filter):
        if value.spec is None or not is_built_in(value.spec):
            raise NotKept("a filter with parts of its user")
        return described([getattr(value.spec, field.name) for field in dataclasses.fields(value.spec)])
    if isinstance(value, tuple | list):
        return f"{type(value).__qualname__}({','.join(map(described, value))})"
    if isinstance(value, functools.partial):
        return f"partial({described([value.func, *value.args, *value.keywords.items()])})"
    if getattr(value, "__module__", None) == "jax.numpy":
        return f"jax.numpy.{value.__qualname__}"
    if isinstance(value, types.FunctionType) and not value.__closure__:
        if value.__module__.partition(".")[0] in PACKAGES:
            return f"{value.__module__}.{value.__qualname__}:{value.__code__.co_firstlineno}"
    raise NotKept(f"{getattr(value, '__module__', '')}.{getattr(value, '__qualname__', type(value).__qualname__)}")
