"""Findings of a reader, a check, a run or a tuning: made of a kind (`jaxnav.kinds`) and numbers, and written."""

from collections.abc import Iterable
from typing import Any

from jaxnav.kinds import KINDS
from jaxnav.types import Finding, Severity


def finding(
    code: str,
    subject: str = "",
    value: float | None = None,
    limit: float | None = None,
    *,
    setting: str = "",
    severity: Severity | None = None,
    **numbers: Any,
) -> Finding:
    """Return a finding of a kind.

    Args:
        code: a row of `KINDS`.
        subject: stream and channel, sensor and axis, or state.
        value: the quantity found, in the kind's unit.
        limit: the limit that it is compared with.
        setting: a setting that would take ``value``.
        severity: in place of the kind's.
        numbers: of the kind's texts.
    """
    kind = KINDS[code]
    write = lambda text: text.format(subject=subject, value=value, limit=limit, **numbers)
    causes, actions = (tuple(map(write, texts)) for texts in (kind.causes, kind.actions))
    severity = kind.severity if severity is None else severity
    return Finding(code, severity, subject, value, limit, kind.unit, write(kind.message), causes, actions, setting)


def line(f: Finding) -> str:
    """Return a finding in one line."""
    likely = f"; likely: {', '.join(f.causes)}" if f.causes else ""
    return f"{f.message}{likely}" + (f"; next: {', '.join(f.actions)}" if f.actions else "")


def warnings(findings: Iterable[Finding], color: bool = False) -> list[str]:
    """Return at most three lines per warning: message, likely causes, next steps.

    Args:
        findings: findings of any severity.
        color: highlight the severity by an escape sequence of a terminal.
    """
    lines: list[str] = []
    for f in findings:
        if f.warns:
            name = f"\033[1;33m{f.severity.name}\033[0m" if color else f.severity.name
            lines.append(f"{name} {f.code}  {f.message}")
            lines += [f"        Likely: {', '.join(f.causes)}"] if f.causes else []
            lines += [f"        Next:   {', '.join(f.actions)}"] if f.actions else []
    return lines


def remarks(findings: Iterable[Finding]) -> list[str]:
    """Return one line per finding that is no warning."""
    return [f"  {line(f)}" for f in findings if not f.warns]
