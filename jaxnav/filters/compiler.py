"""How jax is set up for navigation: float64, a compiler that is quick, and compiled programs that are kept."""

import ctypes
import gc
import logging
import os
import platform
import sys
from contextlib import suppress
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

import jax

from jaxnav.filters import programs
from jaxnav.types import DataError

CACHE = "JAXNAV_CACHE_DIR"  # environment: folder of compiled programs; empty turns the cache off
LOG = logging.getLogger("jaxnav")
EMITTERS = "xla_cpu_use_fusion_emitters"  # off: XLA's older emitter writes the kernels, in half of the time
MAX_MEMORY_SHARE = 0.9  # of the memory that one job may take
FLAG_VERSIONS = (0, 10)  # last jaxlib that has the flag; XLA ends a process with an unknown flag


def enable_x64() -> None:
    """Switch jax to float64 for the whole process; importing jaxnav changes no flag of jax."""
    jax.config.update("jax_enable_x64", True)


def fast_compiler() -> bool:
    """Before the first array: compile in half of the time, with a third of the memory mappings, to programs as fast.

    Sets an option of XLA in the environment of this process. Returns whether it was set: jaxlib's version is one that
    is known to have it, and XLA_FLAGS does not name it already.
    """
    given = os.environ.get("XLA_FLAGS", "")
    os.environ["XLA_FLAGS"] = fast_flags(given)
    return os.environ["XLA_FLAGS"] != given


def fast_flags(given: str) -> str:
    """Return the value ``given`` of XLA_FLAGS with the option of `fast_compiler`, where that sets it."""
    version = metadata.version("jaxlib").split(".")
    if EMITTERS in given or (int(version[0]), int(version[1])) > FLAG_VERSIONS:
        return given
    return f"{given} --{EMITTERS}=false".strip()


def cache(folder: str | Path | None = None) -> Path | None:
    """Keep compiled programs, small ones included, and what was traced (`programs`) for the next process.

    Args:
        folder: by default that of the environment variable JAXNAV_CACHE_DIR (empty turns the cache off), else a folder
            of jaxnav in the user's cache folder. Programs of another jaxlib or processor are in folders of their
            versions.

    Returns:
        The folder, None where turned off.
    """
    home = cache_home() if folder is None else Path(folder)
    if home is None:
        programs.keep_in(None)
        return None
    folder = home / f"jaxlib-{metadata.version('jaxlib')}-{_processor()}"
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    programs.keep_in(folder)
    return folder


class ProcessUsage(NamedTuple):
    """Resources that this process holds; zeros where the system does not report them (only Linux does)."""

    maps: int  # memory mappings: every compiled kernel keeps some, and past the system's limit the compiler crashes
    resident: int  # bytes of memory


def process_usage() -> ProcessUsage:
    """Return mappings and memory of this process."""
    try:
        maps = Path("/proc/self/maps").read_bytes().count(b"\n")
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return ProcessUsage(0, 0)
    return ProcessUsage(maps, pages * os.sysconf("SC_PAGE_SIZE"))


def clear_caches_if_needed(maps: int = 30_000, resident: float | None = None) -> bool:
    """Drop all compiled programs if this process holds too much memory, and log it.

    Called by `navigate`, `solve`, Monte Carlo, tuning and the bake-off before they compile, and by whoever loops over
    many filters. Programs in use compile again.

    Args:
        maps: limit of memory mappings; Linux allows 65,530 (`vm.max_map_count`), one more filter may add ten thousand.
        resident: bytes, limit of resident memory; None is half of the machine's memory.

    Returns:
        Whether programs were dropped.
    """
    now = process_usage()
    most = _memory() / 2 if resident is None else resident
    if now.maps <= maps and now.resident <= most:
        return False
    programs.clear()
    jax.clear_caches()
    gc.collect()
    if sys.platform == "linux":  # small freed pieces return to the system only on request
        getattr(ctypes.CDLL(None), "malloc_trim", lambda pad: 0)(0)
    LOG.warning("dropped all compiled programs, which held %d mappings, %.1f GiB", now.maps, now.resident / 2**30)
    return True


def require_memory(size: float, subject: str) -> None:
    """Refuse work beyond this machine's memory before it starts: the system would end the process without a message.

    Raises:
        DataError: ``size`` bytes are more than `MAX_MEMORY_SHARE` of its memory.
    """
    if size > MAX_MEMORY_SHARE * _memory():
        raise DataError(
            f"{subject} takes about {size / 2**30:.3g} GiB of memory, this machine has {_memory() / 2**30:.3g}"
        )


def _memory() -> float:
    """Bytes of memory of this machine, or of the control group that this process may not leave; inf if unknown."""
    limits = [float("inf")]
    with suppress(OSError, ValueError):
        limits.append(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    with suppress(OSError, ValueError):  # "max" where there is no limit
        limits.append(int(Path("/sys/fs/cgroup/memory.max").read_text()))
    return min(limits)


def cache_home() -> Path | None:
    """Return the user's folder of compiled programs, or None where it is turned off."""
    if CACHE in os.environ:
        return Path(os.environ[CACHE]) if os.environ[CACHE] else None
    if sys.platform == "win32":
        home = Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    elif sys.platform == "darwin":
        home = Path.home() / "Library" / "Caches"
    else:
        home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return home / "jaxnav" / "compiled"


def _processor() -> str:
    """Return the processor's instruction set and model as a short name of a folder."""
    name = platform.machine()
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as lines:
            model = next((line.split(":", 1)[1] for line in lines if line.startswith("model name")), "")
    except OSError:
        model = platform.processor()
    words = "".join(c if c.isalnum() else " " for c in f"{name} {model}").split()
    return "-".join(words)[:60].lower() or "unknown"
