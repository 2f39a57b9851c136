"""The library user's page runs as it is printed; the other pages quote files, list names and link as they say."""

import re
import tomllib
from pathlib import Path

import numpy as np
import pytest

import jaxnav
import tuning
from jaxnav.app import config, prepare
from jaxnav.app.jobs import tune
from jaxnav.filters.catalogue import build
from jaxnav.states.grades import GRADES

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "library.md"
SET = re.compile(r"""--set ['"]?(?!section)([a-z_.]+)=(\[[^\]]*\]|{[^}]*}|[^\s'"`]+)""")
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def test_library_page_runs_and_does_what_it_says(capsys):
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.S)
    assert len(blocks) == 7
    assert sum(bool(line.strip()) for line in blocks[1].splitlines()) <= 15
    assert len(blocks[2].splitlines()) <= 30
    space: dict = {}
    for block in blocks:
        exec(block, space)
    truth = space["drive"].truth
    error = np.abs(space["solution"].lla[-1] - truth.lla[-1]) * 6.4e6
    assert error[:2].max() < 10.0 and bool(space["info"].ok.all())
    history = space["tuned"].history
    assert history[-1]["loss"] < history[0]["loss"]
    # the rule's knee at infinity is the Kalman filter
    jax, np_ = space["jax"], space["jnp"]
    params = space["params"]._replace(rule=space["Huber"](np_.array(1e9)))
    wide = jax.jit(space["jaxnav"].run, static_argnums=0)(space["robust"], params, space["nav"], space["packed"].epochs)
    np.testing.assert_allclose(wide.nav.pos, space["info"].nav.pos, rtol=1e-14, atol=1e-14)
    assert space["gated_params"].rule.rule.kd == 0.1
    assert space["about"]["runs"] == 8 and space["band"].shape == space["found"].course.t.shape


def test_what_is_quoted_is_the_file():
    quoted = re.findall(r'```python title="([^"]+)"\n(.*?)```', (ROOT / "docs" / "contributing.md").read_text(), re.S)
    assert len(quoted) == 2
    for name, text in quoted:
        assert text == (ROOT / name).read_text(), name


@pytest.mark.parametrize("page", [p for p in PAGES if p.name != "formats.md"], ids=lambda page: page.name)
def test_configurations_and_their_keys_are_known(page):
    """A configuration on a page gives parameters and what is tuned; each --set names a setting."""
    text = page.read_text()
    for key, value in SET.findall(text):
        config.resolve([(page.name, config.parse_set(f"{key}={value}"))])
    for block in re.findall(r"```toml\n(.*?)```", text, re.S):
        c = config.resolve([(page.name, tomllib.loads(block))])
        params = prepare.base_params(c, GRADES["consumer"], np.zeros(3))
        filt = build(c.filter.name, prepare.measurements_of(c), states=c.filter.states)
        tune.free_of(c, filt, params, tune.FREE_RECORDED)


def test_every_public_name_is_in_the_api_and_has_a_docstring():
    listed = re.findall(r"^ +- (\w+)$", (ROOT / "docs" / "api.md").read_text(), re.M)
    assert set(listed) >= {*jaxnav.__all__, *tuning.__all__}
    for name in jaxnav.__all__:
        thing = getattr(jaxnav, name)
        if callable(thing):
            assert (thing.__doc__ or "").strip(), name


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        found = (page.parent / path).resolve() if path else page
        assert found.exists(), f"{page.name}: {target}"
        if anchor:
            heads = re.findall(r"^#+ (.+)$", found.read_text(), re.M)
            slugs = [re.sub(r"[^\w\- ]", "", head.lower()).strip().replace(" ", "-") for head in heads]
            assert anchor in slugs, f"{page.name}: {target}"


def test_the_readme_is_read_in_some_minutes():
    assert len((ROOT / "README.md").read_text().split()) <= 800
