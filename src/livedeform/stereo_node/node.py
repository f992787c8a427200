"""stereo_node: stereo pictures in, marker points with covariance out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from geometry_msgs.msg import TransformStamped
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2
from visualization_msgs.msg import Marker

from livedeform.common import topics as t
from livedeform.common.experiment.markers_file import read_markers
from livedeform.common.experiment.yaml_file import load_experiment
from livedeform.common.frames import inverse, matrix_pose
from livedeform.common.ros import messages as m
from livedeform.common.ros.node import CountingNode, run
from livedeform.common.ros.session import RELIABLE, SENSOR, declare
from livedeform.common.types import CameraCalibration
from livedeform.common.types import Image as Picture
from livedeform.stereo_node.correction import MeasuringCorrection, parse_pose
from livedeform.stereo_node.pairing import PicturePairs
from livedeform.stereo_node.parameters import StereoParameters
from livedeform.stereo_node.pipeline import StereoTracker, detector_of
from livedeform.stereo_node.track.model_prior import ModelPrior
from livedeform.stereo_node.warm_up import warm_up


class StereoNode(CountingNode):
    """Publishes the markers of every pair of pictures, corrected for the measuring effects of the experiment."""

    def __init__(self, parameters: Mapping[str, Any] | None = None) -> None:
        super().__init__("stereo_node", t.STEREO_STATUS, parameters)
        settings = declare(self, StereoParameters)
        self.experiment = load_experiment(settings.experiment)
        tolerance, offset = round(settings.pair_tolerance * 1e9), round(settings.pair_offset * 1e9)
        self.pairs = PicturePairs(tolerance, expected_ns=offset)
        self.tracker: StereoTracker | None = None
        self._rest = read_markers(Path(settings.rest_markers)).points if settings.rest_markers else None
        self.correction = MeasuringCorrection(
            self.experiment, settings.start_ns, parse_pose(settings.camera_pose), self._rest
        )
        self._cameras: dict[str, CameraCalibration] = {}
        self._registered = False
        self._prior = ModelPrior(self.experiment.markers.ids, round(settings.model_prior_age * 1e9))
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
        warm_up(detector_of(self.experiment))

    def on_camera(self, side: str, message: CameraInfo) -> None:
        """Take a camera's calibration, used where the experiment names none."""
        self._cameras[side] = m.from_camera_info(message, side)
        if self.tracker is None and len(self._cameras) == 2:
            cameras = self._cameras["left"], self._cameras["right"]
            self.tracker = StereoTracker.from_experiment(self.experiment, cameras, self._rest)

    def on_picture(self, add: Callable[[Picture], list[tuple[Picture, Picture]]], message: Any) -> None:
        picture = m.from_image(message)
        for left, right in add(picture):
            if self.tracker is None:
                self.status(left.stamp_ns, "ERROR", f"no camera calibration; waiting for {t.LEFT_CAMERA_INFO}")
                continue
            frame, status = self.tracker.process(left, right, self._prior.at(left.stamp_ns))
            self.register(left.stamp_ns)
            if self._uncorrected is not None:
                self._uncorrected(m.to_marker_cloud(frame))
            self._markers(m.to_marker_cloud(self.correction.apply(frame)))
            self.status(left.stamp_ns, status.level.upper(), status.message, asdict(status) | self.pairs.counts())
        if trouble := self.pairs.news_of_trouble(picture.stamp_ns):
            self.status(picture.stamp_ns, "ERROR", trouble, self.pairs.counts())

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
        if self._registered or self.tracker is None or self.tracker.T_phantom_left is None:
            return
        self._registered = True
        self.correction.cameras(self.tracker.T_phantom_left, self.tracker.rig)
        left = matrix_pose(self.tracker.T_phantom_left, stamp_ns)
        right = matrix_pose(inverse(self.tracker.rig.T_right_left), stamp_ns)
        self._registration(m.to_transform(left, t.FRAME_PHANTOM, t.FRAME_LEFT))
        self._registration(m.to_transform(right, t.FRAME_LEFT, t.FRAME_RIGHT))


def main(args: Sequence[str] | None = None) -> None:
    """Run the console script ``stereo_node``."""
    run(StereoNode, args)
