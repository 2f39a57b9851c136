"""`jaxnav stream`: a recording at its pace, and lines from standard input, some of them none."""

import csv
import io
import json
import socket
import time

import numpy as np
import pytest

from jaxnav.app import cli
from jaxnav.app.config import resolve
from jaxnav.app.jobs.stream import FORMATS, Event, lines_of, paced, parsed, played, sink, stream
from jaxnav.io import read_recording
from jaxnav.types import ConfigError, DataError
from tests.test_now import example


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    out = tmp_path_factory.mktemp("stream") / "drive"
    argv = ["simulate", "--data", "urban_short", "--out", str(out), "--quiet", "--set", "data.options.duration_s=40"]
    assert cli.main(argv) == 0
    return out


def rows_of(text):
    return list(csv.DictReader(io.StringIO(text)))


@pytest.mark.full
def test_a_recording_and_its_lines_end_near_the_truth(drive, capsys):
    rec = read_recording(drive)
    arm = rec.lever_arm.tolist()
    assert cli.main(["stream", "--data", str(drive), "--every", "5", "--set", "filter.cov_stride=5"]) == 0
    said = capsys.readouterr()
    played_rows = rows_of(said.out)
    assert "starts at t = " in said.err and "a sample takes" in said.err
    lines = "".join(f"{e.name},{e.t!r},{','.join(map(repr, e.values))}\n" for e in played(rec))
    config = resolve([("test", {"filter": {"cov_stride": 5}, "mounting": {"lever_arm_m": arm}})])
    out = io.StringIO()
    found = stream(config, 0.0, 5.0, io.StringIO("# ours\nhello,1\nimu,1,2\n" + lines), out)
    assert found.metrics["ok"] and "2 not used: lines that are none, such as 'hello,1'" in found.text
    for rows in (played_rows, rows_of(out.getvalue())):
        t = np.array([float(r["t_s"]) for r in rows])
        assert 4 <= len(rows) <= 8 and (np.diff(t) >= 5.0 - 1e-9).all()
        at = int(np.argmin(np.abs(rec.truth.t - t[-1])))
        north = (np.radians(float(rows[-1]["lat_deg"])) - rec.truth.lla[at, 0]) * 6.37e6
        assert abs(north) < 4 * float(rows[-1]["sd_n_m"]) + 1.0


def test_a_vehicle_that_never_moves_has_no_start():
    lines = io.StringIO("".join(f"imu,{0.1 * i:.1f},0,0,0,0,0,-9.81\n" for i in range(1, 300)))
    with pytest.raises(DataError, match="no start in 299 lines"):
        stream(resolve([]), 0.0, 1.0, lines, io.StringIO())


def test_events_come_at_their_own_pace():
    events = [Event(0.0, "imu", ()), Event(0.3, "imu", ()), Event(0.6, "imu", ())]
    begin = time.monotonic()
    assert list(paced(iter(events), 3.0)) == events and 0.19 < time.monotonic() - begin < 0.6
    bad: list[str] = []
    good = list(parsed(io.StringIO("velocity,1,1,2,3,.1,.1,.1\nvelocity,1,1\nimu,x,1,2,3,4,5,6\n\n"), bad))
    assert good == [Event(1.0, "velocity", (1.0, 2.0, 3.0, 0.1, 0.1, 0.1))] and len(bad) == 2


def test_rows_are_the_same_numbers_in_every_format(capsys):
    now = example()
    said = {name: (head, row(now)) for name, (head, row) in FORMATS.items()}
    (csv_row,) = rows_of("\n".join(said["csv"]))
    head, text = said["jsonl"]
    assert head == "" and json.loads(text) == {name: float(cell) for name, cell in csv_row.items()}
    assert said["nmea"] == ("", now.gga()) and float(csv_row["h_m"]) == 520.0
    assert cli.main(["stream", "--format", "xml"]) == 2 and "invalid choice: 'xml'" in capsys.readouterr().err


def test_lines_of_other_axes_and_units():
    lines = io.StringIO("imu,1,90,0,-45,0,0.5,1\nposition,1,180,-90,30,1,2,3\nvelocity,1,1,2,3,1,1,1\n")
    imu, position, velocity = parsed(lines, [], lines_of("flu", "g, deg/s,deg"))
    np.testing.assert_allclose(imu.values, [np.pi / 2, 0, np.pi / 4, 0, -0.5 * 9.80665, -9.80665], rtol=1e-4)
    np.testing.assert_allclose(position.values, [np.pi, -np.pi / 2, 30, 1, 2, 3])
    assert velocity.values == (1, 2, 3, 1, 1, 1)


@pytest.mark.parametrize("axes, units, words", [
    ("fll", None, "--axes"), (None, "deg/sec", "did you mean deg/s"), (None, "rad/s,deg/s", "two units of one rate"),
])  # fmt: skip
def test_axes_and_units_that_are_none(axes, units, words):
    with pytest.raises(ConfigError, match=words):
        lines_of(axes, units)


@pytest.mark.full
def test_a_recording_names_its_axes_by_itself(capsys):
    assert cli.main(["stream", "urban_short", "--axes", "flu"]) == 2
    assert "[data] options.axes" in capsys.readouterr().err


def test_rows_by_udp():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(5.0)
        with sink(io.StringIO(), receiver.getsockname()[1]) as put:
            put("$GPGGA,1")
        assert receiver.recv(100) == b"$GPGGA,1\n"
    with pytest.raises(ConfigError, match="no port 70000"), sink(io.StringIO(), 70000):
        pass
