"""Delays of the atmosphere against their closed forms at zenith and known sizes."""

import math

import numpy as np
import pytest

from jaxnav.gnss.atmosphere import klobuchar, saastamoinen
from jaxnav.gnss.ranges import LIGHT

ALPHA = np.array([1.2e-8, 0.0, 0.0, 0.0])
BETA = np.array([1.0e5, 0.0, 0.0, 0.0])


def at(tow: float, elevation: float = 0.5 * math.pi) -> float:
    one = np.ones(1)
    return float(klobuchar(ALPHA, BETA, 0.5 * one, 0.0 * one, 0.0 * one, elevation * one, tow * one)[0])


def test_the_ionosphere_is_5_ns_at_night_and_its_amplitude_more_at_14_h():
    assert at(2 * 3600.0) == pytest.approx(5e-9 * LIGHT, rel=2e-3)
    assert at(14 * 3600.0) == pytest.approx((5e-9 + 1.2e-8) * LIGHT, rel=2e-3)
    assert at(14 * 3600.0 + 86_400.0 * 3) == pytest.approx(at(14 * 3600.0))
    slant = 1 + 16 * (0.53 - 1 / 18) ** 3  # 10 deg
    assert at(2 * 3600.0, math.radians(10.0)) / at(2 * 3600.0) == pytest.approx(slant, rel=5e-3)


def test_the_troposphere_is_2_4_m_at_the_sea_and_less_above():
    one = np.ones(1)
    zenith = lambda h, E=0.5 * math.pi: float(saastamoinen(0.7 * one, h * one, E * one)[0])
    assert 2.3 < zenith(0.0) < 2.6
    assert zenith(3000.0) / zenith(0.0) == pytest.approx(0.66, abs=0.05)  # of the pressure
    assert zenith(0.0, math.radians(30.0)) == pytest.approx(2 * zenith(0.0))
    assert np.isfinite(zenith(-400.0)) and zenith(50_000.0) < 0.7
