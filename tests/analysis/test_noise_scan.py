"""The noise scan: noise and latency of simulated recordings, receiver faults, standstill, what is stated stays."""

import json
from functools import partial
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from jaxnav import build, initialize, navigate, navigation, scan_noise
from jaxnav.analysis import noise_scan
from jaxnav.analysis.boxes import CUBE, vertex
from jaxnav.analysis.noise_scan import FINE_BOX, NoiseScan, _in_motion
from jaxnav.analysis.receiver_errors import on_top
from jaxnav.app import cli
from jaxnav.app.config import resolve
from jaxnav.app.sources import load
from jaxnav.filters.parameters import change, strong
from jaxnav.initialization.initialize import timed
from jaxnav.io.canonical import write_recording
from jaxnav.measurements import MEASUREMENTS
from jaxnav.types import Recording, Samples

FACTOR, LATENCY = 10.0, 0.2
EKF = build("ekf15")


def simulated(factor: float = FACTOR, latency: float = LATENCY, **options) -> Recording:
    """A drive of 120 s, consumer IMU at 50 Hz with ``factor`` times its noise, fixes at 2 Hz."""
    plain = {"duration_s": 120.0, "imu_rate_hz": 50.0, "gnss_rate_hz": 2.0, "grade": "consumer", "outages_s": []}
    data = {"source": "urban_short", "imu_worse_by": factor, "gnss_latency_s": latency, "options": plain | options}
    return load(resolve([("", {"data": data})]))


@pytest.fixture(scope="module")
def drive() -> Recording:
    return simulated()


def with_arm(rec: Recording, scale: float = 0.0):
    """A consumer's datasheet with the recording's lever arm, and with the simulation's scale errors: none."""
    params = change(EKF.params("consumer"), {"noise.scale": scale})
    return params._replace(mounting=params.mounting._replace(lever_arm=rec.lever_arm))


@pytest.mark.full
def test_it_finds_noise_and_latency(drive):
    found = scan_noise(drive, with_arm(drive))
    assert found.latency == pytest.approx(LATENCY, abs=0.03)
    assert 0.5 < found.gyro / FACTOR < 2.0 and 0.5 < found.accel / FACTOR < 2.0
    assert found.gain > 0.1 and found.fixes > 100
    assert 0.001 < found.latency_sd < 0.03 and abs(found.latency - LATENCY) < 3 * found.latency_sd
    params = found.applied(with_arm(drive))
    assert float(params.mounting.time_offset) == pytest.approx(found.latency)
    np.testing.assert_allclose(params.noise.accel / EKF.params("consumer").noise.accel, found.accel)
    assert found.coarse.shape == (5, 9) and found.coarse.max() == 0.0
    N = (found.part[1] - found.part[0]) / noise_scan.CORRELATION_S
    at = [int(np.argmin(np.abs(axis - value))) for axis, value in zip(found.grid, (0.0, 1.0), strict=True)]
    assert 0.0 <= N * found.gain + found.coarse[*at] < 1.0  # what the boxes add to the coarse grid
    assert f"{found.latency:.2f} s late" in found.findings[0].message and found.figure().axes


def test_the_sd_of_a_latency_is_the_curvature_of_its_likelihood():
    """J of a Gaussian of 0.01 s by stretches of 4 s is less curved by 4 / 10; a prior of 0.1 s is part of it."""
    prior = noise_scan.Delay()
    data = (1 / 0.01**2) * noise_scan.WHITENED_S / noise_scan.CORRELATION_S
    points = np.array([0.3, 0.2, 0.1]) + np.array([0.25, 0.25, 0.005]) * CUBE
    J = -0.5 * (data + 1 / prior.sd**2) * (points[:, 2] - 0.102) ** 2 - (points[:, 0] - 0.3) ** 2
    sd = partial(noise_scan._Objective.latency_sd, SimpleNamespace(delay=prior))
    box = np.column_stack([points, J])
    assert sd(box, points[13], 0.0) == pytest.approx((1e4 + 1e2) ** -0.5)
    assert sd(box, points[13], 0.03) == pytest.approx(np.hypot((1e4 + 1e2) ** -0.5, 0.03))
    assert sd(np.column_stack([points, np.full(27, -np.inf)]), points[13], 0.0) == pytest.approx(prior.sd)
    stated = partial(noise_scan._Objective.latency_sd, SimpleNamespace(delay=noise_scan.Delay(free=False)))
    assert stated(box, points[13], 0.0) == 0.0


