"""Scenarios: printable, hashable, checked, settable by name; the papers' cases hold what the papers say."""

import math
import re
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.app.config import resolve
from jaxnav.app.sources import scenario_of
from jaxnav.filters.compiler import enable_x64
from jaxnav.maths import earth, rotations, units
from jaxnav.simulate import faults
from jaxnav.simulate.faults import Burst, Constant, Ramp
from jaxnav.simulate.gnss import Receiver
from jaxnav.simulate.scenarios import GIPKF, PATTERN, READINGS, REPRO, SCENARIOS, describe
from jaxnav.simulate.simulation import matched_params, simulate, sizes
from jaxnav.simulate.trajectories import Circle, Static
from jaxnav.states.grades import GRADES
from jaxnav.types import ConfigError

enable_x64()
KEYS = jax.random.split(jax.random.key(2), 40)
quick = partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})


def runs(scenario, n=40):
    """Many runs of a scenario."""
    return quick(jax.vmap(partial(simulate, scenario=scenario)))(KEYS[:n])


def angles(a, b):
    """Rotation vectors between quaternions (n, 4), deg ENU."""
    turn = lambda p, q: rotations.log(rotations.multiply(p, rotations.conjugate(q)))
    return np.asarray(jax.vmap(turn)(a, b)) / units.DEG


@pytest.mark.parametrize("name", SCENARIOS)
def test_every_scenario_is_printable_hashable_and_can_be_traced(name):
    scenario = SCENARIOS[name]
    E, k = sizes(scenario)
    sim = jax.eval_shape(partial(simulate, scenario=scenario), jax.random.key(0))
    assert (
        sim.epochs.imu.gyro.shape == (E, k, 3) and sim.truth.pos.shape == (E, 3) and sim.epochs.fix.sd.shape == (E, 6)
    )
    assert all(not leaf.weak_type for leaf in jax.tree.leaves(sim))
    assert hash(scenario) == hash(scenario._replace()) and scenario.name == name
    groups = [scenario, *(v for v in scenario if hasattr(v, "_fields"))]
    fields = [f for group in groups for f in group._fields]
    assert len(fields) == len(set(fields))  # each can be set by its name alone
    text = describe(scenario)
    assert all(f in text for f in fields) and f"motion.{scenario.motion._fields[0]}" in text


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"imu_rate_hz": 25.5}, "multiple of gnss_rate_hz"),
        ({"duration_s": 80.3}, "whole epochs"),
        ({"grade": "x"}, "no IMU grade 'x'"),
        ({"position_sd_m": (0.0, 1.0, 1.0)}, "position_sd_m must be positive"),
        ({"alignment_s": 0.5}, "alignment_s must be whole epochs"),
        ({"alignment_s": 80.0}, "less than the run"),
        ({"calibrate_gyro": True}, "needs an alignment_s"),
    ],
)
def test_scenarios_that_do_not_fit_together(change, words):
    scenario = SCENARIOS["urban_short"]
    (field, value), *_ = change.items()
    for group in ("imu", "gnss", "start"):
        if hasattr(getattr(scenario, group), field):
            scenario = scenario._replace(**{group: getattr(scenario, group)._replace(**change)})
            break
    else:
        scenario = scenario._replace(**change)
    with pytest.raises(ValueError, match=words):
        sizes(scenario)


def chosen(name, **options):
    """The scenario that a configuration gives."""
    return scenario_of(resolve([("", {"data": {"source": name, "options": options}})]))


