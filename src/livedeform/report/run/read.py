"""Read what a run left in its folder: the evidence of its report."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from livedeform.common import topics as t
from livedeform.common.bags.read import read_bag
from livedeform.common.bags.recording import Recording, first_stamp_ns, load_recording, to_image
from livedeform.common.bags.types import RawMessage, decode
from livedeform.common.errors import InputError
from livedeform.common.experiment.schema import Experiment
from livedeform.common.frames import pose_matrix
from livedeform.common.types import Array, Image
from livedeform.compare_node.at_rest import read_at_rest
from livedeform.compare_node.coverage import read_coverage
from livedeform.compare_node.metrics import RunMetrics, run_metrics
from livedeform.compare_node.places import with_places
from livedeform.compare_node.residual import Residual
from livedeform.compare_node.surface_error import SURFACE_CSV, read_surface_error
from livedeform.compare_node.takes import ONE_TAKE
from livedeform.report.playback import Playback, read_playback
from livedeform.report.run.counts import describe_counts
from livedeform.report.run.evidence import RunEvidence, SurfaceMesh
from livedeform.stereo_node.camera.setup import rig_of

MOST_ON_PAGE = 30  # moments of the playback: the page stays small
OF_TORN = "run it again: its recording alone does not say what was counted"
MAX_PICTURE_GAP_NS = 100_000_000  # a picture further away does not show the moment

ABSOLUTE = re.compile(r"(?<![\w/:.])(?:/[^/\s'\",:;<>()\[\]{}]+){2,}/?")


def load_evidence(run_dir: Path, experiment: Experiment) -> RunEvidence:
    """Everything that the page shows of a run."""
    bag = run_dir / "run.mcap"
    recording = load_recording(bag, experiment)
    document = read_metrics(run_dir / "metrics.json", OF_TORN)
    long, short = _by_length(recording.metadata)
    residuals = residuals_of(recording)
    metrics = replace(
        with_places(run_metrics(residuals, experiment.thresholds.error), residuals, experiment.markers),
        interpolation_bound=_known(document.get("interpolation_bound")),
        interpolation_judged=_known(document.get("interpolation_judged")),
        coverage=read_coverage(document.get("coverage")),
        doubts=tuple(document.get("doubts", ())),
        wrong=tuple(document.get("wrong", ())),
        mesh=tuple((document.get("mesh") or {}).get("report", ())),
        surface=read_surface_error(document.get("surface_error")),
        rest=tuple(read_at_rest(r) for r in document.get("rest") or ()),
    )
    return RunEvidence(
        start_ns=recording.start_ns,
        residuals=residuals,
        metrics=metrics,
        predictions=recording.predictions,
        wrenches=recording.predicted_wrenches,
        surfaces=lambda stamp_ns: _surface_at(bag, stamp_ns),
        rig=rig_of(experiment, recording.camera_infos),
        T_phantom_left=None if recording.camera_pose is None else pose_matrix(recording.camera_pose),
        pictures=lambda stamp_ns: (_picture_at(bag, t.LEFT_IMAGE, stamp_ns), _picture_at(bag, t.RIGHT_IMAGE, stamp_ns)),
        playback=lambda: _playback(bag, recording, residuals, experiment),
        counts=[*describe_counts(_counts(document)), *((warning, "", "") for warning in recording.warnings)],
        facts=[*_facts(document, bag.name, metrics), *short],
        configuration="\n\n".join(long),
        distances=_distances(run_dir / SURFACE_CSV),
    )


def read_metrics(file: Path, remedy: str) -> dict[str, Any]:
    """Read what a run says of itself; ``InputError`` with a ``remedy`` where that is torn."""
    try:
        return dict(json.loads(file.read_text()))
    except (OSError, ValueError, TypeError) as error:
        raise InputError("is not what livedeform run wrote", where=str(file), remedy=remedy) from error


def _known(value: Any) -> float:
    """Return a number of ``metrics.json``, where null is what is not known."""
    return float("nan") if value is None else float(value)


def _distances(path: Path) -> Mapping[str, Array]:
    """Read the distances of points without ids, moment by moment (m); nothing where none were measured."""
    if not path.is_file():
        return {}
    table = np.genfromtxt(path, delimiter=",", names=True, ndmin=1)
    return {name: np.atleast_1d(table[name]) for name in table.dtype.names or ()}


def _facts(document: Mapping[str, Any], bag: str, metrics: RunMetrics) -> list[tuple[str, str]]:
    """Return what was run, where that contradicts the model at rest, and what is expected of another take."""
    takes = (document.get("next_take") or {}).get("text", ONE_TAKE)
    rest = [("at rest", r.text) for r in metrics.rest if r.contradicts]
    return [
        ("recording", str(document.get("bag", bag))),
        ("another take", takes),
        *rest,
        *(("mesh", m) for m in metrics.mesh),
    ]


def residuals_of(recording: Recording) -> list[Residual]:
    """The run's own residuals (``/compare/markers``), with the covariances of the measured markers."""
    measured = {frame.stamp_ns: frame for frame in recording.marker_frames}
    residuals = []
    for frame in recording.errors:
        source = measured.get(frame.stamp_ns)
        if source is not None and np.array_equal(frame.ids, source.ids):
            covariances = source.covariances
        else:
            covariances = np.full((len(frame.ids), 3, 3), np.nan)
            if source is not None:
                _, rows, columns = np.intersect1d(frame.ids, source.ids, return_indices=True)
                covariances[rows] = source.covariances[columns]
        residuals.append(
            Residual(frame.stamp_ns, frame.ids, frame.measured, frame.measured - frame.errors, covariances)
        )
    return residuals


