"""Findings after a solution: delays that are taken, commands that have run, causes without their consequences."""

import pytest

from jaxnav.filters.catalogue import build
from jaxnav.filters.lanes import RECEIVER_ERROR
from jaxnav.filters.parameters import put
from jaxnav.findings import finding
from jaxnav.kinds import KINDS
from tuning.solving.settled import CHECKED, CONSEQUENCES, EXCLUSIONS, TUNED, settled

PARAMS = build("ekf15").params("consumer")
LATE = finding("time.late", "position", 0.31, size=0.31, side="late", sd=0.01, cause="latency of the receiver")
HIGH = finding("nis.high", "position", 3.0, 1.2, vector="3.0")


def test_a_delay_that_is_taken_is_said_to_be_and_how_to_undo_it():
    (found,) = settled([LATE], put(PARAMS, "mounting.time_offset", 0.30), True)
    assert found.code == "solve.applied" and not found.warns and found.value == pytest.approx(0.30)
    assert found.subject == "mounting.time_offset_s" and "0.310 s late" in found.message
    assert "mounting.time_offset_s" in found.actions[0]
    (own,) = settled([LATE], put(PARAMS, "measurements.position.latency", 0.28), True)
    assert own.subject == "measurements.position.latency_s"


@pytest.mark.parametrize("taken", [0.0, 0.1, -0.31])
def test_a_delay_that_is_not_taken_stays(taken):
    (found,) = settled([LATE], put(PARAMS, "mounting.time_offset", taken), True)
    assert found.code == "time.late" and found.warns and TUNED not in " ".join(found.actions)


def test_a_velocity_against_its_position_has_a_delay_of_its_own():
    old = finding("velocity.latency", value=0.2, size=0.2, side="older", sd=0.01)
    assert settled([old], put(PARAMS, "mounting.time_offset", 0.2), True) == [old]
    (found,) = settled([old], put(PARAMS, "measurements.velocity.latency", 0.2), True)
    assert found.code == "solve.applied"


def test_no_command_is_named_that_has_just_run():
    (after,) = settled([HIGH], PARAMS, True)
    assert after.actions == tuple(a for a in HIGH.actions if a not in (CHECKED, TUNED)) and len(after.actions) == 1
    (fast,) = settled([HIGH], PARAMS, False)
    assert TUNED in fast.actions and CHECKED not in fast.actions


def test_a_state_that_is_there_is_not_asked_for():
    wide = build("ekf15", states=(RECEIVER_ERROR,)).params("consumer")
    last = finding("innovations.correlated", "position", vector="east 0.9")
    assert settled([last], PARAMS, True)[0].actions and not settled([last], wide, True)[0].actions


def test_a_consequence_of_a_known_cause_is_left_out():
    mixed = finding("gyro.sign", "gyro z", was=9.0, then=1.0, gain=99.0, cause="gyro z has the other sign")
    assert [f.code for f in settled([HIGH, mixed, LATE], PARAMS, True)] == ["gyro.sign"]
    low = finding("nis.low", "position", 0.1, 0.8, vector="0.1")
    wide = finding("solve.inflated", "stated sd of positions", 1.4, count=88)
    assert [f.code for f in settled([low, wide], PARAMS, True)] == ["solve.inflated"]
    assert len(settled([low, HIGH], PARAMS, True)) == 2  # of other channels


def test_exclusions_are_of_kinds_and_none_excludes_its_own_cause():
    assert {*EXCLUSIONS, *CONSEQUENCES} <= set(KINDS)
    for winner, losers in EXCLUSIONS.items():
        assert set(losers) <= set(KINDS) and all(winner not in EXCLUSIONS.get(loser, ()) for loser in losers)
