"""Monte Carlo: a run is its key's alone, its scores are those of a run by hand, and the statistics are right."""

import json
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2

from jaxnav import build
from jaxnav.analysis import metrics, montecarlo
from jaxnav.analysis.montecarlo import BINS, Course, monte_carlo, percentile, summary
from jaxnav.analysis.plots.montecarlo import figures
from jaxnav.app.cli import main
from jaxnav.filters.run import run_jit
from jaxnav.maths import rotations
from jaxnav.simulate.keys import Purpose, run_key
from jaxnav.simulate.scenarios import SCENARIOS
from jaxnav.simulate.simulation import matched_params, simulate_jit
from tests.conftest import leaves_equal, told
from tuning.fit import checkpoint

SCENARIO = SCENARIOS["gpid_circle_no_fault"]
SCENARIO = SCENARIO._replace(
    duration_s=40.0, imu_rate_hz=5.0, gnss=SCENARIO.gnss._replace(outages_s=((10.0, 14.0), (25.0, 30.0)))
)
FILTER = build("ekf9", cov_stride=5)
PARAMS = matched_params(SCENARIO)
SEED = 3
RUNS = 14


@pytest.fixture(scope="module")
def found():
    return monte_carlo(FILTER, SCENARIO, PARAMS, RUNS, SEED, chunk=4)


@pytest.mark.full
def test_scores_are_those_of_a_run_by_hand(found):
    sim = simulate_jit(run_key(SEED, Purpose.STUDY, 5), SCENARIO)
    info = run_jit(FILTER, PARAMS, sim.initial, sim.epochs)
    position = np.asarray(jax.vmap(metrics.position_error)(info.nav, sim.truth.pos))
    velocity = np.asarray(info.nav.vel - sim.truth.vel)
    phi = np.asarray(jax.vmap(lambda a, b: rotations.log(rotations.multiply(a, rotations.conjugate(b))))(
        info.nav.q, sim.truth.q
    ))  # fmt: skip
    x = np.concatenate([position, velocity, phi], 1)
    nees = np.einsum("ei,eij,ej->e", x, np.linalg.inv(np.asarray(info.P)), x)
    horizontal = np.hypot(*position[:, :2].T)
    expected = dict(
        position=metrics.rms(position), horizontal=metrics.rms(horizontal), vertical=metrics.rms(position[:, 2]),
        velocity=metrics.rms(velocity), tilt=metrics.rms(np.hypot(*phi[:, :2].T)), yaw=metrics.rms(phi[:, 2]),
        outage_ends=horizontal[[13, 29]], nees=nees.mean(), nis=info.nis.sum() / info.valid.any(1).sum(),
        dof=info.valid.sum(), nis_sum=info.nis.sum(), ok=True, failed=np.inf,
    )  # fmt: skip
    for name, value in expected.items():
        np.testing.assert_allclose(getattr(found.scores, name)[5], value, rtol=1e-6, err_msg=name)


def test_a_run_depends_on_its_key_alone(found):
    """Bit for bit, whatever the others of its chunk are."""
    traces = montecarlo._chunk._cache_size()
    alone = monte_carlo(FILTER, SCENARIO, PARAMS, [9, 2], SEED, chunk=4)
    assert montecarlo._chunk._cache_size() == traces  # compiled once for all chunks, the last and its padding too
    leaves_equal(alone.scores, jax.tree.map(lambda a: a[[9, 2]], found.scores))
    np.testing.assert_array_equal(alone.runs, [9, 2])
    assert len(set(found.scores.horizontal.tolist())) == RUNS
    assert monte_carlo(FILTER, SCENARIO, PARAMS, [9], SEED + 1, chunk=4).scores.horizontal != alone.scores.horizontal[0]


