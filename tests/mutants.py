"""``make mutants``: break the code in one place at a time, and see whether a test fails.

Places are drawn at random, as many in every folder as its share of the lines: an operator, a comparison, a number, a
sign. The tests nearest to the file run first, then those of its folder and the contract of all filters. What survives
is printed as a diff: a test that is missing, or a change that changes nothing.
"""

import argparse
import ast
import copy
import difflib
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
SWAPS = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.Eq: ast.NotEq,
    ast.Lt: ast.GtE, ast.Gt: ast.LtE, ast.LtE: ast.Gt, ast.GtE: ast.Lt,
    ast.And: ast.Or, ast.Or: ast.And, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd,
}  # fmt: skip
FOLDERS = ("jaxnav", "tuning", "benchmarks", "tests", "docs", "examples")
COPIED = (*FOLDERS, "README.md", "pyproject.toml", "Makefile", "CHANGELOG.md")
CPU_LIMIT = 420  # s of processor time of a run of tests, whatever runs on the machine at the same time
WALL_LIMIT = 2400  # s; a mutant on which the nearest tests hang is seen


def mutants(tree: ast.Module) -> Iterator[ast.AST]:
    """Nodes of code, not of annotations and documentation, that `broken` can break."""
    skipped: set[int] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.arg | ast.AnnAssign) and node.annotation is not None:
            skipped |= {id(n) for n in ast.walk(node.annotation)}
        if isinstance(node, ast.FunctionDef) and node.returns is not None:
            skipped |= {id(n) for n in ast.walk(node.returns)}
        if isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING":
            skipped |= {id(n) for n in ast.walk(node)}
    for node in ast.walk(tree):
        if id(node) in skipped:
            continue
        if isinstance(node, ast.BinOp | ast.BoolOp) and type(node.op) in SWAPS:
            text = isinstance(node, ast.BinOp) and any(isinstance(s, ast.Constant | ast.JoinedStr) and not isinstance(
                getattr(s, "value", 0), int | float) for s in (node.left, node.right))  # fmt: skip
            if not text:
                yield node
        elif isinstance(node, ast.Compare) and len(node.ops) == 1 and type(node.ops[0]) in SWAPS:
            yield node
        elif isinstance(node, ast.Constant) and type(node.value) in (int, float):
            yield node
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.Not):
            yield node


def broken(source: str, which: int) -> str:
    """The source with one of its `mutants` changed, as the parser writes it."""
    tree = copy.deepcopy(ast.parse(source))
    node = list(mutants(tree))[which]
    if isinstance(node, ast.Compare):
        node.ops = [SWAPS[type(node.ops[0])]()]  # type: ignore[list-item]
    elif isinstance(node, ast.BinOp | ast.BoolOp):
        node.op = SWAPS[type(node.op)]()  # type: ignore[assignment]
    elif isinstance(node, ast.Constant):
        node.value = node.value + 1 if isinstance(node.value, int) else 1.5 * node.value + 0.1
    elif isinstance(node, ast.UnaryOp):
        node.op = ast.UAdd() if isinstance(node.op, ast.USub) else node.op
        if isinstance(node.op, ast.Not):
            node.operand = ast.UnaryOp(ast.Not(), node.operand)
    return ast.unparse(tree)


def nearest(path: Path) -> list[list[str]]:
    """Runs of tests, the nearest first."""
    package, *between, _ = path.parts
    folder = Path("tests", *(between if package == "jaxnav" else ["tuning"]))
    while not (ROOT / folder).is_dir():
        folder = folder.parent
    module = ".".join(path.with_suffix("").parts)
    near = [
        str(t.relative_to(ROOT))
        for t in sorted((ROOT / "tests").rglob("test_*.py"))
        if t.stem in (f"test_{path.stem}", f"test_{path.stem.rstrip('s')}") or module in t.read_text()
    ]
    return [
        *([near] if near else []),
        ["tests/replay", str(folder), "tests/test_contract.py", "tests/test_contract_rows.py", "tests/faults"],
    ]


def limit_cpu() -> None:
    """Limit the processor time of this process to `CPU_LIMIT`."""
    resource.setrlimit(resource.RLIMIT_CPU, (CPU_LIMIT, CPU_LIMIT + 10))


def killed(work: Path, path: Path) -> str:
    """Which run of tests noticed; empty if none did."""
    runs = nearest(path)
    for step, tests in enumerate(runs):
        argv = [sys.executable, "-m", "pytest", "-x", "-q", "-m", "not slow", "-p", "no:cacheprovider", *tests]
        env = os.environ | {"PYTHONPATH": str(work), "MPLBACKEND": "Agg"}
        try:
            code = subprocess.run(argv, cwd=work, env=env, capture_output=True, timeout=WALL_LIMIT,
                                  preexec_fn=limit_cpu).returncode  # fmt: skip
        except subprocess.TimeoutExpired:
            code = -signal.SIGXCPU
        if code in (-signal.SIGXCPU, -signal.SIGKILL):
            return "hangs" if step == 0 and len(runs) == 2 else ""  # a folder's tests alone may take longer
        if code not in (0, 5):
            return ("near", "folder")[step if len(runs) == 2 else 1]
    return ""


def main() -> None:
    """Draw the places, try each, print what survived."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutants", description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=50, help="how many, default 50")
    parser.add_argument("--seed", type=int, default=0, help="of the places")
    parser.add_argument("--first", type=int, default=1, help="number of the first place to try, to resume")
    args = parser.parse_args()
    chance = random.Random(args.seed)
    files = sorted(p.relative_to(ROOT) for part in ("jaxnav", "tuning") for p in (ROOT / part).rglob("*.py"))
    places = [(p, i) for p in files for i in range(len(list(mutants(ast.parse((ROOT / p).read_text())))))]
    seen = 0
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        for name in COPIED:
            (shutil.copytree if (ROOT / name).is_dir() else shutil.copy)(ROOT / name, work / name)
        for n, (path, which) in list(enumerate(chance.sample(places, args.count), 1))[args.first - 1 :]:
            source = (ROOT / path).read_text()
            mutant, plain, begin = broken(source, which), ast.unparse(ast.parse(source)), time.perf_counter()
            (work / path).write_text(mutant)
            how = killed(work, path)
            seen += bool(how)
            print(f"{n:3} {how or 'SURVIVED':8} {time.perf_counter() - begin:4.0f} s  {path}", flush=True)
            diff = difflib.unified_diff(plain.splitlines(), mutant.splitlines(), n=0, lineterm="")
            print("\n".join(f"      {line}" for line in list(diff)[3:]), flush=True)
            (work / path).write_text(source)
    print(f"{seen} of {args.count - args.first + 1} were seen")


if __name__ == "__main__":
    main()
