"""A small renderer for tests: discs on a curved body, seen by two pinhole cameras with lenses.

It shares no code with stereo_node's model of pictures: a disc is drawn by sampling every pixel's area, tracing each
sample's ray to the disc's plane, or to the ellipsoid that it is painted on (OpenCV's lens model, not ours), and
blurring with the exact Gaussian.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from livedeform.common.experiment.yaml_file import Markers
from livedeform.common.frames import apply, inverse, transform
from livedeform.common.types import Array, Image
from livedeform.stereo_node.boards.boards import Board
from livedeform.stereo_node.camera.rig import StereoRig, make_rig
from livedeform.stereo_node.discs.outlines import area_centre


def make_test_rig(width=1280, height=720, focal=1000.0, baseline=0.1, dist=(0.0,) * 5, converge=0.1) -> StereoRig:
    """Two cameras with a baseline in m, turned towards each other by ``converge`` rad in all."""
    K = np.array([[focal, 0, width / 2 - 0.5 + 3.0], [0, focal * 1.001, height / 2 - 0.5 - 2.0], [0, 0, 1]])
    R = Rotation.from_rotvec([0.002, converge, -0.001]).as_matrix()
    T = transform(R, -R @ np.array([baseline, 0.001, -0.0005]))
    camera = (width, height, K, np.asarray(dist, float), "plumb_bob")
    return make_rig(("left", *camera), ("right", *camera), T)


DOME = (0.06, 0.06, 0.045)  # semi-axes, m


def dome_markers(n=60, seed=0, radius=DOME[0], height=DOME[2], spacing=0.009) -> tuple[Markers, Array]:
    """``n`` irregular markers on a half ellipsoid that stands on z = 0, with their outward normals (n, 3)."""
    rng = np.random.default_rng(seed)
    points: list[Array] = []
    for _ in range(200_000):
        if len(points) == n:
            break
        d = rng.normal(size=3)
        d /= np.linalg.norm(d)
        if d[2] < 0.35:
            continue
        p = d * [radius, radius, height]
        if all(np.linalg.norm(p - q) > spacing for q in points):
            points.append(p)
    P = np.array(points)
    assert len(P) == n
    normals = P / np.array([radius, radius, height]) ** 2
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    markers = Markers(np.arange(100, 100 + n, dtype=np.uint32), P, np.full(n, np.nan), np.array(["surface"] * n))
    return markers, normals


def looking_down(distance=0.40, tilt=0.25, turn=0.3) -> Array:
    """T_phantom_left of a camera above the body, tilted by ``tilt`` rad and turned by ``turn`` rad about z."""
    R = Rotation.from_euler("z", turn).as_matrix() @ Rotation.from_euler("x", np.pi - tilt).as_matrix()
    centre = np.array([0.0, 0.0, 0.02])
    return transform(R, centre - R @ np.array([0.05, 0.0, distance]))


@dataclass(frozen=True)
class Look:
    """How a scene looks: grey values, blur sigma px (beside the pixel's own area), disc radius m, noise."""

    background: float = 190.0
    ink: float = 50.0
    blur_px: float = 0.6
    radius: float = 0.002
    noise: float = 2.0
    slope: float = 0.03  # grey values per pixel, of the light
    texture: float = 0.0  # amplitude of a smooth random texture
    grain: int = 5  # its seed
    painted_on: tuple[float, ...] | None = (
        None  # semi-axes (m) of the ellipsoid that the discs follow; None: flat discs
    )


def render(
    rig: StereoRig, T_phantom_left: Array, points: Array, normals: Array, look: Look, rng, side: str, rounded=True
) -> np.ndarray:
    """One grey picture (h, w) uint8 of discs at ``points`` (n, 3) with ``normals`` (n, 3), both in phantom."""
    camera = rig.left if side == "left" else rig.right
    T = inverse(T_phantom_left) if side == "left" else rig.T_right_left @ inverse(T_phantom_left)
    centres, directions = apply(T, points), normals @ T[:3, :3].T
    h, w = camera.height, camera.width
    cover = np.zeros((h, w))
    pixels, _ = cv2.projectPoints(centres, np.zeros(3), np.zeros(3), camera.camera_matrix, camera.dist_coeffs)
    pixels = pixels.reshape(-1, 2)
    n_sub = 6
    offsets = (np.arange(n_sub) + 0.5) / n_sub - 0.5
    for c, n, p in zip(centres, directions, pixels, strict=True):
        if n @ c >= 0 or not (15 < p[0] < w - 15 and 15 < p[1] < h - 15):
            continue
        half = int(np.ceil(1.3 * look.radius / c[2] * camera.camera_matrix[0, 0])) + 3 + int(3 * look.blur_px)
        x0, y0 = int(np.rint(p[0])) - half, int(np.rint(p[1])) - half
        size = 2 * half + 1
        u = (x0 + np.arange(size)[:, None] + offsets[None]).ravel()
        v = (y0 + np.arange(size)[:, None] + offsets[None]).ravel()
        if x0 < 0 or y0 < 0 or x0 + size > w or y0 + size > h:
            continue
        U, V = np.meshgrid(u, v)
        rays = _rays(camera, U.ravel(), V.ravel())
        if look.painted_on is None:
            depth = (n @ c) / (rays @ n)
        else:
            depth = _depth_on_ellipsoid(rays, T, np.array(look.painted_on))
        beyond = np.linalg.norm(rays * depth[:, None] - c, axis=1).reshape(size * n_sub, size * n_sub) - look.radius
        slope = np.hypot(*np.gradient(beyond))  # per sample, so that a sample cut by the rim counts with its share
        fine = np.clip(0.5 - beyond / slope, 0, 1).astype(np.float32)
        if look.blur_px:
            fine = cv2.GaussianBlur(fine, (0, 0), look.blur_px * n_sub, borderType=cv2.BORDER_REPLICATE)
        share = fine.reshape(size, n_sub, size, n_sub).mean(axis=(1, 3))
        patch = cover[y0 : y0 + size, x0 : x0 + size]
        np.maximum(patch, share, out=patch)
    ground = (
        look.background + look.slope * (np.arange(w)[None] - w / 2) + 0.5 * look.slope * (np.arange(h)[:, None] - h / 2)
    )
    if look.texture:
        # texture is fixed to the picture here: it is there to tempt the detector, not to be measured
        grain = cv2.GaussianBlur(np.random.default_rng(look.grain).normal(size=(h, w)), (0, 0), 3.0)
        ground = ground + look.texture * grain / grain.std()
    picture = ground * (1 - cover) + look.ink * (ground / look.background) * cover
    if not rounded:
        return picture
    return np.clip(np.round(picture + rng.normal(0, look.noise, picture.shape)), 0, 255).astype(np.uint8)


def _depth_on_ellipsoid(rays: Array, T: Array, semi_axes: Array) -> Array:
    """Where rays (n, 3) of the camera first meet the ellipsoid about the phantom's origin; far away where they miss."""
    d = rays @ T[:3, :3] / semi_axes
    o = -(T[:3, :3].T @ T[:3, 3]) / semi_axes
    a, b, c = (d * d).sum(axis=1), d @ o, o @ o - 1
    root = b * b - a * c
    return np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, 10.0)


