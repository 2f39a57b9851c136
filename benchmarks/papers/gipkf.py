"""GIP-KF against Kalman filters in GNSS outages of 10, 11 and 22 s: random urban drives, recorded ones, the paper's.

Three sets of drives with an ADIS16488A and 1 Hz fixes: nominal, uncalibrated (the gyros' biases at switch-on stay) and
stress (scale errors, correlated fixes, a lever arm and a latency that no filter knows). The error is the horizontal
distance of the IMU at the end of an outage. Tuned means: by gradient on other drives, with new outages at each step.
"""

import json
from functools import cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import common
from benchmarks.papers import flops, gipkf_claims, gipkf_figures, gipkf_recorded
from benchmarks.papers import gipkf_study as study
from benchmarks.papers.nine_states import nine_params, nine_states
from jaxnav.analysis import metrics
from jaxnav.filters.catalogue import FILTERS, build
from jaxnav.filters.core import Filter, make_filter
from jaxnav.filters.error_model import error_model
from jaxnav.filters.feedback import reset
from jaxnav.filters.papers.gip_kf import gip_kf_params
from jaxnav.filters.parameters import change, get, late, mounting, put
from jaxnav.maths import units
from jaxnav.simulate.scenarios import SCENARIOS, Scenario
from jaxnav.simulate.simulation import matched_params
from jaxnav.strapdown.frames import FRAMES
from jaxnav.types import Params
from tuning.fit.transforms import IDENTITY, LOG, Spec
from tuning.fit.transforms import scaled as scaled_by

TUNED = Path(__file__).with_name("gipkf_tuned.json")  # results of such runs
SETS = {"nominal": "gipkf_urban", "uncalibrated": "gipkf_urban_uncalibrated", "stress": "gipkf_urban_stress"}
TRAIN, TEST, FIRST_TEST = 48, 64, 1000  # drives
# by its turns and brakes a drive's heading and its velocity along and across walk at random so fast, for up to 22 s
HEADING_WALK = 0.19  # rad/sqrt(s)
VELOCITY_WALK = np.array([1.9, 1.4, 0.0])  # m/s/sqrt(s), forward, right, down
FIGURES = Path("out/gipkf/figures.png")
CLAIMED = ("ekf15_datasheet", "gipkf_body_dm_hand", "gipkf_body_dm_tuned", "gipkf_literal_open", "gipkf_literal_shift")
PAPER = {"gipkf": 15.15, "ekf": 79.63, "gipkf_22": 82.0, "ekf_22": 455.0}  # m: Table 1, and Fig. 7 after 22 s
ROWS = {  # method -> filter of the catalogue
    "ekf15_datasheet": "ekf15", "ekf15_tuned": "ekf15", "ekf9_tuned": "ekf9", "gipkf_literal_open": "gipkf_literal",
    "gipkf_literal_shift": "gipkf_literal_shift", "gipkf_body_dm_hand": "gipkf", "gipkf_constant_tuned": "gipkf",
    "gipkf_body_dm_tuned": "gipkf_learning", "gipkf_mix_tuned": "gipkf_mix", "nine_states_tuned": "",
    "gipkf_literal_open_tuned": "gipkf_literal", "gipkf_literal_shift_tuned": "gipkf_literal_shift",
    "gipkf_coupled_tuned": "gipkf_learning",
}  # fmt: skip
_SCALES = ("measurements.position.scale", "measurements.velocity.scale")
_WHITE: Spec = dict.fromkeys(("noise.gyro", "noise.accel", *_SCALES), LOG)
_EKF9: Spec = _WHITE | {"prior.attitude": LOG}
_GIP_KF: Spec = _EKF9 | {"rule.log_rl": IDENTITY}
_BIAS = (
    "states.gyro_bias.driving_noise",
    "states.accel_bias.driving_noise",
    "states.gyro_bias.sd",
    "states.accel_bias.sd",
)
SPECS: dict[str, Spec] = {
    "ekf15_tuned": _EKF9 | dict.fromkeys(_BIAS, LOG),
    "ekf9_tuned": _EKF9,
    "gipkf_constant_tuned": _GIP_KF,
    "gipkf_body_dm_tuned": _GIP_KF | {"rule.growth": LOG, "rule.unlearnt": LOG},
    "gipkf_mix_tuned": _GIP_KF | {"rule.kappa": LOG},
    "gipkf_literal_open_tuned": _GIP_KF,
    "gipkf_literal_shift_tuned": _GIP_KF,
    "gipkf_coupled_tuned": _GIP_KF
    | {"rule.growth": LOG, "rule.unlearnt": LOG, "rule.log_rm": IDENTITY, "rule.rm_lower": scaled_by(0.03)},
    "nine_states_tuned": dict.fromkeys(("noise.gyro", "noise.accel", "measurements.velocity.scale"), LOG)
    | dict.fromkeys(("prior.attitude", *_BIAS), LOG)
    | {f"rule.{name}": LOG for name in ("walk", "lag", "vertical", "kappa", "early", "delay", "fade")},
}
CRIPPLED = {  # of the datasheet's 15-state filter: names of leaves -> factor
    "bias prior x0.01": {"states.gyro_bias.sd": 0.01, "states.accel_bias.sd": 0.01},
    "biases frozen": dict.fromkeys(_BIAS, 0.0),
    "accelerometer bias frozen": {"states.accel_bias.driving_noise": 0.0, "states.accel_bias.sd": 0.0},
    "process noise x100": {"noise.gyro": 100.0, "noise.accel": 100.0},
    "measurement sd x100": {"measurements.position.scale": 100.0, "measurements.velocity.scale": 100.0},
}


