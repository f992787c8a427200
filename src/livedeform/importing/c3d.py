"""Motion capture in C3D files as recordings of ``/stereo/markers``. The only module that imports ezc3d."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import BrokenExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from livedeform.common.bags.recording_writer import RecordingWriter
from livedeform.common.bags.types import one_line
from livedeform.common.bags.write import BagWriter
from livedeform.common.errors import InputError, RecordingError
from livedeform.common.frames import apply, fit_rigid, inverse, make_a_frame
from livedeform.common.processes import worker_pool
from livedeform.common.types import Array, Ids, MarkerFrame

METRES_PER_UNIT = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "dm": 1e-1, "in": 0.0254}
START_NS = 1_000_000_000  # a C3D file knows no date, and a stamp of zero means "unset" in ROS
STILL_SECONDS = 0.2
PARSE_SECONDS = 60.0
MEMORY = 1 << 30  # bytes, besides twenty times the file
HIGHEST_RATE = 1e6  # Hz
OTHER_PLACES = 0.25  # of the markers' spread (rms): a misfit beyond that is of other markers, or of another unit
MIRRORED = 0.5  # of the misfit: a mirror image that fits better than that is what the take shows
DIGITS = sorted((c * u * 10.0**-k for k in range(2, 6) for c in (1.0, 0.5, 0.2) for u in (1.0, 0.254)), reverse=True)
"""m: what the last digit of an export may stand for, the coarsest first; 0.254: of inches."""
MANY = 20_000  # values tell it
ON_DIGITS = 0.02  # of the last digit: places that are written by it are no farther from a multiple, save for float32
SMALLEST_SIGMA = 1e-6  # m: float32 coordinates near 1 m resolve 0.1 um; no tracker is better than this
CODES = [sign * float("9" * n) for n in range(3, 8) for sign in (-1, 1)]
"""As which tables write what was not measured, in their own unit: -999, -9999 .."""
HELD = 3  # steps of exactly nothing, one after the other, that are no chance beside markers that change
CHANGING = 0.5  # of the coordinates beside: fewer change where a tracker's resolution is coarser than its noise
SHOWN = 6  # names in a line


@dataclass(frozen=True)
class MotionCapture:
    """A take: ``points`` (frames, markers, 3) m in the tracker's frame, NaN where a marker was not seen; ``rate_hz``;
    ``residuals`` (frames, markers) m, the tracker's own statement, NaN where there is none; ``times`` (frames,) s if
    the frames are stamped one by one; ``notes`` on what its reader took as something else than it says; ``since`` s:
    of the file's first frame the first one here is so much later."""

    path: Path
    labels: tuple[str, ...]
    points: Array
    residuals: Array
    rate_hz: float
    times: Array | None = None
    notes: tuple[str, ...] = ()
    since: float = 0.0

    @property
    def seconds(self) -> Array:
        """Time of each frame (frames,) s, from the first: ``times`` where the file states them, else by the rate."""
        return np.arange(len(self.points)) / self.rate_hz if self.times is None else self.times - self.times[0]

    def frames_between(self, start: float, end: float) -> NDArray[np.int64]:
        """Indices of the frames with start <= time < end, s from the file's first frame."""
        at = self.seconds + self.since
        return np.flatnonzero((at >= start - 1e-9) & (at < end - 1e-9))

    def cropped(self, first: int) -> MotionCapture:
        """The take from frame ``first`` on."""
        return self.taken(np.arange(first, len(self.points)))

    def taken(self, frames: NDArray[np.int64], markers: NDArray[np.int64] | None = None) -> MotionCapture:
        """The take's ``frames`` alone, and of its markers these (all if None); times are from the first of them."""
        which = np.arange(len(self.labels)) if markers is None else markers
        return MotionCapture(
            self.path, tuple(self.labels[int(k)] for k in which), self.points[np.ix_(frames, which)],
            self.residuals[np.ix_(frames, which)], self.rate_hz, None if self.times is None else self.times[frames],
            self.notes,
        )  # fmt: skip


