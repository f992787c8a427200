"""Make tetrahedra from a phantom's surface: repair it, mesh it, check the mesh against it, and keep the result."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Literal, NamedTuple, Protocol

import meshio
import numpy as np

from livedeform.common.errors import MeshError
from livedeform.common.types import Array
from livedeform.fem_node.mesh import cache as mesh_cache
from livedeform.fem_node.mesh.balanced import balanced
from livedeform.fem_node.mesh.mesher import MesherError, tetrahedra
from livedeform.fem_node.mesh.quality import MeshReport, check_mesh, doubled_nodes
from livedeform.fem_node.mesh.repair.record import Repair
from livedeform.fem_node.mesh.structured import ball_mesh, block_mesh, cylinder_mesh, hemi_ellipsoid_mesh
from livedeform.fem_node.mesh.surface import METRES, Surface, check_size, closed_surface, read_surface, repair_surface
from livedeform.fem_node.mesh.tet_mesh import IntArray, Location, TetMesh, locate, tet_volumes
from livedeform.fem_node.mesh.thickness import thickness_warning, thinnest_part

__all__ = [
    "Location",
    "MeshReport",
    "TetMesh",
    "ball_mesh",
    "block_mesh",
    "check_mesh",
    "cylinder_mesh",
    "hemi_ellipsoid_mesh",
    "load_or_make_mesh",
    "locate",
    "mesh_to_file",
    "mesh_warnings",
    "meshed",
    "prepared",
    "read_mesh",
    "read_surface",
    "remeshed",
    "repairs_of",
    "tet_volumes",
    "tetrahedralise",
    "write_mesh",
]

MESHING_VERSION = 5  # part of the cache's key: raise it when the same surface would give another mesh
ENVELOPES = (1 / 40, 1 / 100, 1 / 250)  # of an element: how far the mesh may leave the surface; the first that serves
OFF_SURFACE = 0.1  # a mesh that is off by more than this share of an element is refused
OFF_VOLUME = 0.003  # ... or its volume by this share
WORST_DIHEDRAL_DEG = 2.0  # flatter tetrahedra than this spoil the solution
GRID = 1e-9  # m: vertices are handed to the mesher on this grid, so that round-off of another machine changes nothing

MOST_NAMED = 8  # material regions in a warning
TETRAHEDRA = ("tetra", "tetra10")
REGIONS = ("gmsh:physical", "medit:ref", "nastran:ref", "avsucd:material", "material", "materialids", "region")

Progress = Callable[[str], None]


class PhantomMesh(Protocol):
    """The part of ``experiment.phantom`` that meshing needs: a surface or a mesh, its unit, and the element size
    (m)."""

    @property
    def surface(self) -> Path | None: ...
    @property
    def mesh(self) -> Path | None: ...
    @property
    def unit(self) -> Literal["m", "mm"]: ...
    @property
    def element_size(self) -> float: ...


def load_or_make_mesh(phantom: PhantomMesh, cache_dir: Path | None = None, progress: Progress | None = None) -> TetMesh:
    """The phantom's tetrahedra: read from its mesh file, or made of its surface (minutes; then kept by content)."""
    return load_or_make(phantom, cache_dir, progress)[0]


def load_or_make(
    phantom: PhantomMesh, cache_dir: Path | None = None, progress: Progress | None = None
) -> tuple[TetMesh, MeshReport]:
    """``load_or_make_mesh`` with its report."""
    tell = progress or (lambda text: None)
    if phantom.mesh is not None:
        mesh, regions = _read(phantom.mesh, phantom.unit)
        report = replace(check_mesh(mesh), regions=regions)
        for line in mesh_warnings(report, report.edge_length_median):
            tell(line)
        return mesh, report
    if phantom.surface is None:
        raise MeshError("there is neither a surface nor a mesh", where="phantom", remedy="name phantom.surface")
    surface = read_surface(phantom.surface, phantom.unit)
    return meshed(*surface, phantom.element_size, cache_dir, tell, str(phantom.surface))


