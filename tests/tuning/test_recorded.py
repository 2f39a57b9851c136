"""Tuning a recording without truth: the objective's derivatives, its parts kept apart, priors, and the verdict."""

import dataclasses
import json
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import tuning
from jaxnav.analysis.noise_scan import NoiseScan
from jaxnav.analysis.receiver_errors import ReceiverErrors
from jaxnav.filters import epochs as ep
from jaxnav.filters.catalogue import build
from jaxnav.filters.lanes import seen_by_position
from jaxnav.filters.parameters import get, put
from jaxnav.filters.run import FREEDOM, prepare, student_nll
from jaxnav.filters.scores import gaussian_scale
from jaxnav.filters.standstill import Standing
from jaxnav.initialization.initialize import initialize
from jaxnav.maths.units import DEG_PER_SQRT_HOUR, TICK
from jaxnav.measurements import GNSS
from jaxnav.simulate.scenarios import URBAN_SHORT
from jaxnav.simulate.simulation import simulate_jit, to_recording
from jaxnav.types import ConfigError, DataError, sample_rows
from tests.tuning.tangents import gaussian
from tuning.fit.status import Status
from tuning.recordings import experiment, priors, recorded, report
from tuning.recordings.evidence import Evidence
from tuning.recordings.parts import MAX_ADDED_DELAY_S, PHASES, ages, parts_of, runs_of, windows_of
from tuning.recordings.runs import Descent, score_of


@pytest.fixture(scope="module")
def found(rec, ekf):
    return tuning.tune(rec, ekf, ekf.params("adis16465"), free=("noise", "fixes"))


@pytest.mark.full
def test_slow_errors_of_the_receiver_are_the_scans(rec, ekf):
    """A filter with their state, as `solve` has it: they are not free, the datasheet has none, the white rest is."""
    slow = ReceiverErrors(np.array([0.5, 0.5]), np.full(2, 60.0), sd=np.median(rec.aiding["position"].sd, 0))
    scan = NoiseScan(receiver=slow, fixes=50)
    wide, params = scan.extended(ekf, ekf.params("adis16465"))
    both = tuning.tune(rec, wide, params, free=("noise", "fixes"), scans=[scan])
    assert not [leaf for leaf in both.spec if "gnss_position_error" in leaf]
    state = {name: trial.params.states["gnss_position_error"] for name, trial in both.trials.items()}
    assert not np.any(state["datasheet"].sd) and not np.any(state["datasheet"].driving_noise)
    for name in ("auto", "tuned"):
        np.testing.assert_allclose(state[name].sd, np.sqrt(0.5) * slow.sd)
        np.testing.assert_allclose(state[name].tau, 60.0)
    np.testing.assert_allclose(both.trials["auto"].params.measurements["position"].scale, np.sqrt(0.5))


@pytest.mark.full
def test_a_result_keeps_the_given_prior_and_not_the_posterior_of_one_start(found, ekf, rec):
    """A next run from these parameters starts from where the first one did."""
    given, datasheet = ekf.params("adis16465"), found.used[0].datasheet
    for params in (found.params, *found.each, *(trial.params for trial in found.trials.values())):
        for name in ("gyro_bias", "accel_bias"):
            np.testing.assert_array_equal(params.states[name].sd, given.states[name].sd)
        np.testing.assert_array_equal(params.prior.attitude, given.prior.attitude)
        assert params.prior.correlated is None
    assert np.asarray(datasheet.states["gyro_bias"].sd).min() < 0.8 * given.states["gyro_bias"].sd
    again = initialize(rec, found.params)
    np.testing.assert_allclose(
        again.navs.errors["gyro_bias"], found.used[0].initialization.navs.errors["gyro_bias"], atol=1e-5
    )
    np.testing.assert_allclose(again.prior.attitude, found.used[0].initialization.prior.attitude, rtol=0.1)


# ---------------------------------------------------------------------------- what is minimised


