"""compare_node: measured and predicted markers in, error and metrics out."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Float64

from livedeform.common import topics as t
from livedeform.common.experiment.yaml_file import load_experiment
from livedeform.common.node_parameters import within
from livedeform.common.ros import messages as m
from livedeform.common.ros.node import CountingNode, run
from livedeform.common.ros.session import SENSOR, declare
from livedeform.compare_node.associate import Associator
from livedeform.compare_node.judgement import doubts_so_far, level_of
from livedeform.compare_node.metrics import Level, RunningTotal, frame_metrics
from livedeform.compare_node.residual import Residual


@dataclass(frozen=True)
class CompareParameters:
    """ROS parameters.

    ``experiment``: folder or YAML file (for its threshold). ``max_gap``: s between two predictions across which is
    interpolated. ``stale_after``: s without an error until the metrics say STALE; 0: never. ``best_effort``: hear a
    tracker that is not reliable.
    """

    experiment: str = ""
    max_gap: float = within(0.5, 0.0, 60.0)
    stale_after: float = within(2.0, 0.0, 3600.0)
    best_effort: bool = True


class CompareNode(CountingNode):
    """Publishes the error of every measured frame that can be compared."""

    def __init__(self, parameters: Mapping[str, Any] | None = None) -> None:
        super().__init__("compare_node", t.COMPARE_METRICS, parameters)
        settings = declare(self, CompareParameters)
        self.threshold = load_experiment(settings.experiment).thresholds.error
        self.associator = Associator(round(settings.max_gap * 1e9))
        self._errors = self.publisher(PointCloud2, t.COMPARE_MARKERS)
        self._numbers = {
            name: self.publisher(Float64, topic)
            for name, topic in (
                ("rmse", t.COMPARE_RMSE), ("mean", t.COMPARE_MEAN), ("p95", t.COMPARE_P95), ("max", t.COMPARE_MAX),
            )
        }  # fmt: skip
        self._last_stamp_ns, self._fresh, self._total = 0, False, RunningTotal(self.threshold)
        quality = SENSOR if settings.best_effort else None
        self.subscribe(PointCloud2, t.STEREO_MARKERS, self.on_measured, quality, gate=True)
        self.subscribe(PointCloud2, t.FEM_MARKERS, self.on_predicted, gate=True)
        if settings.stale_after > 0:
            self.create_timer(settings.stale_after, self.watch)

    def on_measured(self, message: PointCloud2) -> None:
        for residual in self.associator.add_measured(m.from_marker_cloud(message)):
            self.publish(residual)

    def on_predicted(self, message: PointCloud2) -> None:
        for residual in self.associator.add_predicted(m.from_predicted_markers(message)):
            self.publish(residual)

    def publish(self, residual: Residual) -> None:
        """Publish the error of one frame, its numbers, and how it compares with the threshold."""
        self._errors(m.to_compare_cloud(residual.stamp_ns, residual.ids, residual.measured, residual.errors))
        metrics = frame_metrics(residual, self.threshold)
        self._total.add(residual.distances)
        for name, publish in self._numbers.items():
            publish(m.to_float64(getattr(metrics, name)))
        values = asdict(metrics) | {"threshold": self.threshold, "interpolation_bound": residual.interpolation_bound}
        del values["stamp_ns"], values["level"]
        self._last_stamp_ns, self._fresh = residual.stamp_ns, True
        n_compared = self.associator.counts.matched_frames
        doubts = doubts_so_far(metrics.n, self._total.most, n_compared, self.associator.n_decided)
        level = Level.WARN if doubts and metrics.level is Level.OK else metrics.level
        text = "; ".join([f"rmse {metrics.rmse * 1e3:.3f} mm of {metrics.n} markers", *doubts])
        self.metrics(residual.stamp_ns, level, text, values)

    def metrics(self, stamp_ns: int, level: str, text: str, values: Mapping[str, Any]) -> None:
        """Publish on ``/compare/metrics`` the numbers, the verdict, and what could not be compared so far."""
        self.associator.refresh_ids()
        counts = {f"count_{key}": value for key, value in self.counts().items()}
        stamp = {"stamp_ns": stamp_ns, "verdict": str(level)}
        finite = {k: v for k, v in values.items() if not (isinstance(v, float) and math.isnan(v))}
        self._publish_status(m.to_diagnostics(stamp_ns, "compare_node: error", level, text, stamp | finite | counts))  # type: ignore[misc]

    def counts(self) -> dict[str, Any]:
        """Return what became of frames and predictions, those whose stamp was far from the others' among them."""
        frames, predictions = self.n_refused(t.STEREO_MARKERS), self.n_refused(t.FEM_MARKERS)
        return self.associator.counts.with_jumps(frames, predictions).as_dict()

    def watch(self) -> None:
        """Say STALE where no error could be told since the last look."""
        if not self._fresh:
            self.metrics(self._last_stamp_ns, "STALE", "no measured frame could be compared with a prediction", {})
        self._fresh = False

    def finish(self) -> None:
        super().finish()
        for residual in self.associator.flush():
            self.publish(residual)
        counts = self.associator.counts
        level = level_of(self._total.level, counts.matched_frames, counts.measured_frames)
        text = f"ended: {counts.matched_frames} of {counts.measured_frames} measured frames were compared"
        text += f", rmse {self._total.rmse * 1e3:.3f} mm" if self._total.n else ""
        self.metrics(self._last_stamp_ns, level, text, self._total.as_dict())


def main(args: Sequence[str] | None = None) -> None:
    """Run the console script ``compare_node``."""
    run(CompareNode, args)
