"""The house: its folders are the glossary, and what is below knows nothing of what is above."""

import ast
import contextlib
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

import jaxnav

ROOT = Path(__file__).parents[1] / "jaxnav"
ORDER = (
    "types", "kinds", "findings", "maths", "states", "strapdown", "measurements", "gnss", "io", "filters",
    "initialization", "checkup", "reading", "simulate", "analysis", "navigation", "now", "stream", "live", "app",
)  # fmt: skip


PARTS = {
    "core": ("types", "kinds", "findings", "maths", "states", "strapdown", "measurements", "filters", "initialization",
             "now", "stream", "live"),
    "recordings": ("gnss", "io", "checkup", "reading"),
    "studies": ("simulate", "analysis", "navigation", "app"),
}  # fmt: skip
"""Parts of the house, docs/architecture.md: each knows those before it alone. `tuning` is of the studies."""


def imported(path: Path) -> set[str]:
    """The parts of the package that a file imports."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "jaxnav":
            names = [node.module] if node.module != "jaxnav" else [f"jaxnav.{a.name}" for a in node.names]
            found |= {name.split(".")[1] for name in names}
    return found


def test_imports_go_downwards():
    upwards = []
    for path in ROOT.rglob("*.py"):
        part = path.relative_to(ROOT).parts[0].removesuffix(".py")
        if part in ORDER:
            upwards += [
                f"{path.relative_to(ROOT)}: {other}"
                for other in imported(path)
                if other in ORDER[ORDER.index(part) + 1 :]
            ]
    assert not upwards


def test_parts_know_those_before_them_alone():
    assert sorted(room for rooms in PARTS.values() for room in rooms) == sorted(ORDER)
    known: set[str] = set()
    for rooms in PARTS.values():
        known |= set(rooms)
        for room in rooms:
            home = ROOT / room
            for path in home.rglob("*.py") if home.is_dir() else [home.with_suffix(".py")]:
                assert imported(path) & set(ORDER) <= known, path


def test_the_root_is_what_the_order_says():
    """Rooms, the types and the three interfaces, `navigate`, `Stream` with its `Now`, and `Live`."""
    entries = {p.name.removesuffix(".py") for p in ROOT.iterdir() if p.name not in ("__pycache__", "py.typed")}
    assert entries - {"__init__", "__main__"} == set(ORDER)


def test_public_names_are_where_the_package_says():
    """What is imported when it is asked for is what a type checker is told, and is there."""
    tree = ast.parse((ROOT / "__init__.py").read_text())
    block = next(node for node in tree.body if isinstance(node, ast.If))
    told = {alias.name: node.module for node in block.body if isinstance(node, ast.ImportFrom) for alias in node.names}
    assert told == jaxnav._HOME
    assert all(getattr(jaxnav, name) is not None for name in jaxnav.__all__)
    with pytest.raises(AttributeError, match="no attribute 'bild'"):
        jaxnav.bild  # noqa: B018


def test_random_keys_come_first():
    """As in jax.random: functions that draw take the key, or the keys, before anything else."""
    for path in [*ROOT.rglob("*.py"), *(ROOT.parent / "tuning").glob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
                draw_state = [a.arg for a in node.args.args[1:] if ast.unparse(a.annotation or a) == "jax.Array"]
                assert not {"key", "keys"} & set(draw_state), (path.name, node.name)


def test_the_command_line_can_be_stopped_before_jax_is_there():
    code = "import sys, jaxnav.app.console; sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], timeout=60).returncode == 0


def test_one_class_name_is_one_thing_within_a_folder():
    """Across folders some words recur with their meaning, such as the start of a job and of a recording."""
    for folder in (f for f in ROOT.rglob("*") if f.is_dir() and f.name != "__pycache__"):
        names = [
            node.name
            for path in folder.glob("*.py")
            for node in ast.parse(path.read_text()).body
            if isinstance(node, ast.ClassDef)
        ]
        assert len(names) == len(set(names)), (folder, sorted(n for n in names if names.count(n) > 1))


@pytest.mark.full
def test_names_that_tests_and_benchmarks_use_exist():
    """A function that moves is found by its name, and not when a test of another folder runs."""
    lacking = []
    for path in [*(ROOT.parent / "tests").rglob("*.py"), *(ROOT.parent / "benchmarks").rglob("*.py")]:
        tree = ast.parse(path.read_text())
        modules = {}
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in ("jaxnav", "tuning"):
                for alias in node.names:
                    with contextlib.suppress(ImportError):
                        modules[alias.asname or alias.name] = importlib.import_module(f"{node.module}.{alias.name}")
        bound = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)}
        bound |= {node.arg for node in ast.walk(tree) if isinstance(node, ast.arg)}
        for node in ast.walk(tree):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id not in bound:
                module = modules.get(node.value.id)
                if module is not None and not hasattr(module, node.attr):
                    lacking.append(f"{path.relative_to(ROOT.parent)}:{node.lineno}: {node.value.id}.{node.attr}")
    assert not lacking