def read_c3d(path: Path) -> MotionCapture:
    """The points of a C3D file in metres.

    The parser is not safe against damaged files (ezc3d 1.5 ends the process on some), so it runs in one of its own.
    """
    if not path.is_file():
        raise RecordingError("the file does not exist", where=str(path), remedy="name a .c3d file")
    try:
        with worker_pool(1, _limit_memory, MEMORY + 20 * path.stat().st_size) as pool:
            content = pool.submit(_parse, str(path)).result(PARSE_SECONDS)
    except Exception as error:  # ezc3d raises plain RuntimeError, ValueError or OSError from C++, or ends its process
        what = "it ends or blocks the parser" if isinstance(error, BrokenExecutor | TimeoutError) else one_line(error)
        raise RecordingError(
            f"cannot be read as C3D ({what})", where=str(path), remedy="export the take as C3D again"
        ) from error
    if content.unit not in METRES_PER_UNIT:
        raise RecordingError(
            f"POINT:UNITS is '{content.unit}'", where=str(path), remedy=f"known are {', '.join(METRES_PER_UNIT)}"
        )
    points = METRES_PER_UNIT[content.unit] * content.points[:3].transpose(2, 1, 0)
    residuals = METRES_PER_UNIT[content.unit] * content.residuals[0].T
    if points.size == 0 or not np.isfinite(points).any():
        raise RecordingError("holds no points", where=str(path), remedy="export the take with its 3-D points")
    if not 0 < content.rate_hz < HIGHEST_RATE or len(content.labels) < points.shape[1]:
        what = f"its rate is {content.rate_hz:g} Hz, with {len(content.labels)} labels of {points.shape[1]} points"
        raise RecordingError(what, where=str(path), remedy="export the take as C3D again")
    labels = content.labels[: points.shape[1]]
    unseen = ~np.isfinite(points).all(axis=2) | (residuals < 0)
    points[unseen], residuals[unseen] = np.nan, np.nan
    residuals[residuals == 0] = np.nan  # 0: made by a program, as gap filling
    points, notes = without_zeros(labels, points)
    return MotionCapture(path, labels, points, residuals, content.rate_hz, None, notes)


def without_zeros(labels: Sequence[str], points: Array) -> tuple[Array, tuple[str, ...]]:
    """Return points (frames, markers, 3) with NaN where one is exactly 0, 0, 0, or three times -9999 or the like, as
    many programs write a marker that they did not see, and a note on how many these are of each (none: no note)."""
    same, notes = (points == points[:, :, :1]).all(axis=2), []
    for code in (0.0, *CODES):
        unseen = same & (points[:, :, 0] == code)
        if unseen.any():
            said = ", ".join([f"{code:.0f}"] * 3)
            notes.append(f"exactly {said} is taken as not measured ({_counted(labels, unseen.sum(axis=0))})")
            points = np.where(unseen[:, :, None], np.nan, points)
    return points, tuple(notes)


def held_note(take: MotionCapture) -> tuple[str, ...]:
    """Return a note on the markers whose places are `held` (none: no note)."""
    steps = held(take).sum(axis=0)
    if not steps.any():
        return ()
    said = _counted(take.labels, steps)
    return (f"places are exactly those of the frame before while others change, and make no noise ({said}); were these "
            "markers lost, leave their cells empty",)  # fmt: skip


def _counted(labels: Sequence[str], frames: NDArray[np.int64]) -> str:
    which = np.flatnonzero(frames)
    more = f" and {len(which) - SHOWN} more markers" if len(which) > SHOWN else ""
    return ", ".join(f"{labels[k]} in {frames[k]} frames" for k in which[:SHOWN]) + more


class _Content(NamedTuple):
    """The part of a file that is read: ``points`` (4, markers, frames) in ``unit``, ``residuals`` (1, ...)."""

    unit: str
    labels: tuple[str, ...]
    rate_hz: float
    points: Array
    residuals: Array


