"""What tuning runs on: batches of runs with hidden windows, for training, validation and the test kept aside."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.analysis.metrics import told_by
from jaxnav.app import prepare as pre
from jaxnav.app.config import Config, changed
from jaxnav.app.sources import scenario_of, simulated
from jaxnav.data import epochs as ep
from jaxnav.data.bank import most_probable
from jaxnav.filters.border import NAMES
from jaxnav.filters.catalogue import build
from jaxnav.filters.core import Filter, Prepared
from jaxnav.filters.parameters import UNITS, history_for
from jaxnav.filters.run import prepare
from jaxnav.maths import earth
from jaxnav.maths.interpolation import columns_at
from jaxnav.measurements import GNSS, Measurement, clock_offset, counted_from
from jaxnav.simulate.keys import Purpose, run_keys
from jaxnav.simulate.scenarios import Scenario
from jaxnav.simulate.simulation import Simulated
from jaxnav.states.grades import GRADES
from jaxnav.types import ConfigError, DataError, Epoch, Mounting, Nav, Params, Recording
from tuning.likelihood import Likelihood, Source

SLOPE = 0.05  # s, half of what a true velocity is taken over


class Truth(NamedTuple):
    """True positions at the epochs' GNSS time, which the clocks that tuning starts from give them."""

    lla: jax.Array  # (B, E, 3) rad, rad, m
    rate: jax.Array  # (B, E, 3) of it, per s
    known: jax.Array  # (B, E) bool; where not, lla is that of the nearest epoch


class Batch(NamedTuple):
    """B runs of E epochs with up to W hidden windows each, none where a scenario has no outages; arrays of jax."""

    nav: Nav  # (B, ...) starts
    epochs: Epoch  # (B, E, ...)
    samples: Prepared  # (B, E, ...) of the same epochs, prepared for the filter
    ends: jax.Array  # (B, W) int, last epoch of each window
    scored: jax.Array  # (B, W) bool, windows that count here
    keep: jax.Array  # (B, E) bool, epochs whose innovations count
    part: jax.Array  # (B, E) bool, epochs of this part of the data, hidden or not
    truth: Truth | None  # for the supervised objectives


class Material(NamedTuple):
    """Everything a tuning job needs."""

    filter: Filter
    measurements: tuple[Measurement, ...]
    params: Params  # the start
    sheet: Params  # the same by the datasheet, without what [params] says of noise
    train: Batch
    validation: Batch
    test: Batch
    blocks: np.ndarray  # (windows of the test that count, or runs where there are none,) what is drawn together
    names: list[str]  # (B of the test,) of its runs
    train_names: list[str]  # (B of the training,)
    t_train: np.ndarray  # (E of the training,) s
    whole: Likelihood
    redraw: Callable[[int], Batch]  # another training batch of the same shapes for a step
    t: np.ndarray  # (E of the test,) s
    recording: Recording | None  # where the runs are of one
    truth: Nav | None  # (B, E, ...) of the test, where simulated
    outages: list[tuple[float, float]]  # of the first run of the test
    about: str  # how the data was split, in words
    known: dict[str, float]  # leaves whose true value is known

    @property
    def windows(self) -> int:
        """Of each run of the test; 0 where nothing is hidden."""
        return self.test.ends.shape[1]

    @property
    def source(self) -> Source:
        """What the likelihood needs of it."""
        return Source(self.filter, self.params, self.whole)


PARTS = (Purpose.TRAIN, Purpose.VALIDATION, Purpose.TEST)  # of runs that are drawn once


def ready(batch: Batch) -> Epoch:
    """The epochs with their prepared samples."""
    return batch.epochs._replace(imu=batch.samples)


# ---------------------------------------------------------------------------- simulated


