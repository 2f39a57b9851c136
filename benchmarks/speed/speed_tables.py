"""The tables of the speed benchmark: times and ratios."""

import os
from functools import partial
from itertools import product
from pathlib import Path
from statistics import median
from typing import NamedTuple

import jax
import numpy as np

from benchmarks.speed import speed_child, speed_peers
from benchmarks.speed.speed_floor import floor
from benchmarks.speed.speed_work import (
    BESIDES,
    CHECKPOINT,
    FIRST,
    FIRST_CHECKPOINT,
    NAIVE,
    NESTED,
    OURS,
    PARAMS,
    RATE,
    Form,
    Rounds,
    arguments,
    drives,
    executable,
    exponent,
    interleaved,
    quotient,
    release,
    rms,
    table,
)  # fmt: skip
from jaxnav.filters.run import prepare


class Sizes(NamedTuple):
    """Sizes of the runs."""

    states: tuple[int, ...] = (9, 15)
    lengths: tuple[int, ...] = (60, 600, 3600)  # s, of one run; the last is the single run's
    batches: tuple[int, ...] = (1, 64, 256, 1024, 4096)
    seconds: int = 60  # of a batch
    large: tuple[int, int] = (4096, 20)  # from so many runs on so many seconds
    gradients: tuple[int, ...] = (1, 64)
    inertial: tuple[int, int] = (60, 20)  # s: python-ins as it comes, and at the IMU step
    repeats: int = 7
    plain: tuple[Form, ...] = (NAIVE, NESTED, FIRST)
    full: bool = True


QUICK = Sizes((15,), (60,), (1, 64), 60, (1 << 20, 0), (1,), (10, 2), 3, (NESTED,), False)


def name_of(form: Form, n: int, runs: int = 0) -> str:
    """A row's name."""
    return f"{form.label}, {n} states" + (f", {runs} runs" if runs else "")


def show(title: str, rows: dict[str, dict], others: tuple[str, ...] = ()) -> None:
    """A line a row, ``others`` being further numbers to print."""
    print(f"\n{title}   (load {os.getloadavg()[0]:.1f})", flush=True)
    for name, row in rows.items():
        cost = f"{row['us_per_step']:10.3f} us/step" if "us_per_step" in row else f"{row['seconds']:10.3f} s      "
        extra = "".join(f"  {key} {row[key]:.3g}" for key in others if key in row)
        print(f"  {name:48} {cost}  {row['ratio']:9.3g} x {row['ratio_to']}{extra}{row.get('note', '')}")


def beside_floor(rows: dict[str, dict], taken: Rounds, floor: str) -> None:
    """Add to our rows how many times as long as the floor they take, in the same turn."""
    for name, row in rows.items():
        if floor in taken and name.startswith("stride"):
            row["by_floor"] = quotient(taken[name], taken[floor])


# ---------------------------------------------------------------------------- tables


def single(sizes: Sizes) -> dict[str, dict]:
    """One run of the whole length."""
    seconds, rows = sizes.lengths[-1], {}
    for n in sizes.states:
        given = arguments(seconds, 1)
        calls = {name_of(f, n): executable(f, n, seconds, 1).call for f in (*sizes.plain, *OURS)}
        lone = jax.tree.map(lambda a: a[None], given[1:])
        if (own := floor(n, 1, PARAMS(), *lone)) is not None:
            calls[f"floor, {n} states"] = own
        taken = interleaved(calls, sizes.repeats)
        new = table(taken, seconds * RATE, name_of(NESTED, n))
        beside_floor(new, taken, f"floor, {n} states")
        rows |= new
    if sizes.full:
        release()
    show(f"one run of {seconds} s", rows, ("by_floor",))
    return rows


def batch(sizes: Sizes) -> dict[str, dict]:
    """Batches, by ``vmap``."""
    rows = {}
    for runs in sizes.batches:
        seconds = sizes.seconds if runs < sizes.large[0] else sizes.large[1]
        # the naive form and that of first order differ most in batches of hundreds
        plain = sizes.plain if runs <= 256 else (NESTED,)
        forms = (*plain, *OURS)
        for n in sizes.states:
            given = arguments(seconds, runs)
            calls = {name_of(f, n, runs): executable(f, n, seconds, runs).call for f in forms}
            calls |= {
                name_of(f, n, runs) + ": preparing": partial(prepare, f.ready(n), given[2]) for f in forms if f.ready
            }
            if runs % 8 == 0 and (own := floor(n, 8, PARAMS(), *given[1:])) is not None:
                calls[f"floor, {n} states, {runs} runs"] = own
            taken = interleaved(calls, sizes.repeats if runs <= 256 else 3)
            new = table(taken, seconds * RATE * runs, name_of(NESTED, n, runs))
            beside_floor(new, taken, f"floor, {n} states, {runs} runs")
            rows |= new
            if sizes.full:
                release()
            if seconds != sizes.seconds:
                for name in taken:
                    rows[name]["note"] = f"  (on {seconds} s)"
        show(f"batch of {runs}", {k: row for k, row in rows.items() if f" {runs} runs" in k}, ("by_floor",))
    return rows