@pytest.mark.parametrize("heavy", [False, True])
def test_likelihood_of_a_residual_and_its_derivatives(heavy):
    """Against scipy; the score against differences; the information of a Gaussian against samples of the score."""
    rng = np.random.default_rng(0)
    m, P = 3, 4
    mix, base, turn = rng.normal(size=(P, m)), rng.normal(size=m), rng.normal(size=(P, m, m))
    S0 = np.eye(m) + 0.1 * np.ones((m, m))

    def at(x):
        W = np.eye(m) + 0.1 * np.einsum("p,pij->ij", x, turn)
        return base + x @ mix, W @ S0 @ W.T

    def value(x):
        nu, S = at(x)
        return float(gaussian(nu, S, np.ones(m, bool), np.zeros((1, m)), np.zeros((1, m, m)), heavy)[0])

    x, h = 0.1 * rng.normal(size=P), 1e-5
    nu, S = at(x)
    dnu = np.array([(at(x + h * e)[0] - at(x - h * e)[0]) / (2 * h) for e in np.eye(P)])
    dS = np.array([(at(x + h * e)[1] - at(x - h * e)[1]) / (2 * h) for e in np.eye(P)])
    nll, score, fisher = gaussian(nu, S, np.ones(m, bool), dnu, dS, heavy)
    zero = np.zeros(m)
    density = stats.multivariate_t(zero, S, df=FREEDOM) if heavy else stats.multivariate_normal(zero, S)
    assert float(nll) == pytest.approx(-density.logpdf(nu))
    slope = [(value(x + h * e) - value(x - h * e)) / (2 * h) for e in np.eye(P)]
    np.testing.assert_allclose(score, slope, rtol=1e-6, atol=1e-8)
    assert np.linalg.eigvalsh(np.asarray(fisher)).min() > 0


@pytest.mark.full
def test_a_likelihood_that_counts_more_weighs_more(job):
    make, _, _ = job
    mine = make()
    more = Evidence(mine.filt, mine.spec, mine.used, observations=10 * mine.effective)
    np.testing.assert_allclose(more.inform(mine.flat).nll, 10 * mine.inform(mine.flat).nll, rtol=1e-12)


def test_values_are_those_of_the_information(job):
    """J of three points at once is J of each with its derivatives."""
    make, _, _ = job
    mine = make()
    points = np.asarray(mine.flat) + np.array([[0.0], [0.3], [-0.2]])
    np.testing.assert_allclose(mine.values(points), [float(mine.inform(x).nll) for x in points], rtol=1e-12)


@pytest.mark.full
def test_the_score_is_the_slope_of_the_objective(job):
    make, _, _ = job
    mine = make()
    inform = mine.inform
    x = np.asarray(mine.flat) + 0.2
    info, h = inform(jnp.asarray(x)), 1e-4
    slope = [(float(inform(x + h * e).nll) - float(inform(x - h * e).nll)) / (2 * h) for e in np.eye(x.size)]
    np.testing.assert_allclose(info.score, slope, rtol=1e-3, atol=1e-4)
    assert np.linalg.eigvalsh(np.asarray(info.fisher)).min() > 0


def test_the_prior_of_a_delay_is_centred_at_the_scan(ekf, job):
    """J grows by half the square of the distance to the scan's delay; the prior of the noise stays at the datasheet."""
    make, _, _ = job
    mine = Evidence(ekf, priors.spec_of(ekf, make.use().datasheet, ("timing", "noise.gyro")), [make.use()])
    scanned = NoiseScan(10.0, 3.0, latency=0.25).applied(make.use().datasheet)
    numbers = mine.numbers([scanned])
    assert float(get(mine.params(numbers), "mounting.time_offset")) == pytest.approx(0.25)
    before = float(mine.inform(numbers).nll)
    mine.centre_delays(numbers)
    delay = np.array(mine.leaves) == "mounting.time_offset"
    np.testing.assert_array_equal(np.asarray(mine.centre == numbers), delay | (np.asarray(mine.flat == numbers)))
    off = (0.25 / 0.1) ** 2 / 2  # its sd is 0.1 s
    assert before - float(mine.inform(numbers).nll) == pytest.approx(off, rel=1e-9)


