"""Raw GNSS from files: RINEX, UBX of our own making, tables; and back from the project's folder."""

import numpy as np
import pytest

from jaxnav.gnss.corrections import Observations, at_reception, with_rates
from jaxnav.gnss.orbits import Ephemeris, state
from jaxnav.gnss.ranges import LIGHT, name, ranges_of
from jaxnav.io import canonical
from jaxnav.io.column_map import read_map
from jaxnav.io.formats import raw_table, rinex, ubx
from jaxnav.io.readers import read_parts, recognise
from jaxnav.io.recording import recording
from jaxnav.maths.gps_time import GPS_EPOCH, WEEK, leap_seconds
from jaxnav.reading.read import read
from jaxnav.types import DataError, ImuLog
from tests.gnss.sky import T0, TOKYO, constellation, ephemeris, inav, lnav
from tests.gnss.test_orbits import observations, repeated

EPOCHS = 20
L1 = LIGHT / 1575.42e6


@pytest.fixture(scope="module")
def seen():
    """Observations of a receiver at rest over 20 s, and the ephemerides."""
    eph = constellation()
    rows = [observations(eph, TOKYO, bias=3e5 + 40.0 * k, t=T0 + k) for k in range(EPOCHS)]
    up = np.zeros(eph.satellite.size, bool)
    position, _ = state(eph, np.full(eph.satellite.size, T0))
    up = (position - TOKYO) @ TOKYO / np.linalg.norm(position - TOKYO, axis=1) / np.linalg.norm(TOKYO) > 0.25
    return [tuple(a[up] for a in row) for row in rows], eph, up


def navigation_file(path, eph: Ephemeris) -> None:
    """A RINEX 3 navigation file, numbers in full."""
    head = ["     3.04           N: GNSS NAV DATA    M: MIXED            RINEX VERSION / TYPE",
            "GPSA   0.1118D-07  0.0000D+00 -0.5960D-07  0.0000D+00       IONOSPHERIC CORR",
            "GPSB   0.9011D+05  0.0000D+00 -0.1966D+06  0.0000D+00       IONOSPHERIC CORR",
            f"{'':60}END OF HEADER"]  # fmt: skip
    f = lambda *v: "".join(f"{x:19.12E}" for x in v)
    body = []
    for k in range(eph.satellite.size):
        e = Ephemeris(*(a[k] for a in eph))
        body += [f"{name(e.satellite)} 2020 11  5  6  0  0{f(e.af0, e.af1, e.af2)}"]
        lines = ((7, e.crs, e.delta_n, e.m0), (e.cuc, e.e, e.cus, e.sqrt_a), (e.toe_of_week, e.cic, e.omega0, e.cis),
                 (e.i0, e.crc, e.omega, e.omega_dot), (e.idot, 1, 2130, 0), (2, e.health, e.group_delay, 7),
                 (e.toe_of_week, 4, 0, 0))  # fmt: skip
        body += [f"    {f(*map(float, line))}" for line in lines]
    path.write_text("\n".join(head + body) + "\n")


def observation_file(path, rows) -> None:
    head = ["     3.04           OBSERVATION DATA    M: MIXED            RINEX VERSION / TYPE",
            "G    4 C1C L1C D1C S1C                                      SYS / # / OBS TYPES",
            "  2020    11     5     5    15    0.0000000     GPS         TIME OF FIRST OBS",
            f"{'':60}END OF HEADER"]  # fmt: skip
    body = []
    for k, (_, sats, pseudorange, rate, cn0, phase, slipped, _) in enumerate(rows):
        body.append(f"> 2020 11  5  5 15 {k:2d}.0000000  0 {len(sats):2d}")
        for s, p, r, c, phi, lost in zip(sats, pseudorange, rate, cn0, phase, slipped, strict=True):
            body.append(f"{name(s)}{p:14.3f}  {phi / L1:14.3f}{int(lost)} {-r / L1:14.3f}  {c:14.3f}  ")
    path.write_text("\n".join(head + body) + "\n")


