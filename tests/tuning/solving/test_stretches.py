"""Stretches with a fault of the receiver: found where they begin and end, left out, said; healthy drives stay whole."""

import jax
import numpy as np
import pytest

from jaxnav.filters import epochs as ep
from jaxnav.filters.catalogue import build
from jaxnav.filters.lanes import LaneRecord
from jaxnav.filters.parameters import put
from jaxnav.initialization.initialize import initialize
from jaxnav.maths import earth
from jaxnav.measurements import GNSS, MEASUREMENTS
from jaxnav.simulate.scenarios import URBAN_SHORT
from jaxnav.simulate.simulation import simulate_jit, to_recording
from tuning.recordings.experiment import experiments_of
from tuning.recordings.parts import plan
from tuning.solving import solve
from tuning.solving.stretches import (
    APART_S,
    Jump,
    as_likely,
    candidates_of,
    changes_of,
    faulty_stretches,
    finding_of_jump,
    jumps_of,
    without,
)

FAULT = (60.0, 90.0)  # s


@pytest.fixture(scope="module")
def drive():
    """Three minutes in town."""
    gnss = URBAN_SHORT.gnss._replace(outages_s=(), position_sd_m=(0.5, 0.5, 1.0))
    what = URBAN_SHORT._replace(duration_s=180.0, imu_rate_hz=50.0, gnss=gnss)
    return to_recording(simulate_jit(jax.random.key(2), what), what)


def dragged(rec, begin, end, rate=2.0):
    """Positions and velocities slide off to the east together, and come back."""
    p, v = rec.aiding["position"], rec.aiding["velocity"]
    metres = np.asarray(earth.metres_per_radian(p.value[0]))
    slide = lambda t: rate * ((t > begin) & (t <= end))
    off = np.column_stack([0 * p.t, slide(p.t) * (p.t - begin), 0 * p.t]) / metres
    moving = np.column_stack([slide(v.t), 0 * v.t, 0 * v.t])
    aiding = {"position": p._replace(value=p.value + off), "velocity": v._replace(value=v.value + moving)}
    return rec._replace(aiding=rec.aiding | aiding)


def scored(rec, scale=1.0):
    """The plain filter over a recording, with the windows of the solution; ``scale`` on the sd of positions."""
    filt = build("ekf15", [m.name for m in GNSS], 5)
    params = put(filt.params("consumer"), "measurements.position.scale", scale * np.ones(3))
    (experiment,) = experiments_of([rec], filt, [initialize(rec, params)], solve.Standing())
    assert experiment.tested
    return experiment.score(filt, params)


@pytest.mark.full
def test_a_receiver_that_is_dragged_off_is_found_from_begin_to_end(drive):
    interval = float(np.median(np.diff(drive.aiding["position"].t)))
    run = scored(dragged(drive, *FAULT))
    (stretch,), gain = faulty_stretches(run, jumps_of(run))
    assert stretch[0] == pytest.approx(FAULT[0], abs=2 * interval + 1.0) and gain > 100
    assert stretch[1] == pytest.approx(FAULT[1], abs=2 * interval)


@pytest.mark.full
def test_a_healthy_drive_stays_whole(drive):
    assert faulty_stretches(scored(drive)) == ([], 0.0)


def jumped(rec, after, metres=30.0, until=np.inf):
    """Positions are off to the east after a time."""
    p = rec.aiding["position"]
    off = np.column_stack([0 * p.t, metres * ((p.t > after) & (p.t < until)), 0 * p.t])
    moved = p.value + off / np.asarray(earth.metres_per_radian(p.value[0]))
    return rec._replace(aiding=rec.aiding | {"position": p._replace(value=moved)})


@pytest.mark.full
@pytest.mark.parametrize("at", [50.0, 90.0])
def test_a_jump_that_stays_is_said_and_nothing_is_left_out(drive, at):
    """Either side may be at fault, and the IMU tells neither."""
    run = scored(jumped(drive, at))
    (jump,) = jumps_of(run)
    assert faulty_stretches(run, [jump]) == ([], 0.0)
    assert at < jump.t < at + 1.5 and jump.size == pytest.approx(30.0, abs=3.0)
    said = finding_of_jump(jump)
    verdict, why = solve.judge(1.0, None, [said])
    assert said.warns and verdict == solve.CARE and f"jump by {jump.size:.1f} m at t = {jump.t:.1f} s" in why


@pytest.mark.full
def test_the_likelier_of_stretch_and_jump_decides_and_both_are_said_if_alike(drive):
    """A drag-off ends in a jump; what came before it is no jump that stays."""
    run = scored(dragged(drive, 60.0, 90.0, 6.0))
    left_out, gain = faulty_stretches(run)
    jump = lambda more: Jump(90.5, np.array([30.0, 0.0, 0.0]), gain + more)
    assert left_out and faulty_stretches(run, [jump(-0.1)]) == (left_out, gain)
    assert faulty_stretches(run, [jump(0.1)]) == ([], 0.0)
    near, far = jump(-19.0), jump(-21.0)
    assert as_likely([near, far], gain) == [near]


def test_an_outlier_and_a_slide_are_no_jumps(drive):
    assert jumps_of(scored(drive)) == []
    assert jumps_of(scored(jumped(drive, 90.0, until=91.2))) == []
    assert all(jump.t > 85.0 for jump in jumps_of(scored(dragged(drive, 60.0, 90.0, 6.0))))  # its end is one