def test_the_scan_sees_the_training_part_by_the_filters_measurements(rec, job, monkeypatch):
    make, _, layout = job
    seen = {}

    def scan_noise(rec, params, *, initialization, stop, reach):
        seen.update(streams=set(rec.aiding), stop=stop, reach=reach)
        return NoiseScan()

    monkeypatch.setattr(recorded, "scan_noise", scan_noise)
    own = make.use()
    (all_of,) = experiment.experiments_of([rec], build("ekf15", GNSS[:1]), [own.initialization], Standing())
    recorded.scan(all_of._replace(layout=layout), own.datasheet, lambda line: None)
    assert seen == {"streams": {"position"}, "stop": layout.train, "reach": MAX_ADDED_DELAY_S}


def test_nothing_after_the_training_part_enters(job):
    make, packed, layout = job
    late = packed.t > layout.train
    value = np.asarray(packed.epochs.fix.value).copy()
    value[late, 3:6] += 50.0
    other = packed._replace(epochs=packed.epochs._replace(fix=packed.epochs.fix._replace(value=jnp.asarray(value))))
    a, b = (make(p) for p in (packed, other))
    np.testing.assert_array_equal(a.inform(a.flat).nll, b.inform(b.flat).nll)


@pytest.mark.full
def test_recordings_together_are_the_sum_of_each(ekf, job):
    """The same recording twice, once longer by padding: twice the evidence, N too; and J that weighs the prior less."""
    make, packed, _ = job
    one, own = make(), make.use()
    E, K = packed.epochs.imu.dt.shape
    padded = own._replace(
        epochs=prepare(ekf, ep.pad_epochs(packed.epochs, E + 7, K + 2)), windows=windows_of(packed, own.layout, E + 7)
    )
    both, x = Evidence(ekf, make.spec, [padded, padded]), one.flat + 0.1
    for a, b in zip(one.evidence(x), both.evidence(x), strict=True):
        jax.tree.map(lambda a, b: np.testing.assert_allclose(2 * a, b, rtol=1e-5, atol=1e-6 * np.abs(a).max()), a, b)
    assert both.effective == pytest.approx(2 * one.effective)
    off = 0.5 * float(jnp.sum((x - one.centre) ** 2 / one.width**2))
    assert float(both.inform(x).nll) - off == pytest.approx(2 * (float(one.inform(x).nll) - off))


@pytest.mark.full
def test_separate_parameters_have_separate_numbers(ekf, job):
    """Two recordings, fixes each one's own: noise sees both, of fixes each sees its own recording alone."""
    make, _, _ = job
    one, fixes = make(), ("measurements.position.scale", "measurements.velocity.scale")
    both = Evidence(ekf, make.spec, [make.use(), make.use()], fixes)
    own = np.isin(one.leaves, fixes)
    three = Evidence(ekf, make.spec, [make.use()] * 3, fixes)  # nobody's own numbers are another's
    assert len({int(i) for at in three.places for i in at[own]}) == 3 * own.sum() == three.flat.size - (~own).sum()
    assert both.flat.size == own.size + own.sum() and [int(n) for n in both.owner] == [0] * own.size + [1] * own.sum()
    x = one.flat + 0.1
    apart = jnp.concatenate([x, x[own] + 0.4])
    other = jnp.where(own, x + 0.4, x)
    np.testing.assert_array_equal(both.params(apart, 1).measurements["position"].scale,
                                  one.params(other).measurements["position"].scale)  # fmt: skip
    np.testing.assert_allclose(both.numbers(both.each(apart)), apart, atol=1e-9)
    (first, _), (second, _), (found, _) = one.evidence(x), one.evidence(other), both.evidence(apart)
    G = own.size
    np.testing.assert_allclose(found.value, first.value + second.value, rtol=1e-12)
    np.testing.assert_allclose(found.score[:G][~own], (first.score + second.score)[~own], rtol=1e-9)
    np.testing.assert_allclose(found.score[:G][own], first.score[own], rtol=1e-12)
    np.testing.assert_allclose(found.score[G:], second.score[own], rtol=1e-12)
    np.testing.assert_allclose(found.fisher[G:, G:], second.fisher[np.ix_(own, own)], rtol=1e-12)
    assert not np.any(found.fisher[G:, :G][:, own])
    timing = Evidence(ekf, priors.spec_of(ekf, make.use().datasheet, ("timing",)), [make.use()] * 2, (recorded.DELAY,))
    scans = [NoiseScan(latency=latency).applied(make.use().datasheet) for latency in (0.2, -0.4)]
    assert sorted(np.asarray(timing.numbers(scans)).tolist()) == pytest.approx([-4.0, 0.0, 0.0, 2.0])  # steps of 0.1 s
    shared = Evidence(ekf, timing.spec, [make.use()] * 2)  # what is shared is the mean
    assert sorted(np.asarray(shared.numbers(scans)).tolist()) == pytest.approx([-1.0, 0.0, 0.0])


