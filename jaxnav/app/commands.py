"""docs/commands.md from the rows of verbs: ``python -m jaxnav.app.commands > docs/commands.md``."""

from jaxnav.app.cli import SHARED
from jaxnav.app.verb import Argument
from jaxnav.app.verbs import VERBS


def page() -> str:
    """Every verb and its arguments, as markdown."""
    lines = ["# Commands", "", "Every verb takes:", *_rows(SHARED)]
    for verb in VERBS.values():
        lines += ["", f"## jaxnav {verb.name}", "", verb.help[0].upper() + verb.help[1:] + ".", *_rows(verb.arguments)]
        if verb.sections:
            lines += ["", f"Reads {', '.join(f'`[{name}]`' for name in verb.sections)} of the [settings](settings.md)."]
    return "\n".join(lines) + "\n"


def _rows(arguments: tuple[Argument, ...]) -> list[str]:
    """A table of arguments."""
    if not arguments:
        return []
    rows = [f"| `{_usage(a)}` | {a.help.replace('|', '/')} |" for a in arguments]
    return ["", "| argument | |", "|---|---|", *rows]


def _usage(argument: Argument) -> str:
    """How an argument is written."""
    value = "/".join(argument.more.get("choices", ())) or argument.value.replace("|", "/")
    return f"{argument.name} {value}".strip() if argument.name.startswith("-") else value or argument.name


if __name__ == "__main__":
    print(page(), end="")
