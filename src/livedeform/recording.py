"""Write a recording of one's own tracker, robot and cameras: ``livedeform.recording.Writer``. Needs no ROS.

The contract of a recording (fields, units, frames, the probe's frame) is on one page, docs/recordings.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

import livedeform
from livedeform.common import topics as t
from livedeform.common.bags import layouts
from livedeform.common.bags.recording_writer import RecordingWriter
from livedeform.common.bags.write import BagWriter
from livedeform.common.errors import InputError
from livedeform.common.frames import apply, transform, unit_pose
from livedeform.common.types import Array, CameraCalibration, Image, MarkerFrame, Wrench

__all__ = ["Writer"]

FARTHEST = 20.0  # m from the phantom's origin; beyond it somebody wrote millimetres
EARLIEST = 1e8  # s since 1970: before March 1973 it is a time since the recording's start, not a date
LATEST_NS = 2**31 * 10**9  # a ROS stamp counts seconds since 1970 in a signed number of 32 bits
LARGEST_FORCE = 1e4  # N
LARGEST_ID = 2**32 - 1  # that the field id (uint32) holds
SIDES = {
    "left": (t.LEFT_IMAGE, t.LEFT_CAMERA_INFO, t.FRAME_LEFT),
    "right": (t.RIGHT_IMAGE, t.RIGHT_CAMERA_INFO, t.FRAME_RIGHT),
}


class Writer:
    """Write points, probe poses, forces and pictures to a recording (a context manager).

    Parameters
    ----------
    path : Path or str
        ``x.mcap``, or any other name for a rosbag2 folder. It must not exist.
    begins : datetime or str, optional
        When your clock read zero, as ``"2026-03-01 10:30"`` (UTC unless it names a zone). Without it ``seconds`` are
        since 1970, as ``time.time()`` and ROS count.
    T_phantom_tracker : (4, 4), optional
        Takes points, poses and forces from your tracker's frame to the phantom's, in which the surface file is. Without
        it they are in the phantom's frame already.

    Examples
    --------
    >>> with Writer("press.mcap", begins="2026-03-01 10:30") as recording:
    ...     for second, markers, position in my_data:
    ...         recording.points(second, ids=[1, 2, 3], points=markers, sigma=0.0002)
    ...         recording.pose(second, position)
    """

    def __init__(
        self, path: Path | str, *, begins: datetime | str | None = None, T_phantom_tracker: ArrayLike | None = None
    ) -> None:
        self._start_ns = _stamp_of(begins) if begins is not None else None
        self._T = _rigid(T_phantom_tracker) if T_phantom_tracker is not None else np.eye(4)
        self._bag = BagWriter(path, {"livedeform": livedeform.__version__, "writer": "livedeform.recording"})
        self._writer = RecordingWriter(self._bag)
        self._closed = False

    def points(
        self,
        seconds: float,
        ids: Sequence[int] | NDArray[np.integer],
        points: ArrayLike,
        *,
        sigma: float | ArrayLike | None = None,
        covariances: ArrayLike | None = None,
    ) -> None:
        """Write the markers that were seen at one moment.

        ``ids`` (n,) as in markers.csv; ``points`` (n, 3) m, a row of NaN for a marker that was not seen, or none at all
        where no marker was; ``sigma`` m, one number or (n,), the standard deviation of one coordinate, or
        ``covariances`` (n, 3, 3) m2, NaN where they are not known. Without either, a diagnosis takes the noise from the
        recording itself where it can. ``InputError`` for what cannot be meant.
        """
        where = self._open("Writer.points")
        places = _numbers(points, where)
        places = np.zeros((0, 3)) if places.shape == (0,) else _shaped(places, (-1, 3), where)
        numbers = _ids(ids, len(places), where)
        seen = np.asarray(np.isfinite(places).all(axis=1))
        _near(places[seen], where)
        spread = _covariances(seen, sigma, covariances)
        R = self._T[:3, :3]
        frame = MarkerFrame(
            self._stamp(seconds, where),
            numbers[seen],
            apply(self._T, places[seen]),
            R @ spread[seen] @ R.T,
            np.full(int(seen.sum()), np.nan),
        )
        self._writer.marker_frame(frame)

    def pose(self, seconds: float, position: ArrayLike, orientation_xyzw: ArrayLike = (1.0, 0.0, 0.0, 0.0)) -> None:
        """Write the probe's pose T_phantom_probe: ``position`` (3,) m of the middle of its contact face.

        ``orientation_xyzw`` (4,) is a unit quaternion. The default turns the probe about x by 180 degrees, so that +z,
        out of the contact face, points down.
        """
        where = self._open("Writer.pose")
        place, turn = _shaped(position, (3,), where), _shaped(orientation_xyzw, (4,), where)
        _near(place[None], where)
        if abs(float(np.linalg.norm(turn)) - 1.0) > 1e-3:
            raise InputError("the quaternion's norm is not 1", where=where, remedy="order x, y, z, w")
        T = self._T @ transform(Rotation.from_quat(turn).as_matrix(), place)
        both = Rotation.from_matrix(T[:3, :3]).as_quat()
        self._writer.pose(unit_pose(self._stamp(seconds, where), T[:3, 3].tolist(), both.tolist()))

    def force(self, seconds: float, force: ArrayLike, torque: ArrayLike = (0.0, 0.0, 0.0)) -> None:
        """Write the force (3,) N of the probe on the phantom and its torque (3,) N m about the frame's origin."""
        where = self._open("Writer.force")
        F, M = _shaped(force, (3,), where), _shaped(torque, (3,), where)
        if np.linalg.norm(F) > LARGEST_FORCE:
            raise InputError(f"{np.linalg.norm(F):g} N is not plausible", where=where, remedy="give it in newtons")
        R, p = self._T[:3, :3], self._T[:3, 3]
        self._writer.wrench(Wrench(self._stamp(seconds, where), R @ F, R @ M + np.cross(p, R @ F)))

    def picture(
        self, side: Literal["left", "right"], seconds: float, pixels: NDArray[np.uint8], encoding: str = "mono8"
    ) -> None:
        """Write one picture, losslessly compressed: ``pixels`` (h, w), or (h, w, 3) with ``encoding`` rgb8 or bgr8.

        Both cameras' pictures of one moment have the same ``seconds``.
        """
        where = self._open("Writer.picture")
        topic, _, frame = _side(side, where)
        try:
            pixels = np.asarray(pixels)
        except ValueError as error:
            raise InputError("pixels are no array", where=where, remedy="give uint8 (h, w)") from error
        if pixels.dtype != np.uint8 or pixels.ndim != (2 if encoding == "mono8" else 3):
            what = f"pixels are {pixels.dtype} {pixels.shape} and the encoding is {encoding}"
            raise InputError(what, where=where, remedy="give uint8 (h, w), or (h, w, 3) with encoding='rgb8' or 'bgr8'")
        self._writer.compressed_image(Image(self._stamp(seconds, where), pixels, encoding, frame), topic)

    def camera(self, side: Literal["left", "right"], seconds: float, calibration: CameraCalibration | Path) -> None:
        """Write one camera's calibration (or that of a ROS camera_calibration file), once before its pictures."""
        from livedeform.stereo_node.camera.calibration_file import read_camera

        where = self._open("Writer.camera")
        _, topic, frame = _side(side, where)
        if not isinstance(calibration, CameraCalibration | Path | str):
            what = f"the calibration is a {type(calibration).__name__}"
            raise InputError(what, where=where, remedy="give the path of a camera_calibration file")
        known = calibration if isinstance(calibration, CameraCalibration) else read_camera(Path(calibration))
        self._writer.camera_info(known, self._stamp(seconds, where), topic, frame)

    def close(self) -> None:
        """End the file; ``with`` does it by itself. Whatever is written after that is refused."""
        self._closed = True
        self._bag.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _open(self, where: str) -> str:
        if self._closed:
            remedy = "write before close(), or within the 'with'"
            raise InputError("the recording is closed: nothing more is written to it", where=where, remedy=remedy)
        return where

    def _stamp(self, seconds: float, where: str) -> int:
        if np.ndim(seconds) or not isinstance(seconds, int | float | np.number | np.ndarray):
            raise InputError(f"the time is {seconds!r}, no number", where=where, remedy="give seconds")
        if not np.isfinite(seconds):
            raise InputError(f"the time is {seconds}", where=where, remedy="give seconds")
        if self._start_ns is None and seconds < EARLIEST:
            remedy = "say when your clock read zero: Writer(path, begins='2026-03-01 10:30')"
            raise InputError(f"{seconds:g} s since 1970 is no time of a recording", where=where, remedy=remedy)
        stamp_ns = (self._start_ns or 0) + round(float(seconds) * 1e9)
        if not 0 <= stamp_ns < LATEST_NS:
            what = (
                f"{seconds:g} s {'after begins' if self._start_ns is not None else 'since 1970'} is no time of a stamp"
            )
            remedy = "give seconds (not milliseconds or nanoseconds); a stamp is from 1970 to 2038"
            raise InputError(what, where=where, remedy=remedy)
        return stamp_ns


