"""Every setting, its default, its limits and its description: as the configuration's fields state them."""

import dataclasses
import math
from typing import Annotated, Any, NamedTuple, get_args, get_origin

from msgspec import Meta

from jaxnav.app import config
from jaxnav.filters.border import KEYS, NAMES, user_value
from jaxnav.filters.parameters import UNITS
from jaxnav.io.toml import inline, limits, to_toml
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
    top, hints = Section("", "", []), config.hints_of(config.Config)
    found = [top]
    for field in dataclasses.fields(config.Config):
        default = getattr(config.Config(), field.name)
        if not dataclasses.is_dataclass(default):
            words = _said(hints[field.name]) or config.MODEL_HELP.get(field.name, "")
            top.settings.append(Setting(field.name, default, words))
            continue
        kind: Any = type(default)
        rows = [
            Setting(name, _default(field.name, name, getattr(default, name)), _words(field.name, name, hint))
            for name, hint in config.hints_of(kind).items()
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


def _words(section: str, name: str, hint: Any) -> str:
    """Return the words of a field, or the text of its row; with its limits."""
    if section == "states":
        return _listed(STATES[name].axes) + ("; by the datasheet of filter.grade" if name in BIASES else "")
    if section == "measurements":
        return _listed(MEASUREMENTS[name].channels)
    unit = UNITS.get(KEYS.get(f"{section}.{name}", ""))
    if unit is None:
        return _said(hint)
    many = "one number, one an axis, or a lower triangular matrix" if unit.root else "one number or one an axis"
    words = ", ".join(part for part in (unit.text, many if unit.shape else "one number") if part)
    return words + ("" if math.isinf(unit.most) else f" ({-unit.most:g} to {unit.most:g})")


def _said(hint: Any) -> str:
    """Return the words of a field and its limits; nothing of one without."""
    for meta in get_args(hint)[1:] if get_origin(hint) is Annotated else ():
        if isinstance(meta, Meta) and meta.description:
            low, high = limits(hint)
            return meta.description + ("" if low is None else f" ({low:.12g} to {high:.12g})")
    return ""


def _listed(names: tuple[str, ...]) -> str:
    """``east, north, up``; of many the first and the last."""
    return ", ".join(names) if len(names) < 10 else f"{names[0]} to {names[-1]}"


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