def balls_inside(
    rig: StereoRig, T_phantom_left: Array, centres: Array, radius: float, index: float, side: str, semi_axes=DOME
) -> Array:
    """Share (h, w) of every pixel that balls at ``centres`` (n, 3) m in phantom cover, seen through the transparent
    ellipsoid: rays are traced through its exact surface by Snell's law."""
    camera = rig.left if side == "left" else rig.right
    T = inverse(T_phantom_left) if side == "left" else rig.T_right_left @ inverse(T_phantom_left)
    cover = np.zeros((camera.height, camera.width))
    v, u = np.mgrid[0 : camera.height : 4, 0 : camera.width : 4].reshape(2, -1).astype(float)
    coarse = _miss(camera, T, u, v, centres, index, np.array(semi_axes))
    n_sub = 5
    offsets = (np.arange(n_sub) + 0.5) / n_sub - 0.5
    for k, miss in enumerate(coarse.T):
        near = int(np.nanargmin(miss))
        half = int(2 * radius / T_distance(T, centres[k]) * camera.camera_matrix[0, 0]) + 8
        x0, y0, size = int(u[near]) - half, int(v[near]) - half, 2 * half + 1
        a = (x0 + np.arange(size)[:, None] + offsets[None]).ravel()
        b = (y0 + np.arange(size)[:, None] + offsets[None]).ravel()
        U, V = np.meshgrid(a, b)
        fine = _miss(camera, T, U.ravel(), V.ravel(), centres[k : k + 1], index, np.array(semi_axes))
        beyond = np.where(np.isfinite(fine[:, 0]), fine[:, 0], 1.0).reshape(size * n_sub, -1) - radius
        share = np.clip(0.5 - beyond / np.maximum(np.hypot(*np.gradient(beyond)), 1e-12), 0, 1)
        patch = cover[y0 : y0 + size, x0 : x0 + size]
        np.maximum(patch, share.reshape(size, n_sub, size, n_sub).mean(axis=(1, 3)), out=patch)
    return cover


