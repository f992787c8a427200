"""Count how much of what was measured was compared: frames, presses and the deepest moments."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from livedeform.common.checks.presses import count_presses, lasting, motion, shows_the_body, without_noise
from livedeform.common.types import Array, MarkerFrame
from livedeform.compare_node.residual import Residual

DEEPEST_SHARE = 0.1  # of the frames, at most, those with the largest motion, are the deepest moments
PRESSED = 0.5  # of the largest motion, of all or of a press: so deep are the moments that count
FEW = "few_markers"


@dataclass(frozen=True)
class Coverage:
    """``presses`` are excursions of the markers (`common.checks.presses`); ``deepest`` the tenth of the frames with the
    largest motion, as far as that is half of the largest of all.

    A frame with less than half of the markers that most frames show does not count as compared. ``skipped`` poses
    were overtaken while the model was solving; ``refused`` measured frames by reason; of the messages that were
    ``sent`` to the nodes and the recorder, once for each that listens, some were ``received`` and the others ``lost``,
    and ``before`` were published before the first that came; ``motion_rms`` and ``motion_largest`` (m) are of the
    measured markers against where they rest: over all, and in the frame with the largest; ``reasons``: why
    the model refused predictions, and how many; ``repeated`` frames were left out, since a frame of their stamp was
    there already: they are not among the measured ones.
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
    repeated: int = 0


def read_coverage(document: Mapping[str, Any] | None) -> Coverage | None:
    """The coverage as ``metrics.json`` has it, where null is what is not known."""
    if document is None:
        return None
    known: dict[str, Any] = {key: float("nan") if value is None else value for key, value in document.items()}
    return Coverage(**known)


def cover(
    heard: Sequence[MarkerFrame],
    residuals: Sequence[Residual],
    *,
    n_measured: int,
    noise: float,
    skipped: int = 0,
    repeated: int = 0,
    refused: Mapping[str, int] | None = None,
    traffic: Iterable[Mapping[str, int]] = (),
    interrupted: bool = False,
    reasons: Mapping[str, int] | None = None,
) -> Coverage:
    """The coverage of the measured frames: those that the recorder ``heard``, and those of ``residuals``, which were
    compared, whether it heard them or not.

    ``n_measured``: frames that were to be measured, each stamp once, which are more where pictures gave no frame.
    ``noise`` (m): rms of the measuring noise, NaN where it is not known. ``traffic``: messages of each listener.
    """
    frames = _measured(heard, residuals)
    moved = motion(frames)
    compared, n_few = _compared(frames, residuals)
    deepest, presses = _pressed(moved, noise)
    rms, largest = _sizes(moved[np.isfinite(moved)])
    return Coverage(
        frames_measured=max(n_measured, len(frames)),
        frames_compared=int(compared.sum()),
        presses=len(presses),
        presses_compared=sum(2 * int(compared[press].sum()) >= len(press) for press in presses),
        deepest=int(deepest.sum()),
        deepest_compared=int((deepest & compared).sum()),
        skipped=skipped,
        repeated=repeated,
        refused={reason: n for reason, n in (*(refused or {}).items(), (FEW, n_few)) if n},
        **_balance(list(traffic)),
        interrupted=interrupted,
        motion_rms=rms,
        motion_largest=largest,
        reasons=dict(reasons or {}),
    )


def _measured(heard: Sequence[MarkerFrame], residuals: Sequence[Residual]) -> Sequence[MarkerFrame]:
    """Return the frames that were ``heard``, by their stamps, and of those that were not what the residuals tell."""
    known = {frame.stamp_ns for frame in heard}
    unheard = [
        MarkerFrame(r.stamp_ns, r.ids, r.measured, r.covariances, np.full(len(r.ids), np.nan))
        for r in residuals
        if len(r.ids) and r.stamp_ns not in known
    ]
    return sorted([*heard, *unheard], key=lambda frame: frame.stamp_ns) if unheard else heard


def _compared(frames: Sequence[MarkerFrame], residuals: Sequence[Residual]) -> tuple[NDArray[np.bool_], int]:
    """Return which frames (n,) were compared, and how many others would have been, had they shown the body."""
    answered = np.isin([frame.stamp_ns for frame in frames], [r.stamp_ns for r in residuals if len(r.ids)])
    few = ~shows_the_body(np.array([np.isfinite(f.points).all(axis=1).sum() for f in frames]))
    return answered & ~few, int((answered & few).sum())


def _sizes(moved: Array) -> tuple[float, float]:
    """The rms and the largest of known motions (k,) m; NaN of none."""
    return (float(np.sqrt(np.mean(moved**2))), float(moved.max())) if len(moved) else (float("nan"), float("nan"))


def _balance(traffic: Sequence[Mapping[str, int]]) -> dict[str, int]:
    """Sum the listeners' messages."""
    return {key: sum(row.get(key, 0) for row in traffic) for key in ("sent", "received", "lost", "before")}


def _pressed(moved: Array, noise: float) -> tuple[np.ndarray, list[np.ndarray]]:
    """The deepest frames (f,), and the rows of the deeper half of each press; none where nothing but ``noise`` (m)
    moved."""
    kept = lasting(moved)
    clear, floor = without_noise(kept, noise)
    presses = count_presses(clear, floor)
    if not presses:
        return np.zeros(len(moved), bool), []
    deeper = [press.start + np.flatnonzero(clear[press] > PRESSED * clear[press].max()) for press in presses]
    return _deepest(kept) & (clear > PRESSED * clear.max()), deeper


def _deepest(moved: Array) -> np.ndarray:
    """The frames (f,) with the largest motion: a tenth at most, and none that moved less than half as far as any."""
    n = max(1, round(DEEPEST_SHARE * len(moved)))
    out = np.zeros(len(moved), bool)
    out[np.argsort(np.where(np.isfinite(moved), moved, -1.0), kind="stable")[-n:]] = True
    return out & (moved > PRESSED * np.nanmax(moved, initial=0.0))