def test_the_score_of_a_part_is_the_objective_but_for_heavy_tails(ekf, job):
    """Over the training part taken for the validation's: hidden fixes as in J, innovations by a Student t."""
    make, packed, layout = job
    mine, own = make(), make.use()
    evidence_ = mine.evidence(mine.flat)
    (run,) = experiment.scores(ekf, own, [own.datasheet])
    info = run.info
    early = layout._replace(train=packed.start + layout.settle - 1e-3, validation=layout.train)
    moved = own._replace(layout=early, parts=own.parts | {"validation": own.parts["training"]})
    counts = (own.t > early.train) & (own.t <= early.validation + 1e-6) & ~own.windows.hidden
    counts &= np.asarray(info.valid).any(-1)
    square, S, m = (np.asarray(a)[counts] for a in (info.nis, info.S, np.asarray(info.valid).sum(-1)))
    scale = np.array([gaussian_scale(int(n)) for n in m])
    student = np.asarray(jax.vmap(lambda q, m: student_nll(q, m, 6))(square * scale, m))
    student = student + 0.5 * (np.linalg.slogdet(S)[1] - m * np.log(scale))
    expected = float(evidence_[1].value / evidence_[1].number) + student.mean()
    assert experiment.predicted([run._replace(used=moved)]) == pytest.approx(expected, rel=1e-9)
    late = info._replace(ok=info.ok & (own.t < layout.train - 1.0))
    assert experiment.predicted([run._replace(used=moved, info=late)]) == np.inf


def test_parts_do_not_meet(job):
    _, packed, layout = job
    windows = windows_of(packed, layout, packed.t.size)
    parts = parts_of(layout, windows)
    total = sum(mask.astype(int) for mask in parts.values())
    assert total.max() == 1 and all(mask.any() for mask in parts.values())
    end = windows.start + layout.window
    assert end[parts["training"]].max() <= layout.train + 1e-6
    assert windows.start[parts["test"]].min() >= layout.validation - 1e-6
    there = np.asarray(packed.epochs.fix.valid)[:, :2].all(1)
    at, known = ages(windows, packed.t, there, parts["training"], layout.window)
    assert at.shape == known.shape == (PHASES, at.shape[1]) and known.any(1).all()
    for phase in range(PHASES):
        assert windows.hidden[phase][at[phase][known[phase]]].all() and there[at[phase][known[phase]]].all()


# ---------------------------------------------------------------------------- priors and verdict


def test_priors_are_about_the_datasheet_and_named_by_kind(ekf):
    params = ekf.params("consumer")
    spec = priors.spec_of(ekf, params, ("noise", "fixes", "timing"), {"noise.gyro": 3.0})
    assert set(spec) == {
        "noise.gyro", "noise.accel", "states.gyro_bias.driving_noise", "states.accel_bias.driving_noise",
        "measurements.position.scale", "measurements.velocity.scale", "mounting.time_offset", "mounting.clock_drift",
        "measurements.velocity.latency",
    }  # fmt: skip
    assert spec["noise.gyro"].prior.sd == pytest.approx(np.log(3)) and spec["noise.accel"].prior.sd == pytest.approx(
        np.log(10)
    )
    assert spec["noise.gyro"].prior.centre == (pytest.approx(0.23 * DEG_PER_SQRT_HOUR),)
    assert spec["mounting.time_offset"].prior.sd == pytest.approx(1.0)  # a step is 0.1 s
    assert all(t.prior is None for t in priors.spec_of(ekf, params, ("noise",), priors=False).values())
    scaled = build("ekf15", states=("gyro_scale",))
    assert "states.gyro_scale.driving_noise" not in priors.spec_of(
        scaled, scaled.params("consumer"), ("noise",)
    )  # a constant
    with pytest.raises(ValueError, match="did you mean noise"):
        priors.spec_of(ekf, params, ("noize",))
    with pytest.raises(ValueError, match="states.gyro_scale.driving_noise: the filter has no state"):
        priors.spec_of(ekf, params, ("states.gyro_scale.driving_noise",))