def from_scenario(config: Config, scenario: Scenario) -> Material:
    """Runs of a scenario; train, validation and test keys never meet.

    Raises:
        ConfigError: constraints that need a recorded IMU stream, or wrong names.
    """
    _check(config, scenario)
    t = config.tune
    counts = (t.runs, t.validation_runs, t.test_runs)
    keys = jnp.concatenate([run_keys(config.seed, part, np.arange(n)) for part, n in zip(PARTS, counts)])
    sims = simulated(scenario, keys)
    windows = sims.outages.shape[1]
    start, own = config.start, scenario.start
    sd = start.position_sd_m or own.prior_position_sd_m, start.velocity_sd_mps or own.prior_velocity_sd_mps
    params = pre.base_params(config, pre.grade_of(config, scenario), np.array(scenario.gnss.lever_arm_m), *sd)
    history = history_for(params, scenario.imu_rate_hz, scenario.duration_s, pre.REACH)
    filt = build(pre.filter_name(config), GNSS, config.filter.cov_stride, history, states=config.filter.states)
    place = np.array(scenario.gnss.lever_arm_m)
    sheet = pre.base_params(datasheet_only(config), pre.grade_of(config, scenario), place, *sd)
    edges = np.cumsum((0, *counts))
    parts = [jax.tree.map(lambda a, s=slice(a, b): a[s], sims) for a, b in zip(edges[:-1], edges[1:])]
    batches = [_batch(filt, part, params.mounting) for part in parts]
    train, test = batches[0], parts[2]

    def redraw(step: int) -> Batch:
        keys = run_keys(config.seed, Purpose.REDRAWN, step * t.runs + np.arange(t.runs))
        return _batch(filt, simulated(scenario, keys), params.mounting)

    runs = jnp.broadcast_to(jnp.arange(t.runs)[:, None], train.keep.shape)
    about = f"simulated runs of {scenario.name}: {counts[0]} to train, {counts[1]} to validate, {counts[2]} kept aside"
    about += "" if windows else "; it has no outages: judged by the error against the truth"
    return Material(
        filt, GNSS, params, sheet, batches[0], batches[1], batches[2],
        np.repeat(np.arange(counts[2]), max(windows, 1)),
        [f"test run {i}" for i in range(counts[2])],
        [f"{scenario.name}, training run {i} of seed {config.seed}" for i in range(counts[0])],
        np.asarray(parts[0].truth.t[0]), Likelihood(train.nav, ready(train), train.keep, runs, t.runs), redraw,
        np.asarray(test.truth.t[0]), None, test.truth,
        [(float(a), float(b)) for a, b in test.outages[0]], about,
        _known(scenario),
    )  # fmt: skip


def _check(config: Config, scenario: Scenario) -> None:
    if pre.measurements_of(config) != GNSS:
        raise ConfigError("filter: constraints are tuned on recordings: simulate one, and tune with --data FOLDER")
    if config.start.heading == "unknown":
        raise ConfigError('start.heading = "unknown" cannot be tuned: give degrees, "course" or "truth"')
    if scenario.sensors or scenario.sensor_states:
        raise ConfigError("data.options.sensors: tuned on recordings: simulate one, and tune with --data FOLDER")
    start, own = config.start, scenario.start
    if own.prior_tilt_sd_deg > start.tilt_sd_deg or own.prior_heading_sd_deg > start.heading_sd_deg:
        raise ConfigError("start: tilt_sd_deg and heading_sd_deg must not be below the scenario's own")


def _known(scenario: Scenario) -> dict[str, float]:
    """True values of parameters by dotted name: what was simulated."""
    late, grade, factor = scenario.gnss.latency_s, GRADES[scenario.imu.grade], scenario.imu.imu_noise_factor
    drive = factor * np.sqrt(2 / grade.tau)
    return {
        "noise.gyro": factor * grade.arw, "noise.accel": factor * grade.vrw,
        "states.gyro_bias.driving_noise": drive * grade.gyro_instability,
        "states.accel_bias.driving_noise": drive * grade.accel_instability,
        "measurements.position.latency": late, "measurements.velocity.latency": late,
    }  # fmt: skip


def _batch(filt: Filter, sims: Simulated, install: Mounting) -> Batch:
    """Simulated runs (B, ...) with the windows of their outages; ``install``: the clocks as the filter has them."""
    t = sims.truth.t[:, None]
    ends = jnp.sum(t <= sims.outages[:, :, 1:] + ep.TICK, axis=-1) - 1
    keep = ~sims.hidden
    halfway = 0.5 * sims.truth.t[:, -1:]  # as of a recording, see `jaxnav.data.start.halfway`
    nav, own = counted_from(sims.initial, halfway[:, 0]), counted_from(sims.truth, halfway)
    all_of_it, offset = jnp.ones_like(keep), clock_offset(install, own)[..., None]
    rate = jax.vmap(jax.vmap(lambda pos, vel: earth.move(pos, vel) - pos))(own.pos, own.vel)
    return Batch(nav, sims.epochs, prepare(filt, sims.epochs).imu, ends, ends >= 0, keep,
                 all_of_it, Truth(own.pos + offset * rate, rate, all_of_it))  # fmt: skip


