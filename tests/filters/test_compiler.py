"""How jax is set up: a flag only where it is known, programs kept on disk, and dropped before the system's limits."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.filters import compiler
from jaxnav.filters.compiler import EMITTERS, clear_caches_if_needed, process_usage


@pytest.mark.parametrize(
    ("version", "flags", "sets"),
    [
        ("0.10.2", "", True),
        ("0.9.0", "--xla_a=1", True),
        ("0.11.0", "", False),
        ("0.10.2", f"--{EMITTERS}=true", False),
    ],
    ids=["known", "beside_others", "too_new", "the_users_own"],
)
def test_the_flag_is_set_only_where_xla_knows_it(monkeypatch, version, flags, sets):
    monkeypatch.setenv("XLA_FLAGS", flags)
    monkeypatch.setattr(compiler.metadata, "version", lambda name: version)
    assert compiler.fast_compiler() is sets
    assert os.environ["XLA_FLAGS"] == (f"{flags} --{EMITTERS}=false".strip() if sets else flags)


def test_importing_starts_no_backend():
    """Else the flag would come too late for whoever imports jaxnav first."""
    code = "import jaxnav, jaxnav.app.cli, jax._src.xla_bridge as b; raise SystemExit(bool(b._backends))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


PROGRAM = """
import jax, jax.numpy as jnp, jaxnav, sys
jaxnav.fast_compiler()
jaxnav.enable_x64()
home = jaxnav.cache(sys.argv[1])
before = set(home.iterdir()) if home.exists() else set()
jax.jit(lambda x: jnp.sin(x) + 1)(1.0)
print(home.name, len(set(home.iterdir()) - before))
"""


def test_small_programs_are_found_by_the_next_process(tmp_path):
    run = lambda: subprocess.run(
        [sys.executable, "-c", PROGRAM, str(tmp_path)], check=True, capture_output=True, text=True
    ).stdout.split()
    (name, first), (again, second) = run(), run()
    assert name == again and name.startswith("jaxlib-") and int(first) > 0 and int(second) == 0


def test_no_cache_where_it_is_turned_off(monkeypatch):
    monkeypatch.setenv(compiler.CACHE, "")
    assert compiler.cache() is None and compiler.cache_home() is None


@pytest.mark.full
@pytest.mark.skipif(process_usage().maps == 0, reason="the system does not say what a process holds")
def test_many_programs_fit_into_a_few_mappings(caplog):
    """Sixty programs, twice as many as the limit lets live; each is right, also after it was dropped."""
    x, base, programs = jnp.arange(4.0), process_usage().maps, []
    most, dropped = base, 0
    for i in range(60):
        programs.append(jax.jit(lambda x, i=i: jnp.sin(x) @ jnp.ones(4) * i))
        np.testing.assert_allclose(programs[-1](x), i * np.sin(x).sum())
        most = max(most, process_usage().maps)
        dropped += clear_caches_if_needed(maps=base + 40, resident=np.inf)
    assert dropped >= 1 and most < base + 150
    assert "dropped all compiled programs" in caplog.text
    np.testing.assert_allclose(programs[3](x), 3 * np.sin(x).sum())
    assert clear_caches_if_needed(maps=10**9, resident=np.inf) is False
