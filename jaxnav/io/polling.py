"""Repair a log whose writer polled a free-running sensor: host numpy.

A logger that reads the sensor's newest sample on a clock a little slower than the sensor's sees the sensor's
phase slide past its phase. Where the two meet, jitter makes it read one sample twice and miss another: a burst with n
repeated rows and n + 1 lost samples, once per beat of the two rates. Integrated as it stands, each event adds the
difference of two neighbouring samples times the sample time: under vibration, a random walk of angle far above the
sensor's (on a car with 5 deg/s of vibration, 0.1 deg/sqrt(s)).

Here the repeated rows go, each lost sample gets its place and a value, and the stream gets the sensor's even clock.
The sensor is assumed to be the faster of the two; a log without repeated rows passes unchanged.
"""

from typing import NamedTuple

import numpy as np

ORDER = 12  # of the autoregressive model of the vibration
MODEL_SAMPLES = 160  # samples that the model is fitted to
MAX_LEAD_POLLS = 10  # polls: how far before a repeated row its lost sample can be
MAX_OFF_POLLS = 1.5  # polls: how far a lost sample may be from where the beat of the two clocks puts it
BURST_GAP = 60  # polls without a repeat that separate two bursts


class Repaired(NamedTuple):
    """An even stream, and where it was mended."""

    values: np.ndarray  # (M, c)
    poll: np.ndarray  # (M,) index of the poll that read the sample; for a lost sample, of the one before it
    lost: np.ndarray  # (M,) bool, filled in


class _Model(NamedTuple):
    """Prediction of each channel from its last ORDER samples, and how good it is."""

    mean: np.ndarray  # (c,)
    taps: np.ndarray  # (c, ORDER + 1) prediction-error filter
    sd: np.ndarray  # (c,) of its output


def repeats(values: np.ndarray) -> np.ndarray:
    """Rows equal to the row before them in all channels, (N,) bool."""
    return np.concatenate([[False], np.all(values[1:] == values[:-1], axis=1)])


def repair(values: np.ndarray) -> Repaired:
    """Mend a polled stream (N, c). Mending looks at most 0.3 s (at 100 Hz) ahead: a fixed lag, not the future.

    Vibration is predicted by a model fitted to the clean stretch before each burst; a lost sample belongs where
    inserting one makes the stream around it most predictable, and gets the least-squares value.
    """
    repeated = repeats(values)
    at = np.flatnonzero(repeated)
    lost_after: list[int] = []
    if at.size:
        for burst in np.split(at, np.flatnonzero(np.diff(at) > BURST_GAP) + 1):
            lost_after += _locate(values, repeated, burst)
    kept = np.flatnonzero(~repeated)
    where = np.searchsorted(kept, lost_after, side="right")
    stream = np.insert(values[kept], where, np.nan, axis=0)
    lost = np.insert(np.zeros(kept.size, bool), where, True)
    return Repaired(_fill(stream, lost), np.insert(kept, where, lost_after), lost)


def _model(rows: np.ndarray) -> _Model:
    """Fitted by least squares to clean samples (n, c), with a little ridge for channels that do not move."""
    mean, taps, sd = rows.mean(0), [], []
    for x in (rows - mean).T:
        past = np.lib.stride_tricks.sliding_window_view(x, ORDER + 1)[:, ::-1]
        normal = past[:, 1:].T @ past[:, 1:] + 1e-6 * (x @ x + 1e-12) * np.eye(ORDER)
        taps.append(np.concatenate([[1.0], -np.linalg.solve(normal, past[:, 1:].T @ past[:, 0])]))
        sd.append(np.std(past @ taps[-1]) + 1e-9)
    return _Model(mean, np.array(taps), np.array(sd))


def _nearby_model(values: np.ndarray, bad: np.ndarray, first: int, last: int) -> _Model | None:
    """From the clean samples before row ``first``, or, at the start of a log, after row ``last``; None without any."""
    for part in (slice(max(0, first - MODEL_SAMPLES), first), slice(last, last + MODEL_SAMPLES)):
        clean = values[part][~bad[part]]
        if clean.shape[0] >= 3 * ORDER:
            return _model(clean)
    return None


def _solve(x: np.ndarray, missing: np.ndarray, taps: np.ndarray) -> tuple[np.ndarray, float]:
    """Least-squares values of the missing entries of one channel (n,), and the squared prediction error left."""
    n = x.size
    A = np.zeros((n - ORDER, n))
    for i in range(ORDER + 1):
        A[np.arange(n - ORDER), np.arange(ORDER, n) - i] = taps[i]
    b = -A[:, ~missing] @ x[~missing]
    value, *_ = np.linalg.lstsq(A[:, missing], b, rcond=None)
    return value, float(np.sum((A[:, missing] @ value - b) ** 2))


