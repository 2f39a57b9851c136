"""Public recordings, by name: pinned upstream commit, hash of every file, licence and reader. None is shipped.

A data set is looked for in ``$JAXNAV_DATA_DIR/NAME`` and then in the cache that `fetch` fills; only `fetch` downloads.
"""

import difflib
import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from jaxnav.data.files import read_bytes
from jaxnav.data.formats.kth import read_kth
from jaxnav.data.formats.navego import read_navego
from jaxnav.data.formats.rtklib import read_drive
from jaxnav.data.formats.umn import read_umn
from jaxnav.types import DataError, Recording

DATA_DIR = "JAXNAV_DATA_DIR"  # environment variable: folder with a folder for each data set


class DataFile(NamedTuple):
    """One file, pinned."""

    name: str
    upstream: str  # path in the repository
    sha256: str
    size: int  # bytes


class Dataset(NamedTuple):
    """Where a data set comes from and how it is read."""

    repository: str  # owner/name on GitHub
    commit: str
    licence: str
    files: tuple[DataFile, ...]
    read: Callable[..., Recording] | None  # from ``entry`` in the folder; None has no IMU, so it is no recording
    entry: str = ""  # the file that the reader takes; empty is the folder


DATASETS: dict[str, Dataset] = {
    "rtkexplorer_drive": Dataset(
        repository="rtklibexplorer/GNSS_IMU",
        commit="8235ee6c5f349db529bf43ad556a3769b346b5a1",
        licence="BSD-3-Clause",
        files=(
            DataFile(
                "gnss_1934_sf.pos",
                "data/drive_0708/gnss_1934_sf.pos",
                "618fba5c7193e8eb448faf95c79c0d198233d5f4e5ad8ffec652893911ff7133",
                557772,
            ),
            DataFile(
                "imu_1934.csv",
                "data/drive_0708/imu_1934.csv",
                "f1126bf3b36efc4bef2dd2c7d93bb2a0e1b4ce714005cbea00a9218ad0b3b7a9",
                2475762,
            ),
            DataFile(
                "imu_1934.csv.tag",
                "data/drive_0708/imu_1934.csv.tag",
                "d30d13d5641df367559472b91b48325601a87c986bf2bb6af368684a36b5ec96",
                301132,
            ),
        ),
        read=read_drive,
    ),
    "umn_thor75": Dataset(
        repository="NorthStarUAS/insgnss_tools",
        commit="0b5f6b16f00997baa5e02f85d1959355aa2a4c82",
        licence="MIT",
        files=(
            DataFile(
                "thor_flight75_WaypointTracker_150squareWaypointNew_2012_10_10.mat",
                "flight_data/thor_flight75_WaypointTracker_150squareWaypointNew_2012_10_10.mat",
                "d87340d8a5ab2bbc0121e73521bb68bfc9042786c78329d965c5aca6d0431675",
                3795234,
            ),
        ),
        read=read_umn,
        entry="thor_flight75_WaypointTracker_150squareWaypointNew_2012_10_10.mat",
    ),
    "navego_synthetic": Dataset(
        repository="rodralez/NaveGo",
        commit="550d90660dceddf70af8957f1fdc988eb763a315",
        licence="LGPL-3.0",
        files=(
            DataFile(
                "gnss.mat",
                "examples/synthetic-data/gnss.mat",
                "5d2fb7a329fb2154b55560ee4bdd8c61e3e6ddf247ed8757f6ef0f987faacbf7",
                94247,
            ),
            DataFile(
                "imu1.mat",
                "examples/synthetic-data/imu1.mat",
                "ca7bc107a95f2cb24f791ebec0d3a85ae452c04cd74c4ddfd0b504ac11fefd94",
                4082543,
            ),
            DataFile(
                "imu2.mat",
                "examples/synthetic-data/imu2.mat",
                "106e1a83de2cab1599ed38e8da355de35d3b5833da48f88dc50de6297632dbee",
                4034637,
            ),
            DataFile(
                "ref.mat",
                "examples/synthetic-data/ref.mat",
                "4ee994f5cde3da55f69fdd0391b8b01cbc35448256bfcf59f9d06f005002e4ec",
                3901743,
            ),
        ),
        read=read_navego,
    ),
    "leador_rtk_track": Dataset(
        repository="i2Nav-WHU/KF-GINS",
        commit="f39bc2e7be8a47eb3bf8ba1dbcb0bf4e7a3edd6a",
        licence="GPL-3.0; use, do not redistribute",
        files=(
            DataFile(
                "GNSS-RTK.txt",
                "dataset/GNSS-RTK.txt",
                "3c1ecf6d03121d695f59ea8383af5ec4233ef9ff1c33939b7c42caa609a94521",
                286692,
            ),
        ),
        read=None,
        entry="GNSS-RTK.txt",
    ),
    "kth_gnss_ins": Dataset(
        repository="mrsandipandas/GPSaidedIMU",
        commit="753d6ba3e3295b5b046df0c99c015e56d33be5a2",
        licence="none stated; course data of I. Skog: use, do not redistribute",
        files=(
            DataFile(
                "GNSSaidedINS_data.mat",
                "GNSSaidedINS_data.mat",
                "a7e4c386e282b9e93e4c4702e207b409df83ceaf773a09720f95cd2812e062cf",
                1419302,
            ),
        ),
        read=read_kth,
        entry="GNSSaidedINS_data.mat",
    ),
}


