"""The command line: exit codes, messages, whole results or none, and runs that can be repeated."""

import gc
import json
import os
import subprocess
import sys

import jax
import numpy as np
import pytest

from jaxnav import navigation as navigate
from jaxnav.app import cli, config, prepare, sources
from jaxnav.app.jobs import filtering
from jaxnav.app.results import staged
from jaxnav.app.verbs import VERBS
from jaxnav.io import read_recording, write_recording
from jaxnav.types import FilterError
from tuning.fit.status import Status
from tuning.fit.train import Fit
from tuning.recordings import runs

SMALL = ["--set", "data.options.standstill_s=4", "--set", "filter.cov_stride=25", "--set", "out.figures=none"]
TINY = [
    "--set",
    "tune.runs=1",
    "--set",
    "tune.validation_runs=1",
    "--set",
    "tune.test_runs=2",
    "--set",
    "tune.steps=1",
    "--filter",
    "kf9_simple",
]


@pytest.fixture(autouse=True)
def no_cache_no_cwd(monkeypatch, tmp_path):
    monkeypatch.setenv("JAXNAV_CACHE_DIR", "")
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """A recording written by `jaxnav simulate`."""
    out = tmp_path_factory.mktemp("sim") / "drive"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("JAXNAV_CACHE_DIR", "")
        assert cli.main(["simulate", "--data", "urban_short", "--out", str(out), "--seed", "3", *SMALL]) == 0
    return out


def copy(drive, to):
    to.mkdir()
    for name in ("imu.csv", "position.csv", "velocity.csv", "truth.csv", "recording.json"):
        (to / name).write_text((drive / name).read_text())
    return to


def fails(capsys, argv, code, *words):
    """Run; the exit code, one line on stderr that holds the words, nothing on stdout, nothing in the folder."""
    out = cli.Path("failed")
    assert cli.main([*argv, "--out", str(out)]) == code
    said = capsys.readouterr()
    assert said.out == "" and said.err.count("\n") == 1 and said.err.startswith("jaxnav: error: "), said.err
    assert all(word in said.err for word in words), said.err
    assert not out.exists() and not list(cli.Path().glob(".failed*"))


def test_simulate_leaves_a_recording_and_its_run(drive):
    rec = read_recording(drive)
    assert rec.truth is not None and set(rec.aiding) == {"position", "velocity"}
    about = json.loads((drive / "run.json").read_text())
    assert about["verb"] == "simulate" and about["seed"] == 3 and "jax" in about["versions"]
    assert set(about["files"]) == {p.name for p in drive.iterdir()}


@pytest.mark.full
def test_filter_writes_everything_and_json_parses(drive, tmp_path, capsys):
    formats = "out.formats=['csv', 'kml', 'nav', 'pos']"
    outages = "filter.outages=[[65, 72]]"
    argv = [
        "filter",
        "--data",
        str(drive),
        "--json",
        "--set",
        formats,
        "--set",
        outages,
        "--set",
        "filter.cov_stride=25",
        "--set",
        "out.figures=files",
    ]
    assert cli.main([*argv, "--out", "r"]) == 0
    said = capsys.readouterr()
    result = json.loads(said.out)
    assert said.err == "" and result["verb"] == "filter"
    metrics = result["metrics"]
    assert list(metrics["errors"])[:3] == ["north_m", "east_m", "down_m"]
    assert metrics["errors"]["horizontal_m"]["rms"] < 5 and 0.7 < metrics["nis_per_dof"] < 1.5
    assert [o["end_s"] for o in metrics["outages"]][-1] == 72 and metrics["outages"][-1]["horizontal_m"] < 50
    names = {p.name for p in cli.Path("r").iterdir()}
    assert {f"solution.{kind}" for kind in ("csv", "kml", "nav", "pos")} <= names
    figures = {f"{name}.png" for name in ("trajectory", "errors", "innovations", "nis", "biases", "noise_scan")}
    assert names == {*figures, "metrics.json", "report.html", "run.json"} | {
        f"solution.{k}" for k in ("csv", "kml", "nav", "pos")
    }
    assert json.loads(cli.Path("r/metrics.json").read_text()) == metrics

    # the same file re-runs the job to the same numbers, over the old folder, whose surplus goes
    plain = ["--set", "out.figures=none"]
    assert cli.main(["filter", "--config", "r/run.json", "--out", "again", "--quiet", *plain]) == 0
    assert capsys.readouterr() == ("", "")
    assert cli.Path("again/solution.csv").read_bytes() == cli.Path("r/solution.csv").read_bytes()
    cli.Path("r/mine.txt").write_text("the user's own")
    csv = ["--set", "out.formats=['csv']"]
    assert cli.main(["filter", "--config", "r/run.json", "--out", "r", *plain, *csv]) == 0
    assert {p.name for p in cli.Path("r").iterdir()} == {"solution.csv", "metrics.json", "run.json", "mine.txt"}
    assert "inside 3 sd" in capsys.readouterr().out