# ---------------------------------------------------------------------------- recorded


class Split(NamedTuple):
    """Where the parts of a recording end, s: train, then validation, then the test."""

    start: float
    train: float
    validation: float
    stop: float


def from_recording(config: Config) -> Material:
    """One recording in contiguous parts of time; each phase is a run with its own hidden windows.

    A run for training stops where the training part ends, one for validation where that ends: nothing later can enter
    an objective, nor can what an earlier part has seen. The test runs over everything, of which the last part counts.

    Raises:
        DataError: too short for windows in every part.
    """
    tune, case = config.tune, pre.prepare(config, tuned=True)
    if tune.train + tune.validation > 0.95:
        raise ConfigError("tune.train + tune.validation must leave 0.05 or more to test on")
    if tune.outage_every_s <= tune.outage_s:
        raise ConfigError("tune.outage_every_s must be longer than tune.outage_s")
    t, start = case.packed.t, case.packed.start
    span = float(t[-1]) - start
    split = Split(start, start + tune.train * span, start + (tune.train + tune.validation) * span, float(t[-1]))
    case = _one_start(case, split.train)
    edges = (start + tune.settle_s, split.train, split.validation, split.stop)
    prepared = prepare(case.filter, case.packed.epochs)
    parts = [_phases(config, case, prepared, begin, end) for begin, end in zip(edges[:-1], edges[1:])]
    batches, (_, labels, hidden) = [part[0] for part in parts], parts[2]
    about = (
        f"{case.recording.name}: train {split.start:.0f} to {split.train:.0f} s, validate to {split.validation:.0f} s, "
        f"kept aside to {split.stop:.0f} s; windows of {tune.outage_s:g} s in {tune.phases} runs, "
        f"{', '.join(str(int(b.scored.sum())) for b in batches)} of them"
    )
    grade = pre.grade_of(config, scenario_of(config))
    sheet = case.begun.given(pre.base_params(datasheet_only(config), grade, case.recording.lever_arm))

    def redraw(step: int) -> Batch:
        shift = np.random.default_rng((config.seed, step)).uniform(0, tune.outage_every_s)
        return _phases(config, case, prepared, edges[0], edges[1], shift)[0]

    phases = [f"{case.recording.name}, phase {p}" for p in range(tune.phases)]
    return Material(
        case.filter, case.measurements, case.params, sheet, batches[0], batches[1], batches[2], labels,
        phases, phases, t[: batches[0].keep.shape[1]],
        _whole(config, case, prepared, split), redraw, t, case.recording, None, _spans(t, hidden[0]), about, {},
    )  # fmt: skip


def _one_start(case: pre.ReadyRun, until: float) -> pre.ReadyRun:
    """With the most probable of several starts by the innovations up to ``until`` s, the training part's end."""
    E = int(np.searchsorted(case.packed.t, until + ep.TICK))
    epochs = jax.tree.map(lambda a: a[:E], case.packed.epochs)
    best = most_probable(case.filter, case.params, case.navs, epochs)
    return case._replace(navs=jax.tree.map(lambda a: a[None], best))


