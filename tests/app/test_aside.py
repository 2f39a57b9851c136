"""Work at the side of a job: in order, all of it before the job ends, and an error ends the job."""

import threading

import pytest

from jaxnav.app.aside import Aside


def test_calls_are_made_in_order_in_another_thread_before_the_block_ends():
    seen, may = [], threading.Event()

    def call(x):
        may.wait(10.0)
        seen.append((x, threading.current_thread() is threading.main_thread()))

    with Aside(call) as aside:
        for x in range(3):
            aside(x)
        assert not seen  # the block goes on meanwhile
        may.set()
    assert seen == [(x, False) for x in range(3)]


def test_an_error_ends_the_job():
    def fails(x):
        raise ValueError(f"call {x}")

    with pytest.raises(ValueError, match="call 1"), Aside(fails) as aside:
        aside(1)
    with pytest.raises(ValueError, match="call 1"), Aside(fails) as aside:
        aside(1)
        aside.calls[0].exception(10.0)
        aside(2)
        raise AssertionError  # not reached


def test_an_interrupted_job_waits_for_the_call_that_runs_and_drops_the_rest():
    seen, started = [], threading.Event()

    def call(x):
        started.set()
        seen.append(x)

    with pytest.raises(KeyboardInterrupt), Aside(call) as aside:
        aside(1)
        started.wait(10.0)
        hold = threading.Event()
        aside.function = lambda x: hold.wait(0.2) or seen.append(x)
        for x in (2, 3):
            aside(x)
        raise KeyboardInterrupt
    assert seen[0] == 1 and 3 not in seen
