"""What each sensor is expected to read, by geometry written out; rows by state: tests/test_contract_rows.py."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav import STATES, build, initial_nav
from jaxnav.maths import rotations
from jaxnav.maths.units import DEG
from jaxnav.measurements import GNSS, MEASUREMENTS
from jaxnav.measurements.measurement import Kinematics
from jaxnav.types import Fix

RPH = np.array([10.0, -20.0, 70.0]) * DEG
NAV = initial_nav([0.8, 0.1, 100.0], [8.0, -3.0, 1.0], RPH)._replace(omega=jnp.array([0.1, -0.2, 0.3]))
KIN = Kinematics(NAV.pos, NAV.vel, rotations.to_dcm(NAV.q))
C = np.asarray(rotations.from_rph(jnp.asarray(RPH)))
PARAMS = build("ekf15", tuple(MEASUREMENTS)).params()


def residual(name: str, value, errors=None, **theta):
    """Of a reading ``value``, with parameters of its own."""
    row, size = MEASUREMENTS[name], len(value)
    own = PARAMS.measurements[name]._replace(**{k: jnp.asarray(v, float) for k, v in theta.items()})
    fix = Fix(jnp.asarray(value, float), jnp.ones(size), jnp.zeros(size), jnp.ones(size, bool))
    nav = NAV._replace(errors={k: jnp.asarray(v, float) for k, v in (errors or {}).items()})
    return np.asarray(row.observe(own, PARAMS.mounting, nav, KIN, fix).y)


def test_a_magnetometer_reads_the_field_in_body_axes():
    declination, inclination = 12 * DEG, 60 * DEG
    m = 48.0 * np.array([np.cos(inclination) * np.sin(declination), np.cos(inclination) * np.cos(declination),
                         -np.sin(inclination)])  # fmt: skip
    here = dict(declination=declination, inclination=inclination, strength=48.0)
    np.testing.assert_allclose(residual("magnetometer", C.T @ m, **here), 0.0, atol=1e-12)
    iron = np.array([3.0, -2.0, 1.0])
    np.testing.assert_allclose(
        residual("magnetometer", C.T @ m + iron, {"magnetometer_bias": iron}, **here), 0.0, atol=1e-12
    )
    # the same field, stated two degrees too far west and known by the state
    less = here | {"declination": 10 * DEG}
    np.testing.assert_allclose(
        residual("magnetometer", C.T @ m, {"declination_error": [2 * DEG]}, **less), 0.0, atol=1e-12
    )


@pytest.mark.parametrize("yaw, expected", [(0.0, 70.0), (90.0, None), (-180.0, -110.0)])
def test_a_heading_is_that_of_the_line_between_the_antennas(yaw, expected):
    d = C @ [np.cos(yaw * DEG), np.sin(yaw * DEG), 0.0]
    angle = np.arctan2(d[0], d[1])
    if expected is not None:
        assert angle / DEG == pytest.approx(expected)
    for turns in (-1, 0, 2):  # 359 deg and -1 deg are one
        np.testing.assert_allclose(residual("heading", [angle + 2 * np.pi * turns], yaw=yaw * DEG), 0.0, atol=1e-12)
    np.testing.assert_allclose(residual("heading", [angle - 0.1], yaw=yaw * DEG), 0.1, atol=1e-12)


def test_baseline_course_and_yaw_rate():
    arm = np.array([0.9, 0.1, -0.05])
    np.testing.assert_allclose(residual("baseline", C @ arm, arm=arm), 0.0, atol=1e-12)
    np.testing.assert_allclose(residual("course", [np.arctan2(8.0, -3.0)]), 0.0, atol=1e-12)
    np.testing.assert_allclose(residual("yaw_rate", [0.25]), 0.05, atol=1e-12)


@pytest.mark.full
@pytest.mark.parametrize("rph", [(0.0, 0.0, 0.0), (0.0, 0.5 * np.pi, 0.0)], ids=["at rest", "at rest, nose up"])
@pytest.mark.parametrize("name", MEASUREMENTS)
def test_gradients_are_finite_where_there_is_no_direction(name, rph):
    """No velocity, and a nose that points straight up: of the residual and of its rows."""
    row, nav = MEASUREMENTS[name], initial_nav([0.8, 0.1, 100.0], rph=rph)
    nav = nav._replace(errors={each: jnp.zeros(STATES[each].size) for each in row.states})
    size = row.size
    nothing = jnp.zeros((size, len(row.auxiliary)))
    fix = Fix(jnp.zeros(size), jnp.ones(size), jnp.zeros(size), jnp.zeros(size, bool), nothing)

    def total(theta, nav):
        kin = Kinematics(nav.pos, nav.vel, rotations.to_dcm(nav.q))
        seen = row.observe(theta, PARAMS.mounting, nav, kin, fix)
        return seen.y.sum() + sum(rows.sum() for rows in seen.rows.values())

    slope = jax.grad(total, (0, 1))(PARAMS.measurements[name], nav)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slope))


def test_airspeed_and_sideslip_are_of_the_velocity_through_the_air():
    wind = np.array([2.0, 5.0])
    through = C.T @ (np.array([8.0, -3.0, 1.0]) - [*wind, 0.0])
    np.testing.assert_allclose(residual("airspeed", [1.01 * through[0]], {"wind": wind}, scale=0.01), 0.0, atol=1e-12)
    np.testing.assert_allclose(residual("sideslip", [0.0], {"wind": wind}), through[1:2], atol=1e-12, strict=True)


def test_a_level_vehicle_has_no_velocity_upwards():
    np.testing.assert_allclose(residual("level", [0.0]), [1.0], atol=1e-12, strict=True)


def test_wheels_read_by_their_scale_and_the_vehicles_axes():
    scale, axes = 0.03, np.array([1.0, -2.0]) * DEG
    turn = np.asarray(rotations.to_dcm(rotations.exp(jnp.array([0.0, *axes]))))  # vehicle -> body
    forward = (turn.T @ C.T @ [8.0, -3.0, 1.0])[0]
    both = {"odometer_scale": [scale], "vehicle_axes": axes}
    np.testing.assert_allclose(residual("speed", [(1 + scale) * forward], both), 0.0, atol=1e-12)


def test_wheels_of_both_sides_run_on_circles_about_one_centre():
    """On the level at 10 m/s, 0.5 rad/s to the right: 20 m of radius to the middle, half a track more to the left."""
    nav = initial_nav([0.8, 0.1, 100.0], [0.0, 10.0, 0.0])._replace(omega=jnp.array([0.0, 0.0, 0.5]))
    kin = Kinematics(nav.pos, nav.vel, rotations.to_dcm(nav.q))
    own = PARAMS.measurements["wheels"]._replace(track=jnp.asarray(1.6))
    nothing = Fix(jnp.zeros(2), jnp.ones(2), jnp.zeros(2), jnp.ones(2, bool))
    said = MEASUREMENTS["wheels"].observe(own, PARAMS.mounting, nav, kin, nothing).y
    np.testing.assert_allclose(said, [0.5 * 20.8, 0.5 * 19.2], rtol=1e-12)


def test_a_doppler_log_reads_along_its_own_axes():
    """Turned to the right by 30 deg, 2 % too much; on a circle a sensor ahead of the IMU also moves sideways."""
    yaw, C_b = 30 * DEG, np.asarray(C)
    turn = np.array([[np.cos(yaw), np.sin(yaw), 0.0], [-np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
    seen = 1.02 * turn @ C_b.T @ [8.0, -3.0, 1.0]
    np.testing.assert_allclose(residual("body_velocity", seen, yaw=yaw, scale=0.02), 0.0, atol=1e-12)
    nav = initial_nav([0.8, 0.1, 100.0], [0.0, 10.0, 0.0])._replace(omega=jnp.array([0.0, 0.0, 0.5]))
    kin = Kinematics(nav.pos, nav.vel, rotations.to_dcm(nav.q))
    own = PARAMS.measurements["body_velocity"]._replace(arm=jnp.array([2.0, 0.0, 0.0]))
    nothing = Fix(jnp.zeros(3), jnp.ones(3), jnp.zeros(3), jnp.ones(3, bool))
    said = MEASUREMENTS["body_velocity"].observe(own, PARAMS.mounting, nav, kin, nothing).y
    np.testing.assert_allclose(said, [10.0, 0.5 * 2.0, 0.0], atol=1e-12)


def test_a_rangefinder_reads_the_slant_way_to_the_ground():
    """Along the body's down axis from 100 m to ground at 30 m: where that line meets it."""
    beam = C[:, 2]
    way = (100.0 - 30.0) / -beam[2]
    assert (np.array([0.0, 0.0, 100.0]) + way * beam)[2] == pytest.approx(30.0)
    np.testing.assert_allclose(residual("rangefinder", [way], {"ground_height": [10.0]}, ground=20.0), 0.0, atol=1e-12)
    assert way > 70.0