def test_fields_of_groups_are_set_by_their_name():
    s = chosen(
        "gpid_circle", duration_s=1200, speed_mps=12, grade="adis16465", position_sd_m=[1, 2, 3], outages_s=[[5, 9]],
        prior_tilt_sd_deg=1, faults=[], latency_s=0.2, fixed_bias=False,
    )  # fmt: skip
    assert s.duration_s == 1200.0 and s.motion == Circle(12.0) and s.imu.grade == "adis16465"
    assert s.gnss.position_sd_m == (1.0, 2.0, 3.0) and s.gnss.outages_s == ((5.0, 9.0),) and s.gnss.latency_s == 0.2
    assert s.faults == () and not s.imu.fixed_bias and s.start.prior_tilt_sd_deg == 1.0
    hash(s)
    for options, words in (
        ({"speed": 3.0}, "unknown for a scenario"),
        ({"motion": "circle"}, "unknown for a scenario"),
        ({"faults": [1]}, r"must be like \[{kind = "),
        (
            {"faults": [{"kind": "rampp", "start_s": 1, "stop_s": 2}]},
            r"faults\[0\].kind: no fault 'rampp': did you mean ramp",
        ),
        ({"faults": [{"kind": "ramp", "start_s": 1}]}, r"faults\[0\]: a ramp needs stop_s"),
        ({"faults": [{"kind": "ramp", "start_s": 1, "stop_s": 2, "size": 3}]}, r"faults\[0\].size: unknown for a ramp"),
        ({"faults": [{"kind": "ramp", "start_s": 2, "stop_s": 1}]}, "stop_s must be after start_s, got 2 and 1"),
        ({"faults": [{"kind": "ramp", "start_s": 0, "stop_s": 1, "position_m": 3}]}, "position_m must be like"),
        ({"fixed_bias": 1.0}, "must be like True"),
        ({"grade": "x"}, "no IMU grade 'x'"),
        ({"outages_s": [5, 9]}, "outages_s must be like"),
    ):
        with pytest.raises(ConfigError, match=words):
            chosen("gpid_circle", **options)
    off = {"start_s": 5, "stop_s": math.inf, "position_m": [1, 2, 3]}
    both = chosen(
        "urban", faults=[{"kind": "constant", **off}, {"kind": "burst", "start_s": 1, "stop_s": 2, "factor": 3}]
    )
    assert both.faults == (Constant(5.0, math.inf, (1.0, 2.0, 3.0)), Burst(1.0, 2.0, 3.0))
    late = scenario_of(resolve([("", {"data": {"source": "urban", "imu_worse_by": 3.0, "gnss_latency_s": 0.1}})]))
    assert late.imu.imu_noise_factor == 3.0 and late.gnss.latency_s == 0.1


# ---------------------------------------------------------------------------- the papers' cases


def test_the_circle_of_ansari_2024():
    name = "gpid_circle_velocity"
    scenario = SCENARIOS[name]._replace(duration_s=1200.0)
    sim = runs(scenario, 8)
    speed = np.linalg.norm(sim.truth.vel, axis=-1)
    np.testing.assert_allclose(speed, 10.0)
    table1 = GRADES["tactical"]
    np.testing.assert_allclose(np.abs(sim.truth.errors["gyro_bias"]), table1.gyro_turn_on, rtol=1e-12)
    np.testing.assert_allclose(np.abs(sim.truth.errors["accel_bias"]), table1.accel_turn_on, rtol=1e-12)
    fault = np.asarray(sim.epochs.fix.value[..., 3:] - sim.truth.vel)
    assert (
        np.allclose(fault[:, 600:1100].mean((0, 1)), 0.5, atol=0.01)
        and np.abs(fault[:, 1100:].mean((0, 1))).max() < 0.02
    )
    assert np.std(fault[:, :600]) == pytest.approx(0.1, rel=0.05)
    assert {s.faults for s in SCENARIOS.values() if s.name.startswith("gpid_repro")} == set(READINGS.values())
    assert 2 * np.pi / REPRO.motion.period_s * 33.5 == pytest.approx(0.0228 * 33.5)


def test_gipkf_starts_aligned_at_rest():
    parked = GIPKF._replace(duration_s=35.0, motion=Static((1.0, 2.0, 30.0)), gnss=Receiver())
    sim = runs(parked)
    assert sim.truth.t[0, 0] == 31.0 and sim.start.t[0] == 30.0 and sim.epochs.imu.dt.shape == (40, 5, 10)
    assert GIPKF.motion.standstill_s == 45.0
    tilt = angles(sim.initial.q, sim.start.q)
    # levelled on the raw accelerometer: a tilt of bias / g, heading with its own error
    C = jax.vmap(rotations.to_dcm)(sim.start.q)
    felt = np.asarray(jnp.einsum("nij,nj->ni", C, sim.start.errors["accel_bias"])) / 9.8 / units.DEG
    np.testing.assert_allclose(tilt[:, 0], felt[:, 1], atol=0.15)  # second order: 2 deg of heading turn 4 deg of tilt
    np.testing.assert_allclose(tilt[:, 1], -felt[:, 0], atol=0.15)
    assert 1.3 < tilt[:, 2].std() < 2.8
    left = np.asarray(sim.initial.errors["gyro_bias"] - sim.start.errors["gyro_bias"]) / units.DEG_PER_HOUR
    assert np.abs(sim.start.errors["gyro_bias"]).max() > 0.2 * units.DEG
    # noise of the mean over 30 s, drift, and the Earth's rate through tilt and heading
    assert left.std() < 2 * np.hypot(0.26 * 60 / np.sqrt(30), 5.1 / 3)
    known = matched_params(GIPKF).states["gyro_bias"]
    assert 0.3 < left.std() * units.DEG_PER_HOUR / float(known.sd) < 2
    raw = SCENARIOS["gipkf_urban_uncalibrated"]
    assert float(matched_params(raw).states["gyro_bias"].sd) == pytest.approx(0.2 * units.DEG)


