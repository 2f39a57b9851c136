"""A recording against itself: what is wrong is named, what is right is left alone."""

from types import SimpleNamespace

import jax
import numpy as np
import pytest
from scipy.signal import lfilter

from benchmarks.recordings import check
from benchmarks.simulated import pauses
from benchmarks.simulated.vehicles import simulated
from jaxnav.app.config import Data
from jaxnav.app.jobs.check import configuration
from jaxnav.checkup import CHECKS, alternatives, checkup, inertial, motion, streams
from jaxnav.checkup.motion import delay_of, mixups, turns_of
from jaxnav.checkup.standstill import standstill
from jaxnav.filters.standstill import Standing, stationary
from jaxnav.initialization import magnetic
from jaxnav.maths import rotations
from jaxnav.maths.units import DEG
from jaxnav.measurements.magnetometer import field
from jaxnav.reading.read import read
from jaxnav.simulate.scenarios import URBAN
from jaxnav.simulate.simulation import simulate_jit, to_recording
from jaxnav.states.grades import GRADES
from jaxnav.types import ImuLog, Recording, Samples, sample_rows


@pytest.fixture(scope="module")
def car() -> Recording:
    """A car for 70 s with fixes, wheels, barometer and compass, nothing wrong but a delay of at most 0.3 s."""
    rec, _ = simulated("car", "consumer", True, np.random.default_rng(5))
    truth, position = rec.truth, rec.aiding["position"]
    k = np.arange(0.5, 69.0, 0.1)
    column = lambda value, sd: Samples(k, value[:, None], np.full((k.size, 1), sd), np.zeros((k.size, 1)))
    speed = np.interp(k, truth.t, np.hypot(truth.vel[:, 0], truth.vel[:, 1]))
    hill = 20 * np.sin(2 * np.pi * k / 60)
    lla = position.value + np.column_stack([np.zeros((position.t.size, 2)), np.interp(position.t, k, hill)])
    here = magnetic.field_at(position.value[0])
    earth = np.asarray(field(here.declination, here.inclination, here.strength))
    rph = np.column_stack([np.interp(k, truth.t, np.unwrap(angle)) for angle in truth.rph.T])
    seen = np.array([np.asarray(rotations.from_rph(angles)).T @ earth for angles in rph])
    three = Samples(k, seen, np.full(seen.shape, 1.0), np.zeros(seen.shape))
    streams = {"position": position._replace(value=lla), "speed": column(speed, 0.1), "barometer": column(hill, 0.5),
               "magnetometer": three}  # fmt: skip
    return rec._replace(aiding=rec.aiding | streams)


def bad(rec: Recording, *rows: str) -> set[str]:
    """Codes of what is wrong, by these checks or by all."""
    return {f.code for row in rows or CHECKS for f in CHECKS[row].answer(rec) if f.warns}


def test_nothing_is_wrong_with_what_is_right(car):
    assert bad(car) - {"time.late"} == set()
    said = " ".join(f.message for f in checkup(car))
    for part in ("IMU at 100 Hz", "wheel speed is", "barometric height changes by", "the course's rate", "chi^2"):
        assert part in said
    assert {f.code for f in checkup(car)} >= {
        "imu.rate", "imu.gravity", "imu.noise", "imu.bias", "gyro", "motion", "mounting.yaw", "position",
        "velocity", "speed", "barometer", "compass", "compass.turns",
    }  # fmt: skip