@pytest.mark.full
def test_scale_errors_are_no_white_noise():
    """An IMU of the datasheet's noise with scale errors and misalignment of 0.01."""
    skewed = {f"{sensor}_{error}": 1e4 if error == "scale_sd_ppm" else 10.0 for sensor in ("gyro", "accel")
              for error in ("scale_sd_ppm", "misalignment_sd_mrad")}  # fmt: skip
    rec = simulated(1.0, 0.0, **skewed)
    white, found = (scan_noise(rec, with_arm(rec, scale)) for scale in (0.0, 3e-3))
    assert white.gyro > 3.0 and white.scale == 1.0
    assert 0.3 <= found.scale <= 3.2 and 0.5 < found.gyro < 2.0 and 0.5 < found.accel < 2.0


@pytest.mark.full
def test_a_receiver_fault_is_no_noise(drive):
    position = drive.aiding["position"]
    far = position.value.copy()
    far[(position.t > 70.0) & (position.t < 73.0), 0] += 200.0 / 6.4e6  # six fixes, 200 m
    faulty = drive._replace(aiding=drive.aiding | {"position": position._replace(value=far)})
    sound, found = (scan_noise(rec, with_arm(rec)) for rec in (drive, faulty))
    assert found.accel < 2.5 * sound.accel and found.latency == pytest.approx(LATENCY, abs=0.1)


@pytest.mark.full
def test_hidden_fixes_are_not_looked_at(drive):
    hidden, position = (60.0, 75.0), drive.aiding["position"]
    far = position.value.copy()
    far[(position.t > 61.0) & (position.t < 74.0), 0] += 1e-4  # 600 m, inside of the window by more than any latency
    changed = drive._replace(aiding=drive.aiding | {"position": position._replace(value=far)})
    one, other = (scan_noise(rec, with_arm(rec), outages=[hidden]) for rec in (drive, changed))
    assert one[:4] == other[:4] and one.gain == other.gain
    np.testing.assert_array_equal(one.receiver.share, other.receiver.share)


def with_slow_errors(rec: Recording, slow: float, tau: float, stated: float = 1.0) -> Recording:
    """White noise as it is, and a Gauss-Markov error of ``slow`` m; the sd is ``stated`` times that of both."""
    position, rng = rec.aiding["position"], np.random.default_rng(5)
    error, step = rng.normal(size=position.value.shape), np.median(np.diff(position.t))
    keep = np.exp(-step / tau)
    for k in range(1, len(error)):
        error[k] = keep * error[k - 1] + np.sqrt(1 - keep**2) * error[k]
    metres = np.array([6.36e6, 6.37e6 * np.cos(position.value[0, 0]), 1.0])
    value = position.value + slow * error[:, [1, 0, 2]] / metres
    moved = position._replace(value=value, sd=stated * np.hypot(slow, position.sd))
    return rec._replace(aiding=rec.aiding | {"position": moved})


