"""Facts about the figures: what is drawn, in which unit, and what the numbers in their titles say."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from scipy.stats import chi2

from jaxnav.analysis.plots import base as plots
from jaxnav.analysis.plots import stats as plots_stats
from jaxnav.maths import units
from jaxnav.types import Samples, Track

N = 200
T = np.arange(N, dtype=float)
OUTAGES = [(20.0, 40.0), (120.0, 150.0)]


def walk(seed: int, *shape: int) -> np.ndarray:
    return np.cumsum(np.random.default_rng(seed).normal(size=shape), axis=0)


def noise(seed: int, *shape: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape)


def line(ax, label):
    """The data of the only line with this label."""
    (found,) = [l for l in ax.lines if l.get_label() == label]
    return np.asarray(found.get_xdata(), float), np.asarray(found.get_ydata(), float)


def height(curve):
    return np.asarray(curve.get_ydata(), float)


def band(ax):
    """The heights of the outline of the only filled band."""
    (found,) = [c for c in ax.collections if isinstance(c, PolyCollection)]
    return np.asarray(found.get_paths()[0].vertices)[:, 1]


def legend(fig):
    assert len(fig.legends) == 1
    return [text.get_text() for text in fig.legends[0].get_texts()]


def shaded(ax):
    return sorted((p.get_x(), p.get_x() + p.get_width()) for p in ax.patches if isinstance(p, Rectangle))


def track(east, north):
    """A track by metres east and north of 48 N 179.9999 E, 500 m, with the radii of curvature there."""
    lat, lon, h = np.deg2rad(48.0), np.deg2rad(179.9999), 500.0
    w = np.sqrt(1.0 - 0.00669437999014 * np.sin(lat) ** 2)
    meridian, prime = 6378137.0 * (1 - 0.00669437999014) / w**3, 6378137.0 / w
    lla = np.stack([lat + north / (meridian + h), lon + east / ((prime + h) * np.cos(lat)), np.full(N, h)], axis=1)
    lla[:, 1] = (lla[:, 1] + np.pi) % (2 * np.pi) - np.pi
    return Track(T, lla, np.zeros((N, 3)), np.zeros((N, 3)))


NAMES = (
    "noise.gyro_deg_per_sqrt_hour", "noise.accel_ug_per_sqrt_hz",
    "states.gyro_bias.driving_noise_deg_per_hour_per_sqrt_s", "states.accel_bias.driving_noise_ug_per_sqrt_s",
    "measurements.position.latency_s",
)  # fmt: skip


@pytest.fixture(scope="module")
def every_figure():
    error, sd = walk(0, N, 9), np.full((N, 9), 10.0)
    path = track(10.0 * T, walk(1, N))
    methods = {"EKF": np.abs(noise(2, 30)), "tuned": np.abs(noise(3, 30))}
    row = lambda i: {"step": i, "loss": 1 / (i + 1), "grad_norm": 0.5**i, "params": dict.fromkeys(NAMES, 2.0**-i)}
    history = [row(i) for i in range(9)]
    S = np.broadcast_to(np.eye(3), (N, 3, 3))
    return {
        "trajectory": plots.trajectory(path, path, Samples(T, path.lla, error[:, :3], error[:, :3]), OUTAGES),
        "errors": plots.errors(T, error, sd, OUTAGES),
        "biases": plots.biases(T, 1e-5 * error[:, :3], error[:, 3:6], outages=OUTAGES),
        "innovations": plots_stats.innovations(T, noise(4, N, 3), S, np.ones((N, 3), bool), list("abc"), OUTAGES),
        "nis": plots_stats.nis(T, noise(5, N) ** 2, np.ones(N), OUTAGES),
        "outage_drift": plots_stats.outage_drift(methods),
        "tuning": plots_stats.tuning(history),
    }


# ---------------------------------------------------------------------------- all figures


def test_every_figure_has_labels_a_legend_and_nothing_clipped_or_overlapping(every_figure):
    for name, fig in every_figure.items():
        fig.draw_without_rendering()
        page = fig.bbox.padded(1.0)
        boxes = [ax.get_tightbbox() for ax in fig.axes]
        below = fig.legends[0].get_window_extent()
        for ax, box in zip(fig.axes, boxes):
            bottom = ax.get_subplotspec().is_last_row()
            assert not bottom or ax.get_xlabel(), name
            assert page.contains(box.x0, box.y0) and page.contains(box.x1, box.y1), name
            assert not any(box.overlaps(other) for other in boxes if other is not box), name
            assert not box.overlaps(below), name
        labels = [ax.get_xlabel() for ax in fig.axes] + [ax.get_ylabel() for ax in fig.axes]
        for text in filter(None, labels):
            assert text == "Step" or text[-1] == ")" and "(" in text, (name, text)


@pytest.mark.parametrize("name", ["errors", "biases", "innovations", "nis"])
def test_outages_are_shaded_in_every_panel_with_one_legend_entry(every_figure, name):
    fig = every_figure[name]
    assert all(shaded(ax) == OUTAGES for ax in fig.axes)
    assert legend(fig).count("GNSS outage") == 1
    assert len(legend(fig)) == len(set(legend(fig)))


def test_outages_are_cut_to_the_run_and_must_not_be_empty():
    fig = plots.errors(T, walk(0, N, 9), outages=[(-50.0, -20.0), (-9.0, 10.0), (190.0, 900.0), (500.0, 600.0)])
    assert shaded(fig.axes[0]) == [(0.0, 10.0), (190.0, 199.0)]
    assert fig.axes[0].get_xlim() == (0.0, 199.0)
    with pytest.raises(ValueError, match="start < end"):
        plots.errors(T, walk(0, N, 9), outages=[(10.0, 10.0)])


def test_drawing_is_lazy_and_without_pyplot(tmp_path):
    code = f"""
