"""Measure how well the boards of a calibration fill the cameras' field: places, tilts, distances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from livedeform.common.types import Array
from livedeform.stereo_node.boards.boards import Pair
from livedeform.stereo_node.calibrate.bundle import Bundle
from livedeform.stereo_node.camera.known_field import known_field

COVER_GRID = (8, 6)
ALMOST_ALL = 0.99


@dataclass(frozen=True)
class BoardCoverage:
    """The coverage of the field by the boards (share of 8 x 6 cells with a point, per camera), their tilt range (rad),
    distances (m), and the share of each picture in which they tell the lens to a pixel (left, right)."""

    left: float
    right: float
    tilt: tuple[float, float]
    distance: tuple[float, float]
    known: tuple[float, float] = (1.0, 1.0)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return what is missing, as sentences."""
        out = []
        for side, share in (("left", self.left), ("right", self.right)):
            if share < 0.6:
                out.append(
                    f"the boards cover {share:.0%} of the {side} picture: take pictures near its edges and corners"
                )
        for side, share in zip(("left", "right"), self.known, strict=True):
            if share < ALMOST_ALL:
                out.append(
                    f"the lens is not known to a pixel on {1 - share:.0%} of the {side} picture, near its edges: "
                    f"markers there are left out; take pictures of the board there"
                )
        if np.degrees(self.tilt[1]) < 20:
            out.append(
                f"no board is tilted by more than {np.degrees(self.tilt[1]):.0f} degrees: the focal "
                f"length is weak, tilt it to 30-45"
            )
        if self.distance[1] < 1.15 * self.distance[0]:
            out.append("all boards are at the same distance: bring some nearer and farther")
        return tuple(out)


def coverage_of(points: Array, pairs: Sequence[Pair], bundle: Bundle, size: tuple[int, int]) -> BoardCoverage:
    shares = []
    for side in ("left", "right"):
        pixels = np.concatenate([getattr(p, side).pixels for p in pairs])
        cells, _, _ = np.histogram2d(pixels[:, 0], pixels[:, 1], bins=COVER_GRID, range=((0, size[0]), (0, size[1])))
        shares.append(float((cells > 0).mean()))
    R = Rotation.from_rotvec(bundle.boards[:, :3]).as_matrix()
    middle = np.einsum("kij,j->ki", R, points.mean(axis=0)) + bundle.boards[:, 3:]
    distance = np.linalg.norm(middle, axis=1)
    tilt = np.arccos(np.clip(np.abs((R[:, :, 2] * middle).sum(axis=1)) / distance, 0, 1))
    return BoardCoverage(
        shares[0], shares[1], (float(tilt.min()), float(tilt.max())), (float(distance.min()), float(distance.max())),
        known_field(bundle, size).shares,
    )  # fmt: skip