def _stamp_of(begins: datetime | str) -> int:
    """Nanoseconds since 1970 of a date; one without a zone is in UTC."""
    try:
        date = datetime.fromisoformat(begins) if isinstance(begins, str) else begins
    except ValueError as error:
        raise InputError(f"'{begins}' is no date", where="begins", remedy="write 2026-03-01 10:30:00") from error
    if not isinstance(date, datetime):
        remedy = "write '2026-03-01 10:30:00'; leave it out where seconds are since 1970"
        raise InputError(f"{begins!r} is no date", where="begins", remedy=remedy)
    date = date if date.tzinfo is not None else date.replace(tzinfo=UTC)
    since = date - datetime(1970, 1, 1, tzinfo=UTC)
    return (since.days * 86_400 + since.seconds) * 1_000_000_000 + since.microseconds * 1000


def _rigid(value: ArrayLike) -> Array:
    T = _shaped(value, (4, 4), "T_phantom_tracker")
    R = T[:3, :3]
    if not (np.allclose(R @ R.T, np.eye(3), atol=1e-6) and np.linalg.det(R) > 0 and np.allclose(T[3], (0, 0, 0, 1))):
        raise InputError("is no rotation with a translation", where="T_phantom_tracker", remedy="metres, no scaling")
    _near(T[:3, 3], "T_phantom_tracker")
    return T


