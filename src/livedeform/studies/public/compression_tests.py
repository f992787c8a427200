"""Read compression tests of cylinders: size and specimen from the header, an option or the file's name."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from livedeform.common.errors import InputError
from livedeform.common.types import Array

FIRST_STRAIN, LAST_STRAIN = 0.02, 0.39  # below, the specimen is still being seated; above, the mesh is not good
FEWEST = 20  # lines of a test
ENOUGH = 400  # lines: of more, every fifth is taken
METRES = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "in": 0.0254}
NEWTONS = {"n": 1.0, "kn": 1e3, "mn": 1e-3}


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
    """One test: ``strain`` (n,) nominal compression, ``force`` (n,) N, the cylinder's ``radius`` and ``height`` m, and
    which ``specimen`` it is a repeat of."""

    name: str
    strain: Array
    force: Array
    radius: float
    height: float
    specimen: str = ""

    @property
    def stress(self) -> Array:
        """Nominal stress (n,) Pa."""
        return self.force / (np.pi * self.radius**2)

    @property
    def shape(self) -> float:
        """Radius over height, rounded: cylinders of one shape have one curve."""
        return round(self.radius / self.height, 6)


def read_materials(folder: Path, size: Size | None = None) -> tuple[dict[str, list[Specimen]], list[str]]:
    """Return the tests of every material (a folder of ``*.csv``, or ``folder`` itself), and a line about each file
    that cannot be used; ``InputError`` where none can."""
    if not folder.is_dir():
        raise InputError("is no folder", where=str(folder), remedy="name the folder of the tests")
    homes = [p for p in sorted(folder.iterdir()) if p.is_dir() and any(p.glob("*.csv"))]
    if any(folder.glob("*.csv")):
        homes.insert(0, folder)
    materials: dict[str, list[Specimen]] = {}
    dropped: list[str] = []
    for home in homes:
        for path in sorted(home.glob("*.csv")):
            try:
                test = read(path, size)
            except InputError as error:
                dropped.append(str(error))
                continue
            known = materials.setdefault(home.name, [])
            if known and known[0].shape != test.shape:
                dropped.append(f"{path}: its shape is not that of {known[0].name}; give it a folder of its own")
            else:
                known.append(test)
    materials = {name: tests for name, tests in materials.items() if tests}
    if not materials:
        why = f" ({dropped[0]})" if dropped else ""
        raise InputError(f"no *.csv file can be used{why}", where=str(folder), remedy="one folder per material")
    return materials, dropped


def read(path: Path, size: Size | None = None) -> Specimen:
    """One test: header lines, then columns of which one is a compression or displacement and one a load or force.

    ``size`` is taken rather than what the header says.
    """
    lines = path.read_text(errors="replace").splitlines()
    first = next((k for k, line in enumerate(lines) if line.strip().lower().startswith("time")), None)
    if first is None:
        raise InputError("has no line that begins with 'Time'", where=str(path), remedy="name the tests' CSV files")
    moved, length = _column(lines[first], ("compression", "displacement", "extension"), METRES, "mm", path)
    pushed, load = _column(lines[first], ("load", "force"), NEWTONS, "n", path)
    stated = size if size is not None else _stated(lines[:first], path)
    try:
        table = np.loadtxt(lines[first + 1 :], delimiter=",", usecols=(moved, pushed), ndmin=2)
    except (ValueError, IndexError) as error:
        raise InputError(f"is torn ({error})", where=str(path), remedy="get the file again") from error
    strain = table[:, 0] * length / stated.height
    keep = (strain >= FIRST_STRAIN) & (strain <= LAST_STRAIN)
    if keep.sum() < FEWEST or strain.max(initial=0.0) < LAST_STRAIN:
        reach = f"{100 * strain.max(initial=0.0):.0f} % in {len(strain)} lines"
        raise InputError(
            f"ends at a compression of {reach}; {100 * LAST_STRAIN:.0f} % are needed",
            where=str(path),
            remedy="get the file again, it may be torn",
        )
    step = 5 if keep.sum() > ENOUGH else 1
    force = table[keep, 1][::step] * load
    if force.mean() <= 0:
        raise InputError("the load does not push", where=str(path), remedy="count compression and load as positive")
    return Specimen(path.stem, strain[keep][::step], force, stated.radius, stated.height, _specimen(path.stem))


def _column(line: str, names: Sequence[str], units: dict[str, float], usual: str, path: Path) -> tuple[int, float]:
    """Return which column it is, and its unit in SI."""
    for k, cell in enumerate(line.split(",")):
        text = cell.strip().lower()
        if any(text.startswith(n) for n in names):
            found = re.search(r"[(\[]\s*(\w+)\s*[)\]]", text)
            unit = found[1] if found else usual
            if unit not in units:
                raise InputError(f"the unit '{unit}' of {names[0]} is not known", where=str(path),
                                 remedy=f"known are {', '.join(units)}")  # fmt: skip
            return k, units[unit]
    raise InputError(f"has no column '{names[0]}'", where=str(path), remedy=f"name a column {' or '.join(names)}")


def _stated(header: Sequence[str], path: Path) -> Size:
    """Return the cylinder's size from lines as ``Cylinder Diameter: 50mm;``."""
    found = {}
    for line in header:
        match = re.search(r"(diameter|radius|height|length)\W*?[:=,]?\s*([\d.]+)\s*(mm|cm|m|in)\b", line, re.IGNORECASE)
        if match:
            found[match[1].lower()] = float(match[2]) * METRES[match[3].lower()]
    radius = found.get("radius", found.get("diameter", np.nan) / 2)
    height = found.get("height", found.get("length", np.nan))
    if not np.isfinite([radius, height]).all():
        raise InputError(
            "does not state the cylinder's diameter and height", where=str(path),
            remedy="say --diameter 0.05 --height 0.03, or write 'Diameter: 50mm' and 'Height: 30mm' above the table",
        )  # fmt: skip
    return Size(float(radius), float(height))


def _specimen(stem: str) -> str:
    """Return the name without the number of the repeat at its end: EF10_A3 is specimen EF10_A."""
    return re.sub(r"[_-]?\d+$", "", stem) or stem