def T_distance(T: Array, point: Array) -> float:
    """How far a point in phantom is from the camera T_camera_phantom, m."""
    return float(np.linalg.norm(T[:3, :3] @ point + T[:3, 3]))


def _miss(camera, T: Array, u: Array, v: Array, centres: Array, index: float, semi_axes: Array) -> Array:
    """(n, m) m: how far the rays of pixels (n,), refracted where they enter the ellipsoid, pass ``centres`` (m, 3)."""
    rays = _rays(camera, u, v)
    eye = -(T[:3, :3].T @ T[:3, 3])
    d = rays @ T[:3, :3]
    places = eye + d * _depth_on_ellipsoid(rays, T, semi_axes)[:, None]
    normals = places / semi_axes**2
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    d /= np.linalg.norm(d, axis=1)[:, None]
    # the part across the normal is divided by the index (Snell), the rest follows from unit length
    across = (d - (d * normals).sum(axis=1)[:, None] * normals) / index
    inside = across - np.sqrt(np.maximum(1 - (across**2).sum(axis=1), 0))[:, None] * normals
    offset = centres[None] - places[:, None]
    along = np.einsum("nmj,nj->nm", offset, inside)
    miss = np.linalg.norm(offset - along[:, :, None] * inside[:, None], axis=2)
    hit = np.linalg.norm(places, axis=1) < 2 * semi_axes.max()
    return np.where(hit[:, None], miss, np.nan)


def photographed(kind, seed):
    """A board in perspective, warped from a fine picture to four times the size, blurred, with noise 2; its points'
    true pixels (of circles the middles of their outlines)."""
    rng, scale, (w, h) = np.random.default_rng(seed), 4, (640, 480)
    if kind == "charuco":
        board = Board("charuco", 8, 6, 0.02, 0.014)
        flat = board.charuco().generateImage((1600, 1200), marginSize=0)
    elif kind == "circles":
        board, flat = Board("circles", 7, 5, 0.02), np.full((1200, 1600), 255, np.uint8)
        for x, y in (board.points[:, :2] / 0.02 + 1) * 200 - 0.5:
            cv2.circle(flat, (round(16 * x), round(16 * y)), 16 * 55, 0, -1, cv2.LINE_AA, shift=4)
    else:
        board = Board("checkerboard", 7, 5, 0.02)
        flat = np.kron(
            (np.add.outer(np.arange(6), np.arange(8)) % 2).astype(np.uint8) * 255, np.ones((200, 200), np.uint8)
        )
    flat = cv2.copyMakeBorder(flat, 200, 200, 200, 200, cv2.BORDER_CONSTANT, value=255)
    quad = np.array([[60, 60], [580, 60], [580, 420], [60, 420]]) + rng.uniform(-35, 35, (4, 2))
    b, a = flat.shape
    corners = np.array([[-0.5, -0.5], [a - 0.5, -0.5], [a - 0.5, b - 0.5], [-0.5, b - 0.5]], np.float32)
    M = cv2.getPerspectiveTransform(corners, ((quad + 0.5) * scale - 0.5).astype(np.float32))
    big = cv2.warpPerspective(flat, M, (w * scale, h * scale), flags=cv2.INTER_AREA, borderValue=255)
    picture = cv2.GaussianBlur(cv2.resize(big, (w, h), interpolation=cv2.INTER_AREA).astype(float), (0, 0), 0.6)
    noisy = np.clip(np.round(0.7 * picture + 30 + rng.normal(0, 2, picture.shape)), 0, 255).astype(np.uint8)
    angle = 2 * np.pi * np.arange(64) / 64
    rim = (55.0 if kind == "circles" else 0.0) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    places = ((board.points[:, :2] / 0.02 + 1) * 200 + 199.5)[:, None] + rim
    outline = np.concatenate([places, np.ones((*places.shape[:2], 1))], axis=2) @ M.T
    outline = (outline[..., :2] / outline[..., 2:] + 0.5) / scale - 0.5
    if kind != "circles":
        return board, noisy, outline[:, 0]
    inner = outline.mean(axis=1)
    return board, noisy, inner + area_centre(outline - inner[:, None])