import sys
import numpy as np
from jaxnav.analysis.plots import base, stats
assert "matplotlib" not in sys.modules and "scipy.stats" not in sys.modules
base.save(stats.outage_drift({{"a": np.arange(5.0)}}), {str(tmp_path / "a.png")!r})
assert "matplotlib.pyplot" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[2])
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")


# ---------------------------------------------------------------------------- save


def test_save_is_reproducible_and_replaces(tmp_path):
    path = tmp_path / "a.png"
    path.write_text("old")
    make = lambda: plots_stats.outage_drift({"a": np.arange(5.0)})
    assert plots.save(make(), path) == path
    plots.save(make(), tmp_path / "b.png")
    data = path.read_bytes()
    assert data == (tmp_path / "b.png").read_bytes() and b"Software" not in data
    assert int.from_bytes(data[16:20], "big") == round(10.0 * 120)
    assert sorted(os.listdir(tmp_path)) == ["a.png", "b.png"]


@pytest.mark.parametrize("where", ["savefig", "replace"])
def test_save_leaves_the_old_file_and_no_temporary_on_failure(tmp_path, monkeypatch, where):
    path = tmp_path / "a.png"
    path.write_text("old")

    def fail(*args, **_):
        if where == "savefig":
            args[1].write_text("half of it")
        raise OSError("disk full")

    monkeypatch.setattr(*((Figure, "savefig") if where == "savefig" else (os, "replace")), fail)
    with pytest.raises(OSError, match="disk full"):
        plots.save(plots_stats.outage_drift({"a": np.arange(5.0)}), path)
    assert path.read_text() == "old" and os.listdir(tmp_path) == ["a.png"]


def test_save_takes_png_only(tmp_path):
    with pytest.raises(ValueError, match="png"):
        plots.save(plots_stats.outage_drift({"a": np.arange(5.0)}), tmp_path / "a.pdf")


# ---------------------------------------------------------------------------- one run