def meshed(
    vertices: Array,
    triangles: IntArray,
    element_size: float,
    cache_dir: Path | None = None,
    tell: Progress = lambda text: None,
    where: str = "the surface",
) -> tuple[TetMesh, MeshReport]:
    """The tetrahedra of a surface (vertices (n, 3) m, triangles (k, 3)) as it was scanned or drawn: repaired, meshed,
    checked and kept by content; and their report against the surface as it was given (closed and turned outward), which
    is also told."""
    vertices, triangles = in_order(vertices, triangles)
    folder = cache_dir or mesh_cache.default_cache_dir()
    key = mesh_cache.content_key(vertices, triangles, _parameters(element_size))
    kept = mesh_cache.load(folder, key, tell)
    if kept is None:
        tell(f"meshing {where} at {1e3 * element_size:g} mm; this can take minutes, and is kept")
        surface = repair_surface(vertices, triangles, element_size, where)
        made = _mesh_surface(surface, element_size, where)
        kept = mesh_cache.Kept(made.mesh, surface.record, made.seeded)
        mesh_cache.save(folder, key, made.mesh, surface.record, seeded=made.seeded)
    given = closed_surface(vertices, triangles, element_size, where)
    report = check_mesh(kept.mesh, (given.vertices, given.triangles), kept.record)
    for line in [*report.lines(), *mesh_warnings(report, element_size, seeded=kept.seeded)]:
        tell(line)
    return kept.mesh, report


def mesh_warnings(report: MeshReport, element_size: float, *, seeded: bool = True) -> list[str]:
    """Return what is to be known before a mesh is trusted, one line each: a surface that its repairs moved by more than
    a mesh may be off, elements too large for the body, a mesher that could not be seeded, and what a mesh file has
    several of: bodies or materials. Nothing if all is well."""
    lines = []
    off, change = report.surface_distance_max, report.volume / report.surface_volume - 1.0
    place = ", ".join(f"{1e3 * c:.1f}" for c in report.farthest)
    if off > OFF_SURFACE * element_size:
        lines.append(
            f"WARN: the body is up to {1e3 * off:.2f} mm off the surface that was given, most at ({place}) mm, over "
            f"{OFF_SURFACE:g} elements: look at its repairs"
        )
    if abs(change) > OFF_VOLUME:
        lines.append(
            f"WARN: the body's volume differs by {100 * change:+.2f} % from that of the surface that was given, over "
            f"{100 * OFF_VOLUME:g} %: look at its repairs"
        )
    lines += thickness_warning(report.thickness, element_size)
    if not seeded:
        lines.append("WARN: this mesher cannot be seeded: meshed again, this body gets other elements")
    if report.n_bodies > 1 and np.isnan(report.surface_volume):  # those of a surface are among its repairs
        lines.append(
            f"WARN: the mesh is {report.n_bodies} bodies that nothing holds together: what presses one leaves the "
            "others where they are; if they are one body, mesh it as one"
        )
    if len(report.regions) > 1:
        names = ", ".join(report.regions[:MOST_NAMED]) + (", ..." if len(report.regions) > MOST_NAMED else "")
        lines.append(
            f"WARN: the mesh has {len(report.regions)} material regions ({names}), and all get the one "
            "phantom.material; say as effects (inclusion, skin) what is stiffer or softer"
        )
    return lines


class Prepared(NamedTuple):
    """A body before it is meshed: the ``record`` of its surface's repairs, and ``warnings``, one
    line each."""

    record: tuple[Repair, ...]
    warnings: list[str]


def prepared(phantom: PhantomMesh) -> Prepared:
    """Repair the phantom's surface as meshing would, and look at its thickness (seconds); of a mesh file, only that.
    ``MeshError`` as meshing would raise it."""
    if phantom.mesh is not None or phantom.surface is None:
        report = load_or_make(phantom)[1]
        return Prepared((), mesh_warnings(report, report.edge_length_median))
    given = in_order(*read_surface(phantom.surface, phantom.unit))
    surface = repair_surface(*given, phantom.element_size, str(phantom.surface))
    thickness = thinnest_part(surface.vertices, surface.triangles)
    return Prepared(surface.record, thickness_warning(thickness, phantom.element_size))


def repairs_of(phantom: PhantomMesh) -> tuple[Repair, ...]:
    """Return what is done to the phantom's surface before it is meshed; nothing to a mesh."""
    return prepared(phantom).record


def in_order(vertices: Array, triangles: IntArray) -> tuple[Array, IntArray]:
    """The same surface, triangles in the order of their vertices: a file that lists them in another gives one mesh."""
    first = triangles.argmin(axis=1)
    turned = np.take_along_axis(triangles, (first[:, None] + np.arange(3)) % 3, axis=1)
    return vertices, turned[np.lexsort(turned.T[::-1])]


def tetrahedralise(vertices: Array, triangles: IntArray, element_size: float, *, repair: bool = True) -> TetMesh:
    """Tetrahedra of the body inside a surface (vertices (n, 3) m, triangles (k, 3)); no cache. ``MeshError`` if not.

    ``repair``: as a scan; a mesh's boundary is sound.
    """
    vertices, triangles = np.asarray(vertices, float), np.asarray(triangles, np.int64)
    surface = repair_surface(vertices, triangles, element_size) if repair else Surface(vertices, triangles)
    return _mesh_surface(surface, element_size, "").mesh


