"""A run with its metrics, as the parts of its page read it."""

from __future__ import annotations

from dataclasses import dataclass, field

from livedeform.common.experiment.schema import Experiment
from livedeform.common.types import Array
from livedeform.compare_node.metrics import RunMetrics
from livedeform.report.run.evidence import RunEvidence


@dataclass(frozen=True)
class RunSummary:
    """A run with everything that several parts of the page need."""

    evidence: RunEvidence
    experiment: Experiment
    metrics: RunMetrics
    seconds: Array = field(repr=False)  # (f,) of the residuals, since the start
    per_frame: Array = field(repr=False)  # (f,) rmse, m

    @property
    def threshold(self) -> float:
        return self.experiment.thresholds.error