def test_a_jump_within_the_stated_sd_is_none(drive):
    """A receiver that states 5 m and scatters by half a metre: jumps of 8 m are within its word, those of 30 m not."""
    p = drive.aiding["position"]
    wide = drive._replace(aiding=drive.aiding | {"position": p._replace(sd=np.full_like(p.sd, 5.0))})
    assert jumps_of(scored(jumped(wide, 90.0, 8.0), 0.1)) == []
    assert [round(jump.size, -1) for jump in jumps_of(scored(jumped(wide, 90.0), 0.1))] == [30.0]


@pytest.mark.full
def test_two_faults_are_two_stretches(drive):
    twice = dragged(dragged(drive, 50.0, 65.0, 4.0), 110.0, 125.0, 4.0)
    run = scored(twice)
    found, _ = faulty_stretches(run, jumps_of(run))
    np.testing.assert_allclose(found, [(50.0, 65.0), (110.0, 125.0)], atol=4.5)


def record(nis):
    """A record of three channels with these normalised squares."""
    E = len(nis)
    valid = np.ones((1, E, 3), bool)
    record = LaneRecord(*[None] * len(LaneRecord._fields))
    nis = np.asarray(nis, float)[None]
    return record._replace(valid=valid, used=valid, nis=nis, ok=np.ones((1, E), bool))


def test_changes_are_the_largest_innovations_some_seconds_apart():
    t, nis = np.arange(40.0), np.full(40, 3.0)
    nis[[10, 11, 30]] = 100.0, 90.0, 50.0
    np.testing.assert_array_equal(changes_of(t, record(nis)), [10.0, 30.0])
    nis[11 + int(APART_S)] = 60.0
    np.testing.assert_array_equal(changes_of(t, record(nis)), [10.0, 15.0, 30.0])
    assert not changes_of(t, record(np.full(40, 3.0))).size and not changes_of(t, record(np.full(40, 90.0))).size


def test_a_stretch_ends_before_the_fix_that_shows_its_end():
    tried = candidates_of(np.array([10.0, 30.0]), 1.0)
    assert (9.0, 29.0) in tried and (19.0, 29.0) in tried and (29.0, 39.0) in tried
    fix = np.arange(50.0)
    np.testing.assert_array_equal(fix[ep.within(fix, [(9.0, 29.0)])], np.arange(10.0, 30.0))


@pytest.mark.full
def test_solve_leaves_a_fault_out_and_says_so(drive, monkeypatch):
    monkeypatch.setattr(solve, "options", lambda rec, found: [])
    found = solve.solve(dragged(drive, *FAULT), fast=True)
    ((begin, end),) = found.left_out
    (said,) = [f for f in found.findings if f.code == "solve.fault"]
    assert said.warns and f"{begin:.1f} to {end:.1f} s" in said.message and said.value == pytest.approx(end - begin)
    sol = found.solution
    assert sol.outages == found.left_out and found.metrics()["left_out"] == found.left_out
    truth = np.column_stack([np.interp(sol.t, drive.truth.t, c) for c in drive.truth.lla.T])
    off = earth.enu_path(sol.lla, truth)[:, :2]
    within = (sol.t > begin) & (sol.t < end)
    assert np.hypot(*off[within].T).max() < 15.0  # of 60 m
    assert np.sqrt(((off / sol.sd[:, :2]) ** 2).mean()) < 2.0
    assert not {"tune.fault", "velocity.columns"} & {f.code for f in found.findings}


def test_all_streams_of_the_receiver_are_left_out_and_no_others(drive):
    p = drive.aiding["position"]
    rec = drive._replace(aiding=drive.aiding | {"heading": p, "barometer": p, "unknown": p})
    left = without(rec, [FAULT])
    inside = lambda name: np.any((left.aiding[name].t > FAULT[0]) & (left.aiding[name].t <= FAULT[1]))
    receiver = {"position", "velocity"} | {n for n in ("heading",) if MEASUREMENTS[n].receiver}
    assert {name for name in rec.aiding if not inside(name)} == receiver


def test_windows_right_after_a_stretch_judge_nothing(drive):
    filt = build("ekf15", [m.name for m in GNSS], 5)
    params = filt.params("consumer")
    rec, begin = without(drive, [FAULT]), initialize(drive, params)
    (whole,) = experiments_of([drive], filt, [begin], solve.Standing())
    used = whole.without([FAULT], rec, begin).score(filt, params).used
    judged = used.starts[np.any(list(used.parts.values()), 0)]
    assert not np.any((judged > FAULT[0]) & (judged <= FAULT[1] + whole.layout.window)) and judged.size > 3


def test_parts_count_the_time_with_fixes(drive):
    """A minute without fixes in the middle belongs to no part."""
    filt = build("ekf15", [m.name for m in GNSS], 5)
    cut = lambda rec: ep.pack_recording(rec, GNSS, initialize(rec, filt.params("consumer")).t, 0.0, None)
    whole = plan(cut(drive), 10.0)
    gap = plan(cut(without(drive, [(60.0, 120.0)])), 10.0)
    begin, end = float(cut(drive).start) + whole.settle, float(drive.imu.t[-1])
    assert whole.train == pytest.approx(begin + 0.5 * (end - begin), abs=0.3)
    counted = end - begin - 60.0
    assert gap.train == pytest.approx(begin + 0.5 * counted + (60.0 if begin + 0.5 * counted > 60.0 else 0.0), abs=1.5)
    assert gap.validation == pytest.approx(begin + 0.65 * counted + 60.0, abs=1.5)
