"""Heights between triangulated points, with what noise and calibration leave open."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from livedeform.common.types import Array

__all__ = ["Height", "height", "plane_height"]


@dataclass(frozen=True)
class Height:
    """A height along ``up`` and its standard deviation from the points' noise and, common to all, from the calibration;
    m."""

    value: float
    sigma_noise: float
    sigma_systematic: float

    @property
    def sigma(self) -> float:
        """One sigma of both together."""
        return float(np.hypot(self.sigma_noise, self.sigma_systematic))


def height(top: Array, bottom: Array, up: Array, top_cov: Array, bottom_cov: Array, scale_sigma: float = 0.0) -> Height:
    """Measure the height of the points ``top`` (k, 3) above ``bottom`` (m, 3), as the difference of their means along
    ``up`` (3,) (thesis, 2.2 and 2.4: one point each). ``scale_sigma``: relative uncertainty of the rig's scale."""
    up = np.asarray(up, float) / np.linalg.norm(up)
    value = float((top.mean(axis=0) - bottom.mean(axis=0)) @ up)
    variance = (
        float(up @ top_cov.sum(axis=0) @ up) / len(top) ** 2
        + float(up @ bottom_cov.sum(axis=0) @ up) / len(bottom) ** 2
    )
    return Height(value, float(np.sqrt(variance)), abs(value) * scale_sigma)


def plane_height(top: Array, plane: Array, top_cov: Array, plane_cov: Array, scale_sigma: float = 0.0) -> Height:
    """Measure the height of ``top`` (3,) above the plane through ``plane`` (k >= 3, 3), by weighted least squares along
    its normal."""
    weights = 1 / np.trace(plane_cov, axis1=1, axis2=2)
    middle = weights @ plane / weights.sum()
    normal = np.linalg.svd((plane - middle) * np.sqrt(weights)[:, None])[2][2]
    normal = normal * (np.sign((top - middle) @ normal) or 1.0)
    # foot of the perpendicular in plane coordinates: the plane's height there is linear in its points' heights
    axes = np.linalg.svd(np.eye(3) - np.outer(normal, normal))[0][:, :2]
    A = np.hstack([np.ones((len(plane), 1)), (plane - middle) @ axes])
    at = np.concatenate([[1.0], (top - middle) @ axes])
    gain = at @ np.linalg.solve(A.T @ (weights[:, None] * A), A.T * weights)
    value = float((top - middle) @ normal)
    variance = float(normal @ top_cov @ normal) + float(gain**2 @ np.einsum("i,kij,j->k", normal, plane_cov, normal))
    return Height(value, float(np.sqrt(variance)), abs(value) * scale_sigma)
