"""The page of a run: verdict, error over time, on the surface, on the pictures, per marker, worst moments, counts."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from livedeform.common.experiment.schema import Experiment
from livedeform.compare_node.judgement import decimals, judge
from livedeform.compare_node.metrics import Level, RunMetrics, rmse, run_metrics
from livedeform.compare_node.residual import Residual
from livedeform.report.page import Table, Tile, Verdict, write_page
from livedeform.report.run.charts import (
    distance_chart,
    on_surface_chart,
    over_time_chart,
    overlaid_pictures,
    per_marker_chart,
    pictures_caption,
    playback_chart,
)
from livedeform.report.run.evidence import RunEvidence
from livedeform.report.run.moments import interesting_moments
from livedeform.report.run.read import load_evidence
from livedeform.report.run.summary import RunSummary
from livedeform.report.text import date, interval, mm

N_WORST = 5


def write_report(run_dir: Path, experiment: Experiment) -> Path:
    """Write ``run_dir/report.html`` from ``run.mcap`` and ``metrics.json`` in the same folder."""
    return write_run_page(run_dir / "report.html", load_evidence(run_dir, experiment), experiment)


def write_run_page(path: Path, evidence: RunEvidence, experiment: Experiment) -> Path:
    """Write the page of a run to ``path``."""
    residuals = [r for r in evidence.residuals if len(r.ids)]
    run = RunSummary(
        evidence,
        experiment,
        evidence.metrics or run_metrics(residuals, experiment.thresholds.error),
        np.array([(r.stamp_ns - evidence.start_ns) * 1e-9 for r in residuals]),
        np.array([rmse(r.distances) for r in residuals]),
    )
    moments = interesting_moments(residuals, evidence)
    over_time = over_time_chart(run, residuals, moments)
    on_surface = on_surface_chart(run, moments)
    per_marker = per_marker_chart(run)
    playback, distance = playback_chart(run), distance_chart(run)
    pictures = overlaid_pictures(run, moments)
    return write_page(
        path,
        "run.html.j2",
        title=experiment.name,
        kind="run report",
        charts=[c for c in (over_time, distance, on_surface, playback, per_marker) if c],
        subtitle=_subtitle(run),
        verdict=_verdict(run),
        tiles=_tiles(run),
        over_time=over_time,
        distance=distance,
        on_surface=on_surface,
        states=list(dict.fromkeys(t.meta for t in on_surface.figure.data)) if on_surface else [],
        per_marker=per_marker,
        playback=playback,
        marker_table=_marker_table(run),
        pictures=pictures,
        moments=[name for name, _ in pictures],
        pictures_caption=pictures_caption(pictures),
        worst=_worst_table(run, residuals),
        counts=Table(("what", "count", "what it means"), tuple(evidence.counts), numbers=(1,)),
        run_table=Table(("what", "value"), tuple(evidence.facts)),
        configuration=evidence.configuration,
    )


TONES = {Level.OK: "good", Level.WARN: "warn", Level.ERROR: "bad", Level.STALE: "neutral"}


def _verdict(run: RunSummary) -> Verdict:
    judgement = judge(run.metrics)
    return Verdict(TONES[judgement.level], judgement.said, judgement.because)


def _tiles(run: RunSummary) -> list[Tile]:
    m = run.metrics
    digits = decimals(m.rmse.value, m.mean.value)
    floor = f"noise alone: {mm(m.noise_floor, digits)}" if np.isfinite(m.noise_floor) else "no covariances recorded"
    return [
        Tile("rmse", mm(m.rmse.value, digits), "mm", interval(m.rmse, digits)),
        Tile("mean error", mm(m.mean.value, digits), "mm", interval(m.mean, digits)),
        Tile("95th percentile", mm(m.p95.value, digits), "mm", interval(m.p95, digits)),
        Tile("largest error", mm(m.max, digits), "mm", floor),
        Tile("errors", f"{m.n}", "", f"{m.n_frames} frames, worth {m.n_effective:.0f} independent ones"),
        *_coverage_tiles(m),
    ]


def _coverage_tiles(m: RunMetrics) -> list[Tile]:
    c = m.coverage
    if c is None:
        return []
    share = f"{100 * m.relative:.0f}" if np.isfinite(m.relative) else "–"
    pressed = f"{c.presses_compared} of {c.presses} presses, {c.deepest_compared} of {c.deepest} deepest moments"
    return [
        Tile("compared", f"{c.frames_compared} of {c.frames_measured}", "frames", pressed),
        Tile("error over motion", share, "%", f"the markers moved {mm(c.motion_rms)} mm rms"),
    ]


def _subtitle(run: RunSummary) -> str:
    length = f"{run.seconds[-1] - run.seconds[0]:.1f} s" if len(run.seconds) else "no frames"
    effects = ", ".join(e.name for e in run.experiment.effects) or "none"
    compared = f"{length} compared, {len(run.metrics.markers)} markers"
    return f"{date(run.evidence.start_ns)}{compared}; effects in the model: {effects}"


def _marker_table(run: RunSummary) -> Table:
    rows = tuple(
        (str(m.id), str(m.n), mm(m.rmse, 3), mm(m.max, 3), *(mm(b, 3) for b in m.bias), mm(m.scatter, 3))
        for m in sorted(run.metrics.markers, key=lambda m: -m.rmse)
    )
    header = ("marker", "frames", "rms (mm)", "max (mm)", "bias x (mm)", "bias y (mm)", "bias z (mm)", "scatter (mm)")
    return Table(header, rows, numbers=tuple(range(1, 8)))


def _worst_table(run: RunSummary, residuals: Sequence[Residual]) -> Table | None:
    """The frames with the largest rmse, at least a twentieth of the recording apart."""
    if not residuals:
        return None
    apart = 0.05 * (run.seconds[-1] - run.seconds[0])
    chosen: list[int] = []
    for k in np.argsort(run.per_frame)[::-1]:
        if all(abs(run.seconds[k] - run.seconds[j]) >= apart for j in chosen):
            chosen.append(int(k))
        if len(chosen) == N_WORST:
            break
    rows = []
    for k in chosen:
        r = residuals[k]
        worst = int(np.argmax(r.distances))
        e = r.errors[worst]
        rows.append(
            (f"{run.seconds[k]:.2f}", mm(run.per_frame[k]), mm(r.distances[worst]), str(r.ids[worst]),
             f"({mm(e[0])}, {mm(e[1])}, {mm(e[2])})", str(len(r.ids)))
        )  # fmt: skip
    header = ("time (s)", "rmse (mm)", "largest (mm)", "at marker", "its error x, y, z (mm)", "markers")
    return Table(header, tuple(rows), numbers=(0, 1, 2, 3, 5))
