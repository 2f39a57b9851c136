"""Claims of the GPID paper beyond its two tables: readings of its noise, its gains, settling times, cost.

*Readings*: the printed form and its neighbours with the fitted noise, and the fitted noise as units that were not
converted (0.001 deg/sqrt(h) taken for 0.001 deg a sample at 50 Hz, 0.03 m/s/sqrt(h) for 0.03 m/s/sqrt(s)). Latitude,
radius and speed of the circle, and both rates, are assumptions: the paper names none.
"""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.papers import flops
from benchmarks.papers.gpid_study import (
    COLUMNS,
    PARTS,
    SCHEMES,
    TABLE4,
    TABLES,
    Study,
    as_row,
    fitted_params,
    hours,
    keys_of,
    paper_filter,
    rms,
    score,
    study,
)  # fmt: skip
from jaxnav.analysis.plots import base as plots
from jaxnav.filters.papers.gpid import gpid_params, literal_params
from jaxnav.filters.parameters import change
from jaxnav.maths import earth, units
from jaxnav.simulate.scenarios import READINGS, REPRO
from jaxnav.simulate.simulation import Simulated

KILOMETRES = {"kf": 1.37, "scheme_1": 0.44, "scheme_2": 0.30}  # Table 4's last column
FAST = REPRO._replace(name="gpid_repro_10_hz", gnss_rate_hz=10.0)
MIXED = REPRO._replace(name="gpid_repro_constant", faults=READINGS["constant"])
BOTH = ("position", "velocity")
GAINS = np.array([-0.3, 0.0, 0.3, 0.6, 1.0, 1.5, 2.0, 3.0]), np.array([-1.0, 0.0, 1.0, 2.0, 3.0, 5.0, 8.0, 12.0])
CALM = 10.0  # m, twice the receiver's sd of an axis: a horizontal error that stays below it has settled
MINUTE = 60  # s that it is averaged over for that
RULES = (
    "ekf9", "ekf15", "gpid", "gpid15", "fwekf", "fwekf15", "ekf9_sage_husa", "ekf15_sage_husa", "ekf9_iae",
    "ekf15_iae", "ekf9_huber", "ekf15_huber", "gipkf", "gipkf_literal",
)  # fmt: skip


