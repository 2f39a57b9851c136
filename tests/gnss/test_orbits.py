"""Orbits against Kepler's laws, messages of known numbers, and satellites that another program computed."""

import math
import os
from pathlib import Path

import numpy as np
import pytest
import scipy.io
import scipy.optimize
from scipy.spatial.transform import Rotation

from jaxnav.gnss.corrections import Ionosphere, Masks, Observations, at_reception, corrected, solved
from jaxnav.gnss.messages import Messages
from jaxnav.gnss.orbits import EARTH_RATE, Ephemeris, chosen, stacked, state, turned
from jaxnav.gnss.ranges import LIGHT, Ranges, number, selected
from jaxnav.gnss.single_point import single_point
from jaxnav.io.formats.rinex import read_navigation, read_observations
from jaxnav.maths.axes import enu_to_ecef
from jaxnav.maths.earth import RATE
from jaxnav.maths.gps_time import GPS_EPOCH, WEEK
from tests.gnss.sky import T0, TOKYO, constellation, ephemeris, inav, lnav

TOKYO_DATA = Path(os.environ.get("JAXNAV_DATA_DIR", "")) / "ixr_tokyo" / "2020-11-05"
needs_tokyo = pytest.mark.skipif(not TOKYO_DATA.is_dir(), reason="needs JAXNAV_DATA_DIR")


def repeated(eph: Ephemeris, n: int) -> Ephemeris:
    return Ephemeris(*(np.repeat(np.atleast_1d(a), n) for a in eph))


def test_orbits_keep_keplers_laws():
    """Without harmonics: radius by e, plane by i0, areas swept per time constant, in axes that do not turn."""
    still = dict.fromkeys(("cuc", "cus", "crc", "crs", "cic", "cis", "idot", "omega_dot", "delta_n"), np.asarray(0.0))
    eph = ephemeris("G05", 2)._replace(**still)
    t = T0 + np.arange(0.0, 3600.0, 10.0)
    position, _ = state(repeated(eph, t.size), t)
    inertial = turned(position, -RATE * (t - t[0]))
    radius = np.linalg.norm(inertial, axis=1)
    a, e = float(eph.sqrt_a) ** 2, float(eph.e)
    assert a * (1 - e) - 1 < radius.min() and radius.max() < a * (1 + e) + 1
    area = np.cross(inertial[1:-1], (inertial[2:] - inertial[:-2]) / 20.0)
    momentum = np.sqrt(3.986005e14 * a * (1 - e**2))
    np.testing.assert_allclose(np.linalg.norm(area, axis=1), momentum, rtol=1e-6)
    np.testing.assert_allclose(area[:, 2] / momentum, np.cos(0.96), rtol=1e-6)


@pytest.mark.parametrize("satellite, mu, rate", [
    ("G05", 3.986005e14, 7.2921151467e-5),  # IS-GPS-200N, table 20-IV
    ("J02", 3.986005e14, 7.2921151467e-5),  # IS-QZSS-PNT-005, table 5.5.1-1
    ("E11", 3.986004418e14, 7.2921151467e-5),  # Galileo OS SIS ICD 2.1, table 67
    ("C11", 3.986004418e14, 7.2921150e-5),  # BDS-SIS-ICD-B1I-3.0, section 5.2.4.12
])  # fmt: skip
def test_an_orbit_is_that_of_its_interface_document(satellite, mu, rate):
    """Near the end of a week, written out from the document's table with its numbers: within a millimetre.

    WGS 84's rate of the Earth, 7.292115e-5 rad/s, turns a GPS satellite by 22 m in length there.
    """
    tow, toe = 603_000.0, 601_200.0
    eph = ephemeris(satellite, 3, toe)
    got, _ = state(repeated(eph, 1), np.array([float(eph.toe) + tow - toe]))
    e, tk, a = float(eph.e), tow - toe, float(eph.sqrt_a) ** 2
    mean = float(eph.m0) + (math.sqrt(mu) / float(eph.sqrt_a) ** 3 + float(eph.delta_n)) * tk
    eccentric = scipy.optimize.brentq(lambda E: E - e * math.sin(E) - mean, mean - 1, mean + 1, xtol=1e-15)
    true = 2 * math.atan(math.sqrt((1 + e) / (1 - e)) * math.tan(eccentric / 2))
    phi = true + float(eph.omega)
    second = lambda c, s: float(c) * math.cos(2 * phi) + float(s) * math.sin(2 * phi)
    u, r = phi + second(eph.cuc, eph.cus), a * (1 - e * math.cos(eccentric)) + second(eph.crc, eph.crs)
    i = float(eph.i0) + float(eph.idot) * tk + second(eph.cic, eph.cis)
    node = float(eph.omega0) + float(eph.omega_dot) * tk - rate * (tk + toe)
    turn = Rotation.from_euler("ZX", [node, i]).as_matrix()
    np.testing.assert_allclose(got[0], turn @ [r * math.cos(u), r * math.sin(u), 0.0], rtol=0, atol=1e-3)


