"""Does what is measured at rest contradict the model, by how much, and how much of that is one rigid motion?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from livedeform.common.experiment.schema import Markers
from livedeform.common.frames import fit_rigid
from livedeform.compare_node.residual import Residual

STILL = 5e-5  # m, rms, by which the model's markers at rest may differ from one frame to another
PLACE = 4e-5  # m, sigma of a marker's place where its file gives none
SHORTEST, LONGEST = 5, 100  # frames that make a rest, and that are looked at
BEYOND = 3.0  # times the noise


@dataclass(frozen=True)
class AtRest:
    """The mean error (m, rms over ``n`` markers off the support) of ``frames`` still frames at one ``end`` of a
    recording: in all, after the best ``rigid`` motion is taken off (``left``), and what ``noise`` would leave: the
    frames' and that of the markers' stated places."""

    end: str
    n: int
    frames: int
    error: float
    rigid: float
    left: float
    noise: float

    @property
    def contradicts(self) -> bool:
        """Return whether that is beyond noise."""
        return self.error > BEYOND * self.noise

    @property
    def text(self) -> str:
        """Put it in a sentence with numbers."""
        found = (
            f"at rest at the {self.end} the mean error of {self.n} markers is {1e3 * self.error:.2f} mm rms "
            f"({1e3 * self.rigid:.2f} mm one rigid motion, {1e3 * self.left:.2f} mm beside it; noise "
            f"{1e3 * self.noise:.3f} mm)"
        )
        if not self.contradicts:
            return found
        return (
            f"{found}: the reference pose contradicts the model, or the model the body: diagnose tests reference_pose"
        )


def at_rest(residuals: Sequence[Residual], markers: Markers) -> tuple[AtRest, ...]:
    """Judge the start and the end of a recording, as far as the model rests there."""
    seen = [r for r in residuals if len(r.ids)]
    found = (_at_end(seen, markers, "start"), _at_end(seen[::-1], markers, "end"))
    return tuple(f for f in found if f is not None)


def _at_end(residuals: Sequence[Residual], markers: Markers, end: str) -> AtRest | None:
    """Judge the first of the ``residuals``, while the model stays within `STILL`; None if that is not long."""
    held = markers.ids[np.asarray(markers.kinds) == "support"]
    if not residuals:
        return None
    first, still = residuals[0], []
    for r in residuals[:LONGEST]:
        if not np.array_equal(r.ids, first.ids) or _moved(r, first) > STILL:
            break
        still.append(r)
    free = ~np.isin(first.ids, held)
    if len(still) < SHORTEST or free.sum() < 3:
        return None
    predicted = np.mean([r.predicted for r in still], axis=0)[free]
    error = np.mean([r.errors for r in still], axis=0)[free]
    T = fit_rigid(predicted, predicted + error)
    left = predicted + error - (predicted @ T[:3, :3].T + T[:3, 3])
    sigma = dict(zip(markers.ids.tolist(), markers.sigmas.tolist(), strict=True))
    place = np.array([sigma.get(int(i), np.nan) for i in first.ids[free]])
    place = np.where(np.isfinite(place), place, PLACE)
    # of a mean over frames that are not independent: as that of one
    frame = np.nan_to_num([np.trace(c) / 3.0 for c in first.covariances[free]])
    noise = float(np.sqrt(3.0 * np.mean(place**2 + frame)))
    size = [float(np.sqrt(np.mean(np.sum(e**2, axis=1)))) for e in (error, error - left, left)]
    return AtRest(end, int(free.sum()), len(still), size[0], size[1], size[2], noise)


def _moved(one: Residual, other: Residual) -> float:
    """Return how far (m, rms) the model's markers are apart in two frames."""
    return float(np.sqrt(np.mean(np.sum((one.predicted - other.predicted) ** 2, axis=1))))
