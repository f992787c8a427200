"""Count how much of what was measured was compared: frames, presses and the deepest moments."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.ndimage import median_filter

from livedeform.common.types import Array, MarkerFrame

DEEPEST_SHARE = 0.1  # of the frames, at most, those with the largest motion, are the deepest moments
PRESSED, RELEASED = 0.5, 0.25  # of the largest motion: a press begins above the one and ends below the other
WILD, OFTEN = 5, 99.0  # what lasts for less than half of so many frames is no press, if fewer than 1 % are so
MOVED = 1.5  # noise floors: less, once the noise is taken off, is no motion
SMOOTHED, STILL = 5, 0.05  # frames to count presses by; share of the frames in which what shows as motion is noise
SEEN_SHARE = 0.5  # of the markers that most frames show; a frame with fewer says nothing of the others
MOST_FRAMES = 90.0  # percentile of the frames' numbers of markers: how many a frame shows where little is hidden
FEW = "few_markers"


@dataclass(frozen=True)
class Coverage:
    """``presses`` are excursions of the markers; ``deepest`` the tenth of the frames with the largest motion, as far as
    that is half of the largest of all.

    A frame with less than half of the markers that most frames show does not count as compared. ``skipped`` poses
    were overtaken while the model was solving; ``refused`` measured frames by reason; of the messages that were
    ``sent`` to the nodes and the recorder, once for each that listens, some were ``received`` and the others ``lost``,
    and ``before`` were published before the first that came; ``motion_rms`` and ``motion_largest`` (m) are of the
    measured markers against where they were first seen: over all, and in the frame with the largest; ``reasons``: why
    the model refused predictions, and how many.
    """

    frames_measured: int = 0
    frames_compared: int = 0
    presses: int = 0
    presses_compared: int = 0
    deepest: int = 0
    deepest_compared: int = 0
    skipped: int = 0
    refused: Mapping[str, int] = field(default_factory=dict)
    sent: int = 0
    received: int = 0
    lost: int = 0
    before: int = 0
    interrupted: bool = False
    motion_rms: float = float("nan")
    motion_largest: float = float("nan")
    reasons: Mapping[str, int] = field(default_factory=dict)


def read_coverage(document: Mapping[str, Any] | None) -> Coverage | None:
    """The coverage as ``metrics.json`` has it, where null is what is not known."""
    if document is None:
        return None
    known: dict[str, Any] = {key: float("nan") if value is None else value for key, value in document.items()}
    return Coverage(**known)


def motion(frames: Sequence[MarkerFrame]) -> Array:
    """Rms motion (f,) m of each frame's markers from where each was first seen; NaN for a frame without markers."""
    out = np.full(len(frames), np.nan)
    counts = [len(frame.ids) for frame in frames]
    if not any(counts):
        return out
    points = np.concatenate([frame.points for frame in frames])
    seen = np.isfinite(points).all(axis=1)
    points, row = points[seen], np.repeat(np.arange(len(frames)), counts)[seen]
    _, first, marker = np.unique(np.concatenate([f.ids for f in frames])[seen], return_index=True, return_inverse=True)
    squares = np.sum((points - points[first[marker]]) ** 2, axis=1)
    n = np.bincount(row, minlength=len(frames))
    out[n > 0] = np.sqrt((np.bincount(row, squares, minlength=len(frames)) / np.maximum(n, 1))[n > 0])
    return out


