"""Other people's filters: each target builds, what is free of it has a logarithm, its files say what was found."""

import os
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.recordings import peers, peers_kfgins
from jaxnav import build, recording
from jaxnav.app import cli
from jaxnav.app.config import resolve
from jaxnav.app.jobs.tune import by_runs, for_target
from jaxnav.filters.epochs import pack_recording
from jaxnav.filters.parameters import change, get, mounting
from jaxnav.filters.run import run_jit
from jaxnav.initialization.initialize import Initialization
from jaxnav.io.formats.kfgins import read_kfgins_gnss, read_kfgins_imu
from jaxnav.maths import units
from jaxnav.measurements import MEASUREMENTS
from jaxnav.measurements.measurement import clock_offset
from jaxnav.types import ConfigError
from tuning.recordings.export import ONE_CORRELATION_TIME
from tuning.recordings.free import leaves_of
from tuning.recordings.targets import TARGETS, delay_of, kfgins_config

KFGINS = os.environ.get("KFGINS_BIN")


@pytest.fixture(scope="module")
def rec(case):
    arm = np.array([0.3, -0.2, -1.0])
    return recording(case.imu, name="town", lever_arm=arm, **{k: case.aiding[k] for k in ("position", "velocity")})


@pytest.fixture(scope="module")
def begin(case):
    nav = case.nav._replace(origin=case.nav.origin._replace(t=jnp.asarray(30.0)))
    return Initialization(jax.tree.map(lambda a: jnp.asarray(a)[None], nav), case.params.prior, float(case.nav.t))


@pytest.mark.parametrize("name", TARGETS)
def test_every_target_s_filter_builds_and_its_free_numbers_have_logarithms(name, rec, begin, tmp_path):
    target = TARGETS[name]
    like = build(target.filter, target.measurements, cov_stride=5, states=target.states)
    params = target.shaped(like.params("consumer"))
    for leaf in leaves_of(like, params, target.free):
        if leaf.startswith(("noise", "states")) or leaf.endswith("scale"):
            assert (np.asarray(get(params, leaf)) > 0).all(), leaf
    if name == "kfgins":
        assert all((np.asarray(s.tau) == ONE_CORRELATION_TIME).all() for s in params.states.values())
        scale = params.states["gyro_scale"]
        np.testing.assert_allclose(
            np.asarray(scale.driving_noise) ** 2 * np.asarray(scale.tau) / 2, np.asarray(scale.sd) ** 2
        )
    target.write(tmp_path, rec, params, begin)
    first = (tmp_path / target.file).read_text().splitlines()[0]
    assert first.startswith("% " if target.file.endswith(".m") else "# ") and "town" in first


def test_kfgins_s_files_hold_the_samples_and_the_fixes_by_the_imu_s_clock(rec, begin, tmp_path):
    """Read again by our own readers; the delay is what a measurement of ours is compared at."""
    target = TARGETS["kfgins"]
    like = build(target.filter, target.measurements, cov_stride=5, states=target.states)
    timing = {"mounting.time_offset": 0.12, "mounting.clock_drift": 2e-4, "measurements.position.latency": 0.03}
    given = target.shaped(like.params("consumer", install=mounting(rec.lever_arm)))
    params = change(given, timing | {"measurements.position.scale": jnp.array([2.0, 2.0, 3.0])})
    target.write(tmp_path, rec, params, begin)
    imu = read_kfgins_imu(tmp_path / "kfgins_imu.txt")
    np.testing.assert_allclose(imu.t[1:], rec.imu.t, atol=1e-9)
    np.testing.assert_allclose(imu.accel[2:], rec.imu.accel[1:], atol=1e-6)
    fixes, mine = read_kfgins_gnss(tmp_path / "kfgins_gnss.txt"), rec.aiding["position"]
    late = mine.t - fixes.t
    np.testing.assert_allclose(late, 0.15 + 2e-4 * (mine.t - 30.0), atol=1e-8)
    nav = jax.tree.map(lambda a: a[0], begin.navs)
    ours = [float(clock_offset(params.mounting, nav._replace(t=jnp.asarray(t)))) + 0.03 for t in mine.t]
    np.testing.assert_allclose(delay_of(params, begin, mine.t), ours, atol=1e-12)
    np.testing.assert_allclose(fixes.sd, mine.sd * [2.0, 2.0, 3.0], rtol=1e-5)
    text = (tmp_path / "kf-gins.yaml").read_text()
    value = lambda key: [float(v) for v in re.search(rf"^\s*{key}: \[(.*?)\]", text, re.M).group(1).split(",")]
    np.testing.assert_allclose(value("antlever"), rec.lever_arm)
    vel, pos = np.asarray(nav.vel), np.asarray(nav.pos)
    np.testing.assert_allclose(value("initvel"), vel[[1, 0, 2]] * [1, 1, -1], atol=1e-9)
    np.testing.assert_allclose(value("initpos"), pos / [units.DEG, units.DEG, 1.0], rtol=1e-10)
    np.testing.assert_allclose(value("initsgstd"), 3000.0)
    np.testing.assert_array_equal(value("initgyrbias"), 0.0)
    np.testing.assert_allclose(value("gsstd"), 3000.0)