def test_a_clock_is_its_polynomial_less_relativity_and_group_delay():
    """Where sin E = 1 at toe, a minute after toc; F = -2 sqrt(mu) / c^2 (IS-GPS-200N, 20.3.3.3.3.1)."""
    eph = ephemeris("G05", 2)._replace(af2=np.asarray(1e-14))
    eph = eph._replace(m0=0.5 * np.pi - eph.e, toc=eph.toe - 60.0)
    _, clock = state(repeated(eph, 1), np.atleast_1d(eph.toe))
    relativity = -2 * np.sqrt(3.986005e14) / LIGHT**2 * float(eph.e) * float(eph.sqrt_a)
    polynomial = float(eph.af0) + 60 * float(eph.af1) + 3600e-14
    np.testing.assert_allclose(clock, polynomial + relativity - float(eph.group_delay), rtol=0, atol=1e-16)


def test_a_geostationary_satellite_stands_still_over_the_equator():
    """BeiDou's elements are in axes tilted by 5 deg: a node on the opposite side, an inclination of 5 deg."""
    still = dict.fromkeys(
        ("e", "cuc", "cus", "crc", "crs", "cic", "cis", "idot", "omega_dot", "delta_n", "toe_of_week"), np.asarray(0.0)
    )
    radius = (3.986004418e14 / RATE**2) ** (1 / 3)
    eph = ephemeris("C03")._replace(
        **still, sqrt_a=np.sqrt(radius), omega0=np.asarray(np.pi), i0=np.radians(5.0), omega=np.asarray(0.3)
    )
    t = float(eph.toe) + np.arange(0.0, 3600.0, 300.0)
    position, _ = state(repeated(eph, t.size), t)
    assert np.abs(position[:, 2]).max() < 1.0 and np.abs(position - position[0]).max() < 1.0
    np.testing.assert_allclose(np.linalg.norm(position, axis=1), radius, rtol=1e-9)
    moving, _ = state(repeated(eph._replace(satellite=np.asarray(number("C11"))), t.size), t)
    assert np.abs(moving[:, 2]).max() > 1e5


def test_an_ephemeris_is_the_nearest_healthy_one():
    early, late = ephemeris("G05", toe=360_000.0), ephemeris("G05", toe=367_200.0)
    ill = ephemeris("G05", toe=364_500.0)._replace(health=np.asarray(1.0))
    eph = stacked([early, late, ill, ephemeris("G06")])
    begin = GPS_EPOCH + 2130 * WEEK
    sats = np.array([number("G05"), number("G05"), number("G06"), number("G07"), number("R01")])
    t = begin + np.array([361_000.0, 366_000.0, 364_500.0, 364_500.0, 364_500.0])
    assert chosen(eph, sats, t).tolist() == [0, 1, 3, -1, -1]
    assert chosen(eph, sats[:1], t[:1] + 90_000.0).tolist() == [-1]


