"""Tell where in the pictures a calibration knows the lens: of an edge that no board came near, it says nothing.

A lens model goes on beyond the boards that it was fitted to, and is soon pixels off. Its covariance shows where: what
moves a pixel's ray, and is neither a turn of the camera nor a change of its intrinsics, is the lens's own uncertainty.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from livedeform.common.types import Array
from livedeform.stereo_node.calibrate.bundle import Bundle
from livedeform.stereo_node.camera.calibration_uncertainty import STEP, principal_axes
from livedeform.stereo_node.camera.rig import undistort

MOST_PX = 1.0  # one sigma of a ray, beyond which nothing is measured with it
NODES = 37, 49  # rows, columns over the picture
N_ROUNDS = 8
FAR = 1e6  # px, of a pixel that the lens does not give


@dataclass(frozen=True)
class KnownField:
    """Hold by how much (px, one sigma) the ``left`` and the ``right`` lens may put rays elsewhere, at nodes spread
    evenly over pictures of ``size`` (width, height)."""

    left: Array
    right: Array
    size: tuple[int, int]

    def holds(self, left: Array, right: Array) -> NDArray[np.bool_]:
        """Tell which (n,) of the pixels ``left``, ``right`` (n, 2) lie where both lenses are known to a pixel."""
        return (self._at(self.left, left) < MOST_PX) & (self._at(self.right, right) < MOST_PX)

    @property
    def shares(self) -> tuple[float, float]:
        """Return the share of each picture in which the lens is known to a pixel."""
        return float((self.left < MOST_PX).mean()), float((self.right < MOST_PX).mean())

    def _at(self, nodes: Array, pixels: Array) -> Array:
        steps = (np.array(nodes.shape[::-1]) - 1) / (np.array(self.size) - 1)
        x, y = (pixels * steps).T.astype(np.float32).reshape(2, 1, -1)
        found = cv2.remap(nodes.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(found, float).ravel()


def known_field(bundle: Bundle, size: tuple[int, int]) -> KnownField:
    """Return where the calibration ``bundle`` knows the lenses of pictures of ``size`` (width, height)."""
    rows, columns = NODES
    y, x = np.meshgrid(np.linspace(0, size[1] - 1, rows), np.linspace(0, size[0] - 1, columns), indexing="ij")
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    left, right = (_lens_uncertainty(bundle, size, side, pixels).reshape(NODES) for side in ("left", "right"))
    return KnownField(left, right, size)


def _lens_uncertainty(bundle: Bundle, size: tuple[int, int], side: str, pixels: Array) -> Array:
    """Return by how much (n,) px, one sigma, the lens of a ``side`` may put the rays of ``pixels`` (n, 2) elsewhere,
    beside what a camera that is turned or has other intrinsics does; ``FAR`` where it gives no ray.

    Which turn is told by the pixels themselves, most by those that the lens knows best (Cauchy weights).
    """
    own = np.array([name.startswith(side) for name in bundle.names])
    camera = getattr(bundle.rig(size), side)
    rays, J = undistort(camera, pixels)
    moved = np.empty((len(pixels), 2, int(own.sum())))
    for k, axis in enumerate(principal_axes(bundle.covariance[np.ix_(own, own)]).T):
        step = np.zeros(len(own))
        step[own] = STEP * axis
        ends = [undistort(getattr(bundle.with_values(bundle.values + s * step).rig(size), side), pixels)[0]
                for s in (1, -1)]  # fmt: skip
        moved[:, :, k] = (ends[0] - ends[1]) / (2 * STEP)
    out = np.full(len(pixels), FAR)
    given = np.isfinite(rays).all(axis=1) & np.isfinite(moved).all(axis=(1, 2)) & np.isfinite(J).all(axis=(1, 2))
    if given.sum() > 8:
        to_pixel = np.asarray(np.linalg.inv(J[given]), float)
        out[given] = np.minimum(_beside_turns(rays[given], to_pixel @ moved[given], to_pixel), FAR)
    return out


def _beside_turns(rays: Array, moved: Array, to_pixel: Array) -> Array:
    """Return (n,) px: what of ``moved`` (n, 2, k) px is no homography of the ideal image points ``rays`` (n, 2);
    ``to_pixel`` (n, 2, 2): d pixel / d ray."""
    x, y = rays.T
    one, zero = np.ones_like(x), np.zeros_like(x)
    along = np.stack([one, zero, x, zero, y, zero, x * x, x * y], axis=1)
    across = np.stack([zero, one, zero, x, zero, y, x * y, y * y], axis=1)
    A = to_pixel @ np.stack([along, across], axis=1)
    weight = np.exp(-4 * (x**2 + y**2) / np.max(x**2 + y**2))
    size = np.zeros(len(x))
    for _ in range(N_ROUNDS):
        w = np.sqrt(weight)[:, None, None]
        q = np.linalg.lstsq((w * A).reshape(-1, 8), (w * moved).reshape(2 * len(x), -1), rcond=None)[0]
        size = np.sqrt(((moved - A @ q) ** 2).sum(axis=(1, 2)) / 2)
        weight = 1.0 / (1.0 + (size / np.median(size)) ** 2) ** 2
    return size
