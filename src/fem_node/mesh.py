"""From a surface to tetrahedra: the one place that knows pytetwild."""

from __future__ import annotations

from fem_node.mesh_shapes import ball_mesh, block_mesh, cylinder_mesh, hemi_ellipsoid_mesh
from fem_node.tet_mesh import Location, TetMesh, locate, tet_volumes

__all__ = [
    "Location",
    "TetMesh",
    "ball_mesh",
    "block_mesh",
    "cylinder_mesh",
    "hemi_ellipsoid_mesh",
    "locate",
    "tet_volumes",
]
