"""The stereo tracker: two pictures in, measured markers with identities and covariances out."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from livedeform.common.errors import CalibrationError, InputError
from livedeform.common.experiment.plausibility import read_body
from livedeform.common.experiment.schema import Experiment, Markers
from livedeform.common.frames import apply, inverse, pose_matrix
from livedeform.common.types import Array, CameraCalibration, Image, MarkerFrame, Pose
from livedeform.stereo_node.calibrate.bundle import Bundle
from livedeform.stereo_node.camera.calibration_uncertainty import (
    CalibrationUncertainty,
    calibration_uncertainty,
    read_bundle,
)
from livedeform.stereo_node.camera.known_field import known_field
from livedeform.stereo_node.camera.rig import StereoRig
from livedeform.stereo_node.camera.setup import declared_camera_pose, rig_of
from livedeform.stereo_node.camera.triangulate import Triangulated, triangulate_missing
from livedeform.stereo_node.detect.adapt import adapted, strongest
from livedeform.stereo_node.detect.blobs import Blobs
from livedeform.stereo_node.detect.fiducials import codes_alike, counted_as_left, detect_markers
from livedeform.stereo_node.detect.picture import Picture, noise_level
from livedeform.stereo_node.detect.settings import DetectorSettings
from livedeform.stereo_node.discs.centres import DiscCorrection
from livedeform.stereo_node.picture_checks import WHERE, BadPictures, PictureChecks
from livedeform.stereo_node.status import FrameStatus, total_counts
from livedeform.stereo_node.track.identities import MAY_BE_NEIGHBOURS, IdentityTracker, Tracked, TrackSettings
from livedeform.stereo_node.track.match import MatchSettings, Pairs, candidate_pairs
from livedeform.stereo_node.track.register import MIN_MARKERS, Registration, refine
from livedeform.stereo_node.track.sides import nearly_flat, outward_side
from livedeform.stereo_node.track.start import (
    MarkersAtRest,
    named_as_before,
    register_cameras,
    track_from_pose,
    track_from_registration,
)

__all__ = ["FrameStatus", "StereoTracker", "TrackerSettings"]

Rows = NDArray[np.int64]
MIN_MARKERS_TO_LEARN = 6
MEDIAN_CHI2 = 0.4549  # of chi-square with one degree of freedom
MOST_CHI2 = 20.0  # 4.5 sigma
MIN_SHARE = 0.3  # of the matched spots must be markers before anything is published


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


def detector_of(experiment: Experiment) -> DetectorSettings:
    """Return the detector's settings that the experiment declares."""
    if experiment.stereo is None:
        return DetectorSettings()
    detector = experiment.stereo.detector
    return DetectorSettings.from_mapping({"type": detector.type, **detector.settings})


class Spots(NamedTuple):
    """Round or coded spots of the left and of the right picture."""

    left: Blobs
    right: Blobs


@dataclass(frozen=True)
class MeasuredMarkers:
    """The markers of one frame: rows ``markers`` (n,) of the experiment's markers and ``pairs`` (n,) of the pairs of
    spots, and their ``points`` with covariances in the left frame. ``rejected``: what was left out, by reason."""

    markers: Rows
    pairs: Rows
    points: Triangulated
    rejected: dict[str, int]

    def __len__(self) -> int:
        return len(self.markers)


