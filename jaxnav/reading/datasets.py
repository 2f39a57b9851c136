"""Public recordings, by name: pinned upstream commit, hash of every file, licence and column map. None is shipped.

Their properties are data, in ``recordings/`` next to this file. A data set is looked for in
``$JAXNAV_DATA_DIR/NAME`` and then in the cache that `fetch` fills; only `fetch` downloads.
"""

import hashlib
import os
import tomllib
from pathlib import Path
from typing import Any, NamedTuple

from jaxnav.io.files import read_bytes
from jaxnav.types import DataError, Json, Recording, nearest

DATA_DIR = "JAXNAV_DATA_DIR"  # environment variable: folder with a folder for each data set
RECORDINGS = Path(__file__).with_name("recordings")


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
    map: Path | None = None  # column map; None: the folder, or its only file, is read as it is
    fixes_only: bool = False  # without an IMU: fixes for another recording
    options: Json = {}  # of `jaxnav.reading.read.read`
    settings: Json = {}  # values that its files lack; the user's settings take precedence


def _datasets() -> dict[str, Dataset]:
    def dataset(name: str, about: Json) -> Dataset:
        files, path = tuple(DataFile(**file) for file in about["files"]), RECORDINGS / f"{name}.toml"
        return Dataset(
            about["repository"], about["commit"], about["licence"], files, path if path.exists() else None,
            about.get("fixes_only", False), about.get("read", {}), about.get("settings", {}),
        )  # fmt: skip

    table = tomllib.loads((RECORDINGS / "sources.toml").read_text(encoding="utf-8"))
    return {name: dataset(name, about) for name, about in table.items()}


DATASETS = _datasets()


def find(name: str) -> Dataset:
    """Return the entry of this name.

    Raises:
        DataError: an unknown name.
    """
    if name not in DATASETS:
        raise DataError(f"no data set {name!r}: {nearest(name, DATASETS)}")
    return DATASETS[name]


def locate(name: str) -> Path:
    """Return the folder that holds every file of a data set; DataError says how to get it."""
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
    """Return the folder of a data set after a check of every file's sha256."""
    folder = locate(name)
    for file in find(name).files:
        digest = hashlib.sha256(read_bytes(folder / file.name)).hexdigest()
        if digest != file.sha256:
            raise DataError(f"{folder / file.name}: expected sha256 {file.sha256}, got {digest}")
    return folder


def load(name: str, **options: Any) -> Recording:
    """Verify and read a data set.

    Args:
        name: a row of `DATASETS`.
        options: of `jaxnav.reading.read.read`, such as ``imu="imu1"`` or ``time_shift_s=-0.1``.

    Raises:
        DataError: an unknown name, a file that is missing or another, an unknown option.
    """
    from jaxnav.reading.read import read  # with the checks: a list of names does not wait for them

    dataset, folder = find(name), verify(name)
    if dataset.fixes_only:
        raise DataError(f"data set {name} has no IMU: {folder / dataset.files[0].name} is the gnss= of a recording")
    options = dataset.options | options
    if dataset.map is not None:
        rec = read(dataset.map, folder=folder, **options)
    else:
        rec = read(folder / dataset.files[0].name if len(dataset.files) == 1 else folder, **options)
    return rec._replace(name=name)


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
