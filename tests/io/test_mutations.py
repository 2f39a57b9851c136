"""Damaged files of every reader: data, or an error that names the file."""

import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from jaxnav import io
from jaxnav.io import files
from jaxnav.io.formats.rtklib import read_tag
from jaxnav.types import DataError

from .test_format_errors import POS_HEAD, POS_ROW, time_tag
from .test_formats import recording

FUZZ = settings(
    deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture], database=None
)


def reads_or_refuses(read, path: Path) -> None:
    """Data or DataError; anything else fails the test."""
    try:
        read(path)
    except DataError as caught:
        assert path.name in str(caught) or os.fspath(path.parent) in str(caught)


@st.composite
def mutations(draw, content: bytes) -> bytes:
    """A good file with a few bytes changed, cut out, doubled or put in, or cut short."""
    mutated = bytearray(content)
    for _ in range(draw(st.integers(1, 4))):
        i = draw(st.integers(0, max(0, len(mutated) - 1)))
        j = min(len(mutated), i + draw(st.integers(0, 40)))
        kind = draw(st.sampled_from(["cut", "double", "put", "end"]))
        put = draw(
            st.binary(max_size=4)
            | st.sampled_from([b"nan", b"1e308", b"-", b"1e-320", b",", b"\n", b" ", b"\0", b"9" * 30])
        )
        if kind == "end":
            del mutated[i:]
        else:
            mutated[i:j] = {"cut": b"", "double": bytes(mutated[i:j]) * 2, "put": put}[kind]
    return bytes(mutated)


def test_the_quick_parser_reads_what_the_strict_one_reads(tmp_path, monkeypatch):
    """A damaged file is left to the strict one, or both read the same numbers from the same lines."""
    content = "t_s,a,b\n" + "".join(f"{k * 0.1!r},{k / 3!r},-{k}e-3\n" for k in range(6))
    file, read = tmp_path / "table.csv", {"quick": 0, "left": 0}

    @settings(FUZZ, max_examples=300)
    @given(mutations(content.encode()))
    def run(mutated):
        file.write_bytes(mutated)
        for quick, strict in (
            (files.clean_csv(file, frozenset({"b"})), lambda: files.read_csv(file, frozenset({"b"}))),
            (files.clean_table(file, 3, ","), lambda: files.read_columns(file, 3, ",")),
        ):
            read["left" if quick is None else "quick"] += 1
            if quick is not None:
                with monkeypatch.context() as patch:
                    patch.setattr(files, "clean_table", lambda *args: None)
                    table = strict()
                np.testing.assert_array_equal(quick.values, table.values)
                np.testing.assert_array_equal(quick.source.lines, table.source.lines)
                assert quick.names == table.names

    run()
    assert read["quick"] > 5 and read["left"] > 100


def good_files() -> dict:
    """Small good content for each reader."""
    rec = recording(n=20)
    imu = np.column_stack([rec.imu.t, 0.01 * rec.imu.gyro, 0.01 * rec.imu.accel]).tolist()
    rows = "".join(" ".join(map(repr, row)) + "\n" for row in imu)
    nav = "2017 1.0 30.0 114.0 20.0 1.0 2.0 3.0 1.0 2.0 3.0\n2017 2.0 30.0 114.0 20.0 1.0 2.0 3.0 1.0 2.0 3.0\n"
    return {
        io.read_pos: POS_HEAD + POS_ROW.format(1) + POS_ROW.format(2),
        io.read_kfgins_imu: rows,
        io.read_kfgins_gnss: "1.0 30.0 114.0 20.0 0.1 0.1 0.2\n2.0 30.0 114.0 20.0 0.1 0.1 0.2\n",
        io.read_kfgins_nav: nav,
    }


@pytest.mark.parametrize("reader", [io.read_pos, io.read_kfgins_imu, io.read_kfgins_gnss, io.read_kfgins_nav])
def test_fuzzed_text_files(tmp_path, reader):
    content, file = good_files()[reader].encode(), tmp_path / "fuzzed.txt"
    file.write_bytes(content)
    reader(file)

    @FUZZ
    @given(st.one_of(mutations(content), st.binary(max_size=200), st.text(max_size=100).map(str.encode)))
    def run(mutated):
        file.write_bytes(mutated)
        reads_or_refuses(reader, file)

    run()


@pytest.mark.parametrize(
    "name", ["imu.csv", "position.csv", "speed.csv", "aiding_zero_rate.csv", "truth.csv", "recording.json"]
)
def test_fuzzed_recordings(tmp_path, name):
    rec = recording(n=20)
    span = {key: stream._replace(t=stream.t - 0.4) for key, stream in rec.aiding.items()}
    io.write_recording(tmp_path / "run", rec._replace(aiding=span, truth=rec.truth._replace(t=rec.truth.t - 0.4)))
    io.read_recording(tmp_path / "run")
    file = tmp_path / "run" / name
    content = file.read_bytes()

    @settings(FUZZ, max_examples=25)
    @given(mutations(content))
    def run(mutated):
        file.write_bytes(mutated)
        reads_or_refuses(lambda path: io.read_recording(path.parent), file)

    run()


@pytest.mark.parametrize("kind", ["npz", "tag"])
def test_fuzzed_binary_files(tmp_path, kind):
    file = tmp_path / f"fuzzed.{kind}"
    if kind == "npz":
        io.write_recording(file, recording(n=250))
    else:
        file.write_bytes(time_tag(np.arange(0, 400, 10)))
    reader = io.read_recording if kind == "npz" else read_tag
    reader(file)
    content = file.read_bytes()

    @settings(FUZZ, max_examples=40)
    @given(st.one_of(mutations(content), st.binary(max_size=200)))
    def run(mutated):
        file.write_bytes(mutated)
        reads_or_refuses(reader, file)

    run()
