"""Refine a body's mesh where it wants smaller elements: where a probe presses, where a bond ends, where a modulus
jumps."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from livedeform.common.experiment.smooth_surface import CREASE
from livedeform.common.types import Array
from livedeform.fem_node.element.element import ElementKind, make_space
from livedeform.fem_node.items.loads import facets_in
from livedeform.fem_node.items.supports import held_facets
from livedeform.fem_node.mesh.refine import refined
from livedeform.fem_node.mesh.tet_mesh import TetMesh
from livedeform.fem_node.physics.record import BodyShape, Physics, bind_fields

__all__ = ["flatness", "jumps", "pressed_facets", "refined", "with_finer_edges"]

JUMP = 1.5  # of the modulus within an element, from which it is uneven
REACH = 0.5  # of the depth in the middle: a ball's contact reaches as far as it would be so deep in it (Hertz 1882)


def pressed_facets(mesh: TetMesh, physics: Physics, poses: Sequence[Array | None]) -> NDArray[np.bool_]:
    """Return which boundary triangles (k,) of the mesh the probe presses at one of the poses (4, 4)."""
    centres = mesh.nodes[mesh.boundary_triangles].mean(axis=1)
    inside = np.zeros(len(centres), bool)
    for pose in poses:
        if physics.probe is not None and pose is not None:
            distance = physics.probe.shape.distance((centres - pose[:3, 3]) @ pose[:3, :3])[0]
            depth = np.maximum(-distance, 0.0)
            inside |= depth > REACH * depth.max()
    return inside


def with_finer_edges(
    mesh: TetMesh, element: ElementKind, physics: Physics, poses: Sequence[Array | None], times: int
) -> TetMesh:
    """Return the mesh with those elements halved some ``times`` that have an edge where the body's bond ends, where
    stresses have no bound, where a load acts, or where the probe presses at one of the poses (4, 4)."""
    for _ in range(times):
        triangles, space = mesh.boundary_triangles, make_space(mesh, element)
        held, pressed = held_facets(space, physics), pressed_facets(mesh, physics, poses)
        for load in physics.loads:
            pressed[facets_in(space, load.region)] = True
        rim = np.intersect1d(triangles[held], triangles[~held])
        under = np.unique(triangles[pressed])
        edges = [np.isin(mesh.tets, vertices).sum(axis=1) >= 2 for vertices in (rim, under)]
        mesh = refined(mesh, np.flatnonzero(np.any(edges, axis=0)))
    return mesh


def jumps(mesh: TetMesh, physics: Physics) -> NDArray[np.bool_]:
    """Return in which elements (n,) the modulus differs by more than `JUMP`."""
    shape = BodyShape(mesh.nodes, mesh.boundary_triangles, np.zeros(len(mesh.boundary_triangles), bool))
    fields = bind_fields(physics.modulus_fields, shape)
    if not fields:
        return np.zeros(len(mesh.tets), bool)
    steps = np.array([w for w in np.ndindex(5, 5, 5, 5) if sum(w) == 4]) / 4.0
    places = np.einsum("qa,mad->mqd", steps, mesh.nodes[mesh.tets])
    factor = np.prod([f(places.reshape(-1, 3), 0.0) for f in fields], axis=0).reshape(places.shape[:2])
    return np.asarray(factor.max(axis=1) > JUMP * factor.min(axis=1))


def flatness(mesh: TetMesh, pressed: NDArray[np.bool_]) -> float:
    """Return how far (m, mean) flat triangles of ``pressed`` (k,) are from the smooth surface through their corners:
    h^2/8R of a ball; its curvature 1 / R is the angle between neighbours over the distance of their centres."""
    import trimesh

    surface = trimesh.Trimesh(mesh.nodes, mesh.boundary_triangles[pressed], process=False)
    smooth = surface.face_adjacency_angles < CREASE
    if not smooth.any():
        return 0.0
    pairs = surface.face_adjacency[smooth]
    away = np.linalg.norm(np.diff(surface.triangles_center[pairs], axis=1)[:, 0], axis=1)
    size2 = 4.0 / np.sqrt(3.0) * surface.area_faces[pairs].mean(axis=1)  # of an equilateral triangle
    return float(np.mean(surface.face_adjacency_angles[smooth] / away * size2 / 8.0))