def larger(sizes: Sizes) -> dict[str, dict]:
    """More states in a batch, with 15 of them in the same turns."""
    rows, runs, ten = {}, min(sizes.batches[-1], 256), next(f for f in OURS if f.label == "stride 10")
    for n in BESIDES:
        calls = {name_of(ten, m, runs): executable(ten, m, sizes.seconds, runs).call for m in (15, n)}
        rows |= table(interleaved(calls, sizes.repeats), sizes.seconds * RATE * runs, name_of(ten, 15, runs))
    if sizes.full:
        release()
    show(f"more states, batch of {runs}", rows)
    return rows


def gradient(sizes: Sizes) -> dict[str, dict]:
    """Value and gradient of the innovation NLL in all noise parameters, 15 states."""
    rows, n = {}, 15
    for runs in sizes.gradients:
        seconds = sizes.seconds
        steps = seconds * RATE * runs
        ours = [f for f in OURS if sizes.full or "stride 10" in f.label]
        forms = {CHECKPOINT: NESTED, FIRST_CHECKPOINT: FIRST} if FIRST in sizes.plain else {CHECKPOINT: NESTED}
        forms |= {f: f for f in ours}
        slopes = {name_of(f, n, runs): executable(f, n, seconds, runs, True) for f in forms}
        values = {name_of(f, n, runs): executable(f2, n, seconds, runs) for f, f2 in forms.items()}
        calls = {k: e.call for k, e in slopes.items()} | {f"{k}: forward": e.call for k, e in values.items()}
        taken = interleaved(calls, sizes.repeats)
        new = table({k: taken[k] for k in slopes}, steps, name_of(CHECKPOINT, n, runs))
        for name, row in new.items():
            row["by_forward"] = quotient(taken[name], taken[f"{name}: forward"])
            row["temp_bytes_per_step"] = slopes[name].temp / steps
        show(f"value and gradient, batch of {runs} on {seconds} s", new, ("by_forward", "temp_bytes_per_step"))
        rows |= new
        if sizes.full:
            release()
    if sizes.full and Path("/proc/self/clear_refs").exists():
        hour = speed_child.ask("memory", "stride 10", n, sizes.lengths[-1], 8)
        name = "stride 10, 15 states, an hour of 8 runs"
        rows[name] = hour | {"ratio_to": "500 bytes per step", "ratio": hour["bytes_per_step"] / 500}
        show("peak memory of the process over the memory before", {name: rows[name]}, ("bytes_per_step",))
    return rows


def compiling(sizes: Sizes) -> dict[str, dict]:
    """First calls with an empty and with a warm cache on disk; in the quick form the compile times here."""
    rows: dict[str, dict] = {}
    forward, backward = [NESTED, *OURS], [CHECKPOINT, *(f for f in OURS if sizes.full or "stride 10" in f.label)]
    if not sizes.full:
        for gradient, forms in ((False, forward), (True, backward)):
            first = speed_child.title(forms[0].label, 15, gradient)
            for f in forms:
                e = executable(f, 15, sizes.seconds if gradient else sizes.lengths[-1], 1, gradient)
                rows[speed_child.title(f.label, 15, gradient)] = {"seconds": e.seconds, "ratio_to": first}
        for row in rows.values():
            row["ratio"] = row["seconds"] / rows[row["ratio_to"]]["seconds"]
    else:
        for n, gradient in product(sizes.states, (False, True)):
            names = [(f.label, n, gradient) for f in (backward if gradient else forward)]
            times = speed_child.compile_times(names)
            titles = [speed_child.title(*name) for name in names]
            for name in titles:
                cold, warm = times["cold"][name], times["warm"][name]
                ratio = cold / times["cold"][titles[0]]
                rows[f"{name}, cold"] = {"seconds": cold, "ratio_to": f"{titles[0]}, cold", "ratio": ratio}
                rows[f"{name}, warm"] = {"seconds": warm, "ratio_to": "cold", "ratio": warm / cold}
    show("first call", rows)
    return rows