def test_trajectory_is_in_metres_about_its_first_point_across_the_date_line():
    east, north = 20.0 * T, walk(1, N) - walk(1, N)[0]
    path, truth = track(east, north), track(east + 3.0, north - 4.0)
    fixes = Samples(T, track(east + 1.0, north).lla, np.ones((N, 3)), np.zeros((N, 3)))
    fixes.value[7, 0] += 0.1  # 640 km
    fig = plots.trajectory(path, truth, fixes, OUTAGES)
    (ax,) = fig.axes
    for label, e, n in (("estimated", east, north), ("truth", east + 3.0, north - 4.0)):
        np.testing.assert_allclose(line(ax, label), (e, n), atol=1e-6)
    np.testing.assert_allclose(line(ax, "GNSS")[0], east + 1.0, atol=1e-6)
    assert ax.get_aspect() == 1.0 and max(ax.get_ylim()) < 1e4  # the stray fix does not flatten the rest
    x, y = line(ax, "GNSS outage")
    lost = ((T >= 20) & (T <= 40)) | ((T >= 120) & (T <= 150))
    assert (np.isfinite(x) == lost).all() and (np.isfinite(y) == lost).all()
    assert legend(fig) == ["GNSS outage", "GNSS", "estimated", "truth", "start", "end"]
    assert legend(plots.trajectory(path)) == ["estimated", "start", "end"]


def test_trajectory_of_a_vehicle_that_stands():
    (ax,) = plots.trajectory(track(0 * T, 0 * T)).axes
    assert ax.get_xlim()[1] > 0.4 and ax.get_ylim()[1] > 0.4


def test_errors_are_nine_panels_with_their_share_inside():
    error, sd = np.zeros((N, 9)), np.ones((N, 9))
    error[:, 1] = 2.9
    error[:50, 1] = -3.1  # a quarter
    error[:100, 8] = np.nan
    error[100:110, 8] = 4.0  # a tenth of the known
    fig = plots.errors(T, error, sd)
    titles = [ax.get_title() for ax in fig.axes]
    names = ["north", "east", "down"] * 2 + ["roll", "pitch", "heading"]
    assert [t.split(":")[0] for t in titles] == names
    assert "75.0 %" in titles[1] and "90.0 %" in titles[8] and "100.0 %" in titles[0]
    units_of = [ax.get_ylabel() for ax in fig.axes if ax.get_ylabel()]
    assert units_of == ["Position error (m)", "Velocity error (m/s)", "Attitude error (deg)"]
    for i, ax in enumerate(fig.axes):
        np.testing.assert_array_equal(line(ax, "estimate − truth")[1], error[:, i])
        assert np.abs(band(ax)).max() == 3.0


def test_errors_without_truth_are_left_out():
    error = walk(0, N, 9)
    error[:, 5:] = np.nan
    fig = plots.errors(T, error, np.ones((N, 9)))
    assert len(fig.axes) == 6
    assert not fig.axes[5].lines and [t.get_text() for t in fig.axes[5].texts] == ["no truth"]
    assert not fig.axes[4].texts
    assert len(plots.errors(T, np.full((N, 9), np.nan)).axes) == 9


def test_an_infinite_value_is_outside():
    error = np.zeros((N, 9))
    error[:20, 0] = np.inf
    assert plots.errors(T, error, np.ones((N, 9))).axes[0].get_title() == "north: 90.0 % inside ±3σ"
    above = plots_stats.nis(T, np.where(T < 20, np.inf, 3.0), np.full(N, 3)).axes[0]
    assert "90.0 %" in above.get_title() and line(above, "off scale")[0].size == 20


def test_errors_by_name_equal_the_array():
    error = walk(0, N, 9)
    fig = plots.errors(T, {"position": error[:, :3], "attitude": error[:, 6:]})
    assert [ax.get_title() for ax in fig.axes] == ["north", "east", "down", "roll", "pitch", "heading"]
    np.testing.assert_array_equal(line(fig.axes[3], "estimate − truth")[1], error[:, 6])
    with pytest.raises(ValueError, match=r"error must have shape \(200, 9\), got \(200, 6\)"):
        plots.errors(T, error[:, :6])