def test_delays_that_initialization_finds_are_the_centres_of_their_priors(rec, ekf, job):
    """A velocity that is 1 s older than the positions has a latency of its own; fixes have the alignment's delay."""
    own = job[0].use()
    v = rec.aiding["velocity"]
    older = np.column_stack([np.interp(v.t - 1.0, v.t, c) for c in v.value.T])
    fine = rec.aiding | {name: s._replace(sd=3 * s.sd) for name, s in rec.aiding.items()}
    late = rec._replace(aiding=fine | {"velocity": fine["velocity"]._replace(value=older)})
    params = recorded.initialized(NoiseScan(), own, late)
    assert float(get(params, "measurements.velocity.latency")) == pytest.approx(1.0, abs=0.3)
    plain = recorded.initialized(NoiseScan(), own, rec._replace(aiding=fine))
    assert float(get(plain, "measurements.velocity.latency")) == 0.0
    aligned = SimpleNamespace(delay=0.46, sd=np.full(10, 0.02))
    begun = own._replace(initialization=own.initialization._replace(alignment=aligned))
    assert float(get(recorded.initialized(NoiseScan(), begun, rec), "mounting.time_offset")) == pytest.approx(0.46)


def test_a_prior_is_told_as_it_is():
    """Of a factor, of a step in the user's unit, of none."""
    params = build("ekf15").params("consumer")
    spec = priors.spec_of(build("ekf15"), params, ("noise.gyro", "mounting.time_offset"), {"noise.gyro": 4.0})
    assert report.describe_prior(spec["noise.gyro"], 1.0, "deg") == "within a factor 4"
    assert report.describe_prior(spec["mounting.time_offset"], 1e-3, "ms") == "within 100 ms"
    free = priors.spec_of(build("ekf15"), params, ("noise.gyro",), priors=False)
    assert report.describe_prior(free["noise.gyro"], 1.0, "deg") == "none"


def test_parameters_of_streams_that_no_recording_has_are_not_free(rec):
    leaves = ["noise.gyro", "measurements.position.scale", "measurements.velocity.latency", "states.gyro_bias.sd"]
    alone = rec._replace(aiding={"position": rec.aiding["position"]})
    assert recorded.measured(leaves, [alone]) == [leaf for leaf in leaves if "velocity" not in leaf]
    assert recorded.measured(leaves, [alone, rec]) == leaves


def test_a_predicted_fix_has_the_covariance_of_position_and_error():
    rng = np.random.default_rng(1)
    L = rng.normal(size=(18, 18))
    A = np.zeros((3, 18))
    A[:, :3], A[:, 15:] = np.eye(3), np.eye(3)
    found = seen_by_position(jnp.asarray(L @ L.T), slice(15, 18))
    np.testing.assert_allclose(found, A @ L @ L.T @ A.T, rtol=1e-12)


def test_clocks_that_do_not_agree_are_said():
    """One delay is tuned for all: where two starts see different ones, which; not within what they are sure of."""
    recs = [SimpleNamespace(name=name) for name in "ab"]
    begin = lambda delay, sd: SimpleNamespace(alignment=SimpleNamespace(delay=delay, sd=np.full(10, sd)))
    said = recorded.clocks(recs, [begin(0.1, 0.04), begin(-0.6, 0.05)])
    assert [f.code for f in said] == ["time.clocks"] and "a +0.10 s (sd 0.04), b -0.60 s (sd 0.05)" in said[0].message
    assert recorded.clocks(recs, [begin(0.1, 0.04), begin(-0.1, 0.05)]) == []
    assert recorded.clocks(recs, [begin(0.0, 0.001), begin(0.09, 0.001)]) == []
    assert recorded.clocks(recs, [SimpleNamespace(alignment=None)] * 2) == []


# ---------------------------------------------------------------------------- a recording


