"""A run for the viewer of rerun.io: an extra, ``pip install 'livedeform[rerun]'``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from livedeform.common.bags.recording import load_recording
from livedeform.common.errors import InputError
from livedeform.common.types import Array
from livedeform.report.playback import Playback, read_playback
from livedeform.report.plots import viridis
from livedeform.report.run.read import residuals_of
from livedeform.report.viewer import probe_of

BODY, PROBE, PREDICTED, ERROR = (185, 192, 198), (86, 180, 233), (0, 114, 178), (213, 94, 0)
RADIUS = 0.001  # m, of a drawn marker
MOST = 2000  # moments


def write_rerun(run: Path, out: Path) -> int:
    """Write a run's folder or recording as ``out`` (.rrd), in metres; give the number of moments.

    ``InputError`` where rerun-sdk is not installed, or nothing was compared.
    """
    try:
        import rerun as rr
    except ModuleNotFoundError as error:
        remedy = "pip install 'livedeform[rerun]', or leave --rerun out"
        raise InputError("rerun-sdk is not installed", where="--rerun", remedy=remedy) from error
    bag = run / "run.mcap" if run.is_dir() else run
    recording = load_recording(bag)
    residuals = [r for r in residuals_of(recording) if len(r.ids)]
    if not residuals:
        raise InputError("holds no errors of a model", where=str(run), remedy="make it with livedeform run")
    probe = probe_of(bag.parent / "experiment.yaml")
    playback = read_playback(bag, residuals, recording.poses, probe, recording.start_ns, MOST, most_bytes=10**10)
    stream = rr.RecordingStream("livedeform")
    stream.save(out)
    stream.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    _log_moments(rr, stream, playback)
    stream.flush()
    stream.disconnect()
    return len(playback.moments)


def _log_moments(rr: Any, stream: Any, playback: Playback) -> None:
    """Body, probe, markers and error arrows at each moment."""
    highest = max(float(m.residual.distances.max()) for m in playback.moments)
    if len(playback.path):
        stream.log("probe/path", rr.LineStrips3D([playback.path], colors=[PROBE]), static=True)
    if len(playback.probe_vertices):
        solid = rr.Mesh3D(
            vertex_positions=playback.probe_vertices, triangle_indices=playback.probe_triangles,
            vertex_colors=_all(PROBE, len(playback.probe_vertices)),
        )  # fmt: skip
        stream.log("probe/solid", solid, static=True)
    for moment in playback.moments:
        stream.set_time("recording", duration=moment.seconds)
        if len(playback.triangles) and len(moment.surface):
            body = rr.Mesh3D(
                vertex_positions=moment.surface, triangle_indices=playback.triangles,
                vertex_colors=_all(BODY, len(moment.surface)),
            )  # fmt: skip
            stream.log("body", body)
        if moment.T_probe is not None:
            place = rr.Transform3D(translation=moment.T_probe[:3, 3], mat3x3=moment.T_probe[:3, :3])
            stream.log("probe/solid", place)
        r = moment.residual
        colours = (255 * viridis(r.distances / highest if highest > 0 else r.distances))[:, :3].astype(np.uint8)
        stream.log("markers/measured", rr.Points3D(r.measured, colors=colours, radii=RADIUS))
        stream.log("markers/predicted", rr.Points3D(r.predicted, colors=[PREDICTED], radii=RADIUS))
        stream.log("markers/error", rr.Arrows3D(origins=r.predicted, vectors=r.errors, colors=[ERROR]))
        stream.log("rmse_mm", rr.Scalars(1e3 * float(np.sqrt(np.mean(r.distances**2)))))


def _all(colour: Sequence[int], n: int) -> Array:
    return np.tile(np.array(colour, np.uint8), (n, 1))
