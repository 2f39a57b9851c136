"""GPID paper (Ansari et al. 2024): Tables 3 and 4 and Figures 3-9, its numbers and ours, and rivals.

An hour on a circle with a GNSS fault from 600 to 1100 s. Three configurations: `literal` is the paper as printed,
`working` has integral and derivative on the position states only, both with the sensors of Table 1; `fitted` is the
working form with noise settings and a reading of the fault that were searched for to come near the paper's tables.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import common
from benchmarks.papers import gpid_claims, gpid_figures
from benchmarks.papers import stability as robustness
from benchmarks.papers.gpid_study import (
    PARTS,
    SCHEMES,
    SCORED,
    TABLES,
    Study,
    as_row,
    fitted_params,
    hours,
    keys_of,
    loss,
    paper_filter,
    rms,
    score,
    study,
)  # fmt: skip
from jaxnav.filters.catalogue import FILTERS, build
from jaxnav.filters.papers.gpid import gpid_params, literal_params
from jaxnav.simulate.scenarios import CIRCLE, READINGS, REPRO, Scenario
from jaxnav.simulate.simulation import matched_params
from jaxnav.simulate.trajectories import shape_of
from tuning.fit.optimizers import adam
from tuning.fit.train import fit
from tuning.fit.transforms import LOG

SEEDS, TRAINING = 24, 6
RIVALS = (
    "ekf9", "ekf15", "ekf9_gate", "ekf15_gate", "ekf9_huber", "ekf15_huber", "ekf9_student", "ekf15_student",
    "ekf9_sage_husa", "ekf15_sage_husa", "ekf9_iae", "ekf15_iae",
)  # fmt: skip
NEVER = "_for_ever"  # a gate that never opens by itself
NOISE = {"noise.gyro": LOG, "noise.accel": LOG, "measurements.position.scale": LOG, "measurements.velocity.scale": LOG}


def coarse(scenario: Scenario) -> Scenario:
    """The same hour with an IMU of 2 Hz, for training: the circle is smooth, and increments lose nothing by it."""
    return scenario._replace(imu_rate_hz=2.0)


def reading(base: Scenario, name: str) -> Scenario:
    """A scenario with the fault read in another way."""
    return base._replace(faults=READINGS[name])


def configurations(seed: int, count: int) -> dict[str, Study]:
    """KF, scheme 1 and scheme 2 in the three configurations."""
    keys, filt = keys_of(seed, 0, count), paper_filter(10)
    sheet = matched_params(CIRCLE)
    circle = hours(CIRCLE, keys)
    return {
        "literal": study(filt, [sheet._replace(rule=literal_params(*g)) for g in SCHEMES.values()], circle),
        "working": study(filt, [sheet._replace(rule=gpid_params(*g)) for g in SCHEMES.values()], circle),
        "fitted": study(filt, [fitted_params(*g) for g in SCHEMES.values()], hours(REPRO, keys)),
    }


def tables(runs: dict[str, Study]) -> dict[str, list[dict]]:
    """Rows of Tables 3 and 4, with the paper's number, for every configuration."""
    result: dict[str, list[dict]] = {}
    for table, (quantities, paper) in TABLES.items():
        result[table] = []
        for configuration, runs_of in runs.items():
            values = rms(runs_of.squares)
            for i, scheme in enumerate(SCHEMES):
                for quantity, printed in zip(quantities, paper[scheme], strict=True):
                    row = {"method": f"{configuration}_{scheme}", "quantity": quantity, "paper": printed}
                    result[table].append(row | as_row(values[quantity][:, i]))
    return result


def print_tables(result: dict[str, list[dict]]) -> None:
    """Paper, ours, sd over seeds, ratio."""
    for table, rows in result.items():
        print(f"\n{table:28} {'quantity':14} {'paper':>10} {'ours':>10} {'sd':>9} {'ratio':>7}")
        for r in rows:
            print(f"  {r['method']:26} {r['quantity']:14} {r['paper']:10.4g} {r['ours']:10.4g} {r['sd']:9.2g} "
                  f"{r['ours'] / r['paper']:7.2f}")  # fmt: skip


