"""From a phantom's surface to tetrahedra: the one place that knows pytetwild."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import chdir
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal, Protocol

import meshio
import numpy as np

from livedeform.common.errors import MeshError
from livedeform.common.types import Array
from livedeform.fem_node.mesh import cache as mesh_cache
from livedeform.fem_node.mesh.quality import MeshReport, check_mesh
from livedeform.fem_node.mesh.structured import ball_mesh, block_mesh, cylinder_mesh, hemi_ellipsoid_mesh
from livedeform.fem_node.mesh.surface import METRES, Surface, check_size, read_surface, repair_surface
from livedeform.fem_node.mesh.tet_mesh import IntArray, Location, TetMesh, locate, tet_volumes

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
    "read_mesh",
    "read_surface",
    "remeshed",
    "tet_volumes",
    "tetrahedralise",
    "write_mesh",
]

MESHING_VERSION = 1  # part of the cache's key: raise it when the same surface would give another mesh
ENVELOPE = 1.0 / 40.0  # the mesh stays within this share of an element of the surface: 0.15 mm for 6 mm
OFF_SURFACE = 0.35  # ... and is refused when it is off by more than this share of an element anyway
OFF_VOLUME = 0.03  # ... or its volume is off by this share
WORST_DIHEDRAL_DEG = 2.0  # flatter tetrahedra than this spoil the solution

Progress = Callable[[str], None]


class PhantomMesh(Protocol):
    """What meshing needs of ``experiment.phantom``: a surface or a mesh, its unit, and the element size (m)."""

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
        mesh = read_mesh(phantom.mesh, phantom.unit)
        return mesh, check_mesh(mesh)
    if phantom.surface is None:
        raise MeshError("there is neither a surface nor a mesh", where="phantom", remedy="name phantom.surface")
    vertices, triangles = read_surface(phantom.surface, phantom.unit)
    folder = cache_dir or mesh_cache.default_cache_dir()
    key = mesh_cache.content_key(vertices, triangles, _parameters(phantom.element_size))
    kept = mesh_cache.load(folder, key)
    if kept is None:
        tell(f"meshing {phantom.surface} at {1e3 * phantom.element_size:g} mm; this can take minutes, and is kept")
        surface = repair_surface(vertices, triangles, phantom.element_size, str(phantom.surface))
        mesh = _mesh_surface(surface, phantom.element_size, str(phantom.surface))
        mesh_cache.save(folder, key, mesh, surface.repairs)
        kept = mesh, surface.repairs
    mesh, repairs = kept
    report = check_mesh(mesh, (vertices, triangles), repairs)
    for line in report.lines():
        tell(line)
    return mesh, report


def tetrahedralise(vertices: Array, triangles: IntArray, element_size: float, *, repair: bool = True) -> TetMesh:
    """Tetrahedra of the body inside a surface (vertices (n, 3) m, triangles (k, 3)); no cache. ``MeshError`` if not.

    ``repair``: as a scan. A mesh's boundary is sound, and its edges, few triangles apart, would be taken for noise.
    """
    vertices, triangles = np.asarray(vertices, float), np.asarray(triangles, np.int64)
    surface = repair_surface(vertices, triangles, element_size) if repair else Surface(vertices, triangles)
    return _mesh_surface(surface, element_size, "")


def remeshed(
    mesh: TetMesh, element_size: float, parameters: Mapping[str, object], progress: Progress | None = None
) -> TetMesh:
    """Mesh the same body with elements of another size (m), and keep the result by its surface and the ``parameters``
    that it depends on. ``MeshError`` if the mesher cannot."""
    used, triangles = np.unique(mesh.boundary_triangles, return_inverse=True)
    vertices, triangles = mesh.nodes[used], triangles.reshape(-1, 3)
    folder = mesh_cache.default_cache_dir()
    key = mesh_cache.content_key(vertices, triangles, parameters)
    kept = mesh_cache.load(folder, key)
    if kept is not None:
        return kept[0]
    if progress is not None:
        progress(f"meshing the body with elements of {1e3 * element_size:.1f} mm; the mesh is kept")
    other = tetrahedralise(vertices, triangles, element_size, repair=False)
    mesh_cache.save(folder, key, other, ())
    return other


def _parameters(element_size: float) -> dict[str, object]:
    return {
        "element_size": element_size,
        "envelope": ENVELOPE,
        "version": MESHING_VERSION,
        "pytetwild": version("pytetwild"),
    }


def _mesh_surface(surface: Surface, element_size: float, where: str) -> TetMesh:
    """Run fTetWild (Hu et al. 2020) and accept the result only if it is the body that was asked for.

    fTetWild draws random numbers without a seed: two runs differ. What must repeat comes from the cache or a mesh file.
    """
    import pytetwild  # slow to import, and only needed when a mesh is not kept yet

    diagonal = float(np.linalg.norm(np.ptp(surface.vertices, axis=0)))
    if element_size > 0.5 * diagonal:
        raise MeshError(
            f"elements of {1e3 * element_size:g} mm are too large for a body {1e3 * diagonal:.1f} mm across",
            where="phantom.element_size",
            remedy=f"use {diagonal / 20:.2g} m or so",
        )
    with TemporaryDirectory() as scratch, chdir(scratch):  # fTetWild leaves its tracked surface where it stands
        nodes, tets = pytetwild.tetrahedralize(
            surface.vertices,
            surface.triangles.astype(np.int32),
            edge_length_abs=element_size,
            epsilon=ENVELOPE * element_size / diagonal,
            quiet=True,
        )
    if len(tets) == 0:
        raise MeshError("the mesher found no inside", where=where, remedy="check that the surface is closed")
    mesh = TetMesh.oriented(nodes, np.asarray(tets, np.int64))
    _accept(check_mesh(mesh, (surface.vertices, surface.triangles)), element_size, where)
    return mesh


def _accept(report: MeshReport, element_size: float, where: str) -> None:
    if report.surface_distance_max > OFF_SURFACE * element_size:
        raise MeshError(
            f"the mesh is up to {1e3 * report.surface_distance_max:.2f} mm off the surface",
            where=where,
            remedy="mend self-intersections and inner walls of the surface, or use smaller elements",
        )
    if not abs(report.volume / report.surface_volume - 1.0) < OFF_VOLUME:
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
    """Tetrahedra of a VTK, gmsh, abaqus, ... file (meshio); of quadratic ones the corners."""
    path = Path(path)
    if not path.is_file():
        raise MeshError("there is no such file", where=str(path), remedy="phantom.mesh names a vtu, msh or inp file")
    try:
        loaded = meshio.read(path)
    except (meshio.ReadError, SystemExit, ValueError, KeyError, IndexError, OSError) as error:
        raise MeshError(f"it cannot be read as a mesh ({error})", where=str(path), remedy="write it again") from error
    blocks = [block.data[:, :4] for block in loaded.cells if block.type in ("tetra", "tetra10")]
    others = sorted({b.type for b in loaded.cells} - {"tetra", "tetra10", "triangle", "triangle6", "line", "vertex"})
    if not blocks or others:
        raise MeshError(
            f"it holds {', '.join(others) or 'no tetrahedra'}", where=str(path), remedy="export tetrahedra alone"
        )
    nodes = np.asarray(loaded.points, float) * METRES[unit]
    check_size(nodes, path, unit)
    try:
        return TetMesh.oriented(nodes, np.concatenate(blocks).astype(np.int64))
    except MeshError as error:
        raise MeshError(error.what, where=str(path), remedy=error.remedy) from error


def write_mesh(path: Path, mesh: TetMesh) -> None:
    """Write a mesh in the format of the file's ending (vtu opens in ParaView), metres."""
    meshio.write(path, meshio.Mesh(mesh.nodes, [("tetra", mesh.tets)]))
