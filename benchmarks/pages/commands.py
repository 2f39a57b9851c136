"""Pages docs/commands.md and docs/findings.md from rows: ``python -m benchmarks.pages.commands [findings]``."""

import sys

from benchmarks.pages.examples import EXAMPLES
from jaxnav.app.cli import SHARED
from jaxnav.app.verb import Argument
from jaxnav.app.verbs import VERBS
from jaxnav.findings import finding
from jaxnav.kinds import KINDS

FINDINGS = """Remarks of `jaxnav check` and of a run. They are in `Solution.findings`, check.json, metrics.json, on the
terminal and in the report. Each has a stable code, a severity, a subject, value and limit with their unit, likely
causes and actions."""


def page() -> str:
    """Every verb and its arguments, as markdown."""
    lines = ["# Commands", "", "Every verb takes:", *_rows(SHARED)]
    for verb in VERBS.values():
        lines += ["", f"## jaxnav {verb.name}", "", verb.help[0].upper() + verb.help[1:] + ".", *_rows(verb.arguments)]
        if verb.sections:
            lines += ["", f"Reads {', '.join(f'`[{name}]`' for name in verb.sections)} of the [settings](settings.md)."]
    return "\n".join(lines) + "\n"


def _rows(arguments: tuple[Argument, ...]) -> list[str]:
    """Return a table of arguments."""
    if not arguments:
        return []
    rows = [f"| `{_usage(a)}` | {a.help.replace('|', '/')} |" for a in arguments]
    return ["", "| argument | |", "|---|---|", *rows]


def _usage(argument: Argument) -> str:
    """How an argument is written."""
    value = "/".join(argument.more.get("choices", ())) or argument.value.replace("|", "/")
    return f"{argument.name} {value}".strip() if argument.name.startswith("-") else value or argument.name


def findings() -> str:
    """Every kind of finding, as markdown."""
    lines = [
        "# Findings",
        "",
        FINDINGS,
        "",
        "| code | severity | example | likely causes | next |",
        "|---|---|---|---|---|",
    ]
    for code, kind in KINDS.items():
        example = finding(code, **EXAMPLES[code])
        cells = (example.message, ", ".join(example.causes), ", ".join(example.actions))
        lines.append(f"| `{code}` | {kind.severity.value} | {' | '.join(text.replace('|', '/') for text in cells)} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    print(findings() if sys.argv[1:] == ["findings"] else page(), end="")