def find(name: str) -> Dataset:
    """The entry of this name; DataError with the nearest known name."""
    if name not in DATASETS:
        near = difflib.get_close_matches(name, DATASETS, n=1)
        hint = f"did you mean {near[0]}?" if near else f"known are {', '.join(DATASETS)}"
        raise DataError(f"no data set {name!r}: {hint}")
    return DATASETS[name]


def locate(name: str) -> Path:
    """The folder that holds every file of a data set; DataError says how to get it."""
    files = [file.name for file in find(name).files]
    home = os.environ.get(DATA_DIR)
    if home and _holds(Path(home) / name, files):
        return Path(home) / name
    cache = _cache(name)  # only now: asking for it imports pooch
    if _holds(cache, files):
        return cache
    looked = f"{Path(home) / name} or {cache}" if home else f"{cache}, and {DATA_DIR} is not set"
    raise DataError(f"data set {name} is not in {looked}: run `jaxnav data fetch {name}`")


def verify(name: str) -> Path:
    """The folder of a data set after every file's sha256 was found right."""
    folder = locate(name)
    for file in find(name).files:
        digest = hashlib.sha256(read_bytes(folder / file.name)).hexdigest()
        if digest != file.sha256:
            raise DataError(f"{folder / file.name}: expected sha256 {file.sha256}, got {digest}")
    return folder


def load(name: str, **options: Any) -> Recording:
    """Verify and read a data set; ``options`` go to its reader (``imu="imu1"``, ``imu_delay=-0.1``, ...)."""
    dataset, folder = find(name), verify(name)
    if dataset.read is None:
        raise DataError(f"data set {name} has no IMU: read it with read_rtk_track({str(folder / dataset.entry)!r})")
    return dataset.read(folder / dataset.entry, **options)


def fetch(name: str) -> Path:
    """Download a data set into the cache, or find it there, and check every hash; nothing else goes online."""
    import pooch  # here: slow to import, and needed by nothing else

    dataset, folder = find(name), _cache(name)
    for file in dataset.files:
        url = f"https://raw.githubusercontent.com/{dataset.repository}/{dataset.commit}/{file.upstream}"
        try:
            pooch.retrieve(url, known_hash=f"sha256:{file.sha256}", fname=file.name, path=folder)
        except Exception as error:  # of pooch, requests, urllib3 and the file system
            raise DataError(f"{url}: cannot be fetched: {error}") from error
    return folder


def _holds(folder: Path, files: list[str]) -> bool:
    return all((folder / file).is_file() for file in files)


def _cache(name: str) -> Path:
    import pooch

    return Path(pooch.os_cache("jaxnav")) / name
