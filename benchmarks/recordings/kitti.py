"""KITTI's drive 0027 as GTSAM ships it: this filter and GTSAM's incremental smoother on the same hidden windows.

Both get the same IMU, the same fixes of 1 Hz, hidden for 15 s at a time, and the sigmas of the file that comes with
them. GTSAM: pre-integrated IMU factors, biases that walk, a prior on the position of every fix that is not hidden, and
`ISAM2`, which relinearises the whole past; its estimate at a window's end uses earlier fixes. ours: `ekf15` from a
start in motion. Then ours tuned without truth on one half of the time and judged on the other, each half in turn.
"""

import os
import time
from pathlib import Path

import numpy as np

from benchmarks import common
from benchmarks.recordings.wild import RECIPES
from jaxnav import Solution, build, initialize, navigate, read
from jaxnav.analysis.tables import table
from jaxnav.analysis.windows import Windows, drift, hidden_windows
from jaxnav.filters import epochs as ep
from jaxnav.filters.core import Filter
from jaxnav.filters.parameters import change, datasheet_params
from jaxnav.maths.units import TICK
from jaxnav.states.grades import Grade
from jaxnav.types import Params, Recording
from tuning.recordings.recorded import Tuned, spread, tune

# the metadata file that ships with the recording, of samples at 100 Hz
ACCEL, GYRO, ACCEL_WALK, GYRO_WALK = 0.01, 1.75e-4, 1.67e-4 * 10, 2.91e-6 * 10
ACCEL_BIAS, GYRO_BIAS = 0.1, 5e-5  # m/s^2, rad/s: initial sd of GTSAM's example
SHEET = Grade(GYRO, ACCEL, GYRO_BIAS, ACCEL_BIAS, 0.0, 0.0, 3600.0, "GTSAM", GYRO_WALK, ACCEL_WALK)
FILE_SD = 0.07  # m, of a fix in docs/recipes/kitti.toml
SD = {"file": FILE_SD, "example": FILE_SD**0.5}  # as the number reads; as GTSAM's example takes it, for a variance
WINDOW, EVERY, PHASES, SETTLE = 15.0, 30.0, 6, 30.0  # s
FIRST, GATHER = 1, 20  # the first fix after the gap in the IMU; fixes before GTSAM's first update, as in its example
RECIPE = RECIPES / "kitti.toml"
DATA = Path(os.environ.get("JAXNAV_DATA_DIR", ".")) / "gtsam_kitti"
FILES = (("KittiEquivBiasedImu.txt", " "), ("KittiGps_converted.txt", ","))


def isam(hidden: np.ndarray, sd: float) -> np.ndarray:
    """Estimate minus fix (N, 3) m at every fix as ISAM2 knows it when it comes, the fixes of a mask (N,) kept from it.

    In metres of the files, z up, axes of the IMU forward, left, up.
    """
    import gtsam
    from gtsam.symbol_shorthand import B, V, X

    imu, fixes = (np.loadtxt(DATA / name, skiprows=1, delimiter=by) for name, by in FILES)
    t, local = fixes[:, 0], fixes[:, 1:]
    params = gtsam.PreintegrationParams.MakeSharedU(9.8)
    params.setAccelerometerCovariance(ACCEL**2 * np.eye(3))
    params.setGyroscopeCovariance(GYRO**2 * np.eye(3))
    params.setIntegrationCovariance(np.zeros((3, 3)))
    settings = gtsam.ISAM2Params()
    settings.setFactorization("CHOLESKY")
    settings.relinearizeSkip = 10
    smoother = gtsam.ISAM2(settings)
    known = gtsam.noiseModel.Isotropic.Sigma(3, sd)
    walk = np.array([ACCEL_WALK] * 3 + [GYRO_WALK] * 3)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    pose, speed, bias = gtsam.Pose3(gtsam.Rot3(), local[FIRST]), np.zeros(3), gtsam.imuBias.ConstantBias()
    graph.addPriorPose3(X(FIRST), pose, gtsam.noiseModel.Diagonal.Precisions(np.array([0, 0, 0, 1.0, 1.0, 1.0])))
    graph.addPriorVector(V(FIRST), speed, gtsam.noiseModel.Isotropic.Sigma(3, 1000.0))
    sds = np.array([ACCEL_BIAS] * 3 + [GYRO_BIAS] * 3)
    graph.addPriorConstantBias(B(FIRST), bias, gtsam.noiseModel.Diagonal.Sigmas(sds))
    off = np.full(local.shape, np.nan)
    for k in range(FIRST, len(t)):
        if k > FIRST:
            measured = gtsam.PreintegratedImuMeasurements(params, bias)
            for row in imu[(imu[:, 0] > t[k - 1]) & (imu[:, 0] <= t[k])]:
                measured.integrateMeasurement(row[2:5], row[5:8], row[1])
            graph.push_back(gtsam.ImuFactor(X(k - 1), V(k - 1), X(k), V(k), B(k - 1), measured))
            between = gtsam.noiseModel.Diagonal.Sigmas(np.sqrt(t[k] - t[k - 1]) * walk)
            graph.push_back(gtsam.BetweenFactorConstantBias(B(k - 1), B(k), gtsam.imuBias.ConstantBias(), between))
            guess = measured.predict(gtsam.NavState(pose, speed), bias)
            pose, speed = guess.pose(), guess.velocity()
            if k <= FIRST + GATHER:  # heading is not known yet: the first guess is the fix
                pose = gtsam.Pose3(pose.rotation(), local[k])
        if not hidden[k]:
            graph.push_back(gtsam.GPSFactor(X(k), local[k], known))
        for key, value in ((X(k), pose), (V(k), speed), (B(k), bias)):
            values.insert(key, value)
        if k > FIRST + GATHER:
            smoother.update(graph, values)
            graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
            known_now = smoother.calculateEstimate()
            pose, speed, bias = known_now.atPose3(X(k)), known_now.atVector(V(k)), known_now.atConstantBias(B(k))
            off[k] = pose.translation() - local[k]
    return off