def growth_rates(periods: tuple[int, ...]) -> dict[int, dict[str, float]]:
    """Growth of a small error on the circle, 1/s, with the gains that a KF has after so many rounds of 126 s.

    The heading is hardly observed and its variance falls for days: the gains, and with them the rates, depend on how
    long the filter has run.
    """
    sheet = matched_params(CIRCLE)
    lat, lon, h = CIRCLE.start_deg_m
    shape = shape_of(jax.random.key(0), CIRCLE.motion, CIRCLE.duration_s)
    start = jnp.array([np.deg2rad(lat), np.deg2rad(lon), h])
    navs, epochs = robustness.perfect(shape, start, round(CIRCLE.motion.period_s))
    thetas = {"kf": gpid_params(0.0, 0.0)} | {
        f"{form}_g{i}": make(*SCHEMES[f"scheme_{i}"])
        for form, make in (("literal", literal_params), ("position", gpid_params))
        for i in (1, 2)
    }
    filt, rates = paper_filter(10), {}
    for n in periods:  # ki and kd leave P alone
        P = robustness.settle(filt, sheet._replace(rule=thetas["kf"]), navs, epochs, 0.0, n)
        rates[n] = {
            name: robustness.growth_rate(filt, sheet._replace(rule=theta), navs, epochs, P)
            for name, theta in thetas.items()
        }
    return rates


def tuned_gains(seed: int, count: int, steps: int) -> dict:
    """Gains by gradient: on the fitted configuration, and on a KF that is matched to its sensors, without a fault.

    Matched has 15 states: with nine the constant biases of Table 1 are not modelled, and the rule has work to do.
    """
    train, test = (keys_of(seed, purpose, n) for purpose, n in ((1, TRAINING), (0, count)))
    spec = {"rule.ki": LOG, "rule.kd": LOG}
    printed = [fitted_params(*SCHEMES[s]) for s in ("scheme_1", "scheme_2")]
    best = fit(loss(paper_filter(2)), spec, printed[1], steps, arguments=(hours(coarse(REPRO), train),), progress=True)
    held_out = score(study(paper_filter(10), [*printed, best.params], hours(REPRO, test)).squares)
    calm, longer = reading(CIRCLE, "no_fault"), 3 * steps  # in logarithms a gain comes to zero slowly
    matched = matched_params(calm, gpid_params(0.1, 0.1, 15))
    quiet = fit(
        loss(build("gpid15", cov_stride=2)), spec, matched, longer, adam(longer, 0.3),
        arguments=(hours(coarse(calm), train),), progress=True,
    )  # fmt: skip
    kf = matched._replace(rule=gpid_params(0.0, 0.0, 15))
    calm_scores = score(study(build("gpid15", cov_stride=10), [matched, kf, quiet.params], hours(calm, test)).squares)
    gains = lambda p: {"ki": float(p.rule.ki), "kd": float(p.rule.kd)}
    return gains(best.params) | {
        "geo_mean_gain_held_out": float(np.exp(held_out[:2].min() - held_out[2])),
        "matched": gains(quiet.params) | {"cost_of_gains_against_kf": float(np.exp(calm_scores[2] - calm_scores[1]))},
    }


