"""Read runs, and the differences between them where both measured the same marker at the same stamp."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from livedeform.common.bags.read import read_bag
from livedeform.common.bags.recording import load_recording
from livedeform.common.errors import InputError
from livedeform.common.experiment.yaml_file import FILE_NAME, load_experiment
from livedeform.common.types import Array, Ids
from livedeform.compare_node.metrics import (
    RunMetrics,
    Statistic,
    correlation_frames,
    difference_of_rms,
    rmse,
    run_metrics,
)
from livedeform.compare_node.places import with_places
from livedeform.compare_node.residual import Residual
from livedeform.comparing.identity import digest_of, is_part
from livedeform.comparing.takes import Take, read_take
from livedeform.outputs import RECORDING
from livedeform.report.run.read import read_metrics, residuals_of

FEWEST = 3  # frames of a marker for a difference
OF_TORN = "run it again, or move the file away to compare without it"


@dataclass(frozen=True)
class ComparedRun:
    """One run: its ``name`` among the others, the verdict and the recording's name as its own results have them, and
    its errors; ``take``: what it says as one take of several, None where its results are not beside it: then the
    ``digest`` of its recording, empty where that is not known."""

    name: str
    path: Path
    verdict: str
    bag: str
    residuals: tuple[Residual, ...]
    metrics: RunMetrics
    start_ns: int
    take: Take | None = None
    digest: str = ""

    @property
    def source(self) -> str:
        """Return what tells its recording from others; empty where that is not known."""
        return self.digest if self.take is None else self.take.source


@dataclass(frozen=True)
class MarkerDifference:
    """The difference of one run's rms error of a marker from the reference's, m, over ``n`` common frames."""

    id: int
    n: int
    reference: float
    other: float
    difference: Statistic


@dataclass(frozen=True)
class Difference:
    """A run against the reference, over what both compared: ``n_frames`` frames with ``n`` errors; rms errors and
    their difference in m, with 95 % intervals of whole frames drawn in blocks for both runs at once."""

    name: str
    n_frames: int
    n: int
    reference: float
    other: float
    difference: Statistic
    markers: tuple[MarkerDifference, ...]


def load_runs(paths: Sequence[Path]) -> list[ComparedRun]:
    """Read runs' folders (or their ``run.mcap``); ``InputError`` for one that compared nothing."""
    names = distinct_names(paths)
    return [_load(path, name) for path, name in zip(paths, names, strict=True)]


def distinct_names(paths: Sequence[Path]) -> list[str]:
    """The shortest ends of the paths that differ; a path that is there twice gets a number."""
    parts = [(p.parent if p.name == RECORDING else p).resolve().parts for p in paths]
    names = [p[-1] for p in parts]
    for depth in range(2, max(len(p) for p in parts) + 1):
        if len(set(names)) == len(names):
            break
        names = [str(Path(*p[-depth:])) for p in parts]
    return [n if names.count(n) == 1 else f"{n} ({names[: i + 1].count(n)})" for i, n in enumerate(names)]


def _load(path: Path, name: str) -> ComparedRun:
    bag = path / RECORDING if path.is_dir() else path
    if not bag.is_file():
        raise InputError("is no run", where=str(path), remedy="name the folder that livedeform run wrote")
    recording = load_recording(bag)
    residuals = tuple(r for r in residuals_of(recording) if len(r.ids))
    if not residuals:
        raise InputError("holds no errors of a model", where=str(path), remedy="make it with livedeform run")
    file = bag.parent / "metrics.json"
    document = read_metrics(file, OF_TORN) if file.is_file() else {}
    metrics = run_metrics(residuals, float(document.get("threshold") or np.inf))
    experiment = bag.parent / FILE_NAME
    if experiment.is_file():
        metrics = with_places(metrics, residuals, load_experiment(experiment, geometry=False).markers)
    verdict = str(document.get("verdict", "not judged"))
    take = read_take(path, name) if document else None
    digest = _digest_of(bag) if take is None else ""
    ran = str(document.get("bag", ""))
    return ComparedRun(name, path, verdict, ran, residuals, metrics, recording.start_ns, take, digest)


def _digest_of(bag: Path) -> str:
    """Return what tells a run's recording from others, as its own recording has it; empty where that is of a part."""
    with read_bag(bag) as recorded:
        return "" if is_part(recorded.metadata) else digest_of(recorded)


def compared(reference: ComparedRun, other: ComparedRun) -> Difference | None:
    """The difference other - reference over common stamps and markers; None where there are none in common, or where
    they ran other recordings, whose stamps may be alike."""
    if reference.source and other.source and reference.source != other.source:
        return None
    pairs = _pairs(reference.residuals, other.residuals)
    if not pairs:
        return None
    by_frame = [lengths for _, lengths in pairs]
    pooled = np.concatenate(by_frame)
    block = _block([float(np.mean(x[:, 1] ** 2 - x[:, 0] ** 2)) for x in by_frame])
    return Difference(
        name=other.name,
        n_frames=len(pairs),
        n=len(pooled),
        reference=rmse(pooled[:, 0]),
        other=rmse(pooled[:, 1]),
        difference=difference_of_rms(*_sums(by_frame), block),
        markers=_by_marker(pairs),
    )


def _pairs(reference: Sequence[Residual], other: Sequence[Residual]) -> list[tuple[Ids, Array]]:
    """Return for each common stamp the common ids (n,) and the lengths (n, 2) m of both errors."""
    known = {r.stamp_ns: r for r in reference}
    pairs = []
    for b in other:
        a = known.get(b.stamp_ns)
        if a is None:
            continue
        ids, i, j = np.intersect1d(a.ids, b.ids, return_indices=True)
        if len(ids):
            pairs.append((ids, np.column_stack([a.distances[i], b.distances[j]])))
    return pairs


def _sums(by_frame: Sequence[Array]) -> tuple[Array, np.ndarray]:
    """Return each frame's sums of squares (m, 2) m2, and its numbers of errors (m,), of lengths (n, 2) m."""
    return np.array([(x**2).sum(axis=0) for x in by_frame]), np.array([len(x) for x in by_frame])


def _by_marker(pairs: Sequence[tuple[Ids, Array]]) -> tuple[MarkerDifference, ...]:
    ids, lengths = np.concatenate([ids for ids, _ in pairs]), np.concatenate([lengths for _, lengths in pairs])
    order = np.argsort(ids, kind="stable")  # the frames of a marker stay in their order
    markers, first = np.unique(ids[order], return_index=True)
    rows = []
    for marker, track in zip(markers, np.split(lengths[order], first[1:]), strict=True):
        if len(track) < FEWEST:
            continue
        squares = track**2
        block = _block((squares[:, 1] - squares[:, 0]).tolist())
        difference = difference_of_rms(squares, np.ones(len(track)), block)
        rows.append(MarkerDifference(int(marker), len(track), rmse(track[:, 0]), rmse(track[:, 1]), difference))
    return tuple(rows)


def _block(series: Sequence[float]) -> int:
    """A block longer than the correlation time of the frames' differences."""
    return max(1, round(2 * correlation_frames(np.array(series))))