def _whole(config: Config, case: pre.ReadyRun, prepared: Epoch, split: Split) -> Likelihood:
    """One run over the training part with nothing hidden; blocks as long as the windows are apart."""
    t = case.packed.t
    E = int(np.searchsorted(t, split.train + ep.TICK))
    block = ((t[:E] - split.start) // config.tune.outage_every_s).astype(int)
    epochs = jax.tree.map(lambda a: jnp.asarray(a[:E])[None], prepared)
    nav = jax.tree.map(lambda a: a[:1], case.navs)
    keep = jnp.asarray(t[:E] >= split.start + config.tune.settle_s)
    return Likelihood(nav, epochs, keep[None], jnp.asarray(block)[None], int(block.max()) + 1)


def datasheet_only(config: Config) -> Config:
    """Return the configuration without stated noise and priors: the datasheet's, with the mounting as stated."""
    return changed(config, {NAMES[leaf]: None for leaf, unit in UNITS.items() if unit.step is None})


def _phases(
    config: Config, case: pre.ReadyRun, prepared: Epoch, begin: float, end: float, shift: float = 0.0
) -> tuple[Batch, np.ndarray, np.ndarray]:
    """Runs up to ``end`` with windows all along, what is between begin and end counts; the windows' blocks of time.

    And which epochs (phases, E) are hidden.

    ``shift`` (s) moves all windows alike, those that leave the end come in at the start.
    """
    tune, t = config.tune, case.packed.t
    E = int(np.searchsorted(t, end + ep.TICK))
    t = t[:E]
    cut, samples = jax.tree.map(lambda a: a[:E], (case.packed.epochs, prepared.imu))
    rows = []
    for phase in range(tune.phases):
        turn = (shift + phase * tune.outage_every_s / tune.phases) % tune.outage_every_s
        first = case.packed.start + tune.settle_s + turn
        starts = np.arange(first, t[-1] - tune.outage_s, tune.outage_every_s)
        fits = (starts >= begin - ep.TICK) & (starts + tune.outage_s <= end)
        hidden, ends = ep.outage_windows(t, starts, tune.outage_s) if starts.size else (np.zeros(E, bool), starts)
        measured = np.asarray(cut.fix.valid)[ends.astype(int), :2].all(1)  # without a fix there is nothing to score by
        rows.append((hidden, starts, ends.astype(int), fits & measured))
    most = int((t[-1] - case.packed.start) // tune.outage_every_s) + 1  # the same for every shift
    pad = lambda a, fill: np.concatenate([a, np.full(most - a.size, fill, a.dtype)])
    hidden = np.stack([row[0] for row in rows])
    starts, ends, count = (np.stack([pad(row[i], 0) for row in rows]) for i in (1, 2, 3))
    if not count.any():
        raise DataError(
            f"{case.recording.name}: no window of {tune.outage_s:g} s with a fix at its end between {begin:.0f} and "
            f"{end:.0f} s; change tune.train, tune.validation or tune.outage_s"
        )
    many = lambda a: jnp.broadcast_to(a, (tune.phases, *a.shape))
    truth = _truth(case, t)
    runs = jax.vmap(lambda e, h: ep.hide(e, h, case.measurements))(jax.tree.map(many, cut), jnp.asarray(hidden))
    nav = jax.tree.map(lambda a: many(a[0]), case.navs)
    # windows that start within one spacing of each other overlap in time, or nearly
    blocks = np.floor((starts - begin) / tune.outage_every_s)[count]
    part = np.broadcast_to(t > begin, hidden.shape)
    batch = Batch(
        nav, runs, jax.tree.map(many, samples), jnp.asarray(ends), jnp.asarray(count),
        jnp.asarray(part & ~hidden), jnp.asarray(part), None if truth is None else jax.tree.map(many, truth),
    )  # fmt: skip
    return batch, blocks, hidden


def _truth(case: pre.ReadyRun, t: np.ndarray) -> Truth | None:
    """Of one run's epochs (E, ...) that end at IMU time ``t``; None without a truth that knows any of them."""
    start, truth = jax.tree.map(lambda a: a[0], case.navs), case.recording.truth
    t = t + np.asarray(clock_offset(case.params.mounting, start._replace(t=t)))
    if truth is None:
        return None
    known = told_by(t, truth.t)
    if not known.any():
        return None
    at = lambda t: columns_at(t, truth.t, earth.continuous(truth.lla))
    rate = (at(t + SLOPE) - at(t - SLOPE)) / (2 * SLOPE)
    return Truth(jnp.asarray(at(t)), jnp.asarray(rate), jnp.asarray(known))


def _spans(t: np.ndarray, hidden: np.ndarray) -> list[tuple[float, float]]:
    """The hidden epochs as (start, end) s."""
    change = np.flatnonzero(np.diff(np.concatenate([[False], hidden, [False]]).astype(int)))
    edges = np.concatenate([t[:1], t])  # an epoch starts where the one before ends
    return [(float(edges[a]), float(edges[b])) for a, b in change.reshape(-1, 2)]
