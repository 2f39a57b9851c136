"""A rule, a reader, a measurement, a constraint and a frame are each one file (here: one section) and one row.

A state that reads a temperature is in tests/states/test_temperature.py, a verb in tests/app/test_verbs.py.
"""

import json
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav import build, navigate
from jaxnav.app import cli
from jaxnav.app.config import read_params, resolve
from jaxnav.app.jobs.tune import for_target
from jaxnav.app.sources import load
from jaxnav.filters.catalogue import FILTERS, Entry
from jaxnav.filters.core import Filter
from jaxnav.filters.parameters import change
from jaxnav.filters.rule import Correction, Innovation, Rule
from jaxnav.filters.standstill import constraint_samples
from jaxnav.io import readers, write_recording
from jaxnav.io.parts import ImuRows, Parts, Stream
from jaxnav.maths import linalg, rotations
from jaxnav.maths.units import Unit
from jaxnav.measurements import MEASUREMENTS
from jaxnav.measurements.columns import column
from jaxnav.measurements.measurement import Kinematics, Measurement, Observation
from jaxnav.navigation import metrics
from jaxnav.reading.read import read
from jaxnav.states.table import BIASES
from jaxnav.strapdown import local_level
from jaxnav.strapdown.errors import local_level as local_level_errors
from jaxnav.strapdown.frames import FRAMES, Frame
from jaxnav.types import Fix, Leaf, Mounting, Nav, Params, Recording, Samples
from tuning.recordings.export import StatedSd
from tuning.recordings.targets import TARGETS, Target, write_exports

QUICK = ["--set", "out.figures=none", "--set", "filter.cov_stride=10", "--set", "filter.grade='consumer'"]


@pytest.fixture(scope="module")
def drive() -> Recording:
    """A drive of 60 s with receiver faults."""
    options = {"duration_s": 60.0, "imu_rate_hz": 25.0, "outages_s": []}
    return load(resolve([("", {"data": {"source": "urban_short", "options": options}})]))


def filtered(data: Path, out: Path, *flags: str) -> dict:
    """Metrics of `jaxnav filter`."""
    assert cli.main(["filter", "--data", str(data), "--out", str(out), *QUICK, *flags]) == 0
    return json.loads((out / "metrics.json").read_text())


# ---------------------------------------------------------------------------- a rule: Cauchy weights, by channel


class Cauchy(NamedTuple):
    """Of Cauchy weights."""

    scale: jax.Array  # () sd at which a channel has half its weight


def correct_cauchy(theta: Cauchy, memory: tuple[()], z: Innovation) -> Correction:
    S = z.H @ z.P @ z.H.T + z.R
    weight = 1 / (1 + z.nu**2 / (theta.scale**2 * jnp.diag(S)))
    K, P = linalg.update(z.P, z.H, z.R / jnp.sqrt(weight[:, None] * weight))
    return Correction(K @ z.nu, P, memory, z.valid)


CAUCHY = Entry(
    BIASES, lambda rows: Rule(lambda n, m: (), correct_cauchy), lambda: Cauchy(jnp.array(2.0)), {"scale": "log"}, "toy",
    accepts_extra_states=True,
)  # fmt: skip


@pytest.mark.full
def test_a_rule_is_a_row(drive, tmp_path, monkeypatch):
    """It runs by its name, has its setting, and keeps out a fix that is 300 m off."""
    monkeypatch.setitem(FILTERS, "ekf15_cauchy", CAUCHY)
    position = drive.aiding["position"]
    far = position.value.copy()
    far[30, 0] += 300.0 / 6.37e6
    write_recording(
        tmp_path / "drive", drive._replace(aiding=drive.aiding | {"position": position._replace(value=far)})
    )
    run = lambda *flags: filtered(tmp_path / "drive", tmp_path / "out", *flags)["errors"]["horizontal_m"]["max"]
    cauchy, plain = run("--filter", "ekf15_cauchy"), run("--filter", "ekf15")
    assert cauchy < 0.4 * plain
    assert run("--filter", "ekf15_cauchy", "--set", "rule.scale=1e6") == pytest.approx(plain, rel=1e-3)


# ---------------------------------------------------------------------------- a reader: a log of lines


def recognises(path: Path, head: bytes) -> bool:
    return head.startswith(b"TOYLOG 1\n")


def read_toy(path: Path) -> Parts:
    rows = [line.split() for line in path.read_text().splitlines()[1:]]
    table = lambda kind: np.array([row[1:] for row in rows if row[0] == kind], float)
    imu, fix = table("I"), table("F")
    return Parts(str(path), ImuRows(imu[:, 0], imu[:, 1:4], imu[:, 4:7]), {"position": Stream(fix[:, 0], fix[:, 1:4])})


