"""Points in tables of text: one row per moment (wide), one per point and moment (long), or one file per moment (DIC).

A column is known by its name: ``time`` or ``frame``; ``x``, ``y``, ``z`` (long), or a marker's name with one of them at
its end (wide: ``tip_x``, ``tip.x [mm]``, ``X1``). What digital image correlation writes (DICe: ``COORDINATE_X`` ..
or ``MODEL_COORDINATES_X`` .. with displacements; tables of ``X``, ``Y``, ``Z`` as MultiDIC's and DuoDIC's points are
exported) is one file per moment, whose rows are the same material points in every file.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from livedeform.common.errors import RecordingError
from livedeform.common.types import Array

UNITS = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "um": 1e-6, "µm": 1e-6, "in": 0.0254, "dm": 0.1}
TIME = ("time", "t", "seconds", "sec", "timestamp")
FRAME = ("frame", "frame#", "image", "step")
NAME = ("id", "marker", "name", "label", "point", "subset_id", "pointid", "marker_id")
TIME_UNITS = {"s": 1.0, "sec": 1.0, "seconds": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}


@dataclass(frozen=True)
class PointTable:
    """Hold a file's words: ``points`` (frames, points, 3) in ``unit`` (empty: not stated), NaN where one was not seen,
    ``times`` (frames,) s, None where it states none; ``layout`` in words."""

    labels: tuple[str, ...]
    points: Array
    times: Array | None
    unit: str
    layout: str


@dataclass(frozen=True)
class _Column:
    name: str  # lower case, without its unit
    unit: str
    shown: str


def read_table(path: Path) -> PointTable:
    """Read a wide or long table; ``RecordingError`` where its columns do not say what they are."""
    columns, rows = _rows(path)
    names = [c.name for c in columns]
    if {"x", "y", "z"} <= set(names):
        if not any(n in NAME for n in names):
            raise RecordingError(
                "has x, y and z, and no column that says which point (id, marker, name)", where=str(path),
                remedy="add it; files of one moment each, as DIC tools write them, are given with --dic",
            )  # fmt: skip
        return _long(path, columns, rows)
    return _wide(path, columns, rows)


def in_order(files: Sequence[Path]) -> list[Path]:
    """Sort files of one moment each by the numbers in their names."""
    return sorted(files, key=lambda f: ([int(n) for n in re.findall(r"\d+", f.stem)], f.name))


def read_moment(path: Path) -> tuple[Array, list[str] | None, str]:
    """Read the points (n, 3) of one moment as they lie then, their names where there is a column of them, and their
    unit (empty: not stated)."""
    columns, rows = _rows(path)
    where = _dic_columns(path, [c.name for c in columns])
    xyz = _numbers(rows, where[:3])
    if len(where) == 6:
        xyz = xyz + _numbers(rows, where[3:])
    own = next((k for k, c in enumerate(columns) if c.name in NAME), None)
    return xyz, [row[own].strip() for row in rows] if own is not None else None, columns[where[0]].unit


def read_dic(files: Sequence[Path]) -> PointTable:
    """Read files of one moment each, in the order of the numbers in their names; their rows are the same points."""
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
        at = {label: k for k, label in enumerate(labels)}
        frames.append(np.array([xyz[at[i]] if i in at else [np.nan] * 3 for i in ids]))
    if ids is None or len(frames) < 2:
        raise RecordingError("a take has two moments at least", where=str(files[0].parent), remedy="name more files")
    return PointTable(tuple(ids), np.array(frames), None, unit, f"one file per moment, {len(ids)} points by row")


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


def _rows(path: Path) -> tuple[list[_Column], list[list[str]]]:
    """Return the columns and the rows of numbers; lines before the header (of fewer cells, or words) are skipped."""
    try:
        text = path.read_text(encoding="utf-8-sig", errors="replace")
    except OSError as error:
        raise RecordingError(
            f"cannot be read ({error.strerror})", where=str(path), remedy="name a text file"
        ) from error
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith(("#", "%", "***"))]
    if len(lines) < 2:
        raise RecordingError("holds no table", where=str(path), remedy="give a header line and a line per moment")
    separator = next((s for s in "\t;," if s in lines[-1]), " ")  # beside tabs and semicolons a comma is a decimal one
    table = list(csv.reader(lines, delimiter=separator, skipinitialspace=True))
    width = len(table[-1])
    first = next((k for k, row in enumerate(table) if len(row) == width and _is_numbers(row)), None)
    if not first:
        what = "no line of numbers" if first is None else "no line with the columns' names"
        raise RecordingError(f"has {what}", where=str(path), remedy="begin with a line as time,tip_x,tip_y,tip_z")
    header = table[first - 1]
    torn = [k for k, row in enumerate(table[first:], first) if len(row) != width]
    if len(header) != width or torn:
        at = f"line with {len(table[torn[0]])} cells" if torn else f"header with {len(header)} names"
        raise RecordingError(
            f"has a {at} beside lines of {width}", where=str(path), remedy="it may be torn; export again"
        )
    return [_column(cell) for cell in header], table[first:]


def _is_numbers(row: Sequence[str]) -> bool:
    def number(cell: str) -> bool:
        try:
            float(cell.replace(",", ".") or "nan")
        except ValueError:
            return False
        return True

    return sum(map(number, row)) >= max(len(row) - 1, 1)


def _column(cell: str) -> _Column:
    text = cell.strip().strip('"').strip()
    found = re.fullmatch(r"(.*?)\s*[\[(]\s*([^\])]*?)\s*[\])]", text)
    name, unit = (found[1], found[2]) if found else (text, "")
    return _Column(re.sub(r"[\s.]+", "_", name.strip().lower()), unit.strip().lower(), name.strip())


def _numbers(rows: Sequence[Sequence[str]], columns: Sequence[int]) -> Array:
    try:
        return np.array([[float(row[k].strip().replace(",", ".") or "nan") for k in columns] for row in rows])
    except ValueError as error:
        raise RecordingError(
            f"holds a cell that is no number ({error})", where="table", remedy="export it again"
        ) from error


def _times(columns: Sequence[_Column], rows: Sequence[Sequence[str]]) -> Array | None:
    """Return the time of every row, s; None where there is no such column."""
    for k, c in enumerate(columns):
        base = re.sub(r"_(s|ms|us|ns)$", "", c.name)
        if base in TIME:
            unit = c.unit or (c.name[len(base) + 1 :] if c.name != base else "s")
            return _numbers(rows, [k])[:, 0] * TIME_UNITS.get(unit, 1.0)
    return None


def _wide(path: Path, columns: Sequence[_Column], rows: Sequence[Sequence[str]]) -> PointTable:
    found: dict[str, dict[str, int]] = {}
    for k, c in enumerate(columns):
        axis = re.fullmatch(r"(.+?)[_\-: ]?([xyz])(?:_?(mm|cm|m|um))?|([xyz])_?(\d+)", c.name)
        if axis and c.name not in TIME:
            marker = c.shown[: len(axis[1])] if axis[1] else axis[5]
            found.setdefault(marker, {})[axis[2] or axis[4]] = k
    whole = {m: a for m, a in found.items() if len(a) == 3}
    if not whole:
        names = ", ".join(c.shown for c in columns[:8])
        raise RecordingError(
            f"has the columns {names}: no marker has x, y and z", where=str(path),
            remedy="name them tip_x, tip_y, tip_z, or give columns time, id, x, y, z",
        )  # fmt: skip
    points = np.stack([_numbers(rows, [a["x"], a["y"], a["z"]]) for a in whole.values()], axis=1)
    first = next(iter(whole.values()))["x"]
    suffix = re.search(r"[xyz]_(mm|cm|m|um)$", columns[first].name)
    unit = columns[first].unit or (suffix[1] if suffix else "")
    return PointTable(tuple(whole), points, _times(columns, rows), unit, "one row per moment")


def _long(path: Path, columns: Sequence[_Column], rows: Sequence[Sequence[str]]) -> PointTable:
    names = [c.name for c in columns]
    who = next(k for k, n in enumerate(names) if n in NAME)
    labels = list(dict.fromkeys(row[who].strip() for row in rows))
    times = _times(columns, rows)
    frame = next((k for k, n in enumerate(names) if n in FRAME), None)
    if times is None and frame is None:
        raise RecordingError("has no column 'time' or 'frame'", where=str(path), remedy="add the time of every row, s")
    moments = _numbers(rows, [frame])[:, 0] if frame is not None else times
    assert moments is not None
    unique, at = np.unique(moments, return_inverse=True)
    points = np.full((len(unique), len(labels), 3), np.nan)
    order = {label: k for k, label in enumerate(labels)}
    column = np.array([order[row[who].strip()] for row in rows])
    twice = len(rows) - len(set(zip(at.tolist(), column.tolist(), strict=True)))
    if twice:
        raise RecordingError(
            f"states {twice} points twice at the same moment", where=str(path), remedy="give every point its own name"
        )
    xyz = [names.index(a) for a in "xyz"]
    points[at, column] = _numbers(rows, xyz)
    stamps = None
    if times is not None:
        stamps = np.array([times[at == k].mean() for k in range(len(unique))])
    return PointTable(tuple(labels), points, stamps, columns[xyz[0]].unit, "one row per point and moment")
