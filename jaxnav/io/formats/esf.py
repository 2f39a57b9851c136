"""Inertial sensors of u-blox receivers: ESF-RAW and ESF-MEAS, as u-blox' interface descriptions have them."""

import numpy as np

from jaxnav.findings import finding
from jaxnav.io.parts import USUAL_DELAY_S, ImuRows, TimeScale
from jaxnav.maths.units import DEG
from jaxnav.types import Note

RAW, MEAS = b"\x10\x03", b"\x10\x02"  # class and number
GYRO, ACCEL = (14, 13, 5), (16, 17, 18)  # data types of x, y, z
GYRO_UNIT, ACCEL_UNIT = DEG / 2**12, 1 / 2**10
TICKS = {"1 ms": 1e-3, "1/25600 s": 1 / 25600, "1 us": 1e-6}  # of the time tag, by receiver; s
MAX_MISFIT = 0.1  # share by which a tick may miss the time between fixes
TYPES = [("field", "<u4"), ("tag", "<u4")]


class Sensors:
    """Samples of a file in messages of one kind, and what their time tag was when fixes came.

    Args:
        message: class and number, `RAW` or `MEAS`.
    """

    def __init__(self, message: bytes) -> None:
        self.message = message
        self.samples: dict[int, dict[int, int]] = {}  # by time tag: value by data type
        self.epochs: list[tuple[float, int]] = []  # s of week, last tag before
        self.last, self.turns = -1, 0

    def take(self, frame: bytes) -> None:
        """Take a message of any kind."""
        body = frame[6:-2]
        if frame[2:4] != self.message:
            return
        if self.message == RAW:
            data = np.frombuffer(body[4 : 4 + 8 * ((len(body) - 4) // 8)], TYPES)
            fields, tags = data["field"], data["tag"]
        else:
            count = min(int.from_bytes(body[4:6], "little") >> 11, (len(body) - 8) // 4)
            fields = np.frombuffer(body[8 : 8 + 4 * max(count, 0)], "<u4")
            tags = np.full(fields.size, int.from_bytes(body[:4], "little"))
        for field, tag in zip(fields.tolist(), tags.tolist()):
            kind, value = (field >> 24) & 63, field & 0xFFFFFF
            if kind not in GYRO + ACCEL:
                continue
            if self.last - tag > 2**31:
                self.turns += 1
            self.last = tag
            at = tag + 2**32 * self.turns
            self.samples.setdefault(at, {})[kind] = value - ((value & 0x800000) << 1)

    def fix(self, tow: float) -> None:
        """Note that a fix of this second of the week came."""
        if self.last >= 0:
            self.epochs.append((tow, self.last + 2**32 * self.turns))

    def imu(self, week: float) -> tuple[ImuRows | None, tuple[Note, ...]]:
        """Return the samples, times from ``week`` (s) on, and notes; None of no samples, or of none with a time."""
        whole = {tag: row for tag, row in sorted(self.samples.items()) if len(row) == len(GYRO + ACCEL)}
        if not self.samples:
            return None, ()
        tow, tags = np.array(self.epochs, float).reshape(-1, 2).T
        known = np.unique(tags, return_index=True)[1]
        if len(whole) < 2 or known.size < 3 or np.ptp(tow[known]) <= 0:
            why = "no sample has all six axes" if len(whole) < 2 else "fewer than 3 fixes date their time tags"
            return None, (finding("file.other", f"imu of {len(self.samples)} ESF samples", words=f": {why}"),)
        slope = float(np.polyfit(tags[known] - tags[known][0], tow[known], 1)[0])
        name, tick = min(TICKS.items(), key=lambda row: abs(np.log(row[1] / max(slope, 1e-12))))
        if abs(slope / tick - 1) > MAX_MISFIT:
            return None, (finding("file.other", "imu of ESF", words=f": a tick of its tags lasts {slope:.3g} s"),)
        begin = float((tow - tags * tick).min())  # a fix comes after its epoch, the sooner the better it dates the tag
        t = week + begin + np.array(list(whole)) * tick
        value = np.array([[row[kind] for kind in GYRO + ACCEL] for row in whole.values()], float)
        lost = len(self.samples) - len(whole)
        notes = (finding("file.left_out", "imu", count=lost, words="ESF samples without an axis"),) if lost else ()
        said = finding("time.by_message", "imu", USUAL_DELAY_S, words=f", by ESF's ticks of {name}")
        return ImuRows(t, value[:, :3] * GYRO_UNIT, value[:, 3:] * ACCEL_UNIT, scale=TimeScale.GPS), (*notes, said)