def test_times_of_a_solution_are_the_imus_stamps_or_those_of_the_fixes(drive, capsys):
    """Fixes that are 0.25 s late and gain 1 %: the same solution, at the stamps of either clock."""
    late = ["--set", "mounting.time_offset_s=0.25", "--set", "mounting.clock_drift_ppm=1e4"]
    found = {}
    for base in ("imu", "fixes"):
        how = [*late, "--set", f"time.base={base}", "--out", base, "--set", "out.figures=none"]
        assert cli.main(["filter", "--data", str(drive), "--set", "filter.grade=adis16465", *how]) == 0
        found[base] = np.genfromtxt(f"{base}/solution.csv", delimiter=",", names=True)
        assert f'fixes are stamped +0.250 s from the IMU: time.base = "{"fixes" if base == "imu" else "imu"}"' in (
            capsys.readouterr().out
        )
        assert json.loads(cli.Path(base, "metrics.json").read_text())["time"] == {"base": base, "fixes_late_s": 0.25}
    stamps = np.genfromtxt(drive / "imu.csv", delimiter=",", names=True)["t_s"]
    imu, fixes = found["imu"]["t_s"], found["fixes"]["t_s"]
    assert np.abs(imu[:, None] - stamps).min(1).max() < 1e-6
    np.testing.assert_allclose(fixes - imu, 0.25 + 0.01 * (imu - 0.5 * (stamps[0] + stamps[-1])), atol=0.01)
    np.testing.assert_array_equal(found["imu"]["lat_deg"], found["fixes"]["lat_deg"])
    fails(capsys, ["filter", "--data", str(drive), "--set", "time.base=gps"], 2, "time.base: no clock 'gps'")


