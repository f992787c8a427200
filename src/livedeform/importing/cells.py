"""The cells of a table of text: its encoding, separator, header and units, and the numbers in its columns."""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from livedeform.common.errors import RecordingError
from livedeform.common.types import Array

UNITS = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "um": 1e-6, "µm": 1e-6, "in": 0.0254, "dm": 0.1}
SPELT = {
    f"{long}{spelling}{plural}": short
    for long, short in (("milli", "mm"), ("centi", "cm"), ("micro", "um"), ("", "m"))
    for spelling in ("meter", "metre")
    for plural in ("", "s")
} | {"inches": "in", "inch": "in"}
MISSING = {"", "nan", "na", "n/a", "#n/a", "#n/d", "null", "none", "-", "--", "?", ".", "nd", "missing"}
NO_LENGTH = {"s", "ms", "us", "ns", "sec", "seconds", "frame", "frames", "deg", "rad", "px", "n"}  # in a line of units
THOUSANDS = re.compile(r"[-+]?[1-9]\d{0,2},\d{3}")
COMMENTS = ("#", "%", "***")


@dataclass(frozen=True)
class TableColumn:
    """A column's ``name`` in lower case without its ``unit``, and as it is ``shown``."""

    name: str
    unit: str
    shown: str


@dataclass(frozen=True)
class Cells:
    """A table: ``columns``, ``rows`` of words, the ``lines`` of the file that they are, a unit of length that is
    stated above (empty: none), and the file's lines ``above`` the header."""

    path: Path
    columns: tuple[TableColumn, ...]
    rows: list[list[str]]
    lines: list[int]
    unit: str = ""
    above: tuple[str, ...] = ()

    @property
    def names(self) -> list[str]:
        """Return the columns' names."""
        return [c.name for c in self.columns]

    def numbers(self, columns: Sequence[int]) -> Array:
        """Return some columns (rows, columns), NaN where a cell says that there is nothing; raises RecordingError."""
        return np.array([[self._number(r, k) for k in columns] for r in range(len(self.rows))], float)

    def if_numbers(self, column: int) -> Array | None:
        """Return a column (rows,) where every cell is a finite number, else None."""
        values = [_value(row[column].strip()) for row in self.rows]
        found = np.array([v for v in values if v is not None], float)
        return found if len(found) == len(values) and np.isfinite(found).all() else None

    def _number(self, row: int, column: int) -> float:
        cell = self.rows[row][column].strip()
        value = _value(cell)
        if value is None:
            shown = self.columns[column].shown or f"number {column + 1}"
            raise RecordingError(
                f"holds '{cell[:20]}' in the column '{shown}', which is no number",
                where=f"{self.path}:{self.lines[row]}",
                remedy="correct the cell, or leave it empty where nothing was measured",
            )  # fmt: skip
        return value

    def unit_of(self, columns: Sequence[int]) -> str:
        """Return the unit of length of some columns (empty: not stated); raises RecordingError where they differ."""
        found = sorted({_unit(self.columns[k]) or self.unit for k in columns})
        if len(found) > 1:
            said = " and ".join(u or "no unit" for u in found)
            raise RecordingError(
                f"has columns of points in {said}", where=str(self.path), remedy="give all of them in one unit"
            )
        return found[0]