def ubx_file(path, rows, eph, encoded=lnav) -> None:
    pyubx2 = pytest.importorskip("pyubx2")
    frames = []
    system = {"G": 0, "E": 2}
    for k, (t, sats, pseudorange, rate, cn0, phase, slipped, _) in enumerate(rows):
        values = {"rcvTow": t[0] - GPS_EPOCH - 2130 * WEEK, "week": 2130, "leapS": 18, "numMeas": len(sats),
                  "reserved1": 0}  # fmt: skip
        for i, (s, p, r, c, phi, lost) in enumerate(zip(sats, pseudorange, rate, cn0, phase, slipped, strict=True), 1):
            each = {"prMes": p, "cpMes": phi / L1, "doMes": -r / L1, "gnssId": system[name(s)[0]], "svId": int(s) % 100,
                    "sigId": 0, "freqId": 0, "locktime": 0 if lost else 1000 * (k + 1),
                    "cno": int(c), "prStd": 1, "cpStd": 1, "doStd": 1,
                    "prValid": 1, "cpValid": 1, "halfCyc": 0, "subHalfCyc": 0, "reserved3": 0}  # fmt: skip
            values |= {f"{key}_{i:02d}": value for key, value in each.items()}
        frames.append(pyubx2.UBXMessage("RXM", "RXM-RAWX", pyubx2.GET, **values).serialize())
        if k:
            continue
        for j in range(eph.satellite.size):
            one = Ephemeris(*(a[j] for a in eph))
            for words in encoded(one):
                about = {"gnssId": system[name(one.satellite)[0]], "svId": int(one.satellite) % 100, "sigId": 0,
                         "freqId": 0, "numWords": len(words), "chn": 0, "version": 2, "reserved0": 0}  # fmt: skip
                about |= {f"dwrd_{i:02d}": word for i, word in enumerate(words, 1)}
                frames.append(pyubx2.UBXMessage("RXM", "RXM-SFRBX", pyubx2.GET, **about).serialize())
    path.write_bytes(b"".join(frames))


def imu_of(t: np.ndarray) -> ImuLog:
    return ImuLog(t, np.full(t.size, 0.02), np.zeros((t.size, 3)), np.tile([0.0, 0.0, -9.8], (t.size, 1)))


def near(parts, metres: float) -> None:
    """Position and rest of a receiver whose atmosphere is corrected and not there."""
    from jaxnav.maths.axes import geodetic

    lla = np.asarray(parts.aiding["position"].value)
    assert lla.shape[0] == EPOCHS
    off = (lla - geodetic(TOKYO[None])) * np.array([6.36e6, 5.2e6, 0.3])
    assert np.abs(off).max() < metres, off[0]
    assert np.abs(parts.aiding["velocity"].value).max() < 0.05