@pytest.mark.parametrize("satellite, encoded", [("G05", lnav), ("J02", lnav), ("E11", inav)])
def test_messages_read_back_to_the_orbit(satellite, encoded):
    """Within the steps of the message: 1 dm of position, 1e-10 s of the clock."""
    eph = ephemeris(satellite, 3)
    got = Messages()
    parts = encoded(eph)
    for words in parts:
        assert not got.found
        got.take(satellite, words, T0)
    (found,) = got.found.values()
    there, clock = state(repeated(eph, 1), np.array([T0]))
    read, read_clock = state(repeated(found, 1), np.array([T0]))
    assert np.linalg.norm(read - there) < 0.1 and abs(float((read_clock - clock)[0])) < 1e-9
    mixed = Messages()
    for words in (*parts[:-2], *encoded(eph, issue=8)[-2:]):
        mixed.take(satellite, words, T0)
    assert not mixed.found  # of two issues


def observations(eph: Ephemeris, place: np.ndarray, bias: float = 1234.5, t: float = T0) -> Observations:
    """What a receiver at rest measures, light time solved by iteration; no atmosphere."""
    n = eph.satellite.size
    times, pseudorange = np.full(n, t), np.full(n, 2.2e7)
    received = times - bias / LIGHT  # true time

    def measured(received):
        flight = np.full(n, 0.07)
        for _ in range(6):
            s, clock = state(eph, received - flight)
            flight = np.linalg.norm(turned(s, RATE * flight) - place, axis=1) / LIGHT
        return LIGHT * (flight - clock)

    pseudorange = measured(received) + bias
    rate = (measured(received + 0.5) - measured(received - 0.5)) / 1.0
    phase = pseudorange + 1000.0 * np.arange(n)  # cycles that are not known
    return Observations(times, eph.satellite.astype(int), pseudorange, rate + 2.0, np.full(n, 45.0), phase,
                        np.zeros(n, bool), np.zeros(n))  # fmt: skip


@pytest.mark.parametrize(("system", "hz"), [("G", 1575.42e6), ("C", 1561.098e6)])
def test_the_ionosphere_delays_by_the_square_of_the_frequency(system, hz):
    """The broadcast model is of L1; a constant night delay of 5 ns at the zenith, IS-GPS-200 figure 20-4."""
    eph = constellation()
    eph = eph._replace(satellite=eph.satellite % 100 + number(f"{system}01") - 1)
    seen = observations(eph, TOKYO, t=T0)
    place = np.tile(TOKYO, (seen.t.size, 1))
    with_delay = corrected(seen, eph, place, Ionosphere(np.zeros(4), np.zeros(4)))
    delay = corrected(seen, eph, place).pseudorange - with_delay.pseudorange
    oblique = 1 + 16 * (0.53 - with_delay.elevation / np.pi) ** 3
    up = with_delay.elevation > 0.2
    np.testing.assert_allclose(delay[up], (LIGHT * 5e-9 * oblique * (1575.42e6 / hz) ** 2)[up], rtol=1e-6)


def test_corrections_leave_distance_and_clock():
    """From a receiver with a clock of 4 us: the solution is the place, the clock and rest."""
    eph = constellation()
    seen = observations(eph, TOKYO)
    ranges = corrected(seen, eph, np.tile(TOKYO, (seen.t.size, 1)))
    from jaxnav.gnss.atmosphere import saastamoinen
    from jaxnav.maths.axes import geodetic

    up = ranges.elevation > 0.2
    assert up.sum() >= 6
    lla = geodetic(TOKYO[None])
    air = saastamoinen(lla[:, 0], lla[:, 2], ranges.elevation)
    distance = np.linalg.norm(ranges.position - TOKYO, axis=1)
    np.testing.assert_allclose((ranges.pseudorange + air - distance)[up], 1234.5, atol=2e-3)
    u = (ranges.position - TOKYO) / distance[:, None]
    np.testing.assert_allclose((ranges.range_rate - np.sum(u * ranges.velocity, 1))[up], 2.0, atol=1e-3)
    clear = selected(ranges._replace(pseudorange=ranges.pseudorange + air), up)
    found = single_point(clear)
    np.testing.assert_allclose(found.position, TOKYO[None], atol=0.02)
    np.testing.assert_allclose(found.clock, 1234.5, atol=0.02)
    np.testing.assert_allclose(found.velocity, 0.0, atol=2e-3)
    # from nothing known, with the atmosphere that is not there taken out: some metres, in height
    _, alone = solved(seen, eph, masks=Masks(12.0))
    assert np.linalg.norm(alone.position - TOKYO) < 25.0


