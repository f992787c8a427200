"""Points that other trackers and DIC tools measured, of any format, as takes: ``livedeform import points``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import livedeform
from livedeform.common.checks.presses import shows_the_body
from livedeform.common.errors import InputError, LivedeformError, RecordingError
from livedeform.common.experiment.schema import Markers
from livedeform.common.experiment.yaml_file import files_of, load_experiment
from livedeform.common.types import Array, Ids
from livedeform.importing.c3d import HIGHEST_RATE, MotionCapture, read_c3d, without_zeros, write_take
from livedeform.importing.cells import UNITS
from livedeform.importing.imports import NOISE, numbered, registered, sigma_said, warnings_of
from livedeform.importing.tables import RATE_AGREES, TIME_UNITS, PointTable, read_dic, read_table
from livedeform.importing.trc import read_npy, read_trc
from livedeform.outputs import prepared

PLAUSIBLE = (0.005, 5.0)  # m: the extent of a body's points
REST_BEFORE = 0.3  # s
FIRST = 0.5  # s of what is kept, at rest if nothing else is said
MOVES = 6.0  # times the noise at rest
RATES = (0.5, 1e4)  # Hz: a tracker's; times that make another are in another unit, if nothing confirms them
LATEST = 4e9  # s since 1970, the year 2096: no time of a file


@dataclass(frozen=True)
class Understanding:
    """Say how to read files: ``unit`` and ``rate_hz`` where they do not say it, ``crop`` and ``release`` in s from the
    file's first frame (release: a number, "auto", or empty), every ``thin``-th point, and whether the files are moments
    of one take."""

    unit: str = ""
    rate_hz: float = 0.0
    crop: tuple[float, float] | None = None
    release: str = ""
    thin: int = 1
    dic: bool = False


def read_take(files: Sequence[Path], how: Understanding) -> tuple[MotionCapture, str]:
    """Return a take in metres, and in words what was understood."""
    path, suffix = files[0], files[0].suffix.lower()
    if suffix == ".c3d":
        take, layout, unit = read_c3d(path), "C3D", "as stated"
        _refuse_another(path, take.rate_hz, how.rate_hz, "leave out --rate: the file says it")
    else:
        table = _table(files, how)
        unit = how.unit or table.unit
        take, layout = _in_metres(files, table, unit, how.rate_hz), table.layout
        if table.unit and unit != table.unit:
            unit += f" (as --units says; the file says {table.unit})"
    if how.thin > 1:
        take = take.taken(np.arange(len(take.points)), np.arange(0, len(take.labels), how.thin))
    if how.crop is not None:
        frames = take.frames_between(*how.crop)
        if not len(frames):
            raise InputError("no frame lies in the time that is kept", where="--crop", remedy="give other seconds")
        take = replace(take.taken(frames), since=float(take.seconds[frames[0]]))
    return take, _said(take, layout, unit)


def _table(files: Sequence[Path], how: Understanding) -> PointTable:
    suffix = files[0].suffix.lower()
    if how.dic:
        return read_dic(files)
    if suffix == ".trc":
        return read_trc(files[0])
    if suffix == ".npy":
        return read_npy(files[0])
    if suffix in (".csv", ".txt", ".tsv"):
        return read_table(files[0])
    raise RecordingError(
        f"'{suffix}' files are not known", where=str(files[0]), remedy="give c3d, trc, csv, txt, tsv or npy"
    )


def _in_metres(files: Sequence[Path], table: PointTable, unit: str, rate_hz: float) -> MotionCapture:
    path = files[0]
    points, notes = without_zeros(table.labels, table.points)
    seen = points[np.isfinite(points).all(axis=2)]
    if not len(seen):
        raise RecordingError("holds no points", where=str(path), remedy="export the take with its 3-D points")
    scale = scale_of(path, seen, unit)
    if table.clock:
        raise RecordingError(
            f"has a column '{table.clock}' that rises as a time does, and is not called so", where=str(path),
            remedy="call it time [s] (or ms, us, ns), or delete it",
        )  # fmt: skip
    times = _times(path, table, rate_hz)
    if times is not None and len(times) > 1:
        rate_hz = _own_rate(path, table, times, rate_hz)
    if not 0 < rate_hz < HIGHEST_RATE:
        raise InputError("does not say when its frames were measured", where=str(path), remedy="say --rate HZ")
    points = points * scale
    points[~np.isfinite(points).all(axis=2)] = np.nan
    return MotionCapture(path, table.labels, points, np.full(points.shape[:2], np.nan), rate_hz, times, notes)


def _times(path: Path, table: PointTable, rate_hz: float) -> Array | None:
    """Return the times (frames,) s that a table states, or that the numbers of its frames have at ``rate_hz``: rows
    may be missing; None where it states neither. Raises ``RecordingError`` where they do not rise."""
    times = table.times
    if times is None and table.frames is not None and rate_hz > 0:
        times = table.frames / rate_hz
    if times is None:
        return None
    if not np.isfinite(times).all():
        n = int((~np.isfinite(times)).sum())
        raise RecordingError(f"{n} rows have no time", where=str(path), remedy="give every row its time, or delete it")
    back = np.flatnonzero(np.diff(times) <= 0)
    if len(back):
        raise RecordingError(
            f"its times do not rise: {times[back[0] + 1]:g} s follows {times[back[0]]:g} s ({len(back)} such places)",
            where=str(path), remedy="sort the rows, and give each its own time",
        )  # fmt: skip
    return times


def _own_rate(path: Path, table: PointTable, times: Array, rate_hz: float) -> float:
    """Return the rate Hz of ``times`` (frames,) s; ``InputError`` where it contradicts ``rate_hz`` (0: not said), or is
    none of a tracker and no unit confirms it."""
    own = 1.0 / float(np.median(np.diff(times)))
    if table.times is None:
        return own  # by the numbers of the frames
    meant = rate_hz if rate_hz > 0 else None
    others = {u: own / s for u, s in TIME_UNITS.items() if s < 1.0 and not table.timed}
    fits = [u for u, hz in others.items() if (_agree(hz, meant) if meant else RATES[0] <= hz <= RATES[1])]
    unit = f"write their unit into the header, as time [{fits[0] if fits else 'ms'}]"
    _refuse_another(path, own, rate_hz, unit if fits else "leave out --rate, or correct the times")
    if meant is None and not table.timed and (not RATES[0] <= own <= RATES[1] or times[-1] > LATEST):
        raise InputError(
            f"its times, taken as seconds, make {own:.4g} Hz and end at {times[-1]:.4g} s", where=str(path),
            remedy=f"{unit} (or [s]), or confirm with --rate HZ",
        )  # fmt: skip
    return own


def _agree(a: float, b: float) -> bool:
    return abs(a / b - 1.0) < RATE_AGREES


def _refuse_another(path: Path, own: float, rate_hz: float, remedy: str) -> None:
    """Raise ``InputError`` where a rate is said (not 0) that is not the file's ``own``."""
    if rate_hz > 0 and not _agree(own, rate_hz):
        raise InputError(f"its own times make {own:.4g} Hz, --rate says {rate_hz:g}", where=str(path), remedy=remedy)


