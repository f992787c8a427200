"""Hold the body: exactly (dofs taken out) or by springs on the surface; friction with the support.

Springs are slack, and friction has not yet slipped, in the unloaded shape: the body was put on (or cast onto) its
support before weight acted on it. So a body that was scanned under its weight stretches them, and ever stiffer springs
become the fixed support. With springs that are slack in the scanned shape, a loaded scan would sag on a base without
any hold, however stiff they are.

Springs that stand for a bond go by the modulus of the body behind them, with whatever effects make of it: were they
declared ones, a body that an effect softens would hang on a bond that is stiffer than it ends.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from trimesh.remesh import subdivide_to_size

from livedeform.common.errors import InputError
from livedeform.common.types import Array
from livedeform.fem_node.element.element import Space
from livedeform.fem_node.items.friction import FrictionSupport
from livedeform.fem_node.items.loads import facets_in
from livedeform.fem_node.items.protocol import Item, Moment, PlainItem
from livedeform.fem_node.physics.record import PartialRegion, Physics, Support
from livedeform.fem_node.solve.assembly import Pattern, System, node_dofs

_FLAT = 1e-3  # a face whose normals are this close to one axis is held along that axis exactly
_ROUGH = 0.005  # of a face's width: within this (rms) of a plane it is flat, and its normals show a scan's noise
_MOSTLY = 0.9  # of the area of a support, that makes it a flat one
_STEEP = 0.5  # cosine to its normal, below which a facet of its region is a wall's
_STIFF = 1e5  # normal springs of a curved or frictional support, in units of E / element size

# what a support must catch of the area in its region; less of one that is only a few (LARGE) elements wide
CAUGHT, CAUGHT_SMALL, LARGE = 0.8, 0.5, 5.0
PIECE = 0.5  # elements: the given surface is cut into pieces of that size, which are in the region or not

DEGREE = 4  # of the quadrature of springs
# where a bond ends (`_partly_held`): width of the ramp in elements, springs in units of E / element size
EDGE, EDGE_STIFF = 0.5, 20.0

# the modulus (f,) Pa behind boundary facets, by their numbers (f,), at the moment for which the body is prepared
Behind = Callable[[NDArray[np.int64]], Array]
# springs' stiffness along the normal and along the surface, Pa/m, each one number, (f, 1) or (f, q), by that modulus
# as (f, 1)
Law = Callable[[Array], tuple[Array | float, Array | float]]


def make_supports(space: Space, physics: Physics, behind: Behind, unloaded: Array | None = None) -> list[Item]:
    """Return the items of all supports, of a body with the modulus ``behind`` its facets; ``unloaded`` (n, 3) m:
    displacement from the scanned to the unloaded shape."""
    items: list[Item] = []
    for number, declared in enumerate(physics.supports):
        where = f"support {number} ({declared.type})"
        support = _without_trifles(space, declared)
        nodes = supported_nodes(space, support)
        if len(nodes) == 0:
            raise InputError("no surface node lies in the region", where=where, remedy="enlarge the region")
        if partly := _partly_held(space, support, behind):
            items += partly
            continue
        if support.type == "fixed":
            items.append(Held(node_dofs(nodes[:, None]).ravel()))
            continue
        face = supported_face(space, support)
        if support.type == "friction":
            items.append(FrictionSupport(space, face, _friction_law(support, space.typical_size), support.mu, behind))
            continue
        if face.axis is not None:
            items.append(Held(3 * face.nodes + face.axis))
        if face.axis is None or support.type == "spring":
            items.append(Springs(space, face, _whole_law(support, face, space.typical_size), behind))
    set_unloaded(items, unloaded)
    return items


def _friction_law(support: Support, size: float) -> Law:
    """Return the springs of a support with friction, on elements of ``size`` m, while it sticks."""
    return lambda modulus: (_STIFF * modulus / size, support.stiffness or 100.0 * modulus / size)


def _whole_law(support: Support, face: Face, size: float) -> Law:
    """Return the springs of a sliding or springy support: along the normal where that is not held exactly."""
    sideways = support.stiffness if support.type == "spring" else 0.0
    return lambda modulus: (_STIFF * modulus / size if face.axis is None else 0.0, sideways)


def _without_trifles(space: Space, support: Support) -> Support:
    """Return the whole support for one of which so little is free that its edge would be stiffer than a bond that holds
    along curved normals; any other as it is."""
    region = support.region
    if not isinstance(region, PartialRegion):
        return support
    whole, usual = replace(support, region=region.region), EDGE * space.typical_size
    base = space.nodes[supported_nodes(space, whole)]
    return whole if len(base) and region.ramp(base, usual) <= usual * EDGE_STIFF / _STIFF else support


def _partly_held(space: Space, support: Support, behind: Behind) -> list[Item]:
    """Make the items of a bond, or of springs, that end somewhere: nodes well inside are held, and up to the edge
    springs fade away, so that the body changes smoothly as the edge moves through the elements. Where the edge is so
    near the end that they have less room, they are as much stiffer, and so become the bond. Nothing for a whole
    one."""
    region = support.region
    if support.type not in ("fixed", "spring") or not isinstance(region, PartialRegion):
        return []
    whole = replace(support, region=region.region)
    face, nodes = supported_face(space, whole), supported_nodes(space, whole)
    facets = space.facets[face.facets]
    base, usual = space.nodes[nodes], EDGE * space.typical_size
    width = region.ramp(base, usual)
    held = nodes[region.share(base, base, width) >= 1.0]
    values, _, _ = space.facet_rule(DEGREE, facets)
    places = np.einsum("qa,kai->kqi", values, space.nodes[facets])
    share = region.share(places.reshape(-1, 3), base, width).reshape(places.shape[:2])
    edge = EDGE_STIFF / space.typical_size * usual / width
    if support.type == "spring":
        return _partly_sprung(space, face, np.intersect1d(held, face.nodes), share, support.stiffness, edge, behind)
    springs = Springs(space, face, lambda modulus: (share * edge * modulus, share * edge * modulus), behind)
    return [Held(node_dofs(held[:, None]).ravel()), springs] if len(held) else [springs]


def _partly_sprung(
    space: Space, face: Face, held: NDArray[np.int64], share: Array, stiffness: float, edge: float, behind: Behind
) -> list[Item]:
    """Make springs of ``stiffness`` Pa/m along a face that is there to a ``share`` (f, q), and what holds it along its
    normal, at the nodes ``held`` and up to the edge; ``edge``: what the springs of a bond's edge are of the modulus,
    1/m."""

    def faded(k: Array | float, modulus: Array) -> Array:  # in series with a bond's edge, which the stiffest come to
        return np.asarray(share * k / (1.0 + (1.0 - share) * k / (edge * modulus)))

    def whole(modulus: Array) -> tuple[Array, Array]:
        return faded(_STIFF * modulus / space.typical_size, modulus), faded(stiffness, modulus)

    if face.axis is None:
        return [Springs(space, face, whole, behind)]
    springs = Springs(space, face, lambda modulus: (share * edge * modulus, faded(stiffness, modulus)), behind)
    return [Held(3 * held + face.axis), springs] if len(held) else [springs]


def set_unloaded(items: Sequence[Item], unloaded: Array | None) -> None:
    """Tell springs and friction among the items where they are slack: displacement (n, 3) m from the scanned shape."""
    for item in items:
        if isinstance(item, Springs | FrictionSupport):
            item.set_unloaded(unloaded)


def supported_nodes(space: Space, support: Support) -> NDArray[np.int64]:
    """Return boundary nodes in the support's region."""
    boundary = np.unique(space.facets)
    return boundary[support.region(space.nodes[boundary])]


