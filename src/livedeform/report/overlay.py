"""The predicted surface laid over the stereo pictures (figure 3.4 of the thesis that the project comes from)."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from livedeform.common.frames import apply, inverse
from livedeform.common.types import Array, Image
from livedeform.stereo_node.camera.rig import StereoRig

MAX_WIDTH = 1280  # px of a picture on the page
QUALITY = 82


@dataclass(frozen=True)
class Overlay:
    """One picture with vector paths over it, in the page picture's pixels; ``stroke`` is the unit of line widths.

    ``mm_per_px`` is the size of one pixel of the recorded picture at the markers' mean distance.
    """

    tag: str
    src: str
    width: int
    height: int
    stroke: float
    surface: str
    outline: str
    measured: tuple[tuple[float, float], ...]
    predicted: str
    mm_per_px: float


def overlays(
    tag: str, left: Image | None, right: Image | None, rig: StereoRig, T_phantom_left: Array,
    surface: Array, triangles: NDArray[np.int64], measured: Array, predicted: Array,
) -> list[Overlay]:  # fmt: skip
    """One ``Overlay`` per picture that is there; positions (n, 3) m in ``phantom``, onto the raw pictures."""
    T_left_phantom = inverse(T_phantom_left)
    points = [apply(T_left_phantom, p) for p in (surface, measured, predicted)]
    out = []
    for side, image in enumerate((left, right)):
        if image is None:
            continue
        camera = (rig.left, rig.right)[side]
        seen = [apply(np.eye(4) if side == 0 else rig.T_right_left, p) for p in points]
        px = [rig.project(p)[side] for p in points]
        corner, far = _window(np.concatenate(px), image)
        picture, scale = _data_uri(image, corner, far)
        surface_px, measured_px, predicted_px = ((p - corner) * scale for p in px)
        width, height = np.round((far - corner) * scale).astype(int)
        front = triangles[_front_facing(seen[0], triangles)]
        depth = float(np.nanmean(seen[2][:, 2])) if len(seen[2]) else float(np.nanmean(seen[0][:, 2]))
        out.append(
            Overlay(
                tag=f"{tag}, {'left' if side == 0 else 'right'} camera",
                src=picture,
                width=int(width),
                height=int(height),
                stroke=width / 620.0,
                surface=_edges_path(surface_px, front),
                outline=_outline_path(surface_px, front, int(width), int(height)),
                measured=tuple((round(float(x), 1), round(float(y), 1)) for x, y in measured_px if np.isfinite(x + y)),
                predicted=_crosses(predicted_px, 5.0 * width / 620.0),
                mm_per_px=1e3 * depth / camera.camera_matrix[0, 0],
            )
        )
    return out


def _window(px: Array, image: Image) -> tuple[Array, Array]:
    """The part of the picture that shows the body: its box with a third as much room around it, in whole pixels."""
    height, width = image.pixels.shape[:2]
    limit = np.array([width, height], float)
    seen = px[np.isfinite(px).all(axis=1)]
    if not len(seen):
        return np.zeros(2), limit
    low, high = seen.min(axis=0), seen.max(axis=0)
    room = 0.33 * float((high - low).max())
    low, high = np.clip(np.floor(low - room), 0, limit), np.clip(np.ceil(high + room), 0, limit)
    return (low, high) if (high - low).min() >= 16 else (np.zeros(2), limit)


def _data_uri(image: Image, corner: Array, far: Array) -> tuple[str, float]:
    """Return that part of the picture as an inline JPEG, between half and all of ``MAX_WIDTH``, and its scale."""
    from PIL import Image as Pillow

    pixels = image.pixels[..., ::-1] if image.encoding == "bgr8" else image.pixels
    (x0, y0), (x1, y1) = corner.astype(int), far.astype(int)
    picture = Pillow.fromarray(np.ascontiguousarray(pixels[y0:y1, x0:x1]))
    scale = float(np.clip(1.0, MAX_WIDTH / 2 / picture.width, MAX_WIDTH / picture.width))
    if scale != 1.0:
        size = (round(picture.width * scale), round(picture.height * scale))
        picture = picture.resize(size, Pillow.Resampling.LANCZOS)
    stream = io.BytesIO()
    picture.save(stream, "JPEG", quality=QUALITY)
    return "data:image/jpeg;base64," + base64.b64encode(stream.getvalue()).decode(), scale


def _front_facing(seen: Array, triangles: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Triangles (k,) whose outward side looks at the camera; ``seen`` (n, 3) in the optical frame."""
    a, b, c = (seen[triangles[:, i]] for i in range(3))
    facing: NDArray[np.bool_] = np.einsum("ij,ij->i", np.cross(b - a, c - a), a) < 0.0
    return facing


def _edges_path(px: Array, triangles: NDArray[np.int64]) -> str:
    """Draw every edge once, in lines as long as can be, each point in tenths of a pixel from the one before: a page
    holds six such pictures."""
    edges = np.unique(np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    edges = edges[np.isfinite(px[edges]).all(axis=(1, 2))]
    tenths = np.round(np.nan_to_num(px) * 10).astype(int)
    parts = []
    for line in _lines(edges):
        x, y = tenths[line[0]] / 10
        steps = np.diff(tenths[line], axis=0) / 10
        parts.append(f"M{x:g} {y:g}l" + " ".join(f"{dx:g} {dy:g}" for dx, dy in steps))
    return "".join(parts)


def _lines(edges: NDArray[np.int64]) -> Iterator[list[int]]:
    """Give the ``edges`` (k, 2) as lines of nodes, each edge once."""
    ways: dict[int, set[int]] = {}
    for a, b in edges.tolist():
        ways.setdefault(a, set()).add(b)
        ways.setdefault(b, set()).add(a)
    for begin in sorted(ways, key=lambda node: len(ways[node]) % 2 == 0):  # a line ends where an odd number meets
        while ways[begin]:
            line = [begin]
            while ways[line[-1]]:
                there = ways[line[-1]].pop()
                ways[there].discard(line[-1])
                line.append(there)
            yield line


def _outline_path(px: Array, triangles: NDArray[np.int64], width: int, height: int) -> str:
    """Outline of the union of the triangles: they are painted, and the painted region's border is followed."""
    from contourpy import contour_generator
    from PIL import Image as Pillow
    from PIL import ImageDraw

    mask = Pillow.new("L", (width + 2, height + 2), 0)
    draw = ImageDraw.Draw(mask)
    for corners in px[triangles] + 1.0:
        if np.isfinite(corners).all():
            draw.polygon([(float(x), float(y)) for x, y in corners], fill=1, outline=1)
    lines = contour_generator(z=np.asarray(mask, float)).lines(0.5)
    closed = [np.asarray(line)[::2] - 1.0 for line in lines if len(line) > 40]
    return "".join("M" + "L".join(f"{x:.0f} {y:.0f}" for x, y in line) + "Z" for line in closed)


def _crosses(px: Array, size: float) -> str:
    return "".join(
        f"M{x - size:.1f} {y:.1f}h{2 * size:.1f}M{x:.1f} {y - size:.1f}v{2 * size:.1f}"
        for x, y in px
        if np.isfinite(x + y)
    )
