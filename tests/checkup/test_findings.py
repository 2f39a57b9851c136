"""KINDS as a contract: every kind is used by a check, a run or a tuning, and gets every number that its words name."""

import ast
import re
from itertools import chain
from pathlib import Path
from string import Formatter

import jaxnav
from benchmarks.pages.examples import EXAMPLES
from jaxnav.app.results import Outcome, terminal
from jaxnav.findings import finding, line, warnings
from jaxnav.kinds import KINDS
from jaxnav.types import Severity

HERE = {*Path("jaxnav/kinds").glob("*.py"), Path("benchmarks/pages/examples.py")}
POSITIONAL = ("code", "subject", "value", "limit")


def sources():
    """Return the syntax tree of every module but the table's own."""
    root = Path(jaxnav.__file__).parents[1]
    files = [
        f for folder in ("jaxnav", "tuning") for f in (root / folder).rglob("*.py") if f.relative_to(root) not in HERE
    ]
    return {f.relative_to(root): ast.parse(f.read_text(encoding="utf-8")) for f in files}


def calls():
    """Return place, code's expression and names of arguments of each call of `finding`; None where some are unnamed."""
    for file, tree in sources().items():
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "finding":
                names = [k.arg for k in node.keywords]
                yield f"{file}:{node.lineno}", node.args[0], {*POSITIONAL[: len(node.args)], *names}


def fields(code):
    """Return the names that a kind's words use."""
    words = " ".join((KINDS[code].message, *KINDS[code].causes, *KINDS[code].actions))
    return {name for _, name, _, _ in Formatter().parse(words) if name}


def test_every_call_names_a_kind_and_gives_its_numbers():
    optional = {"subject", "value", "limit"}  # empty by default: a kind that prints one must be given it
    count = 0
    for place, code, given in calls():
        if isinstance(code, ast.Constant):
            assert code.value in KINDS, f"{place}: {code.value}"
            missing = fields(code.value) - given
            assert None in given or not missing, f"{place}: {code.value} lacks {missing & optional or missing}"
            count += 1
    assert count > 40


def test_every_kind_is_used():
    constants, patterns = set(), []
    for tree in sources().values():
        for node in ast.walk(tree):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                constants.add(node.value.partition(":")[0])  # "velocity.units: looks like km/h"
            if isinstance(node, ast.JoinedStr):
                parts = (re.escape(v.value) if isinstance(v, ast.Constant) else r"[a-z_]+" for v in node.values)
                patterns.append("".join(parts))
    exact = [re.compile(p) for p in patterns if "\\." in p and p.count("+") == 1 and len(p) < 40]
    unused = [k for k in KINDS if k not in constants and not any(p.fullmatch(k) for p in exact)]
    assert not unused


def test_words_end_without_a_stop_and_say_what_to_do():
    for code, kind in KINDS.items():
        for words in chain((kind.message,), kind.causes, kind.actions):
            assert words and not words.endswith("."), code
            assert words == words.strip() and "  " not in words, code
        assert kind.severity is Severity.INFO or (kind.causes and kind.actions), f"{code} warns without a next step"


def test_every_kind_has_an_example():
    assert list(EXAMPLES) == list(KINDS)
    for code, numbers in EXAMPLES.items():
        message = finding(code, **numbers).message
        assert message and "{" not in message and "None" not in message, code


def test_a_warning_prints_code_cause_and_next_step():
    late = finding("time.late", "position", 0.2, size=0.2, side="late", sd=0.01, cause="latency of the receiver")
    shown = warnings([late])
    assert shown[0] == "WARNING time.late  position is 0.200 s late against the IMU (sd 0.010 s)"
    assert shown[1].strip() == "Likely: latency of the receiver"
    assert shown[2].split() == ["Next:", "set", "measurements.position.latency_s,", "or", "jaxnav", "tune"]
    assert line(late).endswith(
        "; likely: latency of the receiver; next: set measurements.position.latency_s, or jaxnav tune"
    )
    known = finding("time.delay", "position", 0.0, size=0.0, side="late", sd=0.01, cause="latency of the receiver")
    assert finding(
        "time.delay", size=0, side="late", sd=1, cause="latency of the receiver", severity=Severity.WARNING
    ).warns
    assert warnings([known]) == []


def test_the_terminal_shows_warnings_first_and_ends_with_a_verdict():
    late = finding("time.late", "position", 0.2, size=0.2, side="late", sd=0.01, cause="latency of the receiver")
    known = finding("time.delay", "velocity", 0.0, size=0.0, side="late", sd=0.01, cause="latency of the receiver")
    clean = Outcome({}, "a table", {}, findings=[known], verdict="consistent: NIS/dof 1.02")
    assert terminal(clean, False, False) == ["a table", "consistent: NIS/dof 1.02; 1 remark: --verbose"]
    assert terminal(clean, True, False)[1:] == [f"  {line(known)}", "consistent: NIS/dof 1.02"]
    both = clean._replace(findings=[known, late, late])
    shown = terminal(both, False, False)
    assert shown[:3] == warnings([late]) and shown[6:8] == ["", "a table"]
    assert shown[-1] == "2 warnings: see above; 1 remark: --verbose"
    assert terminal(both, False, True)[0] == "\033[1;33mWARNING\033[0m" + shown[0].removeprefix("WARNING")
    assert terminal(Outcome({}, "a table", {}), False, False) == ["a table"]
