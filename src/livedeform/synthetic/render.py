"""Pictures of the deformed body: perspective, shading, painted markers, texture, the probe in front, blur and noise.

The surface is drawn as small triangles into a depth buffer ``SUPERSAMPLE`` times finer than the picture, so that a
marker is the true projection of the painted, deformed disc. At a marker's rim a sample counts with the share of it that
is painted: whole samples would move its centre by 0.01 px at random.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from livedeform.common.compiled import njit
from livedeform.common.types import Array
from livedeform.synthetic.rig import Camera
from livedeform.synthetic.truth.hexmesh import point_normals

SUPERSAMPLE = 3
LIGHT = np.array([0.35, -0.45, 0.82])


@dataclass(frozen=True)
class Paint:
    """Describe how the body looks: grey levels of its parts (0..255), and the markers' ``radius`` m."""

    body: float = 165.0
    marker: float = 32.0
    probe: float = 95.0
    background: float = 0.0
    radius: float = 0.0022
    texture: float = 5.0
    blur_px: float = 0.6
    noise: float = 1.0


@dataclass(frozen=True)
class Scene:
    """The surface as triangles (k, 3) of ``n`` points; ``reference`` (n, 3) m their painted places; ``markers`` (m, 3)
    m."""

    triangles: NDArray[np.int64]
    reference: Array
    markers: Array
    paint: Paint

    @cached_property
    def grey(self) -> Array:
        """(n,): the texture's grey level at each point: smooth random waves on the body."""
        rng = np.random.default_rng(7)
        waves = rng.normal(size=(12, 3)) * 250.0
        phase = rng.uniform(0, 2 * np.pi, 12)
        level: Array = self.paint.texture * np.cos(self.reference @ waves.T + phase).mean(1) * np.sqrt(12)
        return level

    @cached_property
    def nearest(self) -> NDArray[np.int64]:
        """(n,): the marker that may touch triangles round each point, -1 for none."""
        distance, marker = cKDTree(self.markers).query(self.reference)
        edge = np.linalg.norm(np.diff(self.reference[self.triangles], axis=1), axis=2).max()
        return np.where(distance < self.paint.radius + edge, marker, -1)


def render(
    scene: Scene, points: Array, probe: tuple[Array, NDArray[np.int64]] | None, camera: Camera, T: Array, seed: int
) -> NDArray[np.uint8]:
    """The picture (h, w) of surface points (n, 3) m by a camera with T_camera_phantom (4, 4)."""
    s = SUPERSAMPLE
    w, h = camera.size
    image = np.full((h * s, w * s), scene.paint.background)
    depth = np.full((h * s, w * s), np.inf)
    normal = point_normals(points, scene.triangles)
    light = LIGHT / np.linalg.norm(LIGHT)
    eye = -T[:3, :3].T @ T[:3, 3]
    view = eye - points
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    half = (view + light) / np.linalg.norm(view + light, axis=1, keepdims=True)
    shade = 0.30 + 0.70 * np.maximum(normal @ light, 0.0)
    gloss = 18.0 * np.maximum((normal * half).sum(1), 0.0) ** 40
    bright = (scene.paint.body + scene.grey) * shade
    pixels, z = _pixels(points, camera, T, s)
    _draw(
        scene.triangles, pixels, z, bright, gloss, scene.paint.marker * shade, scene.reference, scene.markers,
        scene.nearest, scene.paint.radius, image, depth,
    )  # fmt: skip
    _draw_probe(scene, probe, camera, T, light, image, depth)
    picture = image.reshape(h, s, w, s).mean((1, 3))
    picture = cv2.GaussianBlur(picture, (0, 0), scene.paint.blur_px)
    rng = np.random.default_rng(seed)
    lit = picture > 0.5  # the dark background is below the sensor's black level: it compresses to nothing
    noisy = picture + np.where(lit, rng.normal(size=picture.shape) * scene.paint.noise, 0.0)
    clipped: NDArray[np.uint8] = np.clip(np.round(noisy), 0, 255).astype(np.uint8)
    return clipped


def _draw_probe(
    scene: Scene,
    probe: tuple[Array, NDArray[np.int64]] | None,
    camera: Camera,
    T: Array,
    light: Array,
    image: Array,
    depth: Array,
) -> None:
    """Draw the probe's facets, lit from ``light``, into ``image`` and ``depth``; nothing without a probe."""
    if probe is not None:
        p, triangles = probe
        pixels, z = _pixels(p, camera, T, SUPERSAMPLE)
        facet = np.cross(p[triangles[:, 1]] - p[triangles[:, 0]], p[triangles[:, 2]] - p[triangles[:, 0]])
        facet /= np.maximum(np.linalg.norm(facet, axis=1, keepdims=True), 1e-12)
        grey = scene.paint.probe * (0.45 + 0.55 * np.maximum(facet @ light, 0.0))
        flat = triangles.reshape(-1)
        own = np.arange(len(flat)).reshape(-1, 3)
        nothing = np.zeros(len(flat))
        none = np.full(len(flat), -1)
        _draw(
            own, pixels[flat], z[flat], np.repeat(grey, 3), nothing, nothing, p[flat], scene.markers, none, 0.0, image,
            depth,
        )  # fmt: skip


