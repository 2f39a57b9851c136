"""`solve` in parts: corrections of the clock, measurements that help, the verdict."""

from types import SimpleNamespace

import jax
import numpy as np
import pytest

from jaxnav import navigation
from jaxnav.analysis.usage import consistency_findings, nis_by_channel
from jaxnav.analysis.windows import drift
from jaxnav.checkup.support import Option, options
from jaxnav.filters.catalogue import build
from jaxnav.findings import finding
from jaxnav.initialization.initialize import initialize
from jaxnav.maths.units import PPM
from jaxnav.measurements import MEASUREMENTS
from jaxnav.simulate.scenarios import URBAN_SHORT
from jaxnav.simulate.simulation import simulate_jit, to_recording
from jaxnav.types import DataError, Samples, sample_rows
from tuning.solving import corrections, sensors, solve
from tuning.solving.calibration import Calibration, Consistency, calibrate, consistency
from tuning.solving.corrections import AXES, DRIFT, OFFSET, check_and_correct, turned
from tuning.solving.sensors import growth, larger, standing_of


@pytest.fixture(scope="module")
def drive():
    """Three minutes in town."""
    gnss = URBAN_SHORT.gnss._replace(outages_s=(), position_sd_m=(0.5, 0.5, 1.0))
    what = URBAN_SHORT._replace(duration_s=180.0, imu_rate_hz=50.0, gnss=gnss)
    return to_recording(simulate_jit(jax.random.key(2), what), what)


# ---------------------------------------------------------------------------- corrections


@pytest.mark.full
def test_leap_seconds_are_taken_out_and_the_setting_is_named(drive):
    late = drive._replace(aiding={n: s._replace(t=s.t + 18.0) for n, s in drive.aiding.items()})
    found = check_and_correct(late)
    assert found.settings == {OFFSET: pytest.approx(18.0, abs=0.11)}
    assert np.allclose(found.recording.imu.t - drive.imu.t, found.settings[OFFSET])
    assert [f.code for f in found.applied] == ["solve.applied"] and OFFSET in found.applied[0].actions[0]
    assert "time.offset" not in {f.code for f in found.found}


@pytest.mark.full
def test_an_imu_with_z_up_is_turned_where_both_sensors_say_so(drive):
    up = turned(drive, "flu")
    found = check_and_correct(up)
    assert found.settings == {AXES: "flu"} and found.applied[0].code == "solve.axes"
    np.testing.assert_allclose(found.recording.imu.accel, drive.imu.accel)
    np.testing.assert_allclose(found.recording.imu.gyro, drive.imu.gyro)
    assert check_and_correct(up, (AXES,)).settings == {}
    one = drive._replace(imu=drive.imu._replace(accel=up.imu.accel))  # the accelerometer alone
    assert AXES not in check_and_correct(one).settings


def test_a_setting_of_the_user_stays(drive, monkeypatch):
    said = [finding("time.offset", "x", 18.0, was=9.0, then=1.0, gain=99.0, cause="leap seconds"),
            finding("time.drift", "velocity", 250.0, sd=20.0)]  # fmt: skip
    monkeypatch.setattr(corrections, "checkup", lambda rec: list(said))
    kept = check_and_correct(drive, (OFFSET, DRIFT))
    assert kept.settings == {} and kept.recording is drive and kept.found == said
    found = check_and_correct(drive, (OFFSET,))
    assert found.settings == {DRIFT: 250} and [f.code for f in found.found] == ["time.offset"]
    params = build("ekf15").params("consumer")
    assert float(found.clock(params).mounting.clock_drift) == pytest.approx(250 * PPM)


def test_a_drive_in_order_is_left_alone(drive):
    found = check_and_correct(drive)
    assert found.settings == {} and found.recording is drive


@pytest.mark.full
def test_stated_sd_grow_by_the_factor_of_the_calibration(drive, monkeypatch):
    monkeypatch.setattr(solve, "calibrate", lambda final: calibrated(0.95)._replace(factor=2.0, velocity_factor=1.5))
    monkeypatch.setattr(solve, "options", lambda rec, found: [])
    before, asked = [], []
    monkeypatch.setattr(solve, "clear_caches_if_needed", lambda: asked.append("solve"))
    monkeypatch.setattr(navigation, "clear_caches_if_needed", lambda: asked.append("navigate"))
    found = solve.solve(drive, fast=True, smooth=False, so_far=lambda make: before.append(make()))
    assert asked[0] == "solve" and asked.count("navigate") == 3  # so that many recordings fit into a process
    assert ["noise by likelihood" in each.why for each in before] == [True, False]
    one, two = (np.median(each.solution.sd[:, 0]) for each in before)
    assert one == pytest.approx(0.5, rel=0.3) and two > 0 and all(each.calibration is None for each in before)
    assert "solve.inflated" in {f.code for f in found.findings}
    P = np.asarray(found.solution.trace.info.P)
    factor = np.repeat([2.0, 1.5, 1.0], 3)  # of hidden positions and velocities: attitude stays
    np.testing.assert_allclose(found.solution.sd, factor * np.sqrt(np.diagonal(P, axis1=1, axis2=2)[:, :9]))
    np.testing.assert_allclose(found.solution.at_imu_rate()[1][-1], found.solution.sd[-1], rtol=1e-6)


