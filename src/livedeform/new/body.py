"""Read what a surface file tells by itself: its unit, how it stands, a sensible element size."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from livedeform.common.errors import InputError
from livedeform.common.experiment.surface import Surface, read_surface
from livedeform.common.types import Array

SMALLEST, LARGEST = 0.005, 1.0  # m: a body of usual size, in one unit or the other
FLAT = 0.02  # of the height: as far as this above the lowest point belongs to a base
BASE_SHARE = 0.02  # of the surface's area that faces down at the lowest point, for a base
TETRAHEDRA = 4000  # that a first mesh has: minutes for a diagnosis
TETRAHEDRON = 1.0 / (6.0 * np.sqrt(2.0))  # volume of a regular one with edge 1


@dataclass(frozen=True)
class NewBody:
    """A surface in metres, and what can be seen of it: ``unit`` of the file, ``base`` (m) the height up to which it
    stands on something (None: it has no flat base), ``element_size`` m."""

    file: Path
    unit: str
    surface: Surface
    base: float | None
    element_size: float

    @property
    def size(self) -> Array:
        """Extents (3,) m."""
        return self.surface.upper - self.surface.lower


def read_new_body(file: Path, unit: str | None) -> NewBody:
    """Read the surface; ``InputError`` where its unit cannot be told from its size and is not given."""
    if not file.is_file():
        raise InputError("the surface does not exist", where=str(file), remedy="name an STL, OBJ or PLY file")
    raw = read_surface(file, "m")
    known = unit or _unit_of(raw, file)
    surface = raw if known == "m" else read_surface(file, known)
    size = float((surface.upper - surface.lower).max())
    if not 0.003 <= size <= 3.0:
        other = {"m": "mm", "mm": "m"}[known]
        raise InputError(f"in {known} the body is {size:.4g} m across", where=str(file), remedy=f"try --unit {other}")
    return NewBody(file, known, surface, _base_of(surface), _element_size(surface))


def _unit_of(raw: Surface, file: Path) -> str:
    across = float((raw.upper - raw.lower).max())
    fits = [unit for unit, factor in (("m", 1.0), ("mm", 1e-3)) if SMALLEST <= across * factor <= LARGEST]
    if len(fits) != 1:
        what = f"is {across:.4g} across, and its unit cannot be told from that"
        raise InputError(what, where=str(file), remedy="say it with --unit m or --unit mm")
    return fits[0]


def _base_of(surface: Surface) -> float | None:
    """The height (m) just above a flat base at the lowest point; None where little of the surface faces down there."""
    corners = surface.corners
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(normals, axis=1) / 2.0
    height = surface.upper[2] - surface.lower[2]
    low = corners[:, :, 2].max(axis=1) <= surface.lower[2] + FLAT * height
    down = normals[:, 2] < -0.9 * np.maximum(2.0 * areas, 1e-30)
    if areas[low & down].sum() < BASE_SHARE * areas.sum():
        return None
    return float(surface.lower[2] + FLAT * height)


def _element_size(surface: Surface) -> float:
    """The edge h (m) of a mesh with about ``TETRAHEDRA`` tetrahedra, V = n h^3 / (6 sqrt 2), to two digits."""
    h = (surface.volume / (TETRAHEDRA * TETRAHEDRON)) ** (1.0 / 3.0)
    return float(f"{h:.2g}")
