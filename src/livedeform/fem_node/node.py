"""fem_node: probe pose in, predicted surface, markers, lesions and force out."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from geometry_msgs.msg import PoseStamped, WrenchStamped
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import Marker, MarkerArray

from livedeform.common import topics as t
from livedeform.common.experiment.yaml_file import load_experiment
from livedeform.common.ros import messages as m
from livedeform.common.ros.node import CountingNode, run
from livedeform.common.ros.session import SENSOR, declare
from livedeform.common.types import Prediction, Wrench
from livedeform.fem_node.live.predictor import full_model, make_predictor, make_worker
from livedeform.fem_node.live.triggers import Moment, make_requests
from livedeform.fem_node.parameters import Parameters

Tell = Callable[[str], None]


class FemNode(CountingNode):
    """Publishes a prediction per pose, or per marker frame where there are no poses."""

    def __init__(self, parameters: Mapping[str, Any] | None = None, progress: Tell | None = None) -> None:
        super().__init__("fem_node", t.FEM_STATUS, parameters)
        settings = declare(self, Parameters)
        self.experiment = load_experiment(settings.experiment)
        asked = settings.newest_only, settings.expected, settings.after, settings.start_ns
        predictor = make_predictor(self.experiment, *asked, progress or self.log)
        self.model = full_model(predictor)
        self.refused: Counter[str] = Counter()  # predictions that were refused, by the reason
        self.n_predicted, self._mesh_ns, self._mesh_period_ns = 0, 0, round(settings.mesh_period * 1e9)
        self._surface = self.publisher(PointCloud2, t.FEM_SURFACE)
        self._markers = self.publisher(PointCloud2, t.FEM_MARKERS)
        self._lesions = self.publisher(MarkerArray, t.FEM_LESIONS)
        self._mesh = self.publisher(Marker, t.FEM_MESH)
        self._wrench = self.publisher(WrenchStamped, t.FEM_WRENCH)
        self._wake = self.create_guard_condition(self.publish_finished)
        self.worker = make_worker(predictor, settings.newest_only, self._wake.trigger)
        quality, probe = SENSOR if settings.best_effort else None, self.model.physics.probe
        self._is_live = settings.newest_only
        self._requests = make_requests(settings.trigger, probe is not None, probe.time_offset if probe else 0.0)
        self.subscribe(PoseStamped, t.PROBE_POSE, self.on_pose, quality, gate=True)
        measured = t.STEREO_MARKERS_RAW if settings.raw_first else t.STEREO_MARKERS
        self.subscribe(PointCloud2, measured, self.on_measured, quality, gate=True)
        self.subscribe(PointCloud2, t.STEREO_SURFACE, self.on_measured, quality, gate=True)
        self._rest_first = settings.rest_first or settings.newest_only  # in real time the kernels are warm at once

    def start(self) -> None:
        if self._rest_first:
            self._mesh(m.to_mesh_data(self.model.rest()))

    def on_pose(self, message: PoseStamped) -> None:
        self.request(self._requests.on_pose(m.from_pose_stamped(message), self.received_ns()))

    def on_measured(self, message: PointCloud2) -> None:
        self.request(self._requests.on_frame(m.from_time(message.header.stamp), self.received_ns()))

    def received_ns(self) -> int | None:
        """Return when the message at hand came, by a clock that is not set; None in lock step."""
        return time.monotonic_ns() if self._is_live else None

    def request(self, moments: list[Moment]) -> None:
        for moment in moments:
            self.worker.submit(moment)
            self.publish_finished()

    def publish_finished(self) -> None:
        while (prediction := self.worker.take()) is not None:
            self.publish(prediction)

    def publish(self, prediction: Prediction) -> None:
        """Everything about one prediction; NaN positions and a status where the model did not converge."""
        self._markers(m.to_predicted_markers(prediction))  # first: an error waits for them
        self._surface(m.to_predicted_surface(prediction))
        self._lesions(m.to_lesions(prediction, self.experiment.lesions))
        if not prediction.converged or abs(prediction.stamp_ns - self._mesh_ns) >= self._mesh_period_ns:
            self._mesh(m.to_mesh_data(prediction))  # large, and only for viewers
            self._mesh_ns = prediction.stamp_ns
        self._wrench(m.to_wrench(Wrench(prediction.stamp_ns, prediction.force, prediction.torque)))
        self.n_predicted += 1
        self.refused.update([] if prediction.converged else [prediction.message])
        level, said = "OK" if prediction.converged else "ERROR", prediction.message or "converged"
        values = {name: getattr(prediction, name) for name in ("n_iterations", "solve_seconds", "error_bound")}
        self.status(prediction.stamp_ns, level, said, self.counts() | values)

    def counts(self) -> dict[str, int]:
        """Count what became of the poses: predicted (not converged among them), left out (a newer one overtook
        them, or their stamp is wrong), in hand."""
        own = {"predicted": self.n_predicted, "not_converged": self.refused.total()}
        left_out = self.worker.skipped + self._requests.skipped + self.n_refused(t.PROBE_POSE)
        return own | {"skipped": left_out, "unfinished": self.worker.unfinished}

    @property
    def busy(self) -> bool:
        return self.worker.busy

    def finish(self) -> None:
        super().finish()
        self.request(self._requests.end())

    def destroy_node(self) -> None:
        self.worker.close()
        super().destroy_node()


def main(args: Sequence[str] | None = None) -> None:
    """Console script ``fem_node``."""
    run(FemNode, args)