def test_seed_reproduces_and_matters(drive):
    scenario = sources.scenario_of(config.resolve([("", {"data": {"source": "urban_short"}})]))
    c = config.resolve([("", {"data": {"source": "urban_short", "options": {"standstill_s": 4.0}}, "seed": 3})])
    again = sources.load(c)
    rec = read_recording(drive)
    np.testing.assert_array_equal(again.imu.gyro, rec.imu.gyro)
    other = sources.load(config.resolve([("", config.as_dict(c)), ("", {"seed": 4})]))
    assert not np.allclose(other.imu.gyro, rec.imu.gyro)
    assert scenario.name == "urban_short"


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["filter", "--set", "filter.nam=ekf9"], ["unknown key filter.nam", "filter.name"]),
        (["filter", "--filter", "ekf16"], ["no filter 'ekf16'", "did you mean ekf15?"]),
        (["filter", "--set", "filter.grade=consumr"], ["did you mean consumer?"]),
        (["filter", "--set", "data.options.duration=3"], ["did you mean duration_s?"]),
        (["filter", "--set", "data.options.duration_s='x'"], ["data.options.duration_s must be like 80.0"]),
        (["simulate", "--set", "data.options.imu_rate_hz=33.3"], ["imu_rate_hz"]),
        (["simulate", "--set", "data.options.sensors={baro=1}"], ["no sensor 'baro'", "barometer"]),
        (["simulate", "--set", "data.options.sensors={barometer=-1}"], ["sensors.barometer: the sd of its noise must"]),
        (["simulate", "--set", "data.options.sensor_states=['barometer']"], ["no state 'barometer'"]),
        (["mc", "--set", "data.options.sensors={barometer=1.0}"], ["runs of mc have a receiver only"]),
        (["tune", "--set", "data.options.sensors={barometer=1.0}"], ["simulate one, and tune with FOLDER"]),
        (["simulate", "--data", "rtkexplorer_drive"], ["simulate takes a scenario"]),
        (["tune", "--set", "tune.objective=nlll"], ["did you mean nll?"]),
        (["tune", "--set", "tune.free=['noise.gyroo']"], ["did you mean noise.gyro?"]),
        (["tune", "--set", 'filter.measurements=["position", "nonholonomic"]'], ["constraints"]),
        (["filter", "--config", "none.toml"], ["none.toml: cannot be read"]),
        (["filter", "--params", "none.toml"], ["none.toml: cannot be read"]),
        (["data", "fetch"], ["needs the name"]),
        (["filter", "--filter", ""], ["no filter ''"]),
        (["filter", "--config", ""], ["cannot be read"]),
        (
            ["filter", "--set", "measurements.position.latency_s=100"],
            ["measurements.position.latency_s must be a number in [-10, 10]"],
        ),
        (["filter", "--set", "filter.outages=[[200, 300]]"], ["filter.outages: [200.0, 300.0] holds no epoch"]),
        (["simulate", "--set", "data.options.duration_s=inf"], ["duration_s must be positive and finite, got inf"]),
        (["tune", "--devices", "-1"], ["--devices must be 0 (all) or more, got -1"]),
        (["tune", "--set", "tune.objective={'os:sep' = 1.0}"], ["'os:sep' is no function"]),
        (["tune", "--set", "tune.objective={':f' = 1.0}"], ["cannot be imported"]),
    ],
)
def test_configuration_errors_exit_2(argv, words, capsys):
    short = ["--data", "urban_short"] if argv[0] in ("filter", "tune") else []
    fails(capsys, [argv[0], *argv[1:], *([] if "--data" in argv else short)], 2, *words)


def test_usage_exits_2_help_0(capsys):
    assert cli.main(["fly"]) == 2 and cli.main([]) == 2 and cli.main(["filter", "--seed", "x"]) == 2
    assert cli.main(["--help"]) == 0 and cli.main(["--version"]) == 0
    assert "Exit codes" in capsys.readouterr().out


@pytest.mark.parametrize("verb", [verb for verb in VERBS if "--data" in {a.name for a in VERBS[verb].arguments}])
def test_a_recording_is_named_as_that_of_solve(verb, capsys):
    named = lambda *argv: cli.resolve(cli.make_parser().parse_args([verb, *argv])).data
    for argv in (["drive.bag"], ["--quiet", "drive.bag"], ["drive.bag", "--set", "seed=1"], ["--data", "drive.bag"]):
        assert named(*argv).source == "drive.bag"
    both = named("imu.csv", "gnss.csv")
    assert (both.source, both.options) == ("imu.csv", {"gnss": "gnss.csv"})
    fails(capsys, [verb, "drive.bag", "--data", "other.bag"], 2, "data.source: by source and by --data")
    assert named().source == cli.resolve(cli.make_parser().parse_args([verb])).data.source


def edit(drive, tmp_path, file, change):
    folder = copy(drive, tmp_path / "bad")
    lines = (folder / file).read_text().splitlines(keepends=True)
    (folder / file).write_text("".join(change(lines)))
    return str(folder)


def cells(line, at, value):
    parts = line.rstrip("\n").split(",")
    parts[at] = value
    return ",".join(parts) + "\n"


