"""``markers.csv``: reference markers, id,x,y,z in metres and optionally sigma (m) and kind."""

from __future__ import annotations

import csv
import re
import unicodedata
from collections.abc import Sequence
from difflib import SequenceMatcher
from pathlib import Path

import numpy as np

from livedeform.common.errors import InputError
from livedeform.common.experiment.schema import Markers

KINDS = ("surface", "internal", "support")
REQUIRED, OPTIONAL = ("id", "x", "y", "z"), ("sigma", "kind")
NEAR = 0.85  # of `SequenceMatcher`: kinds and kin are near to kind, sigma_x is not near to sigma


def read_markers(path: Path) -> Markers:
    """The markers of the file; ``InputError`` naming the line for anything that is not a marker.

    Columns go by their names, in small or capital letters; others than id, x, y, z, sigma and kind are not read.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot be read ({error})", where=str(path), remedy="save it as UTF-8 text") from error
    lines = {i: line for i, line in enumerate(text.splitlines(), 1) if line.strip() and not _is_comment(line)}
    rows = csv.DictReader(lines.values(), skipinitialspace=True)
    rows.fieldnames = columns = _columns(rows.fieldnames or [], path)
    numbers, places = list(lines), []  # of all lines, of those with a marker
    parsed = []
    for row in rows:
        places.append(f"{path}:{numbers[rows.line_num - 1]}")
        parsed.append(_parse(row, places[-1]))
    if not parsed:
        raise InputError("holds no markers", where=str(path), remedy="add one line per marker: id,x,y,z in metres")
    ids = [row[0] for row in parsed]
    for i, marker_id in enumerate(ids):
        if marker_id in ids[:i]:
            what = f"marker id {marker_id} is there twice"
            raise InputError(what, where=places[i], remedy="give every marker its own id")
    return Markers(
        np.array(ids, np.uint32),
        np.array([row[1] for row in parsed], float).reshape(-1, 3),
        np.array([row[2] for row in parsed], float),
        np.array([row[3] for row in parsed]),
        kinds_stated="kind" in columns,
    )


def _is_comment(line: str) -> bool:
    return line.lstrip().startswith("#")


def _columns(names: Sequence[str], path: Path) -> list[str]:
    """Return the names of the columns, those that are read in small letters."""
    columns = [name.strip() for name in names]
    read = [name for name in (*REQUIRED, *OPTIONAL) if name not in columns]  # these are there as they are
    columns = [name.lower() if name.lower() in read else name for name in columns]
    missing = [name for name in REQUIRED if name not in columns]
    if missing:
        raise InputError(
            f"column {', '.join(missing)} is missing (found: {', '.join(columns) or 'nothing'})",
            where=str(path),
            remedy=_remedy(columns),
        )
    doubled = sorted({name for name in columns if name and columns.count(name) > 1})
    if doubled:
        raise InputError(f"column {', '.join(doubled)} is there twice", where=str(path), remedy="delete one of them")
    for wanted in OPTIONAL:
        near = [name for name in columns if name != wanted and _mistyped(name, wanted)]
        if near and wanted not in columns:
            what, meant = f"a column '{near[0]}' is not read", f"call it {wanted} (lengths in metres) if that is meant"
            raise InputError(what, where=str(path), remedy=f"{meant}, or else otherwise")
    return columns


def _remedy(columns: Sequence[str]) -> str:
    """Return what to do about columns that are not found: their separator, or units behind their names, may be why."""
    separator = next((s for s in (";", "\t", "|") if s in " ".join(columns)), "")
    if separator:
        name = {"\t": "tabs"}.get(separator, f"'{separator}'")
        return f"columns are separated by {name}: put commas between them, and points into decimals"
    heads = [re.match(r"([xyz])[ _]*[\[(]?[ ]*(mm|m)\b", name.lower()) for name in columns]
    units = sorted({head[2] for head in heads if head})
    if units:
        option = f"; livedeform new takes millimetres with --markers-unit {units[-1]}" if units[-1] == "mm" else ""
        return f"call the columns id,x,y,z, without their unit: lengths are in metres{option}"
    return "begin the file with the line id,x,y,z"


def _mistyped(name: str, wanted: str) -> bool:
    """Tell whether a column is the wanted one in other signs, with a unit or anything else behind it, with letters
    exchanged, or with one too many or too few. One of a single axis (sigma_x) is another."""
    plain = unicodedata.normalize("NFKC", name).lower().replace("\u03c3", "sigma")
    if wanted == "sigma" and plain.startswith(wanted) and not re.fullmatch(r"sigma[ _]?[xyz]", plain):
        return True
    return sorted(plain) == sorted(wanted) or SequenceMatcher(None, plain, wanted).ratio() > NEAR


def no_markers() -> Markers:
    """Return no markers, of a body of which points without ids are measured."""
    return Markers(np.zeros(0, np.uint32), np.zeros((0, 3)), np.zeros(0), np.zeros(0, "<U8"))


def _parse(row: dict[str, str], where: str) -> tuple[int, list[float], float, str]:
    if None in row:
        raise InputError("has more values than there are columns", where=where, remedy="correct the line")
    values = {name: _number(row, name, where) for name in REQUIRED}
    if values["id"] != int(values["id"]) or not 0 <= values["id"] < 2**32:
        raise InputError(f"id '{row['id']}' is not a whole number >= 0", where=where, remedy="number the markers")
    sigma = _number(row, "sigma", where) if (row.get("sigma") or "").strip() else float("nan")
    if sigma <= 0:
        raise InputError(
            f"sigma is {sigma:g}", where=where, remedy="give one standard deviation in metres, or leave it out"
        )
    kind = (row.get("kind") or "").strip() or "surface"
    if kind not in KINDS:
        raise InputError(f"unknown kind '{kind}'", where=where, remedy=f"known are {', '.join(KINDS)}")
    return int(values["id"]), [values["x"], values["y"], values["z"]], sigma, kind


def _number(row: dict[str, str], name: str, where: str) -> float:
    text = (row.get(name) or "").strip()
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not np.isfinite(value):
        raise InputError(f"{name} is '{text}', not a number", where=where, remedy="correct the line or delete it")
    return value


def write_markers(path: Path, markers: Markers) -> None:
    """Writes the file that ``read_markers`` reads; ``sigma`` and ``kind`` only where there is something to say."""
    with_sigma = bool(np.isfinite(markers.sigmas).any())
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([*REQUIRED, *(["sigma"] if with_sigma else []), "kind"])
        for i, marker_id in enumerate(markers.ids):
            sigma = [f"{markers.sigmas[i]:.6g}" if np.isfinite(markers.sigmas[i]) else ""] if with_sigma else []
            writer.writerow([int(marker_id), *(f"{x:.9g}" for x in markers.points[i]), *sigma, markers.kinds[i]])