@pytest.mark.full
def test_it_splits_what_the_receiver_states(drive):
    """A slow error of 5 m over 30 s beside 2 m of white noise; the receiver states their sum."""
    rec = with_slow_errors(drive, 5.0, 30.0)
    found = scan_noise(rec, with_arm(rec))
    share, tau = found.receiver.share, found.receiver.tau
    odds = share / (1 - share)  # of 5^2 and 2^2 m^2 level, 5^2 and 4^2 up
    np.testing.assert_allclose(np.log10(odds), np.log10([25 / 4, 25 / 16]), atol=0.35)
    np.testing.assert_allclose(np.log10(tau), np.log10(30.0), atol=0.5)
    assert found.receiver.position == 1.0 and not found.assumed.any()
    assert found.latency == pytest.approx(LATENCY, abs=0.1)
    filt, params = found.extended(EKF, with_arm(rec))
    assert "gnss_position_error" in filt.model.states
    params, sd = found.applied(params), found.receiver.sd
    total = np.square(params.measurements["position"].scale * sd) + np.square(params.states["gnss_position_error"].sd)
    np.testing.assert_allclose(total, sd**2)
    assert f"variance {share[0]:.2g} is slow over {tau[0]:.0f} s" in found.findings[0].message


@pytest.mark.full
def test_a_white_receiver_has_few_slow_errors(drive):
    found = scan_noise(drive, with_arm(drive))
    assert found.receiver.share.max() < 0.3 and found.receiver.position == 1.0


@pytest.mark.full
def test_an_sd_that_is_too_small_grows(drive):
    """Positions of three times the stated sd, velocities of 0.4 times."""
    factor = {"position": 3.0, "velocity": 0.4}
    rec = drive._replace(aiding={name: s._replace(sd=s.sd / factor[name]) for name, s in drive.aiding.items()})
    found = scan_noise(rec, with_arm(rec))
    assert found.receiver.position == pytest.approx(3.0, rel=0.4)
    assert found.receiver.velocity == pytest.approx(0.4, rel=0.4)
    assert 0.4 < found.gyro / FACTOR < 2.5 and 0.4 < found.accel / FACTOR < 2.5
    fixes = found.applied(with_arm(rec)).measurements  # without slow errors all of it is white
    np.testing.assert_allclose(fixes["position"].scale, found.receiver.position)
    np.testing.assert_allclose(fixes["velocity"].scale, found.receiver.velocity)
    assert f"sd of positions {found.receiver.position:.2g} times the stated" in found.findings[0].message


class Made(noise_scan._Objective):
    """An objective of known means of innovations, hidden fixes and drift, in place of runs."""

    effective, rows, sd, assumed_sd, scale = 10.0, ("position", "velocity"), np.full(3, 2.0), False, 0.0
    stated = False

    def __init__(self, fit):
        self.fit = fit


def test_the_split_maximises_likelihood_and_prior_together():
    """Parabolas of known maxima, level and up separately; where points drift more, no."""

    def fit(points, hidden, drift=1.0):
        v, odds, tau, above, higher, _ = points[:, 3:9].T
        level = -2.0 * (odds - 1.0) ** 2 - 2.0 * (tau - 2.0) ** 2 - 2.0 * (v - 0.2) ** 2
        up = -2.0 * (above + 0.5) ** 2 - 2.0 * (higher - 1.5) ** 2
        return np.stack([level, up], 1), np.where(odds > 0.4, drift, 1.0)

    # d/dx of -50 (x - a)^2 - ((x - b) / s)^2 / 2 is 0
    peak = lambda a, b, s: (100 * a + b / s**2) / (100 + 1 / s**2)
    centre = np.array([0.6, np.log10(150.0)])
    found, assumed = Made(fit).best_receiver(np.array([1.0, 1.0, 0.2]), [()])
    expected = [peak(0.2, 0.0, 0.5), peak(1.0, centre[0], 1.5), peak(2.0, centre[1], 0.5),
                peak(-0.5, centre[0], 1.5), peak(1.5, centre[1], 0.5), 0.0]  # fmt: skip
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert not assumed.any()
    found, _ = Made(partial(fit, drift=2.0)).best_receiver(np.array([1.0, 1.0, 0.2]), [()])
    assert found[1] <= 0.4  # within the limit
    flat = lambda points, hidden: (np.zeros((len(points), 2)), np.ones(len(points)))
    found, assumed = Made(flat).best_receiver(np.array([1.0, 1.0, 0.2]), [()])
    np.testing.assert_allclose(found, [0.0, *centre, *centre, 0.0], atol=1e-9)
    assert assumed.all() and Made(flat).best_receiver(np.zeros(3), [])[1].all()
    level = lambda points, hidden: (fit(points, hidden)[0] * [1, 0], np.ones(len(points)))
    found, assumed = Made(level).best_receiver(np.array([1.0, 1.0, 0.2]), [()])
    np.testing.assert_allclose(found[3:5], centre)
    assert assumed.tolist() == [False, True]


