"""The library user's page runs as it is printed; the other pages quote files, list names and link as they say."""

import ast
import builtins
import contextlib
import importlib
import inspect
import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

import jaxnav
import tuning
from jaxnav.app import config, prepare, settings
from jaxnav.app.jobs import tune
from jaxnav.filters.catalogue import build
from jaxnav.kinds import KINDS
from jaxnav.measurements import MEASUREMENTS
from jaxnav.simulate.scenarios import SCENARIOS
from jaxnav.states.grades import GRADES
from jaxnav.states.table import STATES

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "library.md"
SET = re.compile(r"""--set ['"]?(?!section)([a-z_.]+)=(\[[^\]]*\]|{[^}]*}|[^\s'"`]+)""")
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


@pytest.mark.full
def test_library_page_runs_and_does_what_it_says(capsys):
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.S)
    assert len(blocks) == 9
    assert sum(bool(line.strip()) for line in blocks[7].splitlines()) <= 25
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
    learned = space["learned"]
    assert learned.loss < learned.history[0]["loss"] and np.abs(learned.params.adapter["out"]).max() > 0.0
    gains = space["gains"]
    assert gains.loss <= min(row["validation"] for row in gains.history if "validation" in row) + 1e-9
    # the rule's knee at infinity is the Kalman filter
    jax, np_ = space["jax"], space["jnp"]
    params = space["params"]._replace(rule=space["Huber"](np_.array(1e9)))
    wide = jax.jit(space["jaxnav"].run, static_argnums=0)(space["robust"], params, space["nav"], space["packed"].epochs)
    np.testing.assert_allclose(wide.nav.pos, space["info"].nav.pos, rtol=1e-14, atol=1e-14)
    assert space["gated_params"].rule.rule.kd == 0.1
    assert space["about"]["runs"] == 8 and space["band"].shape == space["found"].course.t.shape


def test_quoted_code_is_the_file():
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


def identifiers() -> set[str]:
    """Return every word of code and of its strings, library, benchmarks and tests, and every part of a file's name."""
    found: set[str] = set()
    for path in (p for folder in ("jaxnav", "tuning", "benchmarks", "tests") for p in (ROOT / folder).rglob("*.py")):
        found |= {*re.findall(r"[A-Za-z_]\w*", path.read_text(encoding="utf-8")), path.stem, path.parent.name}
    return found | {part for path in ROOT.glob("docs/**/*") for part in path.name.split(".")}