@pytest.mark.full
def test_a_reader_is_a_row(drive, tmp_path, monkeypatch):
    monkeypatch.setattr(readers, "READERS", (readers.Reader("toy log", recognises, read_toy), *readers.READERS))
    imu, position = drive.imu, drive.aiding["position"]
    rows = [("I", t, *w, *f) for t, w, f in zip(imu.t, imu.gyro, imu.accel)]
    rows += [("F", t, *value) for t, value in zip(position.t, position.value)]
    text = "\n".join(" ".join(map(str, row)) for row in rows)
    (tmp_path / "drive.toy").write_text(f"TOYLOG 1\n{text}\n")
    rec = read(tmp_path / "drive.toy")
    np.testing.assert_allclose(rec.imu.gyro, imu.gyro)
    np.testing.assert_allclose(rec.aiding["position"].value, position.value)
    assert "position: the file states no sd; assumed are 3, 3, 6 m" in rec.notes
    assert filtered(tmp_path / "drive.toy", tmp_path / "out")["nis_per_dof"] < 3.0


# ---------------------------------------------------------------------------- a measurement: a Doppler radar


class RadarParams(NamedTuple):
    """Of a radar that sees the speed along the body's forward axis."""

    factor: Leaf  # () what it reads of the speed


def observe_radar(theta: RadarParams, mounting: Mounting, nav: Nav, kin: Kinematics, fix: Fix) -> Observation:
    forward = theta.factor * kin.C[:, 0]
    rows = {"velocity": forward[None], "attitude": jnp.cross(forward, kin.vel)[None]}
    return Observation((forward @ kin.vel)[None] - fix.value, rows, fix.sd)


RADAR = Measurement(
    "radar", ("forward",), observe_radar, RadarParams(1.0), RadarParams(Unit(step=0.02)),
    columns=(column("forward_mps", "speed", 0.1, plausible=(-100.0, 100.0)),),
)  # fmt: skip


def test_a_measurement_is_a_row_with_a_stream_and_settings(drive, tmp_path, monkeypatch):
    monkeypatch.setitem(MEASUREMENTS, "radar", RADAR)
    t = drive.imu.t[::5]
    speed = np.hypot(*(np.interp(t, drive.truth.t, v) for v in drive.truth.vel[:, :2].T))[:, None]
    radar = Samples(t, 0.5 * speed, np.full_like(speed, 0.05), np.zeros_like(speed))
    write_recording(tmp_path / "drive", drive._replace(aiding=drive.aiding | {"radar": radar}))
    assert (tmp_path / "drive" / "radar.csv").read_text().startswith("t_s,forward_mps,sd_mps\n")
    rec = read(tmp_path / "drive")
    filt = build("ekf15", ["position", "velocity", "radar"], cov_stride=10)
    params = filt.params("consumer")

    def velocity(filt: Filter, params: Params) -> float:
        """RMS of the north velocity, 20 s of it without fixes."""
        sol = navigate(rec, filt, params, outages=[(30.0, 50.0)])
        return metrics(sol)["errors"]["vn_mps"]["rms"]

    right = velocity(filt, change(params, {"measurements.radar.factor": 0.5}))
    plain = build("ekf15", cov_stride=10)
    assert right < 0.7 * velocity(plain, plain.params("consumer")) and right < 0.2 * velocity(filt, params)


# ---------------------------------------------------------------------------- a constraint: a speed by the throttle


class ThrottleParams(NamedTuple):
    """Of a speed along the body's forward axis that is known at the end of every epoch."""

    sd: Leaf  # () m/s


def observe_throttle(theta: ThrottleParams, mounting: Mounting, nav: Nav, kin: Kinematics, fix: Fix) -> Observation:
    forward = kin.C[:, 0]
    rows = {"velocity": forward[None], "attitude": jnp.cross(forward, kin.vel)[None]}
    return Observation((forward @ kin.vel)[None] - fix.value, rows, fix.sd, theta.sd)