def test_one_spike_does_not_flatten_a_panel_and_an_outage_is_not_a_spike():
    error = 0.5 * noise(0, N, 9)
    error[77, 0] = 1e4
    error[100:120, 1] = np.linspace(0.0, 80.0, 20)
    error[5, 2] = 2.5 * np.abs(error[:, 2]).max()
    fig = plots.errors(T, error, np.full((N, 9), 0.5), OUTAGES)
    assert fig.axes[0].get_ylim()[1] < 5.0
    x, y = line(fig.axes[0], "off scale")
    assert x == [77.0] and y == [fig.axes[0].get_ylim()[1]]
    assert all(fig.axes[i].get_ylim()[1] > np.abs(error[:, i]).max() for i in range(1, 9))
    assert legend(fig).count("off scale") == 1 and "off scale" not in legend(plots.errors(T, error[:, [1] * 9]))


def test_a_wide_envelope_does_not_flatten_the_errors():
    error, sd = 0.5 * noise(0, N, 9), np.full((N, 9), 0.5)
    sd[:5] = 100.0
    assert plots.errors(T, error, sd).axes[0].get_ylim()[1] < 6.0
    assert plots.errors(T, error, 20.0 * sd).axes[0].get_ylim()[1] > 30.0  # but a cautious filter is shown as one


def test_a_single_epoch_and_all_zero_errors_can_be_drawn():
    fig = plots.errors(np.zeros(1), np.zeros((1, 9)), np.zeros((1, 9)), [(-1.0, 1.0)])
    fig.draw_without_rendering()
    assert fig.axes[0].get_ylim() == (-1.0, 1.0)
    with pytest.raises(ValueError, match="t must be"):
        plots.errors(np.zeros(0), np.zeros((0, 9)))


def test_biases_are_in_degrees_per_hour_and_mg():
    b_g, b_a = 10.0 + walk(0, N, 3), 2.0 + 0.01 * walk(1, N, 3)
    unit_g, unit_a = np.pi / 180 / 3600, 9.80665e-3
    fig = plots.biases(T, b_g * unit_g, b_a * unit_a, truth_g=np.array([7.0, 8.0, 9.0]) * unit_g)
    assert [fig.axes[i].get_ylabel() for i in (0, 3)] == ["Gyro bias (deg/h)", "Accelerometer bias (mg)"]
    for i in range(3):
        np.testing.assert_allclose(line(fig.axes[i], "estimated")[1], b_g[:, i])
        np.testing.assert_allclose(line(fig.axes[i + 3], "estimated")[1], b_a[:, i])
        np.testing.assert_allclose(line(fig.axes[i], "truth")[1], 7.0 + i)
    assert not fig.axes[0].collections and legend(fig) == ["estimated", "truth"]


def test_large_gyro_biases_are_in_degrees_per_second():
    b_g, sd = np.full((N, 3), 0.4 * units.DEG), np.full((N, 3), 0.1 * units.DEG)
    ax = plots.biases(T, b_g, 0 * b_g, sd_g=sd).axes[0]
    assert ax.get_ylabel() == "Gyro bias (deg/s)"
    np.testing.assert_allclose(line(ax, "estimated")[1], 0.4)
    y = band(ax)
    np.testing.assert_allclose([y.min(), y.max()], np.array([0.1, 0.7]))
    assert ax.get_ylim()[0] < 0.1 and ax.get_ylim()[1] > 0.7


# ---------------------------------------------------------------------------- innovations and NIS