def members() -> dict[str, set[str]]:
    """Return names that modules and classes define, by the last part of the owner's name."""
    owners: dict[str, set[str]] = {}
    for path in (p for folder in ("jaxnav", "tuning", "benchmarks") for p in (ROOT / folder).rglob("*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for owner, body in (
            (path.stem, tree.body),
            *((n.name, n.body) for n in tree.body if isinstance(n, ast.ClassDef)),
        ):
            names = owners.setdefault(owner, set())
            for node in body:
                for name in ast.walk(node) if isinstance(node, ast.Assign | ast.AnnAssign) else ():
                    names |= {name.id} if isinstance(name, ast.Name) else set()
                names |= {node.name} if isinstance(node, ast.FunctionDef | ast.ClassDef) else set()
                names |= {a.asname or a.name for a in node.names} if isinstance(node, ast.ImportFrom) else set()
    return owners


def exists(name: str, words: set[str], owners: dict[str, set[str]], dotted: set[str]) -> bool:
    """Is a dotted name of a page one of the package, a setting, a file or a word of the sources?"""
    parts = name.split(".")
    if parts[0] in ("jaxnav", "tuning", "benchmarks"):
        for count in range(len(parts), 0, -1):
            with contextlib.suppress(ImportError):
                thing = importlib.import_module(".".join(parts[:count]))
                return all((thing := getattr(thing, part, None)) is not None for part in parts[count:])
        return False
    if name in dotted or parts[-1] in ("py", "csv", "json", "jsonl", "toml", "html", "png", "mat"):
        return True
    if len(parts) == 2 and parts[0] in owners and parts[1] not in owners[parts[0]] and parts[0] not in PARAMETERS:
        return False
    return all(part in words for part in parts)


PARAMETERS = {"noise", "mounting", "prior", "states", "measurements", "rule", "imu", "gnss", "system"}
PARAMETERS |= {*MEASUREMENTS, *STATES}
"""First parts of dotted names of parameters, and of other software's."""


FOREIGN = {"bias_walk", "EstimationModel", "jax.vmap", "gc.set_threshold", "v0.2.0"}  # of pyins, jax, python; a tag
COLUMNS = re.compile(r"[a-z_0-9]+_(rad|deg|degps|radps|mps|mps2|g|m|s|ut|degc)|(corr|pitch|heading)_.*")
"""Columns of CSV files, whose names are made of quantity and unit (tests/io/test_promises.py reads each)."""


def test_every_name_between_backticks_exists():
    words, owners = identifiers() | set(SCENARIOS) | FOREIGN, members()
    keys = {f"{section.name}.{key.name}" for section in settings.sections() for key in section.settings}
    words |= {key.rpartition(".")[2] for key in keys}
    functions = set.union(*owners.values()) | set(dir(builtins))
    unknown = []
    for page in PAGES:
        text = re.sub(r"```.*?```", "", page.read_text(), flags=re.S)
        for tick in re.findall(r"`([^`\n]+)`", text):
            name = re.fullmatch(r"([A-Za-z]\w*(?:\.\w+)*)(\(.*\))?", tick)
            column = page.name == "formats.md" and COLUMNS.fullmatch(tick)
            if not name or column or name[1] in FOREIGN:
                continue
            called = not name[2] or name[1].rpartition(".")[2] in functions  # what is called is defined
            if not called or not exists(name[1], words, owners, keys | set(KINDS)):
                unknown.append(f"{page.name}: {tick}")
    assert not unknown
    assert not exists("components.again", words, owners, set()) and not exists(
        "jaxnav.robustness", words, owners, set()
    )


def test_every_public_name_is_in_the_api_and_has_a_docstring():
    listed = re.findall(r"^ +- (\w+)$", (ROOT / "docs" / "api.md").read_text(), re.M)
    assert set(listed) >= {*jaxnav.__all__, *tuning.__all__}
    for name in jaxnav.__all__:
        thing = getattr(jaxnav, name)
        if callable(thing):
            assert (thing.__doc__ or "").strip(), name


def test_the_api_has_a_parameter_table_for_every_function():
    """Args of every function and method that the API pages list; D417 of ruff sees to each argument."""
    lacking = []
    for block in re.split(r"^::: ", (ROOT / "docs" / "api.md").read_text(), flags=re.M)[1:]:
        module = importlib.import_module(block.split("\n")[0].strip())
        listed = re.findall(r"^ +- (\w+)$", block, re.M) or [name for name in vars(module) if name[0] != "_"]
        for name in listed:
            thing = getattr(module, name)
            if getattr(thing, "__module__", "") != module.__name__:
                continue
            methods = [m for key, m in vars(thing).items() if key[0] != "_"] if inspect.isclass(thing) else [thing]
            for function in (getattr(m, "__func__", m) for m in methods):
                arguments = {*inspect.signature(function).parameters} - {"self", "cls"} if callable(function) else set()
                if inspect.isfunction(function) and arguments and "Args:" not in (function.__doc__ or ""):
                    lacking.append(f"{module.__name__}.{function.__qualname__}")
    assert not lacking


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
    assert len((ROOT / "README.md").read_text().split()) <= 600


def test_one_import_reaches_what_the_pages_use():
    """``import jaxnav, tuning``: every name that the page for users of the library and the notebooks take from them."""
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.S)
    for notebook in sorted((ROOT / "docs" / "notebooks").glob("*.ipynb")):
        blocks += ["".join(c["source"]) for c in json.loads(notebook.read_text())["cells"] if c["cell_type"] == "code"]
    taken = [
        f"{node.module}.{each.name}"
        for block in blocks
        for node in ast.walk(ast.parse(block))
        if isinstance(node, ast.ImportFrom) and str(node.module).split(".")[0] in ("jaxnav", "tuning")
        for each in node.names
    ]
    assert len(taken) > 20
    reach = f"import jaxnav, tuning\nfor name in {taken!r}:\n    eval(name)"
    subprocess.run([sys.executable, "-c", reach], check=True, cwd=ROOT)
