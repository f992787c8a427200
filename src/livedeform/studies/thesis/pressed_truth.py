"""The true phantom under the probe, for the probe study: 27-node hexahedra and their own contact, no part of the model.

Markers and lesion are nodes of the truth's mesh, so that their true places need no interpolation.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from livedeform.common.types import Array
from livedeform.synthetic.truth.hexmesh import HexMesh, IntArray, hemi_ellipsoid
from livedeform.synthetic.truth.physics import TruthPhysics
from livedeform.synthetic.truth.probe import TruthProbe
from livedeform.synthetic.truth.solver import TruthBody

STEP = 0.0025  # m of the probe's path at a time


@dataclass(frozen=True)
class TruePress:
    """True places at rest and pressed: ``markers`` (n, 3), ``lesion`` (3,) m; ``force`` (3,) N; ``top`` m of the body
    at rest; ``n_nodes``, CPU ``seconds``."""

    rest_markers: Array
    markers: Array
    rest_lesion: Array
    lesion: Array
    force: Array
    top: float
    n_nodes: int
    seconds: float


class TruePhantom:
    """A half ellipsoid of hexahedra: ``n`` across, in ``shells`` round a core."""

    def __init__(self, semi_axes: Sequence[float], n: int, shells: int) -> None:
        self.mesh: HexMesh = hemi_ellipsoid(semi_axes, n, shells)
        self._surface = np.unique(self.mesh.faces)

    def markers_near(self, points: Array) -> IntArray:
        """The surface's nodes (k,) nearest to ``points`` (n, 3), each once."""
        nodes = self.mesh.nodes[self._surface]
        near = [int(np.argmin(np.linalg.norm(nodes - p, axis=1))) for p in points]
        return self._surface[np.unique(near)]

    def node_near(self, point: Array) -> int:
        """The node nearest to ``point`` (3,)."""
        return int(np.argmin(np.linalg.norm(self.mesh.nodes - point, axis=1)))

    def press(
        self, physics: TruthPhysics, probe: TruthProbe, depth: float, markers: IntArray, lesion: int
    ) -> TruePress:
        """Straight down on the top by ``depth`` m below the first touch; ``markers`` (k,) and ``lesion`` are nodes."""
        began = time.process_time()
        body = TruthBody(self.mesh, physics, probe)
        rest = body.rest().x
        top = float(rest[self._surface, 2].max())
        n = int(np.ceil(depth / STEP))
        for k in range(n + 1):
            T = np.diag([1.0, -1.0, -1.0, 1.0])  # the face looks down
            T[2, 3] = top - depth * k / n
            state = body.step(T, float(k))
        body.factors.close()
        x = state.x
        return TruePress(
            rest[markers], x[markers], rest[lesion], x[lesion], state.force, top, len(x), time.process_time() - began
        )
