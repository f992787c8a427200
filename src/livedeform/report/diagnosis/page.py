"""The page of a diagnosis: what was wrong, how sure that is, and how good the model is now. One offline file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from livedeform.closed_loop.assessment.verdict import EVIDENCE, headline, share_of_evidence
from livedeform.closed_loop.diagnosis import Diagnosis
from livedeform.closed_loop.write import as_json
from livedeform.common.experiment.schema import Experiment
from livedeform.compare_node.judgement import decimals
from livedeform.report.diagnosis.charts import on_surface_chart, over_time_chart, per_marker_chart, ranking_chart
from livedeform.report.diagnosis.collect import evidence_of
from livedeform.report.diagnosis.evidence import DiagnosisEvidence
from livedeform.report.diagnosis.tables import (
    correlation_table,
    fit_table,
    noise_table,
    ranking_table,
    rivals_in,
)
from livedeform.report.page import Table, Tile, Verdict, write_page
from livedeform.report.text import less, less_between, mm, words


def write_report(out: Path, result: Diagnosis, experiment: Experiment) -> Path:
    """Write ``out/report.html`` from the closed loop's result."""
    return write_diagnosis_report(out, as_json(result), evidence_of(result, experiment, out))


def write_diagnosis_report(out_dir: Path, diagnosis: Mapping[str, Any], evidence: DiagnosisEvidence) -> Path:
    """Write ``out_dir/report.html`` from the content of ``diagnosis.json`` and the evidence behind it."""
    diagnosis = _without_nulls(diagnosis)
    held_out = [r for r in evidence.recordings if r.held_out] or list(evidence.recordings)
    over_time = over_time_chart(evidence.recordings)
    per_marker = per_marker_chart(held_out)
    on_surface = on_surface_chart(held_out, evidence.body)
    ranking = ranking_chart(diagnosis)
    return write_page(
        out_dir / "report.html",
        "diagnosis.html.j2",
        title=evidence.name,
        kind="diagnosis",
        charts=[c for c in (*over_time, per_marker, on_surface, ranking) if c],
        subtitle="What the declared model lacks, and how good the model is with it",
        verdict=diagnosis_verdict(diagnosis),
        tiles=_tiles(diagnosis),
        causes=[_cause(effect, evidence) for effect in diagnosis["effects"]],
        doubts=_doubts(diagnosis, evidence),
        fit=fit_table(evidence.fit),
        correlations=correlation_table(evidence.correlations or {}),
        over_time=over_time,
        per_marker=per_marker,
        on_surface=on_surface,
        states=list(dict.fromkeys(t.meta for t in on_surface.figure.data)) if on_surface else [],
        ranking=ranking,
        ranking_table=ranking_table(diagnosis, evidence),
        unexplained=diagnosis.get("unexplained", ""),
        noise=noise_table(evidence.noise),
        facts=Table(("what", "value"), tuple(evidence.facts)),
        configuration=evidence.configuration,
    )


