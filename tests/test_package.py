"""The wheel: built from this checkout, used in an environment that knows nothing of it."""

import json
import os
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests import conftest

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def environment(tmp_path_factory):
    """A python whose jaxnav comes from the wheel, and what that depends on from here; the wheel's version."""
    home = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "hatchling", "build", "--target", "wheel", "--directory", str(home)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True, timeout=120)
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(home / "env")], check=True, timeout=120)
    [site] = (home / "env").glob("[Ll]ib/**/site-packages")
    [wheel] = home.glob("*.whl")
    with zipfile.ZipFile(wheel) as packed:
        packed.extractall(site)
    # a folder that a .pth names is searched, but the .pth of this checkout in it is not read
    (site / "here.pth").write_text(sysconfig.get_path("purelib") + "\n")
    found = list((home / "env").glob("*/python*"))
    return next(p for p in found if p.stem == "python"), wheel.name.split("-")[1], home


def ask(environment, code):
    python, _, home = environment
    alone = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    return subprocess.run(
        [python, "-c", code], cwd=home, env=alone, capture_output=True, text=True, timeout=200, check=True
    ).stdout


def test_everything_that_is_imported_is_in_the_wheel(environment):
    """Every module of the checkout is there, with the marker that its types can be read, and no test or benchmark."""
    code = "import jaxnav, tuning, pathlib; print(pathlib.Path(jaxnav.__file__).parents[1])"
    site = Path(ask(environment, code).strip())
    assert environment[2] in site.parents
    for package in ("jaxnav", "tuning"):
        files = {
            str(p.relative_to(ROOT)) for p in (ROOT / package).rglob("*") if p.suffix in (".py", ".typed", ".json")
        }
        assert files <= {str(p.relative_to(site)) for p in (site / package).rglob("*")}
    assert not (site / "tests").exists() and not (site / "benchmarks").exists()


@pytest.mark.full
def test_the_installed_command_line_filters(environment):
    code = """
from jaxnav.app import cli
import jaxnav, json
run = ["filter", "--data", "urban_short", "--out", "run", "--quiet", "--set", "filter.cov_stride=25"]
few = ["--set", "data.options.duration_s=30", "--set", "out.figures=none"]
print(json.dumps([cli.main([*run, *few]), jaxnav.__version__]))
"""
    rc, version = json.loads(ask(environment, code).splitlines()[-1])
    assert rc == 0 and version == environment[1]
    about = json.loads((environment[2] / "run" / "run.json").read_text())
    assert about["versions"]["jaxnav"] == version and about["git"] is None


def test_a_row_selects_its_tests():
    item = lambda name, ids: SimpleNamespace(name=name, **({"callspec": SimpleNamespace(id=ids)} if ids else {}))
    items = [item("a", "barometer-frd"), item("b", "barometer_bias"), item("c", ""), item("d", "tangent-barometer")]
    out = []
    hook = SimpleNamespace(pytest_deselected=lambda items: out.extend(items))
    conftest.pytest_collection_modifyitems(SimpleNamespace(getoption=lambda name: "barometer", hook=hook), items)
    assert [i.name for i in items] == ["a", "d"] and [i.name for i in out] == ["b", "c"]