def remeshed(
    mesh: TetMesh, element_size: float, parameters: Mapping[str, object], progress: Progress | None = None
) -> TetMesh:
    """Mesh the same body with elements of another size (m), and keep the result by its surface and the ``parameters``
    that it depends on. ``MeshError`` if the mesher cannot."""
    used, triangles = np.unique(mesh.boundary_triangles, return_inverse=True)
    vertices, triangles = mesh.nodes[used], triangles.reshape(-1, 3)
    folder = mesh_cache.default_cache_dir()
    key = mesh_cache.content_key(vertices, triangles, {**_parameters(element_size), **parameters})
    kept = mesh_cache.load(folder, key, progress or (lambda text: None))
    if kept is not None:
        return kept.mesh
    if progress is not None:
        progress(f"meshing the body with elements of {1e3 * element_size:.1f} mm; the mesh is kept")
    other = tetrahedralise(vertices, triangles, element_size, repair=False)
    mesh_cache.save(folder, key, other, ())
    return other


def mesh_to_file(vertices: Array, triangles: IntArray, element_size: float, path: Path) -> None:
    """Write the tetrahedra of the body inside a surface (vertices (n, 3) m, triangles (k, 3)) to a mesh file."""
    write_mesh(path, tetrahedralise(vertices, triangles, element_size))


def _parameters(element_size: float) -> dict[str, object]:
    return {
        "element_size": element_size,
        "envelopes": ENVELOPES,
        "version": MESHING_VERSION,
        "pytetwild": version("pytetwild"),
    }


class _Made(NamedTuple):
    mesh: TetMesh
    seeded: bool


def _mesh_surface(surface: Surface, element_size: float, where: str) -> _Made:
    """Mesh a sound surface and accept the result only if it is the body that was asked for, in an envelope that is made
    tighter until it is."""
    diagonal = float(np.linalg.norm(np.ptp(surface.vertices, axis=0)))
    if element_size > 0.5 * diagonal:
        raise MeshError(
            f"elements of {1e3 * element_size:g} mm are too large for a body {1e3 * diagonal:.1f} mm across",
            where="phantom.element_size",
            remedy=f"use {diagonal / 20:.2g} m or so",
        )
    vertices = GRID * np.round(surface.vertices / GRID)
    refused = MeshError("no envelope was tried", where=where)
    for envelope in ENVELOPES:
        try:
            made = tetrahedra(vertices, surface.triangles, element_size, envelope * element_size)
        except MesherError as error:
            raise MeshError(f"the mesher failed ({error})", where=where, remedy="mend the surface") from error
        try:
            if len(made.tets) == 0:
                raise _without_inside(surface, element_size, where)
            return _Made(_accepted(TetMesh.oriented(made.nodes, made.tets), surface, element_size, where), made.seeded)
        except MeshError as error:
            refused = error
    raise refused


def _accepted(mesh: TetMesh, surface: Surface, element_size: float, where: str) -> TetMesh:
    """Return the mesh, with its boundary balanced if it keeps to the surface and only its volume is off; `MeshError` if
    it is not the body that was asked for."""
    given = surface.vertices, surface.triangles
    report = check_mesh(mesh, given)
    if report.surface_distance_max <= OFF_SURFACE * element_size and not _holds(report):
        with suppress(MeshError):  # an element would be turned inside out
            mesh = balanced(mesh, *given)
            report = check_mesh(mesh, given)
    _accept(report, element_size, where)
    return mesh


def _holds(report: MeshReport) -> bool:
    """Tell whether a mesh has the volume of its surface."""
    return abs(report.volume / report.surface_volume - 1.0) < OFF_VOLUME


def _without_inside(surface: Surface, element_size: float, where: str) -> MeshError:
    """The error of a body that the mesher found nothing in, as of one much thinner than its elements."""
    thin = thinnest_part(surface.vertices, surface.triangles).thinnest
    return MeshError(
        f"the mesher found no inside: at its thinnest the body is {1e3 * thin:.2g} mm, with elements of "
        f"{1e3 * element_size:g} mm",
        where=where,
        remedy=f"use elements of {1e3 * thin / 3.0:.2g} mm, or check that the surface is closed and looks outward",
    )


def _accept(report: MeshReport, element_size: float, where: str) -> None:
    if report.surface_distance_max > OFF_SURFACE * element_size:
        raise MeshError(
            f"the mesh is up to {1e3 * report.surface_distance_max:.2f} mm off the surface, most at "
            f"{[round(c, 4) for c in report.farthest]}",
            where=where,
            remedy="mend self-intersections and inner walls of the surface, or use smaller elements",
        )
    if not _holds(report):
        raise MeshError(
            f"the mesh holds {1e6 * report.volume:.2f} cm3 and the surface {1e6 * report.surface_volume:.2f} cm3",
            where=where,
            remedy="mend self-intersections and overlapping pieces of the surface",
        )
    if report.dihedral_min_deg < WORST_DIHEDRAL_DEG:
        raise MeshError(
            f"the flattest tetrahedron has an angle of {report.dihedral_min_deg:.2f} degrees",
            where=where,
            remedy="use another element size, or smooth the surface",
        )


