"""Programs on disk: named by all that they depend on, found by another process, and never in the way."""

import os
import subprocess
import sys
from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.filters import programs
from jaxnav.filters.catalogue import FILTERS, build, changed, is_built_in
from jaxnav.filters.feedback import open_loop
from jaxnav.filters.rule import Rule
from jaxnav.filters.run import keep_info
from jaxnav.filters.spec import FilterSpec
from jaxnav.measurements import MEASUREMENTS
from tuning.fit.transforms import LOG, SIGNED, interval, scaled
from tuning.recordings.runs import loss_of

CODE = """
import sys, jax.numpy as jnp, jaxnav
from jaxnav.filters import programs
jaxnav.enable_x64()
programs.keep_in(__import__("pathlib").Path(sys.argv[1]))
from jaxnav.maths import rotations
made = programs._save
programs._save = lambda *args: print("made") or made(*args)
print(repr(programs.stored(rotations.to_rph)(jnp.eye(3)).tolist()))
from jaxnav.filters.catalogue import FILTERS, build
print(programs.described([build(name) for name in FILTERS]))
"""


@pytest.fixture
def home(tmp_path):
    programs.keep_in(tmp_path)
    yield tmp_path
    programs.keep_in(None)


def doubled(scale, x, shift=0.0):
    return scale * x + shift


doubled.__module__ = "jaxnav.made_up"


def files(home):
    return sorted(home.rglob("programs-*/*"))


def test_another_process_finds_the_program_and_names_filters_alike(tmp_path):
    run = lambda: subprocess.run(
        [sys.executable, "-c", CODE, str(tmp_path)], check=True, capture_output=True, text=True,
        env=os.environ | {"PYTHONHASHSEED": str(len(files(tmp_path)))},
    ).stdout.split("\n", 1)  # fmt: skip
    first, second = run(), run()
    assert first[0] == "made" and "made" not in second[0]
    assert [second[0], second[1]] == first[1].split("\n", 1) and len(files(tmp_path)) == 1


def test_a_program_gives_what_jit_gives(home):
    chex.clear_trace_counter()
    call = programs.stored(chex.assert_max_traces(doubled, n=4), static_argnums=(0,))
    for x in (jnp.arange(3.0), np.arange(3.0) + 1):
        np.testing.assert_array_equal(call(2.0, x, shift=jnp.ones(3)), 2 * np.asarray(x) + 1)
    assert len(files(home)) == 1
    assert not call(2.0, jnp.arange(3.0), shift=jnp.ones(3)).committed  # else what takes it compiles again
    assert call(2.0, 3.0) == 6.0 and call(2.0, jnp.ones(())) == 2.0 and call(3.0, 1.0) == 3.0
    assert len(files(home)) == 4


def test_one_that_runs_once_is_kept_as_well(home):
    """Its options of the compiler are those of the outermost program, with a file and without."""
    call = programs.stored(doubled, static_argnums=(0,), once=True)
    assert [float(call(2.0, x)) for x in (2.0, 2.5)] == [4.0, 5.0] and len(files(home)) == 1
    programs.keep_in(None)
    assert float(call(2.0, 3.0)) == 6.0


def test_under_a_transformation_it_is_jit(home):
    call = programs.stored(doubled, static_argnums=(0,))
    assert jax.grad(partial(call, 3.0))(2.0) == 3.0
    np.testing.assert_array_equal(jax.vmap(partial(call, 2.0))(jnp.arange(3.0)), [0.0, 2.0, 4.0])
    assert jax.jit(partial(call, 2.0))(4.0) == 8.0 and files(home) == []


def test_nothing_is_written_without_a_folder(tmp_path):
    programs.keep_in(None)
    assert programs.stored(doubled, static_argnums=(0,))(2.0, 3.0) == 6.0 and files(tmp_path) == []


def test_a_static_argument_of_the_user_is_no_part_of_a_name(home):
    """Its source may change without a change of ours."""
    call = programs.stored(lambda f, x: f(x), static_argnums=(0,))
    assert call(lambda x: x + 1, 2.0) == 3.0 and files(home) == []


