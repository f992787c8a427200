"""Points in tables of text: one row per moment (wide), one per point and moment (long), or one file per moment (DIC).

A column is known by its name: ``time`` or ``frame``; ``x``, ``y``, ``z`` (long), or a marker's name with one of them at
its end (wide: ``tip_x``, ``tip.x [mm]``, ``X1``). What digital image correlation writes (DICe: ``COORDINATE_X`` ..
or ``MODEL_COORDINATES_X`` ..; tables of ``X``, ``Y``, ``Z`` as VIC-3D's, MultiDIC's and DuoDIC's points are exported;
displacements beside places at rest) is one file per moment, whose rows are the same material points in every file.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from livedeform.common.errors import RecordingError
from livedeform.common.types import Array
from livedeform.importing.cells import Cells, read_cells

TIME = ("time", "t", "seconds", "sec", "timestamp", "time_stamp", "elapsed", "elapsed_time", "time_elapsed")
LIKE_TIME = re.compile("time|stamp|elapsed|clock")  # in the name of a column that may be the rows' time
FRAME = ("frame", "frame#", "image", "step")
Rows = NDArray[np.int64]
NAME = ("id", "marker", "name", "label", "point", "subset_id", "pointid", "marker_id")
FAILED = ("sigma", "status_flag")  # DICe: below zero of a subset that was not found, whose displacement is zero
MOVES = [[move.format(a) for a in "xyz"] for move in ("displacement_{}", "disp_{}", "u_{}", "d_{}", "u{}", "d{}")]
PLACES = {  # columns of places: those of displacements that may stand beside; DICe's places are those at rest
    "model_coordinates_{}": [["model_displacement_x", "model_displacement_y", "model_displacement_z"]],
    "coordinate_{}": MOVES[:1], "{}": [*MOVES, ["u", "v", "w"], []], "{}c": [*MOVES, ["u", "v", "w"], []],
}  # fmt: skip
MOVED = 0.5  # of the change of places: what is left without their displacement, if they are those of the moment
OF_DIC = ("model_coordinates", "model_displacement", "coordinate", "displacement")
NO_PLACE = re.compile(  # what three columns may be besides a place, by the last word of their name: probe_force_x
    "(forces?|torques?|moments?|rotation|orientation|quat(ernion)?|vel(ocity)?|acc(el(eration)?)?|disp(lacements?)?|"
    "std(dev)?|sigma|err(or)?s?|strains?|norm(al)?s?)[0-9]*|sd"
)
SIDES = re.compile("left|right|top|bottom|front|back|upper|lower|up|down|inner|outer|near|far|end")  # name markers
LETTERS = "qvun"  # which are no marker's beside words: turns, velocities, displacements, normals
OF_A_ROBOT = "qvunaftmrw"  # as fx beside x: also accelerations, forces, torques, turns
RATE_AGREES = 0.1  # of a rate that is stated: more beside is another rate
OF_DAY = r"(.*)(?<!\d)([01]?\d|2[0-3])[-_:.h ]([0-5]\d)[-_:.m ]([0-5]\d)(\D.*)?"
AFTER_DATE = r"(.*(?<!\d)\d{8}[-_T ]?)([01]\d|2[0-3])([0-5]\d)([0-5]\d)(\D.*)?"
DECIMAL = r"(.*)(?<!\d)(\d+)\.(\d+)(\D.*)?"
NamePart = tuple[str, int, str]
"""What else a name says, minutes or the whole part of a number, and seconds or digits behind its point."""
TIME_UNITS = {"s": 1.0, "sec": 1.0, "seconds": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}


@dataclass(frozen=True)
class PointTable:
    """Hold a file's words: ``points`` (frames, points, 3) in ``unit`` (empty: not stated), NaN where one was not seen,
    ``times`` (frames,) s and numbers of the ``frames`` (frames,), None where it states none; ``layout`` in words.

    ``timed``: whether it says in which unit its times are; ``clock``: where it states neither times nor frames, a
    column that may be its time."""

    labels: tuple[str, ...]
    points: Array
    times: Array | None
    unit: str
    layout: str
    frames: Array | None = None
    timed: bool = False
    clock: str = ""


def read_table(path: Path) -> PointTable:
    """Read a wide or long table; ``RecordingError`` where its columns do not say what they are."""
    cells = read_cells(path)
    if not {"x", "y", "z"} <= set(cells.names):
        return _wide(cells)
    if set(NAME) & set(cells.names):
        return _long(cells)
    robot = all(g.lower() in OF_A_ROBOT and f"{g.lower()}x" in cells.names for g in _places(cells)[0])
    return _long(cells) if robot else _wide(cells)


def in_order(files: Sequence[Path]) -> list[Path]:
    """Sort files of one moment each by the numbers in their names."""
    ordered = sorted(files, key=lambda f: ([int(n) for n in re.findall(r"\d+", f.stem)], f.name))
    decimals = sorted((float(f"{p[1]}.{p[2]}"), k) for k, p in enumerate(_decimal(f.stem) for f in ordered) if p)
    by_value = [ordered[k] for _, k in decimals]
    return by_value if len(by_value) == len(ordered) and _counted([f.stem for f in by_value]) else ordered


def moments_of(ordered: Sequence[Path]) -> tuple[Rows, str]:
    """Return which moments (files,) files of one moment each are, from 0, and what is to be said of it: by the one
    number that differs in their names, or the decimal or time of day, so that a file that is missing leaves its time;
    by their order where there is none of these.

    Raises ``RecordingError`` where the one number does not rise by equal steps with gaps.
    """
    numbers = [[int(n) for n in re.findall(r"\d+", f.stem)] for f in ordered]
    columns = list(zip(*numbers, strict=True)) if len({len(n) for n in numbers}) == 1 else []
    differing = [c for c in columns if len(set(c)) > 1]
    counted = _counted([f.stem for f in ordered])
    if counted is None and len(differing) == 1 and len(set(differing[0])) == len(ordered):
        counted = list(differing[0])
    if counted is None:
        return np.arange(len(ordered)), " (times by the files' order)"
    steps = [b - a for a, b in pairwise(counted)]
    step = math.gcd(*steps)
    if 2 * steps.count(step) < len(steps):
        raise RecordingError(
            f"the numbers in the files' names rise by {min(steps)} to {max(steps)} and do not tell which moments are "
            "missing", where=str(ordered[0].parent), remedy="number the files by moments: 1, 2, 4 where 3 is missing",
        )  # fmt: skip
    moments = np.array([(n - counted[0]) // step for n in counted])
    missing = int(moments[-1]) + 1 - len(moments)
    return moments, f" ({missing} missing by the files' numbers)" if missing else ""


def _time_of_day(stem: str) -> NamePart | None:
    """Read hours, minutes and seconds: 10-00-59, or 100059 after a date."""
    f = re.fullmatch(OF_DAY, stem) or re.fullmatch(AFTER_DATE, stem)
    return (f"{f[1]}:{f[5]}", 60 * int(f[2]) + int(f[3]), f[4]) if f else None


def _decimal(stem: str) -> NamePart | None:
    """Read a number with digits behind a point: 1.25."""
    f = re.fullmatch(DECIMAL, stem)
    return (f"{f[1]}.{f[4]}", int(f[2]), f[3]) if f else None


def _counted(stems: Sequence[str]) -> list[int] | None:
    """Return whole numbers that rise as the times of day (s) or decimals (last digits) in names do; None where there
    are none, something else differs too, or they do not rise by equal steps with gaps."""
    for read, base in ((_time_of_day, 60), (_decimal, 0)):
        parts = [part for part in map(read, stems) if part is not None]
        if len(parts) < len(stems) or len({rest for rest, _, _ in parts}) > 1:
            continue
        upper, lower = [up for _, up, _ in parts], [low for _, _, low in parts]
        n, least = max(map(len, lower)), min(map(len, lower))
        if n > least and (len(set(upper)) == 1 or any(low.endswith("0") and len(low) > least for low in lower)):
            continue  # 1.9, 1.10, 1.11: counted, no decimals
        values = [(base or 10**n) * up + int(low.ljust(n, "0")) for up, low in zip(upper, lower, strict=True)]
        steps = [b - a for a, b in pairwise(values)]
        step = math.gcd(*steps)
        carried = [(gap, low) for gap, low, a, b in zip(steps, lower[1:], upper, upper[1:], strict=False) if a != b]
        # 1.1, 1.2, 2.1, 2.2 are two numbers, the second of which begins anew; 0.5, 1.0, 3.0 are not
        anew = any(low == lower[0] for _, low in carried) and all(gap > step for gap, _ in carried)
        if min(steps, default=0) > 0 and 2 * steps.count(step) >= len(steps) and not anew:
            return values
    return None


class OneMoment(NamedTuple):
    """Hold the ``points`` (n, 3) of one moment as they lie then, NaN where the tool says that it found none; their
    names where there is a column of them, their unit (empty: not stated), and the displacements (n, 3) that were added
    to what is stated, None if none were, with their columns."""

    points: Array
    labels: list[str] | None = None
    unit: str = ""
    moves: Array | None = None
    added: str = ""


def read_moment(path: Path) -> OneMoment:
    """Read one moment; ``RecordingError`` where its columns do not say what they are."""
    cells = read_cells(path, ("x", "y", "z"))
    where = _dic_columns(path, cells.names)
    xyz = cells.numbers(where[:3])
    moves = cells.numbers(where[3:]) if len(where) == 6 else None
    if moves is not None:
        xyz = xyz + moves
    for name in FAILED:
        if name in cells.names:
            xyz[cells.numbers([cells.names.index(name)])[:, 0] < 0] = np.nan
    own = next((k for k, name in enumerate(cells.names) if name in NAME), None)
    labels = [row[own].strip() for row in cells.rows] if own is not None else None
    added = ", ".join(cells.columns[k].shown for k in where[3:])
    return OneMoment(xyz, labels, cells.unit_of(where), moves, added)


def displacements_said(read: Sequence[tuple[Path, OneMoment]]) -> str:
    """Return in words which displacements were added to the places of files of one moment each.

    Raises ``RecordingError`` where the places hold them already: they change from file to file as these say.
    """
    with_moves = [(path, m, m.moves) for path, m in read if m.moves is not None and np.isfinite(m.points).any()]
    if not with_moves:
        return "no displacements added"
    sizes = [float(np.nanmedian(np.linalg.norm(moves, axis=1))) for _, _, moves in with_moves]
    _, least, before = with_moves[int(np.argmin(sizes))]
    path, most, after = with_moves[int(np.argmax(sizes))]
    stated, freed = (_apart(least.points - k * before, most.points - k * after) for k in (1, 2))
    if freed < MOVED * stated:
        raise RecordingError(
            f"its places change from file to file as {most.added} say, and would be moved twice", where=str(path),
            remedy=f"delete the columns {most.added}, or export the places at rest",
        )  # fmt: skip
    return f"displacements {most.added} added"


def _apart(first: Array, other: Array) -> float:
    """Return the median distance between the points (n, 3) of two moments: row by row, or of other numbers of rows
    from the nearest one."""
    if len(first) == len(other):
        distances = np.linalg.norm(other - first, axis=1)
    else:
        tree = cKDTree(first[np.isfinite(first).all(axis=1)])
        distances = tree.query(other[np.isfinite(other).all(axis=1)])[0]
    distances = distances[np.isfinite(distances)]
    return float(np.median(distances)) if len(distances) else float("nan")


def read_dic(files: Sequence[Path]) -> PointTable:
    """Read files of one moment each, which the numbers in their names tell; their rows are the same points."""
    ordered = in_order(files)
    read = [(path, read_moment(path)) for path in ordered]
    frames, ids, unit = [], None, ""
    for path, moment in read:
        xyz, names = moment.points, moment.labels
        labels = names if names is not None else [str(k + 1) for k in range(len(xyz))]
        unit = unit or moment.unit
        if ids is None:
            ids = labels
        elif names is None and len(labels) != len(ids):
            raise RecordingError(
                f"has {len(labels)} rows, {ordered[0].name} has {len(ids)}: row k is not the same point in both",
                where=str(path), remedy="export all points of every moment (lost ones as NaN), or a column 'id'; or "
                "compare surfaces: livedeform import surface",
            )  # fmt: skip
        _refuse_twice(path, labels)
        at = {label: k for k, label in enumerate(labels)}
        frames.append(np.array([xyz[at[i]] if i in at else [np.nan] * 3 for i in ids]))
    if ids is None or len(frames) < 2:
        raise RecordingError("a take has two moments at least", where=str(files[0].parent), remedy="name more files")
    moments, counted = moments_of(ordered)
    layout = f"one file per moment{counted}, {len(ids)} points by row, {displacements_said(read)}"
    return PointTable(tuple(ids), np.array(frames), None, unit, layout, moments.astype(float))


def _dic_columns(path: Path, names: Sequence[str]) -> list[int]:
    """Return the columns of x, y, z, and of the displacements where there are some beside."""
    for place, beside in PLACES.items():
        wanted = [place.format(a) for a in "xyz"]
        moves = next((m for m in beside if all(name in names for name in m)), None)
        if moves is None or not all(w in names for w in wanted):
            continue
        twice = next((name for name in moves if names.count(name) > 1), None)
        if twice is not None:
            raise RecordingError(
                f"has the column '{twice}' twice", where=str(path),
                remedy="keep places and displacements in space, and delete those in the picture",
            )  # fmt: skip
        return [list(names).index(w) for w in wanted + moves]
    raise RecordingError(
        f"has the columns {', '.join(names[:8])}: none are x, y, z", where=str(path),
        remedy="export x, y, z of every point (DICe: MODEL_COORDINATES_X, ..)",
    )  # fmt: skip


def _refuse_twice(path: Path, labels: Sequence[str]) -> None:
    """Raise ``RecordingError`` where two points have one name."""
    twice = next((label for label in dict.fromkeys(labels) if labels.count(label) > 1), None)
    if twice is not None:
        raise RecordingError(
            f"states the point '{twice}' twice at the same moment", where=str(path),
            remedy="give every point its own name",
        )  # fmt: skip


def _times(cells: Cells) -> tuple[Array | None, bool]:
    """Return the time of every row, s (None where there is no such column), and whether its unit is stated."""
    for k, c in enumerate(cells.columns):
        base = re.sub(r"_(s|ms|us|ns)$", "", c.name)
        if base in TIME:
            stated = c.unit or c.name[len(base) + 1 :] or (base if base in TIME_UNITS else "")
            unit = stated or "s"
            if unit not in TIME_UNITS:
                raise RecordingError(
                    f"states times in '{unit}'", where=str(cells.path),
                    remedy=f"give seconds; known are {', '.join(TIME_UNITS)}",
                )  # fmt: skip
            return cells.numbers([k])[:, 0] * TIME_UNITS[unit], bool(stated)
    return None, False


def _clock(cells: Cells) -> str:
    """Return a column that rises and is called like a time, but not in a way that is known; empty if there is none."""
    for k, c in enumerate(cells.columns):
        values = cells.if_numbers(k)
        if LIKE_TIME.search(c.name) and values is not None and (np.diff(values) >= 0).all() and np.ptp(values) > 0:
            return c.shown
    return ""


def _frames(cells: Cells) -> Array | None:
    """Return the number of every row's frame; None where there is no such column."""
    k = next((k for k, name in enumerate(cells.names) if name in FRAME), None)
    return cells.numbers([k])[:, 0] if k is not None else None


