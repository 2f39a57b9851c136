"""Rotations against scipy, jaxlie and python-ins, and their derivatives at the singular points."""

import jax
import jaxlie
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from pyins import transform
from scipy.spatial.transform import Rotation

from jaxnav.maths import rotations

exp, log, to_dcm, from_dcm = (jax.jit(f) for f in (rotations.exp, rotations.log, rotations.to_dcm, rotations.from_dcm))
multiply, conjugate = jax.jit(rotations.multiply), jax.jit(rotations.conjugate)
from_rph, to_rph = jax.jit(rotations.from_rph), jax.jit(rotations.to_rph)
lie_exp = jax.jit(lambda phi: jaxlie.SO3.exp(phi).wxyz)
lie_log = jax.jit(lambda q: jaxlie.SO3(q).log())
quaternions = arrays(np.float64, 4, elements=st.floats(-1, 1)).filter(lambda q: np.linalg.norm(q) > 0.1)
vectors = arrays(np.float64, 3, elements=st.floats(-1.8, 1.8))
exp_jacobian = jax.jit(jax.jacfwd(rotations.exp))
exp_hessian = jax.jit(jax.jacfwd(jax.grad(lambda phi: rotations.exp(phi)[0])))
dcm_jacobian = jax.jit(jax.jacrev(rotations.from_dcm))
log_exp_jacobians = [jax.jit(j(lambda phi: rotations.log(rotations.exp(phi)))) for j in (jax.jacrev, jax.jacfwd)]
fast = settings(max_examples=60, deadline=None, derandomize=True)
AXIS = np.array([2.0, -1.0, 2.0]) / 3


def unit(q):
    return q / np.linalg.norm(q)


def test_skew_is_the_cross_product():
    a, b = np.array([1.0, -2.0, 3.0]), np.array([0.3, 0.5, -0.7])
    np.testing.assert_allclose(rotations.skew(a) @ b, np.cross(a, b), rtol=1e-15)


@fast
@given(quaternions, quaternions)
def test_multiply_conjugate_and_dcm_are_scipy(p, q):
    p, q = unit(p), unit(q)
    R, S = Rotation.from_quat(p, scalar_first=True), Rotation.from_quat(q, scalar_first=True)
    np.testing.assert_allclose(to_dcm(p), R.as_matrix(), atol=1e-15)
    np.testing.assert_allclose(to_dcm(multiply(p, q)), (R * S).as_matrix(), atol=2e-15)
    np.testing.assert_allclose(to_dcm(conjugate(p)), R.as_matrix().T, atol=1e-15)


@fast
@given(quaternions)
def test_from_dcm_inverts_to_dcm(q):
    q = unit(q)
    back = np.asarray(from_dcm(to_dcm(q)))
    assert back[0] >= 0
    np.testing.assert_allclose(min(abs(back - q).max(), abs(back + q).max()), 0, atol=4e-16 * 4)


@pytest.mark.parametrize("angle", [np.pi - 1e-9, np.pi - 1e-4, np.pi])
@pytest.mark.parametrize("axis", [[1, 0, 0], [0, 1, 0], [0, 0, 1], AXIS])
def test_from_dcm_near_a_half_turn(axis, angle):
    R = Rotation.from_rotvec(np.array(axis) * angle)
    np.testing.assert_allclose(to_dcm(from_dcm(R.as_matrix())), R.as_matrix(), atol=1e-15)
    assert np.isfinite(np.asarray(dcm_jacobian(R.as_matrix()))).all()


@fast
@given(vectors)
def test_exp_and_log_are_scipy_and_jaxlie(phi):
    q = np.asarray(exp(phi))
    np.testing.assert_allclose(to_dcm(q), Rotation.from_rotvec(phi).as_matrix(), atol=2e-15)
    np.testing.assert_allclose(q, lie_exp(phi), atol=1e-14)
    np.testing.assert_allclose(log(q), lie_log(q), atol=1e-10)  # jaxlie's own series is coarser


