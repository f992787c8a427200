"""Place the markers of a scenario on and in its body, where its cameras see them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from livedeform.common.errors import InputError
from livedeform.common.types import Array
from livedeform.synthetic.measuring.refraction import BodySurface
from livedeform.synthetic.rig import Rig, stereo_rig
from livedeform.synthetic.truth import hexmesh

NEAR = 0.008  # m, within which a surface has a point of its mesh
REFRACTS = 0.0017  # m, between places at which the surface that refracts is known, at rest
SURFACE_CUTS = 20  # of a face's side into triangles: a flat one of 0.6 mm lies 1 um below a surface of 45 mm radius


@dataclass(frozen=True)
class BodyMarkers:
    """Markers of the truth's mesh: surface ones by face and weights, internal ones as nodes, support ones fixed in
    space."""

    faces: NDArray[np.int64]
    weights: Array
    nodes: NDArray[np.int64]
    support: Array
    mesh: hexmesh.HexMesh

    @property
    def kinds(self) -> tuple[str, ...]:
        n = (len(self.faces), len(self.nodes), len(self.support))
        return ("surface",) * n[0] + ("internal",) * n[1] + ("support",) * n[2]

    def places(self, x: Array) -> Array:
        """(n, 3) m for the mesh's places ``x``."""
        surface = np.einsum("pa,pad->pd", self.weights, x[self.mesh.faces[self.faces]])
        return np.vstack([surface, x[self.nodes], self.support])

    def normals(self, x: Array) -> Array:
        """(n, 3) outward; of internal and support markers upward."""
        local = np.array([[-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0]])
        p = np.einsum("qa,fad->fqd", hexmesh.face_shape(local), x[self.mesh.faces[self.faces]])
        normal = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        return np.vstack([normal, np.tile([0.0, 0.0, 1.0], (len(self.nodes) + len(self.support), 1))])

    def surface(self, x: Array) -> BodySurface:
        """Return the body's surface for the mesh's places ``x``."""
        weights, faces, triangles = self._cut
        places = np.einsum("pa,pad->pd", weights, x[self.mesh.faces[faces]])
        return BodySurface(places, hexmesh.point_normals(places, triangles))

    @cached_property
    def _cut(self) -> tuple[Array, NDArray[np.int64], NDArray[np.int64]]:
        corners = self.mesh.nodes[self.mesh.faces].reshape(-1, 3, 3, 3)[:, ::2, ::2]
        sides = [np.linalg.norm(np.diff(corners, axis=axis), axis=-1).max() for axis in (1, 2)]
        return hexmesh.surface_triangles(self.mesh, int(np.ceil(max(sides) / REFRACTS)))


def aimed_rig(spec: Mapping[str, Any], x: Array) -> Rig:
    target = np.array([0.0, 0.0, 0.55 * float(x[:, 2].max())])
    options: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in spec["rig"].items()}
    return stereo_rig(target, **options)


def place_markers(spec: Mapping[str, Any], mesh: hexmesh.HexMesh, x: Array, rig: Rig) -> BodyMarkers:
    """Surface markers spread evenly over what both cameras see, clear of where the probe presses."""
    weights, faces, _ = hexmesh.surface_triangles(mesh, 4)
    everything = BodyMarkers(faces, weights, np.empty(0, np.int64), np.empty((0, 3)), mesh)
    places, normals = everything.places(x), everything.normals(x)
    visible = places[:, 2] > 0.004
    for _, T in rig.views():
        eye = -T[:3, :3].T @ T[:3, 3]
        view = (eye - places) / np.linalg.norm(eye - places, axis=1, keepdims=True)
        visible &= (view * normals).sum(1) > 0.35
    candidates = np.flatnonzero(visible)
    chosen = _spread(places[candidates], int(spec["markers"]["surface"]))
    chosen = candidates[chosen]
    inner = np.setdiff1d(np.arange(len(mesh.nodes)), np.unique(mesh.faces))
    shallow = inner[mesh.nodes[inner, 2] > 0.5 * mesh.nodes[:, 2].max()]
    shallow = shallow[_seen_from_above(x[shallow], x[np.unique(mesh.faces)], rig)]
    n_inner = int(spec["markers"]["internal"])
    nodes = shallow[_spread(mesh.nodes[shallow], n_inner)]
    half = np.ptp(mesh.nodes[:, :2], axis=0) / 2 + 0.010
    y = -half[1] * np.array([1.0, 1.0, 0.25, 0.25])
    corners = np.column_stack([half[0] * np.array([-0.8, 0.8, -1.05, 1.05]), y, np.zeros(4)])
    return BodyMarkers(faces[chosen], weights[chosen], nodes, corners[: int(spec["markers"]["support"])], mesh)


def _seen_from_above(points: Array, surface: Array, rig: Rig) -> NDArray[np.bool_]:
    """Return which of the inner ``points`` both cameras see through the surface straight above, not through a side.

    The surface goes on, as high, beyond where the lines of sight pass it.
    """
    out = np.ones(len(points), bool)
    for _, T in rig.views():
        eye = -T[:3, :3].T @ T[:3, 3]
        for i, p in enumerate(points):
            top = _height(surface, p[:2])
            across = (eye - p)[:2] * (top - p[2]) / (eye - p)[2]
            beyond = p[:2] + across + NEAR * across / max(float(np.linalg.norm(across)), 1e-9)
            out[i] &= _height(surface, beyond) > top - 0.1 * np.ptp(surface[:, 2])
    return out


def _height(surface: Array, place: Array) -> float:
    """The highest of the surface's points near a place (2,); -inf where there are none."""
    near = np.linalg.norm(surface[:, :2] - place, axis=1) < NEAR
    return float(surface[near, 2].max(initial=-np.inf))


def _spread(points: Array, n: int) -> NDArray[np.int64]:
    """n of the points, each as far as possible from those before."""
    if n == 0:
        return np.empty(0, np.int64)
    if len(points) < n:
        raise InputError(f"only {len(points)} places are visible for {n} markers", remedy="ask for fewer markers")
    chosen = [int(np.argmin(np.linalg.norm(points - points.mean(0), axis=1)))]
    distance = np.full(len(points), np.inf)
    while len(chosen) < n:
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
        chosen.append(int(np.argmax(distance)))
    return np.array(chosen)
