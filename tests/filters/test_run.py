"""What `run` refuses: arrays that are not one run of the filter, float32, and parameters of another filter."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.analysis.montecarlo import monte_carlo
from jaxnav.filters import run as run_module
from jaxnav.filters.catalogue import FILTERS, build
from jaxnav.filters.parameters import change, datasheet_params
from jaxnav.filters.run import require_params, run, run_in_chunks, run_jit
from jaxnav.navigation import navigate
from jaxnav.simulate.scenarios import SCENARIOS
from jaxnav.states.grades import GRADES
from jaxnav.types import DataError
from tuning.recordings.recorded import tune


def test_wrong_shapes_are_refused_by_their_field(case):
    epochs = case.packed.epochs
    fix, imu, many = epochs.fix, epochs.imu, jax.tree.map(lambda a: jnp.stack([a, a]), case.nav)
    for match, nav, bad in (
        (r"fix.value has shape \(\d+, 5\), expected \(\d+, 6\): .* 6 channels of position, velocity", case.nav,
         epochs._replace(fix=fix._replace(value=fix.value[:, :5]))),
        (r"epochs.imu.gyro has shape", case.nav, epochs._replace(imu=imu._replace(gyro=imu.gyro[..., :2]))),
        (r"nav.pos has shape \(2, 3\), expected \(3,\).*of many runs, vmap", many, epochs),
        (r"epochs.fix.valid must be bool, got float64", case.nav,
         epochs._replace(fix=fix._replace(valid=fix.valid.astype(float)))),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=match):
            run(build("ekf15"), case.params, nav, bad)


@pytest.mark.parametrize(
    "filt, make, match",
    [
        (build("gpid"), lambda f: datasheet_params(GRADES["consumer"]),
         r"params.rule is tuple\(\), the filter takes Gpid\(ki, kd, .*filt.params\("),
        (build("ekf15"), lambda f: build("gpid15").params(), r"params.rule is Gpid\(.*takes tuple"),
        (build("ekf15", ("position", "barometer")), lambda f: build("ekf9").params(),
         r"has no states\['gyro_bias'\], states\['accel_bias'\], measurements\['barometer'\]"),
        (build("ekf15"), lambda f: f.params()._asdict(), "params is dict, expected jaxnav.Params"),
        (build("ekf15"), lambda f: change(f.params(), {"mounting.lever_arm": [1.0, 2.0]}),
         r"mounting.lever_arm has shape \(2,\), expected \(3,\)"),
        (build("ekf15"), lambda f: change(f.params(), {"states.gyro_bias.sd": np.ones((3, 3))}),
         r"states.gyro_bias.sd has shape \(3, 3\), expected \(\) or \(3,\)"),
        (build("ekf15"), lambda f: change(f.params(), {"measurements.velocity.latency": [0.1, 0.1]}),
         r"velocity.latency has shape \(2,\), expected \(\)"),
        (build("gpid"), lambda f: change(f.params(), {"rule.ki": [1.0, 2.0]}), r"params.rule.ki has shape \(2,\)"),
        (build("ekf15"), lambda f: change(f.params(), {"noise.gyro": [1.0, 2.0]}), r"noise.gyro has shape \(2,\)"),
    ],
)  # fmt: skip
def test_parameters_of_another_filter_are_refused_by_their_field(case, filt, make, match):
    with pytest.raises(ValueError, match=match):
        run(filt, make(filt), case.nav, case.packed.epochs)


def test_parameters_of_another_filter_are_refused_before_anything_else():
    """By what takes recordings and scenarios as well: neither is looked at."""
    filt, params = build("gpid"), datasheet_params(GRADES["consumer"])
    calls = (
        lambda: navigate(None, filt, params), lambda: tune(None, filt, params),
        lambda: monte_carlo(filt, SCENARIOS["urban_short"], params, 1),
    )  # fmt: skip
    for call in calls:
        with pytest.raises(ValueError, match="params.rule is tuple"):
            call()


def test_parameters_fit_by_every_shape_that_a_filter_takes():
    """One number for all axes, one an axis, roots; those of a larger filter; of every filter of the catalogue."""
    ekf = build("ekf9")
    for values in (
        {"noise.gyro": 1e-3}, {"noise.gyro": np.eye(3)}, {"prior.attitude": 0.1},
        {"measurements.position.scale": np.eye(3)}, {"measurements.position.scale": 2.0},
    ):  # fmt: skip
        require_params(ekf, change(ekf.params(), values))
    wide = build("ekf15", states=("gyro_scale",))
    require_params(ekf, wide.params())
    require_params(
        wide, change(wide.params(), {"states.gyro_bias.driving_noise": np.eye(3), "states.gyro_scale.tau": 5.0})
    )
    for name in FILTERS:
        require_params(build(name), build(name).params("consumer"))


def test_float32_is_refused(case):
    small = case.nav._replace(pos=case.nav.pos.astype(jnp.float32))
    with pytest.raises(DataError, match="float64, got float32"):
        run(build("ekf15"), case.params, small, case.packed.epochs)
    imu = jax.tree.map(lambda a: a.astype(jnp.float32), case.packed.epochs.imu)
    with pytest.raises(DataError, match="enable_x64"):
        run_jit(build("ekf15"), case.params, case.nav, case.packed.epochs._replace(imu=imu))
    made_too_early = jax.tree.map(lambda a: jnp.asarray(a).astype(jnp.float32), case.params)
    with pytest.raises(DataError, match="enable_x64"):
        run_jit(build("ekf15"), made_too_early, case.nav, case.packed.epochs)


@pytest.mark.full
def test_a_long_run_in_chunks_is_one_run(case, monkeypatch):
    """Late fixes look back over the cut, and the last chunk is padded; 60 epochs by chunks of 25."""
    filt = build("ekf15", cov_stride=5, history=9)
    params = change(case.params, {"measurements.velocity.latency": 0.2})
    epochs = case.packed.epochs
    whole = run_jit(filt, params, case.nav, epochs)
    monkeypatch.setattr(run_module, "CHUNK", 25)
    parts = run_in_chunks(filt, params, case.nav, epochs)
    assert epochs.imu.dt.shape[0] > 50 and isinstance(parts.P, np.ndarray)
    for a, b in zip(jax.tree.leaves(whole), jax.tree.leaves(parts), strict=True):
        np.testing.assert_allclose(b, a, rtol=1e-9, atol=1e-12)
