"""Every sample is accounted for, and innovations that are not as expected are said by channel."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.analysis import evaluate, usage
from jaxnav.filters.catalogue import build
from jaxnav.filters.epochs import Packed, hide, pack
from jaxnav.filters.run import run_jit
from jaxnav.measurements import GNSS, MEASUREMENTS
from jaxnav.measurements.satellites import SATELLITE
from jaxnav.types import Epoch, Fix, Info, Nav, Recording, Samples


def recording(case, aiding=None) -> Recording:
    return Recording("drive", case.imu, aiding or case.aiding, case.truth, np.zeros(3))


def test_every_sample_is_somewhere(case):
    later = {name: s._replace(t=s.t + 10.0) for name, s in case.aiding.items()}  # ten fixes after the IMU's end
    rec = recording(case, later | {"barometer": Samples(np.arange(5.0), *[np.ones((5, 1))] * 3)})
    packed = pack(case.imu, later, 1.0, start=15.0)
    hidden = (packed.t > 20.0) & (packed.t <= 30.0)
    info = run_jit(build("ekf15"), case.params, case.nav, hide(packed.epochs, hidden))
    found = usage.usage(rec, packed, info, GNSS, hidden)
    total = later["position"].t.size
    for name in ("position", "velocity"):
        u = found[name]
        assert u.read == total == u.before + u.outside + u.hidden + u.refused + u.used
        assert u.outside == int((later[name].t > 60.0).sum()) > 5 and u.hidden == 10 and u.refused == 0
    assert found["barometer"] == usage.Use(5, 0, 0, 0, 0, 0)
    first, second, *rest = usage.usage_findings(found)
    assert not rest and first.code == "stream.unused" and first.subject == "position" and second.subject == "velocity"
    assert "after the IMU's last sample" in first.message and "10 hidden as asked for" in first.message


def test_rejected_fixes_are_counted(case):
    wild = case.aiding["position"].value.copy()
    wild[30:33, 2] += 500.0
    aiding = case.aiding | {"position": case.aiding["position"]._replace(value=wild)}
    packed = pack(case.imu, aiding, 1.0)
    filt = build("ekf15_gate")
    own = case.params._replace(rule=filt.params("consumer").rule)
    info = run_jit(filt, own, case.nav, packed.epochs)
    found = usage.usage(recording(case, aiding), packed, info, GNSS, np.zeros(packed.t.size, bool))
    assert found["position"].refused >= 1
    assert any("refused by the filter's rule" in f.message for f in usage.usage_findings(found))


def test_a_filter_that_is_a_little_too_sure_everywhere_is_told_so():
    """Each of six channels of sixty fixes may be 1.4 times too large; all of them may not. A consistent one passes."""
    rng = np.random.default_rng(0)
    _, names, _ = evaluate.channel_names(GNSS)
    said = lambda z: usage.consistency_findings(info_of(z), usage.nis_by_channel(info_of(z), GNSS))
    white = rng.normal(size=(200, 60, 6))
    assert sum(bool(said(z)) for z in white) <= 4
    lines = [said(np.sqrt(1.4) * z) for z in white]
    assert np.mean([bool(each) for each in lines]) > 0.7
    assert np.mean(["nis.overall" in [f.code for f in each] for each in lines]) > 0.5
    lasting = white[0].copy()
    lasting[1:, 2] = 0.3 * white[0][1:, 2] + 0.95 * np.sqrt(0.5) * (white[0][:-1, 2] + white[0][1:, 2])
    (found,) = [f for f in said(lasting) if f.code == "innovations.correlated"]
    assert names[2] in found.subject and names[0] not in found.subject and found.value > 0.3


def info_of(z: np.ndarray) -> Info:
    """Innovations of unit covariance."""
    n, m = z.shape
    nothing = dict.fromkeys(Info._fields)
    return Info(**nothing | {
        "nu": jnp.asarray(z), "S": jnp.tile(jnp.eye(m), (n, 1, 1)), "used": jnp.ones((n, m), bool),
        "valid": jnp.ones((n, m), bool), "nis": jnp.sum(jnp.asarray(z) ** 2, 1), "nav": Nav(*[None] * len(Nav._fields)),
    })  # fmt: skip


@pytest.mark.parametrize("correlation", [0.0, 0.8])
def test_bounds_hold_a_consistent_filter_however_its_innovations_are_correlated(correlation):
    """Two hundred filters of 300 fixes: nearly all pass, and one that is 1.5 times too sure does not."""
    rng, flagged = np.random.default_rng(0), 0
    for _ in range(200):
        white = rng.normal(size=(300, 6)) * np.sqrt(1 - correlation**2)
        z = np.zeros((300, 6))
        z[0] = rng.normal(size=6)
        for i in range(1, 300):
            z[i] = correlation * z[i - 1] + white[i]
        flagged += bool(usage.channel_findings(usage.nis_by_channel(info_of(z), GNSS)))
    assert flagged <= 4
    words = usage.channel_findings(usage.nis_by_channel(info_of(1.5 * z), GNSS))
    if correlation == 0.0:
        assert [f.code for f in words] == ["nis.high"] and words[0].subject.endswith("and 3 more")
        assert words[0].value > words[0].limit > 1.0
    small = usage.channel_findings(usage.nis_by_channel(info_of(0.4 * z), GNSS))
    assert any(f.code == "nis.low" and f.value < f.limit < 1.0 for f in small)


def test_too_few_innovations_say_nothing():
    assert usage.nis_by_channel(info_of(np.full((5, 6), 9.0)), GNSS) == {}


def test_a_component_that_nothing_measured_is_no_finding():
    """A receiver without a vertical velocity states an sd of 1 km/s: its innovations are small, and mean nothing."""
    z = np.random.default_rng(0).normal(size=(60, 6))
    z[:, 5] *= 1e-3
    info = info_of(z)
    assert any(f.code == "nis.low" for f in usage.channel_findings(usage.nis_by_channel(info, GNSS)))
    silent = info._replace(nu=info.nu.at[:, 5].multiply(1e3), S=info.S.at[:, 5, 5].set(1e6))
    assert not usage.channel_findings(usage.nis_by_channel(silent, GNSS))


def test_sensors_that_are_louder_than_told_are_named(case):
    """The case's own noise passes; five times and more does not, of the sensor that it is and by its size."""
    rng = np.random.default_rng(0)
    told = float(np.mean(case.params.noise.gyro))
    root = np.sqrt(np.median(case.imu.dt))
    quiet = case.imu._replace(
        gyro=told / root * rng.normal(size=case.imu.gyro.shape), accel=np.tile([0.0, 0.0, -9.81], (case.imu.t.size, 1))
    )
    assert usage.noise_findings(quiet, case.params) == []
    loud = usage.noise_findings(quiet._replace(gyro=20 * quiet.gyro), case.params)
    assert [(f.code, f.subject) for f in loud] == [("imu.noise_high", "gyro")] and 14 < loud[0].value / loud[
        0
    ].limit < 23
    one = quiet.gyro * [1.0, 20.0, 1.0]
    alone = usage.noise_findings(quiet._replace(gyro=one), case.params)
    assert [(f.code, f.subject) for f in alone] == [("imu.noise_axis", "gyro y")] and alone[0].value > alone[0].limit


