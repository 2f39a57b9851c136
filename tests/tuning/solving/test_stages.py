"""The time that is left, by weights."""

from tuning.solving.stages import Stage, Stages


def test_the_rest_follows_from_the_time_so_far():
    lines, now = [], [0.0]
    stages = Stages([Stage("check", 1.0), Stage("tune", 9.0)], lines.append, lambda: now[0])
    stages.next()
    now[0] = 4.0
    stages.replace([Stage("noise", 3.0), Stage("tune", 20.0)])
    stages.next()
    now[0] = 16.0
    stages.next()
    assert lines == ["1 of 2: check", "2 of 3: noise, about 92 s left", "3 of 3: tune, about 80 s left"]