def test_rinex_observations_and_messages(tmp_path, seen):
    rows, eph, _ = seen
    observation_file(tmp_path / "rover.obs", rows)
    with pytest.raises(DataError, match="its folder has none: give nav"):
        rinex.read(tmp_path / "rover.obs")
    navigation_file(tmp_path / "hour.nav", eph)
    found, ionosphere = rinex.read_navigation(tmp_path / "hour.nav")
    assert ionosphere is not None and ionosphere.alpha[2] == -0.596e-7 and ionosphere.beta[2] == -0.1966e6
    for a, b in zip(found, eph, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-11)
    assert recognise(tmp_path / "rover.obs").name == "RINEX observations"
    parts = rinex.read(tmp_path / "rover.obs", elevation_mask_deg=12.0)
    near(parts, 8.0)
    assert set(parts.aiding) == {"position", "velocity", "pseudorange", "range_rate"}
    assert any("the receiver's clock is taken out, 299" in str(note) for note in parts.notes), parts.notes
    known = (tmp_path / "hour.nav").read_text().splitlines(keepends=True)
    (tmp_path / "hour.nav").write_text("".join(row for row in known if "IONOSPHERIC" not in row))
    found = [note for note in rinex.read(tmp_path / "rover.obs").notes if note.warns]
    assert [(f.code, f.subject, f.warns) for f in found] == [("ranges.ionosphere", "hour.nav", True)]
    # with an IMU's file, and options for the reader of the fixes
    t = np.arange(T0 - 1.0, T0 + EPOCHS, 0.02)
    canonical.write_recording(tmp_path / "imu", recording(imu_of(t - T0 + 10.0)))
    (tmp_path / "map.toml").write_text(
        f"""[imu]
file = "imu.csv"
time = "t_s"
time_shift_s = {T0 - 10.0}
gyro = ["gyro_x_radps", "gyro_y_radps", "gyro_z_radps"]
gyro_unit = "rad/s"
accel = ["accel_x_mps2", "accel_y_mps2", "accel_z_mps2"]
accel_unit = "m/s^2"
"""
    )
    rec = read(tmp_path / "map.toml", folder=tmp_path / "imu", gnss=tmp_path / "rover.obs", elevation_mask_deg=30.0)
    few = rec.aiding["pseudorange"]
    assert np.degrees(few.auxiliary[..., 7][few.valid]).min() > 30.0
    for text, match in (("RINEX 2", "expected 3"), ("END OF HEADEX", "cut, or no RINEX")):
        body = (tmp_path / "rover.obs").read_text()
        broken = body.replace("     3.04", "     2.11", 1) if text == "RINEX 2" else body.replace("END OF HEADER", text)
        (tmp_path / "bad.obs").write_text(broken)
        with pytest.raises(DataError, match=match):
            rinex.read_observations(tmp_path / "bad.obs")


@pytest.mark.parametrize("encoded, letter", [(lnav, "G"), (inav, "E")])
def test_a_ubx_stream_of_our_own_making_decodes_to_the_same_orbits(tmp_path, encoded, letter):
    pytest.importorskip("pyubx2")
    from jaxnav.gnss.orbits import stacked

    eph = stacked([ephemeris(f"{letter}{k + 1:02d}", k) for k in range(24)])
    there, _ = state(eph, np.full(24, T0))
    up = (there - TOKYO) @ TOKYO / np.linalg.norm(there - TOKYO, axis=1) / np.linalg.norm(TOKYO) > 0.25
    rows = [tuple(a[up] for a in observations(eph, TOKYO, t=T0 + k)) for k in range(EPOCHS)]
    ubx_file(tmp_path / "log.ubx", rows, eph, encoded)
    assert recognise(tmp_path / "log.ubx").name == "UBX"
    parts = ubx.read(tmp_path / "log.ubx")
    near(parts, 8.0)
    stream = parts.aiding["pseudorange"]
    auxiliary = np.asarray(stream.auxiliary)[5]
    for row in auxiliary[auxiliary[:, 0] > 0]:
        one = repeated(Ephemeris(*(a[eph.satellite == row[0]] for a in eph)), 1)
        k = list(eph.satellite[up]).index(row[0])
        exact, _ = at_reception(one, np.array([T0 + 5]), rows[5][2][k : k + 1], TOKYO[None])
        assert np.linalg.norm(exact[0] - row[1:4]) < 0.2  # the steps of the message
    (tmp_path / "none.ubx").write_bytes((tmp_path / "log.ubx").read_bytes()[:400])
    with pytest.raises(DataError):
        ubx.read(tmp_path / "none.ubx", spp=True)


