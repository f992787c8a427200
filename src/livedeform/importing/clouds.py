"""Points of a surface without identity (tables of DIC tools, scans) as a bag of ``/stereo/surface``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh

import livedeform
from livedeform.common.bags.recording_writer import RecordingWriter
from livedeform.common.bags.write import BagWriter
from livedeform.common.errors import InputError, RecordingError
from livedeform.common.experiment.plausibility import read_body
from livedeform.common.experiment.schema import Experiment
from livedeform.common.experiment.yaml_file import files_of, load_experiment
from livedeform.common.types import Array
from livedeform.fem_node.mesh.tet_mesh import IntArray
from livedeform.fem_node.model import PhantomModel
from livedeform.importing.c3d import HIGHEST_RATE, START_NS
from livedeform.importing.cloud_pose import CloudPose, lay_on
from livedeform.importing.points import Understanding, scale_of
from livedeform.importing.tables import OneMoment, displacements_said, in_order, moments_of, read_moment
from livedeform.outputs import prepared

SCANS = (".ply", ".stl", ".obj")
MOST = 20_000  # points at rest that are registered


@dataclass(frozen=True)
class Placing:
    """Say how clouds are brought into the phantom's frame: laid on the ``experiment``'s body (None: they are in it) by
    those of the seconds of ``rest``; ``near`` and ``keep`` as for `lay_on`."""

    experiment: Path | None = None
    rest: tuple[float, float] = (0.0, 0.5)
    near: bool = False
    keep: bool = False


def import_clouds(
    files: Sequence[Path], out: Path, how: Understanding, placing: Placing | None = None, *, preview: bool = False,
    force: bool = False,
) -> list[str]:  # fmt: skip
    """Write ``out/<first file>.mcap`` of files of one moment each (with ``preview`` nothing); gives lines about it."""
    ordered = in_order(files)
    moments, remarks = _moments(ordered, how)
    experiment = load_experiment(placing.experiment) if placing is not None and placing.experiment else None
    said = "taken to be in the phantom's frame"
    about = {"source": ordered[0].name, "livedeform": livedeform.__version__}
    if experiment is not None:
        assert placing is not None
        pose, on = _placed(moments, experiment, placing)
        moments = [(s, pose.moved(points)) for s, points in moments]
        said = f"{pose.text}; the surface is {on}"
        at_rest = np.concatenate([points for s, points in moments if placing.rest[0] <= s < placing.rest[1]])
        about |= {"registration": said, "registration_sigma_m": f"{pose.sigma_at(at_rest):.4g}"}
    size = " x ".join(f"{1e3 * d:.1f}" for d in np.ptp(np.concatenate([c for _, c in moments]), axis=0))
    counts = [len(c) for _, c in moments]
    line = (
        f"{len(moments)} moments{moments_of(ordered)[1]} in {moments[-1][0] - moments[0][0]:.3f} s "
        f"({how.rate_hz:.4g} Hz), {min(counts)} to {max(counts)} points without ids within {size} mm, {said}{remarks}"
    )
    if preview:
        return [f"{ordered[0].name} and {len(ordered) - 1} more: {line}", "nothing was written: this is a preview"]
    name = f"{ordered[0].stem}.mcap"
    inputs = [*files, *(files_of(experiment) if experiment is not None else [])]
    with (
        prepared(out, [name], force=force, inputs=inputs, alone=False) as draft,
        BagWriter(draft / name, about, atomic=True) as bag,
    ):
        writer = RecordingWriter(bag)
        for s, points in moments:
            writer.surface_points(START_NS + round(s * 1e9), points)
    return [f"{out / name}: {line}"]


def _moments(ordered: Sequence[Path], how: Understanding) -> tuple[list[tuple[float, Array]], str]:
    """Return the time s of each moment that is kept and its points (n, 3) m, and in words what was added to them and
    how many points of all were exactly 0, 0, 0, as depth cameras write what they did not see."""
    read = [(path, _read(path)) for path in ordered]
    scans = all(path.suffix.lower() in SCANS for path in ordered)
    remarks = "" if scans else f"; {displacements_said(read)}"
    every = [moment.points for _, moment in read]
    n_zero = sum(int((points == 0.0).all(axis=1).sum()) for points in every)
    if n_zero:
        remarks += f"; left out, as not measured: {n_zero} points at exactly 0, 0, 0"
    clouds = [points[np.isfinite(points).all(axis=1) & points.any(axis=1)][:: how.thin] for points in every]
    empty = next((path for path, c in zip(ordered, clouds, strict=True) if not len(c)), None)
    if empty is not None:
        raise RecordingError("holds no points", where=str(empty), remedy="export it again, or leave it out")
    stated = sorted({moment.unit for _, moment in read if moment.unit})
    if len(stated) > 1 and not how.unit:
        raise RecordingError(
            f"the files are in {' and '.join(stated)}", where=str(ordered[0].parent), remedy="export all in one unit"
        )
    scale = scale_of(ordered[0], np.concatenate(clouds), how.unit or next(iter(stated), ""))
    if not 0 < how.rate_hz < HIGHEST_RATE:
        raise InputError("files of one moment each do not say when", where=str(ordered[0]), remedy="say --rate HZ")
    seconds = moments_of(ordered)[0] / how.rate_hz
    first, last = how.crop or (0.0, np.inf)
    kept = [(float(s), scale * c) for s, c in zip(seconds, clouds, strict=True) if first <= s <= last]
    if not kept:
        raise InputError("no frame lies in the time that is kept", where="--crop", remedy="give other seconds")
    return kept, remarks


def _placed(moments: Sequence[tuple[float, Array]], experiment: Experiment, placing: Placing) -> tuple[CloudPose, str]:
    """Return the pose that lays the points at rest on the body, and in words what surface that is."""
    still = [points for s, points in moments if placing.rest[0] <= s < placing.rest[1]]
    if not still:
        raise InputError("no moment lies in the time of rest", where="--rest", remedy="give other seconds")
    vertices, triangles, on = surface_at_rest(experiment)
    points = np.concatenate(still)
    points = points[:: -(-len(points) // MOST)]
    return lay_on(points, vertices, triangles, near=placing.near, keep=placing.keep), on


def surface_at_rest(experiment: Experiment) -> tuple[Array, IntArray, str]:
    """Return the body's surface before anything but its weight and loads acts: vertices (n, 3) m, triangles (k, 3), and
    in words whether it is the file's or predicted from it. One that is let go later is held as it was scanned until
    then. ``ConvergenceError`` where it finds no equilibrium."""
    phantom = experiment.phantom
    loaded = phantom.configuration == "loaded"
    as_scanned = phantom.gravity == phantom.scan_gravity if loaded else not any(phantom.gravity)
    if experiment.timeline.release > 0.0 or (as_scanned and not experiment.loads):
        body = read_body(experiment)
        return body.vertices, body.triangles, "the experiment's file"
    rest = PhantomModel.from_experiment(experiment).rest(needed=True)
    return rest.surface, np.asarray(rest.triangles, np.int64), "what the model predicts at rest"


def _read(path: Path) -> OneMoment:
    """Read the points of one moment, of a table or a scan."""
    if path.suffix.lower() not in SCANS:
        return read_moment(path)
    try:
        scan = trimesh.load(path, process=False)
        points = np.asarray(getattr(scan, "vertices", np.zeros((0, 3))), float).reshape(-1, 3)
    except Exception as error:  # whatever a damaged file makes of a reader
        raise RecordingError(f"cannot be read ({error})", where=str(path), remedy="export it again") from error
    return OneMoment(points)
