"""Temporal alignment of films of the same motion, and detection of the release and of the end of the motion.

The signal of a film is the fraction of pixels that change between frames, which depends less on the view than the
amount of change. Increments of these signals correlate when something falls, lands or stops. The peak of the
cross-correlation of each pair of films is refined by a parabola, and the offsets of all films are a robust
least-squares solution over all pairs. With sound, the signal is the loudness.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stages.core.errors import InputError

log = logging.getLogger(__name__)
MIN_CHANGE = 0.03  # smallest change of a pixel's colour (0..1) that is not noise
NOISE_FACTOR = 6.0  # smallest change of a pixel that is not noise, relative to the median change of all pixels
PAIR_ERROR = 0.3  # scale of the errors of pairwise offsets in the robust weights [frames]
MIN_CORRELATION = 0.6  # smallest best correlation of a film with others; below it, the film shows another motion
MIN_OVERLAP = 0.6  # smallest overlap of two films, relative to the shorter one
ROUNDS = 20  # number of rounds of iterative reweighting
ONSET = 0.1  # speed at which motion begins or ends, relative to the highest speed
ONSET_FRAMES = 3  # number of frames from which the release is extrapolated
FLOOR = 0.1  # quantile of the changes between frames that is taken as noise


@dataclass(frozen=True)
class MotionSignal:
    """Amount of motion in a film; entry k is the change from frame k to frame k + 1."""

    share: np.ndarray  # fraction of the pixels that change
    square: np.ndarray  # mean squared change of the colours (0..1)

    @property
    def speed(self) -> np.ndarray:
        """Root mean square change, without noise."""
        return np.sqrt(np.maximum(self.square - np.quantile(self.square, FLOOR), 0))


def motion_signal(frames: Sequence[np.ndarray]) -> MotionSignal:
    """The signal of a film with frames (h, w, 3), 0..255; small frames are sufficient."""
    if len(frames) < 2:
        return MotionSignal(np.zeros(0), np.zeros(0))
    changes = np.stack([np.sqrt(np.square((b.astype(np.float32) - a) / 255).mean(-1))
                        for a, b in zip(frames, frames[1:], strict=False)])  # fmt: skip
    limit = max(MIN_CHANGE, NOISE_FACTOR * float(np.median(changes)))
    return MotionSignal((changes > limit).mean((1, 2)), np.square(changes).mean((1, 2)))


def find_offsets(signals: dict[str, np.ndarray], rate: float = 1.0) -> dict[str, float]:
    """Offset [frames] by which each film shows the same moment later than the first film.

    `signals` have `rate` entries per frame. Films that do not correlate with the others are left out, with a warning.
    Raises InputError if fewer than two are left.
    """
    names, found = list(signals), {}
    for i, a in enumerate(names):
        for j in range(i):
            found[i, j] = _lag(np.diff(signals[names[j]]), np.diff(signals[a]))
    best = [max((c for pair, (_, c) in found.items() if i in pair), default=0.0) for i in range(len(names))]
    kept = [i for i in range(len(names)) if best[i] >= MIN_CORRELATION]
    for i in set(range(len(names))) - set(kept):
        log.warning(
            "%s: left out, as it shows no motion in common with the other films; give its time with --offsets", names[i]
        )
    if len(kept) < 2:
        raise InputError("the films show no common motion that could synchronise them; give their times with --offsets")
    rows = [(kept.index(i), kept.index(j), lag, c) for (i, j), (lag, c) in found.items() if i in kept and j in kept]
    offsets = _solve(len(kept), rows, PAIR_ERROR * rate) / rate
    return {names[i]: float(x) for i, x in zip(kept, offsets - offsets[0], strict=True)}


def _lag(a: np.ndarray, b: np.ndarray) -> tuple[float, float]:
    """Lag of b relative to a, at the peak of their normalised cross-correlation refined by a parabola; and the peak."""
    if min(len(a), len(b)) < 3:
        return 0.0, 0.0
    ones = [np.ones_like(x) for x in (a, b)]
    power = np.correlate(b * b, ones[0], "full") * np.correlate(ones[1], a * a, "full")
    overlap = np.correlate(ones[1], ones[0], "full")
    c = np.correlate(b, a, "full") / np.sqrt(np.maximum(power, 1e-12))
    c[overlap < MIN_OVERLAP * min(len(a), len(b))] = -1.0
    k = int(c.argmax())
    peak = float(c[k])
    if 0 < k < len(c) - 1:
        left, middle, right = c[k - 1 : k + 2]
        k += 0.5 * (left - right) / min(left - 2 * middle + right, -1e-12)
    return k - (len(a) - 1), peak


def _solve(count: int, rows: list[tuple[int, int, float, float]], tolerance: float) -> np.ndarray:
    """Robust offsets from pairs (i, j, offset i - offset j, correlation), by iteratively reweighted least squares."""
    A, b, weight = np.zeros((len(rows), count)), np.array([r[2] for r in rows]), np.array([r[3] for r in rows])
    for row, (i, j, *_) in enumerate(rows):
        A[row, i], A[row, j] = 1, -1
    weight = np.square(np.maximum(weight, 1e-3))
    x = np.zeros(count)
    for k in range(ROUNDS):
        robust = weight / (1 + np.square((A @ x - b) / tolerance)) ** 2 if k else weight
        x = np.linalg.solve(A.T @ (robust[:, None] * A) + np.ones((count, count)) / count, A.T @ (robust * b))
    return x


def find_motion(signals: dict[str, MotionSignal], offsets: dict[str, float]) -> tuple[float, float]:
    """Times of release and rest [frames of a film with offset 0]: medians over the films that show the motion.

    The speed in the first frames with motion is extrapolated to 0, which is the release. Raises InputError if nothing
    moves.
    """
    begins, ends = [], []
    for name, offset in offsets.items():
        speed = signals[name].speed
        if not len(speed) or not speed.max() > 0:
            continue
        moves = np.flatnonzero(speed > ONSET * speed.max())
        # first of ONSET_FRAMES consecutive frames with motion
        first = next((k for k in moves if (speed[k : k + ONSET_FRAMES] > ONSET * speed.max()).all()), moves[0])
        k = np.arange(first, min(first + ONSET_FRAMES, len(speed)))
        # time is fitted as a polynomial of speed, which grows more slowly once textures move by more than their grain
        rising = len(k) == ONSET_FRAMES and (np.diff(speed[k]) > 0).all()
        start = float(np.polyval(np.polyfit(speed[k], k + 0.5, len(k) - 1), 0.0)) if rising else float(first)
        begins.append(min(max(start, first - 2.0), first + 1.0) - offset)
        ends.append(moves[-1] + 1 - offset)
    if not begins:
        raise InputError("nothing moves in the films; give films that show the objects before and after their release")
    return float(np.median(begins)), float(np.median(ends))


def parse_offsets(text: str, names: Sequence[str]) -> dict[str, float]:
    """Parse offsets "A.mp4=0,B.mp4=3.33" [frames]. Raises InputError for other texts and unknown or missing films."""
    offsets = {}
    for part in text.split(","):
        name, _, value = part.strip().rpartition("=")
        try:
            offsets[name] = float(value)
        except ValueError:
            raise InputError(f"--offsets {text}: write NAME=FRAME,..., such as {names[0]}=0,{names[1]}=3.33") from None
    if wrong := [*(n for n in offsets if n not in names), *(n for n in names if n not in offsets)]:
        raise InputError(f"--offsets: {wrong[0]} is {'not a film' if wrong[0] in offsets else 'missing'}; the films "
                         f"are {', '.join(names)}")  # fmt: skip
    if not all(np.isfinite(list(offsets.values()))):
        raise InputError(f"--offsets {text}: offsets must be finite numbers")
    return offsets