@pytest.mark.parametrize("kind", ["rinex", "ubx"])
def test_range_rates_by_carrier_phase(tmp_path, seen, kind):
    """Equal to Doppler's but for the clock, whose 40 m/s only the phase has; nothing where lock was lost."""
    rows, eph, _ = seen
    rows = [(*row[:6], (np.arange(row[6].size) == 1) & (k == 8), row[7]) for k, row in enumerate(rows)]
    if kind == "rinex":
        observation_file(tmp_path / "rover.obs", rows)
        navigation_file(tmp_path / "rover.nav", eph)
        by = lambda rates: rinex.read(tmp_path / "rover.obs", rates=rates)
    else:
        ubx_file(tmp_path / "log.ubx", rows, eph)
        by = lambda rates: ubx.read(tmp_path / "log.ubx", rates=rates)
    doppler, phase = (by(rates).aiding["range_rate"] for rates in ("doppler", "phase"))
    assert "latency_s = 0.5" in " ".join(map(str, by("phase").notes))
    assert doppler.t.size == EPOCHS and phase.t.size == EPOCHS - 1  # the first epoch has none before it
    both = doppler.valid[1:] & phase.valid
    lost = np.argwhere(doppler.valid[1:] & ~phase.valid)
    assert len(lost) == 1 and lost[0, 0] == 7 and doppler.auxiliary[8, lost[0, 1], 0] == rows[0][1][1]
    off = np.where(both, phase.value - doppler.value[1:], np.nan)
    off = off - np.nanmedian(off, 1, keepdims=True)
    assert np.nanmax(np.abs(off)) < (2e-3 if kind == "rinex" else 1e-3)  # of a satellite, in the digits of the file
    with pytest.raises(DataError, match="doppler, phase, got 'code'"):
        by("code")


def test_a_phase_is_not_differenced_over_a_gap(seen):
    """Two epochs are missing: the next one has no rate, of any satellite."""
    rows = [row for k, row in enumerate(seen[0]) if k not in (7, 8)]
    found, _ = with_rates(Observations(*(np.concatenate(a) for a in zip(*rows, strict=True))), "phase")
    rated = {round(t - T0) for t in found.t[np.isfinite(found.range_rate)]}
    assert rated == set(range(1, EPOCHS)) - {7, 8, 9}


def test_the_folder_of_a_recording_keeps_the_satellites(tmp_path, seen):
    rows, eph, _ = seen
    observation_file(tmp_path / "rover.obs", rows)
    navigation_file(tmp_path / "rover.nav", eph)
    parts = rinex.read(tmp_path / "rover.obs")
    t0 = T0 - 1.0
    streams = {key: s._replace(t=s.t - t0) for key, s in parts.aiding.items()}
    from jaxnav.types import Samples

    made = {k: Samples(s.t, s.value, s.sd, s.corr, s.valid, s.auxiliary) for k, s in streams.items()}
    rec = recording(imu_of(np.arange(0.02, EPOCHS + 1.0, 0.02)), **made)
    canonical.write_recording(tmp_path / "folder", rec)
    assert (tmp_path / "folder" / "satellites.csv").exists()
    again = canonical.read_recording(tmp_path / "folder")
    for key, samples in rec.aiding.items():
        for a, b in zip(samples, again.aiding[key], strict=True):
            np.testing.assert_array_equal(a, b)
    canonical.write_recording(tmp_path / "rec.npz", rec)
    packed = read(tmp_path / "rec.npz")
    np.testing.assert_array_equal(packed.aiding["pseudorange"].auxiliary, rec.aiding["pseudorange"].auxiliary)
    assert packed.aiding["pseudorange"].valid.dtype == bool
    # the table alone gives fixes to another IMU
    table = raw_table.read(tmp_path / "folder" / "satellites.csv")
    assert recognise(tmp_path / "folder" / "satellites.csv").name == "raw GNSS table"
    near(table, 8.0)


