"""Rows of verbs: the example of docs/contributing.md is one by a file and a row; no other code knows a verb by name."""

import json
import re
import types
from pathlib import Path
from typing import Any

import pytest

from benchmarks.pages import commands
from jaxnav.app import cli
from jaxnav.app.jobs import printed as completion
from jaxnav.app.verbs import VERBS

ROOT = Path(__file__).parents[2]


@pytest.fixture
def length(monkeypatch):
    """The verb of docs/contributing.md, a row."""
    text = (ROOT / "docs" / "contributing.md").read_text()
    module = types.ModuleType("length")
    exec(re.search(r"A verb is a row.*?```python\n(.*?)```", text, re.S)[1], module.__dict__)
    monkeypatch.setitem(VERBS, "length", module.VERB)


def test_a_verb_is_one_file_and_one_row(length, tmp_path, capsys):
    source, out = tmp_path / "drive", tmp_path / "out"
    small = ["--set", "data.options.duration_s=20", "--quiet"]
    assert cli.main(["simulate", "--data", "urban_short", "--out", str(source), *small]) == 0
    assert cli.main(["length", str(source), "--km", "--json", "--out", str(out), "--set", "data.start=5"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["verb"] == "length" and abs(said["metrics"]["duration_s"] - 20) < 0.2
    about = json.loads((out / "run.json").read_text())
    assert set(about["config"]) == {"seed", "data"} and about["metrics"] == said["metrics"]
    assert "## jaxnav length" in commands.page() and "`--km`" in commands.page()
    assert "length" in completion.script(cli.make_parser(), "bash")
    assert cli.main(["length"]) == 2 and "required: PATH" in capsys.readouterr().err


def test_no_other_code_knows_a_verb_by_its_name():
    """The command line and what it writes turn on rows alone."""
    named = re.compile(rf"""\bverb (==|!=|(not )?in \()|["']({"|".join(VERBS)})["'] (==|!=)""")
    for path in (ROOT / "jaxnav" / "app").glob("*.py"):
        found = [line for line in path.read_text().splitlines() if named.search(line)]
        assert not found, (path.name, found)


SET = [(verb.name, a.name) for verb in VERBS.values() for a in verb.arguments if a.setting]
WORDS = {"--filter": "ekf9", "--for": "kfgins", "--data": "urban_short", "path": "drive", "--unseen": "a, b"}


@pytest.mark.parametrize("verb, name", SET)
def test_an_argument_sets_its_setting(verb, name):
    argument = next(a for a in VERBS[verb].arguments if a.name == name)
    text = WORDS.get(name, "7")
    given = [name] * name.startswith("-") + [text] * bool(argument.value)
    needed = ["drive"] if name != "path" and any(a.name == "path" for a in VERBS[verb].arguments) else []
    found: Any = cli.resolve(cli.make_parser().parse_args([verb, *given, *needed]))
    for key in argument.setting.split("."):  # options are a table
        found = found[key] if isinstance(found, dict) else getattr(found, key)
    expected = argument.type(text) if argument.value else True
    assert found == (tuple(expected) if isinstance(expected, list) else expected)
