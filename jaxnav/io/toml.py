"""Values of TOML and the types of fields: conversion, expected values in words, line of a key, writing."""

import json
import math
import re
import types
import typing
from collections.abc import Mapping
from typing import Any


def convert(value: Any, hint: Any) -> tuple[bool, Any]:
    """Whether the value is of the type, and the value in it: int to float, list to tuple."""
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        tries = [convert(value, arg) for arg in args]
        return next((t for t in tries if t[0]), (False, value))
    if hint is float:
        value = math.inf if value == "inf" else value  # strict JSON has none
        good = isinstance(value, (int, float)) and not isinstance(value, bool) and not math.isnan(value)
        return good, float(value) if good else value
    if hint is int:
        return isinstance(value, int) and not isinstance(value, bool), value
    if origin is tuple:
        if not isinstance(value, (list, tuple)):
            return False, value
        parts = [convert(v, args[0]) for v in value]
        return all(ok for ok, _ in parts), tuple(v for _, v in parts)
    if origin is dict:
        good = isinstance(value, Mapping)
        table = {k: convert(v, args[1]) for k, v in value.items()} if good else {}
        return good and all(ok for ok, _ in table.values()), {k: v for k, (_, v) in table.items()}
    if hint is Any:
        return True, value
    return (value is None) if hint is type(None) else isinstance(value, hint), value


def describe(hint: Any) -> str:
    """Return the values that a type takes, in words."""
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(describe(a) for a in args if a is not type(None))
    if origin is tuple:
        return f"a list of ({describe(args[0])})" if typing.get_origin(args[0]) else f"a list of {_plural(args[0])}"
    if origin is dict:
        return "a table" if args[1] is Any else f"a table of {_plural(args[1])}"
    return {float: "a number", int: "a whole number", bool: "true or false", str: "text"}.get(hint, str(hint))


def _plural(hint: Any) -> str:
    return {float: "numbers", int: "whole numbers", str: "texts"}.get(hint, describe(hint))


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