@pytest.mark.full
def test_the_judged_filter_is_the_delivered_one(drive, monkeypatch):
    """The same start, filter and parameters, where what is found starts the run later than the datasheet did."""
    judged = []
    monkeypatch.setattr(solve, "calibrate", lambda final: judged.append(final) or calibrate(final))
    monkeypatch.setattr(solve, "_first", pytest.fail)  # nobody asks for an answer before the best one
    monkeypatch.setattr(solve, "options", lambda rec, found: [])

    def later(rec, params):
        return initialize(rec, params, t_start=None if float(params.mounting.time_offset) == 0 else rec.imu.t[0] + 30.0)

    found = solve.solve(drive, fast=True, smooth=False, initialization=later)
    (final,), sol = judged, found.solution
    assert sol.packed.start == final.used.packed.start > drive.imu.t[0] + 30.0
    windows = final.used.windows
    windows = windows._replace(hidden=windows.hidden[:, : sol.packed.t.size])
    error, _ = drift(sol.filter, sol.params, sol.nav, sol.packed.epochs, windows, sol.measurements)
    np.testing.assert_allclose(final.error, error, atol=1e-3)
    test = windows.start >= final.used.layout.validation - 1e-6
    assert test.sum() > 5
    rms = np.sqrt((error[test, :2] ** 2).sum(1).mean())
    assert found.drift_m["solution"] == pytest.approx(rms, rel=1e-3)
    velocities = final.velocities("training", "validation", "test")
    assert len(velocities.age) > 60 and velocities.age.max() > 5.0
    assert consistency(velocities.nees()).error_over_sd == pytest.approx(1.0, abs=0.35)


# ---------------------------------------------------------------------------- measurements


def test_options_are_of_streams_and_findings(drive):
    speed = Samples(np.arange(3.0), np.ones((3, 1)), np.ones((3, 1)), np.zeros((3, 1)))
    rec = drive._replace(aiding=drive.aiding | {"speed": speed})
    yaw = finding("mounting.yaw", value=2.0, count=9, scatter=1.0)
    assert options(drive, []) == []
    rolling = Option(("speed",), ("odometer_scale",))
    assert options(rec, [yaw]) == [rolling, Option(("nonholonomic",), ("vehicle_axes", "wheel_arm_error"))]
    sides = drive._replace(aiding=drive.aiding | {"wheels": speed._replace(value=np.ones((3, 2)), sd=np.ones((3, 2)))})
    assert options(sides, []) == [Option(("wheels",), ("odometer_scale",))]
    turned = finding("mounting.yaw", value=40.0, count=9, scatter=1.0)
    assert options(rec, [turned]) == [rolling]
    level = finding("standstill.accel", value=0.07, setting="", count=30, window=1.0)
    assert options(drive, [level]) == [Option(("zero_velocity", "zero_rate"))]
    assert standing_of([level]).accel_sd == 0.07 and standing_of([]).accel_sd == 0.2


def test_the_sd_of_measurements_grow_to_their_innovations():
    """Wheel speeds of three times their sd in the training part; larger ones after it do not count."""
    filt = build("ekf15", ("position", "speed"))
    t, rng = np.arange(400.0), np.random.default_rng(0)
    nu = rng.normal(size=(1, 400, 4)) * [1.0, 1.0, 1.0, 3.0]
    nu[:, 200:] *= 100.0
    info = SimpleNamespace(nu=nu, S=np.broadcast_to(np.eye(4), (1, 400, 4, 4)), valid=np.ones((1, 400, 4), bool))
    hidden = np.zeros((1, 400), bool)
    used = SimpleNamespace(t=t, layout=SimpleNamespace(train=199.5), windows=SimpleNamespace(hidden=hidden))
    run = SimpleNamespace(used=used, info=info, filter=filt, params=filt.params("consumer"))
    grown = growth(run)
    assert grown == {"measurements.speed.sd_scale": pytest.approx(3.0, rel=0.15)}
    grown["measurements.position.scale"] = 2.0
    new = larger(run.params, grown).measurements
    assert float(new["speed"].sd_scale) == pytest.approx(3.0, rel=0.15)
    np.testing.assert_allclose(new["position"].scale, 2.0 * np.asarray(run.params.measurements["position"].scale))
    info.nu[:] = 0.5
    assert growth(run) == {}  # never smaller: neighbours may be correlated


