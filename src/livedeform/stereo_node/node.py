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
from livedeform.common.types import CameraCalibration, MarkerFrame
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
        self.correction = settings.correction(self.experiment, self._rest)
        self._cameras: dict[str, CameraCalibration] = {}
        self._prior = settings.prior(self.experiment.markers.ids)
        self._markers = self.publisher(PointCloud2, t.STEREO_MARKERS)
        if self.correction.needs_surface:
            self.subscribe(Marker, t.FEM_MESH, self.on_mesh)
            hear = self.correction.hear
            self.subscribe(PointCloud2, t.FEM_SURFACE, lambda said: self.publish(hear(*m.from_predicted_surface(said))))
        if settings.model_prior:
            self.subscribe(PointCloud2, t.FEM_MARKERS, lambda said: self._prior.add(m.from_predicted_markers(said)))
        quality = SENSOR if settings.best_effort else RELIABLE
        if settings.source == "markers":
            self.subscribe(PointCloud2, t.STEREO_MARKERS_RAW, self.on_markers, quality, gate=True)
            return
        self._uncorrected = self.publisher(PointCloud2, t.STEREO_MARKERS_RAW) if self.correction else None
        self._registration = self.publisher(TransformStamped, t.STEREO_REGISTRATION)
        for kind, (left, right) in ((Image, t.IMAGES), (CompressedImage, t.COMPRESSED_IMAGES)):
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
                self.publish(self.correction.take(frame))
                self.status(left.stamp_ns, status.level.upper(), status.message, asdict(status) | self.pairs.counts())

    def finish(self) -> None:
        super().finish()
        self.measure(self.pairs.flush())
        with self.bad_input_said():
            self.publish(self.correction.ready(ended=True))

    def on_mesh(self, message: Marker) -> None:
        self.correction.surfaces.add_mesh(m.from_time(message.header.stamp), m.from_mesh_marker(message))

    def on_markers(self, message: PointCloud2) -> None:
        self.publish(self.correction.take(m.from_marker_cloud(message)))  # another tracker's

    def publish(self, corrected: Sequence[tuple[MarkerFrame, str]]) -> None:
        """Publish corrected frames, and what is wrong with them."""
        for frame, trouble in corrected:
            self._markers(m.to_marker_cloud(frame))
            if trouble:
                self.status(frame.stamp_ns, "WARN", trouble)

    def register(self, stamp_ns: int) -> None:
        """Publish where the cameras are, once it is known."""
        if self.traffic.sent[t.STEREO_REGISTRATION] or self.tracker is None or self.tracker.T_phantom_left is None:
            return
        self.correction.cameras(self.tracker.T_phantom_left, self.tracker.rig)
        for transform in m.to_camera_transforms(stamp_ns, self.tracker.T_phantom_left, self.tracker.rig.T_right_left):
            self._registration(transform)


def main(args: Sequence[str] | None = None) -> None:
    """Run the console script ``stereo_node``."""
    run(StereoNode, args)
