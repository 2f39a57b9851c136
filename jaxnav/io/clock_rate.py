"""Board time against GPS time, where a log has both: rate, jumps and repeated stamps."""

import numpy as np

from jaxnav.findings import finding
from jaxnav.io.parts import Parts

MAX_OSCILLATOR_ERROR = 1e-3  # relative rate; a larger one is a wrong time base, not an oscillator
MIN_FIXES, MIN_SPAN = 20, 20.0  # of a rate estimate; span in s
MIN_JUMP, MIN_REPEATED = 1.0, 5  # s between two fixes; repeated stamps that are reported


def at_gps_rate(parts: Parts, board: np.ndarray, gps: np.ndarray) -> Parts:
    """Return parts in board time at the rate of GPS time, with notes on the clock.

    The rate is the median slope over pairs of fixes, half a log from each other, without the jumps of either clock.

    Args:
        parts: of a log, in board time that counts from 0.
        board: (K,) s, board time of fixes.
        gps: (K,) s, GPS time (or UTC) of the same fixes, nan if unknown.
    """
    there = np.isfinite(board) & np.isfinite(gps)
    board, gps = board[there], gps[there]
    if board.size < MIN_FIXES or np.ptp(board) < MIN_SPAN:
        return parts
    notes = []
    moved = (np.diff(board) > 0) & (np.diff(gps) > 0)
    for name, stamps, other in (("board time", board, gps), ("GPS time", gps, board)):
        repeated = int(((np.diff(stamps) == 0) & (np.diff(other) > 0)).sum())
        if repeated >= MIN_REPEATED:
            notes.append(finding("clock.repeats", name, count=repeated, of=stamps.size))
    board, gps = (t[np.r_[True, moved]] for t in (board, gps))
    if board.size < MIN_FIXES:
        return parts._replace(notes=(*parts.notes, *notes))
    usual = float(np.median(np.diff(gps) / np.diff(board)))
    jumps = np.diff(gps) - usual * np.diff(board)
    far = np.abs(jumps) > MIN_JUMP
    if far.any():
        at = int(far.argmax())
        first = f"{jumps[at]:+.1f} s at t = {board[at + 1]:.2f} s"
        notes.append(finding("clock.jumps", count=int(far.sum()), words=first))
    even = gps - np.r_[0.0, np.cumsum(np.where(far, jumps, 0.0))]
    half = board.size // 2
    passed, run = even[half:] - even[:-half], board[half:] - board[:-half]
    far_apart = np.abs(run) > 0.1 * np.ptp(board)  # the board may have restarted
    rate = float(np.median(passed[far_apart] / run[far_apart])) if far_apart.any() else usual
    if abs(rate - 1.0) <= MAX_OSCILLATOR_ERROR:
        return parts._replace(notes=(*parts.notes, *notes))
    notes.append(finding("clock.rate", value=1 / rate))
    stretched = lambda stream: stream._replace(t=stream.t * rate)
    imu = (
        None
        if parts.imu is None
        else parts.imu._replace(t=parts.imu.t * rate, dt=None if parts.imu.dt is None else parts.imu.dt * rate)
    )
    aiding = {name: stretched(stream) for name, stream in parts.aiding.items()}
    truth = None if parts.truth is None else stretched(parts.truth)
    return parts._replace(imu=imu, aiding=aiding, truth=truth, notes=(*parts.notes, *notes))
