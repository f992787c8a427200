"""Tell how much of a run's prediction is its elements' doing, at its deepest moment."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from livedeform.common.checks.finding import Finding
from livedeform.common.errors import ConvergenceError, MeshError
from livedeform.common.types import Array, Pose, PredictedMarkers
from livedeform.fem_node.discretisation import DiscretisationError, discretisation_error
from livedeform.fem_node.model import PhantomModel
from livedeform.fem_node.physics.memory import memory_of
from livedeform.fem_node.simulator import Recorded
from livedeform.fem_node.solve.agreement import SAME_PLACE

MATTERS = 0.005  # of the motion: above it the error is a warning


@dataclass(frozen=True)
class Elements:
    """The elements' ``error`` (None: it cannot be told), the ``line`` that says so, and what they make doubtful."""

    error: DiscretisationError | None
    line: str
    findings: tuple[Finding, ...] = ()

    def described(self, mesh: dict[str, Any]) -> dict[str, Any]:
        """Return the record of a run's ``mesh`` with the elements' error in it."""
        report = [*mesh.get("report", ()), self.line]
        return mesh | {"report": report, "discretisation": None if self.error is None else self.error.as_dict()}


def elements(
    model: PhantomModel,
    predictions: Sequence[PredictedMarkers],
    poses: Sequence[Pose],
    start_ns: int,
    tell: Callable[..., None],
) -> Elements:
    """Estimate the elements' error at the deepest moment of a run's ``predictions``, along the probe's ``poses``; and
    look whether that moment has the same answer where it is reached at once."""
    predicted = [p for p in predictions if p.converged and len(p.points)]
    if not predicted or model.markers.still.all():
        return Elements(None, "elements: how much they get wrong is not told, since no marker was predicted")
    tell("looking how much the elements get wrong")
    deep = deepest(predicted)
    stamps = sorted({predicted[0].stamp_ns, deep.stamp_ns})
    try:
        found = discretisation_error(model, Recorded("run", stamps, start_ns, poses))
    except (ConvergenceError, MeshError) as error:
        return Elements(None, f"WARN: how much the elements get wrong cannot be told: {error}")
    line = f"WARN: {found.line()}" if found.share > MATTERS else found.line()
    if memory_of(model.physics).beyond_the_pose:
        return Elements(found, line)
    return Elements(found, line, several_answers(np.linalg.norm(found.markers - deep.points, axis=1)))


def several_answers(apart: Array) -> tuple[Finding, ...]:
    """Doubt a model whose markers are ``apart`` (m,) m where a pose is reached in two ways."""
    furthest = float(np.nanmax(apart, initial=0.0))
    if furthest <= SAME_PLACE:
        return ()
    text = "the model has more than one answer to its deepest moment: reached at once, markers are up to "
    text += f"{1e3 * furthest:.2f} mm from where they are along the recorded poses"
    return (Finding("WARN", text, "use elements as small as the radius of the probe's edges", doubts=True),)


def deepest(predicted: Sequence[PredictedMarkers]) -> PredictedMarkers:
    """Return the moment at which the markers are furthest from where they were first."""
    first = predicted[0].points
    return max(predicted, key=lambda p: float(np.nansum((p.points - first) ** 2)))
