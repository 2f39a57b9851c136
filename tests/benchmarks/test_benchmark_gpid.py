"""The GPID paper's tables in short form: two seeds, an IMU of 2 Hz."""

import jax
import numpy as np
import pytest

from benchmarks.papers import gpid
from benchmarks.papers.gpid_study import SCHEMES, fitted_params, hours, keys_of, loss, paper_filter, rms, score, study
from jaxnav.filters.papers.gpid import gpid_params
from jaxnav.filters.parameters import get, put
from jaxnav.simulate.scenarios import CIRCLE, REPRO
from jaxnav.simulate.simulation import matched_params


@pytest.fixture(scope="module")
def fitted():
    params = [fitted_params(*gains) for gains in SCHEMES.values()]
    return study(paper_filter(2), params, hours(gpid.coarse(REPRO), keys_of(1, 0, 2)))


def test_fitted_configuration_is_near_the_papers_tables(fitted):
    rows = gpid.tables({"fitted": fitted})
    ratios = {(t, r["method"], r["quantity"]): r["ours"] / r["paper"] for t in rows for r in rows[t]}
    assert len(ratios) == 18
    assert all(1 / 1.75 < ratio < 1.75 for ratio in ratios.values()), ratios


def test_gpid_beats_the_mistuned_kf_but_is_no_faster_after_the_fault(fitted):
    kf, one, two = score(fitted.squares)
    assert two < one < kf - 1.0
    after = rms(fitted.squares, "rest")["horizontal_m"].mean(0)
    assert after[1] > 2 * after[0]  # the price: the integral rings on


def test_a_part_of_the_hour_and_the_parts_together(fitted):
    """The mean square of the hour is the mean over its parts, by their length."""
    parts = {"before": 600, "in": 500, "after": 500, "rest": 2000}
    whole = rms(fitted.squares)["altitude_m"]
    together = sum(n * rms(fitted.squares, part)["altitude_m"] ** 2 for part, n in parts.items()) / 3600
    np.testing.assert_allclose(whole**2, together, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rule.ki", "rule.kd", "noise.gyro", "noise.accel", "measurements.position.scale"])
def test_gradient_through_the_whole_hour(name):
    calm = CIRCLE._replace(faults=())
    params = matched_params(calm, gpid_params(0.003, 0.1))
    sims = hours(gpid.coarse(calm._replace(start_deg_m=(0.0, 0.0, 100.0))), keys_of(2, 0, 2))
    f = jax.jit(lambda value: loss(paper_filter(2))(put(params, name, value), sims))
    value = get(params, name)
    h = 1e-2 * value
    steps = (f(value + h) - f(value - h)) / 2, (f(value + 2 * h) - f(value - 2 * h)) / 4
    central = (4 * steps[0] - steps[1]) / 3  # per relative step of 1e-2, the third derivative taken out
    ours = np.sum(np.asarray(jax.grad(f)(value)) * h)
    assert ours == pytest.approx(float(central), rel=1e-5)
