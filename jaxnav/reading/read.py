"""`read`: a file or folder of any known format becomes a checked recording."""

from typing import Any

from jaxnav.checkup import checkup
from jaxnav.io.files import FilePath
from jaxnav.io.readers import read_parts
from jaxnav.reading.timescale import in_one_scale
from jaxnav.types import Recording


def read(path: FilePath, **options: Any) -> Recording:
    """Read the recording in a file or folder; ``notes`` and ``findings`` say what was assumed, left out or doubtful.

    `jaxnav.checkup.checkup` asks it more, and takes longer.

    Args:
        path: file or folder of a format in `READERS`, or a column map (``docs/formats.md``).
        options: ``gnss``, a file with the fixes where ``path`` holds the IMU alone; ``map``, a column map that names
            other files, to read ``path`` (a folder, or its file) and ``gnss`` in their place; the fields of
            `jaxnav.io.mend.Changes` (``axes``, ``accel_sign``, ``lever_arm``, ``sd``, ``time_shift_s``, ``name``);
            options of the reader of either file.

    Raises:
        DataError: not there, of no known format, an unknown option, or nothing that could be used; names the file.
    """
    rec = in_one_scale(read_parts(path, **options))
    return rec._replace(findings=tuple(f for f in checkup(rec, quick=True) if f.warns or f in rec.findings))