def scaling(sizes: Sizes, batches: dict[str, dict], devices: bool) -> tuple[dict[str, dict], dict]:
    """Exponents of cost in run length, batch and states, and two devices; also the curves."""
    curves: dict[str, dict[str, list[list[float]]]] = {"run length, s": {}, "batch": {}}
    by_round = {}  # exponents of run length
    pair = [f for f in OURS if not f.ready]
    tolerance = {"run length, s": 0.03, "batch": 0.05} if sizes.full else {}
    if sizes.full:
        calls = {(f, s): executable(f, 15, s, 1).call for f in pair for s in sizes.lengths}
        taken = interleaved({f"{f.label} {s}": call for (f, s), call in calls.items()}, 2 * sizes.repeats)
        for f in pair:
            seconds = [taken[f"{f.label} {s}"] for s in sizes.lengths]
            by_round[name_of(f, 15)] = median(exponent(sizes.lengths, each) for each in zip(*seconds, strict=True))
            points = [[float(s), median(each)] for s, each in zip(sizes.lengths, seconds, strict=True)]
            curves["run length, s"][name_of(f, 15)] = points
    for f in pair:
        for n in sizes.states:
            some = [b for b in sizes.batches if b >= 64 or not tolerance]
            us = [batches[name_of(f, n, b)]["us_per_step"] for b in some]
            curves["batch"][name_of(f, n)] = [
                [float(b), u * b * sizes.seconds * RATE * 1e-6] for b, u in zip(some, us, strict=True)
            ]
    curves = {quantity: lines for quantity, lines in curves.items() if lines}
    rows = {}
    for quantity, lines in curves.items():
        for name, points in lines.items():
            found = by_round[name] if quantity == "run length, s" else exponent(*zip(*points, strict=True))
            row = {"seconds": points[-1][1], "ratio_to": "exponent 1", "ratio": found}
            limit = {"tolerance": tolerance[quantity]} if quantity in tolerance else {}
            rows[f"{quantity.split(',')[0]}, {name}"] = row | limit | {"points": points}
    if len(sizes.states) > 1:
        for f in (NESTED, *pair):
            for b in (1, 256):
                cost = [batches[name_of(f, n, b)]["us_per_step"] for n in sizes.states]
                rows[f"states, {f.label}, {b} runs"] = {
                    "us_per_step": cost[-1], "ratio_to": "exponent 1", "ratio": exponent(sizes.states, cost),
                }  # fmt: skip
    if devices:
        t = speed_child.ask("devices", "stride 10", 15, sizes.seconds, 1024, sizes.repeats, JAX_NUM_CPU_DEVICES="2")
        rows["2 devices, stride 10, 15 states, 1024 runs"] = {
            "seconds": median(t["2"]), "ratio_to": "1 device, wall time", "ratio": quotient(t["2"], t["1"]),
        }  # fmt: skip
    show("growth: cost ~ size ^ exponent", rows)
    return rows, curves


def peers(sizes: Sizes) -> tuple[dict[str, dict], dict[str, dict]]:
    """Other packages on one run, 15 states; and how accurate python-ins and we are on it."""
    seconds, n, params = sizes.seconds, 15, PARAMS()
    given = arguments(seconds, 1)
    ours = {name_of(f, n): executable(f, n, seconds, 1).call for f in OURS}
    work = speed_peers.given(n, params, *given[1:])
    filters = {f"{k}, Kalman filter alone": make(work) for k, make in speed_peers.KALMAN.items()}
    loop = {"numpy loop": speed_peers.numpy_loop(n, params, *given[1:])}
    calls = {name: call for name, call in (ours | loop | filters).items() if call is not None}
    steps = {name: seconds * RATE for name in calls}
    P = np.asarray(speed_peers.covariance(work))
    sd, notes = np.sqrt(np.diag(P)), {}
    for name, call in calls.items():  # compile
        out = call()
        if name in filters:
            notes[name] = f"  (covariance off by {np.abs((out - P) / np.outer(sd, sd)).max():.0e})"
    accuracy, begin = {}, jax.tree.map(lambda a: a[: sizes.inertial[0]], given[2])
    default = speed_peers.python_ins(params, given[1], begin, 0.1)
    if default is not None:
        found = default()  # its compiler warms up here
        solution, truth = next(iter(ours.values()))().lla, drives(seconds).truth.pos[0]
        for name, lla in (("python-ins, default step", found), ("stride 1 at the same times", solution)):
            accuracy[name] = {"rms_m": rms(lla[: len(found)], truth[: len(found)])}
        begin = jax.tree.map(lambda a: a[: sizes.inertial[1]], given[2])
        fine = speed_peers.python_ins(params, given[1], begin, 1 / RATE)
        calls |= {"python-ins, default step": default, "python-ins, IMU step": fine}
        steps |= {k: s * RATE for k, s in zip(("python-ins, default step", "python-ins, IMU step"), sizes.inertial)}
    rows = table(interleaved(calls, min(sizes.repeats, 3)), steps, name_of(OURS[0], n))
    notes |= {k: f"  (on {s // RATE} s)" for k, s in steps.items() if s != seconds * RATE}
    for name, note in notes.items():
        rows[name]["note"] = note
    show(f"one run of {seconds} s, {n} states, with other packages", rows)
    return rows, accuracy
