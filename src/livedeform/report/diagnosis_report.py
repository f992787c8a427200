"""The report of a diagnosis: what was wrong, how sure that is, and how good the model is now. One offline file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from livedeform.common.effect import EffectInfo
from livedeform.common.types import Array, Ids
from livedeform.compare_node.metrics import rmse
from livedeform.compare_node.residual import Residual, tabulate
from livedeform.report import plots
from livedeform.report.page import Chart, Table, Tile, Verdict, write_page
from livedeform.report.run_page import MM, SurfaceMesh, mm


@dataclass(frozen=True)
class Compared:
    """One recording: its residuals with the declared and the fitted model; ``held_out``: nothing was fitted to it."""

    name: str
    held_out: bool
    start_ns: int
    before: Sequence[Residual]
    after: Sequence[Residual]


@dataclass(frozen=True)
class FitRow:
    """One fitted number, in ``unit``: value, one sigma, start of the search, bounds, and whether it sits on one."""

    name: str
    unit: str
    value: float
    sigma: float
    start: float
    lower: float
    upper: float
    at_bound: bool


@dataclass(frozen=True)
class RestingBody:
    """The body at rest: its surface, and the places (m, 3) m of the markers ``ids`` (m,)."""

    shape: SurfaceMesh
    ids: Ids
    places: Array


@dataclass(frozen=True)
class DiagnosisEvidence:
    """What the page shows beside ``diagnosis.json``.

    ``infos`` are the catalogue's cards of the effects; ``correlations`` maps pairs of fitted names to their
    correlation; ``body`` is the surface on which the errors are drawn; ``facts`` (what,
    value) rows on what was fitted, held out, counted and how long it took; ``experiments`` says what would tell
    candidates apart.
    """

    name: str
    recordings: Sequence[Compared]
    infos: Mapping[str, EffectInfo]
    fit: Sequence[FitRow] = ()
    correlations: Mapping[tuple[str, str], float] | None = None
    body: RestingBody | None = None
    facts: Sequence[tuple[str, str]] = ()
    experiments: Sequence[str] = ()
    configuration: str = ""


def write_diagnosis_report(out_dir: Path, diagnosis: Mapping[str, Any], evidence: DiagnosisEvidence) -> Path:
    """Write ``out_dir/report.html`` from the content of ``diagnosis.json`` and the evidence behind it."""
    diagnosis = _without_nulls(diagnosis)
    held_out = [r for r in evidence.recordings if r.held_out] or list(evidence.recordings)
    over_time = _over_time(evidence.recordings)
    per_marker = _per_marker(held_out)
    on_surface = _on_surface(held_out, evidence.body)
    ranking = _ranking_chart(diagnosis)
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
        fit=_fit_table(evidence.fit),
        correlations=_correlation_table(evidence.correlations or {}),
        over_time=over_time,
        per_marker=per_marker,
        on_surface=on_surface,
        states=list(dict.fromkeys(t.meta for t in on_surface.figure.data)) if on_surface else [],
        ranking=ranking,
        ranking_table=_ranking_table(diagnosis, evidence),
        unexplained=diagnosis.get("unexplained", ""),
        facts=Table(("what", "value"), tuple(evidence.facts)),
        configuration=evidence.configuration,
    )


def _without_nulls(value: Any) -> Any:
    """What JSON cannot hold as a number comes back as NaN."""
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


def indistinguishable(diagnosis: Mapping[str, Any]) -> list[str]:
    """Candidates that the data cannot tell from the first effect that was added."""
    if not diagnosis["effects"]:
        return []
    first = diagnosis["effects"][0]["name"]
    for candidate in diagnosis["candidates"]:
        if candidate["name"] == first:
            return [n for n in candidate.get("indistinguishable_from", []) if n != first]
    return []


def words(name: str) -> str:
    """An effect's name as it reads in a sentence."""
    return name.replace("_", " ")


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
    """What the data cannot decide, and what would."""
    doubts = []
    rivals = indistinguishable(diagnosis)
    if rivals:
        names = " or ".join(words(n) for n in rivals)
        doubts.append(f"These recordings cannot tell {words(diagnosis['effects'][0]['name'])} from {names}.")
    return doubts + list(evidence.experiments)


def _fit_table(rows: Sequence[FitRow]) -> Table | None:
    if not rows:
        return None
    lines = []
    for r in rows:
        relative = f"{100 * r.sigma / abs(r.value):.1f} %" if r.value and np.isfinite(r.sigma) else "–"
        bound = "at a bound: the interval is not reliable" if r.at_bound else ""
        lines.append(
            (
                r.name,
                f"{r.value:.5g}",
                f"{r.sigma:.2g}",
                relative,
                r.unit,
                f"{r.start:.4g}",
                f"{r.lower:.4g} … {r.upper:.4g}",
                bound,
            )
        )
    header = ("parameter", "value", "sigma", "relative", "unit", "start", "bounds", "")
    return Table(header, tuple(lines), numbers=(1, 2, 3, 5))


def _correlation_table(correlations: Mapping[tuple[str, str], float]) -> Table | None:
    strong = sorted(((abs(c), a, b, c) for (a, b), c in correlations.items() if abs(c) >= 0.1), reverse=True)[:12]
    if not strong:
        return None
    return Table(("pair", "correlation"), tuple((f"{a}, {b}", f"{c:+.2f}") for _, a, b, c in strong), numbers=(1,))


