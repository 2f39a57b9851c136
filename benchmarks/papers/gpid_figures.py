"""Figures 3-9 of the GPID paper: errors of one run, KF against both schemes, and the track in the plane."""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from benchmarks.papers.gpid_study import COLUMNS, PARTS, Study

LABELS = ("standard KF", "GPID, scheme 1", "GPID, scheme 2")
COLOURS = ("tab:red", "tab:blue", "tab:green")
ERRORS = {  # figure -> column, label, as in the paper
    3: ("roll_deg", "roll error, deg"),
    4: ("pitch_deg", "pitch error, deg"),
    5: ("yaw_deg", "yaw error, deg"),
    6: ("latitude_deg", "latitude error, deg"),
    7: ("longitude_deg", "longitude error, deg"),
    8: ("altitude_m", "altitude error, m"),
}


def error_panel(ax, study: Study, number: int) -> None:
    """One of Figures 3-8."""
    column, label = ERRORS[number]
    t = np.arange(1, study.series.shape[1] + 1)
    ax.axvspan(*PARTS["in"], color="0.9", label="GNSS fault")
    for series, name, colour in zip(study.series, LABELS, COLOURS, strict=True):
        ax.plot(t, series[:, COLUMNS.index(column)], color=colour, lw=0.8, label=name)
    ax.set(xlabel="time, s", ylabel=label, xlim=(0, t[-1]), title=f"Figure {number}")
    ax.ticklabel_format(axis="y", style="sci", scilimits=(-3, 4))


def track_panel(ax, study: Study) -> None:
    """Figure 9."""
    for track, name, colour in zip(study.track[:-1], LABELS, COLOURS, strict=True):
        ax.plot(*np.rad2deg(track[:, ::-1].T), color=colour, lw=0.6, label=name)
    ax.plot(*np.rad2deg(study.track[-1][:, ::-1].T), "k--", lw=1.2, label="truth")
    ax.set(xlabel="longitude, deg", ylabel="latitude, deg", title="Figure 9")
    ax.set_aspect(1 / np.cos(study.track[-1][0, 0]), adjustable="datalim")
    ax.ticklabel_format(useOffset=False)
    ax.tick_params(axis="x", rotation=30)


def draw(study: Study, folder: str) -> list[str]:
    """Figures 3-9 as a PNG file each, and all of them on one sheet; their paths."""
    out = Path(folder)
    out.mkdir(parents=True, exist_ok=True)
    files = []
    for number in (*ERRORS, 9):
        fig, ax = plt.subplots(figsize=(7, 3.2) if number in ERRORS else (5.5, 5.5), layout="constrained")
        panel(ax, study, number)
        ax.legend(fontsize=8, ncols=2)
        files.append(save(fig, out / f"figure_{number}.png"))
    fig, axes = plt.subplots(4, 2, figsize=(10, 11), layout="constrained")
    for number, ax in zip((*ERRORS, 9), axes.flat, strict=False):
        panel(ax, study, number)
    axes[3, 1].axis("off")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    axes[3, 1].legend(handles, labels, loc="center")
    return [*files, save(fig, out / "figures.png")]


def panel(ax, study: Study, number: int) -> None:
    """Any of the figures."""
    if number in ERRORS:
        error_panel(ax, study, number)
    else:
        track_panel(ax, study)


def save(fig, path: Path) -> str:
    """Write a figure and close it."""
    fig.savefig(path, dpi=110)
    plt.close(fig)
    return str(path)
