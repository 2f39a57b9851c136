"""Receivers' own formats, and which of several receivers is read."""

import numpy as np
import pytest

from jaxnav.io import mend
from jaxnav.io.formats.rosbag import from_receiver
from jaxnav.io.parts import with_fixes
from jaxnav.io.read import read_parts
from jaxnav.types import DataError
from tests.io.conftest import fixes

SENTENCES = ("GNGGA,100000.00,4806.0,N,01136.0,E,1,10,{hdop},475.8,M,45.0,M,,", "GNVTG,90.0,T,,M,10.0,N,18.5,K,A",
             "GNZDA,100000.00,01,06,2024,00,00")  # fmt: skip


def nmea(hdop: str = "0.8", order: tuple[int, ...] = (0, 1, 2)) -> list[str]:
    """Return twenty seconds of sentences without checksum."""
    bursts = [
        [SENTENCES[i].format(hdop=hdop).replace("100000.00", f"1000{k:02d}.00") for i in order] for k in range(20)
    ]
    return [line for burst in bursts for line in burst]


def checked(line: str) -> str:
    """Return a sentence with its checksum."""
    total = 0
    for byte in line.encode():
        total ^= byte
    return f"${line}*{total:02X}"


@pytest.mark.parametrize(
    ("written", "count", "words"),
    [
        (lambda lines: [checked(line) for line in lines], 20, None),
        (lambda lines: [f"${line}" for line in lines], 20, "60 sentences have no checksum and are taken"),
        (lambda lines: [f"12:00:01.5 RX {checked(line)}" for line in lines], 20, None),
        (lambda lines: [f"\\s:r1,c:1717236000*1A\\{checked(line)}" for line in lines], 20, None),
        (lambda lines: [checked(line) for line in lines[:-3]] + [f"${line}" for line in lines[-3:]], 19,
         "3 sentences have no checksum and are left out"),
        (lambda lines: [checked(line) for line in lines[:-3]] + ["$GNGGA,1000*00"], 19, "1 sentences are damaged"),
    ],
)  # fmt: skip
def test_nmea_as_loggers_write_it(tmp_path, written, count, words):
    (tmp_path / "log.txt").write_text("\r\n".join(written(nmea())) + "\r\n")
    parts = read_parts(tmp_path / "log.txt")
    position, velocity = (parts.aiding[name] for name in ("position", "velocity"))
    start = 1717236000.0 + 18.0
    np.testing.assert_allclose(position.t, start + np.arange(count), rtol=0, atol=1e-6)
    assert velocity.t[-1] == pytest.approx(start + count - 1, rel=0, abs=1e-6)
    np.testing.assert_allclose(velocity.value[-1], [10 * 1852 / 3600, 0.0, 0.0], atol=1e-9)
    assert words is None or any(words in str(note) for note in parts.notes)


def test_an_empty_hdop_is_an_assumed_sd(tmp_path, drive):
    (tmp_path / "log.txt").write_text("\r\n".join(checked(line) for line in nmea(hdop="")) + "\r\n")
    stream = read_parts(tmp_path / "log.txt").aiding["position"]
    assert len(stream.t) == 20
    span = stream._replace(t=stream.t - stream.t[0] + drive.imu.t[0] + 5.0)
    rec = mend.recording(fixes(drive)._replace(aiding={"position": span}))
    assert (rec.aiding["position"].sd == [3.0, 3.0, 6.0]).all()


@pytest.mark.parametrize(
    ("shares", "chosen"),
    [((1.0, 1.0), "a 0"), ((0.0, 1.0), "a 1"), ((0.6, 1.0), "a 0"), ((0.3, 0.4), "a 1"), ((0.0, 0.0), "a 0")],
)
def test_a_dead_first_receiver_does_not_hide_the_second(shares, chosen):
    masks = {f"a {i}": np.arange(100) < 100 * share for i, share in enumerate(shares)}
    notes: list[str] = []
    assert with_fixes("a.log", masks, None, notes) == chosen and "of a 0, a 1 (option receiver)" in notes[0]
    assert with_fixes("a.log", masks, "a 1", notes) == "a 1"
    with pytest.raises(DataError, match="a.log: receiver: no b, it has a 0, a 1"):
        with_fixes("a.log", masks, "b", notes)


@pytest.mark.parametrize(
    ("receiver", "estimate"),
    [
        ("/mavros/global_position/raw/fix", "/mavros/global_position/global"),
        ("/gps/fix", "/gps/filtered"),
        ("/fix", "/odometry/gps"),
        ("/gnss", "/ekf/global"),
    ],
)
def test_words_of_a_receivers_topic(receiver, estimate):
    assert from_receiver(receiver) > from_receiver(estimate)
