"""What is wrong with files, settings and calls is said in one line, before any work: input x fault x expected word."""

import shutil
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jaxnav import initial_nav
from jaxnav.app import cli
from jaxnav.filters.compiler import require_memory
from jaxnav.filters.core import make_filter
from jaxnav.filters.error_model import error_model
from jaxnav.filters.feedback import reset
from jaxnav.filters.rule import Correction, Rule
from jaxnav.filters.run import run
from jaxnav.strapdown.frames import FRAMES
from jaxnav.types import DataError
from tuning.fit import checkpoint
from tuning.fit.train import fit
from tuning.fit.transforms import LOG

SMALL = ["--set", "out.figures=none", "--set", "filter.cov_stride=25"]


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    folder = tmp_path_factory.mktemp("faults") / "drive"
    argv = [
        "simulate",
        "--data",
        "urban_short",
        "--set",
        "data.options.duration_s=40",
        "--out",
        str(folder),
        *SMALL[:2],
    ]
    assert cli.main(argv) == 0
    return folder


def replaced(file, old, new):
    """Of a file's text."""

    def change(folder):
        text = (folder / file).read_text()
        assert old in text
        (folder / file).write_text(text.replace(old, new))

    return change


def of_column(file, column, value):
    """Another value in the tenth row."""

    def change(folder):
        lines = (folder / file).read_text().splitlines()
        cells = lines[10].split(",")
        cells[lines[0].split(",").index(column)] = value
        lines[10] = ",".join(cells)
        (folder / file).write_text("\n".join(lines) + "\n")

    return change


FILES = {
    "semicolons": (replaced("imu.csv", ",", ";"), ["imu.csv", "semicolons"]),
    "tabs": (replaced("position.csv", ",", "\t"), ["position.csv", "tabs"]),
    "booleans": (replaced("recording.json", "0.3", "true"), ["lever_arm_frd_m", "three numbers"]),
    "a kilometre of arm": (replaced("recording.json", "0.3", "1e9"), ["lever_arm_frd_m", "at most 100 m"]),
    "the Earth's centre": (of_column("position.csv", "h_m", "-6378000"), ["position.csv", "line 11", "height"]),
    "degrees": (of_column("position.csv", "lat_rad", "48.2"), ["position", "latitude", "degrees as radians?"]),
    "an sd of zero": (of_column("velocity.csv", "sd_e_mps", "0"), ["velocity", "sd > 0"]),
    "not a number": (of_column("imu.csv", "gyro_x_radps", "nan"), ["imu", "line 11"]),
    "text": (of_column("imu.csv", "gyro_x_radps", "12,5"), ["imu.csv", "line 11", "columns"]),
}


@pytest.mark.parametrize("fault", FILES)
def test_files(drive, tmp_path, capsys, fault):
    change, words = FILES[fault]
    folder = tmp_path / "drive"
    shutil.copytree(drive, folder)
    change(folder)
    assert cli.main(["filter", "--data", str(folder), "--out", str(tmp_path / "r"), *SMALL]) == 3
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and all(word in said for word in words), said
    assert not (tmp_path / "r").exists()


SETTINGS = {
    "initialization.heading=inf": (2, ["initialization.heading", "finite"]),
    "initialization.heading=nan": (2, ["initialization.heading", "a number"]),
    "filter.interval_s=1e-9": (3, ["interval", "epochs"]),
    "out.formats=['cvs']": (2, ["cvs", "csv"]),
    "filter.states=['gnss_error']": (2, ["gnss_error", "gnss_position_error"]),
    "filter.lag=3": (2, ["filter.lag"]),
}


@pytest.mark.parametrize("setting", SETTINGS)
def test_settings(drive, tmp_path, capsys, setting):
    code, words = SETTINGS[setting]
    argv = ["filter", "--data", str(drive), "--out", str(tmp_path / "r"), *SMALL, "--set", setting]
    assert cli.main(argv) == code
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and all(word in said for word in words), said


@pytest.mark.parametrize(
    "argv", [["simulate", "--set", "data.options.duration_s=1e12"], ["tune", "--set", "tune.runs=1000000"]]
)
def test_work_beyond_memory_is_refused_before_it_starts(tmp_path, capsys, argv):
    assert cli.main([*argv, "--data", "urban_short", "--out", str(tmp_path / "r")]) == 3
    assert "GiB of memory, this machine has" in capsys.readouterr().err
    require_memory(1.0, "a byte")
    with pytest.raises(DataError, match="a planet takes about"):
        require_memory(1e18, "a planet")


def test_a_mark_in_front_of_a_configuration_and_a_name_too_long(drive, tmp_path, capsys):
    (tmp_path / "c.toml").write_bytes(b"\xef\xbb\xbf[filter]\nname = 'ekf9'\n")
    out = str(tmp_path / ("x" * 300))
    assert cli.main(["filter", "--config", str(tmp_path / "c.toml"), "--data", str(drive), "--out", out]) == 3
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "cannot be used: File name too long" in said


# ---------------------------------------------------------------------------- calls of the library


def badly(theta, memory, z):
    return Correction(jnp.zeros(6), z.P, memory, z.valid)


def test_a_rule_that_answers_in_another_shape_is_named(case):
    rule = Rule(lambda n, m: (), badly)
    filt = make_filter(FRAMES["local_level"].propagate, error_model("local_level", ()), rule, reset)
    with pytest.raises(ValueError, match=r"Correction.delta has shape \(6,\), expected \(9,\)"):
        jax.eval_shape(partial(run, filt), case.params, case.nav, case.packed.epochs)


def test_silently_wrong_input_is_refused(tmp_path):
    with pytest.raises(DataError, match="float64"):
        initial_nav(np.array([0.8, 0.1, 100.0], np.float32))
    with pytest.raises(ValueError, match="steps must be 0 or more"):
        fit(lambda p: p["a"], {"a": LOG}, {"a": jnp.array(1.0)}, -1, optax.adam(0.1))
    with pytest.raises(checkpoint.CheckpointError, match="bfloat16"):
        checkpoint.save(tmp_path / "c.npz", {"a": jnp.ones(3, jnp.bfloat16)}, {})
