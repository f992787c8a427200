"""The moments of a run that are worth looking at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from livedeform.compare_node.metrics import rmse
from livedeform.compare_node.residual import Residual
from livedeform.report.run.evidence import RunEvidence, SurfaceMesh

DEEPEST = "largest deformation"


@dataclass(frozen=True)
class NotableMoment:
    """A moment of the run that is worth looking at; ``shape`` is the predicted surface, where it was recorded."""

    name: str
    residual: Residual
    shape: SurfaceMesh | None


def interesting_moments(residuals: Sequence[Residual], evidence: RunEvidence) -> list[NotableMoment]:
    """Choose the first moment (at rest), the deepest press or largest sag, and the largest error; they may coincide."""
    if not residuals:
        return []
    moved = [distance_moved(r, residuals[0]) for r in residuals]
    errors = [rmse(r.distances) for r in residuals]
    chosen = {"at rest": 0, DEEPEST: int(np.argmax(moved)), "largest error": int(np.argmax(errors))}
    moments: list[NotableMoment] = []
    for k in dict.fromkeys(chosen.values()):
        name = ", ".join(label for label, at in chosen.items() if at == k)
        moments.append(NotableMoment(name, residuals[k], evidence.surfaces(residuals[k].stamp_ns)))
    return moments


def distance_moved(now: Residual, first: Residual) -> float:
    """Rms displacement (m) of the predicted markers that both moments have."""
    _, rows, columns = np.intersect1d(now.ids, first.ids, return_indices=True)
    return rmse(np.linalg.norm(now.predicted[rows] - first.predicted[columns], axis=1)) if len(rows) else 0.0