def test_a_file_that_is_cut_is_written_again(home):
    assert programs.stored(doubled, static_argnums=(0,))(2.0, 3.0) == 6.0
    (file,) = files(home)
    whole = file.read_bytes()
    file.write_bytes(whole[:100])
    assert programs.stored(doubled, static_argnums=(0,))(2.0, 3.0) == 6.0
    assert files(home) == [file] and file.stat().st_size > 100


def test_programs_of_other_sources_go_when_they_are_old(home):
    old, young = home / "programs-old", home / "programs-young"
    for folder in (old, young):
        folder.mkdir()
        (folder / "a").write_bytes(b"")
    os.utime(old, (0, 0))
    programs.stored(doubled, static_argnums=(0,))(2.0, 3.0)
    assert not old.exists() and (young / "a").exists()


def test_filters_that_differ_have_other_names():
    """By history, stride, measurements, states, frame, form or feedback; of equal fields they are one filter."""
    filters = [build(name) for name in FILTERS]
    filters += [build("ekf15", cov_stride=5), build("ekf15", history=9), build("ekf15", ("position",))]
    filters += [build("ekf15", states=("gyro_scale",)), build("ekf15", frame="tangent"), build("ekf15", fast=False)]
    filters += [build("ekf15", feedback=open_loop), build("ekf15", adapter="mlp_noise")]
    described = [programs.described(f) for f in filters]
    assert len(set(described)) == len(described)
    assert programs.described(changed(build("ekf15", history=9), history=2)) == described[0]


def test_a_function_is_its_name_and_what_a_partial_holds():
    functions = [keep_info, partial(keep_info, 1), partial(keep_info, 2), partial(keep_info, along=2), jnp.exp]
    functions += [t.forward for t in (LOG, SIGNED, scaled(0.1), scaled(0.2), interval(0, 1), interval(0, 2))]
    described = [programs.described(f) for f in functions]
    assert len(set(described)) == len(described) - 1  # LOG's is jnp.exp
    assert programs.described(loss_of(build("ekf15"), (("nll", 1.0),), ("noise.gyro",)))


def closing(a):
    return lambda x: x + a


closing.__module__ = "jaxnav.made_up"


@pytest.mark.parametrize("part", ["row", "own rule", "no spec", "closure", "users", "objective", "object"])
def test_code_outside_of_the_sources_has_no_name(part, monkeypatch, tmp_path):
    """A row that was added or replaced at run time, a rule or objective of the user, values that a function holds."""
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "own_score.py").write_text("def score(info, epochs, truth):\n    return info.nis.sum()\n")
    filt = build("ekf15")
    if part == "row":
        for name in ("mine", "ekf15"):
            monkeypatch.setitem(FILTERS, name, FILTERS["ekf9"]._replace(citation="mine"))
        assert not is_built_in(FilterSpec("mine", frame="local_level")) and not is_built_in(filt.spec)
        assert not is_built_in(FilterSpec("ekf9", (MEASUREMENTS["position"],), frame="local_level"))
    value = {
        "row": filt,
        "own rule": build("ekf15", rule=Rule(lambda n, m: (), lambda theta, memory, z: None)),
        "no spec": filt._replace(spec=None),
        "closure": closing(1),
        "users": lambda x: x,
        "objective": loss_of(filt, (("own_score:score", 1.0),), ("noise.gyro",)),
        "object": (1, object()),
    }[part]
    with pytest.raises(programs.NotKept):
        programs.described(value)


def test_an_error_of_the_function_is_the_callers_and_a_callback_is_not_exported(home):
    """The first passes through with one trace; the second is `jax.jit`, with nothing written."""
    chex.clear_trace_counter()

    @chex.assert_max_traces(n=1)
    def refuses(x):
        raise ValueError("x has shape")

    refuses.__module__ = "jaxnav.made_up"
    with pytest.raises(ValueError, match="x has shape"):
        programs.stored(refuses)(1.0)
    seen = []
    calls_back = lambda x: jax.debug.callback(seen.append, x) or x + 1
    calls_back.__module__ = "jaxnav.made_up"
    assert programs.stored(calls_back)(1.0) == 2.0 and files(home) == []