@pytest.mark.full
def test_fixes_that_are_worse_than_they_say_are_found_out(found):
    """Stated are a third of the sd; what two minutes cannot tell is said to be the prior's."""
    rows = {row.name: row for row in found.rows}
    level = next(row for name, row in rows.items() if name.startswith("position.scale"))  # one for level, one for up
    assert level.value == pytest.approx(3.0, rel=0.35)
    assert rows["velocity.scale"].value == pytest.approx(3.0, rel=0.35)
    assert level.low < 3.0 < level.high
    assert rows["gyro_bias.driving_noise"].remark == "the data add nothing to the prior"
    assert found.chosen in found.trials and found.effective > 1
    assert found.test[found.chosen]["rms_m"] <= 1.02 * found.test["datasheet"]["rms_m"]
    said = str(found)
    assert "position.scale" in said and "within a factor 3" in said and "observations" in said
    assert found.gain is None and ("no interval" in said or found.chosen == "datasheet")


def test_a_written_result_is_read_back(found, ekf, tmp_path):
    found.write(tmp_path / "tuned")
    again = tuning.load(tmp_path / "tuned" / "tuned.toml", ekf.params("consumer"))
    for leaf in found.spec:
        np.testing.assert_allclose(get(again, leaf), get(found.params, leaf), rtol=1e-12)
    assert json.loads((tmp_path / "tuned" / "metrics.json").read_text())["verdict"] == found.verdict
    assert (tmp_path / "tuned" / "tuned_px4.params").read_text().startswith(f"# jaxnav tune: {found.used[0].name}")
    later = put(found.params, "mounting.time_offset", jnp.asarray(0.07))
    free = found.spec | priors.spec_of(ekf, later, ("mounting.time_offset",))
    dataclasses.replace(found, params=later, spec=free).write(tmp_path / "later")  # no noise, and yet written
    again = tuning.load(tmp_path / "later" / "tuned.toml", ekf.params("consumer"))
    assert float(again.mounting.time_offset) == pytest.approx(0.07)
    (tmp_path / "other.toml").write_text("[filter]\n")
    for path, words in ((tmp_path / "other.toml", r"none of \[noise\]"), (tmp_path / "none.toml", "cannot be read")):
        with pytest.raises(DataError, match=words):
            tuning.load(path, ekf.params("consumer"))


@pytest.mark.full
def test_ctrl_c_leaves_the_best_so_far(rec, ekf, found):
    """In the second evaluation of the search: the first one's numbers are judged, and the verdict is one."""

    def log(line):
        if "tuned, evaluation 1" in line:
            raise KeyboardInterrupt

    less = tuning.tune(rec, ekf, ekf.params("adis16465"), free=("noise", "fixes"), log=log)
    assert (
        less.status is Status.INTERRUPTED
        and found.status is not Status.INTERRUPTED
        and set(less.trials) == {"datasheet", "auto", "tuned"}
    )
    np.testing.assert_array_equal(less.trials["auto"].drift, found.trials["auto"].drift)
    assert len(less.history) < len(found.history) and "position.scale" in str(less)


@pytest.mark.full
def test_an_objective_is_minimised_by_gradient_over_the_training_windows(rec, ekf, found, job):
    """The same split, start, verdict and table; nothing that is scored later, or was earlier, enters the objective."""
    how = Descent({"log_drift": 1.0, "nll": 1.0}, steps=2)
    own = tuning.tune(rec, ekf, ekf.params("adis16465"), free=("noise", "fixes"), how=how)
    assert set(own.trials) == {"datasheet", "auto", "tuned"} and own.status is Status.ITERATION_LIMIT
    np.testing.assert_array_equal(own.trials["auto"].drift, found.trials["auto"].drift)
    assert [row["step"] for row in own.history] == [0, 1, 2] and "noise.gyro" in own.history[0]["params"]
    assert {row.name for row in own.rows} == {row.name for row in found.rows}
    make, packed, layout = job
    used = make.use()
    for part, begin, end in (
        ("training", packed.start + layout.settle, layout.train), ("validation", layout.train, layout.validation),
    ):  # fmt: skip
        size = int(np.searchsorted(packed.t, end + TICK))
        r, t = runs_of(used, ekf, part, size), packed.t[:size]
        keep, scored = np.asarray(r.keep), np.asarray(r.scored)
        assert scored.sum() == used.parts[part].sum() and (t[np.asarray(r.ends)[scored]] <= end).all()
        assert (t[keep.any(0)] > begin).all() and not np.take_along_axis(keep, np.asarray(r.ends), 1)[scored].any()
        assert (np.asarray(r.epochs.fix.valid)[..., :2].any(-1) <= ~used.windows.hidden[:, :size]).all()
        first = int(np.argmax(np.asarray(r.part)[0]))  # an error before it does not count
        one = jax.tree.map(lambda a: a[0], r)
        nav = jax.tree.map(lambda a, n=size: jnp.broadcast_to(a, (n, *a.shape)), one.nav)
        for i, counts in ((first - 1, False), (first, True)):
            info = SimpleNamespace(nav=nav._replace(pos=one.truth.lla.at[i, 2].add(100.0)))
            assert (float(score_of("rmse")(info, one)) > 1.0) == counts
    with pytest.raises(ConfigError, match="tune.per_recording goes with the tempered method"):
        tuning.tune([rec, rec], ekf, ekf.params("adis16465"), free=("noise",), per_recording=("noise.gyro",), how=how)


