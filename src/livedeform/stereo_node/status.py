"""The status of one pair of pictures: counts, errors, and the verdict on the measurement."""

from __future__ import annotations

from dataclasses import dataclass, field

__all__ = ["FrameStatus"]


@dataclass(frozen=True)
class FrameStatus:
    """The outcome of measuring one pair of pictures.

    ``level`` is "ok", "warn" (fewer markers than usual), or "error" (no point is published; ``message`` says why and
    what to do). ``rejected`` counts what was not published, by reason. ``epipolar_rms_px`` is of the identified
    markers. ``calibration_sigma``, m: what the calibration's own uncertainty displaces markers by (rms), and what the
    registration leaves of that; common to all pictures and not in the points' covariances. NaN where no
    ``calibration.json`` lies beside the cameras' files. ``n_by_model``: markers not seen before this pair that were
    looked for where the model's prediction puts them.
    """

    stamp_ns: int
    level: str
    message: str
    n_found_left: int = 0
    n_found_right: int = 0
    n_matched: int = 0
    n_identified: int = 0
    n_markers: int = 0
    rejected: dict[str, int] = field(default_factory=dict)
    epipolar_rms_px: float = float("nan")
    epipolar_mean_px: float = float("nan")
    calibration_sigma: float = float("nan")
    calibration_sigma_registered: float = float("nan")
    n_by_model: int = 0


def total_counts(*counts: dict[str, int]) -> dict[str, int]:
    """Add up counts by reason."""
    out: dict[str, int] = {}
    for part in counts:
        for reason, n in part.items():
            out[reason] = out.get(reason, 0) + n
    return out