def scenario(name: str) -> Scenario:
    """A set's scenario with every fix: outages are masks."""
    chosen = SCENARIOS[SETS[name]]
    return chosen._replace(gnss=chosen.gnss._replace(outages_s=(), random_outages=0))


@cache
def filter_of(method: str) -> Filter:
    """In the tangent frame, the covariance moved once an epoch; the EKF15's feedback keeps a biased levelling."""
    if method == "nine_states_tuned":
        model = error_model("tangent", form="simple")
        return make_filter(FRAMES["tangent"].propagate, model, nine_states(), reset, study.SAMPLES)
    feedback = study.reset_balanced if ROWS[method] == "ekf15" else None
    return build(ROWS[method], cov_stride=study.SAMPLES, feedback=feedback, frame="tangent")


@cache
def plain_ekf15() -> Filter:
    """With the feedback of any filter."""
    return build("ekf15", cov_stride=study.SAMPLES, frame="tangent")


def scaled(params: Params, factors: dict[str, Any]) -> Params:
    """Leaves of noise and prior times a factor."""
    for name, factor in factors.items():
        params = put(params, name, factor * get(params, name))
    return params


def noise_figures(name: str) -> Params:
    """The grade's noise and biases and the start's; without scale errors and errors of the stress set."""
    return late(matched_params(scenario(name))._replace(mounting=mounting()), 0.0, 0.0)


def datasheet(name: str) -> Params:
    """And the scale errors of the nominal set, as the noise that they make of turns and brakes.

    Levelling ties the tilt to the accelerometers' bias, whose prior is then that of both: a prior of the tilt's own,
    here 5 times as wide, would count the same knowledge twice.
    """
    params = scaled(noise_figures(name), {"prior.attitude": np.array([5.0, 5.0, 1.0])})
    sheet, noise = scenario("nominal").imu, params.noise
    gyro = units.PPM * sheet.gyro_scale_sd_ppm * HEADING_WALK * np.array([0, 0, 1])
    accel = units.PPM * sheet.accel_scale_sd_ppm * VELOCITY_WALK
    return params._replace(noise=noise._replace(gyro=jnp.hypot(noise.gyro, gyro), accel=jnp.hypot(noise.accel, accel)))