@pytest.mark.parametrize("n", [0.0, 1e-300, 1e-12, 1e-5, 0.00999, 0.01001, 0.0199, 0.0201, 1.0, 3.0, np.pi - 1e-6])
def test_log_inverts_exp_up_to_a_half_turn(n):
    np.testing.assert_allclose(log(exp(n * AXIS)), n * AXIS, rtol=1e-14, atol=1e-300)
    np.testing.assert_allclose(log(-exp(n * AXIS)), n * AXIS, rtol=1e-14, atol=1e-300)  # the same rotation
    np.testing.assert_allclose(np.linalg.norm(exp(n * AXIS)), 1.0, atol=3e-16)


@pytest.mark.parametrize("f, threshold", [(exp, 0.01), (lambda v: log(exp(v)), 2 * np.arcsin(0.01))])
def test_series_meet_the_closed_forms(f, threshold):
    """No step where the series gives way: over 16 ulp either side the value moves by rounding only."""
    values = [np.asarray(f(threshold * (1 + k * 2.2e-16) * AXIS)) for k in range(-16, 17)]
    np.testing.assert_allclose(values, [values[0]] * 33, rtol=0, atol=2e-16)


def test_series_agree_with_extended_precision():
    for n in (1e-3, 5e-3, 0.0099, 0.02):
        m = np.longdouble(n)
        np.testing.assert_allclose(exp(n * AXIS), [float(np.cos(m / 2)), *(float(np.sin(m / 2)) * AXIS)], rtol=3e-16)


def test_derivatives_at_zero():
    J = exp_jacobian(np.zeros(3))
    np.testing.assert_array_equal(J[0], 0.0)
    np.testing.assert_array_equal(J[1:], 0.5 * np.eye(3))
    H = exp_hessian(np.zeros(3))
    np.testing.assert_allclose(H, -0.25 * np.eye(3), atol=1e-16)  # cos(n/2) = 1 - n^2/8


@pytest.mark.parametrize("n", [0.0, 1e-200, 1e-9, 0.00999, 0.01001, 2.0, np.pi - 1e-7, np.pi])
def test_log_of_exp_has_the_identity_as_derivative(n):
    for jacobian in log_exp_jacobians:
        J = np.asarray(jacobian(n * AXIS))
        assert np.isfinite(J).all()
        if n < np.pi:
            np.testing.assert_allclose(J, np.eye(3), atol=1e-8 if n > 3 else 1e-14)


def test_from_rph_is_pyins_turned_to_enu():
    ned = transform.mat_from_rph([10, -20, 30])
    np.testing.assert_allclose(ned[0], [0.813797681349, -0.543838142482, -0.204874128703], atol=1e-12)
    rng = np.random.default_rng(0)
    for degrees in np.vstack([[10, -20, 30], rng.uniform(-89, 89, (8, 3))]):
        ours = from_rph(np.deg2rad(degrees))
        np.testing.assert_allclose(ours, rotations.ENU_NED @ transform.mat_from_rph(degrees), atol=4e-16)
    north_up = from_rph(np.zeros(3))  # level and heading north: forward is north, right is east, down is minus up
    np.testing.assert_array_equal(north_up, [[0, 1, 0], [1, 0, 0], [0, 0, -1]])


@fast
@given(st.floats(-3.14, 3.14), st.floats(-1.56, 1.56), st.floats(-3.14, 3.14))
def test_to_rph_inverts_from_rph(roll, pitch, heading):
    rph = np.array([roll, pitch, heading])
    np.testing.assert_allclose(to_rph(from_rph(rph)), rph, rtol=0, atol=2e-14)


def test_to_rph_keeps_digits_of_pitch_near_the_vertical():
    # an arcsine of the matrix would lose half of them: this is sqrt(eps) = 1.5e-8 away from the pole
    rph = np.array([0.2, np.pi / 2 - 1e-6, -1.0])
    np.testing.assert_allclose(to_rph(from_rph(rph))[1], rph[1], rtol=0, atol=1e-15)


def test_attitude_error_turns_as_documented():
    """C_est = exp([phi x]) C_true: a positive heading error (clockwise) is a negative rotation about up."""
    C = from_rph(np.array([0.1, -0.05, 0.7]))
    turned = to_dcm(exp(np.array([0.0, 0.0, -0.01]))) @ C
    np.testing.assert_allclose(to_rph(turned), [0.1, -0.05, 0.71], atol=1e-14)
