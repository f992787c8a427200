"""The page of a diagnosis: what was wrong, how sure that is, and how good the model is now. One offline file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from livedeform.closed_loop.diagnosis import Diagnosis
from livedeform.closed_loop.write import as_json
from livedeform.common.experiment.schema import Experiment
from livedeform.report.diagnosis.charts import on_surface_chart, over_time_chart, per_marker_chart, ranking_chart
from livedeform.report.diagnosis.collect import evidence_of
from livedeform.report.diagnosis.evidence import DiagnosisEvidence
from livedeform.report.diagnosis.tables import correlation_table, fit_table, indistinguishable, ranking_table
from livedeform.report.page import Table, Tile, Verdict, write_page
from livedeform.report.text import mm, words


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
    before, after, floor = (diagnosis["error_before"], diagnosis["error_after"], diagnosis["noise_floor"])
    numbers = f"Held-out rmse {mm(before['rmse'])} mm"
    if diagnosis["verdict"] == "none":
        because = f"{numbers}; the measuring noise alone would leave {mm(floor)} mm."
        return Verdict("good", "The declared model explains the data: nothing was added", because)
    low, high = diagnosis.get("improvement_interval") or (float("nan"), float("nan"))
    gain = f" (−{100 * (1 - after['rmse'] / before['rmse']):.0f} %, 95 %: {100 * low:.0f} to {100 * high:.0f} %)"
    numbers += f" before, {mm(after['rmse'])} mm after{gain}; the measuring noise alone leaves {mm(floor)} mm."
    names = " and ".join(words(e["name"]) for e in diagnosis["effects"])
    if diagnosis["verdict"] == "unexplained":
        added = f"; {names} accounts for a part" if names else ""
        return Verdict("bad", f"There is an error that no known effect explains{added}", numbers)
    rivals = indistinguishable(diagnosis)
    if rivals:
        return Verdict("warn", f"Traced to {names}, or to {' or '.join(map(words, rivals))}", numbers)
    return Verdict("good", f"Traced to {names}", numbers)


def _tiles(diagnosis: Mapping[str, Any]) -> list[Tile]:
    before, after, floor = diagnosis["error_before"], diagnosis["error_after"], diagnosis["noise_floor"]
    excess = [np.sqrt(max(e["rmse"] ** 2 - floor**2, 0.0)) for e in (before, after)]
    removed = f"{100 * (1 - excess[1] / excess[0]):.0f}" if excess[0] > 0 else "–"
    return [
        Tile(
            "rmse before",
            mm(before["rmse"]),
            "mm",
            f"95 % of errors below {mm(before['p95'])}, max {mm(before['max'])}",
        ),
        Tile("rmse after", mm(after["rmse"]), "mm", f"95 % of errors below {mm(after['p95'])}, max {mm(after['max'])}"),
        Tile("measuring noise", mm(floor), "mm", "the rmse that noise alone leaves"),
        Tile("excess removed", removed, "%", "of what is above the noise"),
        Tile("held-out errors", f"{after['n']}", "", "not used for fitting"),
    ]


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
    info = evidence.infos.get(effect["name"])
    values = []
    for name, entry in effect["parameters"].items():
        unit = next((p.unit for p in info.parameters if p.name == name), "") if info else ""
        text = f"{name} = {_numbers(entry['value'], entry.get('sigma'))} {unit}"
        values.append(text.removesuffix(" -").removesuffix(" 1").rstrip())
    card = ("", "", "", "")
    if info is not None:
        summary = info.summary[:1].upper() + info.summary[1:].rstrip(".") + "."
        card = (summary, info.equation, info.source, info.acts_on)
    return _Cause(words(effect["name"]), *card, tuple(values))


def _numbers(value: Any, sigma: Any) -> str:
    values, sigmas = np.atleast_1d(np.asarray(value, float)), np.atleast_1d(np.asarray(sigma, float))
    if sigma is None or sigmas.shape != values.shape:
        sigmas = np.full(values.shape, np.nan)
    parts = [f"{v:.4g} ± {s:.2g}" if np.isfinite(s) else f"{v:.4g}" for v, s in zip(values, sigmas, strict=True)]
    return parts[0] if np.ndim(value) == 0 else "(" + ", ".join(parts) + ")"


def _doubts(diagnosis: Mapping[str, Any], evidence: DiagnosisEvidence) -> list[str]:
    """Return what the data cannot decide, and what would."""
    doubts = []
    rivals = indistinguishable(diagnosis)
    if rivals:
        names = " or ".join(words(n) for n in rivals)
        doubts.append(f"These recordings cannot tell {words(diagnosis['effects'][0]['name'])} from {names}.")
    return doubts + list(evidence.experiments)
