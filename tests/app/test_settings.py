"""The list of settings: whole, readable as a configuration, and the page of the docs is it."""

import dataclasses
import re
import tomllib
import typing
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.pages import commands
from jaxnav.app import cli, config, settings
from jaxnav.filters import border
from jaxnav.filters.parameters import datasheet_params, strong
from jaxnav.io.toml import limits
from jaxnav.states.grades import GRADES
from jaxnav.states.table import STATES
from jaxnav.types import StateParams

DOCS = Path(__file__).parents[2] / "docs"


def test_every_setting_is_there_and_says_what_it_is():
    found = {(s.name, key.name): key.words for s in settings.sections() for key in s.settings}
    for section in dataclasses.fields(config.Config):
        if dataclasses.is_dataclass(section.default):
            assert {(section.name, f.name) for f in dataclasses.fields(section.default)} <= set(found)
    assert (
        found["filter", "cov_stride"].startswith("the error dynamics see means")
        and "1 to 1000" in found["filter", "cov_stride"]
    )
    assert found["noise", "gyro_deg_per_sqrt_hour"].startswith("deg/sqrt(h), one number, one an axis")
    assert "tempered for recordings" in found["tune", "method"]
    assert "`tuning.recordings.recorded`: tempered" in found["tune", "method"]
    assert all(found.values())
    assert found["tune", "prior"].endswith("else in the parameter's unit")


def test_numbers_have_limits():
    """But times of a recording, and sd, whose limits are those of the parameters that they set."""
    numbers = {
        f"{section.name}.{name}"
        for section in dataclasses.fields(config.Config)
        if dataclasses.is_dataclass(section.default)
        for name, hint in config.hints_of(type(section.default)).items()
        if (*typing.get_args(hint), None)[0] in (int, float, float | None) and limits(hint)[0] is None
    }
    assert numbers - set(border.KEYS) == {"data.start", "data.stop"}


def test_the_printed_page_is_a_configuration_with_the_defaults():
    """Nothing of it is set as it stands; with the marks taken away it is what one has without a file."""
    text = settings.commented()
    assert all(not value for value in tomllib.loads(text).values())
    bare = re.sub(r"^#(\w+ =) *(?=$|  #).*$", "", text, flags=re.MULTILINE)  # those without a default
    tree = tomllib.loads(re.sub(r"^#(?=\w+ =)", "", bare, flags=re.MULTILINE))
    c = config.resolve([("all", tree)])
    assert dataclasses.replace(c, states=config.States(), measurements=config.Measurements()) == config.resolve([])
    rows = {name: StateParams(*row.defaults) for name, row in STATES.items()}
    params = datasheet_params(GRADES["consumer"])._replace(states=strong(rows))
    same = border.override(params, config.as_dict(c))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, jnp.broadcast_to(b, a.shape), rtol=1e-3), same, params)


def test_the_verb_prints_it_and_the_page_is_it(capsys):
    assert cli.main(["config"]) == 0
    assert capsys.readouterr().out == settings.commented()
    by_hand, head, rest = (DOCS / "settings.md").read_text().partition(settings.HEAD)
    assert head + rest == settings.page(), (
        "python -m jaxnav config --markdown: the part of docs/settings.md from its head"
    )
    known = {f"{s.name}.{k.name}" for s in settings.sections() for k in s.settings}
    named = set(re.findall(r"^\| `([a-z_.]+)` \|", by_hand, flags=re.MULTILINE))
    rows = {name for name in named if name.startswith(("states.", "measurements."))}
    assert 20 <= len(named) <= 30 and named - rows <= known and rows <= set(border.KEYS)
    assert (DOCS / "commands.md").read_text() == commands.page(), (
        "python -m benchmarks.pages.commands > docs/commands.md"
    )
    assert (DOCS / "findings.md").read_text() == commands.findings(), "python -m benchmarks.pages.commands findings"


def test_the_compiled_programs_are_counted_and_removed(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("JAXNAV_CACHE_DIR", str(tmp_path / "c"))
    own, mine = tmp_path / "c" / "jaxlib-0.10.2-x86_64", tmp_path / "c" / "thesis.pdf"
    own.mkdir(parents=True)
    (own / "program").write_bytes(b"x" * 2**20)
    mine.write_text("not ours")
    (tmp_path / "c" / "photos").mkdir()
    assert cli.main(["info"]) == 0
    assert f"compiled programs: 1 files, 1.0 MiB, in {tmp_path / 'c'}\n" in capsys.readouterr().out
    assert cli.main(["info", "--clear-cache"]) == 0 and not own.exists()
    assert capsys.readouterr().out == f"compiled programs removed: 1 files, 1.0 MiB, in {tmp_path / 'c'}\n"
    assert mine.exists() and (tmp_path / "c" / "photos").is_dir()
    monkeypatch.setenv("JAXNAV_CACHE_DIR", "")
    assert cli.main(["info"]) == 0 and "no compiled programs are kept" in capsys.readouterr().out
