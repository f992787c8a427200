"""Read compression tests of cylinders: size and specimen from the header, an option or the file's name."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from livedeform.common.errors import InputError
from livedeform.common.types import Array
from livedeform.importing.cells import Cells, read_cells

FIRST_STRAIN, LAST_STRAIN = 0.02, 0.39  # below, the specimen is still being seated; above, the mesh is not good
FEWEST = 20  # lines of a test
ENOUGH = 400  # lines: of more, every fifth is taken
METRES = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "in": 0.0254}
NEWTONS = {
    "n": 1.0, "kn": 1e3, "mn": 1e-3, "g": 9.80665e-3, "gf": 9.80665e-3, "kg": 9.80665, "kgf": 9.80665, "lbf": 4.4482216,
}  # fmt: skip
MOVED, PUSHED = ("compression", "displacement", "extension"), ("load", "force")
TABLES = (".csv", ".txt", ".tsv")
OTHERS = (".xls", ".xlsx", ".xlsm", ".ods", ".dat", ".mat", ".tdms", ".h5")  # of tests as well, but not read
TOUCHED = 0.02  # of the largest load
OFF = 1e-3, 0.05  # m, and share of the height more, by which the touch may be off the compression's zero
BACK = 0.02  # strain that a test may go back before its largest


@dataclass(frozen=True)
class Size:
    """A cylinder's radius and height, m."""

    radius: float
    height: float

    def __post_init__(self) -> None:
        if not (1e-4 < self.radius < 1.0 and 1e-4 < self.height < 1.0):
            raise InputError(
                f"a cylinder of radius {self.radius:g} m and height {self.height:g} m is not plausible",
                where="--diameter, --height", remedy="give metres (0.025 for 25 mm)",
            )  # fmt: skip


@dataclass(frozen=True)
class Specimen:
    """One test: ``strain`` (n,) nominal compression, ``force`` (n,) N, the cylinder's ``radius`` and ``height`` m,
    which ``specimen`` it is a repeat of, and ``notes`` on what was taken that its file does not say."""

    name: str
    strain: Array
    force: Array
    radius: float
    height: float
    specimen: str = ""
    notes: tuple[str, ...] = ()

    @property
    def stress(self) -> Array:
        """Nominal stress (n,) Pa."""
        return self.force / (np.pi * self.radius**2)

    @property
    def shape(self) -> float:
        """Radius over height, rounded: cylinders of one shape have one curve."""
        return round(self.radius / self.height, 6)


def read_materials(folder: Path, size: Size | None = None) -> tuple[dict[str, list[Specimen]], list[str]]:
    """Return the tests of every material (each folder with tables, however deep, and ``folder`` itself), and a line
    about each file that cannot be used; ``InputError`` where none can."""
    if not folder.is_dir():
        raise InputError("is no folder", where=str(folder), remedy="name the folder of the tests")
    materials: dict[str, list[Specimen]] = {}
    dropped: list[str] = []
    for path in sorted((p for p in folder.rglob("*") if p.is_file()), key=lambda p: _natural(str(p))):
        if path.suffix.lower() in OTHERS:
            dropped.append(f"{path}: is no table of text; save it as CSV")
        if path.suffix.lower() not in TABLES:
            continue
        name = path.parent.relative_to(folder).as_posix()
        try:
            _add(read(path, size), path, materials.setdefault(folder.resolve().name if name == "." else name, []))
        except InputError as error:
            dropped.append(str(error))
    materials = {name: tests for name, tests in materials.items() if tests}
    if not materials:
        what = f"none of {len(dropped)} files can be used ({dropped[0]})" if dropped else "holds no *.csv file"
        others = ", ".join(Path(line.split(": ")[0]).name for line in dropped[1:9])
        remedy = f"nor {others}" + (" .." if len(dropped) > 9 else "") if others else "give folders of tests"
        raise InputError(what, where=str(folder), remedy=remedy)
    return materials, dropped


def _add(test: Specimen, path: Path, known: list[Specimen]) -> None:
    """Add a test to those of its material; raises InputError where its cylinder has another shape."""
    if known and known[0].shape != test.shape:
        raise InputError(
            f"its shape is not that of {known[0].name}", where=str(path), remedy="give it a folder of its own"
        )
    known.append(test)


