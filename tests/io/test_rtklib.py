"""Every form that RTKLIB writes a solution in, made from one of degrees: the same fixes come back."""

import numpy as np
import pytest

from jaxnav import io
from jaxnav.io.readers import read_parts
from jaxnav.maths.axes import ecef, enu_to_ecef, lla_to_local
from jaxnav.maths.units import DEG
from jaxnav.types import DataError, Samples

REFERENCE = np.array([40.09 * DEG, -105.14 * DEG, 1600.0])
TAIL = "  0.00    0.0"


def fixes(n=6):
    rng = np.random.default_rng(0)
    t = 1752003258.5 + np.arange(n)
    lla = REFERENCE + np.array([1e-4, -2e-4, 3.0]) + rng.normal(size=(n, 3)) * [1e-5, 1e-5, 1.0]
    corr = np.array([[0.5, -0.2, 0.3]] * n)
    position = Samples(t, lla, rng.uniform(0.5, 2.0, size=(n, 3)), corr)
    return position, Samples(t, rng.normal(size=(n, 3)), rng.uniform(0.1, 0.2, size=(n, 3)), -corr)


def signed(cov, i, j):
    return np.sign(cov[i, j]) * np.sqrt(abs(cov[i, j]))


def covariance(samples, k):
    """Return the covariance of a row, ENU."""
    r = np.eye(3)
    for c, (i, j) in zip(samples.corr[k], ((0, 1), (1, 2), (2, 0))):
        r[i, j] = r[j, i] = c
    return r * np.outer(samples.sd[k], samples.sd[k])


def stamp(t, ahead=0.0):
    return str(np.datetime64(int((t + ahead) * 1000), "ms")).replace("-", "/").replace("T", " ")


def rows(form, ahead=0.0, sep="  "):
    """Return header and rows of a form."""
    position, velocity = fixes()
    lines = []
    for k, t in enumerate(position.t):
        lla, cov = position.value[k], covariance(position, k)
        degrees = lla[:2] / DEG
        n, e, u = np.sqrt(np.diag(cov))[[1, 0, 2]]
        sd = [n, e, u, signed(cov, 0, 1), signed(cov, 0, 2), signed(cov, 1, 2)]
        more = []
        if form == "deg":
            place = [*degrees, lla[2]]
        elif form == "dms":
            place = []
            for angle in degrees:
                d, rest = divmod(abs(angle), 1)
                m, s = divmod(rest * 60, 1)
                place += [np.copysign(d, angle), m, s * 60]
            place.append(lla[2])
        elif form == "ecef":
            turn = enu_to_ecef(lla)
            place, x = ecef(lla[None])[0], turn @ cov @ turn.T
            sd = [*np.sqrt(np.diag(x)), signed(x, 0, 1), signed(x, 1, 2), signed(x, 2, 0)]
            v = turn @ covariance(velocity, k) @ turn.T
            more = [
                *(turn @ velocity.value[k]),
                *np.sqrt(np.diag(v)),
                signed(v, 0, 1),
                signed(v, 1, 2),
                signed(v, 2, 0),
            ]
        else:
            place = lla_to_local(lla[None], REFERENCE)[0]
            sd = [n, e, u, signed(cov, 0, 1), signed(cov, 0, 2), signed(cov, 1, 2)]
        cells = [f"{x:.12f}" for x in place] + ["1", "9"] + [f"{x:.12f}" for x in sd] + ["0.00", "0.0"]
        lines.append(sep.join([stamp(t, ahead), *cells, *(f"{x:.12f}" for x in more)]))
    names = {
        "deg": "latitude(deg) longitude(deg) height(m) Q ns sdn(m) sde(m) sdu(m) sdne(m) sdeu(m) sdun(m)",
        "dms": "latitude(d'\") longitude(d'\") height(m) Q ns sdn(m) sde(m) sdu(m) sdne(m) sdeu(m) sdun(m)",
        "ecef": "x-ecef(m) y-ecef(m) z-ecef(m) Q ns sdx(m) sdy(m) sdz(m) sdxy(m) sdyz(m) sdzx(m)",
        "baseline": "e-baseline(m) n-baseline(m) u-baseline(m) Q ns sdn(m) sde(m) sdu(m) sden(m) sdue(m) sdnu(m)",
    }[form]
    speeds = " vx(m/s) vy(m/s) vz(m/s) sdvx sdvy sdvz sdvxy sdvyz sdvzx" if form == "ecef" else ""
    return sep.join(f"{names} age(s) ratio{speeds}".split()), lines