@pytest.mark.parametrize(
    ("drift", "taken"),
    [
        ([1.0, 2.0, 3.0, 2.0, 1.0, 1.0], 0),
        ([1.1, 1.01, 3.0, 2.0, 1.0, 1.0], 1),
        ([1.1, 1.1, 0.3, 2.0, 1.0, 1.0], 2),
        ([1.1, 1.1, 1.1, 0.9, 1.0, 1.0], 3),
        ([1.1, 1.1, 1.1, 1.1, 1.0, 1.0], 4),
        ([1.1, 1.1, 1.1, 1.1, 1.1, 1.0], 5),
    ],
)
def test_a_scan_is_taken_as_far_as_it_does_no_harm(drift, taken):
    """All, else with slow errors on top of the stated ones, of that delay and scale errors, neither, the datasheet."""
    made = Made(lambda points, hidden: (points[:, :2], np.array(drift)))
    point, white, safe = (
        np.array([2.0, 1.5, 0.2, -0.5, 0.3, 2.0, 0.1, 1.8, 0.0, 0.5]),
        noise_scan.WHITE,
        on_top(made.sd),
    )
    delay, none = [0.0, 0.0, 0.2], [0.0, 0.0, 0.0]
    kept = [point, [2.0, 1.5, 0.2, *safe, 0.5], [*delay, *safe, 0.5], [*none, *safe, 0.5], [*none, *safe, 0.0],
            [*none, *white, 0.0]]  # fmt: skip
    found, ratio, harm = made.harmless(point, [()])
    np.testing.assert_array_equal(found, kept[taken])
    assert (ratio, harm) == (drift[taken], drift[0])
    plain = NoiseScan(latency=0.2, fixes=50, drift_ratio=0.3, harm=1.1)
    assert [f.code for f in plain.findings] == ["noise.scan", "noise.harm"]
    assert "the datasheet's noise and this delay is taken" in plain.findings[1].message
    assert plain.metrics()["harm"] == 1.1 and "harm" not in NoiseScan().metrics()


@pytest.mark.full
@pytest.mark.parametrize("early", [0.46, -0.6])
def test_a_delay_that_alignments_show_is_found(early):
    """Fixes that are early, or later than the grid of an unknown delay reaches with its prior."""
    rec = simulated(factor=1.0, latency=0.0)
    rec = rec._replace(aiding={name: s._replace(t=s.t - early) for name, s in rec.aiding.items()})
    found = scan_noise(rec, with_arm(rec))
    assert found.latency == pytest.approx(-early, abs=0.02)
    assert 0.5 < found.gyro < 2.0 and 0.5 < found.accel < 2.0 and found.drift_ratio < 0.7


@pytest.mark.full
def test_a_stated_value_stays(drive):
    params = with_arm(drive)
    stated = params._replace(mounting=params.mounting._replace(time_offset=np.asarray(0.18)))
    found = scan_noise(drive, stated)
    assert found.latency == 0.0 and found.accel > 3.0 and float(found.applied(stated).mounting.time_offset) == 0.18
    fixes = {name: theta._replace(scale=np.asarray(2.0)) for name, theta in params.measurements.items()}
    found = scan_noise(drive, params._replace(measurements=fixes))
    assert found.receiver.position == found.receiver.velocity == 1.0 and not found.receiver.share.any()
    assert found.latency == pytest.approx(LATENCY, abs=0.05)