def _natural(text: str) -> list[tuple[int, str]]:
    """Return a key that sorts 2 before 10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", text)]


def read(path: Path, size: Size | None = None) -> Specimen:
    """One test: header lines, then columns of which one is a compression or displacement and one a load or force.

    ``size`` is taken rather than what the header says. Both columns may count compression as negative. Used is what
    comes before the largest compression.
    """
    cells = read_cells(path)
    moved, length, no_length = _column(cells, MOVED, METRES, "mm")
    pushed, load, no_load = _column(cells, PUSHED, NEWTONS, "n")
    stated = size if size is not None else _stated(cells.above, path)
    table = cells.numbers((moved, pushed)) * [length, load]
    if not np.isfinite(table).all():
        line = cells.lines[int(np.flatnonzero(~np.isfinite(table).all(axis=1))[0])]
        raise InputError("has no compression or no load", where=f"{path}:{line}", remedy="delete the line, or fill it")
    if table[:, 0].max() < -table[:, 0].min() and table[:, 1].sum() < 0.0:
        table = -table
    strain, force = _loading(path, table[:, 0] / stated.height, table[:, 1], stated.height)
    notes = [f"{path}: no unit of {what}, taken as {unit}" for what, unit in (no_length, no_load) if unit]
    if size is not None:
        notes += _other_size(cells.above, path, size)
    return Specimen(path.stem, strain, force, stated.radius, stated.height, _specimen(path.stem), tuple(notes))


def latest_touch(height: float) -> float:
    """Return how far (m) the touch may be off the compression's zero: a test is taken, and a fit finds it, up to
    here."""
    return OFF[0] + OFF[1] * height


def _loading(path: Path, strain: Array, force: Array, height: float) -> tuple[Array, Array]:
    """Return the part of a test (strain, force N) that is used; raises InputError where it is not one loading, too
    short, or counted from elsewhere than the touch."""
    end = int(strain.argmax()) + 1
    strain, force = strain[:end], force[:end]
    if strain[-1] >= 1.0:
        raise InputError(
            f"is compressed by {1e3 * strain[-1] * height:.1f} mm, and {1e3 * height:.1f} mm high", where=str(path),
            remedy="check the columns, their units and the height",
        )  # fmt: skip
    reach = f"{100 * strain[-1]:.0f} % in {len(strain)} lines"
    keep = (strain >= FIRST_STRAIN) & (strain <= LAST_STRAIN)
    if keep.sum() < FEWEST or strain[-1] < LAST_STRAIN:
        raise InputError(
            f"ends at a compression of {reach}; {100 * LAST_STRAIN:.0f} % are needed", where=str(path),
            remedy="it may be torn, of another size, or count compression as negative and load as positive",
        )  # fmt: skip
    if (np.maximum.accumulate(strain) - strain).max() > BACK:
        raise InputError("is loaded more than once", where=str(path), remedy="give one loading")
    if force[keep].mean() <= 0:
        raise InputError("the load does not push", where=str(path), remedy="count compression and load as positive")
    touched = float(strain[np.flatnonzero(force < TOUCHED * force[keep].max())].max(initial=0.0)) * height
    if touched > latest_touch(height):
        raise InputError(
            f"the load begins at a compression of {1e3 * touched:.1f} mm", where=str(path),
            remedy="count compression from where the platen touches",
        )  # fmt: skip
    step = 5 if keep.sum() > ENOUGH else 1
    return strain[keep][::step], force[keep][::step]


def _column(
    cells: Cells, names: Sequence[str], units: dict[str, float], usual: str
) -> tuple[int, float, tuple[str, str]]:
    """Return which column it is, its unit in SI, and what is taken where none is stated (name, unit), else ("", "")."""
    for k, column in enumerate(cells.columns):
        if column.name.startswith(tuple(names)):
            unit = column.unit or usual
            if unit not in units:
                raise InputError(f"the unit '{unit}' of {names[0]} is not known", where=str(cells.path),
                                 remedy=f"known are {', '.join(units)}")  # fmt: skip
            return k, units[unit], ("", "") if column.unit else (names[0], usual.upper() if usual == "n" else usual)
    raise InputError(f"has no column '{names[0]}'", where=str(cells.path), remedy=f"name a column {' or '.join(names)}")


def _lengths(header: Sequence[str], path: Path) -> dict[str, float]:
    """Return the cylinder's stated lengths (m) by name; raises InputError where one is stated twice differently."""
    found: dict[str, float] = {}
    unit = r"(mm|cm|m|in)"
    for line in header:
        for match in re.finditer(
            rf"(diameter|radius|height|length)\W*?(?:[\[(]\s*{unit}\s*[\])])?[\s:=,;\t]*(\d+(?:[.,]\d+)?)[\s,;\t]*{unit}?\b",
            line, re.IGNORECASE,
        ):  # fmt: skip
            spelt = match[4] or match[2]
            if not spelt:
                continue
            name, value = match[1].lower(), float(match[3].replace(",", ".")) * METRES[spelt.lower()]
            name, value = ("diameter", 2 * value) if name == "radius" else (name, value)
            if abs(found.setdefault(name, value) - value) > 1e-9:
                raise InputError(
                    f"states two values of the {name}", where=str(path), remedy="say --diameter and --height"
                )
    return found


def _stated(header: Sequence[str], path: Path) -> Size:
    """Return the cylinder's size from lines as ``Cylinder Diameter: 50mm;`` or ``Diameter (mm), 50``."""
    found = _lengths(header, path)
    diameter, height = found.get("diameter", np.nan), found.get("height", found.get("length", np.nan))
    if not np.isfinite([diameter, height]).all():
        raise InputError(
            "does not state the cylinder's diameter and height", where=str(path),
            remedy="say --diameter 0.05 --height 0.03, or write 'Diameter: 50mm' and 'Height: 30mm' above the table",
        )  # fmt: skip
    try:
        return Size(diameter / 2, height)
    except InputError as error:
        raise InputError(
            error.what, where=str(path), remedy="correct its header, or say --diameter, --height"
        ) from error


def _other_size(header: Sequence[str], path: Path, size: Size) -> list[str]:
    """Say where a file's header states another size than the one that is taken."""
    try:
        stated = _stated(header, path)
    except InputError:
        return []
    if np.allclose([stated.radius, stated.height], [size.radius, size.height], rtol=1e-6):
        return []
    return [
        f"{path}: its header says diameter {2e3 * stated.radius:g} mm and height {1e3 * stated.height:g} mm, taken are "
        f"{2e3 * size.radius:g} and {1e3 * size.height:g} mm as --diameter and --height say"
    ]


def _specimen(stem: str) -> str:
    """Return the name without the number of the repeat at its end: EF10_A3 is specimen EF10_A; files that are numbers
    alone are repeats of one specimen."""
    return re.sub(r"[_-]?\d+$", "", stem) or "specimen"
