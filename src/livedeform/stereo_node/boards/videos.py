"""Pairs of pictures of two videos of a board: aligned in time by what moves, taken where everything rests."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from livedeform.common.errors import CalibrationError
from livedeform.common.types import Array
from livedeform.stereo_node.detect.picture import Picture

SMALL = 160  # px, width of the pictures by which movement is judged
STEP = 0.02  # s, of the common time
LONGEST_SHIFT = 20.0  # s between the starts of the two videos
LEAST_CORRELATION = 0.4
APART = 0.5  # s between moments
MOST_MOMENTS = 40
SUFFIXES = (".mp4", ".mkv", ".mov", ".avi", ".webm", ".m4v", ".mpg", ".mpeg")


@dataclass(frozen=True)
class Movement:
    """Hold how much pictures change: ``seconds`` (n,) from the video's start and ``change`` (n,) in grey
    values."""

    path: Path
    seconds: Array
    change: Array

    def at(self, seconds: Array) -> Array:
        """Return the change at these times, NaN outside the video."""
        out: Array = np.interp(seconds, self.seconds, self.change, left=np.nan, right=np.nan)
        return out


def is_video(path: str) -> bool:
    """Tell whether the name is that of a video."""
    return path.lower().endswith(SUFFIXES)


def movement(path: Path) -> Movement:
    """Return how much changes in a video; ``CalibrationError`` where it cannot be read."""
    seconds, change, before = [], [], None
    for t, picture in _pictures(path):
        small = cv2.resize(picture, (SMALL, max(SMALL * picture.shape[0] // picture.shape[1], 1)), interpolation=3)
        if before is not None:
            seconds.append(t)
            change.append(float(cv2.absdiff(small, before).mean()))
        before = small
    if len(change) < 10:
        raise CalibrationError(
            f"holds {len(change) + 1} pictures", where=str(path), remedy="give a video of the board, or pictures"
        )
    return Movement(path, np.array(seconds), np.array(change))


def _pictures(path: Path) -> Iterator[tuple[float, Picture]]:
    """Yield seconds from the start and the grey picture of every frame."""
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # its own lines would stand beside the one that counts
    video = cv2.VideoCapture(str(path)) if path.is_file() else None
    if video is None or not video.isOpened():
        raise CalibrationError("cannot be read as a video", where=str(path), remedy="give mp4, mkv, mov or avi")
    rate = video.get(cv2.CAP_PROP_FPS)
    rate = rate if 1 <= rate <= 1000 else 30.0
    k = 0
    while True:
        stated = video.get(cv2.CAP_PROP_POS_MSEC) * 1e-3
        good, frame = video.read()
        if not good:
            break
        yield (stated if stated > 0 else k / rate), cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)  # type: ignore[misc]
        k += 1
    video.release()


def shift_between(left: Movement, right: Movement) -> tuple[float, float]:
    """Return by how many seconds the right video's clock is ahead (t_right = t_left + shift), where the movement in
    both agrees best, and their correlation there."""
    span = np.arange(0.0, max(left.seconds[-1], right.seconds[-1]), STEP)
    series = []
    for m in (left, right):
        value = np.log1p(m.at(span))
        value -= np.nanmean(value)
        series.append(np.nan_to_num(value))
    a, b = series
    best = (0.0, -1.0)
    n = min(int(LONGEST_SHIFT / STEP), len(span) // 2)
    for k in range(-n, n + 1):
        x, y = (a[: len(a) - k], b[k:]) if k >= 0 else (a[-k:], b[:k])
        size = float(np.sqrt((x @ x) * (y @ y)))
        agreement = float(x @ y) / size if size > 0 else 0.0
        if agreement > best[1]:
            best = (k * STEP, agreement)
    return best


def still_moments(left: Movement, right: Movement, shift: float) -> Array:
    """Return up to ``MOST_MOMENTS`` times (s of the left video) at which least moves in both, spread over them."""
    first, last = max(left.seconds[0], right.seconds[0] - shift), min(left.seconds[-1], right.seconds[-1] - shift)
    span = np.arange(first, last, STEP)
    moves = np.fmax(left.at(span), right.at(span + shift))
    n = int(max(min((last - first) / APART, MOST_MOMENTS), 1))
    parts = np.array_split(np.arange(len(span)), n)
    best = np.array([int(p[np.nanargmin(moves[p])]) for p in parts if len(p) and np.isfinite(moves[p]).any()])
    quiet = moves[best] <= np.nanmedian(moves)
    out: Array = span[best[quiet]]
    return out


def video_pairs(left: Path, right: Path, shift: float | None = None) -> tuple[list[tuple[str, Picture, Picture]], str]:
    """Return pairs of pictures (name, left, right) of two videos, and a line that says how they were aligned.

    ``shift`` s: by how much the right video's clock is ahead, if it is known. ``CalibrationError`` where nothing says
    which moments are the same.
    """
    moves = movement(left), movement(right)
    said = f"given: {shift:+.2f} s" if shift is not None else ""
    if shift is None:
        shift, correlation = shift_between(*moves)
        if correlation < LEAST_CORRELATION:
            raise CalibrationError(
                f"the movement in both videos does not agree (correlation {correlation:.2f})",
                where="--left, --right",
                remedy="film the moving board with both cameras at once, or say --shift SECONDS (right minus left)",
            )
        said = f"{shift:+.2f} s (correlation of the movement {correlation:.2f})"
    times = still_moments(*moves, shift)
    sides = _at(left, times), _at(right, times + shift)
    pairs = [(f"{t:.2f} s", a, b) for t, a, b in zip(times, *sides, strict=True)]
    return pairs, f"{len(pairs)} still moments of the videos; the right one's time minus the left one's: {said}"


def _at(path: Path, times: Array) -> list[Picture]:
    """Return the pictures nearest to ``times`` (n,), ascending, s."""
    out: list[Picture] = []
    before: tuple[float, Picture] | None = None
    for t, picture in _pictures(path):
        while len(out) < len(times) and times[len(out)] <= t:
            nearer = before is not None and times[len(out)] - before[0] < t - times[len(out)]
            out.append(before[1] if nearer and before is not None else picture)
        before = t, picture
    while len(out) < len(times) and before is not None:
        out.append(before[1])
    return out
