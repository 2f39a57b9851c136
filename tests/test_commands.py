"""Every command of README and docs: it parses as it is printed, and (slow) those of the command line run to the end."""

import argparse
import importlib
import os
import re
import shlex
from pathlib import Path

import pytest

from benchmarks.__main__ import HOME
from jaxnav.app import cli

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
RECORDINGS = ("drive.bag", "my_drive")  # what a page calls the reader's own


def blocks(page, language):
    return re.findall(rf"```{language}\n(.*?)```", page.read_text(), re.S)


def commands(page, start):
    """What begins with these words, in blocks of a shell and between backticks, without remarks."""
    lines = [line for block in blocks(page, "(?:sh|bash|console)?") for line in block.splitlines()]
    quoted = re.findall(r"`([^`\n]+)`", re.sub(r"```.*?```", "", page.read_text(), flags=re.S))
    found = [re.sub(r"\s#.*", "", text).strip() for text in (*lines, *quoted)]
    return [text for text in dict.fromkeys(found) if text.startswith(start + " ")]


def whole(text):
    """Not of the kind `jaxnav tune ...`, nor a verb's name alone in a sentence."""
    return "..." not in text and "|" not in text and not re.search(r"\b[A-Z]{2,}\b|=\.\.\.", text)


class Parsed(Exception):
    pass


@pytest.mark.parametrize("page", PAGES, ids=[p.stem for p in PAGES])
def test_commands_parse(page, monkeypatch):
    for text in commands(page, "jaxnav"):
        if whole(text) and len(text.split()) > 2:
            cli.make_parser().parse_args(shlex.split(text.split(";")[0])[1:])
    targets = re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(), re.M)
    for text in commands(page, "make"):
        assert text.split()[1] in targets, text
    real = argparse.ArgumentParser.parse_args

    def parse(self, args=None, namespace=None):
        real(self, args, namespace)
        raise Parsed

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parse)
    for text in commands(page, "python -m benchmarks"):
        names, options = re.fullmatch(r"((?:\w+ \| )*\w+)(.*)", text.removeprefix("python -m benchmarks ")).groups()
        for name in names.split(" | "):
            if name != "NAME":
                assert name in HOME, text
                with pytest.raises(Parsed):
                    importlib.import_module(f"benchmarks.{HOME[name]}.{name}").main(shlex.split(options))


@pytest.mark.parametrize("name", HOME)
def test_every_benchmark_is_there(name):
    assert callable(importlib.import_module(f"benchmarks.{HOME[name]}.{name}").main)


def run_of(page):
    return [text for block in blocks(page, "(?:sh|bash)") for text in block.splitlines() if text.startswith("jaxnav ")]


@pytest.mark.slow
@pytest.mark.timeout(1500)
@pytest.mark.parametrize("page", [p for p in PAGES if run_of(p)], ids=lambda p: p.stem)
def test_the_shell_s_lines_run_one_after_the_other(page, tmp_path, monkeypatch, capsys):
    """As a user would who has two minutes of a drive, in a folder with the docs in it."""
    if "JAXNAV_DATA_DIR" not in os.environ and "docs/recipes" in page.read_text():
        pytest.skip("needs the recordings of JAXNAV_DATA_DIR")
    monkeypatch.chdir(tmp_path)
    for name in ("docs", "examples"):
        (tmp_path / name).symlink_to(ROOT / name)
    lines = [re.sub(r"\s#.*", "", text) for text in run_of(page) if "..." not in text]
    for name in RECORDINGS:
        if any(name in line for line in lines):
            long = ["--set", "data.options.duration_s=150.0"]
            assert cli.main(["simulate", "--data", "urban_short", "--out", name, "--quiet", *long]) == 0
    for line in lines:
        assert cli.main(shlex.split(line)[1:]) == 0, f"{line}\n{capsys.readouterr()}"
