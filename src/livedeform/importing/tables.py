"""Points in tables of text: one row per moment (wide), one per point and moment (long), or one file per moment (DIC).

A column is known by its name: ``time`` or ``frame``; ``x``, ``y``, ``z`` (long), or a marker's name with one of them at
its end (wide: ``tip_x``, ``tip.x [mm]``, ``X1``). What digital image correlation writes (DICe: ``COORDINATE_X`` ..
or ``MODEL_COORDINATES_X`` .. with displacements; tables of ``X``, ``Y``, ``Z`` as MultiDIC's and DuoDIC's points are
exported) is one file per moment, whose rows are the same material points in every file.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from livedeform.common.errors import RecordingError
from livedeform.common.types import Array
from livedeform.importing.cells import Cells, read_cells

TIME = ("time", "t", "seconds", "sec", "timestamp", "time_stamp", "elapsed", "elapsed_time", "time_elapsed")
LIKE_TIME = re.compile("time|stamp|elapsed|clock")  # in the name of a column that may be the rows' time
FRAME = ("frame", "frame#", "image", "step")
Rows = NDArray[np.int64]
NAME = ("id", "marker", "name", "label", "point", "subset_id", "pointid", "marker_id")
FAILED = ("sigma", "status_flag")  # DICe: below zero of a subset that was not found, whose displacement is zero
OF_DIC = ("model_coordinates", "model_displacement", "coordinate", "displacement")
NO_PLACE = re.compile(  # what three columns may be besides a place, by the last word of their name: probe_force_x
    "(forces?|torques?|moments?|rotation|orientation|quat(ernion)?|vel(ocity)?|acc(el(eration)?)?)[0-9]*"
)
RATE_AGREES = 0.1  # of a rate that is stated: more beside is another rate
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
    return _long(cells) if {"x", "y", "z"} <= set(cells.names) else _wide(cells)


def in_order(files: Sequence[Path]) -> list[Path]:
    """Sort files of one moment each by the numbers in their names."""
    return sorted(files, key=lambda f: ([int(n) for n in re.findall(r"\d+", f.stem)], f.name))


def moments_of(ordered: Sequence[Path]) -> Rows:
    """Return which moments (files,) files of one moment each are, from 0: by the one number that differs in their
    names, so that a file that is missing leaves its time; by their order where there is no such number.

    Raises ``RecordingError`` where it does not rise by equal steps with gaps.
    """
    numbers = [[int(n) for n in re.findall(r"\d+", f.stem)] for f in ordered]
    columns = list(zip(*numbers, strict=True)) if len({len(n) for n in numbers}) == 1 else []
    differing = [c for c in columns if len(set(c)) > 1]
    if len(differing) != 1 or len(set(differing[0])) < len(ordered):
        return np.arange(len(ordered))
    counted = differing[0]
    steps = [b - a for a, b in pairwise(counted)]
    step = math.gcd(*steps)
    if 2 * steps.count(step) < len(steps):
        raise RecordingError(
            f"the numbers in the files' names rise by {min(steps)} to {max(steps)} and do not tell which moments are "
            "missing", where=str(ordered[0].parent), remedy="number the files by moments: 1, 2, 4 where 3 is missing",
        )  # fmt: skip
    return np.array([(n - counted[0]) // step for n in counted])


def read_moment(path: Path) -> tuple[Array, list[str] | None, str]:
    """Read the points (n, 3) of one moment as they lie then, their names where there is a column of them, and their
    unit (empty: not stated); NaN where the tool says that it found none."""
    cells = read_cells(path, ("x", "y", "z"))
    where = _dic_columns(path, cells.names)
    xyz = cells.numbers(where[:3])
    if len(where) == 6:
        xyz = xyz + cells.numbers(where[3:])
    for name in FAILED:
        if name in cells.names:
            xyz[cells.numbers([cells.names.index(name)])[:, 0] < 0] = np.nan
    own = next((k for k, name in enumerate(cells.names) if name in NAME), None)
    labels = [row[own].strip() for row in cells.rows] if own is not None else None
    return xyz, labels, cells.unit_of(where)


def read_dic(files: Sequence[Path]) -> PointTable:
    """Read files of one moment each, which the numbers in their names tell; their rows are the same points."""
    ordered = in_order(files)
    frames, ids, unit = [], None, ""
    for path in ordered:
        xyz, names, stated = read_moment(path)
        labels = names if names is not None else [str(k + 1) for k in range(len(xyz))]
        unit = unit or stated
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
    moments = moments_of(ordered)
    layout = f"one file per moment{gaps_said(moments)}, {len(ids)} points by row"
    return PointTable(tuple(ids), np.array(frames), None, unit, layout, moments.astype(float))


def gaps_said(moments: Rows) -> str:
    """Return in words how many moments are missing among those given."""
    missing = int(moments[-1]) + 1 - len(moments)
    return f" ({missing} missing by the files' numbers)" if missing else ""


def _dic_columns(path: Path, names: Sequence[str]) -> list[int]:
    """Return the columns of x, y, z, and of the displacements where places are those at rest."""
    for place, move in (
        ("model_coordinates_{}", "model_displacement_{}"), ("coordinate_{}", "displacement_{}"),
        ("{}", "u_{}"), ("{}", "d{}"), ("{}", ""), ("{}c", ""),
    ):  # fmt: skip
        wanted = [place.format(a) for a in "xyz"]
        if all(w in names for w in wanted):
            moves = [move.format(a) for a in "xyz"] if move else []
            if not moves or all(m in names for m in moves):
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
    beside), velocities (``v``, unless it is a letter among letters), accelerations."""
    letters = [g for g in groups if len(g) == 1 and g.lower() not in "qv"]
    out = []
    for group in groups:
        plain = re.sub(r"[\s.]+", "_", group.lower())
        word = next((w for w in reversed(re.split(r"[_:\-]+", plain)) if w and not w.isdigit()), "")
        turn = word == "q" and any(f"{plain}{sign}w" in names for sign in ("", "_", "-", ":"))
        fast = word == "v" and (len(group) > 1 or not letters)
        if turn or fast or NO_PLACE.fullmatch(word):
            out.append(group)
    return out


def _wide(cells: Cells) -> PointTable:
    found = _groups(cells)
    if {m.lower() for m in found} & set(OF_DIC):
        raise RecordingError(
            "is one moment of a DIC tool, a row per point", where=str(cells.path),
            remedy="give all moments of the take with --dic",
        )  # fmt: skip
    others = _no_places(cells.names, list(found))
    whole = {m: a for m, a in found.items() if len(a) == 3 and m not in others}
    if not whole:
        names = ", ".join(c.shown for c in cells.columns[:8])
        raise RecordingError(
            f"has the columns {names}: no marker has x, y and z", where=str(cells.path),
            remedy="name them tip_x, tip_y, tip_z, or give columns time, id, x, y, z",
        )  # fmt: skip
    places = [[a["x"], a["y"], a["z"]] for a in whole.values()]
    points = np.stack([cells.numbers(columns) for columns in places], axis=1)
    unit = cells.unit_of([k for columns in places for k in columns])
    part = [f"{m} (has {' and '.join(sorted(a))} only)" for m, a in found.items() if len(a) == 2 and m not in others]
    part += [f"{m} (no position)" for m in others]
    layout = "one row per moment" + (f", left out: {', '.join(part)}" if part else "")
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
    return PointTable(labels, points, stamps, unit, "one row per point and moment", numbers, timed)


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