def hand_set(name: str, kappa: float = 0.0) -> Params:
    """For nine states: white noise wide enough to stand for the biases, small and constant shares of model error."""
    gyro = 20.0 if name == "uncalibrated" and kappa else 8.0
    noise = {"noise.gyro": gyro * np.ones(3), "noise.accel": 10.0 * np.ones(3)}
    params = scaled(noise_figures(name), noise)
    scales = jnp.array([1.5, 1.5, 0.8]), jnp.array([1.7, 1.7, 0.6])
    params = change(
        params, dict(zip(("measurements.position.scale", "measurements.velocity.scale"), scales, strict=True))
    )
    return params._replace(rule=gip_kf_params(0.001, 0.03, kappa))


def learning(params: Params) -> Params:
    """Shares and noise for the biases that fall as these are learnt; of `hand_set`'s noise the rest stays."""
    known = FILTERS["gipkf_learning"].theta()
    rule = params.rule._replace(growth=known.growth, unlearnt=known.unlearnt)
    return scaled(params, {"noise.gyro": 0.25})._replace(rule=rule)


def coupled(params: Params) -> Params:
    """The same filter, ready for couplings: attitude as dear as velocity, or one to it would have to be large."""
    log_rm = params.rule.log_rm
    return params._replace(rule=params.rule._replace(log_rm=log_rm.at[6:].set(log_rm[3:6])))


def nine_set(name: str) -> Params:
    """For `nine_states`: noise on the z gyro for its bias, which is learnt from the start if it was not calibrated."""
    raw = name == "uncalibrated"
    gains = nine_params(kappa=0.015, early=0.8, fade=0.25, fading=8.0) if raw else nine_params()
    params = scaled(noise_figures(name), {"noise.gyro": np.array([1.0, 1.0, 14.0 if raw else 4.0])})
    return params._replace(rule=gains)


def start_of(method: str, name: str) -> Params:
    """Parameters before tuning."""
    if method == "nine_states_tuned":
        return nine_set(name)
    if method == "gipkf_mix_tuned":
        return hand_set(name, 0.04 if name == "uncalibrated" else 0.002)
    if method in ("gipkf_body_dm_hand", "gipkf_constant_tuned"):
        return hand_set(name)
    if method == "gipkf_body_dm_tuned":
        return learning(hand_set(name))
    params = datasheet(name) if ROWS[method] == "ekf15" else noise_figures(name)
    return params._replace(rule=FILTERS[ROWS[method]].theta())


def tuned_params(name: str, key: jax.Array, train: int, steps: int, only: tuple[str, ...] = ()) -> dict[str, Params]:
    """Parameters of every method on one set: tuned, or of ``only`` some, and without steps, of a full run."""
    params = {method: start_of(method, name) for method in ROWS}
    if not steps or only:
        found = json.loads(TUNED.read_text())[name]
        for method, leaves in found.items():
            for leaf, value in leaves.items():
                params[method] = put(params[method], leaf, jnp.asarray(value, float))
    if not steps:
        return params
    for method in only:
        params[method] = start_of(method, name)
    drives = study.drive(scenario(name), jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(train)))
    calm = name == "nominal"  # on the others couplings from tuned weights are lost in the first steps
    steer = jax.random.fold_in(key, 7 * FIRST_TEST)
    for method, spec in SPECS.items() if not only else [(m, SPECS[m]) for m in only]:
        if method == "gipkf_coupled_tuned":
            params[method] = coupled(params["gipkf_body_dm_tuned"] if calm else learning(hand_set(name)))
        filt, rate = filter_of(method), 0.03 if calm and method == "gipkf_coupled_tuned" else 0.1
        params[method], losses = study.tune(filt, params[method], spec, drives, steer, steps, rate)
        print(f"  tuned {method}: loss {np.mean(losses[:10]):.3f} -> {np.mean(losses[-10:]):.3f}", flush=True)
    return params