def test_fwekf_cases():
    sim = runs(SCENARIOS["fwekf_noise_free"], 2)
    t = np.asarray(sim.truth.t[0])
    assert t[0] == pytest.approx(0.1) and t[-1] == pytest.approx(40.0) and sim.epochs.imu.dt.shape == (2, 400, 10)
    assert float(sim.truth.vel[0, -1, 1]) == pytest.approx(30.0) and not sim.truth.vel[0, :200].any()
    value, truth = sim.epochs.fix.value, sim.truth
    np.testing.assert_allclose(value[..., :3], truth.pos, rtol=0, atol=1e-13)
    assert not sim.truth.errors["gyro_bias"].any() and (sim.epochs.fix.sd[0, 0] == np.array([10] * 3 + [0.2] * 3)).all()
    off = jax.vmap(earth.enu_difference)(sim.initial.pos, sim.start.pos)
    np.testing.assert_allclose(off, np.tile(10 * np.array(PATTERN), (2, 1)), rtol=1e-5)
    np.testing.assert_allclose(angles(sim.initial.q, sim.start.q), np.tile(PATTERN, (2, 1)), atol=1e-9)

    assert SCENARIOS["fwekf_bias_10"].imu.gyro_bias_sd_deg_per_hour * units.DEG_PER_HOUR == pytest.approx(3e-3)
    assert SCENARIOS["fwekf_bias_10"].imu.accel_bias_sd_mg * units.MG == pytest.approx(3e-2)


def test_kinds_of_faults_and_motions_are_told_apart():
    """Tuples of the same numbers: as static arguments they must not share a compiled function."""
    a, b = Constant(1.0, 2.0, (3.0, 0.0, 0.0)), Ramp(1.0, 2.0, (3.0, 0.0, 0.0))
    assert tuple(a) == tuple(b) and a != b and (a,) != (b,) and not a == b
    assert a == Constant(1.0, 2.0, (3.0, 0.0, 0.0)) and hash(a) == hash(a._replace())
    offset = jax.jit(lambda f, t: faults.offsets(jax.random.key(0), (f,), t, jnp.zeros((3, 6))), static_argnums=0)
    t = jnp.array([1.2, 1.5, 2.0])
    np.testing.assert_allclose(offset(a, t)[:, 0], 3.0)
    np.testing.assert_allclose(offset(b, t)[:, 0], [0.6, 1.5, 3.0])


def test_the_page_on_simulation_runs():
    page = (Path(__file__).parents[2] / "docs" / "simulation.md").read_text()
    space: dict = {}
    for block in re.findall(r"```python\n(.*?)```", page, re.S):
        exec(block, space)
    north = space["sim"].truth.pos[-1, 0] - space["sim"].start.pos[0]
    assert float(north) * 6.37e6 == pytest.approx(180, abs=2) and not np.abs(space["sim"].truth.vel[-1]).any()
    assert float(jnp.abs(space["rolling"].truth.omega[:, 0]).max()) == pytest.approx(0.1, rel=0.01)
    np.testing.assert_allclose(space["semi_synthetic"].truth.pos[-1, :2], space["lla"][-1, :2], atol=1e-8)
    names = re.findall(r"`([a-z_]+)`", page.split("## Your own")[0].split("| scenario")[1])
    assert {n for n in names if not n.startswith("_")} <= set(SCENARIOS)
