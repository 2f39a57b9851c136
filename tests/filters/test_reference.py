"""The nested scans against naive loops in numpy that share no code with them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.filters.catalogue import build
from jaxnav.filters.papers.gpid import gpid_params, literal_params
from jaxnav.filters.parameters import datasheet_params
from jaxnav.filters.run import run_jit
from jaxnav.maths import rotations
from jaxnav.states.table import BIASES, mask
from tests import reference
from tests.conftest import GRADE, dynamics_15


@pytest.fixture(scope="module")
def near_origin(fine_case):
    """Start and epochs, of which two have no fix, three no velocity and one only heights."""
    epochs = fine_case.packed.epochs
    valid = epochs.fix.valid.at[8:10].set(False).at[20:23, 3:].set(False)
    valid = valid.at[30, np.array([0, 1, 3, 4, 5])].set(False)
    return fine_case.nav, epochs._replace(fix=epochs.fix._replace(valid=valid))


def loop(nav, epochs, params, n, **options):
    imu = [np.asarray(a) for a in epochs.imu]
    value, sd, valid = (np.asarray(a) for a in (epochs.fix.value, epochs.fix.sd, epochs.fix.valid))
    fixes = (value[:, :3], sd[:, :3], value[:, 3:], sd[:, 3:], valid)
    biases = [params.states[name] for name in BIASES]
    noise = {k: np.asarray(v) for k, v in params.noise._asdict().items()}
    noise |= {name: np.asarray(p.driving_noise) for name, p in zip(BIASES, biases, strict=True)}
    noise |= {"gyro_tau": np.asarray(biases[0].tau), "accel_tau": np.asarray(biases[1].tau)}
    prior = np.concatenate([np.broadcast_to(sd, 3) for sd in (*params.prior[:3], *(p.sd for p in biases))])[:n]
    begin = nav.pos, nav.vel, rotations.to_dcm(nav.q)
    return reference.run(imu, fixes, begin, noise, prior, **options)


def errors(info, expected):
    """Largest differences: position m, velocity m/s, attitude, state in units of its sd, covariance relative."""
    lla, vel, C, x, P = expected
    position = [np.abs(reference.metres(b) @ (a - b)).max() for a, b in zip(np.asarray(info.nav.pos), lla, strict=True)]
    sd = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
    return (
        max(position), np.abs(info.nav.vel - vel).max(), np.abs(jax.vmap(rotations.to_dcm)(info.nav.q) - C).max(),
        np.abs((info.x - x) / sd).max(), np.abs((info.P - P) / (sd[:, :, None] * sd[:, None])).max(),
    )  # fmt: skip


@pytest.mark.full
@pytest.mark.parametrize(
    "name, theta, options",
    [
        ("kf9_simple", (), {}),
        ("gpid_literal", literal_params(0.05, 0.1), dict(ki=0.05, kd=0.1)),
        ("gpid_literal", gpid_params(0.05, 0.3), dict(ki=0.05, kd=0.3, states=mask("position"))),
    ],
    ids=["kf", "gpid_literal", "gpid_position"],
)
def test_the_scan_is_the_loop(near_origin, name, theta, options):
    nav, epochs = near_origin
    params = datasheet_params(GRADE, rule=theta)
    info = run_jit(build(name), params, nav, epochs)
    position, velocity, attitude, state, covariance = errors(info, loop(nav, epochs, params, 9, **options))
    assert position < 3e-9 and velocity < 1e-9 and attitude < 1e-10
    assert state < 1e-9 and covariance < 1e-10
    assert np.abs(info.x[:, :3]).max() > 0.5  # and there was something to correct
    if options:
        plain = run_jit(build("kf9_simple"), params._replace(rule=()), nav, epochs)
        assert np.abs(plain.nav.vel - info.nav.vel).max() > 1e-4  # by what the rule adds


@pytest.mark.full
def test_the_full_form_is_the_derivative_of_the_equations(near_origin):
    """15 states against complex-step dynamics, which hold every term: those that the package leaves out are tiny."""
    nav, epochs = near_origin
    params = datasheet_params(GRADE)
    info = run_jit(build("ekf15"), params, nav, epochs)
    expected = loop(nav, epochs, params, 15, dynamics=reference.full_dynamics)
    position, velocity, attitude, state, covariance = errors(info, expected)
    assert position < 1e-7 and velocity < 1e-7 and attitude < 1e-9 and state < 1e-6 and covariance < 1e-6
    simple = loop(nav, epochs, params, 15)
    assert errors(info, simple)[4] > 30 * covariance  # the test can tell the forms apart


def test_the_dynamics_block_by_block():
    """The package's full F against the complex step, each block relative to its own size."""
    from jaxnav.filters.run import initial_nav
    from jaxnav.strapdown.errors.local_level import dynamics
    from jaxnav.types import ErrorInputs

    nav = initial_nav([0.8, -1.3, 900.0], [60.0, -45.0, 5.0], [0.2, -0.3, 2.0])
    C, f = rotations.to_dcm(nav.q), jnp.array([1.0, -2.0, 10.0])
    ours = dynamics_15(jax.jit(lambda nav: dynamics(ErrorInputs(nav, C, f, f, f), "full"))(nav))
    exact = reference.full_dynamics(*(np.asarray(a) for a in (nav.pos, nav.vel, C, f)), 15)
    for i in range(5):
        for j in range(5):
            a, b = ours[3 * i : 3 * i + 3, 3 * j : 3 * j + 3], exact[3 * i : 3 * i + 3, 3 * j : 3 * j + 3]
            # the radii are taken as constant along the meridian: of the order of the flattening
            np.testing.assert_allclose(a, b, rtol=0, atol=8e-3 * np.abs(b).max() + 1e-20)