def _groups(cells: Cells) -> dict[str, dict[str, int]]:
    """Return the column of each axis, of every name that ends with axes; raises RecordingError where one is twice."""
    found: dict[str, dict[str, int]] = {}
    for k, c in enumerate(cells.columns):
        axis = re.fullmatch(r"(.+?)[_\-: ]?([xyz])(?:_?(mm|cm|m|um))?|([xyz])_?(\d+)", c.name)
        if not axis or c.name in (*TIME, *FRAME):
            continue
        marker = c.shown[: len(axis[1])] if axis[1] else axis[5]
        if found.setdefault(marker, {}).setdefault(axis[2] or axis[4], k) != k:
            raise RecordingError(
                f"has the column '{c.shown}' twice", where=str(cells.path), remedy="give every marker its own name"
            )
    return found


def _no_places(names: Sequence[str], groups: Sequence[str]) -> list[str]:
    """Return which groups of columns are no places, by what they are called: forces, rotations (``q`` with a ``w``
    beside), velocities (``v``), displacements, deviations and the like, unless they are letters among letters; and what
    is stated of every marker (``M1_raw`` beside ``M1``)."""
    words = {g: [w for w in re.split(r"[_:\-\s.]+", g.lower()) if w] for g in groups}
    letters = any(len(g) == 1 and g.lower() not in LETTERS for g in groups) or not (
        len(groups) == 1 or any(len(g) > 1 for g in groups)
    )
    out, bases, beside = [], [], dict[str, list[str]]()
    for group in groups:
        plain = re.sub(r"[\s.]+", "_", group.lower())
        word = next((w for w in reversed(words[group]) if not w.isdigit()), "")
        of_another = words[group][-1:] == [word] and words[group][:-1] in words.values()
        turn = word == "q" and any(f"{plain}{sign}w" in names for sign in ("", "_", "-", ":"))
        letter = len(word) == 1 and word in "vun" and (not letters if len(group) == 1 else word == "v" or of_another)
        if turn or letter or NO_PLACE.fullmatch(word):
            out.append(group)
        elif of_another and len(word) > 1 and not SIDES.fullmatch(word):
            beside.setdefault(word, []).append(group)
        else:
            bases.append(group)
    return out + [g for same in beside.values() if len(same) == len(bases) > 1 for g in same]