def check_caught(space: Space, supports: Sequence[Support], vertices: Array, triangles: NDArray[np.int64]) -> None:
    """Refuse a support that holds less of the mesh than the surface that was given has in its region.

    The surface (vertices (n, 3) m, triangles (k, 3)) is cut into pieces; of each in the region counts the share of
    nodes that are held of the facet beside it.
    """
    corners, of = subdivide_to_size(vertices, triangles, PIECE * space.typical_size)
    middles, area = corners[of].mean(axis=1), _triangle_areas(corners[of])
    facets = space.nodes[space.facets]
    beside = cKDTree(facets.mean(axis=1))
    for number, support in enumerate(supports):
        there = support.region(middles)
        given = float(area[there].sum())
        if given == 0.0:
            continue
        inside = support.region(facets.reshape(-1, 3)).reshape(facets.shape[:2]).mean(axis=1)
        held = float(area[there] @ inside[beside.query(middles[there])[1]])
        large = given > (LARGE * space.typical_size) ** 2
        if held < (CAUGHT if large else CAUGHT_SMALL) * given:
            raise InputError(
                f"it holds {len(supported_nodes(space, support))} nodes, {1e6 * held:.0f} mm2 of the "
                f"{1e6 * given:.0f} mm2 that the given surface has in its region",
                where=f"support {number} ({support.type})",
                remedy="enlarge the region a little (by a tenth of an element), or use smaller elements",
            )


def _triangle_areas(corners: Array) -> Array:
    """(k,) m2 of triangles (k, 3, 3)."""
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.asarray(0.5 * np.linalg.norm(cross, axis=1))


def held_facets(space: Space, physics: Physics) -> NDArray[np.bool_]:
    """Return which boundary facets (k,) lie on a support."""
    held = np.zeros(len(space.facets), bool)
    for support in physics.supports:
        held[facets_in(space, support.region)] = True
    return held


class Face(NamedTuple):
    """The face that a support holds: numbers of boundary ``facets`` (k,) and ``nodes`` (n,).

    If it is flat, its ``normal`` (3,), unit and outward, and the ``axis`` that this is along, if there is one.
    """

    facets: NDArray[np.int64]
    nodes: NDArray[np.int64]
    normal: Array | None
    axis: int | None