def _playback(
    bag: Path, recording: Recording, residuals: Sequence[Residual], experiment: Experiment
) -> Playback | None:
    """The run over time; None where nothing was compared."""
    kept = [r for r in residuals if len(r.ids)]
    if not kept:
        return None
    return read_playback(bag, kept, recording.poses, experiment.probe, recording.start_ns, MOST_ON_PAGE)


def _nearest(bag_path: Path, names: Sequence[str], stamp_ns: int, gap_ns: int) -> RawMessage | None:
    """The message, which has a header, of the first topic that is there whose stamp is nearest, within ``gap_ns``."""
    with read_bag(bag_path) as bag:
        present = [name for name in names if name in bag.topics][:1]
        best, distance = None, gap_ns + 1
        for raw in bag.messages(present):
            stamp = first_stamp_ns(raw)
            if stamp is not None and abs(stamp - stamp_ns) < distance:
                best, distance = raw, abs(stamp - stamp_ns)
        return best


def _picture_at(bag_path: Path, topic: str, stamp_ns: int) -> Image | None:
    raw = _nearest(bag_path, (topic, topic + "/compressed"), stamp_ns, MAX_PICTURE_GAP_NS)
    return None if raw is None else to_image(raw)


def _surface_at(bag_path: Path, stamp_ns: int) -> SurfaceMesh | None:
    """The predicted surface of ``/fem/mesh``: corners of triangles, put together again."""
    raw = _nearest(bag_path, (t.FEM_MESH,), stamp_ns, 2 * MAX_PICTURE_GAP_NS)
    if raw is None:
        return None
    corners = np.array([(p.x, p.y, p.z) for p in decode(raw).points])
    if not len(corners) or not np.isfinite(corners).all():
        return None
    _, first, row = np.unique(np.round(corners, 9), axis=0, return_index=True, return_inverse=True)
    return SurfaceMesh(corners[first], row.reshape(-1, 3).astype(np.int64))


def _by_length(metadata: Mapping[str, str]) -> tuple[list[str], list[tuple[str, str]]]:
    """Metadata of many lines (configurations), and rows of short ones."""
    said = {key: without_folders(text) for key, text in metadata.items()}
    long = [f"# {key}\n{text}" for key, text in said.items() if "\n" in text or len(text) > 400]
    short = [(key.replace("_", " "), text) for key, text in said.items() if "\n" not in text and len(text) <= 400]
    return long, short


def without_folders(text: str) -> str:
    """The text with absolute paths cut down to their last parts: a report is handed on, whose folders are nobody's
    business. Names of topics stay."""
    return ABSOLUTE.sub(lambda found: found[0] if found[0] in t.TOPICS else Path(found[0]).name, text)


def _counts(document: Mapping[str, Any]) -> dict[str, Any]:
    """The counts of ``metrics.json``, whatever nodes they come from."""
    return dict(document.get("counts", {}))
