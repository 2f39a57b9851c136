"""Kinds of findings that no other test makes from a recording with the fault: each by its code."""

from functools import partial
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from benchmarks.recordings import check
from benchmarks.simulated.vehicles import simulated
from jaxnav import build, initialize, navigate
from jaxnav.analysis.noise_scan import NoiseScan
from jaxnav.analysis.observability import Observability, observability_findings
from jaxnav.app.jobs.check import shown
from jaxnav.app.jobs.mc import findings_of
from jaxnav.checkup import CHECKS, checkup
from jaxnav.checkup.motion import clock_rate_of
from jaxnav.filters import programs
from jaxnav.filters.catalogue import Filter
from jaxnav.maths.units import DEG
from jaxnav.simulate.scenarios import SCENARIOS
from jaxnav.simulate.simulation import simulate_jit, to_recording
from jaxnav.types import Recording, Samples, Track
from tuning import likelihood, uncertainty
from tuning.fit.transforms import LOG


def codes(findings) -> set[str]:
    return {f.code for f in findings}


KINDS = ("car", "aircraft", "walk", "robot", "ship", "train", "bus", "mower", "glider", "table")


@pytest.mark.full
@pytest.mark.parametrize("kind", KINDS)
def test_a_clean_recording_warns_of_nothing(kind):
    """Ten vehicles of different motion, consumer's IMU, fixes with position and velocity."""
    rec, _ = simulated(kind, "consumer", True, np.random.default_rng(20 + KINDS.index(kind)), late=0.0)
    found = checkup(rec)
    assert [f.code for f in found if f.warns] == [] and (kind == "table" or "time.delay" in codes(found))


def test_an_aircraft_shows_the_sign_of_its_vertical_velocity():
    rec, _ = simulated("aircraft", "consumer", True, np.random.default_rng(3))
    assert "velocity.vertical" in codes(CHECKS["velocity"].answer(rec))
    turned = check.stream("velocity", check.times(1, 1, -1))(rec)
    assert "velocity.vertical_sign" in codes(CHECKS["velocity"].answer(turned))


def test_a_clock_that_gains_shows_over_three_minutes():
    rec, _ = simulated("car", "consumer", True, np.random.default_rng(3), sd=0.5, span=180.0, late=0.0)
    fast = check.later(ppm=3000.0)(rec)
    assert "time.drift" in codes(CHECKS["together"].answer(fast))
    rate, sd = clock_rate_of(fast)
    usual, _ = clock_rate_of(rec)
    assert abs(rate - usual) * 1e6 == pytest.approx(3000.0, rel=0.15) and 20.0 < sd * 1e6 < 1500.0
    assert abs(usual) < 3 * sd


def test_fixes_that_no_motion_explains_are_a_misfit():
    rec, _ = simulated("car", "consumer", False, np.random.default_rng(7))
    rng, position = np.random.default_rng(0), rec.aiding["position"]
    shift = np.cumsum(rng.normal(size=position.value.shape), 0) * [3e-8, 3e-8, 0.2]
    wild = position._replace(value=position.value + shift, sd=0 * position.sd + 0.02)
    assert "motion.misfit" in codes(CHECKS["together"].answer(rec._replace(aiding={"position": wild})))


def test_a_vehicle_on_a_table_has_too_little_motion():
    rec, _ = simulated("table", "consumer", True, np.random.default_rng(7))
    assert "motion.little" in codes(CHECKS["together"].answer(rec))


@pytest.fixture(scope="module")
def drive() -> Recording:
    """A drive in town of 80 s, antenna 1 m above, with a barometer and a truth of half the time."""
    scenario = SCENARIOS["urban_short"]
    rec = to_recording(simulate_jit(jax.random.key(2), scenario), scenario)
    t = np.arange(1.0, 80.0)
    height = Samples(t, np.full((79, 1), 200.0), np.full((79, 1), 0.5), np.zeros((79, 1)))
    half = rec.truth.t < 40.0
    truth = Track(*(a[half] for a in rec.truth))
    return rec._replace(aiding=rec.aiding | {"barometer": height}, truth=truth, lever_arm=np.array([0.5, 0.0, -1.0]))