def score(off: np.ndarray) -> dict:
    """Figures of horizontal drifts (W,) m."""
    return {f"drift_{k}": v for k, v in spread(off).items()} | {"windows": off.size, "drift_m": off.tolist()}


def ours(sol: Solution, filt: Filter, params: Params, packed: ep.Packed, windows: Windows) -> np.ndarray:
    """Horizontal drift (W,) m of a filter with some parameters from a solution's start."""
    error, _ = drift(filt, params, sol.nav, packed.epochs, windows, sol.measurements)
    return np.hypot(error[:, 0], error[:, 1])


def tuned(rec: Recording, filt: Filter, sheet: Params, middle: float) -> dict[str, Tuned]:
    """Results on either half alone."""
    found = {
        "first": tune(rec, filt, sheet, stop=middle, log=print),
        "second": tune(rec, filt, sheet, initialization=initialize(rec, sheet, t_start=middle), log=print),
    }
    for half, each in found.items():
        print(f"{half} half: {each.verdict}", flush=True)
    return found


def main(argv: list[str]) -> None:
    """Print the table, write the JSON."""
    parser = common.options("kitti", __doc__.splitlines()[0])
    parser.add_argument("--no-tune", action="store_true", help="leave out the tuning of both halves (minutes)")
    args = parser.parse_args(argv)
    rec = read(RECIPE)
    filt = build("ekf15", measurements=["position"], cov_stride=5)
    results: dict[str, dict] = {}
    for name, sd in SD.items():
        sheet = datasheet_params(SHEET, measurements=["position"])
        sheet = change(sheet, {"measurements.position.scale": np.full(3, sd / FILE_SD)})
        sol = navigate(rec, filt, sheet)
        packed = ep.pack_recording(sol.recording, sol.measurements, sol.initialization.t)
        windows = hidden_windows(packed, WINDOW, EVERY, PHASES, SETTLE)
        results["jaxnav" if name == "file" else f"jaxnav, {name}"] = score(
            ours(sol, sol.filter, sol.params, packed, windows)
        )
        begin = time.perf_counter()
        ends = np.searchsorted(rec.aiding["position"].t, packed.t[windows.end] - TICK)
        off = np.empty(windows.end.size)
        for p in range(PHASES):
            at = rec.aiding["position"].t
            of = windows.phase == p
            hidden = ((at[:, None] > windows.start[of] + TICK) & (at[:, None] <= windows.start[of] + WINDOW)).any(1)
            error = isam(hidden, sd)[ends[of]]
            off[of] = np.hypot(error[:, 0], error[:, 1])
        seconds = time.perf_counter() - begin
        results["gtsam" if name == "file" else f"gtsam, {name}"] = score(off) | {"seconds": seconds}
    if not args.no_tune:
        middle = float(packed.t[0] + packed.t[-1]) / 2
        off = np.full(windows.end.size, np.nan)
        late = windows.start > middle
        sheet = datasheet_params(SHEET, measurements=["position"])
        for half, each in tuned(rec, filt, sheet, middle).items():
            judged = late if half == "first" else windows.start + WINDOW < middle
            # the start is that of the whole recording: the tuned parameters are handed over
            off[judged] = ours(sol, each.filter, sol.initialization.apply_to(each.params), packed, windows)[judged]
        kept = ~np.isnan(off)
        results["jaxnav, tuned"] = score(off[kept])
        for name in ("jaxnav", "gtsam"):
            results[f"{name}, same windows"] = score(np.array(results[name]["drift_m"])[kept])
    head = ["filter", "windows", "median m", "RMS m", "largest m"]
    rows = [[n, r["windows"], r["drift_median_m"], r["drift_rms_m"], r["drift_max_m"]] for n, r in results.items()]
    print(table(head, rows))
    common.write_json(args.json, results)