def supported_face(space: Space, support: Support) -> Face:
    """Return the face in the support's region. Of one that is nearly all flat, what is steep is left out: the foot of a
    wall, which the support does not touch, and which would not slip.

    A scan's noise makes a flat's facets face every way; held along its normals, such a base would lock on its own
    roughness. So a face is flat when its normals are, or when it lies close to one plane.
    """
    facets, nodes = facets_in(space, support.region), supported_nodes(space, support)
    _, weights, normals = space.facet_rule(1, space.facets[facets])
    area = weights.sum(axis=1)
    normal = _flat_normal(area, normals, space.facet_centres[facets])
    if normal is None:
        return Face(facets, nodes, None, None)
    facets = facets[np.abs(normals @ normal) > _STEEP]
    axis = int(np.argmax(np.abs(normal)))
    exactly = np.abs(normal[axis]) > 1.0 - _FLAT
    if exactly:
        normal = np.sign(normal[axis]) * np.eye(3)[axis]
    return Face(facets, np.intersect1d(nodes, space.facets[facets]), normal, axis if exactly else None)


def _flat_normal(area: Array, normals: Array, centres: Array) -> Array | None:
    """Return the normal (3,) of a face that is mostly flat (facets' ``area`` (k,), ``normals`` and ``centres``
    (k, 3)); None of one that is not."""
    along = np.abs(normals)
    axis = int(np.argmax(area @ along))
    if area[along[:, axis] > 1.0 - _FLAT].sum() >= _MOSTLY * area.sum():
        return np.asarray(np.sign(area @ normals[:, axis]) * np.eye(3)[axis])
    mean = area @ normals
    flat = np.abs(normals @ mean) > _STEEP * np.linalg.norm(mean)
    if area[flat].sum() < _MOSTLY * area.sum():
        return None
    weight = area[flat] / area[flat].sum()
    middle = weight @ centres[flat]
    spread, directions = np.linalg.eigh((centres[flat] - middle).T * weight @ (centres[flat] - middle))
    if np.sqrt(max(spread[0], 0.0)) > _ROUGH * np.sqrt(area[flat].sum()):
        return None
    return np.asarray(directions[:, 0] * np.sign(directions[:, 0] @ mean))


class Held(PlainItem):
    """Dofs held at zero."""

    def __init__(self, dofs: NDArray[np.int64]) -> None:
        self._dofs = np.unique(dofs)
        self._values = np.zeros(len(self._dofs))

    def evaluate(self, x: Array, system: System, *, tangent: bool) -> float:
        return 0.0

    def constraints(self) -> tuple[NDArray[np.int64], Array]:
        return self._dofs, self._values


class Springs(PlainItem):
    """W = 1/2 int k_n (v.n)^2 + k_t |v - (v.n) n|^2 over the ``face`` (scanned normals: its own, or each facet's); v =
    u - w is the displacement from the unloaded shape. The ``law`` gives k_n and k_t, Pa/m, by the modulus ``behind``.
    """

    def __init__(self, space: Space, face: Face, law: Law, behind: Behind) -> None:
        facets = space.facets[face.facets]
        self._values, self._weights, normals = space.facet_rule(DEGREE, facets)
        if face.normal is not None:
            normals = np.broadcast_to(face.normal, normals.shape)
        self._normals = normals[:, :, None] * normals[:, None, :]
        self._dofs = node_dofs(facets)
        self._slack = np.zeros(self._dofs.shape)
        self._numbers, self._law, self._behind = face.facets, law, behind
        self._modulus, self._blocks = np.zeros(0), np.zeros((0, 0, 0))

    def prepare(self, moment: Moment) -> None:
        """Take the stiffness that the body behind has now."""
        modulus = self._behind(self._numbers)
        if np.array_equal(modulus, self._modulus):
            return
        normal, tangential = self._law(modulus[:, None])
        along, across = (
            np.einsum("kq,qa,qb->kab", self._weights * k, self._values, self._values) for k in (normal, tangential)
        )
        n = self._dofs.shape[1]
        blocks = np.einsum("kab,kij->kaibj", along, self._normals)
        blocks += np.einsum("kab,kij->kaibj", across, np.eye(3) - self._normals)
        self._modulus, self._blocks = modulus, blocks.reshape(-1, n, n)

    def set_unloaded(self, unloaded: Array | None) -> None:
        """Take where the springs are slack: displacement (n, 3) m from the scanned shape, None: the scanned shape
        itself."""
        self._slack = np.zeros(self._dofs.shape) if unloaded is None else unloaded.ravel()[self._dofs]

    def attach(self, pattern: Pattern) -> None:
        self._positions = pattern.positions(self._dofs)

    def evaluate(self, x: Array, system: System, *, tangent: bool) -> float:
        u = x[self._dofs] - self._slack
        force = np.einsum("kab,kb->ka", self._blocks, u)
        system.add_vectors(self._dofs, force)
        if tangent:
            system.add_blocks(self._positions, self._blocks)
        return 0.5 * float(np.sum(u * force))
