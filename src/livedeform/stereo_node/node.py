"""stereo_node: stereo pictures in, marker points with covariance out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from typing import Any

from geometry_msgs.msg import TransformStamped
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2
from visualization_msgs.msg import Marker

from livedeform.common import topics as t
from livedeform.common.experiment.yaml_file import load_experiment
from livedeform.common.ros import messages as m
from livedeform.common.ros.node import CountingNode, run
from livedeform.common.ros.session import RELIABLE, SENSOR, declare
from livedeform.common.types import CameraCalibration
from livedeform.stereo_node.correction import MeasuringCorrection, parse_pose
from livedeform.stereo_node.pairing import Pictures
from livedeform.stereo_node.parameters import StereoParameters
from livedeform.stereo_node.pipeline import StereoTracker, detector_of
from livedeform.stereo_node.warm_up import warm_up


class StereoNode(CountingNode):
    """Publishes the markers of every pair of pictures, corrected for the measuring effects of the experiment."""

    def __init__(self, parameters: Mapping[str, Any] | None = None) -> None:
        super().__init__("stereo_node", t.STEREO_STATUS, parameters)
        settings = declare(self, StereoParameters)
        self.experiment = load_experiment(settings.experiment)
        self.pairs = settings.picture_pairs()
        self.tracker: StereoTracker | None = None
        self._rest = settings.rest()
        place = parse_pose(settings.camera_pose)
        self.correction = MeasuringCorrection(self.experiment, settings.start_ns, place, self._rest)
        self._cameras: dict[str, CameraCalibration] = {}
        self._prior = settings.prior(self.experiment.markers.ids)
        self._markers = self.publisher(PointCloud2, t.STEREO_MARKERS)
        if self.correction.needs_surface:
            self.subscribe(Marker, t.FEM_MESH, self.on_mesh)
        if settings.model_prior:
            self.subscribe(PointCloud2, t.FEM_MARKERS, self.on_prediction)
        quality = SENSOR if settings.best_effort else RELIABLE
        if settings.source == "markers":
            self.subscribe(PointCloud2, t.STEREO_MARKERS_RAW, self.on_markers, quality, gate=True)
            return
        self._uncorrected = self.publisher(PointCloud2, t.STEREO_MARKERS_RAW) if self.correction else None
        self._registration = self.publisher(TransformStamped, t.STEREO_REGISTRATION)
        for kind, left, right in (
            (Image, t.LEFT_IMAGE, t.RIGHT_IMAGE), (CompressedImage, t.LEFT_COMPRESSED, t.RIGHT_COMPRESSED),
        ):  # fmt: skip
            self.subscribe(kind, left, partial(self.on_picture, self.pairs.add_left), quality, gate=True)
            self.subscribe(kind, right, partial(self.on_picture, self.pairs.add_right), quality, gate=True)
        for side, topic in (("left", t.LEFT_CAMERA_INFO), ("right", t.RIGHT_CAMERA_INFO)):
            self.subscribe(CameraInfo, topic, partial(self.on_camera, side), quality)
        if self.experiment.stereo is not None and self.experiment.stereo.left is not None:
            self.tracker = StereoTracker.from_experiment(self.experiment, None, self._rest)
        if settings.lone_after > 0:
            self.create_timer(settings.lone_after, lambda: self.measure(self.pairs.lone()))
        warm_up(detector_of(self.experiment))

    def on_camera(self, side: str, message: CameraInfo) -> None:
        """Take a camera's calibration, used where the experiment names none."""
        self._cameras[side] = m.from_camera_info(message, side)
        if self.tracker is None and len(self._cameras) == 2:
            cameras = self._cameras["left"], self._cameras["right"]
            self.tracker = StereoTracker.from_experiment(self.experiment, cameras, self._rest)

    def on_picture(self, add: Callable[[Any], Pictures], message: Any) -> None:
        picture = m.from_image(message)
        self.measure(add(picture))
        if trouble := self.pairs.news_of_trouble(picture.stamp_ns):
            self.status(picture.stamp_ns, "ERROR", trouble, self.pairs.counts())

    def measure(self, pairs: Pictures) -> None:
        """Publish the markers of each pair."""
        for left, right in pairs:
            with self.bad_input_said():
                if self.tracker is None:
                    self.status(left.stamp_ns, "ERROR", f"no camera calibration; waiting for {t.LEFT_CAMERA_INFO}")
                    continue
                frame, status = self.tracker.process(left, right, self._prior.at(left.stamp_ns))
                self.register(left.stamp_ns)
                if self._uncorrected is not None:
                    self._uncorrected(m.to_marker_cloud(frame))
                self._markers(m.to_marker_cloud(self.correction.apply(frame)))
                self.status(left.stamp_ns, status.level.upper(), status.message, asdict(status) | self.pairs.counts())

    def finish(self) -> None:
        super().finish()
        self.measure(self.pairs.flush())

    def on_prediction(self, message: PointCloud2) -> None:
        """Take the markers' places that the model predicts."""
        self._prior.add(m.from_predicted_markers(message))

    def on_mesh(self, message: Marker) -> None:
        """Take the predicted surface, through which internal markers are seen."""
        self.correction.surface = m.from_mesh_marker(message) or self.correction.surface

    def on_markers(self, message: PointCloud2) -> None:
        """Correct and publish another tracker's markers."""
        self._markers(m.to_marker_cloud(self.correction.apply(m.from_marker_cloud(message))))

    def register(self, stamp_ns: int) -> None:
        """Publish where the cameras are, once it is known."""
        said = bool(self.traffic.sent[t.STEREO_REGISTRATION])
        if said or self.tracker is None or self.tracker.T_phantom_left is None:
            return
        self.correction.cameras(self.tracker.T_phantom_left, self.tracker.rig)
        for transform in m.to_camera_transforms(stamp_ns, self.tracker.T_phantom_left, self.tracker.rig.T_right_left):
            self._registration(transform)


def main(args: Sequence[str] | None = None) -> None:
    """Run the console script ``stereo_node``."""
    run(StereoNode, args)
