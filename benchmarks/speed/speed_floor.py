"""The C++ floor: built with the system's compiler into a temporary folder, called in this process."""

import ctypes
import platform
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np

from benchmarks.speed.speed_plain import noise_of, prior_sd
from jaxnav.types import Epoch, Nav, Params

SOURCE = Path(__file__).parent / "floor.cpp"
FLAGS = ("-O3", "-march=native", "-ffast-math", "-std=c++17", "-fPIC", "-c")


def compiler() -> str | None:
    """The system's C++ compiler."""
    return next((found for name in ("c++", "g++", "clang++") if (found := shutil.which(name))), None)


def compiler_version() -> str:
    """Name and version of the compiler."""
    name = compiler()
    if name is None:
        return "none"
    return subprocess.run([name, "--version"], capture_output=True, text=True).stdout.splitlines()[0]


@cache
def library(lanes: int) -> ctypes.CDLL | None:
    """The floor for 1 or 8 lanes, or None, with a notice, where it cannot be built."""
    program = compiler()
    if program is None:
        print("no C++ compiler: rows of the floor are left out")
        return None
    flags = [*FLAGS, f"-DLANES={lanes}"]
    if lanes > 1 and platform.machine() == "x86_64":
        flags.append("-mprefer-vector-width=512")  # one run is slower with it
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder) / "floor.o", Path(folder) / "floor.so"
        # in two steps: linked with -ffast-math the library would switch denormals off for the whole process
        for command in ([*flags, SOURCE, "-o", made[0]], ["-shared", made[0], "-o", made[1], "-lm"]):
            done = subprocess.run([program, *command], capture_output=True, text=True)
            if done.returncode:
                print(f"{program} does not build the floor, rows of it are left out: {done.stderr[:300]}")
                return None
        return ctypes.CDLL(str(made[1]))


def floor(n: int, lanes: int, params: Params, nav: Nav, epochs: Epoch) -> Callable[[], np.ndarray] | None:
    """A call that filters runs (B, ...), B a multiple of ``lanes``, and gives lla, vel, q at the epochs, (B, E, 10).

    Data are laid out for it beforehand.
    """
    if library(lanes) is None:
        return None
    function = getattr(library(lanes), f"floor_{n}")
    B, E, k = epochs.imu.dt.shape
    noise = noise_of(params)
    side = lambda a: np.broadcast_to(np.asarray(a), (3,))

    def by_lane(*parts) -> np.ndarray:  # (B, ..., c) side by side -> (B / lanes, ..., c, lanes)
        a = np.concatenate([np.asarray(p) for p in parts], -1)
        return np.ascontiguousarray(np.moveaxis(a.reshape(B // lanes, lanes, *a.shape[1:]), 1, -1))

    scale = np.concatenate([side(noise.position_scale), side(noise.velocity_scale)])
    variance = np.broadcast_to(np.asarray(prior_sd(params, n)) ** 2, (B, n))
    data = (
        by_lane(np.asarray(epochs.imu.dt)[..., None], epochs.imu.gyro, epochs.imu.accel),
        by_lane(epochs.fix.value, (scale * np.asarray(epochs.fix.sd)) ** 2),
        by_lane(nav.pos, nav.vel, nav.q, variance),
        np.concatenate([side(sd) ** 2 for sd in (noise.accel, noise.gyro, noise.gyro_bias, noise.accel_bias)]),
        np.empty((B // lanes, E, 10, lanes)),
    )  # fmt: skip
    pointers = [a.ctypes.data_as(ctypes.POINTER(ctypes.c_double)) for a in data]

    def call() -> np.ndarray:
        function(B // lanes, E, k, *pointers)
        return np.moveaxis(data[-1], -1, 1).reshape(B, E, 10)

    return call
