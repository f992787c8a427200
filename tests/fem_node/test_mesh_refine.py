"""Smaller elements where they are wanted: the same body, sound elements, nothing changed elsewhere."""

from __future__ import annotations

import numpy as np

from livedeform.fem_node.mesh.refine import refined
from livedeform.fem_node.mesh.structured import block_mesh, hemi_ellipsoid_mesh


def volumes(mesh) -> np.ndarray:
    corners = mesh.nodes[mesh.tets]
    return np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6.0


def test_refined_elements_are_smaller_and_the_body_is_the_same():
    mesh = block_mesh((0.08, 0.06, 0.04), (4, 3, 2))
    corner = mesh.nodes.max(axis=0)
    near = np.flatnonzero(np.linalg.norm(mesh.nodes[mesh.tets].mean(axis=1) - corner, axis=1) < 0.02)
    finer = refined(mesh, near)
    assert volumes(finer).min() > 0.0
    assert np.isclose(volumes(finer).sum(), volumes(mesh).sum(), rtol=1e-12)
    centres = finer.nodes[finer.tets].mean(axis=1)
    there = np.linalg.norm(centres - corner, axis=1) < 0.015
    assert volumes(finer)[there].max() <= 0.5 * volumes(mesh).min() + 1e-12
    far = np.linalg.norm(centres - mesh.nodes.min(axis=0), axis=1) < 0.02
    assert np.isclose(volumes(finer)[far].max(), volumes(mesh).max(), rtol=1e-12)
    _, counts = np.unique(np.sort(finer.boundary_triangles, axis=1), axis=0, return_counts=True)
    assert counts.max() == 1


def test_new_vertices_of_a_round_body_are_on_its_arcs():
    """Middles of edges of 10 mm lie 0.3 mm inside a ball of 50 mm; new vertices within 0.009 mm of it."""
    mesh = hemi_ellipsoid_mesh((0.05, 0.05, 0.05), 6)
    finer = refined(mesh, np.arange(len(mesh.tets)))
    assert volumes(finer).min() > 0.0
    new = np.setdiff1d(np.unique(finer.boundary_triangles), np.unique(mesh.boundary_triangles))
    new = new[finer.nodes[new, 2] > 0.015]  # beside the edge of the base the normals are those of one side
    assert len(new) > 50
    assert np.abs(0.05 - np.linalg.norm(finer.nodes[new], axis=1)).max() < 1.5e-5