def _places(cells: Cells) -> tuple[dict[str, dict[str, int]], str]:
    """Return the columns of each marker's axes, and in words which other groups of columns were left out."""
    found = _groups(cells)
    others = _no_places(cells.names, list(found))
    whole = {m: a for m, a in found.items() if len(a) == 3 and m not in others}
    part = [f"{m} (has {' and '.join(sorted(a))} only)" for m, a in found.items() if len(a) == 2 and m not in others]
    part += [f"{m} (no position)" for m in others]
    return whole, f", left out: {', '.join(part)}" if part else ""


def _wide(cells: Cells) -> PointTable:
    found = _groups(cells)
    if {m.lower() for m in found} & set(OF_DIC):
        raise RecordingError(
            "is one moment of a DIC tool, a row per point", where=str(cells.path),
            remedy="give all moments of the take with --dic",
        )  # fmt: skip
    whole, left_out = _places(cells)
    if not whole:
        names = ", ".join(c.shown for c in cells.columns[:8])
        raise RecordingError(
            f"has the columns {names}: no marker has x, y and z", where=str(cells.path),
            remedy="name them tip_x, tip_y, tip_z, or give columns time, id, x, y, z",
        )  # fmt: skip
    places = [[a["x"], a["y"], a["z"]] for a in whole.values()]
    points = np.stack([cells.numbers(columns) for columns in places], axis=1)
    unit = cells.unit_of([k for columns in places for k in columns])
    if {"x", "y", "z"} <= set(cells.names):
        left_out += f"{', ' if left_out else ', left out: '}x, y, z (of no marker's name)"
    layout = f"one row per moment{left_out}"
    (times, timed), frames = _times(cells), _frames(cells)
    clock = _clock(cells) if times is None and frames is None else ""
    return PointTable(tuple(whole), points, times, unit, layout, frames, timed, clock)