def test_googles_columns(tmp_path, seen):
    """Satellites at emission, their clocks in a column of their own."""
    rows, eph, up = seen
    lines = ["utcTimeMillis,Svid,ConstellationType,SignalType,RawPseudorangeMeters,PseudorangeRateMetersPerSecond,"
             "Cn0DbHz,SvPositionXEcefMeters,SvPositionYEcefMeters,SvPositionZEcefMeters,SvVelocityXEcefMetersPerSecond,"
             "SvVelocityYEcefMetersPerSecond,SvVelocityZEcefMetersPerSecond,SvClockBiasMeters,"
             "SvClockDriftMetersPerSecond,SvElevationDegrees,IsrbMeters"]  # fmt: skip
    own = Ephemeris(*(a[up] for a in eph))
    for t, sats, pseudorange, rate, cn0, *_ in rows:
        emitted = t - pseudorange / LIGHT
        _, clock = state(own, emitted)
        emitted = emitted - clock
        there, clock = state(own, emitted)
        speed = state(own, emitted + 0.5)[0] - state(own, emitted - 0.5)[0]
        drift = state(own, emitted + 0.5)[1] - state(own, emitted - 0.5)[1]
        utc = t[0] - leap_seconds(t[0])
        for i, s in enumerate(sats):
            signal_bias = 100.0 * (s % 3)
            cells = [utc * 1e3, s % 100, 1, "GPS_L1_CA", pseudorange[i] + signal_bias, rate[i], cn0[i], *there[i],
                     *speed[i], LIGHT * clock[i], LIGHT * drift[i], 45.0, signal_bias]  # fmt: skip
            lines.append(",".join(str(c) for c in cells))
        lines.append(lines[-1].replace("GPS_L1_CA", "GPS_L5_Q"))
    (tmp_path / "device_gnss.csv").write_text("\n".join(lines) + "\n")
    assert recognise(tmp_path / "device_gnss.csv").name == "raw GNSS table"
    parts = raw_table.read(tmp_path / "device_gnss.csv")
    near(parts, 0.5)
    assert float(parts.aiding["position"].t[0]) == pytest.approx(T0 - 3e5 / LIGHT, abs=1e-3)
    assert float(parts.aiding["pseudorange"].t[0]) == float(parts.aiding["position"].t[0])
    found = ranges_of(parts.aiding)
    first = found.t == found.t[0]
    for s, velocity in zip(found.satellite[first], found.velocity[first], strict=True):
        k = list(rows[0][1]).index(s)
        one = repeated(Ephemeris(*(a[k] for a in own)), 1)
        p, r = rows[0][2][k : k + 1], rows[0][3][k : k + 1]
        before, after = (at_reception(one, np.array([T0 + h]), p + h * r, TOKYO[None])[0] for h in (-0.5, 0.5))
        np.testing.assert_allclose(velocity, (after - before)[0], atol=1e-3)  # in axes that turn on
    u = (found.position - TOKYO) / np.linalg.norm(found.position - TOKYO, axis=1)[:, None]
    left = found.range_rate - np.sum(u * found.velocity, 1)
    assert np.abs(left - np.median(left)).max() < 2e-3
    # the same by a column map
    (tmp_path / "map.toml").write_text(
        """[read]
file = "imu"
[satellites]
file = "named.csv"
time = "utcTimeMillis"
time_unit = "ms"
time_scale = "utc"
satellite = "name"
pseudorange = "RawPseudorangeMeters"
range_rate = "PseudorangeRateMetersPerSecond"
position = ["SvPositionXEcefMeters", "SvPositionYEcefMeters", "SvPositionZEcefMeters"]
velocity = ["SvVelocityXEcefMetersPerSecond", "SvVelocityYEcefMetersPerSecond", "SvVelocityZEcefMetersPerSecond"]
emission = true
clock = "SvClockBiasMeters"
delays = ["IsrbMeters"]
clock_rate = "SvClockDriftMetersPerSecond"
where = { SvElevationDegrees = 45 }
"""
    )
    named = [f"{lines[0]},name"] + [f"{line},G{int(line.split(',')[1]):02d}" for line in lines[1:] if "L1" in line]
    (tmp_path / "named.csv").write_text("\n".join(named) + "\n")
    canonical.write_recording(tmp_path / "imu", recording(imu_of(np.arange(0.02, 3.0, 0.02))))
    mapped = read_map(tmp_path / "map.toml", read_parts)
    near(mapped, 0.5)
    assert mapped.aiding["position"].scale == "utc"
    values = (np.sort(p.aiding["pseudorange"].value, axis=1) for p in (mapped, parts))
    np.testing.assert_allclose(*values, atol=0.05)
    (tmp_path / "bad.csv").write_text("satellite,pseudorange_m,x_m\nQ1,1,2\n")
    with pytest.raises(DataError, match="t_s"):
        raw_table.read(tmp_path / "bad.csv")