def read_mesh(path: Path, unit: Literal["m", "mm"] = "m") -> TetMesh:
    """Tetrahedra of a VTK, gmsh, abaqus, ... file (meshio); of quadratic ones the corners. ``MeshError`` where bodies
    of it have the same places, but no nodes, in common."""
    return _read(Path(path), unit)[0]


def _read(path: Path, unit: Literal["m", "mm"]) -> tuple[TetMesh, tuple[str, ...]]:
    """Read a file's tetrahedra, and the names of its material regions."""
    if not path.is_file():
        raise MeshError("there is no such file", where=str(path), remedy="phantom.mesh names a vtu, msh or inp file")
    cards = _cards(path)
    parts = sum(card.split(",")[0].strip() == "*NODE" for card in cards)
    if parts > 1:  # meshio keeps the nodes of the last one, for the elements of all
        raise MeshError(
            f"it has {parts} lists of nodes, as several parts have, and one alone can be read",
            where=str(path),
            remedy="merge the parts into one, with their coincident nodes, and export that",
        )
    try:
        loaded = meshio.read(path)
    except (meshio.ReadError, SystemExit, ValueError, KeyError, IndexError, OSError) as error:
        raise MeshError(f"it cannot be read as a mesh ({error})", where=str(path), remedy="write it again") from error
    blocks = [block.data[:, :4] for block in loaded.cells if block.type in TETRAHEDRA]
    others = sorted({b.type for b in loaded.cells} - {*TETRAHEDRA, "triangle", "triangle6", "line", "vertex"})
    if not blocks or others:
        raise MeshError(
            f"it holds {', '.join(others) or 'no tetrahedra'}", where=str(path), remedy="export tetrahedra alone"
        )
    nodes = np.asarray(loaded.points, float) * METRES[unit]
    check_size(nodes, path, unit)
    try:
        mesh = TetMesh.oriented(nodes, np.concatenate(blocks).astype(np.int64))
    except MeshError as error:
        raise MeshError(error.what, where=str(path), remedy=error.remedy) from error
    _refuse_doubled(mesh, path)
    return mesh, _regions(loaded, cards)


def _cards(path: Path) -> list[str]:
    """Return an Abaqus file's lines of keywords in capitals; nothing of another file's."""
    if path.suffix.lower() != ".inp":
        return []
    return [line.strip().upper() for line in path.read_text(errors="replace").splitlines() if line.startswith("*")]


def _refuse_doubled(mesh: TetMesh, path: Path) -> None:
    """``MeshError`` where a boundary between two bodies has its nodes twice: they would be solved as if apart."""
    doubled = doubled_nodes(mesh)
    if len(doubled):
        place = ", ".join(f"{c:.1f}" for c in np.round(1e3 * mesh.nodes[doubled[0]], 1) + 0.0)
        raise MeshError(
            f"it is several bodies that touch without a common node: {len(doubled)} nodes lie on one of another body, "
            f"as at ({place}) mm, and nothing holds them together",
            where=str(path),
            remedy="merge coincident nodes in the mesher (gmsh: Coherence Mesh;)",
        )


def _regions(loaded: meshio.Mesh, cards: list[str]) -> tuple[str, ...]:
    """Return the names of the materials of an Abaqus file, or of the regions that tetrahedra of another are in."""
    found = set(re.findall(r"^\*SOLID SECTION\b.*\bMATERIAL\s*=\s*([^,\n]*\w)", "\n".join(cards), re.MULTILINE))
    physical = loaded.field_data if "gmsh:physical" in loaded.cell_data else {}
    names = {int(tag): name for name, (tag, dimension) in physical.items() if dimension == 3}
    for data in (d for name, d in loaded.cell_data.items() if name.lower() in REGIONS):
        rows = (np.unique(d) for d, block in zip(data, loaded.cells, strict=True) if block.type in TETRAHEDRA)
        found |= {names.get(tag, f"{tag:g}") for row in rows for tag in row.tolist()}
    return tuple(sorted(found))


def write_mesh(path: Path, mesh: TetMesh) -> None:
    """Write a mesh in the format of the file's ending (vtu opens in ParaView), metres."""
    meshio.write(path, meshio.Mesh(mesh.nodes, [("tetra", mesh.tets)]))