def test_innovations_are_normalised_and_channels_never_valid_are_dropped():
    S = np.zeros((N, 8, 8)) + np.diag(np.arange(1.0, 9.0) ** 2) + 0.1
    nu, valid = np.ones((N, 8)), np.ones((N, 8), bool)
    valid[:, 2] = False
    valid[:100, 1] = False
    nu[100:125, 1] = 4.0 * np.sqrt(4.1)
    names = [f"channel {i}" for i in range(8)]
    fig = plots_stats.innovations(T, nu, S, valid, names)
    assert [ax.get_title().split(":")[0][-1] for ax in fig.axes] == list("013456")
    assert fig.get_suptitle() == "first 6 of 7 channels"
    plots.name(fig, "nis", "a drive")
    assert fig.get_suptitle() == "NIS: a drive (first 6 of 7 channels)"
    z = line(fig.axes[1], "innovation / its sd")[1]
    assert np.isnan(z[:100]).all()
    np.testing.assert_allclose(z[100:], nu[100:, 1] / np.sqrt(4.1))
    rms = np.sqrt(0.25 * 16.0 + 0.75 / 4.1)
    assert fig.axes[1].get_title() == f"channel 1: RMS {rms:.2f}, 75.0 % inside ±3"
    assert {height(l)[0] for l in fig.axes[0].lines if l.get_label() == "±3"} == {-3.0, 3.0}
    assert len(plots_stats.innovations(T, nu, S, valid, names, at_most=None).axes) == 7
    with pytest.raises(ValueError, match="no measurement"):
        plots_stats.innovations(T, nu, S, 0 * valid, names)


def test_nis_has_the_bounds_of_its_degrees_of_freedom():
    dof = np.where(T < 100, 3, 6)
    dof[::4] = 0
    values = np.where(dof > 0, dof * 1.0, np.nan)
    values[1:41:4] = 50.0  # 10 of 150 fixes
    fix = dof > 0
    fig = plots_stats.nis(T, values, dof, window=20)
    above, below = fig.axes
    bounds = [height(l) for l in above.lines if "chi-square" in str(l.get_label())]
    np.testing.assert_allclose(bounds, chi2.ppf([[0.025], [0.975]], dof[fix]), rtol=1e-9)
    assert above.get_title() == "each fix: 93.3 % inside the 95 % bounds"
    x, y = line(above, "NIS")
    np.testing.assert_array_equal(x, T[fix])
    np.testing.assert_array_equal(y, values[fix])

    x, y = line(below, "running mean of NIS / dof")
    assert x.size == 150 - 19 and x[0] == T[fix][19]
    total = [values[fix][i : i + 20].sum() for i in range(131)]
    freedom = np.array([dof[fix][i : i + 20].sum() for i in range(131)])
    np.testing.assert_allclose(y, total / freedom)
    bounds = [height(l) for l in below.lines if "chi-square" in str(l.get_label())]
    np.testing.assert_allclose(bounds, chi2.ppf([[0.025], [0.975]], freedom) / freedom, rtol=1e-9)
    inside = np.mean((y >= bounds[0]) & (y <= bounds[1]))
    assert below.get_title() == f"mean of the last 20 fixes: {100 * inside:.1f} % inside its 95 % bounds"
    assert 0.5 < inside < 0.9


def test_nis_with_fewer_fixes_than_its_window_and_with_none():
    dof = np.where(T < 3, 2.0, 0.0)
    below = plots_stats.nis(T, np.ones(N), dof).axes[1]
    np.testing.assert_allclose(line(below, "running mean of NIS / dof"), ([2.0], [0.5]))
    with pytest.raises(ValueError, match="no fix"):
        plots_stats.nis(T, np.ones(N), 0 * dof)


# ---------------------------------------------------------------------------- windows, methods, steps


def test_outage_drift_of_two_methods_is_paired():
    before, after = np.array([4.0, 1.0, 2.0, 3.0, 5.0]), np.array([2.0, 2.0, 1.0, np.nan, 4.0])
    fig = plots_stats.outage_drift({"a": before, "b": after}, {"b": "tuned"})
    left, right = fig.axes
    x, y = line(left, "a: RMS 3.32 m, median 3.00 m, 5 windows")
    np.testing.assert_array_equal(x, [1, 1, 2, 3, 4, 5])
    np.testing.assert_allclose(y, [0, 20, 40, 60, 80, 100])
    assert "tuned: RMS 2.50 m, median 2.00 m, 4 windows" in legend(fig)
    points = right.lines[0]
    np.testing.assert_array_equal(points.get_xydata(), [[4, 2], [1, 2], [2, 1], [5, 4]])
    assert right.get_title() == "tuned is smaller in 3 of 4 windows"
    assert (right.get_xlabel(), right.get_ylabel()) == ("a (m)", "tuned (m)")
    diagonal = line(right, "equal")
    np.testing.assert_array_equal(*diagonal)
    assert left.get_xscale() == right.get_xscale() == "linear"
    with pytest.raises(ValueError, match="same windows"):
        plots_stats.outage_drift({"a": before, "b": after[:3]})
    with pytest.raises(ValueError, match="drift has no finite value in 'b'"):
        plots_stats.outage_drift({"a": before, "b": after[3:4]})


