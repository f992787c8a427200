"""A run as time series for ParaView: predicted surface, markers with errors, probe (VTU files and PVD lists)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import meshio
import numpy as np
from numpy.typing import NDArray

from livedeform.common.bags.read import read_bag
from livedeform.common.bags.recording import Recording, load_recording
from livedeform.common.errors import InputError
from livedeform.common.experiment.probe_mesh import probe_mesh
from livedeform.common.experiment.schema import Experiment
from livedeform.common.frames import apply, pose_matrix
from livedeform.common.types import Array, Pose
from livedeform.compare_node.residual import Residual
from livedeform.report.playback import surface_triangles, surfaces_of
from livedeform.report.run.read import residuals_of

NS = 1e-9


@dataclass
class Series:
    """A time series that is being written: one VTU file per moment, and in the end the list of them."""

    folder: Path
    name: str
    steps: list[tuple[float, str]] = field(default_factory=list)

    def add(self, seconds: float, points: Array, cells: Mapping[str, NDArray[Any]], data: Mapping[str, Any]) -> None:
        """Write one moment; ``points`` (n, 3) m, ``data`` by name (n, ...)."""
        file = f"{self.name}_{len(self.steps):05d}.vtu"
        mesh = meshio.Mesh(points, dict(cells), point_data={key: np.asarray(value) for key, value in data.items()})
        mesh.write(self.folder / file)
        self.steps.append((seconds, file))

    def close(self) -> None:
        """Write ``name.pvd``, which ParaView opens, unless there is no moment."""
        if not self.steps:
            return
        rows = "".join(
            f'    <DataSet timestep="{seconds:.9g}" part="0" file={quoteattr(file)}/>\n' for seconds, file in self.steps
        )
        head = '<?xml version="1.0"?>\n<VTKFile type="Collection" version="0.1">\n  <Collection>\n'
        (self.folder / f"{self.name}.pvd").write_text(f"{head}{rows}  </Collection>\n</VTKFile>\n")


def write_series(run: Path, experiment: Experiment | None, out: Path) -> dict[str, int]:
    """Write ``surface``, ``markers`` and ``probe`` (where the experiment has one) of a run's recording into ``out``.

    Gives the number of moments of each. Times are seconds since the recording's start, everything else in SI:
    ``displacement`` is from the first predicted surface, ``error`` is measured - predicted.
    """
    recording = load_recording(run)
    residuals = [r for r in residuals_of(recording) if len(r.ids)]
    if not residuals:
        raise InputError("holds no errors of a model", where=str(run), remedy="make it with livedeform run")
    written = [
        _surfaces(run, recording, out),
        _markers(recording, residuals, out),
        *([_probe(recording, residuals, experiment, out)] if experiment is not None and experiment.probe else []),
    ]
    for series in written:
        series.close()
    return {series.name: len(series.steps) for series in written if series.steps}


def _surfaces(run: Path, recording: Recording, out: Path) -> Series:
    series = Series(out, "surface")
    with read_bag(run) as bag:
        surfaces = surfaces_of(bag)
        triangles = surface_triangles(bag)
    first: Array | None = None
    for stamp, points in sorted(surfaces.items()):
        first = points if first is None or len(first) != len(points) else first
        data = {"displacement": points - first}
        series.add((stamp - recording.start_ns) * NS, points, {"triangle": triangles}, data)
    return series


def _markers(recording: Recording, residuals: Sequence[Residual], out: Path) -> Series:
    """The measured markers as points."""
    series = Series(out, "markers")
    for r in residuals:
        each = np.arange(len(r.ids))[:, None]
        data = {
            "id": r.ids.astype(np.int64), "error": r.errors, "error_length": r.distances, "predicted": r.predicted,
            "sigma": np.sqrt(np.trace(r.covariances, axis1=1, axis2=2) / 3.0),
        }  # fmt: skip
        series.add((r.stamp_ns - recording.start_ns) * NS, r.measured, {"vertex": each}, data)
    return series


def _probe(recording: Recording, residuals: Sequence[Residual], experiment: Experiment, out: Path) -> Series:
    """The probe's surface where its recorded pose nearest to each compared moment puts it."""
    series = Series(out, "probe")
    assert experiment.probe is not None  # the caller
    vertices, triangles = probe_mesh(experiment.probe)
    poses: Sequence[Pose] = recording.poses
    if not poses:
        return series
    stamps = np.array([p.stamp_ns for p in poses])
    for r in residuals:
        pose = poses[int(np.abs(stamps - r.stamp_ns).argmin())]
        points = apply(pose_matrix(pose), vertices)
        series.add((r.stamp_ns - recording.start_ns) * NS, points, {"triangle": triangles}, {})
    return series
