"""Heading without motion: the field and what it shows, two antennas, and when a compass is not believed."""

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.simulated.vehicles import simulated
from jaxnav.filters.catalogue import build
from jaxnav.initialization import initialize, magnetic
from jaxnav.initialization.pointing import heading_by_sensor
from jaxnav.maths import rotations
from jaxnav.maths.units import DEG
from jaxnav.measurements.magnetometer import field
from jaxnav.types import ImuLog, Recording, Samples

LLA = np.array([37.0 * DEG, -122.0 * DEG, 30.0])


def standing(rph, seconds=20.0, **streams):
    """A recording at rest: consumer noise, positions that stay, and further streams of one value each."""
    rng, C = np.random.default_rng(3), np.asarray(rotations.from_rph(jnp.asarray(rph)))
    t = np.arange(0.02, seconds, 0.02)
    accel = C.T @ [0, 0, 9.8] + 0.02 * rng.normal(size=(t.size, 3))
    imu = ImuLog(t, np.full(t.size, 0.02), 1e-3 * rng.normal(size=(t.size, 3)), accel)
    n = int(seconds)
    place = LLA + rng.normal(size=(n, 3)) * [3e-7, 3e-7, 2.0]
    aiding = {"position": Samples(np.arange(1.0, n + 1), place, np.full((n, 3), 2.0), np.zeros((n, 3)))}
    for name, (value, sd) in streams.items():
        each = np.tile(np.atleast_1d(np.asarray(value, float)), (n, 1))
        aiding[name] = Samples(np.arange(1.0, n + 1), each, np.full_like(each, sd), np.zeros_like(each))
    return Recording("parked", imu, aiding, None, np.zeros(3), "")


def by_field(rph, known, iron=(0.0, 0.0, 0.0)):
    C = np.asarray(rotations.from_rph(jnp.asarray(rph)))
    return C.T @ np.asarray(field(known.declination, known.inclination, known.strength)) + np.asarray(iron)


def test_the_field_is_the_models():
    """At 80 N, 0 E, sea level, 2025.0, a row of the test values that are published with WMM2025."""
    found = magnetic.field_at(np.array([80 * DEG, 0.0, 0.0]))
    assert found.declination / DEG == pytest.approx(1.28, abs=0.02)
    assert found.inclination / DEG == pytest.approx(83.21, abs=0.02)
    assert found.strength == pytest.approx(55.1, abs=0.1)


@pytest.mark.parametrize("rph", [(0.0, 0.0, 0.3), (0.2, -0.3, -2.0), (-0.4, 0.1, 3.0)])
def test_a_field_shows_the_heading_at_any_tilt(rph):
    known = magnetic.Field(0.2, 1.1, 48.0, 0.02)
    heading, level, bent = magnetic.heading_of(by_field(rph, known), rph[0], rph[1], known)
    assert heading == pytest.approx(rph[2], abs=1e-12) and bent < 1e-10
    assert level == pytest.approx(48.0 * np.cos(1.1))


def test_a_compass_starts_what_stands():
    known = magnetic.field_at(LLA)
    rec = standing((0.02, -0.03, 2.5), magnetometer=(by_field((0.02, -0.03, 2.5), known, (0.5, -0.5, 0.5)), 1.0))
    begin = initialize.initialize(rec)
    heading = float(rotations.to_rph(rotations.to_dcm(begin.navs.q[0]))[2])
    assert begin.navs.t.shape == (1,) and abs(heading - 2.5) < 3 * float(begin.prior.attitude[2]) < 0.9
    assert abs(heading - 2.5) < 5 * DEG and "by the magnetometer" in begin.how and "World Magnetic Model" in begin.how
    stated = build("ekf15", ("position", "magnetometer")).params()
    given = begin.apply_to(stated).measurements["magnetometer"]
    assert float(given.declination) == pytest.approx(known.declination)
    own = stated.measurements["magnetometer"]._replace(declination=jnp.asarray(0.5))
    said = initialize.initialize(rec, stated._replace(measurements=stated.measurements | {"magnetometer": own}))
    assert float(said.field.declination) == 0.5  # what the user states is taken