@pytest.mark.parametrize(
    ("file", "change", "words"),
    [
        ("imu.csv", lambda x: [*x[:5], x[7], x[6], x[5], *x[8:]], ["imu.csv: line", "time later"]),
        ("imu.csv", lambda x: [*x[:9], cells(x[9], 3, "nan"), *x[10:]], ["imu.csv: line 10", "finite"]),
        ("position.csv", lambda x: [*x[:9], cells(x[9], 4, "0.0"), *x[10:]], ["position.csv: line 10", "sd > 0"]),
        ("imu.csv", lambda x: [x[0].replace("mps2", "g"), *x[1:]], ["imu.csv", "gravity"]),
        ("imu.csv", lambda x: [x[0].replace("gyro_x_radps", "gx"), *x[1:]], ["imu.csv", "gyro_x_radps"]),
        ("recording.json", lambda x: ["{"], ["recording.json"]),
    ],
    ids=["time", "nan", "sd", "units", "column", "json"],
)
def test_bad_data_exits_3(drive, tmp_path, capsys, file, change, words):
    fails(capsys, ["filter", "--data", edit(drive, tmp_path, file, change)], 3, *words)


@pytest.mark.full
def test_a_last_line_that_is_cut_short_is_said(drive, tmp_path, capsys):
    folder = edit(drive, tmp_path, "truth.csv", lambda x: [*x[:-1], x[-1][:10]])
    assert cli.main(["filter", "--data", folder, "--out", "cut", *SMALL[2:]]) == 0
    said = capsys.readouterr().out
    assert "truth.csv" in said and "cut" in said


def test_no_name_is_no_scenario(capsys):
    fails(capsys, ["filter", "--data", ""], 3, "no name")


def test_files_that_nobody_reads_are_named(drive, tmp_path, capsys):
    folder = copy(drive, tmp_path / "bad")
    (folder / "position.csv").rename(folder / "gnss.csv")
    fails(capsys, ["filter", "--data", str(folder)], 3, "no position.csv, and gnss.csv is not read")
    (folder / "gnss.csv").rename(folder / "position.csv")
    text = (folder / "velocity.csv").read_text()
    (folder / "velocity.csv").write_text(text.replace("corr_en,corr_nu,corr_ue", "corr_ne,corr_un,corr_eu"))
    fails(capsys, ["filter", "--data", str(folder)], 3, "velocity.csv: no column corr_ne is known", "corr_en")


def test_absent_data_and_fetched_data_exit_3(monkeypatch, tmp_path, capsys):
    fails(capsys, ["filter", "--data", "urban_shrt"], 3, "urban_shrt", "did you mean urban_short?")
    monkeypatch.setenv("JAXNAV_DATA_DIR", str(tmp_path))
    monkeypatch.setattr("jaxnav.reading.datasets._cache", lambda name: tmp_path / "cache" / name)
    fails(capsys, ["filter", "--data", "umn_thor75"], 3, "jaxnav data fetch umn_thor75")
    fails(capsys, ["data", "check", "umn_thor"], 3, "did you mean umn_thor75?")
    assert cli.main(["data", "list", "--json"]) == 0
    assert set(json.loads(capsys.readouterr().out)["metrics"]["data_sets"].values()) == {None}


def test_float32_exits_3(drive, monkeypatch, capsys):
    monkeypatch.setattr(cli, "_start_jax", lambda args: None)
    with jax.enable_x64(False):
        fails(capsys, ["filter", "--data", str(drive)], 3, "float64", "float32")


@pytest.mark.full
def test_filter_that_fails_exits_1_with_run_and_time(drive, monkeypatch, capsys):
    real = navigate.execute

    def broken(*arguments):
        info, about = real(*arguments)
        return info._replace(ok=info.ok & (np.arange(info.ok.size) < 20)), about

    monkeypatch.setattr(navigate, "execute", broken)
    argv = ["filter", "--data", str(drive), "--set", "filter.cov_stride=25"]
    fails(capsys, argv, 1, "run urban_short", "stopped being finite at t = ", "epoch 20")


@pytest.mark.full
def test_a_failure_leaves_the_old_results(drive, monkeypatch, capsys):
    out = cli.Path("kept")
    out.mkdir()
    (out / "run.json").write_text('{"verb": "filter", "files": ["run.json"]}')
    monkeypatch.setattr(filtering, "summary", lambda *a: (_ for _ in ()).throw(FilterError("late")))
    argv = ["filter", "--data", str(drive), "--out", str(out), "--set", "filter.cov_stride=25", *SMALL[-2:]]
    assert cli.main(argv) == 1
    assert [p.name for p in out.iterdir()] == ["run.json"] and not list(cli.Path().glob(".kept*"))
    capsys.readouterr()