@pytest.fixture
def tried(monkeypatch):
    """What is taken of runs, one by the factor on the sd: (nll, growth that innovations ask for, taken)."""

    def call(outcome):
        def run(params):
            factor = float(params.measurements["speed"].sd_scale)
            nll, asks, taken = outcome(factor)
            return SimpleNamespace(hidden=lambda *p: SimpleNamespace(nll=lambda: np.full(3, nll)), asks=asks, row=taken)

        option = Option(("speed",))
        monkeypatch.setattr(sensors, "growth", lambda run: {LEAF: run.asks} if run.asks > 1.0 else {})
        monkeypatch.setattr(sensors, "compare", lambda option, before, run: sensors.Tried(option, 1.0, 0.0, run.row))
        runs = lambda candidates: [run(params) for params in candidates]
        params = build("ekf15", ("position", "speed")).params("consumer")
        return sensors._tried(option, None, runs, params, {})[1:]

    return call


LEAF = "measurements.speed.sd_scale"


def test_the_likeliest_sd_of_those_that_are_taken_are_taken(tried):
    own, row = tried(lambda factor: (factor, 1.0, factor > 1.0))
    assert own == {LEAF: 3.0} and row.taken and row.sd == 3.0
    said = sensors.finding_of(row._replace(drift_ratio=0.41, gain=0.8)).message
    assert said.startswith("speed is taken with 3 times its sd: 0.41 times the horizontal drift")
    assert tried(lambda factor: (factor, 1.0, False))[0] == {LEAF: 1.0}  # the likeliest of all, in the finding


def test_sd_that_innovations_contradict_are_not_taken(tried):
    """However likely the hidden fixes are; beyond the ladder they grow as the innovations ask for."""
    assert tried(lambda factor: (factor, 12.0 / factor, True))[0] == {LEAF: 10.0}
    assert tried(lambda factor: (factor, 300.0 / factor, True))[0] == {LEAF: pytest.approx(300.0)}
    assert tried(lambda factor: (0.0, 1e9, True))[0] == {LEAF: pytest.approx(1e21, rel=1.0)}  # the last one, as it is


def test_windows_without_a_measurement_show_no_gain():
    """Of a constraint at rest: those in which the vehicle rests."""
    filt, t = build("ekf15", ("position", "zero_rate")), np.arange(100.0)
    valid = np.ones((2, 100, 6), bool)
    valid[:, :, 3:] = ((t > 40) & (t <= 50))[:, None]
    start = np.array([10.0, 30.0, 39.5, 49.0, 50.0])
    used = SimpleNamespace(
        windows=SimpleNamespace(start=start, phase=np.array([0, 1, 0, 1, 0])), t=t, layout=SimpleNamespace(window=10.0)
    )
    run = SimpleNamespace(used=used, info=SimpleNamespace(valid=valid), filter=filt)
    np.testing.assert_array_equal(sensors.measured(Option(("zero_rate",)), run), [False, False, True, True, False])
    assert sensors.measured(Option((), ("lever_arm_error",)), run).all()


# ---------------------------------------------------------------------------- verdict


def calibrated(inside, fixes=80):
    same = Consistency(1.0, inside, fixes)
    return Calibration(1.0, same, same, [])


@pytest.mark.parametrize(
    ("nis", "inside", "verdict", "why"),
    [
        (1.0, 0.95, "consistent", "NIS/dof 1.00, 95 % of 80"),
        (1.5, 0.95, "usable with care", "larger than their sd"),
        (0.6, 0.95, "usable with care", "smaller than their sd"),
        (1.0, 0.86, "consistent", ""),  # of 20 windows 3 may be outside
        (1.0, 0.8, "usable with care", "too small"),
        (1.0, 1.0, "consistent", ""),  # 20 of 20 inside are no surprise
        (5.0, 0.95, "not usable", "contradict"),
        (1.0, 0.5, "not usable", "contradict"),
    ],
)
def test_the_verdict_is_of_the_test_part(nis, inside, verdict, why):
    found = solve.judge(nis, calibrated(inside), [])
    assert found[0] == verdict and why in found[1]


