"""Weight and dead loads: forces that do not depend on the displacement."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from livedeform.common.errors import InputError
from livedeform.common.types import Array
from livedeform.fem_node.element.element import Space, shape_values
from livedeform.fem_node.element.quadrature import triangle
from livedeform.fem_node.items.protocol import Moment, PlainItem
from livedeform.fem_node.physics.record import DeadLoad, Physics, RegionTest
from livedeform.fem_node.solve.assembly import System

PARTS = 8  # pieces along each side of a facet, to tell what of it is loaded


class Weight(PlainItem):
    """r_a -= rho g sum_q w N_a over the unloaded volume; ``weights`` (e, q) m3 (`Continuum.mass_weights`)."""

    def __init__(self, space: Space, density: float, weights: Array) -> None:
        self._space, self._density = space, density
        self._n = 3 * space.n_nodes
        self._force = np.zeros(self._n)
        self.set_volumes(weights)

    def set_volumes(self, weights: Array) -> None:
        """Take new unloaded volumes (e, q) m3."""
        s = self._space
        parts = self._density * np.einsum("eq,qa->ea", weights, s.values)
        self.masses = np.bincount(s.cells.ravel(), parts.ravel(), minlength=s.n_nodes)

    def prepare(self, moment: Moment) -> None:
        self._force = np.outer(self.masses, moment.gravity).ravel()

    def evaluate(self, x: Array, system: System, *, tangent: bool) -> float:
        system.r[: self._n] -= self._force
        return -float(self._force @ x[: self._n])


class Dead(PlainItem):
    """A force spread evenly over the surface of a region; ``moment.load`` scales it, once its delay is over."""

    def __init__(self, space: Space, load: DeadLoad) -> None:
        self._n, self._delay = 3 * space.n_nodes, load.delay
        self._full = np.outer(shares(space, load), np.asarray(load.force, float)).ravel()
        self._force = self._full

    def prepare(self, moment: Moment) -> None:
        self._force = moment.load * moment.begun(self._delay) * self._full

    def evaluate(self, x: Array, system: System, *, tangent: bool) -> float:
        system.r[: self._n] -= self._force
        return -float(self._force @ x[: self._n])


def shares(space: Space, load: DeadLoad) -> Array:
    """Return the nodes' shares (n,) of a load, one in all.

    A facet that the region's edge crosses carries the part of it that is inside: else the area that is loaded, and
    where its middle is, would depend on how the body happens to be meshed.
    """
    weights = _loaded(space, load.region)
    if not weights.any():
        facets = facets_in(space, load.region)
        if len(facets) == 0:
            raise InputError(
                "no surface triangle lies in the region", where=f"load '{load.name}'", remedy="enlarge the region"
            )
        values, rule, _ = space.facet_rule(2, space.facets[facets])
        weights = np.zeros(space.facets.shape)
        weights[facets] = rule @ values
    share = np.zeros(space.n_nodes)
    np.add.at(share, space.facets, weights)
    return np.asarray(share / share.sum())


def _loaded(space: Space, region: RegionTest) -> Array:
    """Return int N dA (k, b) m2 over what of each boundary facet is in the region."""
    return np.asarray(_pieces_in(space, region) @ _over_pieces(space).sum(axis=1))


def _loaded_products(space: Space, region: RegionTest) -> Array:
    """Return int N N^T dA (k, b, b) m2 over the same, or over the facets nearest to it."""
    inside, values = _pieces_in(space, region), _over_pieces(space)
    if not inside.any():
        facets = facets_in(space, region)
        inside[facets] = space.facet_rule(1)[1].sum(axis=1)[facets, None]
    _, rule = triangle(2)
    share = rule / rule.sum() / len(values)
    of_piece = np.einsum("pqa,pqb,q->pab", values, values, 1.0 / share)
    return np.asarray(np.einsum("kp,pab->kab", inside, of_piece))


def _pieces_in(space: Space, region: RegionTest) -> Array:
    """Return the area (k, p) m2 of each boundary facet, for the pieces that are in the region by their middles: cut
    into `PARTS`^2 pieces."""
    corners = space.nodes[space.facets[:, :3]]
    pieces = _pieces(PARTS)
    inside = region((pieces.mean(axis=1) @ corners).reshape(-1, 3)).reshape(len(corners), -1)
    return np.asarray(space.facet_rule(1)[1].sum(axis=1)[:, None] * inside)


def _over_pieces(space: Space) -> Array:
    """Return N dA / A (p, q, b) at the points of each piece of a facet with the area A."""
    pieces = _pieces(PARTS)
    barycentric, rule = triangle(2)
    points = np.einsum("qc,pcd->pqd", barycentric, pieces)
    values = shape_values(points.reshape(-1, 3), quadratic=space.quadratic).reshape(*points.shape[:2], -1)
    return np.asarray(values * (rule / rule.sum() / len(pieces))[None, :, None])


def _pieces(n: int) -> Array:
    """Return the barycentric corners (n^2, 3, 3) of a triangle cut into ``n`` pieces along each side."""
    i, j = (k.ravel() for k in np.meshgrid(np.arange(n), np.arange(n), indexing="ij"))
    up, down = i + j < n, i + j < n - 1
    corner = np.column_stack([i, j])
    upright = corner[up][:, None] + [[0, 0], [1, 0], [0, 1]]
    turned = corner[down][:, None] + [[1, 1], [0, 1], [1, 0]]
    xy = np.concatenate([upright, turned]) / n
    return np.concatenate([1.0 - xy.sum(axis=2, keepdims=True), xy], axis=2)


@dataclass(frozen=True)
class HungMass:
    """Mass that hangs at the surface: ``facets`` (k, b) nodes and its mass matrices ``blocks`` (k, b, b) kg there, from
    ``delay`` s after gravity begins to act."""

    facets: NDArray[np.int64]
    blocks: Array
    delay: float = 0.0


def hung_masses(space: Space, physics: Physics) -> list[HungMass]:
    """Return the mass of each load that pulls along gravity: a weight moves with the body that carries it, once it is
    carried. Shared out to nodes as the force is, corners of quadratic facets would have none or less than none."""
    g = float(np.linalg.norm(physics.gravity))
    hung = []
    for load in physics.loads:
        size = float(np.linalg.norm(load.force))
        if load.is_weight(physics.gravity):
            products = _loaded_products(space, load.region)
            loaded = products.any(axis=(1, 2))
            blocks = size / g / products.sum() * products[loaded]
            hung.append(HungMass(space.facets[loaded], blocks, load.delay))
    return hung


def facets_in(space: Space, region: RegionTest) -> NDArray[np.int64]:
    """Return indices of the boundary facets whose centroid lies in the region; of those that touch it if there is
    none."""
    inside = np.flatnonzero(region(space.facet_centres))
    if len(inside):
        return inside
    return np.flatnonzero(region(space.nodes)[space.facets].any(axis=1))
