"""The middles of the discs that are the markers, from the outlines that the pictures show.

Keeps each disc's normal from picture to picture. The normals of discs on the body follow the surface through the
markers around them, since a stretched disc looks like a tilted one; those of others (on the support) come from their
outlines.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from livedeform_common.frames import inverse
from livedeform_common.types import Array
from stereo_node.camera import StereoRig
from stereo_node.detect import Blobs
from stereo_node.ellipse import fit_discs, neighbour_normals, rim_bias, stretched_discs
from stereo_node.quadric import Quadrics, fit_quadrics
from stereo_node.triangulate import Triangulated, triangulate

Rows = NDArray[np.int64]


class DiscCorrection:
    """Corrects the points of markers for the perspective of their discs and, where they are ``painted`` on the body,
    for its curvature. Internal markers are taken for balls, and left as they are."""

    def __init__(self, rig: StereoRig, rest: Array, kinds: NDArray[np.str_], painted: bool) -> None:
        """``rest`` (m, 3) m: the markers' places at rest in the left frame; ``kinds`` (m,)."""
        self.rig, self.painted = rig, painted
        self.on_body = kinds == "surface"
        self.flat = kinds != "internal"
        self.normals = np.zeros_like(rest)
        for kind in np.unique(kinds):
            self.normals[kinds == kind] = neighbour_normals(rest[kinds == kind], np.zeros(3))
        self._seen = np.zeros(len(rest), bool)

    def middles(
        self, points: Triangulated, left: Blobs, right: Blobs, markers: Rows, places: Array, sigma: Array
    ) -> Triangulated:
        """Points (n, 3) of the middles of the discs ``markers`` (n,), triangulated from ``left``, ``right`` (n blobs).

        ``places`` (m, 3) m: where all markers are as far as is known, each to ``sigma`` (m,) m. What the curvature is
        not known to is in the covariances.
        """
        self._look_first(points, left, right, markers)
        n = self.normals[markers].copy()
        K, unsure = np.zeros((len(markers), 3, 3)), np.zeros((len(markers), 3, 3))
        axes = stretched_discs(self.rig, points.points, left.shapes, right.shapes, n)
        body = self.on_body[markers]
        if body.any():
            sigma = np.where(self.on_body, sigma, np.inf)
            found = fit_quadrics(places, sigma, self.normals, markers[body])
            n[body] = self.normals[markers[body]] = found.normals
            axes = stretched_discs(self.rig, points.points, left.shapes, right.shapes, n)
            if self.painted:
                K[body] = found.tensors
                unsure[body] = self._unsure(points.points[body], axes[body], found)
        bias_left, bias_right = rim_bias(self.rig, points.points, axes, n, K)
        flat = self.flat[markers][:, None]
        measured = triangulate(
            self.rig,
            left.centres - np.where(flat, bias_left, 0.0),
            right.centres - np.where(flat, bias_right, 0.0),
            left.covariances,
            right.covariances,
        )
        return replace(measured, covariances=measured.covariances + unsure)

    def _unsure(self, points: Array, axes: Array, found: Quadrics) -> Array:
        """(n, 3, 3) m2: what the curvatures' covariances leave of the middles.

        The mean of the rim n n^T (-t^T K t / 2) over its directions gives the outline's middle, seen along u, the place
        -r^2 / 4 (tr(K) n + (K - tr(K) / 2) v), v = -u_t / (u . n): where a height of 1 is seen in the tangent plane.
        """
        u = points - 0.5 * inverse(self.rig.T_right_left)[:3, 3]
        B, n = found.bases, found.normals
        across = np.einsum("nja,nj->na", B, u)
        v = -across / np.minimum((u * n).sum(axis=1), -0.1 * np.linalg.norm(u, axis=1))[:, None]
        half = 0.5 * v
        D = np.stack(
            [
                n + np.einsum("nja,na->nj", B, half * [1.0, -1.0]),
                np.einsum("nja,na->nj", B, v[:, ::-1]),
                n + np.einsum("nja,na->nj", B, half * [-1.0, 1.0]),
            ],
            axis=2,
        )
        r2 = 0.5 * (axes**2).sum(axis=(1, 2))[:, None, None]
        out: Array = (r2 / 4) ** 2 * D @ found.covariances @ np.swapaxes(D, 1, 2)
        return out

    def _look_first(self, points: Triangulated, left: Blobs, right: Blobs, markers: Rows) -> None:
        """Normals of discs that are seen for the first time, from their outlines: they are round then."""
        new = ~self._seen[markers]
        if not new.any():
            return
        m = markers[new]
        discs = fit_discs(self.rig, points.points[new], left.shapes[new], right.shapes[new], self.normals[m])
        length = np.linalg.norm(discs, axis=1)[:, None]
        self.normals[m] = np.where(np.isfinite(discs) & (length > 0), discs / length, self.normals[m])
        self._seen[m] = True
