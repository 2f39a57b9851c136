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


def test_a_stage_longer_than_the_limit_does_not_fit():
    now, tune = [0.0], Stage("tune", 9.0)
    stages = Stages([Stage("check", 1.0), Stage("noise", 2.0), tune], lambda line: None, lambda: now[0], limit=20.0)
    assert stages.fits(tune)  # nothing is known of the time yet
    stages.next()
    stages.next()
    now[0] = 2.0  # two seconds for a weight of three
    assert stages.takes([tune]) == 6.0 and stages.fits(tune) and not stages.fits(tune, tune, tune, tune)
    assert stages.coming() == "tune to come, about 6 s"