def _long(cells: Cells) -> PointTable:
    """Read a row per point and moment, in any order; without a column of names every row is the one point's."""
    (times, timed), frames = _times(cells), _frames(cells)
    moments = frames if frames is not None else times
    if moments is None:
        raise RecordingError(
            "has no column 'time' or 'frame'", where=str(cells.path),
            remedy="add the time of every row, s; files of one moment each, as DIC tools write them, need --dic",
        )  # fmt: skip
    if not np.isfinite(moments).all():
        line = cells.lines[int(np.flatnonzero(~np.isfinite(moments))[0])]
        raise RecordingError("does not say when this was", where=f"{cells.path}:{line}", remedy="give its time")
    unique, at = np.unique(moments, return_inverse=True)
    who = next((k for k, n in enumerate(cells.names) if n in NAME), None)
    if who is None and len(unique) < len(moments):
        raise RecordingError(
            "has x, y and z, and no column that says which point (id, marker, name)", where=str(cells.path),
            remedy="add it; files of one moment each, as DIC tools write them, are given with --dic",
        )  # fmt: skip
    named = [row[who].strip() if who is not None else "1" for row in cells.rows]
    labels, points = _placed(cells, named, at)
    stamps = np.bincount(at, times) / np.bincount(at) if times is not None else None
    unit = cells.unit_of([cells.names.index(a) for a in "xyz"])
    numbers = unique if frames is not None else None
    others = ", ".join(group for group, axes in _groups(cells).items() if len(axes) == 3)
    layout = "one row per point and moment" + (f", left out: {others}" if others else "")
    return PointTable(labels, points, stamps, unit, layout, numbers, timed)


def _placed(cells: Cells, named: Sequence[str], at: Rows) -> tuple[tuple[str, ...], Array]:
    """Return the points' names, in the order in which the first moments name them, and their places (moments, points,
    3), of rows that are each of the point ``named`` at the moment ``at`` (rows,)."""
    labels = tuple(dict.fromkeys(named[k] for k in np.argsort(at, kind="stable")))
    order = {label: k for k, label in enumerate(labels)}
    column = np.array([order[name] for name in named])
    _, first = np.unique(at * len(labels) + column, return_index=True)
    if len(first) < len(named):
        twice = int(np.setdiff1d(np.arange(len(named)), first)[0])
        raise RecordingError(
            f"states the point '{named[twice]}' twice at the same moment", where=f"{cells.path}:{cells.lines[twice]}",
            remedy="give every point its own name",
        )  # fmt: skip
    points = np.full((int(at.max()) + 1, len(labels), 3), np.nan)
    points[at, column] = cells.numbers([cells.names.index(a) for a in "xyz"])
    return labels, points
