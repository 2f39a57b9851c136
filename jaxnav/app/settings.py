"""Every setting, its default, its limits and its description: read from the configuration's source.

The remark next to a field there is the user's text, so that it is written once.
"""

import ast
import dataclasses
import io
import tokenize
from pathlib import Path
from typing import Any, NamedTuple

from jaxnav.app import config
from jaxnav.filters.border import KEYS, NAMES, user_value
from jaxnav.filters.parameters import UNITS
from jaxnav.io.toml import inline, to_toml
from jaxnav.measurements import MEASUREMENTS
from jaxnav.states.table import BIASES, STATES

HEAD = "## All settings"
PAGE = """`jaxnav config` prints this as a file to fill in; `--set section.key=value` sets one. Defaults are shown.
A row of `[states]` or `[measurements]` is a table: `[states.wind]`, `--set states.wind.sd_mps=3`."""


class Setting(NamedTuple):
    """One key of the configuration."""

    name: str  # without its section
    default: Any
    words: str


class Section(NamedTuple):
    """One table of the configuration; without a name, the keys above all tables."""

    name: str
    words: str
    settings: list[Setting]


def sections() -> list[Section]:
    """All of it, in the order of `jaxnav.app.config.Config`; a row of [states] or [measurements] is one setting."""
    said, found = _remarks(), []
    top = Section("", "", [])
    found.append(top)
    for field in dataclasses.fields(config.Config):
        default = getattr(config.Config(), field.name)
        if not dataclasses.is_dataclass(default):
            words = "of all that is random" if field.name == "seed" else config.MODEL_HELP.get(field.name, "")
            top.settings.append(Setting(field.name, default, words))
            continue
        kind: Any = type(default)
        rows = [
            Setting(
                f.name, _default(field.name, f.name, getattr(default, f.name)), _words(kind, field.name, f.name, said)
            )
            for f in dataclasses.fields(kind)
        ]
        found.append(Section(field.name, " ".join((kind.__doc__ or "").split()), rows))
    return found


def _default(section: str, name: str, value: Any) -> Any:
    """Return a setting's default; of a row, a table of its keys with the row's values in a user's units."""
    if not dataclasses.is_dataclass(value):
        return value
    row: Any = STATES[name] if section == "states" else MEASUREMENTS[name]
    leaves = [f"{section}.{name}.{leaf}" for leaf in row.defaults._fields]
    said = [(NAMES[leaf].rpartition(".")[2], leaf) for leaf in leaves if leaf in NAMES]
    values = {key: user_value(leaf, getattr(row.defaults, leaf.rpartition(".")[2])) for key, leaf in said}
    return {key: float(f"{v:.4g}") if isinstance(v, float) else v for key, v in values.items()}


def _words(kind: type, section: str, name: str, said: dict[tuple[str, str], str]) -> str:
    """Return the remark next to a field, or the text of its row; with its limits."""
    if section == "states":
        return _listed(STATES[name].axes) + ("; by the datasheet of filter.grade" if name in BIASES else "")
    if section == "measurements":
        return _listed(MEASUREMENTS[name].channels)
    words = said.get((kind.__name__, name), "")
    unit = UNITS.get(KEYS.get(f"{section}.{name}", ""))
    if unit is not None:
        many = "one number, one an axis, or a lower triangular matrix" if unit.root else "one number or one an axis"
        words = ", ".join(part for part in (unit.text, many if unit.shape else "one number") if part)
    low_high = config.LIMITS.get(f"{section}.{name}")
    return words + ("" if low_high is None else f" ({low_high[0]:g} to {low_high[1]:g})").lstrip("" if words else " ")


def _listed(names: tuple[str, ...]) -> str:
    """``east, north, up``; of many the first and the last."""
    return ", ".join(names) if len(names) < 10 else f"{names[0]} to {names[-1]}"


def _remarks() -> dict[tuple[str, str], str]:
    """By class and field, the remark next to it, with comment lines right above and, indented, below."""
    text = Path(config.__file__).read_text(encoding="utf-8")
    remarks, alone = {}, set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            remarks[token.start[0]] = token.string.removeprefix("#")
            if not token.line[: token.start[1]].strip():
                alone.add(token.start[0])
    found = {}
    for node in ast.parse(text).body:
        if not isinstance(node, ast.ClassDef):
            continue
        for field in node.body:
            if not (isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)):
                continue
            first, last = field.lineno, field.end_lineno or field.lineno
            above, below = first - 1, last + 1
            while above in alone and not remarks[above].startswith("   "):
                above -= 1
            while below in alone and remarks[below].startswith("   "):
                below += 1
            lines = [remarks[i] for i in range(above + 1, below) if i in remarks]
            found[node.name, field.target.id] = " ".join(" ".join(lines).split())
    return found


def commented() -> str:
    """Return a configuration with every setting, commented out."""
    lines = ["# Every setting of jaxnav with its default; remove the comment mark to set one.", ""]
    for section in sections():
        if section.name:
            lines += ["", f"# {section.words}", f"[{section.name}]"]
        for s in section.settings:
            text = _toml(s.default)
            value = f"#{s.name} = {text}" if text else f"#{s.name} ="
            lines.append(f"{value}{'  # ' + s.words if s.words else ''}")
    return "\n".join(lines) + "\n"


def page() -> str:
    """Return the same as markdown: the generated part of docs/settings.md."""
    lines = [HEAD, "", PAGE]
    for section in sections():
        lines += ["", f"### {f'[{section.name}]' if section.name else 'Above all tables'}", ""]
        lines += [section.words, ""] if section.words else []
        lines += ["| key | default | |", "|---|---|---|"]
        for s in section.settings:
            text = _toml(s.default)
            lines.append(f"| `{s.name}` | {f'`{text}`' if text else ''} | {s.words.replace('|', '/')} |")
    return "\n".join(lines) + "\n"


def _toml(value: Any) -> str:
    """Return a default as TOML; nothing where there is none."""
    if value is None:
        return ""
    if isinstance(value, dict):
        return inline(value) if value else "{}"
    return to_toml({"v": value}).removeprefix("v = ").strip()
