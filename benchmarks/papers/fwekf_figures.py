"""Figures 5 to 11 of the FWEKF paper from our runs, and the tuned rules' memberships and control surfaces."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.papers import fuzzy_plots as plots_fuzzy
from jaxnav.analysis.plots.base import COLORS, figure, legend, panels, save
from jaxnav.filters.papers import fuzzy_combined, fwekf
from jaxnav.maths import rotations, units
from jaxnav.simulate.simulation import Simulated

SETS = ("zero", "small", "large")
SPANS = ((0.0, 1.0), (0.0, 6.0))
LABELS = ("Z", "S", "L", "NS")
NAMES = ("mean of the residuals, x1", "size of the residuals, x2")
AXES = ("east", "north", "up")
SHOWN = {  # method -> name in a figure
    "ekf": "EKF", "fwekf_hand": "FWEKF by hand", "fwekf_1.0_tuned": "FWEKF tuned, a ≥ 1",
    "fwekf_0.9_tuned": "FWEKF tuned, a ≥ 0.9", "fuzzy_combined_tuned": "fading or a new R, tuned",
}  # fmt: skip


def _components(ax, t, values, names=AXES) -> None:
    for j, name in enumerate(names):
        ax.plot(t, values[:, j], color=COLORS[j], lw=1.0, label=name)
    ax.axvline(20.0, color="0.6", lw=0.8, ls=":")


def reference(truth) -> Any:
    """Figure 5: position, velocity and acceleration along the motion."""
    t = np.asarray(truth.t)
    north = np.asarray((truth.pos[:, 0] - truth.origin.lla[:, 0]) * 6.36e6)
    C = jax.vmap(rotations.to_dcm)(truth.q)
    accel = np.asarray(jnp.einsum("eij,ej->ei", C, truth.force))[:, 1]
    fig = figure(5, 5)
    rows = (north, "position / m"), (truth.vel[:, 1], "velocity / m/s"), (accel, "acceleration / m/s²")
    for ax, (values, label) in zip(panels(fig, 3, 1, "t / s"), rows, strict=True):
        ax.plot(t, values, color=COLORS[0], lw=1.4)
        ax.set_ylabel(label, fontsize=9)
    return fig


def errors(t, columns: dict[str, Any], scale: tuple[float, float] | None = None) -> Any:
    """Figures 6 to 8: position and velocity errors of the corrected INS, a column for each case."""
    fig = figure(4.2 * len(columns), 5)
    axes = panels(fig, 2 * len(columns), len(columns), "t / s")
    for i, (title, e) in enumerate(columns.items()):
        for row, (values, label) in enumerate(((e.position, "position / m"), (e.velocity, "velocity / m/s"))):
            ax = axes[i + row * len(columns)]
            _components(ax, t, np.asarray(values))
            if row == 0:
                ax.set_title(title, fontsize=9)
            if i == 0:
                ax.set_ylabel(label, fontsize=9)
            if scale:
                ax.set_yscale("symlog", linthresh=scale[row])
    legend(fig)
    return fig


def attitude(t, columns: dict[str, Any]) -> Any:
    """Figures 10 and 11: attitude errors."""
    fig = figure(4.2 * len(columns), 3)
    axes = panels(fig, len(columns), len(columns), "t / s")
    for i, (ax, (title, e)) in enumerate(zip(axes, columns.items(), strict=True)):
        angle = np.asarray(e.attitude) / units.DEG
        turned = np.abs(np.diff(angle, axis=0, prepend=angle[:1])) > 180  # past half a turn: the line is broken
        _components(ax, t, np.where(turned, np.nan, angle))
        ax.set_title(title, fontsize=9)
        if i == 0:
            ax.set_ylabel("attitude error / deg", fontsize=9)
    legend(fig)
    return fig


def residuals(t, columns: dict[str, np.ndarray], n: int = 50) -> Any:
    """Figure 9: the mean square of the last n residuals of position and of velocity, divided by n from the start."""
    fig = figure(4.2 * len(columns), 5)
    axes = panels(fig, 2 * len(columns), len(columns), "t / s")
    for i, (title, nu) in enumerate(columns.items()):
        total = np.concatenate([np.zeros((1, 6)), np.cumsum(np.asarray(nu) ** 2, axis=0)])
        k = np.arange(1, total.shape[0])
        power = (total[k] - total[np.maximum(k - n, 0)]) / n
        for row, label in enumerate(("position / m²", "velocity / m²/s²")):
            ax = axes[i + row * len(columns)]
            _components(ax, t, power[:, 3 * row : 3 * row + 3])
            if row == 0:
                ax.set_title(title, fontsize=9)
            if i == 0:
                ax.set_ylabel(label, fontsize=9)
    legend(fig)
    return fig


def by_case(cases: dict[str, dict[str, float]]) -> Any:
    """RMS of position of every case but the noise-free one, a mark for each method."""
    names = [n for n in cases if n != "C1"]
    fig = figure(7.5, 3.4)
    (ax,) = panels(fig, 1, 1, "case")
    for j, (method, label) in enumerate(SHOWN.items()):
        x = np.arange(len(names)) + 0.13 * (j - 2)
        ax.plot(x, [cases[n][method] for n in names], "oDsv^"[j], color=COLORS[j], ms=5.5, label=label)
    ax.set_yscale("log")
    ax.set_yticks([1, 2, 5, 10, 20], ["1", "2", "5", "10", "20"], minor=False)
    ax.set_yticks([], minor=True)
    ax.set_ylabel("RMS of position / m", fontsize=9)
    ax.set_xticks(np.arange(len(names)), names)
    legend(fig, 3)
    return fig


def draw(
    folder: Path, sim: Simulated, data: dict[str, dict], tuned: dict[str, Any], cases: dict[str, dict[str, float]]
) -> list[str]:
    """Write all figures; ``data`` has, by case and method, the errors and innovations of one run."""
    folder.mkdir(parents=True, exist_ok=True)
    truth = jax.tree.map(lambda a: a[0], sim.truth)
    t = np.asarray(truth.t)
    kinds = {"C2": "R = 0.001", "C2m": "R matched"}
    of = lambda m, i=0: {f"{SHOWN[m]}, {kind}": data[c][m][i] for c, kind in kinds.items()}
    figures = {
        "figure_05_reference": reference(truth),
        "figure_06_ekf_noise_free": errors(t, {"EKF, no noise": data["C1"]["ekf"][0]}, (0.01, 0.02)),
        "figure_07_ekf": errors(t, of("ekf")),
        "figure_08_fwekf": errors(t, of("fwekf_hand")),
        "figure_08_fwekf_tuned": errors(t, of("fwekf_1.0_tuned")),
        "figure_09_residuals": residuals(t, of("fwekf_hand", 1)),
        "figure_10_attitude_ekf": attitude(t, of("ekf")),
        "figure_11_attitude_fwekf": attitude(t, of("fwekf_hand")),
        "cases": by_case(cases),
    }
    for name in ("fwekf_0.9_tuned", "fwekf_1.0_tuned"):
        system, hand = tuned[name].system, fwekf.fwekf_params().system
        figures[f"{name}_sets"] = plots_fuzzy.memberships(system, fwekf.TABLE, SPANS, NAMES, (SETS, SETS), hand)
        figures[f"{name}_surface"] = plots_fuzzy.surface(system, fwekf.TABLE, SPANS, NAMES, "weight a", labels=LABELS)
    combined, start = tuned["fuzzy_combined_tuned"], fuzzy_combined.combined_params()
    table, names = fuzzy_combined.TABLE, ("mean of the velocity residuals, m", "size of the residuals, e")
    spans = ((0.0, 1.0), (0.0, 2.5))
    for part, answer in (("fade", "weight a"), ("adapt", "share of the way to the new R")):
        system, before = getattr(combined, part), getattr(start, part)
        figures[f"combined_{part}_sets"] = plots_fuzzy.memberships(system, table, spans, names, (SETS, SETS), before)
        figures[f"combined_{part}_surface"] = plots_fuzzy.surface(system, table, spans, names, answer)
    return [str(save(fig, folder / f"{name}.png")) for name, fig in figures.items()]