def one_set(name: str, params: dict[str, Params], key: jax.Array, test: int) -> tuple[dict, study.Drives, jax.Array]:
    """Every method on the held-out drives of one set, which are returned with their outages."""
    drives = study.drive(scenario(name), jax.vmap(jax.random.fold_in, (None, 0))(key, FIRST_TEST + jnp.arange(test)))
    windows = study.draw(jax.random.fold_in(key, 5 * FIRST_TEST), test)
    scores = {method: study.score(filter_of(method), p, drives, windows) for method, p in params.items()}
    distance = {m: np.hypot(*np.moveaxis(np.asarray(s.ends)[..., :2], -1, 0)) for m, s in scores.items()}
    print(f"\n{name}: {test} held-out drives, RMS of the horizontal error at the end, m; wins against ekf15_tuned")
    print(study.HEADER)
    found = {}
    for method, s in scores.items():
        found[method] = study.summary(s, distance["ekf15_datasheet" if method == "ekf15_tuned" else "ekf15_tuned"])
        print(study.line(method, found[method]), flush=True)
    return found, drives, windows


def consistency(name: str, drives: study.Drives, windows: jax.Array) -> dict:
    """NEES of the datasheet's EKF15 around each outage, and without its consistent parts."""
    bounds = metrics.chi2_bounds(9, windows.shape[0])
    print(f"\nNEES of 9 states before | at the end of each outage, 95 % bounds {bounds[0]:.2f} to {bounds[1]:.2f}")
    found: dict = {"bounds": bounds}
    better = filter_of("ekf15_datasheet")
    for label, filt, params in (
        ("linear feedback, no scale error", plain_ekf15(), noise_figures(name)),
        ("no scale error", better, noise_figures(name)),
        ("ekf15_datasheet", better, datasheet(name)),
    ):
        s = study.score(filt, params, drives, windows)
        before, end = np.asarray(s.nees).mean(0)
        found[label] = {"before": before.tolist(), "end": end.tolist()}
        rms = study.summary(s, None)["22"]
        print(f"  {label:34} {np.round(before, 2)} | {np.round(end, 2)}   RMS at 22 s {rms:.2f} m")
    return found


def crippled(params: Params, drives: study.Drives, windows: jax.Array, gip: dict) -> dict:
    """The datasheet's EKF made worse, and by how much the tuned GIP-KF then seems better."""
    found = {}
    print("\nnominal, a crippled EKF15, and GIP-KF's gain at 10, 11 and 22 s (the paper: about 80 % at 22 s)")
    for name, factors in CRIPPLED.items():
        s = study.score(plain_ekf15(), scaled(params, factors), drives, windows)
        found[name] = study.summary(s, None)
        found[name]["gain"] = [1 - gip[k] / found[name][k] for k in ("10", "11", "22")]
        gain = "  ".join(f"{100 * g:5.0f} %" for g in found[name]["gain"])
        print(f"  {name:28} {found[name]['10']:8.2f} {found[name]['11']:8.2f} {found[name]['22']:8.2f}     {gain}")
    return found


def table1(result: dict) -> dict:
    """The paper's Table 1, RMS of the horizontal error over the whole drive with its three outages, and ours."""
    rows = {"GIP-KF, paper": PAPER["gipkf"], "EKF, paper": PAPER["ekf"]}
    rows |= {name: r["whole_rms"] for name, r in result["nominal"].items()}
    rows |= {f"EKF15, {name}": r["whole_rms"] for name, r in result["crippled"].items()}
    print("\nTable 1, horizontal RMS of the whole drive, m")
    for name, value in rows.items():
        print(f"  {name:36} {value:9.2f}")
    return rows


def figures(path: Path, params: dict[str, Params], drives: study.Drives, windows: jax.Array) -> None:
    """Figures 5 to 10 on the first drive."""
    shown = {name: (filter_of(method), params[method])
             for name, method in (("EKF15", "ekf15_datasheet"), ("GIP-KF", "gipkf_body_dm_tuned"))}  # fmt: skip
    shown["EKF15, biases frozen"] = plain_ekf15(), scaled(noise_figures("nominal"), CRIPPLED["biases frozen"])
    infos = {name: gipkf_figures.solve(filt, p, drives, windows, 0) for name, (filt, p) in shown.items()}
    truth = jax.tree.map(lambda a: a[0], drives.truth)
    path.parent.mkdir(parents=True, exist_ok=True)
    gipkf_figures.draw(path, infos, truth, np.asarray(windows[0]))
    two = {name: infos[name] for name in ("EKF15", "GIP-KF")}
    gipkf_claims.draw(path.with_stem(f"{path.stem}_as_printed"), two, truth, np.asarray(windows[0]))


