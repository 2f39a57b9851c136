"""What a motion shows: against the filter's own covariance, at rest and on a drive, in words."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.analysis import observability as obs
from jaxnav.filters.catalogue import build
from jaxnav.filters.epochs import pack
from jaxnav.filters.parameters import put
from jaxnav.filters.run import initial_nav, run_jit
from jaxnav.states.table import zeros
from jaxnav.types import DataError, ImuLog, Info, Samples, StateParams

FILTER = build("ekf15", cov_stride=5)


@pytest.mark.full
def test_without_noise_it_is_what_the_filter_knows(case):
    """P at the end of a window is (P0^-1 + G)^-1, moved there: Kalman's covariance, by other arithmetic."""
    params = case.params
    # so small that second order adds nothing
    for name, sd in {"prior.attitude": 1e-4, "states.gyro_bias.sd": 1e-5, "states.accel_bias.sd": 1e-3}.items():
        params = put(params, name, jnp.full(3, sd))
    for name in ("noise.gyro", "noise.accel", "states.gyro_bias.driving_noise", "states.accel_bias.driving_noise"):
        params = put(params, name, jnp.zeros(3))
    for name in ("states.gyro_bias.tau", "states.accel_bias.tau"):
        params = put(params, name, jnp.asarray(jnp.inf))
    epochs = jax.tree.map(lambda a: a[:20], case.packed.epochs)
    Phi, told = map(np.asarray, obs._seen(FILTER, params, case.nav, epochs))
    P = np.asarray(FILTER.model.covariance(params, case.nav))
    since, G = np.eye(15), np.zeros((15, 15))
    for i in range(20):
        since = Phi[i] @ since
        G += since.T @ told[i] @ since
    expected = since @ np.linalg.inv(np.linalg.inv(P) + G) @ since.T
    found, sd = np.asarray(run_jit(FILTER, params, case.nav, epochs).P[-1]), np.sqrt(np.diag(expected))
    np.testing.assert_allclose(found / np.outer(sd, sd), expected / np.outer(sd, sd), atol=1e-4)


@pytest.fixture(scope="module")
def rest(case):
    """A minute at rest where the drive begins."""
    t = np.arange(1, 6001) / 100
    truth = np.broadcast_to(case.truth.lla[0], (60, 3))
    up = np.broadcast_to([0.0, 0.0, -9.81], (6000, 3))
    imu = ImuLog(t, np.full(6000, 0.01), np.zeros((6000, 3)), up)
    fixes = {
        "position": Samples(np.arange(1.0, 61.0), truth, np.full((60, 3), 2.0), np.zeros((60, 3))),
        "velocity": Samples(np.arange(1.0, 61.0), np.zeros((60, 3)), np.full((60, 3), 0.1), np.zeros((60, 3))),
    }
    return pack(imu, fixes, 1.0)


@pytest.mark.full
def test_rest_shows_neither_heading_nor_the_gyro_about_it(case, rest):
    level = case.nav._replace(
        q=jnp.asarray([0.0, 1 / np.sqrt(2), 1 / np.sqrt(2), 0.0]), vel=jnp.zeros(3), t=jnp.zeros(())
    )
    found = obs.observability(FILTER, case.params, level, rest.epochs, rest.t, 20.0)
    left = dict(zip(found.names, found.left.min(0), strict=True))
    assert left["attitude up"] > 0.99 and left["gyro_bias down"] > 0.99
    assert max(left["position east"], left["velocity north"]) < 0.6 and (found.rank < 13).all()
    # tilt and the accelerometers' bias are one direction: together known, apart not
    assert left["accel_bias down"] < 0.5 < min(left["accel_bias forward"], left["accel_bias right"])
    words = " ".join(f.message for f in obs.observability_findings(found, 20.0))
    assert "no window observes attitude up" in words and "gyro_bias down" in words and "of 15 directions" in words