def test_defaults_of_measurements_state_nothing(drive):
    """Of all rows together, as the command line has them: an odometer's scale is none of the fixes'."""
    every = {name: strong(row.defaults) for name, row in MEASUREMENTS.items()}
    params = with_arm(drive)._replace(measurements=every)
    assert not noise_scan.stated_scale(params) and not timed(params)


@pytest.mark.full
def test_slow_errors_that_are_stated_stay(drive):
    filt = build("ekf15", states=("gnss_position_error",))
    params = with_arm(drive)._replace(states=filt.params("consumer").states)
    found = scan_noise(drive, params)
    assert not found.receiver.share.any()
    kept = found.applied(params)
    assert kept.states["gnss_position_error"].sd == params.states["gnss_position_error"].sd


def test_a_few_fixes_are_too_few(drive):
    found = scan_noise(drive, with_arm(drive), stop=initialize(drive, with_arm(drive)).t + 8.0)
    assert found.fixes == 0 and found.gyro == 1.0 and found.findings[0].code == "noise.datasheet"


def test_it_begins_where_the_vehicle_moves():
    """Parked for 200 s, then driving: the scan begins 15 s before the first motion."""
    rec = simulated(duration_s=120.0, latency=0.0, factor=1.0)
    parked = lambda s: s._replace(
        t=np.concatenate([s.t[0] - np.arange(400, 0, -1) / 2, s.t]),
        **{f: np.concatenate([np.repeat(getattr(s, f)[:1], 400, 0), getattr(s, f)]) for f in ("value", "sd", "corr")},
    )
    position = parked(rec.aiding["position"])
    value = np.concatenate([np.zeros((400, 3)), rec.aiding["velocity"].value])
    velocity = Samples(position.t, value, np.full_like(value, 0.1), np.zeros_like(value))
    imu, n = rec.imu, 10_000
    rest = lambda a: np.repeat(np.median(a[:50], 0)[None], n, 0)
    t0 = imu.t[0]
    long = imu._replace(
        t=np.concatenate([t0 - np.arange(n, 0, -1) / 50.0, imu.t]), dt=np.concatenate([np.full(n, 0.02), imu.dt]),
        gyro=np.concatenate([rest(imu.gyro), imu.gyro]), accel=np.concatenate([rest(imu.accel), imu.accel]),
    )  # fmt: skip
    rec = rec._replace(imu=long, aiding={"position": position, "velocity": velocity})
    begin = initialize(rec, with_arm(rec), t_start=float(long.t[0]))
    assert begin.t < t0 - 100.0
    assert _in_motion(rec, with_arm(rec), begin, float(imu.t[-1])).t > t0 - 15.0


def test_the_quadratic_fit_is_exact_on_a_quadratic():
    A = np.array([[2.0, 0.3, 0.1], [0.3, 1.5, -0.2], [0.1, -0.2, 1.0]])
    centre, peak = np.array([1.0, 1.5, 0.1]), np.array([0.3, -0.4, 0.6])
    d = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3, indexing="ij"), -1).reshape(27, 3)
    J = -np.einsum("ni,ij,nj->n", d - peak, A, d - peak)
    points = np.column_stack([centre + d * FINE_BOX, J])
    np.testing.assert_allclose(vertex(points, centre, FINE_BOX), centre + peak * FINE_BOX, atol=1e-12)
    convex = np.column_stack([points[:, :3], -J])
    np.testing.assert_array_equal(vertex(convex, centre, FINE_BOX), convex[np.argmax(-J), :3])