def _parse(path: str) -> _Content:
    import ezc3d

    content = ezc3d.c3d(path)
    parameters, data = content["parameters"]["POINT"], content["data"]
    return _Content(
        (parameters.get("UNITS", {}).get("value") or ["mm"])[0].strip().lower(),
        tuple(label.strip() for label in parameters["LABELS"]["value"]),
        float(parameters["RATE"]["value"][0]),
        np.asarray(data["points"], float),
        np.asarray(data["meta_points"]["residuals"], float),
    )


def _limit_memory(more: int) -> None:
    """Let this process take so many bytes more than it has; only where /proc tells how many these are."""
    import resource

    size = Path("/proc/self/statm")
    if size.is_file():
        limit = int(size.read_text().split()[0]) * resource.getpagesize() + more
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


def rest_positions(take: MotionCapture, frames: NDArray[np.int64]) -> Array:
    """Median place (markers, 3) m over ``frames``; NaN for a marker that is never seen there."""
    if len(frames) == 0:
        kept = f" (kept is what begins {take.since:g} s after the file's start)" if take.since else ""
        raise InputError(f"no frame lies in the time of rest{kept}", where=str(take.path), remedy="give another --rest")
    seen = np.isfinite(take.points[frames]).all(axis=2).any(axis=0)
    rest = np.full((len(take.labels), 3), np.nan)
    rest[seen] = np.nanmedian(take.points[np.ix_(frames, np.flatnonzero(seen))], axis=0)
    return rest


def held(take: MotionCapture) -> NDArray[np.bool_]:
    """Tell for each step (frames - 1, markers) whether a marker is exactly where it was in the frame before, for
    ``HELD`` steps or more in which the other markers' coordinates change: its last place was written on."""
    here, before = take.points[1:], take.points[:-1]
    same = (here == before).all(axis=2)
    seen = np.isfinite(here).all(axis=2) & np.isfinite(before).all(axis=2) & ~same
    changed = ((here != before) & seen[:, :, None]).sum(axis=(1, 2))
    beside = 3 * seen.sum(axis=1)  # of those that are not held themselves
    same &= (changed > CHANGING * beside)[:, None]
    if len(same) < HELD:
        return np.zeros_like(same)
    whole = np.lib.stride_tricks.sliding_window_view(same, HELD, axis=0).all(axis=2)
    out: NDArray[np.bool_] = np.any([np.pad(whole, ((k, HELD - 1 - k), (0, 0))) for k in range(HELD)], axis=0)
    return out