@pytest.mark.full
def test_candidates_see_the_same_runs_and_a_failure_is_named(found):
    """The second cannot be used from the first epoch on; the first is as alone, though chunks of another size round."""
    scale = jnp.array([1.0, jnp.nan, 2.0])
    many = jax.tree.map(lambda a: jnp.broadcast_to(jnp.asarray(a), (3, *jnp.shape(a))), PARAMS)
    many = many._replace(noise=many.noise._replace(accel=(many.noise.accel.T * scale).T))
    three = monte_carlo(FILTER, SCENARIO, many, RUNS, SEED, candidates=True, chunk=5)
    for a, b in zip(three.scores, found.scores, strict=True):
        np.testing.assert_allclose(a[0], b, rtol=1e-10)
    np.testing.assert_allclose(three.course.mean[0], found.course.mean, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(three.course.sd[0], found.course.sd, rtol=1e-9)
    np.testing.assert_array_equal(three.course.counts[0], found.course.counts)
    assert not three.scores.ok[1].any() and (three.scores.failed[1] == 1.0).all()
    assert np.isfinite(three.scores.position).all() and three.course.runs[1].max() == 0
    assert (three.scores.horizontal[2] != three.scores.horizontal[0]).all()
    assert three.course.mean.shape == (3, 40, 5) and three.scores.outage_ends.shape == (3, RUNS, 2)


def test_a_run_beyond_the_limit_is_a_divergence(found):
    limit = 3.0 * float(np.median(found.scores.outage_ends.max(1)))
    limited = monte_carlo(FILTER, SCENARIO, PARAMS, RUNS, SEED, chunk=4, limit_m=limit)
    assert 0 < limited.scores.ok.sum() < RUNS
    about = summary(limited)
    for bad in about["diverged"]:
        sim = simulate_jit(run_key(SEED, Purpose.STUDY, bad["run"]), SCENARIO)
        info = run_jit(FILTER, PARAMS, sim.initial, sim.epochs)
        error = np.hypot(*np.asarray(jax.vmap(metrics.position_error)(info.nav, sim.truth.pos))[:, :2].T)
        assert bad["t_s"] == sim.truth.t[np.argmax(error > limit)]
    assert len(about["diverged"]) == RUNS - limited.scores.ok.sum()
    kept = limited.scores.horizontal[limited.scores.ok]
    assert about["scores"]["horizontal_m"]["median"] == np.median(kept)


@pytest.mark.full
def test_consistency_bounds(found):
    """Bounds are those of chi-square; a matched filter is inside, and one with half the noise is not."""
    about = summary(found)
    dof = RUNS * 31 * 6
    np.testing.assert_allclose(about["anis"]["bounds"], chi2.ppf([0.025, 0.975], dof) / dof, rtol=1e-9)
    np.testing.assert_allclose(about["anees"]["bounds"], chi2.ppf([0.025, 0.975], 9 * RUNS) / (9 * RUNS), rtol=1e-9)
    low, high = metrics.chi2_bounds(dof, 1, 0.999)
    assert low / dof < about["anis"]["mean"] < high / dof
    assert about["anees"]["share_inside"] > 0.8 and 0.7 < about["anees"]["mean"] < 1.3
    sure = told(PARAMS, velocity_scale=0.5, position_scale=0.5)
    about = summary(monte_carlo(FILTER, SCENARIO, sure, RUNS, SEED, chunk=4))
    assert about["anis"]["mean"] > 2 * about["anis"]["bounds"][1] and about["anees"]["share_inside"] < 0.5


def test_ctrl_c_keeps_what_is_finished(found, monkeypatch):
    real, calls = montecarlo._chunk, []

    def chunk(*args):
        calls.append(None)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return real(*args)

    monkeypatch.setattr(montecarlo, "_chunk", chunk)
    part = monte_carlo(FILTER, SCENARIO, PARAMS, RUNS, SEED, chunk=4)
    assert part.stopped and not found.stopped
    np.testing.assert_array_equal(part.runs, np.arange(8))
    leaves_equal(part.scores, jax.tree.map(lambda a: a[:8], found.scores))
    assert (part.course.runs == 8).all()
    calls[:] = [None, None]
    with pytest.raises(KeyboardInterrupt):
        monte_carlo(FILTER, SCENARIO, PARAMS, RUNS, SEED, chunk=4)


def test_percentiles_are_within_a_bin():
    values = np.random.default_rng(1).lognormal(sigma=2.0, size=5000)
    cell = np.searchsorted(BINS, values, side="right") - 1
    counts = np.bincount(cell, minlength=BINS.size - 1)[None, None].repeat(5, axis=1)
    one = Course(*[np.zeros(1)] * 4, counts, *[np.zeros(1)] * 4)
    for q in (5, 50, 95):
        np.testing.assert_allclose(percentile(one, q), np.percentile(values, q), rtol=0.03)


def test_the_course_is_the_mean_over_the_runs(found):
    """Mean, sd and median at one epoch, from the runs one by one."""
    each = [monte_carlo(FILTER, SCENARIO, PARAMS, [i], SEED, chunk=4).course.mean[20] for i in range(RUNS)]
    np.testing.assert_allclose(found.course.mean[20], np.mean(each, 0), rtol=1e-12)
    np.testing.assert_allclose(found.course.sd[20], np.std(each, 0, ddof=1), rtol=1e-9)
    np.testing.assert_allclose(percentile(found.course, 50)[20], np.median(each, 0), rtol=0.35)
    assert (found.course.fixes[9] == RUNS) and (found.course.fixes[11] == 0)


def test_figures_show_each_filter_and_its_bounds(found):
    draw_state = figures({"one": found, "two": found}, SCENARIO.gnss.outages_s)
    assert set(draw_state) == {"mc_errors", "mc_consistency", "mc_spread"}
    ax = draw_state["mc_consistency"].axes[0]
    low = [line for line in ax.lines if line.get_label() == "95 % bounds"][0]
    np.testing.assert_allclose(low.get_ydata(), chi2.ppf(0.025, 9 * RUNS) / (9 * RUNS), rtol=1e-9)
    yaw = draw_state["mc_errors"].axes[4].lines[0]
    np.testing.assert_allclose(yaw.get_ydata(), np.degrees(percentile(found.course, 50)[:, 4]))


def test_scenarios_that_cannot_be_run_are_refused():
    with pytest.raises(ValueError, match="runs and chunk must be at least 1"):
        monte_carlo(FILTER, SCENARIO, PARAMS, 0)
    with pytest.raises(ValueError, match="imu_rate_hz"):
        monte_carlo(FILTER, SCENARIO._replace(imu_rate_hz=2.5), PARAMS, 2)


def test_the_verb(found, tmp_path, monkeypatch, capsys):
    """The same runs by command, with a table, metrics, scores of every run and figures; and what it refuses."""
    monkeypatch.setenv("JAXNAV_CACHE_DIR", "")
    out = tmp_path / "mc"
    options = ["duration_s=40.0", "imu_rate_hz=5.0", "outages_s=[[10.0, 14.0], [25.0, 30.0]]"]
    line = [
        "mc",
        "--data",
        "gpid_circle_no_fault",
        "--filter",
        "ekf9",
        "--seed",
        str(SEED),
        "--out",
        str(out),
        "--quiet",
    ]
    line += [arg for option in options for arg in ("--set", f"data.options.{option}")] + ["--set", "mc.chunk=4"]
    assert main([*line, "--runs", str(RUNS)]) == 0
    about = json.loads((out / "metrics.json").read_text())["ekf9"]
    assert about["runs"] == RUNS and about["diverged"] == []
    assert about["scores"]["horizontal_m"]["mean"] == pytest.approx(found.scores.horizontal.mean(), rel=1e-9)
    with np.load(out / "runs.npz") as saved:
        np.testing.assert_allclose(saved["ekf9.nees"], found.scores.nees, rtol=1e-9)
    assert {p.name for p in out.glob("*.png")} == {"mc_errors.png", "mc_consistency.png", "mc_spread.png"}
    assert main([*line, "--runs", "4", "--set", "mc.limit_m=0.01"]) == 1
    assert "every run of ekf9" in capsys.readouterr().err
    assert main([*line, "--runs", "0"]) == 2 and main([*line, "--filter", "ekf9,ekf8"]) == 2
    assert main(["mc", "--data", "kth_gnss_ins", "--quiet"]) == 2


def test_runs_that_are_kept_go_on_to_the_bit(found, tmp_path):
    """From what was finished after two chunks, through a file."""
    seen = []
    monte_carlo(FILTER, SCENARIO, PARAMS, 8, SEED, chunk=4, keep=seen.append)
    assert [each.done for each in seen] == [4, 8]
    checkpoint.save(tmp_path / "mc.npz", seen[-1], {}, "job")
    leaves = checkpoint.load(tmp_path / "mc.npz", None, "job").tree
    finished = jax.tree.unflatten(jax.tree.structure(seen[-1]), leaves)._replace(done=8)
    whole = monte_carlo(FILTER, SCENARIO, PARAMS, RUNS, SEED, chunk=4, resume=finished)
    leaves_equal(whole.scores, found.scores)
    leaves_equal(whole.course, found.course)


@pytest.mark.full
def test_a_chunk_that_devices_cannot_share_is_refused():
    mesh = jax.make_mesh((1,), ("runs",), axis_types=(jax.sharding.AxisType.Auto,))
    assert monte_carlo(FILTER, SCENARIO, PARAMS, 4, SEED, chunk=4, mesh=mesh).scores.ok.all()
    two = SimpleNamespace(size=2)
    with pytest.raises(ValueError, match="a chunk of 3 runs cannot be shared among 2 devices"):
        monte_carlo(FILTER, SCENARIO, PARAMS, 4, SEED, chunk=3, mesh=two)