def _pixels(points: Array, camera: Camera, T: Array, s: int) -> tuple[Array, Array]:
    x = points @ T[:3, :3].T + T[:3, 3]
    return (camera.project(x) + 0.5) * s - 0.5, x[:, 2]


@njit(cache=True)
def _draw(triangles, pixels, z, bright, gloss, dark, reference, markers, nearest, radius, image, depth) -> None:
    """Triangles into ``image`` where they are nearer than ``depth``; attributes are interpolated perspectively."""
    h, w = image.shape
    for k in range(len(triangles)):
        a, b, c = triangles[k]
        x0, y0 = pixels[a]
        x1, y1 = pixels[b]
        x2, y2 = pixels[c]
        area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
        if area == 0.0 or z[a] <= 0.0 or z[b] <= 0.0 or z[c] <= 0.0:
            continue
        marker = max(nearest[a], nearest[b], nearest[c])
        lo_x, hi_x = max(0, int(np.ceil(min(x0, x1, x2)))), min(w - 1, int(np.floor(max(x0, x1, x2))))
        lo_y, hi_y = max(0, int(np.ceil(min(y0, y1, y2)))), min(h - 1, int(np.floor(max(y0, y1, y2))))
        for v in range(lo_y, hi_y + 1):
            for u in range(lo_x, hi_x + 1):
                l1 = ((u - x0) * (y2 - y0) - (x2 - x0) * (v - y0)) / area
                l2 = ((x1 - x0) * (v - y0) - (u - x0) * (y1 - y0)) / area
                l0 = 1.0 - l1 - l2
                if l0 < -1e-9 or l1 < -1e-9 or l2 < -1e-9:
                    continue
                w0, w1, w2 = l0 / z[a], l1 / z[b], l2 / z[c]
                here = 1.0 / (w0 + w1 + w2)
                if here >= depth[v, u]:
                    continue
                depth[v, u] = here
                w0, w1, w2 = w0 * here, w1 * here, w2 * here
                grey = w0 * bright[a] + w1 * bright[b] + w2 * bright[c]
                if marker >= 0:
                    ink = _ink(
                        a, b, c, l1, l2, (y2 - y0) / area, (y0 - y1) / area, (x0 - x2) / area, (x1 - x0) / area,
                        z, reference, markers[marker], radius,
                    )  # fmt: skip
                    grey += ink * (w0 * dark[a] + w1 * dark[b] + w2 * dark[c] - grey)
                image[v, u] = grey + w0 * gloss[a] + w1 * gloss[b] + w2 * gloss[c]


@njit(cache=True)
def _ink(a, b, c, l1, l2, l1_u, l2_u, l1_v, l2_v, z, reference, marker, radius):
    """Return the share of a sample within ``radius`` of the marker.

    From the marker's distance there, one sample to the right and one down.
    """
    here = _distance(a, b, c, l1, l2, z, reference, marker)
    right = _distance(a, b, c, l1 + l1_u, l2 + l2_u, z, reference, marker) - here
    down = _distance(a, b, c, l1 + l1_v, l2 + l2_v, z, reference, marker) - here
    slope = np.sqrt(right * right + down * down) + 1e-15
    return min(max(0.5 + (radius - here) / slope, 0.0), 1.0)


@njit(cache=True)
def _distance(a, b, c, l1, l2, z, reference, marker):
    """Return the distance of the marker from the painted place under a sample with the picture's barycentric l1, l2."""
    w0, w1, w2 = (1.0 - l1 - l2) / z[a], l1 / z[b], l2 / z[c]
    total = w0 + w1 + w2
    d = 0.0
    for i in range(3):
        p = (w0 * reference[a, i] + w1 * reference[b, i] + w2 * reference[c, i]) / total - marker[i]
        d += p * p
    return np.sqrt(d)


def probe_surface(kind: str, size: tuple[float, ...]) -> tuple[Array, NDArray[np.int64]]:
    """The probe's outline as triangles in its own frame."""
    if kind == "box":
        a, b, c = size[0] / 2, size[1] / 2, size[2]
        corners = np.array([[x, y, z] for x in (-a, a) for y in (-b, b) for z in (-c, 0.0)])
        quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
        return corners, np.array([t for q in quads for t in ((q[0], q[1], q[2]), (q[0], q[2], q[3]))])
    radius = size[0]
    n = 32
    angle = 2 * np.pi * np.arange(n) / n
    if kind == "cylinder":
        ring = np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])
        levels = [(1.0, 0.0), (1.0, -size[1])]
    else:
        ring = np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])
        latitude = np.linspace(-np.pi / 2, np.pi / 2, 13)
        levels = [(float(np.cos(l)), radius * (float(np.sin(l)) - 1.0)) for l in latitude]
    points = np.concatenate([np.column_stack([ring * r, np.full(n, z)]) for r, z in levels])
    points = np.vstack([points, [0.0, 0.0, levels[0][1]], [0.0, 0.0, levels[-1][1]]])
    triangles = []
    for level in range(len(levels) - 1):
        for i in range(n):
            a, b = level * n + i, level * n + (i + 1) % n
            triangles += [(a, b, b + n), (a, b + n, a + n)]
    last = (len(levels) - 1) * n
    for i in range(n):
        j = (i + 1) % n
        triangles += [(i, j, len(points) - 2), (last + i, last + j, len(points) - 1)]
    return points, np.array(triangles)
