"""The tuned fuzzy rules with 15 states on recorded data with faults injected into the fixes.

On the drive an error is that of the predicted antenna against the clean RTK fix, before the fix corrects anything; on
NaveGo's data that of the corrected solution against the truth. All filters reset the error and work in local level.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.recordings import drive, navego
from jaxnav import measurements as ms
from jaxnav import reading
from jaxnav.analysis import metrics
from jaxnav.filters import epochs
from jaxnav.filters.core import Filter, make_filter
from jaxnav.filters.error_model import error_model
from jaxnav.filters.feedback import reset
from jaxnav.filters.papers.fuzzy_combined import fuzzy_combined
from jaxnav.filters.papers.fwekf import fwekf
from jaxnav.filters.rule import Rule
from jaxnav.filters.rules.combinators import only
from jaxnav.filters.rules.kalman import kalman
from jaxnav.filters.rules.robust import gate, gate_params, huber, huber_params
from jaxnav.filters.run import initial_nav, run
from jaxnav.maths import earth
from jaxnav.maths.interpolation import columns_at
from jaxnav.simulate.faults import Constant, White, offsets
from jaxnav.strapdown.frames import FRAMES
from jaxnav.types import Epoch, Nav, Params

SETTLED = 60.0  # s
FAULTS = {
    "clean": (),
    "jumps": tuple(Constant(t, t + 3.0, (30.0, 30.0, 0.0)) for t in (120.0, 240.0, 360.0)),
    "noise": tuple(White(t, t + 7.0, (15.0, 15.0, 15.0), (0.5, 0.5, 0.5)) for t in (150.0, 270.0, 390.0)),
    "step": (Constant(300.0, 330.0, (10.0, 10.0, 0.0)),),
}


class Recorded(NamedTuple):
    """One data set, ready to be filtered."""

    nav: Nav
    params: Params
    epochs: Epoch
    t: np.ndarray  # (E,) s
    chosen: tuple[ms.Measurement, ...]
    history: int
    truth: np.ndarray | None  # (E, 3) lat, lon, h; without it the clean fix is the reference


def rules(tuned: dict[str, Any]) -> dict[str, tuple[Rule, Any]]:
    """Name -> rule and its parameters."""
    return {
        "ekf15": (kalman(), ()),
        "gate": (gate(kalman()), gate_params()),
        "huber": (huber(kalman()), huber_params()),
        "fwekf_1.0_tuned": (fwekf(), tuned["fwekf_1.0_tuned"]),
        "fuzzy_combined_tuned": (fuzzy_combined(), tuned["fuzzy_combined_tuned"]),
    }


def load() -> dict[str, Recorded]:
    """The drive, its log mended and read early as in the benchmark of that name, and NaveGo's synthetic data."""
    rec = drive.recording()
    data = drive.cut(rec, False, drive.START)
    params = drive.parameters(-0.21)
    white = {name: drive.WIDEN * getattr(params.noise, name) for name in ("gyro", "accel")}
    params = params._replace(noise=params.noise._replace(**white))
    made = {"drive": Recorded(data.nav, params, data.epochs, data.t, drive.measurements(False), drive.HISTORY, None)}

    folder = reading.verify("navego_synthetic")
    rec = reading.load("navego_synthetic")
    start = float(rec.aiding["position"].t[0])
    packed = epochs.pack(rec.imu, rec.aiding, 0.2, start=start)
    i = int(np.argmin(np.abs(rec.truth.t - start)))
    nav = initial_nav(rec.truth.lla[i], rec.truth.vel[i], rec.truth.rph[i], t=start)
    lla = columns_at(packed.t, rec.truth.t, rec.truth.lla)
    params = navego.parameters(folder, "imu2")
    return made | {"navego": Recorded(nav, params, packed.epochs, packed.t, ms.GNSS, 2, lla)}


def injected(data: Recorded) -> jax.Array:
    """Offsets of the fixes by all kinds of fault, (kinds, E, 6) ENU m and m/s."""
    noise = jnp.zeros((data.t.size, 6))
    return jnp.stack([offsets(jax.random.key(0), f, jnp.asarray(data.t), noise) for f in FAULTS.values()])


@partial(jax.jit, static_argnums=0)
def _errors(filt: Filter, params: Params, nav: Nav, data: Epoch, offset: jax.Array, truth: jax.Array | None):
    """Position errors (kinds, E, 3) ENU m."""

    def one(off):
        value = data.fix.value.at[:, :3].set(jax.vmap(earth.move)(data.fix.value[:, :3], off[:, :3]))
        value = value.at[:, 3:6].add(off[:, 3:6])
        info = run(filt, params, nav, data._replace(fix=data.fix._replace(value=value)))
        if truth is None:
            return info.residual[:, :3] + off[:, :3]
        return jax.vmap(earth.enu_difference)(info.nav.pos, truth)

    return jax.vmap(one)(offset)


def table(tuned: dict[str, Any]) -> dict[str, dict[str, dict[str, float]]]:
    """RMS of the 3-D position error after 60 s by data set, kind of fault and rule, m."""
    result: dict = {}
    for name, data in load().items():
        offset, stride = injected(data), data.epochs.imu.dt.shape[1]
        model = error_model(measurements=data.chosen)
        scored = data.t > SETTLED
        if data.truth is None:
            scored &= np.asarray(data.epochs.fix.valid[:, :3].all(1))
        result[name] = {kind: {} for kind in FAULTS}
        for method, (rule, theta) in rules(tuned).items():
            seen = only(rule, tuple(range(6))) if len(data.chosen) > 2 else rule
            filt = make_filter(FRAMES["local_level"].fast, model, seen, reset, stride, data.history)
            params = data.params._replace(rule=theta)
            found = np.asarray(_errors(filt, params, data.nav, data.epochs, offset, data.truth))
            for kind, e in zip(FAULTS, found, strict=True):
                result[name][kind][method] = float(metrics.rms(np.linalg.norm(e[scored], axis=1)))
    return result


def show(result: dict) -> None:
    """Print the table."""
    for name, kinds in result.items():
        print(f"{name}, 15 states, RMS of position, m")
        print(f"{'':22}" + "".join(f"{kind:>10}" for kind in kinds))
        for method in kinds["clean"]:
            print(f"{method:22}" + "".join(f"{row[method]:10.3f}" for row in kinds.values()))
