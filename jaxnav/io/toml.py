"""Values of TOML and the types of fields: conversion, expected values in words, line of a key, writing."""

import json
import math
import re
import types
import typing
from collections.abc import Callable, Mapping
from typing import Any

import msgspec


def converted(value: Any, hint: Any) -> Any:
    """Return a value of a file in a type, with whole numbers as such of a float and lists as tuples.

    Raises:
        msgspec.ValidationError: it is of another type, not a number, or out of the limits of the type.
    """
    try:
        return msgspec.convert(_changed(value, _no_nan), hint)
    except msgspec.ValidationError:  # where a number is asked for, "inf" is one: strict JSON has no other way
        return msgspec.convert(_changed(_changed(value, _no_nan), lambda v: math.inf if v == "inf" else v), hint)


def _no_nan(value: Any) -> Any:
    if isinstance(value, float) and math.isnan(value):
        raise msgspec.ValidationError("not a number")
    return value


def _changed(value: Any, change: Callable[[Any], Any]) -> Any:
    """Return tables and lists with other numbers and texts."""
    if isinstance(value, Mapping):
        return {k: _changed(v, change) for k, v in value.items()}
    return [_changed(v, change) for v in value] if isinstance(value, (list, tuple)) else change(value)


def describe(hint: Any, many: bool = False) -> str:
    """Return the values that a type takes, in words; ``many``: several of them."""
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Annotated:
        low, high = limits(hint) if args[0] in WORDS else (None, None)
        return describe(args[0], many) + ("" if low is None else f" in [{low:.12g}, {high:.12g}]")
    if origin in (typing.Union, types.UnionType):
        return " or ".join(describe(a, many) for a in args if a is not type(None))
    if origin is tuple:
        return f"{'lists' if many else 'a list'} of {describe(args[0], many=True)}"
    if origin is dict:
        return "a table" if args[1] is Any else f"a table of {describe(args[1], many=True)}"
    one, several = WORDS.get(hint, (str(hint), str(hint)))
    return several if many else one


WORDS: dict[Any, tuple[str, str]] = {
    float: ("a number", "numbers"),
    int: ("a whole number", "whole numbers"),
    bool: ("true or false", "truths"),
    str: ("text", "texts"),
}


def limits(hint: Any) -> tuple[float | None, float | None]:
    """Return the smallest and the largest value of a type or of its parts, None where there is none."""
    for part in typing.get_args(hint):
        own = isinstance(part, msgspec.Meta) and part.ge is not None
        found = (part.ge, math.inf if part.le is None else part.le) if own else limits(part)
        if found[0] is not None:
            return found
    return None, None


def place(where: str, text: str, name: str) -> str:
    """``file: line 7`` where the key's line can be found in the text."""
    section, _, key = name.rstrip(".").rpartition(".")
    inside = not section
    for i, line in enumerate(text.splitlines(), start=1):
        head = re.match(r"\s*\[+\s*([^\]]+?)\s*\]", line)
        if head:
            inside = head[1] == section
            if head[1] in (name, name.rstrip(".")):
                return f"{where}: line {i}"
        elif inside and re.match(rf'\s*"?{re.escape(key)}"?\s*[=.]', line):
            return f"{where}: line {i}"
    return where


def plain(value: Any) -> Any:
    """Return the value in types of TOML and JSON: tables without None, lists for tuples."""
    if isinstance(value, Mapping):
        return {k: plain(v) for k, v in value.items() if v is not None}
    return [plain(v) for v in value] if isinstance(value, (list, tuple)) else value


def to_toml(tree: Mapping[str, Any], section: str = "") -> str:
    """Return a tree as TOML text."""
    lines = [f"{quoted(k)} = {cell(v)}" for k, v in tree.items() if not isinstance(v, Mapping)]
    if section and (lines or not tree):
        lines = [f"[{section}]", *lines]
    text = "\n".join(lines) + "\n" if lines else ""
    for key, value in tree.items():
        if isinstance(value, Mapping):
            name = f"{section}.{quoted(key)}" if section else quoted(key)
            text += ("\n" if text else "") + to_toml(value, name)
    return text


def inline(table: Mapping[str, Any]) -> str:
    """Return a table as TOML in one line."""
    return f"{{ {', '.join(f'{quoted(k)} = {cell(v)}' for k, v in table.items())} }}"


def quoted(key: str) -> str:
    """Return a key as TOML writes it."""
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else json.dumps(key)


def cell(value: Any) -> str:
    """Return a value as TOML in one line."""
    if isinstance(value, Mapping):
        return inline(value)
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(cell(v) for v in value)}]"
    return json.dumps(value) if isinstance(value, str) else repr(value)