def show_claims(result: dict) -> None:
    """Print the claims of the text beyond its table."""
    print("\nobservability, ranks over a minute: x of eqs. 22 and 26; (x, m) of eq. 23, all that rounding leaves")
    for name, r in result["observability"].items():
        print(f"  {name:12} {r['state']} of {r['state_of']}; {r['input']} of {r['input_of']}, {r['input_by_rounding']}")
    print("growth of a small error on a circle, 1/s:", {m: f"{v:+.1e}" for m, v in result["growth"].items()})
    print("\naround the outages of 10, 11 and 22 s, RMS")
    for m, r in result["around"].items():
        print(f"  {m:28} " + "; ".join(f"{k} {' / '.join(f'{v:.3g}' for v in values)}" for k, values in r.items()))


def main(argv: list[str]) -> None:
    """Print the tables; write the JSON and the figures."""
    parser = common.options("gipkf", __doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="the nominal set, 8 drives, no tuning, nothing recorded")
    parser.add_argument("--seed", type=int, default=0, help="of the drives, default 0")
    help = "of tuning, default 50; 0 takes stored results of such runs, as --quick does"
    parser.add_argument("--steps", type=int, default=50, help=help)
    args = parser.parse_args(argv)
    steps, train, test = (0, 0, 8) if args.quick else (args.steps, TRAIN, TEST)
    key = jax.random.key(args.seed)
    result: dict = {"seed": args.seed, "steps": steps, "paper": PAPER, "tuned": {}}
    for name in reversed(["nominal"] if args.quick else list(SETS)):  # nominal last: later parts use it
        params = tuned_params(name, key, train, steps)
        result["tuned"][name] = {m: {leaf: get(params[m], leaf) for leaf in spec} for m, spec in SPECS.items()}
        result[name], drives, windows = one_set(name, params, key, test)
    result["nees"] = consistency("nominal", drives, windows)
    result["crippled"] = crippled(noise_figures("nominal"), drives, windows, result["nominal"]["gipkf_body_dm_tuned"])
    result["table1"] = table1(result)
    result["flops"] = flops.table()
    flops.show(result["flops"])
    if not args.quick:
        result["recorded"] = gipkf_recorded.table()
    chosen = {m: (filter_of(m), params[m]) for m in CLAIMED}
    result["observability"] = gipkf_claims.ranks(*chosen["gipkf_body_dm_hand"], drives)
    result["growth"] = gipkf_claims.growth(chosen)
    result["around"] = {m: gipkf_claims.around(*each, drives, windows) for m, each in chosen.items()}
    show_claims(result)
    literal = ("gipkf_literal_open_tuned", "gipkf_literal_shift_tuned")
    result["literal_tuned"] = {s: {m: result[s][m] for m in literal} for s in SETS if s in result}
    figures(args.json.with_suffix(".png") if args.json else FIGURES, params, drives, windows)
    ratio = result["nominal"]["gipkf_body_dm_tuned"]["22"] / result["nominal"]["ekf15_tuned"]["22"]
    print(f"\nTuned alike, GIP-KF ends a 22 s outage {ratio:.1f} times as far off as an EKF of 15 states. Its gain")
    print("in the paper appears only against an EKF with frozen or overconfident biases, or one that hardly measures.")
    worst = max(result[name]["nine_states_tuned"][k] / result[name]["ekf15_tuned"][k]
                for name in SETS if name in result for k in ("10", "11", "22"))  # fmt: skip
    print(f"A covariance of other nine states, with gains for the rest, ends at most {worst:.2f} times as far off.")
    common.write_json(args.json, result)
