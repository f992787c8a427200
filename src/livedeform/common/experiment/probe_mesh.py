"""The surface of a probe as triangles in the frame ``probe``, for pictures and viewers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from livedeform.common.experiment.schema import Probe
from livedeform.common.experiment.surface import read_surface
from livedeform.common.types import Array

AROUND = 48  # corners of a circle
CORNER = 2  # subdivisions of the ball that rounds a corner


def probe_mesh(probe: Probe) -> tuple[Array, NDArray[np.int64]]:
    """Vertices (n, 3) m and outward triangles (k, 3) of the probe; everything lies at z <= 0."""
    import trimesh

    shape, r = probe.shape, probe.edge_radius
    if shape.mesh is not None:
        surface = read_surface(shape.mesh)
        return surface.vertices, surface.triangles
    if shape.sphere is not None:
        mesh = trimesh.creation.icosphere(subdivisions=3, radius=shape.sphere)
        mesh.apply_translation((0.0, 0.0, -shape.sphere))
    elif shape.cylinder is not None:
        mesh = trimesh.creation.revolve(_profile(*shape.cylinder, r), sections=AROUND)
    else:
        assert shape.box is not None  # schema
        mesh = _rounded_box(shape.box, r)
    return np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64)


def _profile(radius: float, height: float, r: float) -> Array:
    """The half section (rho, z) (n, 2) m of a cylinder with rims rounded by ``r``."""
    turn = np.linspace(0.0, np.pi / 2, 7 if r else 1)
    low = np.column_stack([radius - r + r * np.sin(turn), -height + r - r * np.cos(turn)])
    high = low[::-1] * (1.0, -1.0) + (0.0, -height)
    return np.vstack([[0.0, -height], low, high, [0.0, 0.0]])


def _rounded_box(size: tuple[float, float, float], r: float):  # type: ignore[no-untyped-def]
    """The convex hull of balls of radius ``r`` in the corners of a box that is smaller by ``r``."""
    import trimesh

    half = np.array(size) / 2.0
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    corners = signs * (half - r) - (0.0, 0.0, half[2])
    if r == 0:
        return trimesh.convex.convex_hull(corners)
    ball = trimesh.creation.icosphere(subdivisions=CORNER, radius=r).vertices
    return trimesh.convex.convex_hull((corners[:, None] + ball[None]).reshape(-1, 3))