def write(path, form, clock="GPST", ahead=0.0, sep="  ", first=()):
    head, lines = rows(form, ahead, sep)
    path.write_text("\n".join([*first, f"%  {clock}  {sep}{head}", *lines]) + "\n")
    return path


def assert_fixes(path, atol=1e-4):
    sent, got = fixes()[0], read_parts(path).aiding["position"]
    np.testing.assert_allclose(got.t, sent.t, atol=1e-6)
    np.testing.assert_allclose(lla_to_local(got.value, REFERENCE), lla_to_local(sent.value, REFERENCE), atol=atol)
    np.testing.assert_allclose(got.sd, sent.sd, atol=1e-6)
    np.testing.assert_allclose(got.corr, sent.corr, atol=1e-5)


REF_POS = "% ref pos   :  40.090000000  -105.140000000  1600.0000"


@pytest.mark.parametrize("sep", ["  ", ",", "\t"])
@pytest.mark.parametrize("form", ["deg", "dms", "ecef", "baseline"])
def test_every_form_gives_the_same_fixes(tmp_path, form, sep):
    path = write(tmp_path / "a.pos", form, sep=sep, first=[REF_POS])
    assert_fixes(path)
    if form == "ecef":
        got, sent = read_parts(path).aiding["velocity"], fixes()[1]
        np.testing.assert_allclose(got.value, sent.value, atol=1e-9)
        np.testing.assert_allclose(got.sd, sent.sd, atol=1e-9)
        np.testing.assert_allclose(got.corr, sent.corr, atol=1e-6)


@pytest.mark.parametrize("clock, ahead", [("GPST", 0.0), ("UTC", -18.0), ("JST", 9 * 3600 - 18.0)])
def test_times_of_every_clock_become_gps_time(tmp_path, clock, ahead):
    assert_fixes(write(tmp_path / "a.pos", "deg", clock, ahead))


def test_a_baseline_counts_from_the_reference_in_ecef_too(tmp_path):
    x = ecef(REFERENCE[None])[0]
    assert_fixes(write(tmp_path / "a.pos", "baseline", first=["% ref pos   : " + " ".join(f"{v:.4f}" for v in x)]))
    with pytest.raises(DataError, match="baselines need a line '% ref pos"):
        read_parts(write(tmp_path / "b.pos", "baseline"))


def test_heights_above_sea_level_are_said(tmp_path):
    head = "% (lat/lon/height=WGS84/geodetic,Q=1:fix,2:float,3:sbas,4:dgps,5:single,6:ppp,ns=# of satellites)"
    assert "above sea level" in " ".join(map(str, read_parts(write(tmp_path / "a.pos", "deg", first=[head])).notes))
    head = head.replace("geodetic", "ellipsoidal")
    assert "above sea level" not in " ".join(map(str, read_parts(write(tmp_path / "b.pos", "deg", first=[head])).notes))


def test_a_southern_latitude_of_zero_degrees_keeps_its_sign(tmp_path):
    head, lines = rows("dms")
    lines = [line.replace("40.000000000000  5.", "-0.000000000000  5.") for line in lines]
    (tmp_path / "a.pos").write_text("\n".join([f"%  GPST  {head}", *lines]) + "\n")
    lat = read_parts(tmp_path / "a.pos").aiding["position"].value[:, 0] / DEG
    assert (lat < 0).all() and (lat > -0.2).all()


@pytest.mark.parametrize("old, new", [("(deg)", "(rad)"), ("itude(deg)", "x(deg)")])
def test_another_header_is_refused_with_the_forms(tmp_path, old, new):
    head, lines = rows("deg")
    (tmp_path / "a.pos").write_text("\n".join(["%  GPST  " + head.replace(old, new), *lines]) + "\n")
    with pytest.raises(DataError, match=r"expected columns latitude\(deg\) .* x-ecef\(m\)"):
        io.read_pos(tmp_path / "a.pos")