ROWS, COLUMN = lambda a: np.arange(len(a))[:, None], np.array([False, True, False])
DAMAGES = {
    "velocity.swapped": check.stream("velocity", check.swapped(0, 1)),
    "velocity.sign": check.stream("velocity", check.times(-1, 1, 1)),
    "velocity.units": check.stream("velocity", lambda v: 3.6 * v),
    "velocity.columns": check.stream("velocity", lambda v: np.random.default_rng(0).normal(size=v.shape) * 8.0),
    "speed.units": check.stream("speed", lambda v: 3.6 * v),
    "barometer.sign": check.stream("barometer", lambda v: -v),
    "compass.axes": check.stream("magnetometer", lambda m: m @ np.diag([1.0, -1.0, -1.0])),
    "compass.inconsistent": check.stream(
        "magnetometer", lambda m: np.random.default_rng(0).normal(size=m.shape) * 25.0
    ),
    "compass.strength": check.stream("magnetometer", lambda m: m / 100),
    "barometer.units": check.stream("barometer", lambda v: 3.28084 * v),
    "gyro.sign": check.imu(gyro=check.times(1, 1, -1)),
    "gyro.swapped": check.imu(gyro=check.swapped(0, 2)),
    "gyro.units": check.imu(gyro=lambda a: a / DEG),
    "gyro.scale": check.imu(gyro=lambda a: 2.5 * a),
    "gyro.bias": check.imu(gyro=lambda a: a + 5 * DEG),
    "accel.bias": check.imu(accel=lambda a: 1.1 * a),
    "imu.lost": check.lost,
    "imu.dead": check.imu(gyro=check.times(1, 0, 1)),
    "imu.stuck": check.imu(gyro=lambda a: np.where((ROWS(a) > 1000) & (ROWS(a) < 1150) & COLUMN, a[1001], a)),
    "accel.sign": check.imu(accel=check.times(-1, 1, 1)),
    "axes.gravity": check.imu(gyro=check.times(1, -1, -1), accel=check.times(1, -1, -1)),
    "imu.clipped": check.imu(gyro=lambda a: np.where((ROWS(a) % 200 < 2) & COLUMN, 1.0, a)),
    "accel.swapped": check.imu(accel=check.swapped(0, 1)),
    "imu.swapped": check.imu(gyro=check.swapped(0, 1), accel=check.swapped(0, 1)),
    "imu.polled": check.polled,
    "imu.slow": lambda rec: rec._replace(imu=ImuLog(*(a[::20] for a in rec.imu))),
    "position.repeats": check.repeated,
    "time.offset": check.later(-18.0),
    "mounting.turned": check.imu(gyro=check.turned, accel=check.turned),
    "time.overlap": check.later(30.0),
    "time.jump": check.stream("position", t=lambda t: np.where(t > 30.0, t - 0.3, t)),
    "time.stream_offset": check.stream("velocity", t=lambda t: t - 0.06),
    "stream.short": lambda rec: rec._replace(
        aiding=rec.aiding
        | {"velocity": sample_rows(rec.aiding["velocity"], slice(None, rec.aiding["velocity"].t.size // 2))}
    ),
    "stream.sd_jumps": lambda rec: rec._replace(
        aiding=rec.aiding
        | {
            "position": rec.aiding["position"]._replace(
                sd=rec.aiding["position"].sd
                * np.random.default_rng(0).uniform(0.6, 1.4, rec.aiding["position"].sd.shape)
            )
        }
    ),
}


@pytest.mark.full
@pytest.mark.parametrize("code", DAMAGES)
def test_every_damage_is_named(car, code):
    part = code.split(".")[0]
    rows = {
        "velocity": ("velocity",), "speed": ("speed",), "barometer": ("barometer",),
        "position": ("fixes",), "stream": ("stated", "ends"), "imu": ("sampling", "gravity", "axes"),
        "axes": ("gravity",),
        "gyro": ("axes", "together"), "accel": ("together",), "mounting": ("together",), "compass": ("compass",),
        "time": ("overlap", "together", "rhythm", "stream_offset"),
    }  # fmt: skip
    chosen = ("together",) if code == "imu.swapped" else rows[part]
    found = bad(check.as_floats(DAMAGES[code](car)), *chosen)
    assert code in found, found


def pointed(rec: Recording, angle) -> Recording:
    """The recording with a heading of two antennas, a change of the true one (rad)."""
    k = np.arange(0.5, 69.0, 0.1)
    value = angle(np.interp(k, rec.truth.t, np.unwrap(rec.truth.rph[:, 2])))[:, None]
    heading = Samples(k, value, np.full_like(value, 0.01), np.zeros_like(value))
    return rec._replace(aiding=rec.aiding | {"heading": heading})


@pytest.mark.parametrize("degrees", [-14.0, 7.0, 60.0])
def test_velocity_from_another_north(car, degrees):
    """Turned clockwise by so much; late or with noise alone it is not."""
    s, c = np.sin(degrees * DEG), np.cos(degrees * DEG)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])  # of rows, east to south
    found = {f.code: f for f in CHECKS["velocity"].answer(check.stream("velocity", lambda v: v @ turn)(car))}
    assert found["velocity.turned"].value == pytest.approx(degrees, abs=1.5)
    for healthy in (check.stream("velocity", t=lambda t: t + 0.6), check.stream("velocity", lambda v: v)):
        assert "velocity.turned" not in {f.code for f in CHECKS["velocity"].answer(healthy(car))}


@pytest.mark.parametrize(
    ("angle", "code", "value"),
    [(lambda a: a, "heading", 0.0), (lambda a: a + np.pi / 2, "heading.turned", 90.0),
     (lambda a: a - 8 * DEG, "heading.turned", -8.0), (lambda a: np.pi / 2 - a, "heading.mirrored", 90.0)],
)  # fmt: skip
def test_a_heading_by_the_course(car, angle, code, value):
    (found,) = CHECKS["heading"].answer(pointed(car, angle))
    assert found.code == code and found.value == pytest.approx(value, abs=2.5)


@pytest.mark.parametrize(("heights", "rates", "ratio"), [(1.0, 1.0, None), (3.28084, 1.0, 3.28), (1.0, 3.28084, 0.305)])
def test_heights_and_vertical_velocities_in_feet(heights, rates, ratio):
    rng, t = np.random.default_rng(0), np.arange(0.0, 200.0)
    height, rate = 50 * np.sin(0.1 * t), 5 * np.cos(0.1 * t)
    lla = np.column_stack([np.full(t.size, 0.8), np.full(t.size, 0.2), heights * height + rng.normal(size=t.size)])
    vel = np.column_stack([np.zeros((t.size, 2)), rates * rate + 0.1 * rng.normal(size=t.size)])
    column = lambda value, sd: Samples(t, value, np.full(value.shape, sd), np.zeros(value.shape))
    imu = ImuLog(t, np.ones(t.size), np.zeros((t.size, 3)), np.zeros((t.size, 3)))
    rec = Recording("hill", imu, {"position": column(lla, 1.0), "velocity": column(vel, 0.1)}, None, np.zeros(3))
    found = {f.code: f for f in CHECKS["velocity"].answer(rec)}
    assert ("velocity.vertical_units" in found) == (ratio is not None)
    assert ratio is None or found["velocity.vertical_units"].value == pytest.approx(ratio, rel=0.05)


def test_positions_in_feet(car):
    origin = car.aiding["position"].value[0]
    feet = check.stream("position", lambda p: origin + 3.28084 * (p - origin))(car)
    (found,) = [f for f in CHECKS["velocity"].answer(feet) if f.code == "velocity.units"]
    assert found.causes == ("positions look like feet",)


def manoeuvring(signed: bool, turns: bool) -> Recording:
    """Forwards, a stop, and on: backwards, or forwards after half a turn in the stop."""
    t = np.arange(0.01, 60.0, 0.01)
    speed = np.where(t < 25, 4.0, np.where(t < 32, 0.0, 4.0 if turns else -4.0))
    rate = np.where((t > 26) & (t < 31), np.pi / 5 if turns else 0.0, 0.02)
    yaw = np.cumsum(rate * 0.01)
    vel = np.column_stack([speed * np.sin(yaw), speed * np.cos(yaw), 0 * t])
    gyro, accel = np.column_stack([0 * t, 0 * t, rate]), np.tile([0.0, 0.0, -9.8], (t.size, 1))
    column = lambda value, sd: Samples(t[::20], value[::20], np.full(value[::20].shape, sd), 0 * value[::20])
    wheel = (speed if signed else np.abs(speed))[:, None]
    aiding = {"velocity": column(vel, 0.1), "speed": column(wheel, 0.1)}
    return Recording("manoeuvres", ImuLog(t, np.full(t.size, 0.01), gyro, accel), aiding, None, np.zeros(3))


@pytest.mark.parametrize(
    ("signed", "turns", "warned"), [(True, False, 0), (False, False, 1), (False, True, 0), (True, True, 0)]
)
def test_a_wheel_without_a_sign_on_a_vehicle_that_reverses(signed, turns, warned):
    found = [f for f in CHECKS["speed"].answer(manoeuvring(signed, turns)) if f.code == "speed.unsigned"]
    assert len(found) == warned
    assert not found or found[0].value == pytest.approx(32.0, abs=0.3)


@pytest.mark.parametrize(("factor", "side"), [(1.0, None), (0.2, "large"), (2.4, "small")])
def test_stated_sd_that_are_off_are_named_by_the_motion(factor, side):
    """White errors, as large as stated, a fifth of it, 2.4 times of it."""
    rec, _ = simulated("car", "tactical", True, np.random.default_rng(3), late=0.0)
    v, p = rec.aiding["velocity"], rec.aiding["position"]
    scaled = {"velocity": v._replace(sd=v.sd / factor), "position": p._replace(sd=p.sd / factor)}
    found = [f for f in CHECKS["together"].answer(rec._replace(aiding=scaled)) if f.code == "motion.sd"]
    assert [f.message.split("times too ")[1].split(",")[0] for f in found] == [side] * (side is not None)


def test_variances_in_the_place_of_sd():
    rng, t = np.random.default_rng(0), np.arange(300.0)
    lla = np.column_stack([0.8 + 0.09 / 6.4e6 * rng.normal(size=300), 0.2 + 0.13 / 6.4e6 * rng.normal(size=300), 0 * t])
    imu = ImuLog(t, np.ones(300), np.zeros((300, 3)), np.zeros((300, 3)))
    for stated, said in ((0.09, False), (0.0081, True), (0.002, True)):
        aiding = {"position": Samples(t, lla, np.full((300, 3), stated), np.zeros((300, 3)))}
        found = [f for f in CHECKS["fixes"].answer(Recording("a", imu, aiding, None, np.zeros(3)))
                 if f.code == "position.sd"]  # fmt: skip
        assert len(found) == said
        if stated == 0.0081:
            assert "variance" in found[0].causes[0]


@pytest.mark.parametrize(("arm", "speeds", "said"), [
    (0.9, (15.0, 14.0, 15.0), "0.9 m behind"), (-0.6, (10.0, 10.0, 10.0), "0.6 m ahead of"),
    (0.0, (5.0, 15.0, 25.0), None), (30.0, (15.0, 15.0, 15.0), None),
])  # fmt: skip
def test_a_lever_arm_that_looks_like_a_delay_is_a_cause(arm, speeds, said):
    """A delay is alike at all speeds, an antenna behind the IMU is not; at one speed nobody knows."""
    each = []
    for speed in speeds:
        late = arm / speed if arm else 0.06
        sd = np.r_[np.full(9, 0.1), 0.004]
        each.append(((0.0, 1.0), SimpleNamespace(delay=late, sd=sd, vel=np.array([speed, 0.0, 0.0]))))
    mean = float(np.mean([a.delay for _, a in each]))
    found = motion._behind(each, mean)
    assert (found is None) == (said is None) and (said is None or found.startswith(said))


def test_no_heading_by_the_course_where_there_is_none(car):
    """Of a vehicle that flies sideways, and one that crabs along one line."""
    assert CHECKS["heading"].answer(pointed(car, lambda a: 2.5 * a)) == []
    straight = check.stream("velocity", lambda v: np.tile([0.0, 8.0, 0.0], (len(v), 1)))
    crab = CHECKS["heading"].answer(straight(pointed(car, lambda a: 0 * a + 12 * DEG)))
    assert [f.code for f in crab] == ["heading"]


def test_a_coarse_step_of_a_quiet_axis_is_no_stop(car):
    """Twice the top in a row, of few values; a pulse that is cut is clipped."""
    rows = np.arange(car.imu.t.size)
    axis = lambda column: car._replace(imu=car.imu._replace(gyro=np.column_stack([column, car.imu.gyro[:, 1:]])))
    clipped = lambda column: "imu.clipped" in bad(axis(column), "axes")
    assert not clipped(np.where(rows % 200 < 2, 2e-3, np.where(rows % 7 == 0, 1e-3, 0.0)))
    wave = np.sin(rows / 30.0) + 1e-4 * np.random.default_rng(0).normal(size=rows.size)
    assert clipped(np.clip(wave**301, -0.6, 0.6))


def test_in_turns_of_one_sense_a_delay_is_no_other_north():
    """On a circle a velocity that is 0.3 s late is turned by 5.7 deg, too; in turns of both senses it is not."""
    t, rng = np.arange(0.0, 120.0, 0.5), np.random.default_rng(0)
    for course, turned in ((0.33 * t, False), (0.33 * t + 0.2, False), (np.sin(0.1 * t), True)):
        course_said = np.interp(t - 0.3, t, course) if not turned else course - 0.1
        at = lambda angle: 8.0 * np.column_stack([np.sin(angle), np.cos(angle)]) + 0.1 * rng.normal(size=(t.size, 2))
        found = streams._turned(at(course), at(course_said), t, 4)
        assert [f.code for f in found] == ["velocity.turned"] * turned


def test_the_gain_of_a_change_does_not_depend_on_the_stated_sd(car):
    """Fixes that say that they are five times worse: chi^2 is 25 times smaller, the likelihood ratio the same."""
    wrong = check.as_floats(DAMAGES["gyro.sign"](car))
    worse = {name: s._replace(sd=5 * s.sd) for name, s in wrong.aiding.items()}
    (plain,), (stated,) = mixups(wrong), mixups(wrong._replace(aiding=wrong.aiding | worse))
    assert plain.code == stated.code == "gyro.sign"


@pytest.mark.parametrize("change", alternatives.changes(), ids=lambda c: c.cause)
def test_a_change_undoes_itself(car, change):
    """Axes, signs and swaps are their own inverse; a unit and a scale are multiplied back."""
    there = alternatives.changed(car, change)
    inverse = change._replace(**{k: np.linalg.inv(getattr(change, k)) for k in ("gyro", "accel", "fixes")})
    back = alternatives.changed(there, inverse)
    np.testing.assert_allclose(back.imu.gyro, car.imu.gyro, atol=1e-12)
    np.testing.assert_allclose(back.imu.accel, car.imu.accel, atol=1e-12)
    np.testing.assert_allclose(back.aiding["position"].value, car.aiding["position"].value, atol=1e-7)


@pytest.mark.parametrize(
    "code, change", [("fixes.swapped", check.swapped(0, 1)), ("fixes.sign", check.times(-1, 1, 1))]
)
def test_mirrored_fixes_show_with_positions_alone(code, change):
    rec, _ = simulated("car", "tactical", False, np.random.default_rng(2), 0.5, late=0.0)
    p = rec.aiding["position"]
    bad_one = rec._replace(aiding={"position": p._replace(value=p.value[0] + change(p.value - p.value[0]))})
    assert mixups(rec) == [] and code in {f.code for f in mixups(bad_one)} | {"fixes.sign"}


@pytest.mark.parametrize("span", [40.0, 60.0])
def test_a_short_recording_has_no_other_clock(span):
    """Turns of 801 lags are alike by chance: only what fits accelerations, too, is another time scale."""
    for seed, kind in enumerate(("car", "ship", "aircraft", "robot")):
        rec, _ = simulated(kind, "consumer", True, np.random.default_rng(seed), span=span, late=0.0)
        assert not [f for f in mixups(rec)], kind


def test_noise_of_the_receivers_height_makes_no_other_unit():
    """Heights that vary by 2.5 m, known to 1.5 m: the slope is 0.7 by regression, and 1 in truth; feet stay feet."""
    rng, t = np.random.default_rng(0), np.arange(1.0, 400.0)
    height = 2.5 * np.sqrt(2) * np.sin(2 * np.pi * t / 90)
    lla = np.column_stack([np.full(t.size, 0.8), np.full(t.size, 0.2), height + 1.5 * rng.normal(size=t.size)])
    column = lambda value, sd: Samples(t, value, np.full(value.shape, sd), np.zeros(value.shape))
    imu = ImuLog(t, np.ones(t.size), np.zeros((t.size, 3)), np.zeros((t.size, 3)))
    for factor, code in ((1.0, "barometer"), (3.28084, "barometer.units")):
        aiding = {"position": column(lla, 1.5), "barometer": column(factor * height[:, None], 0.1)}
        (found,) = CHECKS["barometer"].answer(Recording("hill", imu, aiding, None, np.zeros(3)))
        assert found.code == code and found.value == pytest.approx(factor, rel=0.1)


@pytest.mark.parametrize("kind", ["jet", "thermal", "coach", "table"])
def test_gravity_is_where_the_fixes_do_not_accelerate(kind):
    """A pull-up and a steady turn are quiet and show more than gravity; a scale of 10 % is named all the same."""
    rec, _ = simulated(kind, "tactical", True, np.random.default_rng(3), span=120.0, late=0.0)
    assert not bad(rec, "gravity")
    larger = rec._replace(imu=rec.imu._replace(accel=1.1 * rec.imu.accel))
    assert bad(larger, "gravity", "together") & {"imu.gravity_size", "accel.bias"}


def hovering(seed: int, seconds: float) -> Recording:
    """Return a multirotor that holds its position: neither velocity nor yaw rate has to do with the other."""
    rng, n = np.random.default_rng(seed), int(50 * seconds)
    walk = lambda tau, sd: lfilter(
        [1.0], [1.0, -np.exp(-0.02 / tau)], sd * np.sqrt(0.04 / tau) * rng.normal(size=(n, 3)), 0
    )
    t, vel = np.arange(1, n + 1) / 50, walk(3.0, rng.uniform(0.3, 1.5))
    imu = ImuLog(t, np.full(n, 0.02), walk(1.0, rng.uniform(0.02, 0.3)), np.tile([0.0, 0.0, -9.8], (n, 1)))
    v = vel[::10] + 0.1 * rng.normal(size=vel[::10].shape)
    sample = lambda value, sd: Samples(t[::10], value, np.full(v.shape, sd), np.zeros_like(v))
    aiding = {"position": sample(np.tile([0.8, 0.2, 100.0], (len(v), 1)), 1.0), "velocity": sample(v, 0.1)}
    return Recording("hovering", imu, aiding, None, np.zeros(3))


@pytest.mark.full
@pytest.mark.parametrize("seconds", [12.0, 20.0, 40.0])
def test_a_hovering_multirotor_has_no_wrong_sign(seconds):
    """Specific force and velocities have nothing to do with each other: hardly a change makes them."""
    warned = [seed for seed in range(20) if mixups(hovering(seed, seconds))]
    assert len(warned) <= 2


@pytest.mark.full
@pytest.mark.parametrize("kind", ["steep", "quadrotor"])
def test_a_banked_and_a_sideways_flight_have_right_gyros(kind):
    """Their gyro z reads some 0.6 and 0.5 times the course's rate; with a wrong scale on top it is named."""
    rec, _ = simulated(kind, "consumer", True, np.random.default_rng(3))
    (said,) = CHECKS["turns"].answer(rec)
    assert said.code == "gyro" and not 0.7 < said.value < 1.4
    assert bad(rec, "turns", "together") <= {"time.late", "mounting.turned"}
    wrong = rec._replace(imu=rec.imu._replace(gyro=rec.imu.gyro * [1.0, 1.0, 0.5]))
    assert bad(wrong, "turns") == {"gyro.turns"}


def test_without_a_position_no_delay_is_known(car):
    """Velocities alone, and positions that are all hidden; with them the delay is that of the simulation."""
    none = sample_rows(car.aiding["position"], slice(0))
    assert delay_of(car._replace(aiding=car.aiding | {"position": none})) is None
    assert delay_of(car._replace(aiding={"velocity": car.aiding["velocity"]})) is None
    mean, sd = delay_of(car)
    assert 0.0 < mean < 0.35 and 0.0 < sd < 0.05


def test_turns_over_a_gap_between_fixes_do_not_count(car):
    """Interpolated over 11 s, velocities turn as nothing did."""
    v = car.aiding["velocity"]
    kept = (v.t < v.t[0] + 30) | (v.t > v.t[0] + 41)
    x = turns_of(car._replace(aiding=car.aiding | {"velocity": sample_rows(v, kept)}))
    assert not x.weight[(x.t > v.t[0] + 30) & (x.t < v.t[0] + 40)].any() and x.weight[x.t < v.t[0] + 25].any()


@pytest.mark.full
@pytest.mark.parametrize("factor, wrong", [(1.0, False), (180 / np.pi, True), (np.pi / 180, True)])
def test_degrees_for_radians_show_with_positions_alone(factor, wrong):
    """Their noise leaves a correlation of turns of 0.45; accelerations tell the unit."""
    rec = pauses.drive(0, 300.0)
    seen = rec._replace(imu=rec.imu._replace(gyro=factor * rec.imu.gyro), aiding={"position": rec.aiding["position"]})
    found = [f.code for f in mixups(seen)]
    assert found == (["gyro.units"] if wrong else [])


def test_coarse_steps_and_a_loud_axis_are_noise_of_that_axis(car):
    """A step q has at least the noise q / sqrt(12) a sample, moving or not; white noise is that of its axis alone."""
    root, rng = np.sqrt(np.median(car.imu.dt)), np.random.default_rng(0)
    coarse = car.imu.gyro.copy()
    coarse[:, 1] = 0.01 * np.round(coarse[:, 1] / 0.01)
    assert inertial.resolution(coarse) == pytest.approx([0.0, 0.01, 0.0])
    floor, _ = inertial.noise_floor(car.imu)
    again, _ = inertial.noise_floor(car.imu._replace(gyro=coarse))
    assert again[1] >= 0.999 * root * 0.01 / np.sqrt(12) and again[[0, 2]] == pytest.approx(floor[[0, 2]], rel=0.2)
    loud = car.imu.gyro + np.array([0.0, 0.0, 0.02]) * rng.normal(size=car.imu.gyro.shape)
    again, _ = inertial.noise_floor(car.imu._replace(gyro=loud))
    assert again[2] == pytest.approx(0.02 * root, rel=0.1) and again[:2] == pytest.approx(floor[:2], rel=0.2)


@pytest.mark.parametrize("kind", ["walk", "mower"])
def test_motion_is_no_noise(kind):
    """Steps at 1.9 Hz and turns that never rest: the noise of a tactical IMU is found, by first differences 7 to 11."""
    rec, _ = simulated(kind, "tactical", True, np.random.default_rng(0))
    gyro, accel = inertial.noise_floor(rec.imu)
    assert np.median(gyro) == pytest.approx(GRADES["tactical"].arw, rel=0.15)
    assert np.median(accel) == pytest.approx(GRADES["tactical"].vrw, rel=0.15)


def test_every_check_answers_where_there_is_little_or_nothing(car):
    """A few rows, an IMU alone, one fix: no exception, no warning."""
    few = ImuLog(*(a[:20] for a in car.imu))
    alone = car._replace(aiding={}, truth=None)
    for rec in (alone, alone._replace(imu=few), car._replace(imu=few)):
        for name, row in CHECKS.items():
            assert isinstance(row.answer(rec), list), name
    one = {name: sample_rows(s, slice(None, 1)) for name, s in car.aiding.items()}
    assert isinstance(checkup(car._replace(aiding=one)), list)


def test_a_read_says_what_looks_wrong(car, tmp_path):
    from jaxnav.io import write_recording

    write_recording(tmp_path / "right", car)
    write_recording(tmp_path / "wrong", DAMAGES["velocity.swapped"](car))
    assert "velocity.swapped" not in {f.code for f in read(tmp_path / "right").findings}
    wrong = read(tmp_path / "wrong")
    assert "velocity.swapped" in {f.code for f in wrong.findings}
    assert [f.code for f in checkup(wrong)].count("velocity.swapped") == 1  # not of the reader and of the check


def test_the_overview_draws_every_stream(car):
    """A row a stream, and lines of finite values in all other panels."""
    from jaxnav.analysis.plots.checkup import overview

    first, *others = overview(car).axes
    assert [tick.get_text() for tick in first.get_yticklabels()] == ["imu", *car.aiding]
    for ax in others:
        lines = ax.get_lines()
        assert lines and all(np.isfinite(line.get_ydata()).any() for line in lines), ax.get_title()
    down = next(line for line in others[-1].get_lines() if line.get_label() == "down")
    assert len(down.get_xdata()) == car.imu.t.size // 100  # means over a second, at its end
    second = car.imu.accel[:100, 2].mean()
    assert (down.get_xdata()[0], down.get_ydata()[0]) == pytest.approx((car.imu.t[99], second))


def test_the_overview_of_an_imu_alone_warns_of_nothing(car):
    """Warnings are errors here: a legend of a panel without lines was one, on the user's terminal."""
    from jaxnav.analysis.plots.checkup import overview

    axes = overview(car._replace(aiding={})).axes
    assert [bool(ax.get_legend()) for ax in axes] == [False, False, True, False, True]


def test_a_stream_that_is_short_says_where(car):
    """The second half is gone, or the first."""
    v = car.aiding["velocity"]
    half = v.t.size // 2
    for rows, said in ((slice(None, half), "ends 34.8 s"), (slice(half, None), "begins 34.8 s")):
        cut = car._replace(aiding=car.aiding | {"velocity": sample_rows(v, rows)})
        (finding,) = CHECKS["ends"].answer(cut)
        assert finding.message.startswith(f"velocity {said}") and " and " not in finding.message, finding.message


def test_the_detector_of_standstills_is_set_by_what_the_receiver_says():
    """A car that stands with its engine on: thresholds between what the IMU shows at rest and in motion."""
    scenario = URBAN._replace(motion=URBAN.motion._replace(standstill_s=60.0), duration_s=200.0)
    rec = to_recording(simulate_jit(jax.random.key(4), scenario), scenario)
    rng = np.random.default_rng(0)
    shaken = rec.imu.accel + 0.5 * rng.normal(size=rec.imu.accel.shape)  # 0.87 m/s^2 in all, always
    boarding = ((rec.imu.t > 20) & (rec.imu.t < 24))[:, None]  # as much as the drive itself
    turned = rec.imu.gyro + 0.3 * boarding * rng.normal(size=shaken.shape)
    shaken += 3 * boarding * rng.normal(size=shaken.shape)
    rec = rec._replace(imu=rec.imu._replace(accel=shaken, gyro=turned))
    accel, gyro = standstill(rec)
    assert (accel.code, gyro.code) == ("standstill.accel", "standstill.gyro")
    lines = configuration(Data("drive"), rec, [accel, gyro]).splitlines()
    assert [line.split(" = ")[0] for line in lines if line.startswith("# standing")] == [
        "# standing_accel_sd_mps2", "# standing_gyro_sd_deg_per_s"]  # fmt: skip
    assert 'measurements = ["position", "velocity"]' in lines
    assert "# `jaxnav solve` also tries zero_velocity, zero_rate" in lines
    assert 0.8 < accel.value < 1.8 and "% of them and 0." in gyro.message
    t = np.arange(5.0, 198.0)
    found = stationary(rec.imu, t, 1.0, accel.value, gyro.value * DEG)
    speed = np.interp(t, rec.truth.t, np.linalg.norm(rec.truth.vel, axis=1))
    assert found[t < 59].mean() > 0.85 and found[speed > 0.5].mean() < 0.03
    assert not stationary(rec.imu, t, *Standing()).any()  # the default takes the engine for motion
    assert standstill(rec._replace(aiding={})) == []


def test_no_threshold_where_rest_looks_like_motion(car):
    """An IMU that shakes more than the vehicle moves tells nothing."""
    scenario = URBAN._replace(motion=URBAN.motion._replace(standstill_s=60.0), duration_s=200.0)
    rec = to_recording(simulate_jit(jax.random.key(4), scenario), scenario)
    rng = np.random.default_rng(1)
    loud = ImuLog(rec.imu.t, rec.imu.dt, *(rng.normal(size=(rec.imu.t.size, 3)) * [1, 1, 1] for _ in range(2)))
    assert [f.code for f in standstill(rec._replace(imu=loud))] == ["standstill"]
