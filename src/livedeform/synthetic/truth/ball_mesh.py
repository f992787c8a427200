"""A block of 27-node hexahedra whose elements end where a ball in it does.

A modulus that jumps within elements makes a truth of its own: of a ball of 20 mm in elements of 10 mm, ten times as
stiff as the rest, what markers tell of it is a quarter too large, as if the ball were a fifth larger. Here the ball is
a core with a shell round it, in a box that is a part of the block's lattice.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from livedeform.common.errors import MeshError
from livedeform.common.types import Array
from livedeform.synthetic.truth.hexmesh import HexMesh, IntArray, directions, lattice, rounded

BOX = 1.5  # radii from the ball's middle to the box's sides, where the block is large enough
LEAST = 1.15  # radii that this is at least
MARGIN = 0.003  # m between the box and the block's surface
LEAST_ACROSS = 3  # elements across the box
SMALLER = 1.2  # times in the box and above it, where the probe presses


def block_round_ball(size: Sequence[float], n: Sequence[int], centre: Sequence[float], radius: float) -> HexMesh:
    """Make a block of ``size`` (3) m, the base's middle at the origin, of about ``n`` (3) elements and those of a ball.

    Raises MeshError where the ball is too near to the block's surface.
    """
    lower, upper = np.array([-size[0] / 2, -size[1] / 2, 0.0]), np.array([size[0] / 2, size[1] / 2, size[2]])
    c = np.asarray(centre, float)
    low = np.maximum(c - BOX * radius, lower + MARGIN)
    high = np.minimum(c + BOX * radius, upper - MARGIN)
    if min((c - low).min(), (high - c).min()) < LEAST * radius:
        raise MeshError(f"a ball of {1e3 * radius:.1f} mm at {tuple(centre)} is too near to the surface of its block")
    step = np.asarray(size, float) / np.asarray(n)
    across = max(LEAST_ACROSS, int(np.ceil(SMALLER * ((high - low) / step)[:2].max())))
    outside, hexes, box = _round_box(
        [_marks(*along, across) for along in zip(lower, low, high, upper, step, strict=True)], across
    )
    unit, core = lattice((across, across, across))
    faces = HexMesh.of(unit, core).faces
    rim = np.unique(faces)
    direction, middle = directions(2.0 * unit[rim] - 1.0), c + radius * rounded(2.0 * unit - 1.0)
    onto = c + radius * direction
    layers = [middle[rim], 0.5 * (middle[rim] + onto), onto, 0.5 * (onto + outside[box][rim]), outside[box][rim]]
    number = np.zeros(len(unit), np.int64)
    number[rim] = np.arange(len(rim))
    at = [number[faces] + len(unit) + k * len(rim) for k in range(len(layers))]
    shells = [np.concatenate(at[k : k + 3], axis=1) for k in (0, 2)]
    nodes = np.concatenate([middle, *layers, outside])
    return HexMesh.of(*_welded(nodes, np.concatenate([core, *shells, hexes + len(nodes) - len(outside)])))


def _marks(lower: float, low: float, high: float, upper: float, step: float, across: int) -> tuple[Array, int]:
    """Return the places of half elements along an axis, and how many elements come before the box."""
    before, after = (max(1, round((b - a) / step)) for a, b in ((lower, low), (high, upper)))
    ends = ((lower, low, before), (low, high, across), (high, upper, after))
    parts = [np.linspace(a, b, 2 * n + 1) for a, b, n in ends]
    return np.concatenate([parts[0], parts[1][1:], parts[2][1:]]), before


def _round_box(marks: Sequence[tuple[Array, int]], across: int) -> tuple[Array, IntArray, IntArray]:
    """Return the nodes of the lattice, its elements without those of the box, and which nodes are the box's, in the
    order of a lattice of its own."""
    places = [place for place, _ in marks]
    n = [len(place) // 2 for place in places]
    _, hexes = lattice((n[0], n[1], n[2]))
    nodes = np.stack(np.meshgrid(*places, indexing="ij"), axis=-1).reshape(-1, 3)
    element = np.stack(np.unravel_index(np.arange(len(hexes)), n), axis=-1)
    first = np.array([before for _, before in marks])
    inside = np.all((element >= first) & (element < first + across), axis=1)
    box = [slice(2 * before, 2 * (before + across) + 1) for _, before in marks]
    return (
        nodes,
        hexes[~inside],
        np.arange(len(nodes)).reshape([len(place) for place in places])[tuple(box)].reshape(-1),
    )


def _welded(nodes: Array, hexes: IntArray) -> tuple[Array, IntArray]:
    """Return the mesh with nodes at one place made one, and without nodes that no element has."""
    used, hexes = np.unique(hexes, return_inverse=True)
    nodes, hexes = nodes[used], hexes.reshape(-1, 27)
    _, first, same = np.unique(np.round(nodes / 1e-8).astype(np.int64), axis=0, return_index=True, return_inverse=True)
    return nodes[first], same.reshape(-1)[hexes]
