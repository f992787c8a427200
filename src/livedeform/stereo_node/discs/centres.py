"""The middles of the discs that are the markers, from the outlines that the pictures show.

Keeps each disc's normal from picture to picture. The normals of discs on the body follow the surface through the
markers around them, since a stretched disc looks like a tilted one; those of others (on the support) come from their
outlines. Where a body stretches unevenly, near a probe, the middle of a disc is not in the middle of it any more: by
r^2 / 4 times the second derivative of the displacement, which the markers are too far apart to show. It is in the
covariances, from how differently the neighbours moved and from how far the outlines are from ellipses.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from livedeform.common.frames import inverse
from livedeform.common.types import Array
from livedeform.stereo_node.camera.rig import StereoRig
from livedeform.stereo_node.camera.triangulate import Triangulated, triangulate
from livedeform.stereo_node.detect.blobs import Blobs
from livedeform.stereo_node.discs.curvature import Quadrics, fit_quadrics
from livedeform.stereo_node.discs.outlines import fit_discs, neighbour_normals, rim_bias, stretched_discs

Rows = NDArray[np.int64]
N_STRAINED = 8  # neighbours
KNOWN_SIGMA = 1e-3  # m: places that are known worse say nothing of strains
UNEVEN_STRAIN = 3.0  # measured near a probe on rendered pictures: gradients between markers are larger than their means
TURN_KNOWN = 3  # neighbours: fewer leave a turn open
SKEWED = 1.0  # displacement of the middle per skewness of the outline, per axis (one-sided stretching: 3 along it)
FOLDED = 6.0  # the same for discs that may be folded over an edge of the body
EYE = np.eye(3)


class DiscCorrection:
    """Corrects the points of markers for the perspective of their discs and, where they are ``painted`` on the body,
    for its curvature. Internal markers are taken for balls, and left as they are."""

    def __init__(self, rig: StereoRig, rest: Array, kinds: NDArray[np.str_], painted: bool) -> None:
        """Take the markers' places at ``rest`` (m, 3) m in the left frame; ``kinds`` (m,)."""
        self.rig, self.painted = rig, painted
        self.on_body = kinds == "surface"
        self.flat = kinds != "internal"
        self.normals = np.zeros_like(rest)
        for kind in np.unique(kinds):
            self.normals[kinds == kind] = neighbour_normals(rest[kinds == kind], np.zeros(3))
        self._seen = np.zeros(len(rest), bool)
        self.rest = rest
        distance = np.linalg.norm(rest[:, None] - rest[None], axis=2)
        distance[:, ~self.on_body] = np.inf
        np.fill_diagonal(distance, np.inf)
        self._near = np.argsort(distance, axis=1)[:, :N_STRAINED]
        self._distance = np.take_along_axis(distance, self._near, axis=1)

    def middles(
        self, points: Triangulated, left: Blobs, right: Blobs, markers: Rows, places: Array, sigma: Array
    ) -> Triangulated:
        """Measure the middles (n, 3) of the discs ``markers`` (n,), triangulated from ``left``, ``right`` (n blobs).

        ``places`` (m, 3) m: where all markers are as far as is known, each to ``sigma`` (m,) m. What the curvature is
        not known to is in the covariances.
        """
        self._look_first(points, left, right, markers)
        n = self.normals[markers].copy()
        K, unsure = np.zeros((len(markers), 3, 3)), np.zeros((len(markers), 3, 3))
        axes = stretched_discs(self.rig, points.points, left.shapes, right.shapes, n)
        body, folded = self.on_body[markers], np.zeros(len(markers), bool)
        if body.any():
            sigma = np.where(self.on_body, sigma, np.inf)
            found = fit_quadrics(places, sigma, self.normals, markers[body])
            n[body] = self.normals[markers[body]] = found.normals
            axes = stretched_discs(self.rig, points.points, left.shapes, right.shapes, n)
            if self.painted:
                K[body] = found.tensors
                unsure[body] = self._unsure(points.points[body], axes[body], found)
                folded[body] = found.at_edge
            r2 = 0.5 * (axes**2).sum(axis=(1, 2))
            skewed = np.where(folded, FOLDED, SKEWED) * self._skewness(points, left, right)
            gradient = self._strain_gradient(markers, places, sigma) if self.painted else 0.0  # stiff ones do not
            stretched = UNEVEN_STRAIN * r2 / 4 * gradient
            unsure += np.where(body, stretched**2 + skewed**2, 0.0)[:, None, None] * EYE
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
        """Return (n, 3, 3) m2: what the curvatures' covariances leave of the middles.

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

    def _strain_gradient(self, markers: Rows, places: Array, sigma: Array) -> Array:
        """Return (n,) 1/m: how differently the neighbours have moved, over the squares of their distances (rms).

        How they turned with the body is no strain, and taken off where three or more are known.
        """
        near, d = self._near[markers], self._distance[markers]
        known = np.isfinite(d) & (sigma[near] < KNOWN_SIGMA)
        rest, now = (np.where(known[:, :, None], at[near] - at[markers][:, None], 0.0) for at in (self.rest, places))
        turned = np.where((known.sum(axis=1) >= TURN_KNOWN)[:, None, None], _turns(rest, now), EYE)
        apart = now - np.einsum("nij,nkj->nki", turned, rest)
        gradient = np.linalg.norm(apart, axis=2) / np.where(known, d, 1.0) ** 2
        out: Array = np.sqrt((np.where(known, gradient, 0.0) ** 2).sum(axis=1) / np.maximum(known.sum(axis=1), 1))
        return out

    def _skewness(self, points: Triangulated, left: Blobs, right: Blobs) -> Array:
        """Return (n,) m: how far the outlines are from ellipses."""
        if left.skewness_px is None or right.skewness_px is None:
            return np.zeros(len(left))
        focal = float(np.sqrt(abs(np.linalg.det(self.rig.left.camera_matrix[:2, :2]))))
        return np.maximum(left.skewness_px, right.skewness_px) * points.points[:, 2] / focal

    def _look_first(self, points: Triangulated, left: Blobs, right: Blobs, markers: Rows) -> None:
        """Take the normals of discs that are seen for the first time from their outlines: they are round then."""
        new = ~self._seen[markers]
        if not new.any():
            return
        m = markers[new]
        discs = fit_discs(self.rig, points.points[new], left.shapes[new], right.shapes[new], self.normals[m])
        length = np.linalg.norm(discs, axis=1)[:, None]
        self.normals[m] = np.where(np.isfinite(discs) & (length > 0), discs / length, self.normals[m])
        self._seen[m] = True


def _turns(source: Array, target: Array) -> Array:
    """Return the rotations (n, 3, 3) that take the offsets ``source`` (n, k, 3) nearest to ``target`` (Kabsch 1976)."""
    U, _, Vt = np.linalg.svd(np.swapaxes(target, 1, 2) @ source)
    U[:, :, 2] *= np.linalg.det(U @ Vt)[:, None]
    return np.asarray(U @ Vt)
