"""Takes a model's measuring effects out of what was measured, so that error = corrected measured - predicted."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from livedeform.common.errors import InputError
from livedeform.common.experiment.schema import Experiment
from livedeform.common.frames import pose_matrix, unit_pose
from livedeform.common.types import Array, MarkerFrame, Pose
from livedeform.stereo_node.camera.rig import StereoRig
from livedeform.stereo_node.camera.setup import declared_camera_pose, rig_of
from livedeform.stereo_node.effects import EFFECTS, Surface, View, correct_all
from livedeform.stereo_node.effects.refraction import spread
from livedeform.stereo_node.surfaces import PredictedSurfaces

__all__ = ["MeasuringCorrection", "format_pose", "make_view", "parse_pose"]

NEED_SURFACE = {"refraction"}
NO_SURFACE = "no /fem/surface is near their moment; check that fem_node runs and poses come"


def make_view(
    experiment: Experiment,
    start_ns: int,
    *,
    T_phantom_left: Array | None = None,
    rig: StereoRig | None = None,
    rest: Array | None = None,
    surface: Callable[[int], Surface | None] | None = None,
) -> View:
    """Gather what the measuring effects of an experiment need to know.

    ``T_phantom_left`` defaults to the experiment's ``stereo.pose`` where that is given as numbers (nobody knows it
    otherwise: the identity), ``rig`` to its calibration files, ``rest`` (n, 3) m, the markers at rest, to where they
    are declared.
    """
    markers, declared = experiment.markers, declared_camera_pose(experiment)
    if T_phantom_left is None:
        T_phantom_left = np.eye(4) if declared is None else pose_matrix(declared)
    return View(
        T_phantom_left=T_phantom_left,
        rig=rig_of(experiment) if rig is None else rig,
        rest=markers.points if rest is None else rest,
        ids=markers.ids,
        kinds=np.asarray(markers.kinds),
        start_ns=start_ns,
        surface=surface,
        registered=declared is None,
    )


class MeasuringCorrection:
    """The inverse of an experiment's measuring effects; False, and does nothing, if there are none.

    ``start_ns`` 0: the recording starts with the first frame. Where internal markers are seen through the predicted
    surface, a frame waits until that of its moment is in ``surfaces``, for ``wait`` s of the frames' stamps at most; 0:
    it does not wait, since predictions follow frames.
    """

    def __init__(
        self,
        experiment: Experiment,
        start_ns: int = 0,
        T_phantom_left: Array | None = None,
        rest: Array | None = None,
        wait: float = 0.0,
    ) -> None:
        self._effects = [effect for effect in experiment.effects if effect.name in EFFECTS]
        self._experiment, self._start_ns = experiment, start_ns
        self._T_phantom_left, self._rest = T_phantom_left, rest
        self._rig: StereoRig | None = None
        self._view: View | None = None
        self.surfaces = PredictedSurfaces()
        self._wait_ns, self._waiting = round(wait * 1e9), deque[MarkerFrame]()

    @property
    def needs_surface(self) -> bool:
        """Return whether ``surfaces`` must be kept up to date."""
        return any(effect.name in NEED_SURFACE for effect in self._effects)

    def __bool__(self) -> bool:
        return bool(self._effects)

    def cameras(self, T_phantom_left: Array, rig: StereoRig) -> None:
        """Take where the cameras are, once that is known."""
        self._T_phantom_left, self._rig, self._view = T_phantom_left, rig, None

    def take(self, frame: MarkerFrame) -> list[tuple[MarkerFrame, str]]:
        """Take a measured frame and return what is `ready` now."""
        self._waiting.append(frame)
        return self.ready()

    def hear(self, stamp_ns: int, surface: Array) -> list[tuple[MarkerFrame, str]]:
        """Take the points (m, 3) m of a predicted surface and return what is `ready` now."""
        self.surfaces.add(stamp_ns, surface)
        return self.ready()

    def ready(self, *, ended: bool = False) -> list[tuple[MarkerFrame, str]]:
        """Return the corrected frames that wait no more (none does where the input ``ended``), in their order, each
        with what is wrong with it."""
        out = []
        while self._waiting and (ended or not self._waits(self._waiting[0].stamp_ns)):
            frame = self._waiting.popleft()
            corrected = self.apply(frame)
            n = self._n_internal(frame) - self._n_internal(corrected)
            out.append((corrected, f"{n} internal markers are left out: {NO_SURFACE}" if n else ""))
        return out

    def _waits(self, stamp_ns: int) -> bool:
        waited = abs(self._waiting[-1].stamp_ns - stamp_ns)
        return self.needs_surface and waited < self._wait_ns and self.surfaces.awaited(stamp_ns)

    def _n_internal(self, frame: MarkerFrame) -> int:
        markers = self._experiment.markers
        return int(np.isin(frame.ids, markers.ids[np.asarray(markers.kinds) == "internal"]).sum())

    def apply(self, frame: MarkerFrame) -> MarkerFrame:
        """Return the frame as a rig without these effects would have measured it; markers that are not declared are
        left out, and internal ones where the surface that refracts their rays is not known.

        The covariances are left as they are, since the effects change lengths by percents; but refraction divides the
        depths of internal markers, whose scatter is multiplied again when it is taken out.
        """
        if not self._effects or len(frame.ids) == 0:
            return frame
        if self._view is None:
            start_ns = self._experiment.timeline.clock_start_ns or self._start_ns or frame.stamp_ns
            self._view = make_view(
                self._experiment,
                start_ns,
                T_phantom_left=self._T_phantom_left,
                rig=self._rig,
                rest=self._rest,
                surface=self.surfaces.at,
            )
        known = np.isin(frame.ids, self._view.ids)
        if self.needs_surface and self.surfaces.at(frame.stamp_ns) is None:
            known &= ~np.isin(frame.ids, self._view.ids[self._view.kinds == "internal"])
        view, reported = self._view.for_ids(frame.ids[known]), frame.points[known]
        covariances = frame.covariances[known]
        points = correct_all(reported, frame.stamp_ns, self._effects, view)
        for effect in self._effects:
            if effect.name == "refraction":
                covariances = spread(reported, covariances, frame.stamp_ns, effect.values, view)
        return replace(
            frame,
            ids=frame.ids[known],
            points=points,
            covariances=covariances,
            reprojection_error_px=frame.reprojection_error_px[known],
        )


def parse_pose(text: str) -> Array | None:
    """Read T (4, 4) from "x y z qx qy qz qw"; None from an empty text."""
    if not text:
        return None
    try:
        x, y, z, *turn = (float(word) for word in text.split())
        return pose_matrix(unit_pose(0, (x, y, z), turn))
    except ValueError as error:
        remedy = 'write seven numbers, "x y z qx qy qz qw"'
        raise InputError(f"'{text}' is no pose", where="camera_pose", remedy=remedy) from error


def format_pose(pose: Pose) -> str:
    """Return the text that ``parse_pose`` reads."""
    return " ".join(repr(float(v)) for v in (*pose.position, *pose.orientation_xyzw))
