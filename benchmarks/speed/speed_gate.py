"""The bars of the speed benchmark, and the comparison of its ratios with those of a committed run."""

import json
import math
import sys
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any

BASELINE = Path(__file__).with_name("speed_baseline.json")
TABLES = ("single", "batch", "states", "gradient", "compile", "scaling", "peers")
SLOPES = ("stride 10", "stride 10, prepared")  # forms with bars on their gradient
WORSE = 1.5  # times the baseline's ratio


Result = dict[str, dict[str, dict]]  # tables of rows


def least(result: Result, of: str, *names: str, key: str = "ratio") -> float:
    """The least number under ``key`` in these rows of a table; nan where none has it."""
    return min((result[of][name][key] for name in names if key in result[of].get(name, {})), default=float("nan"))


def bars(result: Result) -> list[dict[str, Any]]:
    """Goals, and whether they are met; bars without measured rows are left out."""
    aims = [(*aim, True) for aim in upper(result)] + [(*aim, False) for aim in lower(result)]
    return [
        {"bar": text, "value": value, "limit": limit, "at_most": at_most, "met": (value <= limit) == at_most}
        for text, value, limit, at_most in aims if not math.isnan(value)
    ]  # fmt: skip


def upper(result: Result) -> Iterator[tuple[str, float, float]]:
    """Text, value and upper limit."""
    for n, limit in ((9, 6.0), (15, 4.0)):
        one, many = f"{n} states", f"{n} states, 256 runs"
        for table, name, what in (("single", one, "scalar floor, one run"), ("batch", many, "8-lane floor, 256 runs")):
            yield f"stride 1 / {what}, {n} states", least(result, table, f"stride 1, {name}", key="by_floor"), limit
    for form, runs in product(SLOPES, (1, 64)):
        by_forward = least(result, "gradient", f"{form}, 15 states, {runs} runs", key="by_forward")
        yield f"value and gradient / forward, {form}, {runs} runs", by_forward, 5.0
    for name, row in result["states"].items():
        if not name.startswith("stride 10, 15 states"):
            yield f"{name} / 15 states", row["ratio"], 2.5
    memory = least(result, "gradient", "stride 10, 15 states, an hour of 8 runs", key="bytes_per_step")
    yield "peak memory of the gradient, bytes per sample and run", memory, 500.0
    apart = 1e3 * least(result, "accuracy", "stride 10", key="m")
    yield "stride 10 against stride 1 over the hour, position, mm", apart, 10.0
    apart = 1e3 * least(result, "accuracy", "stride 10", key="prepared_m")
    yield "stride 10, prepared, against stride 1 over the hour, position, mm", apart, 10.0
    apart = 100 * least(result, "accuracy", "stride 10", key="gradient")
    yield "stride 10 against stride 1 over the hour, gradient, %", apart, 1.0
    for name, row in result["scaling"].items():
        if "tolerance" in row:
            yield f"exponent of {name}: distance from 1", abs(row["ratio"] - 1), row["tolerance"]
    for name, row in result["compile"].items():
        if name.endswith("warm"):
            yield f"first call, cache / none: {name.removesuffix(', warm')}", row["ratio"], 0.2


def lower(result: Result) -> Iterator[tuple[str, float, float]]:
    """Text, value and lower limit."""
    for n, at10, at1 in ((9, 8.0, 2.4), (15, 7.0, 1.8)):
        many = f"{n} states, 256 runs"
        nested = least(result, "batch", f"nested scan, {many}")
        yield (
            f"nested scan / stride 10, 256 runs, {n} states",
            nested / least(result, "batch", f"stride 10, {many}"),
            at10,
        )
        ready = nested / least(result, "batch", f"stride 10, prepared, {many}")
        yield f"nested scan / stride 10, prepared, 256 runs, {n} states", ready, at10
        yield f"nested scan / stride 1, 256 runs, {n} states", nested / least(result, "batch", f"stride 1, {many}"), at1
    for step, stride, limit in (("IMU", 1, 1500.0), ("default", 10, 600.0)):
        gap = least(result, "peers", f"python-ins, {step} step") / least(result, "peers", f"stride {stride}, 15 states")
        yield f"python-ins, {step} step / stride {stride}", gap, limit
    for form, runs in product(SLOPES, (1, 64)):
        many = f"15 states, {runs} runs"
        gap = least(result, "gradient", f"nested, checkpoint, {many}") / least(result, "gradient", f"{form}, {many}")
        yield f"gradient: nested, checkpoint / {form}, {runs} runs", gap, 4.0
    for name, row in result["scaling"].items():
        if name.startswith("2 devices"):
            yield f"speedup of {name}", 1 / row["ratio"], 1.7


def show_bars(rows: list[dict[str, Any]]) -> None:
    """A line a bar."""
    print(f"\n{'bar':70} {'value':>9} {'limit':>9}")
    for row in rows:
        limit = ("<= " if row["at_most"] else ">= ") + f"{row['limit']:g}"
        print(f"  {row['bar']:68} {row['value']:9.4g} {limit:>9}  {'met' if row['met'] else 'NOT MET'}")


def keep(result: Result, mode: str, path: Path = BASELINE) -> None:
    """Make this run the baseline of its mode."""
    all_modes = json.loads(path.read_text()) if path.exists() else {}
    ours = {t: {name: row["ratio"] for name, row in result[t].items() if is_compared(name)} for t in TABLES}
    all_modes[mode] = {t: rows for t, rows in ours.items() if rows} | {"environment": result["versions"]}
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(all_modes, indent=1) + "\n")
    print(f"wrote {path}")


def is_compared(name: str) -> bool:
    """Is the row ours, so that a larger ratio is a loss?"""
    return "stride" in name


def worse(result: Result, mode: str, path: Path = BASELINE) -> list[str]:
    """Rows with a ratio of more than `WORSE` times the baseline's, and rows of it that are missing, in words."""
    if not path.exists() or mode not in (before := json.loads(path.read_text())):
        return [f"no baseline of the {mode} form in {path}"]
    found = []
    for t in TABLES:
        for name, old in before[mode].get(t, {}).items():
            row = result[t].get(name)
            if row is None:
                found.append(f"{t}: {name} is in the baseline and was not measured")
            elif row["ratio"] > WORSE * old:
                found.append(f"{t}: {name}: ratio to {row['ratio_to']} {row['ratio']:.3g}, in the baseline {old:.3g}")
    return found


def gate(result: Result, mode: str, path: Path = BASELINE) -> int:
    """Print the rows worse than the baseline; 1 if there are any."""
    found = worse(result, mode, path)
    for line in found:
        print(f"gate: {line}", file=sys.stderr)
    if not found:
        print(f"gate: no ratio is more than {WORSE} times the baseline's")
    return 1 if found else 0