def test_nis_of_the_verdict_is_of_the_receivers_channels():
    """Wheels with sd ten times their noise, correlated positions, some of them missing."""
    filt, rng, count = build("ekf15", ("position", "speed")), np.random.default_rng(4), 4000
    root = np.array([[1.0, 0.0, 0.0, 0.0], [0.5, 2.0, 0.0, 0.0], [0.0, 0.3, 1.5, 0.0], [0.4, 0.0, 0.1, 1.0]])
    S, nu = np.broadcast_to(root @ root.T, (count, 4, 4)).copy(), rng.normal(size=(count, 4)) @ root.T
    nu[:, 3] *= 0.1
    valid = np.ones((count, 4), bool)
    valid[::3, :3], nu[::3, :3] = False, 0.0
    S[::3, :3], S[::3, :, :3], S[::3, range(3), range(3)] = 0.0, 0.0, 1.0
    late = np.arange(count) > 500
    nu[~late] *= 10.0
    measurements = tuple(MEASUREMENTS[name] for name in filt.model.measurements)
    info = SimpleNamespace(nu=nu, S=S, valid=valid)
    assert solve.receiver_nis(info, measurements, late) == pytest.approx(1.0, abs=0.05)


def test_sd_that_are_larger_for_a_reason_are_not_said_to_be_too_large():
    """Of wheels that were taken with ten times their sd; positions whose sd are too large are said still."""
    filt, rng, count = build("ekf15", ("position", "speed")), np.random.default_rng(4), 1000
    measurements = tuple(MEASUREMENTS[name] for name in filt.model.measurements)
    slow = sensors.Tried(Option(("speed",)), 0.5, 1.0, True, 10.0)
    other = finding("imu.dead", "gyro y", 0.0)

    def said(scale, tried):
        nu = rng.normal(size=(count, 4)) * [*3 * [scale], 0.1]
        S, valid = np.broadcast_to(np.eye(4), (count, 4, 4)), np.ones((count, 4), bool)
        info = SimpleNamespace(nu=nu, S=S, valid=valid, used=valid, nis=(nu**2).sum(1))
        low = consistency_findings(info, nis_by_channel(info, measurements))
        sol = SimpleNamespace(trace=SimpleNamespace(info=info), measurements=measurements, findings=[other, *low])
        return [(f.code, f.subject) for f in solve.unwidened(sol, tried)]

    assert said(1.0, []) == [("imu.dead", "gyro y"), ("nis.low", "speed forward")]
    assert said(1.0, [slow]) == [("imu.dead", "gyro y")]
    assert said(1.0, [slow._replace(taken=False)]) == said(1.0, [slow._replace(sd=1.0)]) == said(1.0, [])
    ((code, subject), _) = said(0.3, [slow])
    assert code == "nis.low" and "position" in subject and "speed" not in subject


def test_a_solution_without_a_test_is_used_with_care_unless_it_contradicts_its_fixes():
    assert solve.judge(1.0, None, []) == ("usable with care", "NIS/dof 1")
    assert solve.judge(5.0, None, []) == ("not usable", "NIS/dof 5: IMU and fixes contradict each other")


def test_exchanged_axes_make_no_trajectory():
    mixed = finding("gyro.sign", "gyro z", was=9.0, then=1.0, gain=99.0, cause="gyro z has the wrong sign")
    assert solve.judge(1.0, calibrated(0.95), [mixed]) == ("not usable", "gyro.sign: gyro z has the wrong sign")


def test_a_recording_without_positions_is_refused(drive):
    gone = finding("stream.empty", "position", words="no row is left of 180", cause="")
    said = finding("stream.assumed_sd", "position", words="3 m", scan="")
    lost = drive._replace(aiding={}, findings=(gone, said))
    with pytest.raises(
        DataError, match="(?s)no positions to start from, and no other.*no row is left of 180.*states no"
    ):
        solve.solve(lost)


@pytest.mark.full
def test_a_short_recording_says_from_which_length_on_it_can_be_tested(drive):
    short = drive._replace(
        imu=drive.imu._replace(**{k: getattr(drive.imu, k)[:1000] for k in ("t", "dt", "gyro", "accel")}),
        aiding={n: sample_rows(s, s.t < 20.0) for n, s in drive.aiding.items()},
    )
    before = []
    found = solve.solve(short, so_far=lambda make: before.append(make()))
    assert found.verdict == "usable with care" and found.tuned is None and found.calibration is None
    (first,) = before
    assert "not tested yet: noise by likelihood to come" in first.why and first.findings and not first.solution.smoothed
    code = first.solution.findings[0].code
    without = solve._untested(first.solution, first.params, [], "", {}, first.standing, first.window_s, gone={code})
    assert code not in {f.code for f in without.findings}
    once = solve.solve(short, limit=1e-3)  # s
    assert [f.subject for f in once.findings if f.code == "solve.time"] == ["noise by likelihood"]
    np.testing.assert_array_equal(once.solution.lla, first.solution.lla)
    (said,) = [f for f in found.findings if f.code == "solve.short"]
    assert "record 120 s" in said.actions[0] and "too short" in found.why