def _without_nulls(value: Any) -> Any:
    """Return what JSON cannot hold as a number comes back as NaN."""
    if isinstance(value, Mapping):
        return {k: _without_nulls(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nulls(v) for v in value]
    return float("nan") if value is None else value


def diagnosis_verdict(diagnosis: Mapping[str, Any]) -> Verdict:
    """The page's first sentence, and what stands behind it."""
    verdict, doubts, rivals = diagnosis["verdict"], diagnosis.get("doubts", []), rivals_in(diagnosis)
    said = headline(verdict, rivals, doubts, [c["name"] for c in diagnosis["candidates"] if c.get("declared")])
    sure = verdict in ("none", "effect") and not doubts and not any(rivals.values())
    tone = "good" if sure else "bad" if verdict == "unexplained" else "warn"
    said_of_doubts = " ".join(f"{doubt[:1].upper()}{doubt[1:]}." for doubt in doubts)
    return Verdict(tone, said, f"{said_of_doubts} {_numbers_behind(diagnosis)}".lstrip())


def _digits(diagnosis: Mapping[str, Any]) -> int:
    """Decimals (mm) that the page's first numbers need, all alike: two significant ones of the smallest, if not two."""
    return decimals(diagnosis["error_before"]["rmse"], diagnosis["error_after"]["rmse"], diagnosis["noise_floor"])


def _numbers_behind(diagnosis: Mapping[str, Any]) -> str:
    """The errors before and after, and the noise."""
    before, after, floor = diagnosis["error_before"]["rmse"], diagnosis["error_after"]["rmse"], diagnosis["noise_floor"]
    digits = _digits(diagnosis)
    noise = f"{mm(floor, digits)} mm"
    if not diagnosis["effects"]:
        return f"Held-out rmse {mm(before, digits)} mm; the measuring noise alone would leave {noise}."
    errors = f"{mm(before, digits)} mm before, {mm(after, digits)} mm after{_gain(diagnosis)}"
    return f"Held-out rmse {errors}; the measuring noise alone leaves {noise}. {next_recording(diagnosis)}"


def _gain(diagnosis: Mapping[str, Any]) -> str:
    """Say by how much the error changed, in brackets, and between which ends its improvement lies."""
    before, after = diagnosis["error_before"]["rmse"], diagnosis["error_after"]["rmse"]
    if not before > 0.0 or not np.isfinite(after):
        return ""
    change = less(1.0 - after / before)
    low, high = diagnosis.get("improvement_interval") or (float("nan"), float("nan"))
    if not np.isfinite([low, high]).all():
        return f" ({change}; one press does not tell between which ends)"
    return f" ({change}; 95 % interval over presses like these: {less_between(low, high)})"


def next_recording(diagnosis: Mapping[str, Any]) -> str:
    """Say what is expected of another recording, as far as those that were held out tell."""
    found = diagnosis.get("next_recording")
    if not isinstance(found, Mapping):
        return "Another recording: two that were held out whole would say how recordings differ, one does not."
    (low, high), gain = found["error_after_rmse"], found["improvement"]
    digits = decimals(low, high)
    return (
        f"Another recording like these {found['recordings']}: rmse {mm(low, digits)} to {mm(high, digits)} mm, "
        f"{less_between(*gain)} (95 %)."
    )


def _tiles(diagnosis: Mapping[str, Any]) -> list[Tile]:
    before, after, floor = diagnosis["error_before"], diagnosis["error_after"], diagnosis["noise_floor"]
    explained, digits = share_of_evidence(diagnosis.get("explained", float("nan"))), _digits(diagnosis)
    return [
        Tile("rmse before", mm(before["rmse"], digits), "mm", _spread(before, digits)),
        Tile("rmse after", mm(after["rmse"], digits), "mm", _spread(after, digits)),
        Tile("measuring noise", mm(floor, digits), "mm", "the rmse that noise alone leaves"),
        Tile("explained", explained, "%", f"of {EVIDENCE}"),
        Tile("held-out errors", f"{after['n']}", "", _compared(diagnosis.get("coverage"))),
    ]


def _compared(coverage: Mapping[str, Any] | None) -> str:
    """Say how much of what was measured was compared."""
    text = "the same before and after, not used for fitting"
    if not coverage:
        return text
    compared, measured, presses = (coverage[k] for k in ("frames_compared", "frames_measured", "presses"))
    return f"{text}; {compared} of {measured} frames, {presses} {'press' if presses == 1 else 'presses'}"


def _spread(error: Mapping[str, Any], digits: int) -> str:
    return f"95 % of errors below {mm(error['p95'], digits)}, max {mm(error['max'], digits)}"


@dataclass(frozen=True)
class _Cause:
    """An effect that was added, as text."""

    name: str
    summary: str
    equation: str
    source: str
    acts_on: str
    values: tuple[str, ...]


def _cause(effect: Mapping[str, Any], evidence: DiagnosisEvidence) -> _Cause:
    info, given = evidence.infos[effect["name"]], effect["parameters"]
    values = [f"{name} = {info.in_words(name, p['value'], p.get('sigma'))}" for name, p in given.items()]
    summary = info.summary[:1].upper() + info.summary[1:].rstrip(".") + "."
    before = [f"{name} {info.in_words(name, p['declared'])}" for name, p in given.items() if "declared" in p]
    if before:
        summary = f"Otherwise than declared ({', '.join(before)}). {summary}"
    card = (summary, info.equation, info.source, info.acts_on)
    return _Cause(words(effect["name"]), *card, tuple(values))


def _doubts(diagnosis: Mapping[str, Any], evidence: DiagnosisEvidence) -> list[str]:
    """Return what the data cannot decide, and what would."""
    doubts = []
    for name, rivals in rivals_in(diagnosis).items():
        if rivals:
            doubts.append(f"These recordings cannot tell {words(name)} from {' or '.join(words(n) for n in rivals)}.")
    return doubts + list(evidence.experiments)