def read_cells(path: Path, bare: tuple[str, ...] = ()) -> Cells:
    """Read a table; the header is the last line of words without a number, what stands above says names and units.

    A table of numbers alone has the columns ``bare`` if it has as many.
    """
    text = _text(path).splitlines()
    numbered = [(n, line) for n, line in enumerate(text, 1) if line.strip() and not line.startswith(COMMENTS)]
    if len(numbered) < 2:
        raise RecordingError("holds no table", where=str(path), remedy="give a header line and a line per moment")
    # beside tabs and semicolons a comma is a decimal one
    separator = next((s for s in "\t;," if s in numbered[len(numbered) // 2][1]), " ")
    table = [next(csv.reader([line], delimiter=separator, skipinitialspace=True)) for _, line in numbered]
    header = max((k for k, row in enumerate(table) if _is_header(row)), default=None)
    if header is None and len(table[0]) == len(bare):
        table, numbered, header = [list(bare), *table], [(0, ""), *numbered], 0
    _refuse_numbers_above(path, table[: (header or 0) + 1], [n for n, _ in numbered])
    if header is None or header == len(table) - 1:
        what = "no line with the columns' names" if header is None else "no line of numbers"
        raise RecordingError(f"has {what}", where=str(path), remedy="begin with a line as time,tip_x,tip_y,tip_z")
    rows, lines = _of_one_width(path, table[header + 1 :], [n for n, _ in numbered[header + 1 :]], len(table[header]))
    if separator == ",":
        _refuse_thousands(path, rows, lines)
    units: list[str] = []
    if header and all(_plain_unit(c) in {*UNITS, *NO_LENGTH, ""} for c in table[header]):
        units, header = [_plain_unit(c) for c in table[header]], header - 1
    names = table[header] + [""] * (len(rows[0]) - len(table[header]))
    if len(names) > len(rows[0]):
        raise RecordingError(
            f"has a header with {len(names)} names beside lines of {len(rows[0])}", where=str(path),
            remedy="it may be torn; export again",
        )  # fmt: skip
    columns = [_column(cell) for cell in names]
    for k, unit in enumerate(units):
        columns[k] = TableColumn(columns[k].name, columns[k].unit or unit, columns[k].shown)
    above, begins = table[:header], max(numbered[header][0] - 1, 0)
    columns = _under_names(path, _beside_pixels(columns), above)
    return Cells(path, tuple(columns), rows, lines, _stated_above(above), tuple(text[:begins]))


def _text(path: Path) -> str:
    """Read a text file as UTF-8, as UTF-16 where it begins so, else as Windows' western encoding."""
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise RecordingError(
            f"cannot be read ({error.strerror})", where=str(path), remedy="name a text file"
        ) from error
    if raw[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return raw.decode("utf-16", errors="replace")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        return raw.decode("cp1252", errors="replace")


def _value(cell: str) -> float | None:
    """Return a cell's number, NaN where it says that nothing was measured, None where it is a word."""
    if cell.lower() in MISSING:
        return float("nan")
    try:
        return float(cell.replace(",", "."))
    except ValueError:
        return None


def _is_header(row: Sequence[str]) -> bool:
    """Return whether a row has words, and no number."""
    values = [_value(cell.strip()) for cell in row]
    return any(v is None for v in values) and all(v is None or np.isnan(v) for v in values)


def _refuse_numbers_above(path: Path, head: Sequence[Sequence[str]], lines: Sequence[int]) -> None:
    """Raise RecordingError where lines of numbers, two at least of one width, stand in ``head`` above the header, its
    last line: a logger that began again. In a file of Vicon Nexus other parts may stand before the trajectories."""
    parts = [k for k, row in enumerate(head) if row[0].strip().lower() == "trajectories" and not any(row[1:])]
    first = parts[-1] + 1 if parts else 0
    wide = [len(row) if _is_numbers(row) else 0 for row in head]
    last = max((k for k in range(first + 1, len(head)) if wide[k] and wide[k] == wide[k - 1]), default=None)
    if last is None:
        return
    words = next(cell.strip() for row in head[last + 1 :] for cell in row if cell.strip())
    raise RecordingError(
        f"has a second header, '{words[:20]}', below lines of numbers", where=f"{path}:{lines[last + 1]}",
        remedy="make one file of each recording, or delete the line if it is a remark",
    )  # fmt: skip


def _is_numbers(row: Sequence[str]) -> bool:
    """Return whether a row is one of numbers: two at least, and it begins with one or half of its cells are."""
    values = [_value(cell.strip()) for cell in row]
    found = [v is not None and bool(np.isfinite(v)) for v in values]
    return sum(found) > 1 and (found[0] or 2 * sum(found) >= len(row))


def _refuse_thousands(path: Path, rows: Sequence[Sequence[str]], lines: Sequence[int]) -> None:
    """Raise RecordingError where all commas in cells of numbers may be those of thousands or decimal ones: 12,345."""
    commas = [(cell.strip(), n) for row, n in zip(rows, lines, strict=True) for cell in row if "," in cell]
    numbers = [(cell, n) for cell, n in commas if _value(cell) is not None]
    if numbers and all(THOUSANDS.fullmatch(cell) for cell, _ in numbers):
        cell, line = numbers[0]
        raise RecordingError(
            f"holds '{cell}', which is {cell.replace(',', '')} or {cell.replace(',', '.')}", where=f"{path}:{line}",
            remedy="write numbers without commas, or decimal commas between semicolons",
        )  # fmt: skip


def _of_one_width(path: Path, rows: list[list[str]], lines: list[int], named: int) -> tuple[list[list[str]], list[int]]:
    """Return the rows, without an empty cell at the end of all; ``RecordingError`` where one has more or fewer cells
    than most."""
    width = Counter(map(len, rows)).most_common(1)[0][0]
    torn = next((k for k, row in enumerate(rows) if len(row) != width), None)
    if torn is not None:
        raise RecordingError(
            f"has {len(rows[torn])} cells beside lines of {width}", where=f"{path}:{lines[torn]}",
            remedy="it may be torn; export again",
        )  # fmt: skip
    if named < width and all(not row[-1].strip() for row in rows):
        return [row[:-1] for row in rows], lines
    if named < width:
        raise RecordingError(
            f"has a header with {named} names beside lines of {width}", where=str(path),
            remedy="it may be torn; export again",
        )  # fmt: skip
    return rows, lines


def _column(cell: str) -> TableColumn:
    text = cell.strip().strip('"').strip()
    found = re.fullmatch(r"(.*?)\s*[\[(]\s*([^\])]*?)\s*[\])]", text)
    name, unit = (found[1], found[2]) if found else (text, "")
    return TableColumn(re.sub(r"[\s.]+", "_", name.strip().lower()), _plain_unit(unit), name.strip())


def _beside_pixels(columns: list[TableColumn]) -> list[TableColumn]:
    """Give columns of the picture names that say so: VIC-3D writes x, y, u, v in pixels beside X, Y, Z, U, V, W."""
    shown = {c.shown for c in columns}
    if not set("XYZ") <= shown or set("zw") & shown:
        return columns
    return [replace(c, name=f"picture_{c.name}") if c.shown in ("x", "y", "u", "v") else c for c in columns]


def _plain_unit(text: str) -> str:
    """Return a unit as `UNITS` spells it."""
    word = text.strip().lower().replace("μ", "µ")
    return SPELT.get(word, word)


def _unit(column: TableColumn) -> str:
    suffix = re.search(r"[xyz]_(mm|cm|m|um)$", column.name)
    return column.unit or (suffix[1] if suffix else "")


def _stated_above(rows: Sequence[Sequence[str]]) -> str:
    """Return the unit after the words 'length units' above the header; empty where there are none."""
    for row in rows:
        words = [cell.strip().lower().rstrip(":") for cell in row]
        for key, value in pairwise(words):
            if key in ("length units", "units", "unit"):
                return _plain_unit(value)
    return ""


def _under_names(path: Path, columns: list[TableColumn], above: Sequence[Sequence[str]]) -> list[TableColumn]:
    """Give columns X, Y, Z that repeat the names that stand in a line above them (Motive, Vicon Nexus), and those of a
    rigid body's rotation in Motive a name that says so."""
    starts = [k for k, c in enumerate(columns) if c.name == "x"]
    if len(starts) < 2:
        return columns
    if any([c.name for c in columns[k : k + 3]] != ["x", "y", "z"] for k in starts):
        raise RecordingError(
            "has several columns X that Y and Z do not follow", where=str(path), remedy="export positions alone"
        )
    turns = [k for k in starts if any(_cell(row, k).lower() == "rotation" for row in above)]
    places = [k for k in starts if k not in turns]
    found = []
    for row in above:
        labels = [_cell(row, k) for k in places]
        if all(labels) and len(set(labels)) == len(labels):
            found.append((next((c for c in row if c.strip()), "").strip().lower() == "name", row))
    if not found:
        raise RecordingError(
            f"has {len(places)} columns X, Y, Z and no line above that gives each its own marker's name",
            where=str(path), remedy="name them tip_x, tip_y, tip_z, or export markers alone",
        )  # fmt: skip
    names = next((row for named, row in found if named), found[-1][1])
    out = list(columns)
    for k in starts:
        label = f"{_cell(names, k)} rotation" if k in turns else _cell(names, k)
        for axis, place in zip("xyz", range(k, k + 3), strict=True):
            out[place] = _column(f"{label}_{axis}")
            out[place] = TableColumn(out[place].name, columns[place].unit, out[place].shown)
    return out


def _cell(row: Sequence[str], k: int) -> str:
    return row[k].strip() if k < len(row) else ""