def rivals(seed: int, count: int, steps: int, names: tuple[str, ...]) -> dict[str, dict]:
    """Every reading of the fault: the working form, robust filters, and a KF with noise tuned for that reading."""
    train, test = (keys_of(seed, purpose, n) for purpose, n in ((1, TRAINING), (0, count)))
    sheet = matched_params(CIRCLE)
    result: dict[str, dict] = {}
    for name in READINGS:
        sims = hours(reading(CIRCLE, name), test)
        own = study(paper_filter(10), [sheet._replace(rule=gpid_params(*g)) for g in SCHEMES.values()], sims)
        rows = {scheme: own.squares[:, i : i + 1] for i, scheme in enumerate(SCHEMES) if scheme != "kf"}
        for rival in names:
            filt, theta = build(rival, cov_stride=10), FILTERS[rival].theta()
            thetas = {rival: theta}
            if rival.endswith("_gate"):
                thetas[rival + NEVER] = theta._replace(timeout=jnp.asarray(np.inf))
            runs = study(filt, [matched_params(CIRCLE, t) for t in thetas.values()], sims)
            rows |= {method: runs.squares[:, i : i + 1] for i, method in enumerate(thetas)}
        tuned = fit(loss(build("ekf9", cov_stride=2)), NOISE, sheet, steps,
                    arguments=(hours(coarse(reading(CIRCLE, name)), train),), progress=True)  # fmt: skip
        rows["ekf9_tuned"] = study(build("ekf9", cov_stride=10), [tuned.params], sims).squares
        result[name] = {method: summary(squares) for method, squares in rows.items()}
        print_reading(name, result[name])
    return result


def summary(squares: np.ndarray) -> dict:
    """RMS over the hour and by part, mean and sd over seeds, of one candidate (S, 1, 4, 13)."""
    total = rms(squares)
    row = {name: as_row(total[name][:, 0]) for name in (*SCORED, "latitude_deg", "longitude_deg", "ve_mps", "vn_mps")}
    parts = {part: {name: as_row(rms(squares, part)[name][:, 0]) for name in SCORED} for part in PARTS}
    lost = ~(total["horizontal_m"] < 1e3)  # m over the hour; nan counts
    return row | {"parts": parts, "diverged": int(lost.sum())}


def print_reading(name: str, rows: dict[str, dict]) -> None:
    """One reading's table: mean over seeds, the horizontal error by part of the hour."""
    print(f"\nfault read as {name}; RMS, mean over seeds; horizontal by part of the hour")
    head = f"  {'':16} {'tilt deg':>9} {'yaw deg':>9} {'horiz m':>9} {'alt m':>9} | "
    print(head + " ".join(f"{p:>8}" for p in PARTS))
    for method, r in rows.items():
        head = " ".join(f"{r[q]['ours']:9.4g}" for q in SCORED)
        parts = " ".join(f"{r['parts'][p]['horizontal_m']['ours']:8.3g}" for p in PARTS)
        print(f"  {method:16} {head} | {parts}" + (f"   {r['diverged']} diverged" if r["diverged"] else ""))


def main(argv: list[str]) -> None:
    """Print the tables, draw the figures, write the JSON."""
    parser = common.options("gpid", __doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=0, help="of every random number (default 0)")
    parser.add_argument("--quick", action="store_true", help="two seeds, one step, two rivals")
    parser.add_argument("--figures", default="out/gpid", metavar="DIR", help="folder of Figures 3-9 (default out/gpid)")
    args = parser.parse_args(argv)
    count, steps, names = (2, 1, ("ekf9", "ekf15_gate")) if args.quick else (SEEDS, 30, RIVALS)
    runs = configurations(args.seed, count)
    result: dict = tables(runs)
    print_tables(result)
    rates = growth_rates((29, 86, 1000))
    result["growth_rates"], result["growth_rates_after_rounds"] = rates[86], rates
    print("\ngrowth of a small error on the circle, 1/s, after 29 rounds (1 h), 86 (3 h) and 1000 (35 h)")
    for name in rates[86]:
        print(f"  {name:12}" + "".join(f"{rates[n][name]:+12.2e}" for n in rates))
    result["tuned"] = tuned_gains(args.seed, count, steps)
    print("\ntuned:", result["tuned"])
    result["readings"] = rivals(args.seed, count, steps, names)
    result["per_seed"] = {
        name: {q: v.tolist() for q, v in rms(s.squares).items()} for name, s in runs.items()
    }  # (S, C) each, C in the order of SCHEMES
    result["figures"] = gpid_figures.draw(runs["fitted"], args.figures)
    claimed, printed = gpid_claims.claims(args.seed, count, Path(args.figures))
    result |= claimed | {"figures_printed": gpid_figures.draw(printed, f"{args.figures}/printed")}
    common.write_json(args.json, result | {"seed": args.seed, "seeds": count})