def still_covariance(take: MotionCapture) -> Array:
    """Covariance (markers, 3, 3) m2 of each marker's noise, from its stillest ``STILL_SECONDS``, and of the rounding to
    the take's last digit; NaN where it was not seen for so long. Places that are `held` do not count.

    White noise of covariance S gives differences between frames of covariance 2 S; a drift drops out.
    """
    least = np.diag(SMALLEST_SIGMA**2 + last_digit(take.points) ** 2 / 12.0)
    n = max(round(STILL_SECONDS * take.rate_hz), 5)
    out = np.full((len(take.labels), 3, 3), np.nan)
    written_on = held(take)
    for i in range(len(take.labels)):
        frames = np.flatnonzero(np.isfinite(take.points[:, i]).all(axis=1))
        steps = np.diff(take.points[frames, i], axis=0)[~written_on[frames[1:] - 1, i]]
        if len(steps) < n:
            continue
        windows = np.lib.stride_tricks.sliding_window_view(steps, n, axis=0)  # (windows, 3, n)
        energy = (windows**2).sum(axis=(1, 2))
        # the quietest of many windows is quieter than typical: the lower quartile is a fair still one
        window = windows[int(np.argsort(energy)[len(energy) // 4])]
        out[i] = np.cov(window) / 2.0 + least
    return out


def last_digit(points: Array) -> Array:
    """Return (3,) m: of what each coordinate of points (.., 3) m is a multiple, as an export to few digits makes it,
    and some differ by no more; 0 where it is finer than any of `DIGITS`."""
    out = np.zeros(3)
    for axis in range(3):
        values = points[..., axis][np.isfinite(points[..., axis])]
        if not len(values):
            continue
        apart = np.diff(np.unique(values))
        some = values[:: len(values) // MANY + 1]
        slack = np.finfo(np.float32).eps * np.abs(some)
        for step in DIGITS:
            on = np.abs(some - step * np.round(some / step)) < ON_DIGITS * step + slack
            if on.mean() > 1.0 - ON_DIGITS and (np.abs(apart / step - 1.0) < 2 * ON_DIGITS).any():
                out[axis] = step
                break
    return out


def residual_covariance(take: MotionCapture) -> Array:
    """Isotropic covariance (markers, 3, 3) m2 from the tracker's residuals: their rms per axis."""
    if not np.isfinite(take.residuals).any():
        raise InputError("the take holds no residuals", where=str(take.path), remedy="use --noise still")
    mean_square = np.nanmean(take.residuals**2, axis=0) / 3.0
    covariance: Array = mean_square[:, None, None] * np.eye(3)
    return covariance


def register(reference: Array, rest: Array) -> tuple[Array, Array]:
    """T_phantom_tracker (4, 4) from the markers' places, and the residuals (n, 3) m = T rest - reference.

    ``reference`` and ``rest`` (n, 3) m in the same order; rows with NaN are not used. ``InputError`` where they are
    fewer than three, on a line, not the same places, or their mirror image.
    """
    known = np.asarray(np.isfinite(reference).all(axis=1) & np.isfinite(rest).all(axis=1))
    if known.sum() < 3:
        raise InputError(
            f"only {known.sum()} markers have a place in the experiment and in the take",
            remedy="name at least three with --ids LABEL=ID",
        )
    if not make_a_frame(reference[known]):
        raise InputError(
            "the markers with a place in the experiment lie on a line, and a turn about it cannot be told",
            remedy="give one more marker beside it a place",
        )
    T, misfit = _fitted(reference, rest, known)
    rms, mirrored = (_rms(m[known]) for m in (misfit, _fitted(reference, rest * [1, 1, -1], known)[1]))
    if mirrored < MIRRORED * rms:
        raise InputError(
            f"the take is mirrored: its frame is left-handed (misfit {1e3 * rms:.2f} mm rms, of its mirror image "
            f"{1e3 * mirrored:.2f} mm)",
            remedy="negate one axis of all its points (or check which marker is which: --ids NAME=ID)",
        )
    size = _rms(reference[known] - reference[known].mean(axis=0))
    if rms > OTHER_PLACES * size:
        raise InputError(
            f"{known.sum()} markers do not lie as the experiment's do: misfit {1e3 * rms:.1f} mm rms, spread "
            f"{1e3 * size:.1f} mm",
            remedy="check which is which (--ids NAME=ID), the unit and the time of rest",
        )
    return T, misfit


def _fitted(reference: Array, rest: Array, known: NDArray[np.bool_]) -> tuple[Array, Array]:
    T = inverse(fit_rigid(reference[known], rest[known]))
    return T, apply(T, rest) - reference


def _rms(misfit: Array) -> float:
    return float(np.sqrt((misfit**2).sum(axis=1).mean()))


def write_take(
    take: MotionCapture,
    out: Path,
    *,
    ids: Ids,
    T_phantom_tracker: Array,
    covariance: Array,
    metadata: Mapping[str, str],
) -> int:
    """Writes the take as a bag of ``/stereo/markers``; gives the number of frames with at least one marker."""
    R = T_phantom_tracker[:3, :3]
    turned = R @ covariance @ R.T
    n_written, seconds = 0, take.seconds
    with BagWriter(out, metadata, atomic=True) as bag:
        writer = RecordingWriter(bag)
        for k, points in enumerate(take.points):
            seen = np.isfinite(points).all(axis=1)
            if not seen.any():
                continue
            stamp_ns = START_NS + round(seconds[k] * 1e9)
            placed = apply(T_phantom_tracker, points[seen])
            nothing = np.full(int(seen.sum()), np.nan)
            writer.marker_frame(MarkerFrame(stamp_ns, ids[seen], placed, turned[seen], nothing))
            n_written += 1
    return n_written
