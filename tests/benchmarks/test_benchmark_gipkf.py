"""The outage study: where outages lie and what they hide, counts of operations, and (slow) its figures."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.papers import flops, gipkf, gipkf_claims
from benchmarks.papers import gipkf_study as study
from jaxnav.filters.parameters import get
from jaxnav.types import Epoch, Fix, Imu


def test_outages_are_on_whole_seconds_and_in_their_places():
    windows = np.asarray(study.draw(jax.random.key(1), 200))
    np.testing.assert_array_equal(windows[..., 1] - windows[..., 0], np.tile(study.LENGTHS, (200, 1)))
    np.testing.assert_array_equal(windows, np.round(windows))
    assert (windows[..., 0].min(0) == study.EARLIEST).all() and (windows[..., 0].max(0) == study.LATEST).all()


def test_hiding_takes_the_fixes_of_the_windows_and_no_others():
    t = jnp.arange(31.0, 421.0)
    fix = Fix(*(jnp.ones((390, 6)) for _ in range(3)), jnp.ones((390, 6), bool).at[5].set(False))
    epochs = Epoch(Imu(jnp.ones((390, 1)), jnp.zeros((390, 1, 3)), jnp.zeros((390, 1, 3))), fix)
    windows = jnp.array([[150.0, 160.0], [240.0, 251.0], [330.0, 352.0]])
    shown, hidden, last = study.hide(epochs, t, windows)
    assert [int(t[i]) for i in last] == [160, 251, 352]
    assert int(hidden.sum()) == 10 + 11 + 22 and bool(hidden[last].all()) and not bool(hidden[last + 1].any())
    np.testing.assert_array_equal(shown.fix.valid, fix.valid & ~np.asarray(hidden)[:, None])


def test_operations_by_hand_are_the_papers():
    assert flops.BY_HAND["gipkf_literal"] == pytest.approx(flops.PAPER["gipkf_literal"], rel=0.003)
    assert flops.BY_HAND["ekf15"] == pytest.approx(flops.PAPER["ekf15"], rel=0.08)
    assert flops.product(2, 3, 4) == 2 * 4 * (3 + 2)


@pytest.mark.full
def test_operations_of_the_program():
    square = jnp.ones((9, 9))
    assert flops.count(lambda a: a @ a, square) == pytest.approx(flops.product(9, 9, 9), rel=0.07)
    ekf, gip = flops.of("ekf15"), flops.of("gipkf")
    assert gip["compiled"] < 0.6 * ekf["compiled"]
    assert ekf["hand"] < ekf["compiled"] < 2 * ekf["hand"]  # Joseph's form is longer than the short one
    assert flops.of_nine()["compiled"] < 0.25 * ekf["compiled"]


def test_tuned_parameters_are_there_for_every_set_and_method():
    found = json.loads(gipkf.TUNED.read_text())
    assert set(found) == set(gipkf.SETS)
    for name in gipkf.SETS:
        params = gipkf.tuned_params(name, jax.random.key(0), 0, 0)
        assert set(params) == set(gipkf.ROWS)
        for method, spec in gipkf.SPECS.items():
            assert set(found[name][method]) == set(spec)
            assert all(np.shape(get(params[method], leaf)) == np.shape(found[name][method][leaf]) for leaf in spec)


@pytest.mark.slow
def test_figures_of_the_study(tmp_path):
    """On all held-out drives, with the parameters that tuning found."""
    path = tmp_path / "gipkf.json"
    gipkf.main(["--steps", "0", "--json", str(path)])
    r = json.loads(path.read_text())
    for length, reference in zip(("10", "11", "22"), (1.3, 1.3, 3.0), strict=True):
        assert r["nominal"]["ekf15_datasheet"][length] == pytest.approx(reference, rel=0.3)
    assert r["uncalibrated"]["gipkf_mix_tuned"]["22"] < 40.0
    learning, constant = r["nominal"]["gipkf_body_dm_tuned"], r["nominal"]["gipkf_constant_tuned"]
    for length, reference in zip(("10", "11", "22"), (2.9, 2.4, 5.7), strict=True):
        assert learning[length] < min(1.15 * reference, constant[length])
    for name in gipkf.SETS:
        nine, ekf = r[name]["nine_states_tuned"], r[name]["ekf15_tuned"]
        assert all(nine[length] < 1.2 * ekf[length] for length in ("10", "11", "22"))
    low, high = r["nees"]["bounds"]
    assert all(low < value < high for value in r["nees"]["ekf15_datasheet"]["before"])
    assert not low < r["nees"]["linear feedback, no scale error"]["before"][0] < high
    for row in r["nominal"].values():
        errors = np.array(row["per_seed"])
        np.testing.assert_allclose([row["10"], row["11"], row["22"]], np.sqrt(np.mean(errors**2, axis=0)))
    assert path.with_suffix(".png").stat().st_size > 50_000


def test_rank_does_not_go_by_the_unit():
    """Two directions of three, one of them seen a thousand times less; rows in metres and in millimetres."""
    M = np.array([[1.0, 0.0, 0.0], [0.0, 1e-3, 0.0], [1.0, 1e-3, 0.0], [0.0, 0.0, 0.0]])
    unit = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    assert gipkf_claims.rank(M, unit, 1e-4) == 2 and gipkf_claims.rank(M, unit, 1e-2) == 1
    scaled = np.tile([[1.0], [1000.0]], (2, 1))
    assert gipkf_claims.rank(M * scaled, unit * np.array([[1.0], [1000.0]]), 1e-2) == 1


@pytest.mark.full
def test_the_claims_of_two_drives(tmp_path):
    """Ranks, growth and what is left around an outage are those of a filter that works."""
    drives = study.drive(gipkf.scenario("nominal"), jax.random.split(jax.random.key(3), 2))
    windows = study.draw(jax.random.key(4), 2)
    each = gipkf.filter_of("gipkf_body_dm_hand"), gipkf.start_of("gipkf_body_dm_hand", "nominal")
    ranks = gipkf_claims.ranks(*each, drives)
    assert [ranks[k]["state"] for k in ("at rest", "in motion")] == [9, 9] and ranks["at rest"]["input"] == 15
    found = gipkf_claims.around(*each, drives, windows)
    assert max(found["tilt_end_deg"]) < 3 and min(found["heading_before_deg"]) > 0.01
    assert 1 <= min(found["again_median_s"]) <= max(found["again_p90_s"]) < 100