def test_outage_drift_over_a_decade_is_log_and_other_counts_are_boxes():
    v = np.array([1.0, 5.0, 30.0])
    fig = plots_stats.outage_drift({"a": v, "b": v})
    assert [ax.get_xscale() for ax in fig.axes] == ["log", "log"]
    for n in (1, 3):
        left, right = plots_stats.outage_drift({f"m{i}": v for i in range(n)}).axes
        assert len(right.patches) == n and right.get_ylabel() == "Horizontal error (m)"
        assert [t.get_text() for t in right.get_xticklabels()] == [f"m{i}" for i in range(n)]
    apart = {"a": np.array([1.0, np.nan]), "b": np.array([np.nan, 2.0])}
    assert "0 of 0 windows" in plots_stats.outage_drift(apart).axes[1].get_title()
    assert plots_stats.outage_drift({"a": v - 1.0}).axes[0].get_xscale() == "linear"  # 0 m has no logarithm


def history(n=10):
    return [
        {
            "step": 5 * i,
            "loss": 3.0 - 0.1 * i,
            "grad_norm": 10.0**-i if i else 0.0,
            "validation": (i - 4.0) ** 2 + 1.0 if i % 2 == 0 else None,
            "params": {"ARW (deg/√h)": 10.0**-i, "lever arm (m)": np.array([i, -i, 1.0]), "offset (s)": -0.1 * i},
        }
        for i in range(n)
    ]


def test_tuning_marks_start_best_and_truth():
    fig = plots_stats.tuning(history(), {"offset (s)": -0.3, "lever arm (m)": [4.0, -4.0, 1.0]})
    loss, gradient, arw, lever, offset = fig.axes
    np.testing.assert_allclose(line(loss, "training loss"), (5.0 * np.arange(10), 3.0 - 0.1 * np.arange(10)))
    np.testing.assert_array_equal(line(loss, "validation loss")[0], [0, 10, 20, 30, 40])
    assert np.isnan(height(gradient.lines[0])[0]) and gradient.get_yscale() == "log"
    assert all(line(ax, "best step")[0][0] == 20.0 for ax in fig.axes)  # the least validation, not the least loss
    np.testing.assert_allclose(line(arw, "best"), ([20.0], [1e-4]))
    np.testing.assert_allclose(line(arw, "start"), ([0.0], [1.0]))
    np.testing.assert_allclose(line(offset, "true value")[1], -0.3)
    assert (arw.get_yscale(), lever.get_yscale(), offset.get_yscale()) == ("log", "linear", "linear")
    np.testing.assert_array_equal(line(lever, "component 2")[1], -np.arange(10.0))
    assert [height(l)[0] for l in lever.lines if l.get_label() == "true value"] == [4.0, -4.0, 1.0]
    assert "true value" not in [l.get_label() for l in arw.lines]


def test_tuning_without_validation_or_parameters_takes_the_least_loss():
    rows = [{**row, "validation": None, "params": {}} for row in history()]
    rows[6]["loss"] = -1.0
    rows[8]["loss"] = np.nan
    fig = plots_stats.tuning(rows)
    fig.draw_without_rendering()
    assert len(fig.axes) == 2 and line(fig.axes[0], "best step")[0][0] == 30.0
    assert legend(fig) == ["training loss", "best step"]
    plots_stats.tuning(history(1)).draw_without_rendering()
    endless = plots_stats.tuning([{**row, "params": {"tau (s)": np.inf}} for row in history()])
    assert [t.get_text() for t in endless.axes[2].texts] == ["always inf"]
    with pytest.raises(ValueError, match="empty"):
        plots_stats.tuning([])