def test_a_constraint_is_a_row_with_values_of_its_own(drive, tmp_path, monkeypatch):
    """The row gives values and times: by name it acts in `filter`, at epochs without a fix and without a stream."""
    true = lambda imu, t, window: np.hypot(*(np.interp(t, drive.truth.t, v) for v in drive.truth.vel[:, :2].T))[:, None]
    row = Measurement(
        "throttle", ("forward",), observe_throttle, ThrottleParams(0.05), ThrottleParams(Unit("mps")), pseudo=true
    )
    monkeypatch.setitem(MEASUREMENTS, "throttle", row)
    write_recording(tmp_path / "drive", drive)
    outage = ("--set", "filter.outages=[[30, 50]]")
    run = lambda *names: filtered(
        tmp_path / "drive", tmp_path / "out", *outage, "--set", f"filter.measurements={json.dumps(names)}"
    )["errors"]["vn_mps"]["rms"]
    assert run("position", "velocity", "throttle") < 0.7 * run("position", "velocity")
    still = constraint_samples(drive.imu, np.arange(5.0), [row._replace(at_rest=True)], np.arange(5) > 2)
    np.testing.assert_array_equal(still["throttle"].t, [3.0, 4.0])


# ---------------------------------------------------------------------------- a frame: local level, west first


SOUTH = np.diag([-1.0, -1.0, 1.0])  # east, north, up <-> west, south, up


def turned(nav: Nav) -> Nav:
    half_turn = jnp.array([0.0, 0.0, 0.0, 1.0])
    return nav._replace(vel=SOUTH @ nav.vel, q=rotations.multiply(half_turn, nav.q))


def propagate_west(nav, u, imu, stride=1, keep=None):
    after, points = local_level.propagate(turned(nav), u, imu, stride, keep)
    after = turned(after) if keep is None else jax.vmap(turned)(after)
    return after, points._replace(nav=jax.vmap(turned)(points.nav), C=SOUTH @ points.C, force=points.force @ SOUTH)


def dynamics_west(point, form):
    local = point._replace(nav=turned(point.nav), C=SOUTH @ point.C, force=SOUTH @ point.force)
    return {key: SOUTH @ block @ SOUTH for key, block in local_level_errors.dynamics(local, form).items()}


def retract_west(nav: Nav, x: jax.Array) -> Nav:
    enu = jnp.concatenate([SOUTH @ x[:3], SOUTH @ x[3:6], x[6:]])
    return turned(local_level_errors.retract(turned(nav), enu))


def test_a_frame_is_a_row(drive, monkeypatch):
    """Its solution is that of local level, but for the rounding of latitudes, 1e-9 m a fix."""
    rows = np.kron(np.eye(3), SOUTH)
    monkeypatch.setitem(FRAMES, "west", Frame(
        propagate_west, dynamics_west, retract_west, enter=turned, leave=turned, enu_rows=lambda nav, local: rows,
    ))  # fmt: skip
    filters = [build("ekf9", cov_stride=10, frame=frame, fast=False) for frame in ("west", "local_level")]
    found, plain = (navigate(drive, filt, filt.params("consumer"), scan=False) for filt in filters)
    np.testing.assert_allclose(found.vel, plain.vel, atol=1e-5)
    np.testing.assert_allclose(found.rph, plain.rph, atol=1e-6)
    np.testing.assert_allclose(found.sd, plain.sd, rtol=1e-4)


# ---------------------------------------------------------------------------- a target: a filter of two numbers


def read_two(text: str) -> dict[str, np.ndarray]:
    lines = dict(line.split() for line in text.splitlines() if line.startswith("sigma"))
    return {f"noise.{sensor}": np.array(float(lines[f"sigma_{sensor}"])) for sensor in ("gyro", "accel")}


def test_a_target_is_a_row(tmp_path, monkeypatch):
    """It is written with all others and under its name, and read as parameters."""
    monkeypatch.setitem(TARGETS, "toy", Target(
        "toy", "two numbers", "ekf9", ("position",), (), ("noise.gyro", "noise.accel"), lambda params: params,
        "tuned_toy.cfg", lambda params, stated: f"sigma_gyro {params.noise.gyro}\nsigma_accel {params.noise.accel}\n",
        read_two,
    ))  # fmt: skip
    params = change(build("ekf9").params("consumer"), {"noise.gyro": 2e-4, "noise.accel": 3e-3})
    write_exports(tmp_path, "a head", params, StatedSd())
    assert (tmp_path / "tuned_toy.cfg").read_text().startswith("# a head\nsigma_gyro 0.0002\n")
    found = resolve([("", read_params(tmp_path / "tuned_toy.cfg"))])
    assert found.noise.gyro_deg_per_sqrt_hour == pytest.approx(2e-4 * 60 * 180 / np.pi)
    assert for_target(resolve([]), TARGETS["toy"]).filter.name == "ekf9"