class StereoTracker:
    """Measures the markers in stereo pictures. ``process`` is all that a node calls.

    ``rest_points`` (m, 3) m: where the markers are at rest in the recording, if that is not where ``markers``
    declares them (an unloaded scan that sags). Without ``T_phantom_left`` the pose is found from the first pictures,
    in which the body must be at rest, and of markers in a plane by ``outward`` (3,), its normal out of the body.
    """

    def __init__(
        self,
        rig: StereoRig,
        markers: Markers,
        settings: TrackerSettings | None = None,
        T_phantom_left: Array | Pose | None = None,
        rest_points: Array | None = None,
        calibration: Bundle | None = None,
        outward: Array | None = None,
    ) -> None:
        self.rig = rig
        self.settings = settings = settings or TrackerSettings()
        self.ids = np.asarray(markers.ids, np.uint32)
        points = np.asarray(markers.points if rest_points is None else rest_points, float)
        kinds = np.asarray(markers.kinds)
        self._rest = MarkersAtRest(points, kinds, settings.rest_tolerance, settings.rest_tolerance_most, outward)
        if isinstance(T_phantom_left, Pose):
            T_phantom_left = pose_matrix(T_phantom_left)
        self.T_phantom_left: Array | None = T_phantom_left
        self._given = T_phantom_left is not None
        self.registration: Registration | None = None
        self._refined = False  # whether the registration is by the middles of the markers
        self.systematic: CalibrationUncertainty | None = None
        self._calibration = calibration
        self._field = None if calibration is None else known_field(calibration, (rig.left.width, rig.left.height))
        self._proven = False  # whether a pair was measured well
        self._identities: IdentityTracker | None = None
        self._discs: DiscCorrection | None = None
        self._checks = PictureChecks(rig, settings.detector.min_contrast / 2, settings.refuse_frozen)
        most = settings.detector.most or 4 * len(self.ids) + 40
        self._detector = self._first_detector = replace(settings.detector, most=most)

    @classmethod
    def from_experiment(
        cls,
        experiment: Experiment,
        cameras: tuple[CameraCalibration, CameraCalibration] | None = None,
        rest_points: Array | None = None,
    ) -> StereoTracker:
        """Make the tracker of an experiment; ``cameras`` (left, right) of the recording where it names no files."""
        recorded = {} if cameras is None else dict(zip(("left", "right"), cameras, strict=True))
        rig = rig_of(experiment, recorded)
        if rig is None:
            raise CalibrationError(
                "no camera calibration", where="stereo.left", remedy="name the calibration files or record CameraInfo"
            )
        stereo, settings = experiment.stereo, TrackerSettings(detector=detector_of(experiment))
        bundle = None if stereo is None or stereo.left is None else read_bundle(stereo.left, rig)
        pose = declared_camera_pose(experiment)
        side = None if pose is not None else _outward(experiment, rest_points)
        return cls(rig, experiment.markers, settings, pose, rest_points, bundle, side)

    def process(self, left: Image, right: Image, model: Array | None = None) -> tuple[MarkerFrame, FrameStatus]:
        """Measure the markers of one pair, in the frame phantom.

        ``model`` (m, 3) m: the model's prediction, NaN where unknown; it helps to tell which point is which marker, and
        no point is moved towards it. A pair that cannot be measured gives an empty frame and a status that says why; no
        exception leaves this function for anything that pictures can hold.
        """
        stamp_ns, spots = left.stamp_ns, None
        try:
            # Refuse pictures that are empty, dark, late, or frozen
            pictures = self._checks.grey_pair(left, right)
            # Find the spots that may be markers in both pictures
            spots = self._detect(pictures)
            # Pair spots of both pictures that meet: points with covariances
            pairs = self._pair(spots)
            # Find where the cameras are, with the first pictures
            identities = self._start(pairs, spots)
        except InputError as error:
            return empty_frame(stamp_ns), self._refused(stamp_ns, error, spots)
        # Tell which pair is which marker, through time and occlusion
        tracked = self._identify(identities, stamp_ns, pairs, spots, model)
        # Measure the middles of the markers, and leave out those whose rays do not meet
        measured = self._measure(identities, spots, pairs, tracked)
        # Refine where the cameras are by these, with the first pictures
        self._refine_cameras(measured)
        # Judge the measurement
        status = self._judge(stamp_ns, spots, pairs, tracked, measured)
        # Learn from it for the next pictures
        frame = self._frame(status, measured)
        self._learn(status, pictures, spots, pairs, measured)
        return frame, status

    # --- the steps ---------------------------------------------------------------------------------------------------

    def _detect(self, pictures: tuple[Picture, Picture]) -> Spots:
        left, right = (detect_markers(picture, self._detector, noise_level(picture)) for picture in pictures)
        right = counted_as_left(left, right, self._detector)
        if self._identities is None:
            most = 2 * len(self.ids) + 20
            return Spots(strongest(left, most), strongest(right, most))
        return Spots(left, right)

    def _pair(self, spots: Spots) -> Pairs:
        """Pair the spots; ``BadPictures`` where a picture has none, or the pictures seem to be exchanged."""
        for side, blobs in zip(("left", "right"), spots, strict=True):
            if len(blobs) == 0:
                reasons = ", ".join(f"{n} x {r}" for r, n in (blobs.rejected or {}).items()) or "no spot stands out"
                raise BadPictures(
                    f"no marker in the {side} picture ({reasons})", remedy="check view, light and stereo.detector"
                )
        pairs = candidate_pairs(self.rig, *spots, self.settings.match)
        if self._identities is None:
            self._check_sides(pairs, spots)
            self._check_depth(pairs, spots)
        return pairs

    def _check_depth(self, pairs: Pairs, spots: Spots) -> None:
        """Raise ``BadPictures`` where most spots meet nearer or farther away than markers are looked for."""
        match, n, half = self.settings.match, len(np.unique(pairs.left)), 0.5 * min(map(len, spots))
        if n >= half:
            return
        anywhere = candidate_pairs(self.rig, *spots, replace(match, min_depth=0.0, max_depth=np.inf))
        if len(np.unique(anywhere.left)) >= max(2 * n, half):
            z = float(np.median(anywhere.points.points[:, 2]))
            raise BadPictures(
                f"spots meet {z:.3g} m from the cameras; markers are looked for from {match.min_depth:g} to "
                f"{match.max_depth:g} m", where=WHERE, remedy="check the unit of the calibration, or move the cameras",
            )  # fmt: skip

    def _check_sides(self, pairs: Pairs, spots: Spots) -> None:
        """Raise ``BadPictures`` where far more spots would meet if the pictures were exchanged."""
        n_left = len(np.unique(pairs.left))
        if n_left >= 0.5 * min(len(spots.left), len(spots.right)):
            return
        turned = candidate_pairs(self.rig, spots.right, spots.left, self.settings.match)
        n_turned = len(np.unique(turned.left))
        if n_turned >= max(2 * n_left, MIN_MARKERS):
            raise BadPictures(
                f"{n_left} spots of the left picture meet one of the right; exchanged, {n_turned} would",
                where=WHERE,
                remedy="exchange the cameras' topics, or stereo.left and stereo.right",
            )

    def _start(self, pairs: Pairs, spots: Spots) -> IdentityTracker:
        """Return the identities; the first pictures start them, and give T_phantom_left unless it is known."""
        if self._identities is not None:
            return self._identities
        if self.T_phantom_left is not None:
            self._identities = track_from_pose(self.T_phantom_left, self._rest, self.settings.track)
        else:
            self.registration = found = register_cameras(pairs, self._codes(pairs, spots), self._rest)
            self.T_phantom_left, self._refined = found.T_phantom_left, False
            self._identities = track_from_registration(found, pairs, self._rest, self.settings.track)
        return self._identities

    def _identify(
        self, identities: IdentityTracker, stamp_ns: int, pairs: Pairs, spots: Spots, model: Array | None
    ) -> Tracked:
        in_left = None if model is None else apply(inverse(self._pose()), model)
        names = named_as_before(self._codes(pairs, spots), pairs, identities)
        return identities.update(stamp_ns, pairs, in_left, names)

    def _pose(self) -> Array:
        """Return T_phantom_left (4, 4) once it is known."""
        assert self.T_phantom_left is not None  # _start has found it
        return self.T_phantom_left

    def _codes(self, pairs: Pairs, spots: Spots) -> list[Rows] | None:
        """Return marker rows (n,) of the pairs where the picture itself names them, -1 for codes of no marker, in each
        way that looks alike; None without codes."""
        if spots.left.codes is None:
            return None
        row = {int(name): i for i, name in enumerate(self.ids)}
        ways = codes_alike(spots.left.codes[pairs.left], self._detector)
        return [np.array([row.get(int(code), -1) for code in codes], np.int64) for codes in ways]

    def _measure(self, identities: IdentityTracker, spots: Spots, pairs: Pairs, tracked: Tracked) -> MeasuredMarkers:
        rows, markers = tracked.pairs[tracked.confirmed], tracked.markers[tracked.confirmed]
        order = np.argsort(markers)
        rows, markers = rows[order], markers[order]
        points = self._middles(identities, spots, pairs, rows, markers)
        meet = _rays_meet(points) | (self._rest.kinds[markers] == "internal")  # refracted rays miss each other
        known = self._known(spots, pairs, rows)
        reasons = {"rays do not meet": int((~meet & known).sum()), "beyond what was calibrated": int((~known).sum())}
        kept = meet & known
        lost = {reason: n for reason, n in reasons.items() if n}
        return MeasuredMarkers(markers[kept], rows[kept], points.take(kept), lost)

    def _known(self, spots: Spots, pairs: Pairs, rows: Rows) -> NDArray[np.bool_]:
        """Tell which of the pairs ``rows`` (n,) lie where the calibration knows both lenses."""
        if self._field is None:
            return np.ones(len(rows), bool)
        return self._field.holds(spots.left.centres[pairs.left[rows]], spots.right.centres[pairs.right[rows]])

    def _middles(
        self, identities: IdentityTracker, spots: Spots, pairs: Pairs, rows: Rows, markers: Rows
    ) -> Triangulated:
        """Return the middles of the markers of the pairs ``rows``; refracted rays to those inside miss each other."""
        left, right = spots.left.take(pairs.left[rows]), spots.right.take(pairs.right[rows])
        points = self._of_outlines(identities, left, right, pairs.points.take(rows), markers)
        inside = self._rest.kinds[markers] == "internal"
        if not inside.any():
            return points
        left, right = left.take(inside), right.take(inside)
        missing = triangulate_missing(self.rig, left.centres, right.centres, left.covariances, right.covariances)
        return points.put(inside, missing)

    def _of_outlines(
        self, identities: IdentityTracker, left: Blobs, right: Blobs, points: Triangulated, markers: Rows
    ) -> Triangulated:
        """Return the middles of the ``markers``, whose outlines' are ``points``: of discs they are others."""
        marker = self.settings.detector.marker
        if marker == "ball" or left.codes is not None or not len(markers):
            return points
        if self._discs is None:
            self._discs = DiscCorrection(self.rig, identities.rest, self._rest.kinds, marker == "painted")
        places, sigma = identities.places()
        sigma[markers] = np.sqrt(np.trace(points.covariances, axis1=1, axis2=2) / 3)
        return self._discs.middles(points, left, right, markers, places, sigma)

    def _refine_cameras(self, measured: MeasuredMarkers) -> None:
        """Refine the registration by the middles of the markers of its own pictures."""
        if self.registration is None or self._refined:
            return
        self._refined = True
        outside = np.isin(measured.markers, self._rest.outside)
        if outside.sum() >= MIN_MARKERS:
            points, declared = measured.points.take(outside), self._rest.points[measured.markers[outside]]
            self.registration = refine(self.registration, points.points, points.covariances, declared)
            self.T_phantom_left = self.registration.T_phantom_left

    def _judge(
        self, stamp_ns: int, spots: Spots, pairs: Pairs, tracked: Tracked, measured: MeasuredMarkers
    ) -> FrameStatus:
        epipolar = pairs.epipolar_px[measured.pairs]
        n_matched = len(np.unique(pairs.left))
        rms = float(np.sqrt((epipolar**2).mean())) if len(measured) else float("nan")
        level, message = self._verdict(len(measured), rms, n_matched, self._beside_rest(measured))
        if MAY_BE_NEIGHBOURS in tracked.rejected:
            what = "markers may have moved to their neighbours' places since the pictures before"
            level, message = "error", f"{what}; waiting until the body is as before, or at rest"
        known = self._uncertainty_of_calibration(measured)
        return FrameStatus(
            stamp_ns,
            level,
            message,
            n_found_left=len(spots.left),
            n_found_right=len(spots.right),
            n_matched=n_matched,
            n_identified=len(measured),
            n_markers=len(self.ids),
            rejected=total_counts(tracked.rejected, measured.rejected, *(dict(b.rejected or {}) for b in spots)),
            epipolar_rms_px=rms,
            epipolar_mean_px=float(np.median(epipolar)) if len(measured) else float("nan"),
            calibration_sigma=float("nan") if known is None else known.in_left_frame,
            calibration_sigma_registered=float("nan") if known is None else known.registered,
            n_by_model=tracked.n_by_model,
        )

    def _beside_rest(self, measured: MeasuredMarkers) -> float:
        """Return how far (m, median) the markers lie from their declared places by a given pose, with which the first
        pictures begin; 0 later and where the pose was found from them."""
        if self._proven or not self._given or not len(measured):
            return 0.0
        places = apply(self._pose(), measured.points.points)
        return float(np.median(np.linalg.norm(places - self._rest.points[measured.markers], axis=1)))

    def _verdict(self, n: int, epipolar_rms: float, n_matched: int, beside_rest: float) -> tuple[str, str]:
        """Return level and message for ``n`` markers with an epipolar error (px, rms) among ``n_matched`` spots, that
        begin ``beside_rest`` m from their declared places."""
        settings = self.settings
        if n == 0:
            return "error", "no marker was identified; check that the body is in view and T_phantom_left still holds"
        if epipolar_rms > settings.epipolar_limit_px:
            what = f"the epipolar error is {epipolar_rms:.2f} px"
            return "error", f"{what}; the calibration is not of these cameras as they stand"
        if not self._proven and n < min(MIN_SHARE * min(n_matched, len(self.ids)), len(self.ids)):
            what = f"{n} of {n_matched} matched spots are where markers should be"
            return "error", f"{what}; check the given pose, markers.csv and the calibration"
        if beside_rest > settings.rest_tolerance_most:
            what = f"the markers are {beside_rest * 1e3:.1f} mm (median) from where they should be"
            return "error", f"{what}; check the given pose, markers.csv and the calibration"
        said = f"{n} of {len(self.ids)} markers"
        if self.registration is not None and self.registration.rms > 1.5 * settings.rest_tolerance:
            fit = f"at rest they are {self.registration.rms * 1e3:.1f} mm rms from their declared places"
            return "warn", f"{said}; {fit}: check scale, configuration and calibration"
        if epipolar_rms > settings.epipolar_warning_px:
            return "warn", f"{said}; the epipolar error of {epipolar_rms:.2f} px asks for a new calibration"
        return ("warn" if n < 0.5 * len(self.ids) else "ok"), said

    def _uncertainty_of_calibration(self, measured: MeasuredMarkers) -> CalibrationUncertainty | None:
        """Return what the calibration's own uncertainty does to the markers, which is computed once."""
        if self._calibration is not None and self.systematic is None and len(measured) >= MIN_MARKERS:
            self.systematic = calibration_uncertainty(self._calibration, self.rig, measured.points.points)
        return self.systematic

    def _learn(
        self,
        status: FrameStatus,
        pictures: tuple[Picture, Picture],
        spots: Spots,
        pairs: Pairs,
        measured: MeasuredMarkers,
    ) -> None:
        """Begin anew while nothing was ever measured well; adapt the detector to the markers' looks once."""
        if status.level == "error":
            if not self._proven:
                self._identities = None
                if not self._given:
                    self.T_phantom_left = self.registration = None
            return
        self._proven = True
        few = len(measured) < max(0.5 * len(self.ids), MIN_MARKERS_TO_LEARN)
        if self._detector is not self._first_detector or few or spots.left.codes is not None:
            return
        seen = spots.left.take(pairs.left[measured.pairs]), spots.right.take(pairs.right[measured.pairs])
        self._detector = adapted(self.settings.detector, pictures, seen)

    def _frame(self, status: FrameStatus, measured: MeasuredMarkers) -> MarkerFrame:
        """Return the markers in the frame phantom; none where the measurement is in error."""
        if status.level == "error":
            return empty_frame(status.stamp_ns)
        T, points = self._pose(), measured.points
        R = T[:3, :3]
        return MarkerFrame(
            status.stamp_ns,
            self.ids[measured.markers],
            apply(T, points.points),
            R @ points.covariances @ R.T,
            points.reprojection_error_px,
        )

    def _refused(self, stamp_ns: int, error: InputError, spots: Spots | None) -> FrameStatus:
        """Return the status of pictures that could not be measured; ``spots`` where some had been looked for."""
        status = FrameStatus(stamp_ns, "error", str(error), n_markers=len(self.ids))
        if spots is None:
            return status
        rejected = total_counts(*(dict(blobs.rejected or {}) for blobs in spots))
        return replace(status, n_found_left=len(spots.left), n_found_right=len(spots.right), rejected=rejected)