def disc_picture(centres, radius, background, contrast, blur, size):
    """A float picture (height, width) of ``size`` (width, height) with discs of ``radius`` px at ``centres`` (n, 2),
    blurred by a Gaussian, and the Fisher information (n,) px^-2 that unit pixel noise leaves of one coordinate of a
    centre."""
    picture = np.full((size[1], size[0]), float(background))
    information = np.empty(len(centres))
    for k, (cx, cy) in enumerate(centres):
        half = int(radius + 4 * blur + 3)
        x0, y0 = int(cx) - half, int(cy) - half
        patches = [contrast * _disc(cx + dx - x0, cy - y0, radius, blur, 2 * half + 2) for dx in (0.0, 0.05, -0.05)]
        picture[y0 : y0 + 2 * half + 2, x0 : x0 + 2 * half + 2] += patches[0]
        information[k] = (((patches[1] - patches[2]) / 0.1) ** 2).sum()
    return picture, information


def _disc(cx, cy, radius, blur, size, n_sub=12):
    at = (np.arange(size * n_sub) + 0.5) / n_sub - 0.5
    fine = np.clip(0.5 + (radius - np.hypot(at[None] - cx, at[:, None] - cy)) * n_sub, 0, 1).astype(np.float32)
    fine = cv2.GaussianBlur(fine, (0, 0), blur * n_sub)
    return fine.reshape(size, n_sub, size, n_sub).mean(axis=(1, 3))


def tag_picture(seed: int, family: str = "DICT_APRILTAG_36h11", noise: float = 2.0):
    """A picture of twelve tags of 25 to 60 px in perspective, and their middles by code: flat pictures of OpenCV,
    warped at four times the size."""
    rng, scale, (w, h) = np.random.default_rng(seed), 4, (800, 600)
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, family))
    big, truth = np.full((h * scale, w * scale), 200.0, np.float32), {}
    # 168 is a multiple of either family's modules: OpenCV draws others as of different size
    corners = np.array([[-0.5, -0.5], [209.5, -0.5], [209.5, 209.5], [-0.5, 209.5]], np.float32)
    for code in range(12):
        flat = np.full((210, 210), 200.0, np.float32)
        flat[21:189, 21:189] = np.where(cv2.aruco.generateImageMarker(dictionary, code, 168) > 0, 200.0, 30.0)
        centre = np.array([110 + 190 * (code % 4), 110 + 190 * (code // 4)]) + rng.uniform(-20, 20, 2)
        turn = rng.uniform(0, 2 * np.pi)
        R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * rng.uniform(22, 40) * rng.uniform(0.75, 1.0, 2)
        quad = centre + square @ R.T + rng.uniform(-3, 3, (4, 2))
        M = cv2.getPerspectiveTransform(corners, ((quad + 0.5) * scale - 0.5).astype(np.float32))
        warped = cv2.warpPerspective(flat, M, (w * scale, h * scale), flags=cv2.INTER_LINEAR, borderValue=-1)
        big = np.where(warped >= 0, warped, big)
        middle = M @ np.array([104.5, 104.5, 1.0])
        truth[code] = (middle[:2] / middle[2] + 0.5) / scale - 0.5
    picture = cv2.GaussianBlur(cv2.resize(big, (w, h), interpolation=cv2.INTER_AREA), (0, 0), 0.6)
    return np.clip(np.round(picture + rng.normal(0, noise, picture.shape)), 0, 255).astype(np.uint8), truth


def _rays(camera, u, v):
    """Rays (n, 3) of pixels by OpenCV's own undistortion, which is exact enough without distortion and iterated with
    it.
    """
    pixels = np.stack([u, v], axis=1)
    if not np.any(camera.dist_coeffs):
        ideal = (pixels - camera.camera_matrix[:2, 2]) / np.diag(camera.camera_matrix)[:2]
    else:
        criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 50, 1e-10)
        known = pixels[:, None], camera.camera_matrix, camera.dist_coeffs
        if int(cv2.__version__.split(".")[0]) < 5:  # there the iterated one has a name of its own
            ideal = cv2.undistortPointsIter(*known, np.eye(3), np.eye(3), criteria)
        else:
            ideal = cv2.undistortPoints(*known, criteria=criteria)
        ideal = ideal.reshape(-1, 2)
    return np.hstack([ideal, np.ones((len(ideal), 1))])


def pair(rig, T_phantom_left, points, normals, look=None, seed=0, stamp_ns=0):
    """Left and right ``Image`` of the same moment."""
    look = look or Look()
    rng = np.random.default_rng(seed)
    return tuple(
        Image(stamp_ns, render(rig, T_phantom_left, points, normals, look, rng, side)) for side in ("left", "right")
    )