def test_ctrl_c_exits_130_and_leaves_nothing(drive, monkeypatch, capsys):
    monkeypatch.setattr(navigate, "execute", lambda *a: (_ for _ in ()).throw(KeyboardInterrupt))
    assert cli.main(["filter", "--data", str(drive), "--out", "r"]) == 130
    assert "stopped" in capsys.readouterr().err and not cli.Path("r").exists()


def test_the_remains_of_a_killed_run_are_cleared(drive, tmp_path):
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    names = [f".r.{dead.pid}.tmp", f".r.{os.getppid()}.tmp", ".r.mine.tmp", f".other.{dead.pid}.tmp"]
    for name in names:
        (tmp_path / name).mkdir()
    argv = ["filter", "--data", str(drive), "--out", str(tmp_path / "r"), "--set", "filter.cov_stride=25", *SMALL[-2:]]
    assert cli.main(argv) == 0
    assert {p.name for p in tmp_path.iterdir()} == {"r", *names[1:]}


def test_debug_shows_the_traceback(capsys):
    assert cli.main(["filter", "--data", "nothing", "--debug"]) == 3
    assert "Traceback" in capsys.readouterr().err


def test_unwritable_out_exits_3(drive, capsys):
    cli.Path("file").write_text("")
    assert cli.main(["simulate", "--data", "urban_short", "--out", "file/r", "--set", "out.figures=none"]) == 3
    assert "cannot be written" in capsys.readouterr().err


def test_results_do_not_mix_with_files_of_others(drive, tmp_path, capsys):
    (tmp_path / "speed.csv").write_text("mine")
    fails_as = ["simulate", "--data", "urban_short", *SMALL, "--out", str(tmp_path)]
    assert cli.main(fails_as) == 3 and "speed.csv" in capsys.readouterr().err
    (tmp_path / "file").write_text("")
    assert cli.main(["filter", "--data", str(drive), "--out", str(tmp_path / "file")]) == 3
    assert "is a file" in capsys.readouterr().err
    with staged(tmp_path / "again", "simulate") as folder:
        (folder / "run.json").write_text('{"verb": "simulate", "files": ["imu.csv"]}')
        (folder / "imu.csv").write_text("")
    with staged(tmp_path / "again", "simulate") as folder:  # its own may be written over
        (folder / "run.json").write_text("{}")


def test_an_output_folder_that_holds_the_input_is_refused(drive, tmp_path, capsys):
    """As it was, `filter --data D --out D` removed every file that `simulate` had listed, with exit code 0."""
    before = {p.name: p.read_bytes() for p in drive.iterdir()}
    assert cli.main(["filter", "--data", str(drive), "--out", str(drive)]) == 3
    assert "holds the result of jaxnav simulate" in capsys.readouterr().err
    mine = copy(drive, tmp_path / "mine")  # without a run.json
    assert cli.main(["filter", "--data", str(mine), "--out", str(mine)]) == 3
    assert "choose an empty folder" in capsys.readouterr().err
    assert {p.name: p.read_bytes() for p in drive.iterdir()} == before
    tuned = tmp_path / "tuned"
    tuned.mkdir()
    (tuned / "run.json").write_text('{"verb": "filter", "files": ["tuned.toml", "run.json"]}')
    (tuned / "tuned.toml").write_text("[noise]\n")
    argv = ["filter", "--data", str(drive), "--params", str(tuned / "tuned.toml"), "--out", str(tuned)]
    assert cli.main(argv) == 3 and "is an input of this run" in capsys.readouterr().err
    assert (tuned / "tuned.toml").exists()