def _over_time(recordings: Sequence[Compared]) -> list[Chart]:
    charts = []
    highest = max((rmse(r.distances) for c in recordings for r in (*c.before, *c.after) if len(r.ids)), default=0.0)
    for number, recording in enumerate(recordings):
        lines = []
        for name, residuals, colour in (
            ("before", recording.before, plots.ORANGE),
            ("after", recording.after, plots.BLUE),
        ):
            kept = [r for r in residuals if len(r.ids)]
            seconds = np.array([(r.stamp_ns - recording.start_ns) * 1e-9 for r in kept])
            lines.append(plots.Line(name, seconds, np.array([rmse(r.distances) for r in kept]) * MM, colour))
        figure = plots.error_over_time(lines, None, {})
        figure.update_yaxes(range=[0.0, 1.05 * highest * MM])
        role = "held out: nothing was fitted to it" if recording.held_out else "used for fitting"
        charts.append(Chart(f"over-time-{number}", figure, f"{recording.name} ({role}): rmse of each moment."))
    return charts


def _marker_rms(recordings: Sequence[Compared], after: bool) -> tuple[Ids, Array, Array]:
    """Ids, rms error and half of its 95 % interval, over all moments of the recordings."""
    table = tabulate([r for c in recordings for r in (c.after if after else c.before)])
    ids = np.unique(table.ids)
    squares = [table.distances[table.ids == i] ** 2 for i in ids]
    rms = np.array([np.sqrt(q.mean()) for q in squares])
    half = np.array([1.96 * q.std() / (2 * np.sqrt(q.mean() * len(q))) if q.any() else 0.0 for q in squares])
    return ids, rms, half


def _per_marker(recordings: Sequence[Compared]) -> Chart | None:
    if not any(len(r.ids) for c in recordings for r in c.before):
        return None
    groups = {"before": _marker_rms(recordings, False), "after": _marker_rms(recordings, True)}
    figure = plots.error_per_marker(groups, (plots.ORANGE, plots.BLUE))
    return Chart(
        "per-marker", figure, "Root mean square error of each marker on the held-out recordings, with 95 % intervals."
    )


def _on_surface(recordings: Sequence[Compared], body: RestingBody | None) -> Chart | None:
    """Rms errors as colours and mean errors as lines, before and after, drawn on the body at rest."""
    if body is None or not any(len(r.ids) for c in recordings for r in c.before):
        return None
    states = []
    for name, after in (("before", False), ("after", True)):
        table = tabulate([r for c in recordings for r in (c.after if after else c.before)])
        known = np.isin(body.ids, table.ids) & np.isfinite(body.places).all(axis=1)
        ids, places = body.ids[known], body.places[known]
        rms = np.array([np.sqrt((table.distances[table.ids == i] ** 2).mean()) for i in ids])
        mean = np.stack([table.errors[table.ids == i].mean(axis=0) for i in ids])
        states.append(
            plots.SurfaceState(name, body.shape.vertices, body.shape.triangles, ids, places, places + mean, rms)
        )
    highest = max(float(np.nanmax(s.error)) for s in states)
    size = float(np.ptp(body.shape.vertices, axis=0).max())
    arrows = float(np.clip(np.floor(0.15 * size / highest), 1, 40)) if highest > 0 else 1.0
    caption = (
        "Drawn on the body at rest. Colour: rms error on the held-out recordings, one scale for both tabs. Lines: the "
        f"markers' mean error, {arrows:g} times longer."
    )
    return Chart("on-surface", plots.surface_map(states, highest, arrows), caption, tall=True)


def _ranking_chart(diagnosis: Mapping[str, Any]) -> Chart | None:
    candidates = [c for c in diagnosis["candidates"] if np.isfinite(c["score"])]
    if not candidates:
        return None
    import plotly.graph_objects as go

    names = [words(c["name"]) for c in candidates]
    best = set(indistinguishable(diagnosis)) | {e["name"] for e in diagnosis["effects"]}
    colours = [plots.BLUE if c["name"] in best else plots.GREY for c in candidates]
    figure = go.Figure(
        go.Bar(
            x=[-c["score"] for c in candidates],
            y=names,
            orientation="h",
            marker_color=colours,
            customdata=[[c["test_rmse"] * MM, c["score_gap"]] for c in candidates],
            hovertemplate="%{y}: %{x:.1f}, %{customdata[1]:.1f} behind the best<br>"
            "rmse %{customdata[0]:.3f} mm<extra></extra>",
        )
    )
    layout = plots.base_layout(height=80 + 22 * len(names))
    layout["margin"] |= {"l": 140}
    layout["xaxis"] = {"title": "gain in predicting unseen blocks (twice the log predictive density)"}
    layout["yaxis"] = {"autorange": "reversed", "ticklabelstandoff": 6}
    figure.update_layout(**layout)
    caption = "Every candidate alone, best score first. Blue: what was added, or what the data cannot tell from it."
    return Chart("ranking", figure, caption)


def _ranking_table(diagnosis: Mapping[str, Any], evidence: DiagnosisEvidence) -> Table | None:
    rows, chosen = [], []
    added = {e["name"] for e in diagnosis["effects"]}
    for number, c in enumerate(diagnosis["candidates"]):
        info = evidence.infos.get(c["name"])
        same = ", ".join(words(n) for n in c.get("indistinguishable_from", []))
        rows.append(
            (
                words(c["name"]),
                info.acts_on if info else "",
                mm(c["test_rmse"], 3),
                f"{c['score']:.1f}",
                f"{c['score_gap']:.1f}",
                same,
            )
        )
        if c["name"] in added:
            chosen.append(number)
    header = ("candidate", "acts on", "rmse (mm)", "score", "gap to the best", "cannot be told from")
    return Table(header, tuple(rows), numbers=(2, 3, 4), chosen=tuple(chosen)) if rows else None
