"""Recorded drives with GNSS hidden for 10, 11 and 22 s in turn: EKF15 and GIP-KF as they come, without tuning.

The error is that of the antenna against the hidden fix, through the measurement model.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.papers.gipkf_study import LENGTHS
from benchmarks.recordings import drive, navego
from jaxnav import reading
from jaxnav.analysis import metrics
from jaxnav.filters import epochs
from jaxnav.filters.catalogue import build
from jaxnav.filters.core import Filter
from jaxnav.filters.epochs import Packed
from jaxnav.filters.papers.gip_kf import gip_kf_params
from jaxnav.filters.parameters import datasheet_params
from jaxnav.filters.run import initial_nav, run
from jaxnav.initialization import initialize as alignment
from jaxnav.maths import units
from jaxnav.measurements import GNSS, POSITION, Measurement
from jaxnav.states.grades import GRADES
from jaxnav.types import DataError, Epoch, Nav, Params

FIRST, EVERY = 120.0, 60.0  # s: the first outage, and from one to the next
METHODS = {"ekf15": 1.0, "ekf9": 10.0, "gipkf": 10.0, "gipkf_mix": 10.0}  # -> factor on white noise, for the biases


class Case(NamedTuple):
    """A recording cut to epochs, with a start and parameters of 15 states."""

    interval: float  # s, of the fixes
    packed: Packed
    nav: Nav
    params: Params
    measurements: tuple[Measurement, ...] = GNSS
    history: int = 2


def _packed(rec, interval, start, measurements=GNSS):
    aiding = {m.name: rec.aiding[m.name] for m in measurements}
    return epochs.pack(rec.imu, aiding, interval, measurements, start=start)


def navego_case() -> Case:
    """Synthetic data of an ADIS16488 in a car, GNSS at 5 Hz; the start is the truth."""
    folder = reading.verify("navego_synthetic")
    rec = reading.load("navego_synthetic")
    start = float(rec.aiding["position"].t[0])
    i = int(np.argmin(np.abs(rec.truth.t - start)))
    nav = initial_nav(rec.truth.lla[i], rec.truth.vel[i], rec.truth.rph[i], t=start)
    return Case(0.2, _packed(rec, 0.2, start), nav, navego.parameters(folder, "imu2"))


def drive_case() -> Case:
    """The rtklibexplorer drive: consumer IMU and RTK at 4 Hz, white noise widened as in `drive.py`."""
    rec = drive.recording()
    params, wide = drive.parameters(-0.21), drive.WIDEN
    noise = params.noise._replace(gyro=wide * params.noise.gyro, accel=wide * params.noise.accel)
    nav = drive.start_at(rec, drive.START)
    return Case(0.25, _packed(rec, 0.25, drive.START), nav, params._replace(noise=noise), history=drive.HISTORY)


def kth_case() -> Case:
    """The KTH car: position alone at 1 Hz."""
    rec = reading.load("kth_gnss_ins")
    position = rec.aiding["position"]
    position = position._replace(sd=np.full_like(position.sd, np.sqrt(3.0)))  # m, the course's setting
    rec = rec._replace(aiding=rec.aiding | {"position": position})
    start = float(position.t[position.t >= rec.imu.t[0]][0])
    roll, pitch = alignment.coarse_leveling(rec.imu, start, start + 2.0)
    nav = initial_nav(position.value[position.t >= start][0], rph=(roll, pitch, np.deg2rad(320.0)), t=start)
    params = datasheet_params(GRADES["consumer"], heading_sd=10 * units.DEG)
    return Case(1.0, _packed(rec, 1.0, start, (POSITION,)), nav, params, (POSITION,))


CASES = {"navego_synthetic imu2": navego_case, "rtkexplorer_drive": drive_case, "kth_gnss_ins": kth_case}


def windows(t: np.ndarray, measured: np.ndarray) -> tuple[np.ndarray, list[list[np.ndarray]]]:
    """Three runs, so that every outage has every length once: hidden (3, E), last epochs by run and length."""
    starts = np.arange(t[0] + FIRST, t[-1] - EVERY / 2, EVERY)
    hidden, ends = np.zeros((3, t.size), bool), []
    for phase in range(3):
        mine = []
        for i, length in enumerate(LENGTHS):
            chosen = starts[(np.arange(starts.size) + phase) % 3 == i]
            inside, last = epochs.outage_windows(t, chosen, length) if chosen.size else (np.zeros(t.size, bool), [])
            hidden[phase] |= inside
            mine.append(np.array([e for e in last if measured[e]], int))
        ends.append(mine)
    return hidden, ends


@partial(jax.jit, static_argnums=(0, 1))
def residuals(filt: Filter, measurements, params: Params, nav: Nav, data: Epoch, hidden: jax.Array) -> jax.Array:
    """Horizontal residual of position, (runs, E), m."""

    def one(hide):
        residual = run(filt, params, nav, epochs.hide(data, hide, measurements)).residual
        return jnp.hypot(residual[:, 0], residual[:, 1])

    return jax.lax.map(one, hidden)


def rule_of(case: Case, method: str):
    """Weights of the urban drives' 1 Hz, at the rate of these fixes: a push per second and per second of an epoch."""
    if not method.startswith("gipkf"):
        return ()
    T, kappa = case.interval, 0.04 if method == "gipkf_mix" else 0.0
    return gip_kf_params(0.001 * T, 0.03 * T**2, kappa * T, channels=3 * len(case.measurements))


def evaluate(case: Case, method: str) -> dict:
    """RMS and errors at the ends of outages, by length."""
    k = case.packed.epochs.imu.dt.shape[1]
    filt = build(method, case.measurements, cov_stride=k, history=case.history, frame="tangent")
    wide, noise = METHODS[method], case.params.noise
    noise = noise._replace(gyro=wide * noise.gyro, accel=wide * noise.accel)
    params = case.params._replace(noise=noise, rule=rule_of(case, method))
    data = case.packed.epochs
    hidden, ends = windows(case.packed.t, np.asarray(data.fix.valid[:, 0]))
    error = np.asarray(residuals(filt, case.measurements, params, case.nav, data, jnp.asarray(hidden)))
    out: dict = {}
    for i, length in enumerate(LENGTHS):
        e = np.concatenate([error[run][last[i]] for run, last in enumerate(ends)])
        out |= {f"{length:g}": float(metrics.rms(e)), f"per_window_{length:g}": e.tolist()}
    return out


def table() -> dict:
    """Every recording that is there by every method; prints as it goes."""
    found: dict = {}
    print("\nrecorded drives, GNSS hidden, RMS of the horizontal error at 10 | 11 | 22 s, m; nothing tuned")
    for name, load in CASES.items():
        try:
            case = load()
        except DataError as error:
            print(f"  {name}: {error}")
            continue
        found[name] = {method: evaluate(case, method) for method in METHODS}
        for method, r in found[name].items():
            count = len(r["per_window_22"])
            print(
                f"  {name:24} {method:8} {r['10']:8.2f} | {r['11']:8.2f} | {r['22']:8.2f}   {count} windows each",
                flush=True,
            )
    return found