def cover(
    frames: Sequence[MarkerFrame],
    compared_ns: Sequence[int],
    *,
    n_measured: int,
    noise: float,
    skipped: int = 0,
    refused: Mapping[str, int] | None = None,
    traffic: Iterable[Mapping[str, int]] = (),
    interrupted: bool = False,
    reasons: Mapping[str, int] | None = None,
) -> Coverage:
    """The coverage of measured ``frames`` of which those at the stamps ``compared_ns`` were compared.

    ``n_measured``: frames that were to be measured, which are more where pictures gave no frame. ``noise`` (m): the rms
    of the measuring noise, NaN where it is not known. ``traffic``: messages sent, received and lost of each listener.
    """
    moved = motion(frames)
    answered = np.isin([frame.stamp_ns for frame in frames], list(compared_ns))
    few = ~shows_the_body(np.array([np.isfinite(f.points).all(axis=1).sum() for f in frames]))
    compared = answered & ~few
    known = np.isfinite(moved)
    deepest, presses = _pressed(moved, noise)
    return Coverage(
        frames_measured=max(n_measured, len(frames)),
        frames_compared=int(compared.sum()),
        presses=len(presses),
        presses_compared=sum(2 * int(compared[press].sum()) >= len(press) for press in presses),
        deepest=int(deepest.sum()),
        deepest_compared=int((deepest & compared).sum()),
        skipped=skipped,
        refused={reason: n for reason, n in (*(refused or {}).items(), (FEW, int((answered & few).sum()))) if n},
        **_balance(list(traffic)),
        interrupted=interrupted,
        motion_rms=float(np.sqrt(np.nanmean(moved[known] ** 2))) if known.any() else float("nan"),
        motion_largest=float(np.nanmax(moved)) if known.any() else float("nan"),
        reasons=dict(reasons or {}),
    )


def _balance(traffic: Sequence[Mapping[str, int]]) -> dict[str, int]:
    """Sum the listeners' messages."""
    return {key: sum(row.get(key, 0) for row in traffic) for key in ("sent", "received", "lost", "before")}


def shows_the_body(n_markers: np.ndarray) -> np.ndarray:
    """Tell of frames with so many markers (f,) which show at least half of what most frames show."""
    if not len(n_markers):
        return np.zeros(0, bool)
    return np.asarray(n_markers >= SEEN_SHARE * np.percentile(n_markers, MOST_FRAMES))


def _pressed(moved: Array, noise: float) -> tuple[np.ndarray, list[list[int]]]:
    """The deepest frames (f,) and the rows of each press's frames; none where nothing but ``noise`` (m) moved."""
    lasting = _lasting(moved)
    clear = _without_noise(lasting, noise)
    if float(clear.max(initial=0.0)) <= MOVED * np.nan_to_num(noise):
        return np.zeros(len(moved), bool), []
    return _deepest(lasting) & (clear > PRESSED * clear.max()), _presses(clear)


def _lasting(moved: Array) -> Array:
    """Motion (f,) m without that of single wild frames, where these are rare: elsewhere frames are so far apart that a
    press shows in one or two."""
    known = np.isfinite(moved)
    if not known.any():
        return moved
    lasting = moved.copy()
    lasting[known] = median_filter(moved[known], WILD)
    rare = PRESSED * np.percentile(moved[known], OFTEN) <= lasting[known].max()
    return lasting if rare else moved


def _deepest(moved: Array) -> np.ndarray:
    """The frames (f,) with the largest motion: a tenth at most, and none that moved less than half as far as any."""
    n = max(1, round(DEEPEST_SHARE * len(moved)))
    out = np.zeros(len(moved), bool)
    out[np.argsort(np.where(np.isfinite(moved), moved, -1.0), kind="stable")[-n:]] = True
    return out & (moved > PRESSED * np.nanmax(moved, initial=0.0))


def _without_noise(moved: Array, noise: float) -> Array:
    """Motion (f,) m over a few frames, less what noise adds: twice its square, as both ends of a displacement have it,
    or what the stillest frames show where it is not known."""
    known = np.isfinite(moved)
    if not known.any():
        return np.zeros(len(moved))
    squares = np.where(known, moved, 0.0) ** 2
    added = 2.0 * noise**2 if np.isfinite(noise) else float(np.quantile(squares[known], STILL))
    kernel = np.ones(min(SMOOTHED, len(moved)))
    seen = np.convolve(known.astype(float), kernel, "same")
    mean = np.divide(np.convolve(squares, kernel, "same"), seen, out=np.zeros(len(moved)), where=seen > 0.0)
    return np.sqrt(np.maximum(mean - added, 0.0))


def _presses(moved: Array) -> list[list[int]]:
    """The rows of the frames of each press: from above half of the largest motion until below a quarter of it."""
    largest = float(moved.max())
    presses: list[list[int]] = []
    pressed = False
    for k, now in enumerate(moved):
        if not pressed and now > PRESSED * largest:
            presses.append([])
            pressed = True
        pressed = pressed and not now < RELEASED * largest
        if pressed:
            presses[-1].append(k)
    return presses