def held(sims: Simulated) -> Simulated:
    """Fixes of 10 Hz with errors drawn once a second: eqs. 44 and 45 with an error that stays between fixes."""

    def one(sim: Simulated) -> Simulated:
        value, truth = sim.epochs.fix.value, sim.truth
        error = jnp.concatenate(
            [jax.vmap(earth.enu_difference)(value[:, :3], truth.pos), value[:, 3:6] - truth.vel], axis=1
        )
        error = error[jnp.arange(value.shape[0]) // 10 * 10]
        kept = jnp.concatenate([jax.vmap(earth.move)(truth.pos, error[:, :3]), truth.vel + error[:, 3:6]], axis=1)
        return sim._replace(epochs=sim.epochs._replace(fix=sim.epochs.fix._replace(value=kept)))

    return jax.jit(jax.vmap(one))(sims)


def unconverted(params: Any) -> Any:
    """The fitted parameters with Table 1's numbers in units that they are not in."""
    return change(params, {"noise.gyro": 0.001 * units.DEG * np.sqrt(50.0), "noise.accel": 0.03})


def rows_of(found: Study) -> dict[str, dict]:
    """Both tables, ours, mean and sd over seeds, by scheme."""
    table = rms(found.squares)
    return {
        name: {scheme: {q: as_row(table[q][:, i]) for q in quantities} for i, scheme in enumerate(SCHEMES)}
        for name, (quantities, _) in TABLES.items()
    }


def readings(seed: int, count: int) -> tuple[dict[str, dict], Study]:
    """Tables 3 and 4 in every reading of the form and of the noise; and the printed form's runs."""
    keys, filt = keys_of(seed, 0, count), paper_filter(10)
    once, often, mixed = hours(REPRO, keys), hours(FAST, keys), hours(MIXED, keys)
    fitted = lambda make: [fitted_params()._replace(rule=make(*gains)) for gains in SCHEMES.values()]
    on_both = lambda ki, kd: gpid_params(ki, kd, states=BOTH)
    printed = study(filt, fitted(literal_params), once)
    found = {
        "literal_fitted": printed,
        "literal_fitted, 10 Hz": study(filt, fitted(literal_params), often),
        "literal_fitted, 10 Hz, error held": study(filt, fitted(literal_params), held(often)),
        "literal_fitted, 50 m and 0.5 m/s": study(filt, fitted(literal_params), mixed),
        "position and velocity, fitted": study(filt, fitted(on_both), once),
        "position, fitted, 50 m and 0.5 m/s": study(filt, fitted(gpid_params), mixed),
        "position, units not converted": study(filt, [unconverted(p) for p in fitted(gpid_params)], once),
        "literal, units not converted": study(filt, [unconverted(p) for p in fitted(literal_params)], once),
    }
    return {name: rows_of(each) | {"finite": float(np.mean(each.ok))} for name, each in found.items()}, printed


def kilometres(latitude: float) -> dict[str, float]:
    """Table 4's last column over the length of its latitude and longitude columns, s^0.5: sqrt(3600) = 60."""
    worth = np.asarray(earth.metres_per_radian(jnp.array([latitude * units.DEG, 0.0, 0.0])))[:2] * units.DEG
    return {s: 1e3 * km / float(np.hypot(*(worth * TABLE4[s][:2]))) for s, km in KILOMETRES.items()}


def settling(found: Study) -> dict[str, np.ndarray]:
    """Of every candidate's first seed: how far off it is at most after the fault, and how long it takes to be calm, s.

    Calm: the horizontal error's RMS over a minute stays below `CALM`.
    """
    east, north = (found.series[..., COLUMNS.index(name)] for name in ("east_m", "north_m"))
    error = np.hypot(east, north)
    within, rest = error[:, slice(*PARTS["in"])], error[:, PARTS["in"][1] :]
    minute = np.sqrt(np.apply_along_axis(lambda e: np.convolve(e**2, np.ones(MINUTE) / MINUTE, "valid"), 1, rest))
    above = minute > CALM
    settled = np.where(above.any(1), above.shape[1] - np.argmax(above[:, ::-1], 1), 0).astype(float)
    settled[above[:, -1] | ~np.isfinite(rest).all(1)] = np.inf
    return {"overshoot_m": rest.max(1), "in_fault_max_m": within.max(1), "settled_s": settled}


def gain_map(seed: int, count: int) -> dict[str, Any]:
    """The fitted configuration over ki and kd, all pairs side by side, by the geometric mean of its four RMS."""
    pairs = [(float(ki), float(kd)) for ki in GAINS[0] for kd in GAINS[1]]
    found = study(paper_filter(10), [fitted_params(*pair) for pair in pairs], hours(REPRO, keys_of(seed, 0, count)))
    shape = len(GAINS[0]), len(GAINS[1])
    grid = lambda a: np.asarray(a).reshape(shape)
    own = settling(found)
    finite = grid(found.ok.all(0))
    return {
        "ki": GAINS[0].tolist(), "kd": GAINS[1].tolist(), "finite": finite.tolist(),
        "geo_mean": np.where(finite, grid(np.exp(score(found.squares))), np.inf).tolist(),
        "horizontal_m": grid(rms(found.squares)["horizontal_m"].mean(0)).tolist(),
        **{name: grid(values).tolist() for name, values in own.items()},
    }  # fmt: skip


def draw_map(found: dict[str, Any], path: Path) -> str:
    """Error and overshoot over the gains; the printed pairs marked."""
    fig = plots.figure(10.0, 4.4)
    for ax, key, title in zip(
        fig.subplots(1, 2), ("geo_mean", "overshoot_m"),
        ("geometric mean of the four RMS", "largest horizontal error after the fault, m"), strict=True,
    ):  # fmt: skip
        values = np.array(found[key], float)
        shown = np.log10(np.where(np.isfinite(values) & (values > 0), np.minimum(values, 100.0), 100.0))
        image = ax.imshow(shown.T, origin="lower", cmap="viridis_r", aspect="auto")
        for i, j in np.ndindex(values.shape):
            text = f"{values[i, j]:.3g}" if values[i, j] < 1e4 else "lost"
            ax.text(i, j, text, ha="center", va="center", fontsize=6, color="white" if shown[i, j] > 1.5 else "black")
        for ki, kd in list(SCHEMES.values())[1:]:
            ax.plot(found["ki"].index(ki), found["kd"].index(kd), "s", ms=26, mfc="none", mec=plots.VERMILION, mew=1.6)
        plots.dress(ax, title, "ki", "kd")
        ax.grid(False)
        ax.set_xticks(range(len(found["ki"])), [f"{v:g}" for v in found["ki"]])
        ax.set_yticks(range(len(found["kd"])), [f"{v:g}" for v in found["kd"]])
        fig.colorbar(image, ax=ax, label="log10", shrink=0.85)
    plots.save(fig, path)
    return str(path)


def operations() -> dict[str, dict]:
    """A cycle of each rule, by hand where its formulas are in print, and compiled."""
    return {name: flops.of(name) for name in RULES}


def claims(seed: int, count: int, folder: Path) -> tuple[dict[str, Any], Study]:
    """Everything, printed; and the printed form's runs with the fitted noise."""
    found, printed = readings(seed, count)
    print("\nreadings with the fitted noise: RMS of roll, pitch, yaw deg; latitude, longitude 1e-5 deg; altitude m")
    for name, tables in found.items():
        print(f"  {name}" + ("" if tables["finite"] == 1 else f"   {tables['finite']:.0%} of the runs finite"))
        for scheme in SCHEMES:
            angles = [tables["table3"][scheme][q]["ours"] for q in TABLES["table3"][0]]
            lat, lon, alt = (tables["table4"][scheme][q]["ours"] for q in TABLES["table4"][0])
            print(f"    {scheme:10}" + "".join(f"{v:10.3g}" for v in (*angles, 1e5 * lat, 1e5 * lon, alt)))
    by_latitude = {str(lat): kilometres(lat) for lat in (20, 28, 30)}
    print("\nTable 4's km over its other columns, by latitude (sqrt(3600) = 60):", by_latitude)
    settled = {name: values.tolist() for name, values in settling(printed).items()}
    own = settling(study(paper_filter(10), [fitted_params(*g) for g in SCHEMES.values()],
                         hours(REPRO, keys_of(seed, 0, 1))))  # fmt: skip
    print("\nafter the fault, one run: KF, scheme 1, scheme 2")
    for name, values in own.items():
        print(f"  {name:16}" + "".join(f"{v:10.4g}" for v in values))
    over = gain_map(seed, min(count, 4))
    cost = operations()
    flops.show(cost)
    result = {
        "literal_fitted": found["literal_fitted"], "readings_of_the_noise": found, "kilometres": by_latitude,
        "settling": {k: v.tolist() for k, v in own.items()}, "settling_literal": settled, "gain_map": over,
        "operations": cost, "figure_gain_map": draw_map(over, folder / "gain_map.png"),
    }  # fmt: skip
    return result, printed