def test_a_satellite_that_the_gate_rejects_is_named():
    """G05 is in slot 1, then in slot 2: 12 of 40 rejected at 100 m; G07 once, which is no finding."""
    row, E = MEASUREMENTS["pseudorange"], 40
    auxiliary = np.zeros((E, row.size, len(SATELLITE)))
    auxiliary[:20, 0, 0], auxiliary[20:, 1, 0] = 5, 5
    auxiliary[20:, 0, 0] = auxiliary[:20, 1, 0] = 7
    valid = np.zeros((E, row.size), bool)
    valid[:, :2] = True
    used, nu = valid.copy(), np.zeros((E, row.size))
    used[15:20, 0] = used[20:27, 1] = used[30, 0] = False
    nu[15:20, 0] = nu[20:27, 1] = 100.0
    info = Info(**dict.fromkeys(Info._fields) | {"valid": valid, "used": used, "nu": nu})
    blank = jnp.zeros((E, row.size))
    fix = Fix(blank, blank, blank, jnp.asarray(valid), {"pseudorange": jnp.asarray(auxiliary)})
    packed = Packed(Epoch(None, fix), np.arange(1.0, E + 1), 0.0)
    (found,) = usage.satellite_findings(packed, info, (row,))
    assert found.code == "satellite.rejected" and found.subject == "G05" and found.value == 100.0 and found.warns
    assert "12 of 40" in found.message and "16 to 27 s" in found.message
    assert usage.satellite_findings(packed, info, GNSS) == []
