"""Points of a surface without identity (tables of DIC tools, scans) as a bag of ``/stereo/surface``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh

import livedeform
from livedeform.common.bags.recording_writer import RecordingWriter
from livedeform.common.bags.write import BagWriter
from livedeform.common.errors import InputError, RecordingError
from livedeform.common.types import Array
from livedeform.importing.c3d import HIGHEST_RATE, START_NS
from livedeform.importing.points import Understanding, scale_of
from livedeform.importing.tables import in_order, read_moment
from livedeform.outputs import prepared

SCANS = (".ply", ".stl", ".obj")


def import_clouds(
    files: Sequence[Path], out: Path, how: Understanding, *, preview: bool = False, force: bool = False
) -> list[str]:
    """Write ``out/<first file>.mcap`` of files of one moment each (with ``preview`` nothing); gives lines about it."""
    ordered = in_order(files)
    read = [_read(path) for path in ordered]
    clouds = [points[np.isfinite(points).all(axis=1)][:: how.thin] for points, _ in read]
    empty = next((path for path, c in zip(ordered, clouds, strict=True) if not len(c)), None)
    if empty is not None:
        raise RecordingError("holds no points", where=str(empty), remedy="export it again, or leave it out")
    stated = next((unit for _, unit in read if unit), "")
    scale = scale_of(ordered[0], np.concatenate(clouds), how.unit or stated)
    if not 0 < how.rate_hz < HIGHEST_RATE:
        raise InputError("files of one moment each do not say when", where=str(ordered[0]), remedy="say --rate HZ")
    seconds = np.arange(len(clouds)) / how.rate_hz
    first, last = how.crop or (0.0, np.inf)
    kept = [(s, scale * c) for s, c in zip(seconds, clouds, strict=True) if first <= s <= last]
    if not kept:
        raise InputError("no frame lies in the time that is kept", where="--crop", remedy="give other seconds")
    size = " x ".join(f"{1e3 * d:.1f}" for d in np.ptp(np.concatenate([c for _, c in kept]), axis=0))
    counts = [len(c) for _, c in kept]
    said = (
        f"{len(kept)} moments in {kept[-1][0] - kept[0][0]:.3f} s ({how.rate_hz:.4g} Hz), {min(counts)} to "
        f"{max(counts)} points without ids within {size} mm, taken to be in the phantom's frame"
    )
    if preview:
        return [f"{ordered[0].name} and {len(ordered) - 1} more: {said}", "nothing was written: this is a preview"]
    name = f"{ordered[0].stem}.mcap"
    about = {"source": ordered[0].name, "livedeform": livedeform.__version__}
    with (
        prepared(out, [name], force=force, inputs=files, alone=False) as draft,
        BagWriter(draft / name, about, atomic=True) as bag,
    ):
        writer = RecordingWriter(bag)
        for s, points in kept:
            writer.surface_points(START_NS + round(s * 1e9), points)
    return [f"{out / name}: {said}"]


def _read(path: Path) -> tuple[Array, str]:
    """Read the points (n, 3) of one moment and their unit (empty: not stated)."""
    if path.suffix.lower() not in SCANS:
        points, _, unit = read_moment(path)
        return points, unit
    try:
        scan = trimesh.load(path, process=False)
        points = np.asarray(getattr(scan, "vertices", np.zeros((0, 3))), float).reshape(-1, 3)
    except Exception as error:  # whatever a damaged file makes of a reader
        raise RecordingError(f"cannot be read ({error})", where=str(path), remedy="export it again") from error
    return points, ""