@pytest.mark.full
def test_tune_scenario_then_filter_with_its_parameters(capsys):
    what = ["--set", "tune.objective={drift = 1, nll = 0.1}", "--set", "tune.free=['noise', 'latency']"]
    argv = ["tune", "--data", "urban_short", "--json", *SMALL[:4], *TINY, *what]
    assert cli.main([*argv, "--out", "t", "--set", "data.gnss_latency_s=0.2"]) == 0
    metrics = json.loads(capsys.readouterr().out)["metrics"]
    rows = metrics["parameters"]
    assert rows["position.latency"]["remark"] == "simulated with 0.2" and rows["position.latency"]["datasheet"] == 0
    test = np.array(metrics["per_window"]["test"])
    before, after = (np.array(metrics["per_window"][f"{name}_m"]) for name in ("datasheet", "tuned"))
    assert before.shape == after.shape == (4,) and test.sum() == 2 and not np.array_equal(before, after)
    assert metrics["test"]["tuned"]["rms_m"] == pytest.approx(np.sqrt(np.mean(after[test] ** 2)))
    assert metrics["runs"] == {"urban_short": {"training": 1, "validation": 1, "test": 2}}
    history = [json.loads(line) for line in cli.Path("t/history.jsonl").read_text().splitlines()]
    assert [row["step"] for row in history] == [0, 1] and "noise.gyro_deg_per_sqrt_hour" in history[0]["params"]
    assert {"outage_drift.png", "tuning.png", "tuned.toml"} <= {p.name for p in cli.Path("t").iterdir()}

    tuned = config.read_params("t/tuned.toml")
    c = config.resolve([("", tuned)])
    assert c.noise.gyro_deg_per_sqrt_hour == pytest.approx(rows["noise.gyro"]["value"])
    grade = prepare.grade_of(config.resolve([("", {"filter": {"grade": "tactical"}})]), None)
    params = prepare.base_params(c, grade, np.zeros(3), 1.0, 0.1)
    assert float(params.measurements["velocity"].latency) == pytest.approx(rows["velocity.latency"]["value"])


@pytest.mark.full
def test_ctrl_c_in_tuning_keeps_the_best(monkeypatch, capsys):
    def interrupted(loss, spec, params, *rest, **more):
        row = {"step": 0, "loss": 1.0, "grad_norm": 1.0, "params": {"noise.gyro": 1e-4}}
        return Fit(params, 1.0, [row], Status.INTERRUPTED)

    monkeypatch.setattr(runs, "fit", interrupted)
    argv = ["tune", "--data", "urban_short", "--quiet", *SMALL, *TINY, "--set", "data.gnss_latency_s=0.2", "--out", "t"]
    assert cli.main(argv) == 130
    assert json.loads(cli.Path("t/run.json").read_text())["stopped"] == "interrupted"
    assert "interrupted" in capsys.readouterr().err and cli.Path("t/tuned.toml").exists()


def test_data_check_of_a_recording(drive, tmp_path, capsys):
    assert cli.main(["data", "check", str(drive)]) == 0
    assert "position" in capsys.readouterr().out
    write_recording(tmp_path / "r.npz", read_recording(drive))
    assert cli.main(["data", "check", str(tmp_path / "r.npz"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["metrics"]["name"] == "urban_short"


def test_info(capsys):
    assert cli.main(["info", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["metrics"]
    assert gc.get_threshold()[0] == cli.COLLECT
    assert (
        found["x64"] is True
        and "ekf15" in found["filters"]
        and "mlp_noise" in found["adapters"]
        and found["compilation_cache"] is None
    )
    assert cli.main(["info"]) == 0
    assert "rtkexplorer_drive" in capsys.readouterr().out


@pytest.mark.full
def test_warm_runs_a_filter_and_writes_nothing(drive, tmp_path, capsys, monkeypatch):
    """For a recording of one's own; what is kept of its programs is said."""
    monkeypatch.setenv("JAXNAV_CACHE_DIR", "")
    monkeypatch.chdir(tmp_path)
    before = sorted(path.name for path in drive.iterdir())
    assert cli.main(["filter", "--warm", "--data", str(drive), *SMALL[2:]]) == 0
    assert "no compiled programs are kept" in capsys.readouterr().out
    assert sorted(path.name for path in drive.iterdir()) == before and not list(tmp_path.iterdir())