def _numbers(value: ArrayLike, where: str) -> Array:
    try:
        return np.asarray(value, float)
    except (TypeError, ValueError) as error:
        what = "no array of numbers: a text or nothing is among them, or rows are of different lengths"
        raise InputError(what, where=where, remedy="give numbers, NaN for what is not known") from error


def _ids(ids: Sequence[int] | NDArray[np.integer], n: int, where: str) -> NDArray[np.uint32]:
    """Return the ids (n,) of as many points."""
    try:
        numbers = np.asarray(ids)
    except ValueError:
        numbers = np.zeros((0, 0))
    if numbers.shape == (0,):
        numbers = numbers.astype(np.int64)
    if numbers.shape != (n,) or not (np.issubdtype(numbers.dtype, np.integer) or numbers.dtype == object):
        raise InputError(f"{n} points need as many ids, whole numbers >= 0", where=where)
    if not all(isinstance(each, int) and 0 <= each <= LARGEST_ID for each in numbers.tolist()):
        raise InputError(f"ids are whole numbers from 0 to {LARGEST_ID}", where=where, remedy="number the markers anew")
    if len(np.unique(numbers)) < len(numbers):
        raise InputError("an id is there twice", where=where, remedy="give every marker its own id")
    return numbers.astype(np.uint32)


def _shaped(value: ArrayLike, shape: tuple[int, ...], where: str) -> Array:
    array = _numbers(value, where)
    if array.ndim != len(shape) or any(n not in (-1, m) for n, m in zip(shape, array.shape, strict=True)):
        wanted = " x ".join("n" if n == -1 else str(n) for n in shape)
        raise InputError(f"an array of shape {array.shape}, not {wanted}", where=where, remedy="reshape it")
    if shape[0] != -1 and not np.isfinite(array).all():
        raise InputError("a number is not finite", where=where, remedy="leave this moment out")
    return array


def _near(points: Array, where: str) -> None:
    far = float(np.abs(points).max(initial=0.0))
    if far > FARTHEST:
        raise InputError(f"a coordinate of {far:g} m is not plausible", where=where, remedy="give metres")


def _covariances(seen: NDArray[np.bool_], sigma: float | ArrayLike | None, covariances: ArrayLike | None) -> Array:
    """Return the covariances (n, 3, 3) m2 of markers, of which some were ``seen`` (n,); NaN where not known."""
    where, n = "Writer.points", len(seen)
    if covariances is not None and n:
        given = _shaped(covariances, (-1, 3, 3), where)
        if len(given) != n:
            raise InputError(f"{n} points need as many covariances, not {len(given)}", where=where)
        if layouts.wrong_covariances(given[seen]).any():
            what = "a covariance is zero, negative, infinite or incomplete"
            raise InputError(what, where=where, remedy="give it in m2, or NaN where it is not known")
        return given
    if sigma is None:
        return np.full((n, 3, 3), np.nan)
    each = _numbers(sigma, where)
    if each.shape not in ((), (n,)):
        remedy = "give one number or one for each point"
        raise InputError(f"{n} points, and sigma is an array of shape {each.shape}", where=where, remedy=remedy)
    each = np.broadcast_to(each, (n,))
    if not ((each > 0) & (each < np.inf) | np.isnan(each)).all():
        remedy = "give it in metres, NaN where it is not known, or leave it out"
        raise InputError("sigma is not positive", where=where, remedy=remedy)
    return np.asarray(each[:, None, None] ** 2 * np.eye(3))


def _side(side: str, where: str) -> tuple[str, str, str]:
    if side not in SIDES:
        raise InputError(f"there is no camera '{side}'", where=where, remedy="write 'left' or 'right'")
    return SIDES[side]
