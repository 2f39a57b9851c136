"""NaveGo's structs in MATLAB files: IMU, fixes and reference."""

from pathlib import Path
from typing import Any

import numpy as np

from jaxnav.findings import finding
from jaxnav.io.checks import ned_to_enu
from jaxnav.io.formats.matfiles import field, read_structs
from jaxnav.io.parts import ImuRows, Parts, Stream
from jaxnav.types import DataError, Samples, Track


def _fixes(gnss: Any, path: Path) -> tuple[dict[str, Samples], np.ndarray]:
    t = field(gnss, "t", path, (None,))
    n = len(t)
    position = np.stack([field(gnss, name, path, (n,)) for name in ("lat", "lon", "h")], axis=1)
    sd = {name: np.tile(field(gnss, name, path, (3,)), (n, 1)) for name in ("stdm", "stdv")}  # N, E, D
    none = np.zeros((n, 3))
    aiding = {
        "position": Samples(t, position, sd["stdm"][:, [1, 0, 2]], none),
        "velocity": Samples(t, ned_to_enu(field(gnss, "vel", path, (n, 3))), sd["stdv"][:, [1, 0, 2]], none),
    }
    return aiding, field(gnss, "larm", path, (3,))


def _track(ref: Any, path: Path) -> Track:
    t = field(ref, "t", path, (None,))
    n = len(t)
    lla = np.stack([field(ref, name, path, (n,)) for name in ("lat", "lon", "h")], axis=1)
    rph = np.stack([field(ref, name, path, (n,)) for name in ("roll", "pitch", "yaw")], axis=1)
    return Track(t, lla, ned_to_enu(field(ref, "vel", path, (n, 3))), rph)


IMU_FIELDS, GNSS_FIELDS, REF_FIELDS = {"t", "wb", "fb"}, {"t", "lat", "stdm", "vel"}, {"t", "lat", "vel", "roll", "yaw"}


def recognises(path: Path, head: bytes) -> bool:
    """Return whether it is a MATLAB file with wb and fb in a struct, or a folder with one."""
    if not path.is_dir() and not head.startswith(b"MATLAB 5"):
        return False
    return bool(_having(_structs(path), IMU_FIELDS))


def read(path: Path, imu: str = "", fixes: str = "") -> Parts:
    """Read the IMU, the fixes and the reference of NaveGo's structs in a file or a folder; t as there.

    Args:
        path: the file or folder.
        imu: name of the struct of the IMU, where there are several; default the first.
        fixes: name of the struct of the fixes, likewise.

    Raises:
        DataError: no struct of this name, or one without a field that it needs.
    """
    structs, notes = _structs(path), []
    chosen = {}
    for part, name, fields in (("imu", imu, IMU_FIELDS), ("fixes", fixes, GNSS_FIELDS), ("reference", "", REF_FIELDS)):
        found = _having(structs, fields)
        if name and name not in found:
            raise DataError(f"{path}: {part}: no struct {name}, it has {', '.join(found)}")
        if found:
            chosen[part] = name or found[0]
        if len(found) > 1 and not name:
            notes.append(finding("stream.chosen", f"the {part}", words=f"{found[0]}, of {', '.join(found)}"))
    file, log = structs[chosen["imu"]]
    t = field(log, "t", file, (None,))
    rows = ImuRows(t, field(log, "wb", file, (len(t), 3)), field(log, "fb", file, (len(t), 3)))
    aiding, arm = {}, np.zeros(3)
    if "fixes" in chosen:
        file, gnss = structs[chosen["fixes"]]
        samples, arm = _fixes(gnss, file)
        aiding = {name: Stream(*stream) for name, stream in samples.items()}
    truth = None
    if "reference" in chosen:
        file, ref = structs[chosen["reference"]]
        truth = _track(ref, file)
    return Parts(str(path), rows, aiding, truth, arm, tuple(notes), name=path.stem)


def _structs(path: Path) -> dict[str, tuple[Path, Any]]:
    """Every struct by name with its file; files that cannot be read have none."""
    out: dict[str, tuple[Path, Any]] = {}
    for file in sorted(path.glob("*.mat")) if path.is_dir() else [path]:
        try:
            found = read_structs(file)
        except DataError:
            if not path.is_dir():
                raise
            continue
        out |= {name: (file, struct) for name, struct in found.items()}
    return out


def _having(structs: dict[str, tuple[Path, Any]], fields: set[str]) -> list[str]:
    return [name for name, (_, struct) in structs.items() if fields <= set(struct._fieldnames)]
