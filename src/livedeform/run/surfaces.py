"""Compare measured points of a surface (``/stereo/surface``) with the predicted surface, from a run's recording."""

from __future__ import annotations

import csv
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from livedeform.common import topics as t
from livedeform.common.bags import layouts
from livedeform.common.bags.read import BagReader, read_bag
from livedeform.common.bags.recording import first_stamp_ns
from livedeform.common.bags.types import RawMessage, decode
from livedeform.common.errors import MeshError, RecordingError
from livedeform.common.types import Array
from livedeform.compare_node.surface_error import FRAMES, FrameDistances, SurfaceError, surface_error
from livedeform.fem_node.mesh.triangle_distance import TriangleTree, closest_features

MAX_GAP_NS = 500_000_000  # between predictions that are interpolated
SAMPLES = 2000  # places on the predicted surface at which is looked for measured points
NEAR = 3.0  # times the points' distance from each other: as near as that is covered
SEED = 20210531


@dataclass(frozen=True)
class Cloud:
    """Points (n, 3) m of one moment, with covariances (n, 3, 3) m2, NaN where nobody states them."""

    stamp_ns: int
    points: Array
    covariances: Array


def compare_surfaces(bag_path: Path) -> tuple[SurfaceError, list[FrameDistances]] | None:
    """Compare every measured cloud with the surface predicted at its stamp, interpolated between two predictions and
    never beyond them; None where no cloud was measured."""
    with read_bag(bag_path) as bag:
        if not bag.topics.get(t.STEREO_SURFACE) or not bag.topics[t.STEREO_SURFACE].count:
            return None
        triangles = predicted_triangles(bag)
        refused: Counter[str] = Counter()
        found = []
        for cloud, surface in _paired(bag, refused) if triangles is not None else ():
            assert triangles is not None
            try:
                found.append(distances(cloud, surface, triangles))
            except MeshError:  # a boundary that touches itself has no inside
                refused["no_closed_surface"] += 1
        n_measured = bag.topics[t.STEREO_SURFACE].count
    return surface_error(found, n_measured, +refused), found


def distances(cloud: Cloud, surface: Array, triangles: NDArray[np.int64]) -> FrameDistances:
    """Measure how far a cloud's points lie from a closed surface (m, 3), signed by its outward normal."""
    place, normal, _, _ = closest_features(TriangleTree.build(surface, triangles), cloud.points)
    gap = cloud.points - place
    size = np.linalg.norm(gap, axis=1)
    signed = np.where(np.einsum("ni,ni->n", gap, normal) < 0.0, -size, size)
    along = np.where(size[:, None] > 0.0, gap / np.maximum(size, np.finfo(float).tiny)[:, None], normal)
    sigmas = np.sqrt(np.einsum("ni,nij,nj->n", along, cloud.covariances, along))
    return FrameDistances(cloud.stamp_ns, cloud.points, signed, sigmas, coverage(place, surface, triangles))


def coverage(places: Array, surface: Array, triangles: NDArray[np.int64]) -> float:
    """Return the share of the surface's area within `NEAR` times their spacing of the measured points' nearest
    ``places`` (n, 3) on it, whatever its triangles."""
    if len(places) < 2:
        return 0.0
    tree = KDTree(places)
    spacing = float(np.median(tree.query(places, 2)[0][:, 1]))
    corners = surface[triangles]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    rng = np.random.default_rng(SEED)
    of = corners[rng.choice(len(triangles), SAMPLES, p=area / area.sum())]
    share = rng.dirichlet(np.ones(3), SAMPLES)
    near, _ = tree.query(np.einsum("nk,nki->ni", share, of))
    return float(np.mean(near <= NEAR * spacing))


def predicted_triangles(bag: BagReader) -> NDArray[np.int64] | None:
    """Return the triangles (k, 3) as rows of ``/fem/surface``, from the first mesh that was published with it."""
    stamp, points = None, np.zeros((0, 3))
    for raw in bag.messages([name for name in (t.FEM_SURFACE, t.FEM_MESH) if name in bag.topics]):
        if raw.topic == t.FEM_SURFACE:
            stamp, points = first_stamp_ns(raw), layouts.points(layouts.unpack(decode(raw)))
        elif first_stamp_ns(raw) == stamp and len(points) and np.isfinite(points).all():
            corners = np.array([(p.x, p.y, p.z) for p in decode(raw).points])
            return np.asarray(KDTree(points).query(corners)[1].reshape(-1, 3), np.int64)
    return None


def _paired(bag: BagReader, refused: Counter[str]) -> Iterator[tuple[Cloud, Array]]:
    """Yield each cloud with the surface (m, 3) m predicted at its stamp; count the others by reason."""
    waiting: deque[Cloud] = deque()
    before: tuple[int, Array] | None = None
    for raw in bag.messages([name for name in (t.STEREO_SURFACE, t.FEM_SURFACE) if name in bag.topics]):
        if raw.topic == t.STEREO_SURFACE:
            cloud = _cloud(raw)
            if cloud is None:
                refused["damaged"] += 1
            elif before is not None and cloud.stamp_ns == before[0] and np.isfinite(before[1]).all():
                yield cloud, before[1]
            else:
                waiting.append(cloud)
                waiting = deque(sorted(waiting, key=lambda c: c.stamp_ns))
            continue
        after = (first_stamp_ns(raw) or 0, layouts.points(layouts.unpack(decode(raw))))
        while waiting and waiting[0].stamp_ns <= after[0]:
            cloud = waiting.popleft()
            surface, why = _at(cloud.stamp_ns, before, after)
            if surface is None:
                refused[why] += 1
            else:
                yield cloud, surface
        before = after
    refused["extrapolation"] += len(waiting)


def _at(stamp_ns: int, before: tuple[int, Array] | None, after: tuple[int, Array]) -> tuple[Array | None, str]:
    """Return the surface at a stamp between two predictions; None and the reason where they do not say."""
    ends = [after] if stamp_ns == after[0] else [] if before is None else [before, after]
    if not ends or ends[0][0] > stamp_ns:
        return None, "extrapolation"
    if not all(np.isfinite(points).all() for _, points in ends):
        return None, "not_converged"
    if ends[-1][0] - ends[0][0] > MAX_GAP_NS:
        return None, "gap"
    if len(ends) == 1:
        return ends[0][1], ""
    share = (stamp_ns - ends[0][0]) / (ends[1][0] - ends[0][0])
    return (1.0 - share) * ends[0][1] + share * ends[1][1], ""


def _cloud(raw: RawMessage) -> Cloud | None:
    """Read a cloud, without points that are not finite; None where it cannot be read, or is empty."""
    try:
        rows = layouts.unpack(decode(raw))
        points = layouts.points(rows)
    except RecordingError:
        return None
    good = np.isfinite(points).all(axis=1)
    stamp = first_stamp_ns(raw)
    if stamp is None or not good.any():
        return None
    covariances = layouts.read_covariances(rows)[good]
    covariances[layouts.wrong_covariances(covariances)] = np.nan
    return Cloud(stamp, points[good], covariances)


def write_surface_csv(path: Path, frames: Sequence[FrameDistances]) -> None:
    """Write ``surface.csv``: a row per moment, lengths in m."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(FRAMES)
        writer.writerows(f.row for f in frames)