def test_a_recording_that_is_too_short_is_refused(rec, ekf):
    few = {name: sample_rows(s, slice(None, 25)) for name, s in rec.aiding.items()}
    short = rec._replace(aiding=few, imu=type(rec.imu)(*(a[rec.imu.t < rec.imu.t[0] + 25] for a in rec.imu)))
    with pytest.raises(DataError, match="it is too short to tune on"):
        tuning.tune(short, ekf, ekf.params("adis16465"), free=("noise",))
    with pytest.raises(ValueError, match="2 recordings, 1 params and 2 initializations"):
        tuning.tune([rec, short], ekf, [ekf.params("adis16465")])


@pytest.mark.slow
def test_two_drives_of_one_imu_tell_more_than_one(rec, ekf, found):
    """Together: one number for both, windows of both, intervals that are narrower where the data speak."""
    what = URBAN_SHORT._replace(duration_s=160.0, imu_rate_hz=20.0, gnss_rate_hz=1.0)
    gnss = what.gnss._replace(outages_s=(), position_sd_m=(0.5, 0.5, 1.0), velocity_sd_mps=(0.05, 0.05, 0.08))
    other = to_recording(simulate_jit(jax.random.key(9), what._replace(gnss=gnss)), what)
    other = other._replace(aiding={name: s._replace(sd=s.sd / 3) for name, s in other.aiding.items()})
    both = tuning.tune([rec, other], ekf, ekf.params("adis16465"), free=("noise", "fixes"))
    shapes = {u.windows.hidden.shape for u in both.used}
    assert len(shapes) == 1 and shapes.pop()[0] == PHASES  # one program
    assert all(both.counts[name] > found.counts[name] for name in both.counts) and both.effective > found.effective
    assert both.each[0].noise.gyro == both.each[1].noise.gyro
    one, two = (next(r for r in each.rows if r.name.startswith("position.scale")) for each in (found, both))
    assert two.low < 3.0 < two.high and np.log(two.high / two.low) < np.log(one.high / one.low)


@pytest.mark.slow
def test_two_loggers_have_two_clocks(rec, ekf, tmp_path):
    """The same drive, once with the IMU's stamps 0.15 s late: each finds its own, all else is one for both."""
    later = rec._replace(name="late", imu=rec.imu._replace(t=rec.imu.t + 0.15), truth=None)
    both = tuning.tune(
        [rec, later],
        ekf,
        ekf.params("adis16465"),
        free=("noise", "fixes", "timing"),
        per_recording=("mounting.time_offset",),
    )
    offsets = [float(p.mounting.time_offset) for p in both.each]
    assert both.chosen != "datasheet" and offsets[1] - offsets[0] == pytest.approx(-0.15, abs=0.03)  # as the scan's
    assert both.each[0].noise.gyro == both.each[1].noise.gyro
    assert any(row.name == "time_offset of late" for row in both.rows)
    both.write(tmp_path)
    second = tuning.load(tmp_path / "tuned_2.toml", ekf.params("consumer"))
    assert float(second.mounting.time_offset) == pytest.approx(offsets[1])