def test_kfgins_starts_from_the_mean_and_the_sd_of_the_initialization(rec, begin):
    """Biases that a start found are its mean, with the sd that is left of them."""
    bias, sd = jnp.array([0.01, -0.02, 0.03]), np.array([1e-4, 2e-4, 3e-4])
    navs = begin.navs._replace(errors={"gyro_bias": bias[None]})
    like = build("ekf15", ("position",), states=TARGETS["kfgins"].states)
    text = kfgins_config(rec, like.params("consumer"), begin._replace(navs=navs, states={"gyro_bias": sd}))
    value = lambda key: [float(v) for v in re.search(rf"^\s*{key}: \[(.*?)\]", text, re.M).group(1).split(",")]
    np.testing.assert_allclose(value("initgyrbias"), np.asarray(bias) / units.DEG_PER_HOUR, rtol=1e-9)
    np.testing.assert_allclose(value("initbgstd"), sd / units.DEG_PER_HOUR, rtol=1e-9)
    np.testing.assert_array_equal(value("initaccbias"), 0.0)
    np.testing.assert_allclose(value("initattstd"), np.ravel(begin.prior.attitude)[[1, 0, 2]] / units.DEG if
                               np.ndim(begin.prior.attitude) else float(begin.prior.attitude) / units.DEG)  # fmt: skip


def test_settings_that_are_the_target_s_are_refused(tmp_path, capsys):
    set_to = lambda **filt: resolve([("", {"filter": filt, "tune": {"target": "kfgins"}})])
    config = for_target(set_to(), TARGETS["kfgins"])
    assert config.filter.states == ("gyro_scale", "accel_scale") and not by_runs(config)
    for own, words in (({"name": "ekf9"}, "filter.name"), ({"states": ["wind"]}, "filter.states")):
        with pytest.raises(ConfigError, match=words):
            for_target(set_to(**own), TARGETS["kfgins"])
    wrong = ["tune", "--for", "kfgin", "--data", "urban_short", "--out", str(tmp_path / "t")]
    assert cli.main(wrong) == 2 and "did you mean kfgins?" in capsys.readouterr().err


@pytest.mark.slow
def test_a_target_s_job_is_written_by_the_command_line(tmp_path):
    """Two minutes in town, no truth; what is for others is not written beside it."""
    argv = ["tune", "--for", "kfgins", "--data", "urban_short", "--out", str(tmp_path / "t"), "--quiet"]
    assert cli.main([*argv, "--set", "data.options.duration_s=150.0", "--set", "filter.cov_stride=10"]) == 0
    names = {p.name for p in (tmp_path / "t").iterdir()}
    assert {"kf-gins.yaml", "kfgins_imu.txt", "kfgins_gnss.txt", "tuned.toml"} <= names
    assert "tuned_px4.params" not in names


@pytest.mark.slow
@pytest.mark.skipif(KFGINS is None, reason="KFGINS_BIN does not name KF-GINS's executable")
def test_kfgins_itself_goes_where_our_filter_of_its_kind_goes(case, rec, begin):
    """Another program in another language, the same noise: within a fifth of the filter's own sd once settled."""
    like, params = peers.like_kfgins(case.params)
    packed = pack_recording(rec, (MEASUREMENTS["position"],), begin.t)
    nav = jax.tree.map(lambda a: a[0], begin.navs)
    params = params._replace(mounting=params.mounting._replace(lever_arm=jnp.asarray(rec.lever_arm)))
    info = run_jit(build("ekf15", ("position",), states=TARGETS["kfgins"].states), params, nav, packed.epochs)
    track = peers_kfgins.run(Path(KFGINS), rec, params, begin)
    theirs = np.stack([np.interp(packed.t, track.t, track.lla[:, i]) for i in range(3)], 1)
    off = peers.horizontal(np.asarray(info.nav.pos), theirs)
    sd = np.sqrt(np.asarray(info.P)[:, 0, 0])
    assert (off[10:] < 0.2 * sd[10:]).all() and np.median(off[10:] / sd[10:]) < 0.05