def test_information_is_carried_by_the_transitions_in_their_order(case, monkeypatch):
    """Of transitions that do not commute, over two windows of three epochs: G = sum since' H' R^-1 H since."""
    rng = np.random.default_rng(1)
    Phi = np.eye(15) + 0.3 * rng.normal(size=(6, 15, 15))
    rows = rng.normal(size=(6, 2, 15))
    information = np.einsum("eki,ekj->eij", rows, rows)
    monkeypatch.setattr(obs, "_seen", lambda *given: (Phi, information))
    sd = np.sqrt(np.diag(np.asarray(FILTER.model.covariance(case.params, case.nav))))
    found = obs.observability(FILTER, case.params, case.nav, None, np.arange(6.0), 3.0)
    assert found.start.tolist() == [0.0]
    M = [np.eye(15), Phi[1], Phi[2] @ Phi[1]]
    G = sum(m.T @ information[i] @ m for i, m in enumerate(M)) * np.outer(sd, sd)
    np.testing.assert_allclose(found.left[0], np.sqrt(np.diag(np.linalg.inv(np.eye(15) + G))), rtol=1e-9)


def test_a_gauss_markov_process_spreads_to_half_its_time_times_its_density():
    """drive^2 tau / 2 is its variance in the long run; before, and of a walk, it grows by drive^2 a second."""
    process = lambda tau, drive=0.2: StateParams(np.asarray(1.0), np.asarray(drive), np.asarray(tau))
    assert obs._driven(process(4.0), 100.0) == pytest.approx(0.08)
    assert obs._driven(process(4.0), 1.0) == pytest.approx(0.04)
    assert obs._driven(process(np.inf), 50.0) == pytest.approx(2.0)
    np.testing.assert_allclose(obs._driven(process(4.0, 0.2 * np.eye(3)), 100.0), 0.08)


def test_a_drive_shows_its_heading(case):
    found = obs.observability(FILTER, case.params, case.nav, case.packed.epochs, case.packed.t, 20.0)
    left = dict(zip(found.names, found.left.min(0), strict=True))
    assert left["attitude up"] < 0.5 and found.rank.max() >= 12 and (found.condition > 1).all()
    with pytest.raises(DataError, match="hold no window of 100 s"):
        obs.observability(FILTER, case.params, case.nav, case.packed.epochs, case.packed.t, 100.0)


@pytest.mark.full
def test_a_run_says_what_it_did_not_show(case):
    """Half a minute straight on tells no scale of the gyros."""
    more = build("ekf15", cov_stride=5, states=("gyro_scale",))
    params = more.params("adis16465")
    epochs = jax.tree.map(lambda a: a[:8], case.packed.epochs)
    (found,) = obs.state_findings(more, params, case.nav, run_jit(more, params, case.nav, epochs))
    assert found.code == "state.unobserved" and "gyro_scale forward" in found.subject


@pytest.mark.full
def test_a_run_says_which_state_went_too_far(case):
    """A bias of six sd of what is known before is named, one of two sd or one that is told at the start not."""
    params, epochs = FILTER.params("adis16465"), case.packed.epochs
    sd = float(params.states["gyro_bias"].sd)

    def said(nav, bias):
        moved = epochs.imu._replace(gyro=epochs.imu.gyro + np.array([0.0, bias, 0.0]))
        found = obs.state_findings(FILTER, params, nav, run_jit(FILTER, params, nav, epochs._replace(imu=moved)))
        return " ".join(f.message for f in found)

    assert "gyro_bias right (" in said(case.nav, 6 * sd) and "gyro_bias" not in said(case.nav, 2 * sd)
    known = case.nav._replace(errors=case.nav.errors | {"gyro_bias": np.array([0.0, 6 * sd, 0.0])})
    assert "gyro_bias" not in said(known, 6 * sd)


def test_a_clock_may_go_as_far_as_its_drift_takes_it():
    """200 m in 70 s at a drift of sd 3 m/s is as expected, 2 km is not; the bias alone has an sd of 30 m."""
    filt = build("ekf9", ("pseudorange", "range_rate"))
    params, n = filt.params(), filt.model.n_states
    nav = initial_nav([0.8, 0.1, 100.0])._replace(errors=zeros(filt.model.states))

    def codes(bias):
        errors = nav.errors | {"receiver_clock_bias": jnp.full(1, bias)}
        end = jax.tree.map(lambda a: jnp.asarray(a)[None], nav._replace(t=nav.t + 70.0, errors=errors))
        info = Info(**dict.fromkeys(Info._fields) | {"nav": end, "P": 1e-4 * jnp.eye(n)[None]})
        return [f.code for f in obs.state_findings(filt, params, nav, info)]

    assert codes(200.0) == [] and codes(2000.0) == ["state.unexpected"]
