"""A block of 27-node hexahedra whose elements end where a ball in it does.

A ball whose edge is spread over some millimetres does what a larger one does; a sharp edge asks for elements that end
at it. Here the ball is a core with a shell round it, in a box that is a part of the block's lattice.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from livedeform.common.errors import MeshError
from livedeform.common.types import Array
from livedeform.synthetic.truth.hexmesh import HexMesh, IntArray, directions, lattice, layers_round, rounded, shells

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
    middle, onto = c + radius * rounded(2.0 * unit - 1.0), c + radius * directions(2.0 * unit[rim] - 1.0)
    between = [0.5 * (middle[rim] + onto), onto, 0.5 * (onto + outside[box][rim])]
    inner = np.concatenate([middle, *between])
    layers = [*layers_round(len(unit), rim, len(between)), len(inner) + box]
    elements = np.concatenate([core, shells(faces, layers), len(inner) + hexes])
    used, elements = np.unique(elements, return_inverse=True)  # the box is empty
    return HexMesh.of(np.concatenate([inner, outside])[used], elements.reshape(-1, 27))


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
