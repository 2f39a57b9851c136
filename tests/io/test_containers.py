"""Recordings inside of .zip, .gz and .xlsx: read as they are outside, or refused with the archive's name."""

import gzip
import shutil
import zipfile

import numpy as np
import pytest

from jaxnav.io.canonical import write_recording
from jaxnav.io.draft import draft
from jaxnav.io.files import format_csv
from jaxnav.io.sheet import numbers, open_sheet
from jaxnav.reading.read import read
from jaxnav.types import DataError


def zipped(folder, archive, inside):
    """Write the files of a folder into an archive, as a computer does: with those that it adds."""
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as out:
        for file in folder.iterdir():
            out.write(file, f"{inside}{file.name}")
            out.writestr(f"__MACOSX/{inside}._{file.name}", b"\0\5\x16\7")


@pytest.mark.parametrize("inside", ["", "drive/", "a/b/"])
def test_a_folder_in_an_archive_is_the_folder(drive, tmp_path, inside):
    write_recording(tmp_path / "drive", drive)
    zipped(tmp_path / "drive", tmp_path / "drive.zip", inside)
    rec = read(tmp_path / "drive.zip")
    np.testing.assert_array_equal(rec.imu.gyro, read(tmp_path / "drive").imu.gyro)
    np.testing.assert_array_equal(rec.aiding["position"].value, drive.aiding["position"].value)


def test_files_of_any_reader_may_be_compressed(drive, tmp_path):
    write_recording(tmp_path / "drive", drive)
    for name in ("imu.csv", "position.csv"):
        with gzip.open(tmp_path / f"{name}.gz", "wb") as out:
            out.write((tmp_path / "drive" / name).read_bytes())
    rec = read(tmp_path / "imu.csv.gz")
    assert rec.name == "imu" and rec.imu.t.size == drive.imu.t.size
    with zipfile.ZipFile(tmp_path / "imu.zip", "w") as out:
        out.write(tmp_path / "drive" / "imu.csv", "imu.csv")
    assert read(tmp_path / "imu.zip").imu.t.size == drive.imu.t.size


def test_a_refusal_names_the_archive_and_leaves_nothing(drive, tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    (tmp_path / "temporary").mkdir()
    write_recording(tmp_path / "drive", drive)
    lines = (tmp_path / "drive" / "position.csv").read_text().splitlines()
    (tmp_path / "drive" / "position.csv").write_text("\n".join([*lines[:3], "x,y", *lines[3:]]) + "\n")
    zipped(tmp_path / "drive", tmp_path / "drive.zip", "drive/")
    with pytest.raises(DataError, match=r"drive\.zip/position\.csv: line 4"):
        read(tmp_path / "drive.zip")
    whole = (tmp_path / "drive.zip").read_bytes()
    (tmp_path / "cut.zip").write_bytes(whole[:2000])
    with pytest.raises(DataError, match=r"cut\.zip: of no known format"):
        read(tmp_path / "cut.zip")
    (tmp_path / "cut.csv.gz").write_bytes(gzip.compress(whole)[:2000])
    with pytest.raises(DataError, match=r"cut\.csv\.gz: cannot be unpacked"):
        read(tmp_path / "cut.csv.gz")
    monkeypatch.setattr("jaxnav.io.containers.MAX_BYTES", 1000)
    with pytest.raises(DataError, match=r"drive\.zip: unpacks to more than 1000 bytes"):
        read(tmp_path / "drive.zip")
    assert not list((tmp_path / "temporary").iterdir())
    shutil.rmtree(tmp_path / "drive")


def test_a_workbook_is_a_table(tmp_path):
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    for row in (["t", "wx", "note"], [0.01, 1.5, "still, here"], [0.02, None, "moving"]):
        book.active.append(row)
    book.save(tmp_path / "log.xlsx")
    sheet = open_sheet(tmp_path / "log.xlsx")
    np.testing.assert_array_equal(numbers(sheet, "wx"), [1.5, np.nan])
    assert sheet.columns["note"].tolist() == ["still, here", "moving"]


def test_a_column_map_reads_and_drafts_what_is_in_archives(drive, tmp_path):
    """Compressed files that it names, and members that a draft of an archive names."""
    names = ["t_s", *(f"gyro_{a}_radps" for a in "xyz"), *(f"accel_{a}_mps2" for a in "xyz")]
    table = np.column_stack([drive.imu.t, drive.imu.gyro, drive.imu.accel])
    (tmp_path / "log").mkdir()
    (tmp_path / "log" / "sensors.csv").write_text(format_csv(names, table))
    zipped(tmp_path / "log", tmp_path / "log.zip", "a/")
    found = draft([tmp_path / "log.zip"], tmp_path)
    assert found.tables["imu"]["file"] == "log.zip/a/sensors.csv"
    (tmp_path / "sensors.csv.gz").write_bytes(gzip.compress((tmp_path / "log" / "sensors.csv").read_bytes()))
    for file in ("log.zip/a/sensors.csv", "sensors.csv.gz"):
        (tmp_path / "map.toml").write_text(found.text().replace("log.zip/a/sensors.csv", file))
        np.testing.assert_array_equal(read(tmp_path / "map.toml").imu.gyro, drive.imu.gyro)
    (tmp_path / "sensors.csv.gz").write_bytes((tmp_path / "sensors.csv.gz").read_bytes()[:500])
    with pytest.raises(DataError, match="sensors.csv.gz: cannot be read from the archive"):
        read(tmp_path / "map.toml")