def scale_of(path: Path, seen: Array, unit: str) -> float:
    """Return a unit in metres; ``InputError`` with what would fit points (n, 3) where it is not known."""
    if unit not in UNITS:
        extent = float(np.ptp(seen, axis=0).max())
        fits = [u for u in ("m", "cm", "mm") if PLAUSIBLE[0] <= extent * UNITS[u] <= PLAUSIBLE[1]]
        hint = ", or ".join(f"--units {u} ({extent * UNITS[u]:.3g} m from end to end)" for u in fits) or "--units mm"
        what = f"the unit '{unit}' is not known" if unit else "does not say its unit"
        raise InputError(what, where=str(path), remedy=f"say it: {hint}")
    return UNITS[unit]


def _said(take: MotionCapture, layout: str, unit: str) -> str:
    seen = np.isfinite(take.points).all(axis=2)
    places = take.points[seen]
    size = " x ".join(f"{1e3 * d:.1f}" for d in np.ptp(places, axis=0))
    shown = ", ".join(take.labels[:6]) + (f" and {len(take.labels) - 6} more" if len(take.labels) > 6 else "")
    return (
        f"{layout}, unit {unit}, {len(take.points)} frames in {take.seconds[-1]:.3f} s ({take.rate_hz:.4g} Hz), "
        f"{len(take.labels)} points ({shown}) seen {seen.mean():.1%} of the time, within {size} mm"
    )