def _outward(experiment: Experiment, rest_points: Array | None) -> Array | None:
    """Return the normal (3,) out of the body of the plane of its markers, as they are declared; None where they do not
    lie in one at rest, ``rest_points`` (m, 3) m if those are others."""
    markers = experiment.markers
    outside = markers.kinds != "internal"
    at_rest = (markers.points if rest_points is None else rest_points)[outside]
    if len(at_rest) < MIN_MARKERS or not nearly_flat(at_rest):
        return None
    return outward_side(read_body(experiment), markers.points[outside])


def _rays_meet(measured: Triangulated) -> NDArray[np.bool_]:
    """Test (n,) the chi-square of each point (one degree of freedom) against how well the others' rays meet.

    A calibration that is slightly off lets all of them miss by as many pixels, however well their centres are known:
    the variance by which half of them miss more than their own covariances let them is added to each one's own.
    """
    if len(measured.chi2) < MIN_MARKERS_TO_LEARN:
        return np.ones(len(measured.chi2), bool)
    missed = 2 * measured.reprojection_error_px**2
    own = missed / np.maximum(measured.chi2, 1e-12)
    common = max(float(np.median(missed / MEDIAN_CHI2 - own)), 0.0)
    return np.asarray((missed < MOST_CHI2 * (own + common)) | (missed == 0))


def empty_frame(stamp_ns: int) -> MarkerFrame:
    """Return a frame without markers."""
    return MarkerFrame(stamp_ns, np.zeros(0, np.uint32), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0))