@pytest.fixture(scope="module")
def ekf() -> Filter:
    return build("ekf15", cov_stride=5)


@pytest.mark.full
def test_a_run_without_params_says_how_it_chose(drive, ekf):
    found = codes(navigate(drive, ekf).findings)
    assert found >= {"noise.scan", "stream.extra", "truth.share", "lever_arm.recorded", "stream.unused"}


@pytest.mark.full
def test_a_run_with_params_says_which_lever_arm_counts(drive, ekf):
    params = ekf.params("consumer")
    params = params._replace(mounting=params.mounting._replace(lever_arm=np.array([0.2, 0.0, -1.0])))
    unknown = partial(initialize, heading="unknown")
    assert codes(navigate(drive, ekf, params, initialization=unknown).findings) >= {
        "lever_arm.stated",
        "heading.hypotheses",
    }


@pytest.mark.full
def test_a_bias_beyond_its_prior_is_unexpected(drive, ekf):
    biased = drive._replace(imu=drive.imu._replace(gyro=drive.imu.gyro + [0.0, 0.0, 2.0 * DEG]))
    given = partial(initialize, heading="truth")
    sol = navigate(biased, ekf, ekf.params("adis16488a"), initialization=given, stop=38.0)
    assert "state.unexpected" in codes(sol.findings)


def test_noise_far_above_a_datasheet_is_vibration():
    assert codes(NoiseScan(gyro=400.0, accel=30.0, fixes=50).findings) == {"noise.scan", "noise.vibration"}
    assert codes(NoiseScan().findings) == {"noise.datasheet"}


@pytest.mark.full
def test_states_that_few_or_no_windows_observe(tmp_path, drive):
    names = ("gyro_bias x", "gyro_bias y", "gyro_bias z")
    left = np.array([[0.2, 1.0, 1.0]] * 5 + [[0.2, 0.3, 1.0]])
    seen = Observability(names, np.arange(6.0), left, np.full(6, 2), np.ones(6))
    found = {f.code: f.subject for f in observability_findings(seen, 30.0)}
    assert set(found) == {"observability.rank", "observability.never", "observability.seldom"}
    assert found["observability.never"] == "gyro_bias z" and found["observability.seldom"] == "gyro_bias y (1)"
    (tmp_path / "config.toml").write_text("[filter]\nname = 'none'\n")
    assert codes(shown(tmp_path / "config.toml", drive)) == {"observability.unknown"}
    (tmp_path / "config.toml").write_text("[filter]\nname = 'ekf9'\n")
    programs.keep_in(tmp_path / "programs")  # as the command line does
    assert "observability.unknown" not in codes(shown(tmp_path / "config.toml", drive))


def test_monte_carlo_names_divergence_and_consistency():
    one = {"runs": 4, "diverged": [{"run": 2, "t_s": 31.0}], "scores": {}, "anees": {"mean": 1.1, "share_inside": 0.9},
           "anis": {"mean": 1.01, "bounds": (0.98, 1.02)}}  # fmt: skip
    assert codes(findings_of({"ekf15": one})) == {"mc.diverged", "mc.anees", "mc.anis"}


@pytest.mark.full
def test_parameters_that_the_data_do_not_determine(ekf):
    """Information along the sum of two logarithms alone: their difference is open."""
    params, spec = ekf.params("consumer"), {"noise.accel": LOG, "noise.gyro": LOG}
    fisher = np.array([[400.0, 400.0], [400.0, 400.0]])
    info = uncertainty.Information(np.zeros(()), np.zeros(2), fisher, np.zeros((8, 2)))
    _, findings = likelihood.rows(SimpleNamespace(inform=lambda flat: info), spec, params, params, {})
    assert codes(findings) == {"tune.indistinguishable"}