@needs_tokyo
def test_orbits_are_those_of_another_program():
    """Satellites of the rows in the messages' folder, median below 1 mm; QZSS by its orbit's radius."""
    eph, ionosphere = read_navigation(TOKYO_DATA / "base.nav")
    assert ionosphere is None
    rows = scipy.io.loadmat(TOKYO_DATA / "GNSSTCData_GQ.mat")["GNSSTCData"]
    rows = rows[(rows[:, 3] > 0) & (rows[:, 0] % 7 == 0)]
    far = np.linalg.norm(rows[:, 5:8], axis=1) > 3e7
    satellite = np.where(far, 100, 0) + rows[:, 3].astype(int)
    t = GPS_EPOCH + 2130 * WEEK + rows[:, 2]
    nothing = np.zeros((t.size, 3))
    ranges = Ranges(rows[:, 2], satellite, rows[:, 4], rows[:, 8], rows[:, 5:8], nothing, np.radians(rows[:, 13]),
                    rows[:, 14])  # fmt: skip
    found = single_point(selected(ranges, np.lexsort((satellite, t))))
    receiver = np.stack([np.interp(rows[:, 2], found.t, found.position[:, i]) for i in range(3)], 1)
    distance = np.linalg.norm(rows[:, 5:8] - receiver, axis=1)
    chosen_rows = Ephemeris(*(a[chosen(eph, satellite, t)] for a in eph))
    position, clock = at_reception(chosen_rows, t, distance, receiver)
    # the rows have the signal leave at distance / c before, by GPS time and not the satellite's
    velocity = (at_reception(chosen_rows, t + 0.5, distance, receiver)[0] - position) / 0.5
    # and are turned by WGS 84's rate of the Earth since the begin of the week, where the documents have another
    theirs = turned(rows[:, 5:8], (EARTH_RATE["G"] - RATE) * ((t - GPS_EPOCH) % WEEK))
    off = np.linalg.norm(position + velocity * clock[:, None] - theirs, axis=1)
    assert np.median(off[~far]) < 1e-3 and np.median(off[far]) < 1e-3


@needs_tokyo
def test_a_station_stands_still():
    """Single points of a station over 70 minutes: 3 m horizontal about their mean, 0.05 m/s by Doppler."""
    eph, _ = read_navigation(TOKYO_DATA / "base.nav")
    seen, notes = read_observations(TOKYO_DATA / "base_GQ_L1.obs")
    assert any("without a pseudorange" in str(note) for note in notes)
    _, found = solved(Observations(*(a[(seen.t % 10) < 0.5] for a in seen)), eph)
    position, velocity = found.samples()
    lla = position.value
    metres = (lla - lla.mean(0)) * np.array([6.36e6, 6.38e6 * np.cos(lla[0, 0]), 1.0])
    assert np.sqrt(np.mean(np.sum(metres[:, :2] ** 2, 1))) < 3.0
    assert np.sqrt(np.mean(velocity.value**2)) < 0.05
    off = enu_to_ecef(lla.mean(0)).T @ (found.position.mean(0) - TOKYO)
    assert np.hypot(*off[:2]) < 1.0 and np.abs(off[2]) < 15.0