def release_frame(take: MotionCapture, rest_s: float = REST_BEFORE) -> int:
    """Return the first frame from which points stay beyond ``MOVES`` times the noise of the first ``rest_s`` seconds
    that were kept.

    ``InputError`` where nothing moves, or there is no rest before.
    """
    rest = take.points[take.frames_between(take.since, take.since + rest_s)]
    if len(rest) < 5:
        raise InputError("too few frames before to tell rest", where="--release", remedy="say --release SECONDS")
    noise = np.nanstd(rest, axis=0)
    away = np.abs(take.points - np.nanmedian(rest, axis=0)) > MOVES * np.fmax(noise, 1e-6)
    seen = np.isfinite(take.points).all(axis=2).sum(axis=1)
    moving = away.any(axis=2).sum(axis=1) > 0.3 * seen  # of the points that are seen
    # by points that are lost nobody knows whether the body moves
    still = np.flatnonzero(~moving & shows_the_body(seen))
    first = int(still[-1]) + 1 if len(still) and still[-1] + 1 < len(moving) else len(moving)
    first = int(np.argmax(moving)) if moving.any() and first == len(moving) else first
    if not moving.any() or first < len(rest):
        raise InputError("nothing tells rest from movement", where="--release", remedy="say --release SECONDS")
    return first


def import_points(
    files: Sequence[Path], out: Path, how: Understanding, *, experiment: Path | None = None,
    ids: Mapping[str, int] | None = None, rest: tuple[float, float] | None = None, noise: str = "still",
    preview: bool = False, force: bool = False,
) -> list[str]:  # fmt: skip
    """Write ``out/<take>.mcap`` for every take (with ``preview`` nothing); gives lines about each, and about those that
    were left out. ``rest``: s from the file's first frame, the first half second that is kept if None. Raises the first
    error where none can be used."""
    if noise not in NOISE:
        raise InputError(f"unknown '{noise}'", where="--noise", remedy=f"known are {', '.join(NOISE)}")
    known = load_experiment(experiment) if experiment is not None else None
    takes = [list(files)] if how.dic else [[f] for f in files]
    lines, read, errors = [], [], []
    for parts in takes:
        try:
            take, said = read_take(parts, how)
        except LivedeformError as error:
            errors.append(error)
            lines.append(f"left out: {error}")
            continue
        read.append(take)
        lines.append(f"{parts[0].name}{f' and {len(parts) - 1} more' if len(parts) > 1 else ''}: {said}")
        lines += warnings_of(take)
    if not read:
        raise errors[0]
    numbers, differing = numbered(read, ids or {})
    lines += differing
    if preview:
        return [*lines, "nothing was written: this is a preview"]
    names = [f"{take.path.stem}.mcap" for take in read]
    twice = [n for n in names if names.count(n) > 1]
    if twice:
        raise InputError(f"two takes would be {twice[0]}", where=str(out), remedy="import them into different folders")
    inputs = [*files, *(files_of(known) if known is not None else [])]
    with prepared(out, names, force=force, inputs=inputs, alone=False) as draft:
        markers = known.markers if known else None
        for take, marker_ids in zip(read, numbers, strict=True):
            lines.append(_write(take, draft, out, markers, marker_ids, rest, noise, how.release))
    return lines


def _write(
    take: MotionCapture, draft: Path, out: Path, markers: Markers | None, marker_ids: Ids,
    rest: tuple[float, float] | None, noise: str, release: str,
) -> str:  # fmt: skip
    name = f"{take.path.stem}.mcap"
    T, fit = registered(take, marker_ids, markers, rest or (take.since, take.since + FIRST))
    covariance: Array = NOISE[noise](take)
    metadata = {"source": take.path.name, "livedeform": livedeform.__version__, "noise": noise, "registration": fit}
    metadata["markers"] = ", ".join(f"{i} {label}" for i, label in zip(marker_ids, take.labels, strict=True))
    told = ""
    if release:
        at = float(take.seconds[release_frame(take)]) if release == "auto" else _seconds(release, take)
        metadata["release_s"] = f"{at:.4f}"
        of_file = f" ({at + take.since:.3f} s after the file's start)" if take.since else ""
        told = f"; released at {at:.3f} s{of_file}: write timeline: {{release: {at:.3f}}} into the experiment"
    n = write_take(take, draft / name, ids=marker_ids, T_phantom_tracker=T, covariance=covariance, metadata=metadata)
    return f"{out / name}: {n} frames, {len(take.labels)} markers, noise {sigma_said(covariance)}, {fit}{told}"


def _seconds(text: str, take: MotionCapture) -> float:
    """Return the seconds from the first frame that is kept, of ``text`` s from the file's first one."""
    try:
        at = float(text)
    except ValueError as error:
        raise InputError(f"'{text}' is neither seconds nor 'auto'", where="--release", remedy="write 1.2") from error
    if not take.since <= at <= take.since + take.seconds[-1]:
        kept = f"{take.since:.3f} to {take.since + take.seconds[-1]:.3f} s that are kept"
        raise InputError(f"{at:g} s is not within the {kept}", where="--release", remedy="count from the file's start")
    return at - take.since