def test_a_compass_is_as_uncertain_as_its_tilt_times_the_tangent_of_the_inclination():
    known = magnetic.field_at(LLA)
    rec = standing((0.0, 0.0, 1.0), magnetometer=(by_field((0.0, 0.0, 1.0), known), 1.0))
    params = build("ekf15", ("position", "magnetometer")).params()
    sd = [heading_by_sensor(rec, params, (0.0, 0.0), tilt, 10.0).sd for tilt in (0.0, 3 * DEG)]
    assert sd[1] ** 2 - sd[0] ** 2 == pytest.approx((np.tan(known.inclination) * 3 * DEG) ** 2, rel=1e-4)
    assert np.tan(known.inclination) > 1.5


@pytest.mark.parametrize("iron", [(0.0, 0.0, 40.0), (25.0, 20.0, 0.0)])
def test_a_compass_near_iron_is_not_believed(iron):
    known = magnetic.field_at(LLA)
    rec = standing((0.0, 0.0, 1.0), magnetometer=(by_field((0.0, 0.0, 1.0), known, iron), 1.0))
    begin = initialize.initialize(rec)
    assert begin.navs.t.shape == (12,) and "magnetometer" not in begin.how


def test_two_antennas_are_surer_than_motion():
    """A car in motion, which shows the heading to degrees; the antennas to a tenth."""
    rec, _ = simulated("car", "consumer", True, np.random.default_rng(5))
    angle = np.interp(rec.aiding["position"].t, rec.truth.t, np.unwrap(rec.truth.rph[:, 2]))[:, None]
    by_antennas = Samples(rec.aiding["position"].t, angle, np.full_like(angle, 2e-3), np.zeros_like(angle))
    without, begin = (
        initialize.initialize(rec),
        initialize.initialize(rec._replace(aiding=rec.aiding | {"heading": by_antennas})),
    )
    assert "two antennas" in begin.how and "two antennas" not in without.how
    assert float(begin.prior.attitude[2]) < 0.3 * float(without.prior.attitude[2])
    heading = float(rotations.to_rph(rotations.to_dcm(begin.navs.q[0]))[2])
    off = heading - np.interp(begin.t, rec.truth.t, np.unwrap(rec.truth.rph[:, 2]))
    assert abs((off + np.pi) % (2 * np.pi) - np.pi) < 0.03  # a fix may be 0.3 s old
    across = by_antennas._replace(value=angle + np.pi / 2)
    refused = initialize.initialize(rec._replace(aiding=rec.aiding | {"heading": across}))
    assert "two antennas contradict" in refused.how
    assert rotations.to_rph(rotations.to_dcm(refused.navs.q[0]))[2] == pytest.approx(
        float(rotations.to_rph(rotations.to_dcm(without.navs.q[0]))[2]), abs=1e-9
    )


def test_two_antennas_come_first():
    known = magnetic.field_at(LLA)
    streams = {"heading": (1.2 + 0.5, 0.01), "magnetometer": (by_field((0.0, 0.0, 1.0), known), 1.0)}
    rec = standing((0.0, 0.0, 1.2), **streams)
    params = initialize.recorded_timing(rec)
    own = params.measurements["heading"]._replace(yaw=jnp.asarray(0.5))  # the line points to the right
    begin = initialize.initialize(rec, params._replace(measurements=params.measurements | {"heading": own}))
    heading = float(rotations.to_rph(rotations.to_dcm(begin.navs.q[0]))[2])
    assert heading == pytest.approx(1.2, abs=1e-9) and "two antennas" in begin.how
    assert float(begin.prior.attitude[2]) == pytest.approx(0.01)
    vague = standing((0.0, 0.0, 1.2), heading=(1.7, 0.5))
    assert initialize.initialize(vague).navs.t.shape == (12,)
