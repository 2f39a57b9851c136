"""A log's own clock beside GPS time, where the log has both: rate, jumps and stamps that stand still."""

import numpy as np

from jaxnav.data.parts import Parts

RATE = 1e-3  # a larger difference of the rates is no oscillator's: the log's clock is wrong
FEWEST, SHORTEST = 20, 20.0  # fixes; s: less says little of a rate
JUMP, STUCK = 1.0, 5  # s; equal stamps in a row


def at_gps_rate(parts: Parts, board: np.ndarray, gps: np.ndarray) -> Parts:
    """Return parts whose times run as GPS time does, with notes on the clock.

    The rate is the median slope of pairs of fixes that are half a log apart, without the jumps of either clock.

    Args:
        parts: of a log, in its own time.
        board: (K,) s, own time of fixes.
        gps: (K,) s, GPS time (or UTC) of the same fixes; nan where there is none.
    """
    there = np.isfinite(board) & np.isfinite(gps)
    board, gps = board[there], gps[there]
    if board.size < FEWEST or np.ptp(board) < SHORTEST:
        return parts
    notes = []
    moved = (np.diff(board) > 0) & (np.diff(gps) > 0)
    for name, own, other in (("the log's own time", board, gps), ("GPS time", gps, board)):
        still = int(((np.diff(own) == 0) & (np.diff(other) > 0)).sum())
        if still >= STUCK:
            notes.append(f"{name} stands still in {still} of {own.size} fixes.")
    board, gps = (t[np.r_[True, moved]] for t in (board, gps))
    if board.size < FEWEST:
        return parts._replace(notes=(*parts.notes, *notes))
    usual = float(np.median(np.diff(gps) / np.diff(board)))
    jumps = np.diff(gps) - usual * np.diff(board)
    far = np.abs(jumps) > JUMP
    if far.any():
        at = int(far.argmax())
        first = f"{jumps[at]:+.1f} s at t = {board[at + 1]:.2f} s"
        notes.append(f"GPS time jumps against the log's clock {far.sum()} time(s), first by {first}.")
    even = gps - np.r_[0.0, np.cumsum(np.where(far, jumps, 0.0))]
    half = board.size // 2
    passed, run = even[half:] - even[:-half], board[half:] - board[:-half]
    far_apart = np.abs(run) > 0.1 * np.ptp(board)  # not so where the clock starts anew
    rate = float(np.median(passed[far_apart] / run[far_apart])) if far_apart.any() else usual
    if abs(rate - 1.0) <= RATE:
        return parts._replace(notes=(*parts.notes, *notes))
    notes.append(f"the log's clock runs at {1 / rate:.5f} of GPS time: its times are stretched to that.")
    stretched = lambda stream: stream._replace(t=stream.t * rate)
    imu = None if parts.imu is None else parts.imu._replace(
        t=parts.imu.t * rate, dt=None if parts.imu.dt is None else parts.imu.dt * rate
    )  # fmt: skip
    aiding = {name: stretched(stream) for name, stream in parts.aiding.items()}
    truth = None if parts.truth is None else stretched(parts.truth)
    return parts._replace(imu=imu, aiding=aiding, truth=truth, notes=(*parts.notes, *notes))
