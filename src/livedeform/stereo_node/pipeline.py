"""The stereo tracker: two pictures in, measured markers with identities and covariances out."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from livedeform.common.errors import CalibrationError, InputError
from livedeform.common.experiment.yaml_file import Experiment, Markers
from livedeform.common.frames import apply, inverse, pose_matrix
from livedeform.common.types import Array, CameraCalibration, Image, MarkerFrame, Pose
from livedeform.stereo_node.calibrate.bundle import Bundle
from livedeform.stereo_node.camera.camera import StereoRig, read_camera
from livedeform.stereo_node.camera.systematic import Systematic, read_bundle, systematic
from livedeform.stereo_node.camera.triangulate import Triangulated
from livedeform.stereo_node.detect.blobs import Blobs, DetectorSettings, find_candidates, grey, noise_level
from livedeform.stereo_node.detect.coded import detect_markers
from livedeform.stereo_node.detect.discs import DiscCorrection
from livedeform.stereo_node.detect.picture import spread
from livedeform.stereo_node.track.identities import IdentityTracker, TrackSettings
from livedeform.stereo_node.track.match import MatchSettings, Pairs, candidate_pairs
from livedeform.stereo_node.track.register import (
    MIN_MARKERS,
    Registration,
    RegistrationError,
    refine,
    register,
    register_named,
)

MIN_MARKERS_TO_LEARN = 6
INTERNAL_SIGMA = 3e-3  # m: refraction lifts a marker 10 mm below the surface by that
MEDIAN_CHI2 = 0.4549  # of chi-square with one degree of freedom
MOST_CHI2 = 20.0  # 4.5 sigma
MIN_SHARE = 0.3  # of the matched spots must be markers before anything is published


@dataclass(frozen=True)
class FrameStatus:
    """What became of one pair of pictures.

    ``level`` is "ok", "warn" (fewer markers than usual), or "error" (no point is published; ``message`` says why and
    what to do). ``rejected`` counts what was not published, by reason. ``epipolar_rms_px`` is of the identified
    markers. ``calibration_sigma``, m: what the calibration's own uncertainty displaces markers by (rms), and what the
    registration leaves of that; common to all pictures and not in the points' covariances. NaN where no
    ``calibration.json`` lies beside the cameras' files. ``n_by_model``: markers not seen before this pair that were
    looked for where the model's prediction puts them.
    """

    stamp_ns: int
    level: str
    message: str
    n_found_left: int = 0
    n_found_right: int = 0
    n_matched: int = 0
    n_identified: int = 0
    n_markers: int = 0
    rejected: dict[str, int] = field(default_factory=dict)
    epipolar_rms_px: float = float("nan")
    epipolar_mean_px: float = float("nan")
    calibration_sigma: float = float("nan")
    calibration_sigma_registered: float = float("nan")
    n_by_model: int = 0


@dataclass(frozen=True)
class TrackerSettings:
    """All settings of the stereo tracker."""

    detector: DetectorSettings = field(default_factory=DetectorSettings)
    match: MatchSettings = field(default_factory=MatchSettings)
    track: TrackSettings = field(default_factory=TrackSettings)
    rest_tolerance: float = 1.0e-3  # m, how far markers at rest may lie from their declared places
    rest_tolerance_most: float = 6.0e-3  # m, tried when the first does not do
    epipolar_limit_px: float = 1.0  # a common epipolar error above it is a calibration of another camera
    epipolar_warning_px: float = 0.4
    refuse_frozen: bool = True


class BadPictures(InputError):
    """A pair of pictures that must not be measured."""


class StereoTracker:
    """Measures the markers in stereo pictures. ``process`` is all that a node calls.

    ``rest_points`` (m, 3) m: where the markers are at rest in the recording, if that is not where ``markers``
    declares them (an unloaded scan that sags). Without ``T_phantom_left`` the pose is found from the first pictures,
    in which the body must be at rest.
    """

    def __init__(
        self,
        rig: StereoRig,
        markers: Markers,
        settings: TrackerSettings | None = None,
        T_phantom_left: Array | Pose | None = None,
        rest_points: Array | None = None,
        calibration: Bundle | None = None,
    ) -> None:
        self.rig = rig
        self._calibration = calibration
        self.systematic: Systematic | None = None
        self.ids = np.asarray(markers.ids, np.uint32)
        self.points = np.asarray(markers.points if rest_points is None else rest_points, float)
        self.settings = settings or TrackerSettings()
        if isinstance(T_phantom_left, Pose):
            T_phantom_left = pose_matrix(T_phantom_left)
        self.T_phantom_left: Array | None = T_phantom_left
        self._given = T_phantom_left is not None
        self._proven = False  # whether a pair was measured well
        self.registration: Registration | None = None
        self._tracker: IdentityTracker | None = None
        self._kinds = np.asarray(markers.kinds)
        self._outside = np.flatnonzero(self._kinds != "internal")  # internal ones are seen where refraction puts them
        if len(self._outside) < MIN_MARKERS:
            self._outside = np.arange(len(self.ids))
        self._discs: DiscCorrection | None = None
        most = self.settings.detector.most or 4 * len(self.ids) + 40
        self._detector = self._first_detector = replace(self.settings.detector, most=most)
        self._last: tuple[Any, Any] | None = None
        self._last_stamp_ns: int | None = None

    @classmethod
    def from_experiment(
        cls,
        experiment: Experiment,
        cameras: tuple[CameraCalibration, CameraCalibration] | None = None,
        rest_points: Array | None = None,
    ) -> StereoTracker:
        """From an experiment's files; ``cameras`` (left, right) of the recording's CameraInfo where it names none."""
        stereo = experiment.stereo
        if stereo is not None and stereo.left is not None and stereo.right is not None:
            cameras = read_camera(stereo.left), read_camera(stereo.right)
        if cameras is None:
            raise CalibrationError(
                "no camera calibration", where="stereo.left", remedy="name the calibration files or record CameraInfo"
            )
        settings = TrackerSettings()
        pose: Pose | None = None
        if stereo is not None:
            values = {"type": stereo.detector.type, **stereo.detector.settings}
            settings = replace(settings, detector=DetectorSettings.from_mapping(values))
            if not isinstance(stereo.pose, str):
                pose = Pose(0, np.array(stereo.pose.position, float), np.array(stereo.pose.orientation_xyzw, float))
        rig = StereoRig(*cameras)
        beside = None if stereo is None or stereo.left is None else read_bundle(stereo.left, rig)
        return cls(rig, experiment.markers, settings, pose, rest_points, beside)

    def process(self, left: Image, right: Image, model: Array | None = None) -> tuple[MarkerFrame, FrameStatus]:
        """Markers of one pair, in the frame phantom. ``model`` (m, 3) m: the model's prediction, NaN where unknown; it
        helps to tell which point is which marker, and no point is moved towards it.

        A pair that cannot be measured gives an empty frame and a status that says why; no exception leaves this
        function for anything that pictures can hold.
        """
        stamp_ns = left.stamp_ns
        try:
            grey_left, grey_right = self._checked(left, right)
            blobs = self._detect(grey_left), self._detect(grey_right)
            status = self._check_blobs(stamp_ns, *blobs)
            if status is not None:
                return empty_frame(stamp_ns), status
            if self._tracker is None:
                blobs = self._strongest(blobs[0]), self._strongest(blobs[1])
            pairs = candidate_pairs(self.rig, *blobs, self.settings.match)
            if self._tracker is None:
                self._check_sides(pairs, blobs)
                self._start(pairs, blobs)
        except InputError as error:
            return empty_frame(stamp_ns), FrameStatus(stamp_ns, "error", str(error), n_markers=len(self.ids))
        return self._track(stamp_ns, (grey_left, grey_right), blobs, pairs, model)

    def _track(
        self,
        stamp_ns: int,
        pictures: tuple[Any, Any],
        blobs: tuple[Blobs, Blobs],
        pairs: Pairs,
        model: Array | None,
    ) -> tuple[MarkerFrame, FrameStatus]:
        T = self.T_phantom_left
        assert self._tracker is not None and T is not None  # _start set both
        first = self._tracker.stamp_ns is None
        in_left = None if model is None else apply(inverse(T), model)
        tracked = self._tracker.update(stamp_ns, pairs, in_left, self._codes(pairs, blobs))
        rows = tracked.pairs[tracked.confirmed]
        markers = tracked.markers[tracked.confirmed]
        order = np.argsort(markers)
        rows, markers = rows[order], markers[order]
        measured = self._middles(blobs, pairs, rows, markers)
        meet = _rays_meet(measured) | (self._kinds[markers] == "internal")  # refracted rays miss each other
        rows, markers, measured = rows[meet], markers[meet], measured.take(meet)
        outside = np.isin(markers, self._outside)
        if first and self.registration is not None and outside.sum() >= MIN_MARKERS:
            self.registration = refine(
                self.registration,
                measured.points[outside],
                measured.covariances[outside],
                self.points[markers[outside]],
            )
            self.T_phantom_left = T = self.registration.T_phantom_left
        epipolar = pairs.epipolar_px[rows]
        rms = float(np.sqrt((epipolar**2).mean())) if len(rows) else float("nan")
        mean = float(np.median(epipolar)) if len(rows) else float("nan")
        rejected = dict(tracked.rejected)
        if not meet.all():
            rejected["rays do not meet"] = int((~meet).sum())
        for b in blobs:
            for reason, count in (b.rejected or {}).items():
                rejected[reason] = rejected.get(reason, 0) + count
        level, message = self._judge(len(rows), rms, len(np.unique(pairs.left)))
        if level == "error" and not self._proven:  # nothing was ever measured well: begin anew with the next pictures
            self._tracker = None
            if not self._given:
                self.T_phantom_left = self.registration = None
        self._proven |= level != "error"
        if (
            self._detector is self._first_detector
            and len(rows) >= 0.5 * len(self.ids)
            and level != "error"
            and blobs[0].codes is None
        ):
            self._learn_looks(pictures, blobs, pairs, rows)
        if self._calibration is not None and self.systematic is None and len(rows) >= MIN_MARKERS:
            self.systematic = systematic(self._calibration, self.rig, measured.points)
        known = self.systematic
        status = FrameStatus(
            stamp_ns,
            level,
            message,
            len(blobs[0]),
            len(blobs[1]),
            len(np.unique(pairs.left)),
            len(rows),
            len(self.ids),
            rejected,
            rms,
            mean,
            float("nan") if known is None else known.in_left_frame,
            float("nan") if known is None else known.registered,
            tracked.n_by_model,
        )
        if level == "error":
            return empty_frame(stamp_ns), status
        R = T[:3, :3]
        frame = MarkerFrame(
            stamp_ns,
            self.ids[markers],
            apply(T, measured.points),
            R @ measured.covariances @ R.T,
            measured.reprojection_error_px,
        )
        return frame, status

    def _middles(self, blobs: tuple[Blobs, Blobs], pairs: Pairs, rows: Any, markers: Any) -> Triangulated:
        """The middles of the markers of the pairs ``rows``."""
        left, right = blobs[0].take(pairs.left[rows]), blobs[1].take(pairs.right[rows])
        points = pairs.points.take(rows)
        tracker = self._tracker
        marker = self.settings.detector.marker
        if marker == "ball" or blobs[0].codes is not None or not len(rows) or tracker is None:
            return points
        if self._discs is None:
            self._discs = DiscCorrection(self.rig, tracker.rest, self._kinds, marker == "painted")
        places, sigma = tracker.places()
        sigma[markers] = np.sqrt(np.trace(points.covariances, axis1=1, axis2=2) / 3)
        return self._discs.middles(points, left, right, markers, places, sigma)

    def _codes(self, pairs: Pairs, blobs: tuple[Blobs, Blobs]) -> Any:
        """Marker rows (n,) of the pairs where the picture itself names them, -1 for codes of no marker; None without
        codes.
        """
        if blobs[0].codes is None:
            return None
        row = {int(name): i for i, name in enumerate(self.ids)}
        return np.array([row.get(int(code), -1) for code in blobs[0].codes[pairs.left]], np.int64)

    def _judge(self, n: int, epipolar_rms: float, n_matched: int) -> tuple[str, str]:
        settings = self.settings
        if n == 0:
            return "error", "no marker was identified; check that the body is in view and T_phantom_left still holds"
        if epipolar_rms > settings.epipolar_limit_px:
            what = f"the epipolar error is {epipolar_rms:.2f} px"
            return "error", f"{what}; the calibration is not of these cameras as they stand"
        if not self._proven and n < min(MIN_SHARE * min(n_matched, len(self.ids)), len(self.ids)):
            what = f"{n} of {n_matched} matched spots are where markers should be"
            return "error", f"{what}; check the given pose, markers.csv and the calibration"
        said = f"{n} of {len(self.ids)} markers"
        if self.registration is not None and self.registration.rms > 1.5 * settings.rest_tolerance:
            fit = f"at rest they are {self.registration.rms * 1e3:.1f} mm rms from their declared places"
            return "warn", f"{said}; {fit}: check scale, configuration and calibration"
        if epipolar_rms > settings.epipolar_warning_px:
            return "warn", f"{said}; the epipolar error of {epipolar_rms:.2f} px asks for a new calibration"
        return ("warn" if n < 0.5 * len(self.ids) else "ok"), said

    def _detect(self, picture: Any) -> Blobs:
        return detect_markers(picture, self._detector, noise_level(picture))

    def _strongest(self, blobs: Blobs) -> Blobs:
        """The spots that stand out most, twice as many as there are markers: before the markers' looks are known, a
        textured ground offers thousands of weak ones."""
        most = 2 * len(self.ids) + 20
        if len(blobs) <= most or blobs.codes is not None:
            return blobs
        strength = np.abs(blobs.contrasts) / np.maximum(blobs.residuals, 1.0)
        return blobs.take(np.sort(np.argsort(-strength)[:most]))

    def _learn_looks(self, pictures: tuple[Any, Any], blobs: tuple[Blobs, Blobs], pairs: Pairs, rows: Any) -> None:
        """Narrows the detector to twice the range of what the identified markers look like, and searches at half size
        if that finds all of them: it is faster, and sees less else."""
        if len(rows) < MIN_MARKERS_TO_LEARN:
            return
        seen = [b.take(side[rows]) for b, side in zip(blobs, (pairs.left, pairs.right), strict=True)]
        radii = np.concatenate([b.radii for b in seen])
        contrasts = np.concatenate([b.contrasts for b in seen])
        given = self.settings.detector
        dark = contrasts < 0
        learned = replace(
            given,
            min_radius=max(given.min_radius, 0.5 * float(radii.min())),
            max_radius=min(given.max_radius, 2.0 * float(radii.max())),
            polarity="dark" if dark.all() else "light" if not dark.any() else "both",
            min_contrast=max(given.min_contrast, 0.35 * float(np.median(np.abs(contrasts)))),
            levels=1,
        )
        # the cheapest search that finds all of them
        for width in (given.surroundings[:1], given.surroundings[1:2], given.surroundings):
            for step in (2, 1):
                search = replace(learned, surroundings=width, search_step=step)
                if width and all(_finds(p, search, b) for p, b in zip(pictures, seen, strict=True)):
                    self._detector = search
                    return
        self._detector = learned

    def _checked(self, left: Image, right: Image) -> tuple[Any, Any]:
        """Grey pictures, or ``BadPictures`` where they must not be measured."""
        greys = []
        for side, image, camera in (("left", left, self.rig.left), ("right", right, self.rig.right)):
            pixels = np.asarray(image.pixels)
            _check_size(side, pixels, camera)
            picture = grey(pixels, image.encoding)
            low, high = spread(picture)
            if high - low < self.settings.detector.min_contrast / 2:
                what = "black" if high < 30 else "white" if low > 225 else "of one grey"
                raise BadPictures(
                    f"the {side} picture is {what}",
                    where="stereo pictures",
                    remedy="check the light, the lens cap, the exposure, and that 16-bit pictures use all bits",
                )
            greys.append(picture)
        if self._last_stamp_ns is not None and left.stamp_ns <= self._last_stamp_ns:
            raise BadPictures(
                "the stamp is not later than the one before",
                where="stereo pictures",
                remedy="replay pictures in the order of their stamps",
            )
        frozen = [] if self._last is None else [_same(a, b) for a, b in zip(greys, self._last, strict=True)]
        self._last = greys[0], greys[1]
        self._last_stamp_ns = left.stamp_ns
        if self.settings.refuse_frozen and any(frozen):
            which = "both pictures are" if all(frozen) else f"the {'left' if frozen[0] else 'right'} picture is"
            raise BadPictures(
                f"{which} the same as before to the last pixel",
                where="stereo pictures",
                remedy="the camera is frozen: start its driver again",
            )
        return greys[0], greys[1]

    def _check_blobs(self, stamp_ns: int, left: Blobs, right: Blobs) -> FrameStatus | None:
        for side, blobs in (("left", left), ("right", right)):
            if len(blobs) == 0:
                reasons = ", ".join(f"{n} x {r}" for r, n in (blobs.rejected or {}).items()) or "no spot stands out"
                return FrameStatus(
                    stamp_ns,
                    "error",
                    f"no marker in the {side} picture ({reasons}); check view, light and stereo.detector",
                    len(left),
                    len(right),
                    n_markers=len(self.ids),
                    rejected=dict(blobs.rejected or {}),
                )
        return None

    def _check_sides(self, pairs: Pairs, blobs: tuple[Blobs, Blobs]) -> None:
        """``BadPictures`` where far more spots would meet if the pictures were exchanged."""
        n_left = len(np.unique(pairs.left))
        if n_left >= 0.5 * min(len(blobs[0]), len(blobs[1])):
            return
        turned = candidate_pairs(self.rig, blobs[1], blobs[0], self.settings.match)
        n_turned = len(np.unique(turned.left))
        if n_turned >= max(2 * n_left, MIN_MARKERS):
            raise BadPictures(
                f"{n_left} spots of the left picture meet one of the right; exchanged, {n_turned} would",
                where="stereo pictures",
                remedy="exchange the cameras' topics, or stereo.left and stereo.right",
            )

    def _start(self, pairs: Pairs, blobs: tuple[Blobs, Blobs]) -> None:
        """Finds T_phantom_left (unless it is given) and starts the identities."""
        if self.T_phantom_left is not None:
            rest = apply(inverse(self.T_phantom_left), self.points)
            sigma = self._start_sigma(self.settings.rest_tolerance_most / 3)
            self._tracker = IdentityTracker(rest, np.zeros(len(rest), bool), self.settings.track, sigma)
            return
        self.registration = self._register(pairs, blobs)
        self.T_phantom_left = self.registration.T_phantom_left
        rest = apply(inverse(self.T_phantom_left), self.points)
        seen = np.zeros(len(rest), bool)
        seen[self.registration.marker_rows] = True
        rest[self.registration.marker_rows] = pairs.points.points[self.registration.point_rows]
        sigma = self._start_sigma(3 * self.settings.rest_tolerance)
        self._tracker = IdentityTracker(rest, seen, self.settings.track, sigma)

    def _start_sigma(self, sigma: float) -> Array:
        """(m,) m: how far markers may be from where they are declared when they are first seen."""
        return np.where(self._kinds == "internal", np.maximum(sigma, INTERNAL_SIGMA), sigma)

    def _register(self, pairs: Pairs, blobs: tuple[Blobs, Blobs]) -> Registration:
        if len(pairs) == 0:
            raise RegistrationError(
                "no spot of the left picture meets one of the right picture",
                where="stereo calibration",
                remedy="check that left and right are not exchanged and that the calibration is of these cameras",
            )
        codes = self._codes(pairs, blobs)
        if codes is not None:
            known = np.flatnonzero(np.isin(codes, self._outside))
            return register_named(
                pairs.points.points[known],
                pairs.points.covariances[known],
                self.points[codes[known]],
                known,
                codes[known],
                self.settings.rest_tolerance_most,
            )
        groups = np.stack([pairs.left, pairs.right], axis=1)
        tolerance = self.settings.rest_tolerance
        while True:
            try:
                found = register(
                    pairs.points.points, pairs.points.covariances, self.points[self._outside], tolerance, groups=groups
                )
                return replace(found, marker_rows=self._outside[found.marker_rows])
            except RegistrationError:
                tolerance *= 2.5
                if tolerance > self.settings.rest_tolerance_most:
                    raise


def _same(a: Any, b: Any) -> bool:
    """Whether two pictures are the same to the last pixel; some rows tell most that are not."""
    return np.array_equal(a[::32], b[::32]) and np.array_equal(a, b)


def _rays_meet(measured: Triangulated) -> Any:
    """(n,) bool: the chi-square test of each point (one degree of freedom), against how well the others' rays meet: a
    calibration that is slightly off lets all of them miss."""
    if len(measured.chi2) < MIN_MARKERS_TO_LEARN:
        return np.ones(len(measured.chi2), bool)
    common = max(float(np.median(measured.chi2)) / MEDIAN_CHI2, 1.0)
    return measured.chi2 < MOST_CHI2 * common


def _finds(picture: Any, settings: DetectorSettings, wanted: Blobs) -> bool:
    """Whether the search alone finds all of ``wanted``."""
    found = find_candidates(picture, settings)[0]
    return bool(len(found) and np.linalg.norm(wanted.centres[:, None] - found[None], axis=2).min(axis=1).max() < 2.0)


def _check_size(side: str, pixels: Any, camera: CameraCalibration) -> None:
    if pixels.ndim not in (2, 3) or pixels.size == 0:
        raise BadPictures(
            f"the {side} picture is empty", where="stereo pictures", remedy="check that both cameras publish"
        )
    if pixels.shape[:2] != (camera.height, camera.width):
        raise BadPictures(
            f"the {side} picture is {pixels.shape[1]}x{pixels.shape[0]}, its calibration "
            f"{camera.width}x{camera.height}",
            where="stereo pictures",
            remedy="calibrate at the size that the camera publishes",
        )


def empty_frame(stamp_ns: int) -> MarkerFrame:
    """A frame without markers."""
    return MarkerFrame(stamp_ns, np.zeros(0, np.uint32), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0))
