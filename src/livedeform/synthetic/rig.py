"""The stereo rig of the synthetic experiments: what it is, and what its calibration says it is."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from livedeform.common.errors import InputError
from livedeform.common.frames import fit_rigid, inverse, make_a_frame
from livedeform.common.types import Array


@dataclass(frozen=True)
class Camera:
    """A pinhole with two radial coefficients: ``f`` px, ``centre`` (2,) px, ``size`` (w, h) px, ``k`` (2,)."""

    f: float
    centre: tuple[float, float]
    size: tuple[int, int]
    k: tuple[float, float] = (0.0, 0.0)

    def project(self, x: Array) -> Array:
        """Points (n, 3) in the camera's frame -> pixels (n, 2): u = f x (1 + k1 r^2 + k2 r^4) + c."""
        ideal = x[:, :2] / x[:, 2:]
        r2 = (ideal**2).sum(1, keepdims=True)
        pixels: Array = self.f * ideal * (1 + self.k[0] * r2 + self.k[1] * r2**2) + np.array(self.centre)
        return pixels

    def rays(self, pixels: Array) -> Array:
        """Pixels (n, 2) -> ideal image points (n, 2) (fixed point)."""
        seen = (pixels - np.array(self.centre)) / self.f
        ideal: Array = seen.copy()
        for _ in range(30):
            r2 = (ideal**2).sum(1, keepdims=True)
            ideal = seen / (1 + self.k[0] * r2 + self.k[1] * r2**2)
        return ideal


@dataclass(frozen=True)
class Rig:
    """Two cameras; ``T_phantom_left`` (4, 4), ``T_right_left`` (4, 4)."""

    left: Camera
    right: Camera
    T_phantom_left: Array
    T_right_left: Array

    def views(self) -> tuple[tuple[Camera, Array], tuple[Camera, Array]]:
        """Each camera with its T_camera_phantom."""
        T = inverse(self.T_phantom_left)
        return (self.left, T), (self.right, self.T_right_left @ T)

    def project(self, points: Array) -> Array:
        """Points (n, 3) in phantom -> pixels (n, 4): left u v, right u v."""
        return np.hstack([camera.project(points @ T[:3, :3].T + T[:3, 3]) for camera, T in self.views()])

    def moved(self, translation: Array, rotation: Array) -> Rig:
        """Both cameras moved as one body, in the left optical frame."""
        from scipy.spatial.transform import Rotation

        D = np.eye(4)
        D[:3, :3] = Rotation.from_rotvec(rotation).as_matrix()
        D[:3, 3] = translation
        return replace(self, T_phantom_left=self.T_phantom_left @ D)

    def triangulate(self, pixels: Array, sigma_px: float) -> tuple[Array, Array, Array]:
        """Pixels (n, 4) -> points (n, 3) m in the left frame, covariances (n, 3, 3), rms reprojection error (n,) px.

        Gauss-Newton on the reprojection error from the rays' midpoint.
        """
        a = self.left.rays(pixels[:, :2])
        b = self.right.rays(pixels[:, 2:])
        R, t = self.T_right_left[:3, :3], self.T_right_left[:3, 3]
        x = _midpoint(a, b, R, t)
        local = replace(self, T_phantom_left=np.eye(4))
        for _ in range(4):
            J, residual = _jacobian(local, x), pixels - local.project(x)
            normal = np.einsum("nki,nkj->nij", J, J)
            x = x + np.linalg.solve(normal, np.einsum("nki,nk->ni", J, residual)[:, :, None])[:, :, 0]
        return x, sigma_px**2 * np.linalg.inv(normal), np.sqrt((residual**2).mean(1))


def _jacobian(rig: Rig, x: Array, h: float = 1e-6) -> Array:
    return np.stack([(rig.project(x + h * e) - rig.project(x - h * e)) / (2 * h) for e in np.eye(3)], axis=2)


def _midpoint(a: Array, b: Array, R: Array, t: Array) -> Array:
    centre = -R.T @ t
    da = np.hstack([a, np.ones((len(a), 1))])
    db = np.hstack([b, np.ones((len(b), 1))]) @ R
    aa, ab, bb = (da * da).sum(1), (da * db).sum(1), (db * db).sum(1)
    ca, cb = da @ centre, db @ centre
    s = (bb * ca - ab * cb) / (aa * bb - ab**2)
    u = (ab * ca - aa * cb) / (aa * bb - ab**2)
    middle: Array = 0.5 * (s[:, None] * da + centre + u[:, None] * db)
    return middle


def look_at(eye: Array, target: Array) -> Array:
    """T_phantom_camera of a camera at ``eye`` that looks at ``target``, the phantom's up being up in the picture."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, np.array([0.0, 0.0, 1.0]))
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    T[:3, 3] = eye
    return T


def stereo_rig(
    target: Array,
    distance: float = 0.40,
    elevation_deg: float = 50.0,
    baseline: float = 0.10,
    f: float = 1000.0,
    size: tuple[int, int] = (640, 480),
    k: tuple[float, float] = (0.0, 0.0),
) -> Rig:
    """Two cameras at the -y side, ``elevation_deg`` above the horizon, toed in on ``target``."""
    e = np.radians(elevation_deg)
    middle = target + distance * np.array([0.0, -np.cos(e), np.sin(e)])
    half = np.array([baseline / 2, 0.0, 0.0])
    T_left, T_right = look_at(middle - half, target), look_at(middle + half, target)
    centre = (size[0] / 2 - 0.5, size[1] / 2 - 0.5)
    camera = Camera(f, centre, size, k)
    return Rig(camera, camera, T_left, inverse(T_right) @ T_left)


def register(points_left: Array, points_phantom: Array) -> Array:
    """T_phantom_left from the markers (n, 3) m at rest; InputError where they leave a turn open."""
    if not make_a_frame(points_phantom):
        raise InputError(
            f"the {len(points_phantom)} markers on surface and support that both cameras see leave open "
            "how the cameras are turned",
            where="markers",
            remedy="ask for more of them, so that three are seen that are on no line",
        )
    return fit_rigid(points_left, points_phantom)