def test_a_fix_that_is_older_than_said_moves_the_clock_and_not_the_position():
    """One position of sd 1 cm that is 0.5 m behind at 10 m/s: a clock of sd 0.1 s, known place: 50 ms late."""
    filt = build("ekf9", ("position",), states=("clock_offset",), history=2)
    params = filt.params("consumer", position_sd=1e-3)
    params = params._replace(states={"clock_offset": params.states["clock_offset"]._replace(sd=jnp.asarray(0.1))})
    nav = initial_nav([0.8, 0.1, 100.0], [0.0, 10.0, 0.0])
    state = filt.init(params, nav)
    earlier = nav._replace(t=nav.t - 0.1, pos=nav.pos - jnp.array([1.0 / 6.37e6, 0.0, 0.0]))
    past = jax.tree.map(lambda a, b: jnp.stack([a, b]), *(
        each._replace(errors={"clock_offset": jnp.zeros(1)}) for each in (earlier, nav)))  # fmt: skip
    fix = Fix(nav.pos - jnp.array([0.5 / 6.37e6, 0.0, 0.0]), jnp.full(3, 0.01), jnp.zeros(3), jnp.ones(3, bool))
    new, _ = filt.correct(params, state._replace(past=past), fix)
    after = jax.tree.map(lambda a: a[-1], new.past)
    np.testing.assert_allclose(after.errors["clock_offset"], 0.05, rtol=2e-3)
    assert abs(float(after.pos[0] - nav.pos[0])) * 6.37e6 < 1e-3


def test_states_of_other_sensors_are_refused_without_them():
    with pytest.raises(ValueError, match="wind.*seen by no sensor.*airspeed or sideslip"):
        build("ekf15", GNSS, states=("wind",))