def _locate(values: np.ndarray, repeated: np.ndarray, burst: np.ndarray) -> list[int]:
    """After which polls of a burst a sample was lost: one before each repeated row, and one after the last.

    The logger is ahead of its slot from a lost sample to the next repeated row, and for longer each time.
    """
    model = _nearby_model(values, repeated, burst[0] - MAX_LEAD_POLLS, burst[-1] + MAX_LEAD_POLLS)
    if model is None:
        return []
    period = float(np.median(np.diff(burst))) if burst.size > 1 else MAX_LEAD_POLLS - 1.5
    edges = [*burst, min(int(burst[-1] + np.ceil(period)), values.shape[0] - 1)]
    lost: list[int] = []
    low = max(int(burst[0]) - MAX_LEAD_POLLS, 1)
    for i, high in enumerate(edges):
        candidates = np.arange(low, high)[~repeated[low:high]]
        if candidates.size == 0:
            continue
        ahead = period * (i + 0.5) / len(edges)
        cost = (
            _costs(values, repeated, model, lost, candidates, low, high)
            + ((high - 1 - candidates - ahead) / MAX_OFF_POLLS) ** 2
        )
        lost.append(int(candidates[np.argmin(cost)]))
        low = int(high)
    return lost


def _costs(
    values: np.ndarray,
    repeated: np.ndarray,
    model: _Model,
    lost: list[int],
    candidates: np.ndarray,
    low: int,
    high: int,
) -> np.ndarray:
    """How unpredictable the stream around polls low to high is, (K,), with samples lost after ``lost`` and a candidate.

    For each candidate the smallest sum of squared prediction errors over the values of the lost samples, of all
    channels in units of their sd: all candidates and channels side by side.
    """
    begin, end = max(0, low - 2 * ORDER), min(values.shape[0], high + ORDER)
    window = np.arange(begin, end)[~repeated[begin:end]]
    before = np.searchsorted(window, [p for p in lost if p >= begin], side="right")
    after = np.searchsorted(window, candidates, side="right")  # a candidate comes behind a lost one
    M, K = before.size + 1, candidates.size
    n = window.size + M
    if n <= ORDER:  # at an end of the log: too short to predict anything
        return np.zeros(K)
    missing = np.column_stack([np.tile(before, (K, 1)), after]) + np.arange(M)  # (K, M) places in the mended stream
    mask = np.zeros((K, n), bool)
    mask[np.arange(K)[:, None], missing] = True
    source = np.clip(np.cumsum(~mask, 1) - 1, 0, window.size - 1)
    x = np.where(mask[..., None], 0.0, (values[window] - model.mean)[source])  # (K, n, c)
    left = sum(x[:, ORDER - i : n - i] * model.taps[:, i] for i in range(ORDER + 1))  # (K, n - ORDER, c)
    # effect of a lost sample on each prediction error: its tap, (K, n - ORDER, M, c)
    tap = np.arange(ORDER, n)[:, None] - missing[:, None]
    adds = np.where(((tap >= 0) & (tap <= ORDER))[..., None], model.taps.T[np.clip(tap, 0, ORDER)], 0.0)
    normal = np.einsum("knic,knjc->kcij", adds, adds) + 1e-9 * np.eye(M)
    right = np.einsum("knic,knc->kci", adds, left)
    gained = np.einsum("kci,kci->kc", right, np.linalg.solve(normal, right[..., None])[..., 0])
    return (((left**2).sum(1) - gained) / model.sd**2).sum(1)


def _fill(stream: np.ndarray, lost: np.ndarray) -> np.ndarray:
    """Values for the lost rows (nan) from the samples around them; by interpolation where no model could be made."""
    out = stream.copy()
    at = np.flatnonzero(lost)
    if at.size == 0:
        return out
    index, known = np.arange(lost.size), ~lost
    for c in range(out.shape[1]):
        out[lost, c] = np.interp(index[lost], index[known], stream[known, c])
    for group in np.split(at, np.flatnonzero(np.diff(at) > BURST_GAP) + 1):
        begin, end = max(0, group[0] - 2 * ORDER), min(lost.size, group[-1] + 2 * ORDER)
        model = _nearby_model(stream, lost, group[0], group[-1] + 1)
        if model is None or end - begin <= ORDER:
            continue
        missing = lost[begin:end]
        for c in range(out.shape[1]):
            x = np.where(missing, 0.0, out[begin:end, c] - model.mean[c])
            out[begin:end, c][missing] = _solve(x, missing, model.taps[c])[0] + model.mean[c]
    return out