@pytest.mark.full
def test_navigate_without_params_takes_noise_and_lever_arm_from_the_recording(monkeypatch):
    """Its run is made ready while the noise is scanned: one program for both."""
    ran, execute = [], navigation.execute

    def recorded(filt, params, navs, epochs, parked):
        ran.append((filt, jax.tree.map(np.shape, (params, navs, epochs))))
        return execute(filt, params, navs, epochs, parked)

    monkeypatch.setattr(navigation, "execute", recorded)
    arm = np.array([1.5, -0.4, -1.8])
    rec = simulated(factor=1.0, latency=0.0, lever_arm_m=arm.tolist())
    solution = navigate(rec, EKF)
    assert len(ran) == 2 and ran[0] == ran[1]
    assert solution.noise is not None and solution.noise.findings[0] in solution.findings
    assert any(note.startswith("lever arm (1.5, -0.4, -1.8) m from the recording") for note in solution.notes)
    truth = np.column_stack([np.interp(solution.t, rec.truth.t, c) for c in rec.truth.lla.T])
    off = (solution.lla - truth) * np.array([6.37e6, 6.37e6 * np.cos(truth[0, 0]), 1.0])
    z = off[20:, [1, 0, 2]] / solution.sd[20:, :3]
    assert 0.4 < np.sqrt(np.mean(z**2)) < 1.4  # a slow error within its word is never ruled out
    named = navigate(rec, EKF, EKF.params("consumer"))
    assert named.noise is None and np.allclose(named.params.mounting.lever_arm, arm)


def test_work_at_the_side_of_a_scan_cannot_fail_it():
    with navigation._aside(lambda: 1 / 0, wanted=True):
        done = True
    assert done


@pytest.mark.full
def test_a_run_is_repeated_without_a_search(drive, tmp_path, monkeypatch):
    folder, out = tmp_path / "drive", tmp_path / "out"
    write_recording(folder, drive)
    files = ["--set", "out.figures=files"]
    assert cli.main(["filter", "--data", str(folder), "--out", str(out), "--quiet", *files]) == 0
    run = json.loads((out / "run.json").read_text())
    assert run["config"]["filter"]["grade"] == "consumer" and run["config"]["mounting"]["time_offset_s"] > 0.1
    assert run["metrics"]["grade"] == "auto" and run["metrics"]["noise_scan"]["latency_s"] > 0.1
    assert (out / "noise_scan.png").exists()
    assert run["config"]["filter"]["states"] == ["gnss_position_error"]
    good = run["metrics"]["accuracy"]
    assert 0.0 < good["relative_m"] < good["earth_m"]
    monkeypatch.setattr(noise_scan, "_Objective", None)  # a search would fail
    again = tmp_path / "again"
    assert cli.main(["filter", "--config", str(out / "run.json"), "--out", str(again), "--quiet"]) == 0
    first, second = (np.genfromtxt(where / "solution.csv", delimiter=",", names=True) for where in (out, again))
    for name in first.dtype.names:  # parameters are written in the user's units
        np.testing.assert_allclose(second[name], first[name], rtol=1e-9, atol=1e-9, err_msg=name)
    stated = ["--set", "noise.accel_ug_per_sqrt_hz=500", "--set", "out.figures=none"]  # as a tuned.toml does
    assert cli.main(["filter", "--data", str(folder), "--out", str(tmp_path / "stated"), "--quiet", *stated]) == 0


@pytest.mark.full
def test_a_wrong_scale_of_a_gyro_does_not_pass_for_its_noise():
    """The noise that fits takes up 70 % of each turn and the run is consistent, but the turns tell."""
    rec = simulated(1.0, 0.0)
    wrong = rec._replace(imu=rec.imu._replace(gyro=rec.imu.gyro * [1.0, 1.0, 0.3]))
    codes = {f.code: f for f in navigate(wrong, EKF).findings}
    assert codes["gyro.turns"].warns and 0.2 < codes["gyro.turns"].value < 0.45
    assert "gyro.turns" not in {f.code for f in navigate(rec, EKF).findings}
