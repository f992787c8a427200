"""The tables of a diagnosis: the fit, its correlations, the ranking."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from livedeform.closed_loop.assessment.verdict import rivals_of
from livedeform.common.effect import EffectInfo, significant
from livedeform.report.diagnosis.evidence import DiagnosisEvidence, FitRow, NoiseRow
from livedeform.report.page import Table
from livedeform.report.text import mm, words

SEEN_FROM = "seen with 95 % from"  # a size on, as a difference from no effect


def rivals_in(diagnosis: Mapping[str, Any]) -> dict[str, tuple[str, ...]]:
    """Candidates that the data cannot tell from each effect that was added, and that are not in the model."""
    alike = {c["name"]: c.get("indistinguishable_from", []) for c in diagnosis["candidates"]}
    return rivals_of([e["name"] for e in diagnosis["effects"]], alike)


def fit_table(rows: Sequence[FitRow]) -> Table | None:
    if not rows:
        return None
    lines = []
    for r in rows:
        relative = f"{100 * r.sigma / abs(r.value):.1f} %" if r.value and np.isfinite(r.sigma) else "–"
        bound = "at a bound: the interval is not reliable" if r.at_bound else ""
        low, high = r.interval
        digits = significant(max(abs(low), abs(high)), high - low, 4)
        interval = "–" if np.isnan(low + high) else f"{low:.{digits}g} … {high:.{digits}g}"
        lines.append(
            (
                r.name,
                f"{r.value:.{significant(abs(r.value), r.sigma, 5)}g}",
                f"{r.sigma:.2g}",
                relative,
                interval,
                r.unit,
                f"{r.start:.4g}",
                f"{r.lower:.4g} … {r.upper:.4g}",
                bound,
            )
        )
    header = ("parameter", "value", "sigma", "relative", "95 % interval", "unit", "start", "bounds", "")
    return Table(header, tuple(lines), numbers=(1, 2, 3, 4, 6))


def noise_table(rows: Sequence[NoiseRow]) -> Table | None:
    if not rows:
        return None
    header = (
        *("recording", "", "measuring noise of one frame (mm rms)", "taken from", "95 % interval (mm)"),
        *("measured over stated variance", "correlation time (s)", "frames per independent one", "mesh (mm rms)"),
    )
    return Table(header, tuple(_noise_line(r) for r in rows), numbers=(2, 4, 5, 6, 7, 8))


def _noise_line(r: NoiseRow) -> tuple[str, ...]:
    n = r.report
    interval = f"{mm(n.interval[0], 3)} to {mm(n.interval[1], 3)}" if np.isfinite(n.interval).all() else "not measured"
    return (
        *(r.name, "held out" if r.held_out else "fitted", mm(r.used, 3), n.source, interval),
        *(f"{n.ratio:.2f}" if np.isfinite(n.ratio) else "–", f"{n.correlation_time:.2g}", f"{n.inflation:.2f}"),
        mm(r.mesh, 3),
    )


def correlation_table(correlations: Mapping[tuple[str, str], float]) -> Table | None:
    strong = sorted(((abs(c), a, b, c) for (a, b), c in correlations.items() if abs(c) >= 0.1), reverse=True)[:12]
    if not strong:
        return None
    return Table(("pair", "correlation"), tuple((f"{a}, {b}", f"{c:+.2f}") for _, a, b, c in strong), numbers=(1,))


def ranking_table(diagnosis: Mapping[str, Any], evidence: DiagnosisEvidence) -> Table | None:
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
                _seen_from(c.get("detectable", float("nan")), c.get("detectable_parameter"), info),
                same,
            )
        )
        if c["name"] in added:
            chosen.append(number)
    header = ("candidate", "acts on", "rmse (mm)", "score", "gap to the best", SEEN_FROM, "cannot be told from")
    return Table(header, tuple(rows), numbers=(2, 3, 4), chosen=tuple(chosen)) if rows else None


def _seen_from(size: float, parameter: str | None, info: EffectInfo | None) -> str:
    """Say from which size of that parameter on a candidate would have been seen."""
    if info is None or parameter is None or np.isnan(size):
        return "no size"
    unit = info.parameter(parameter).unit
    return f"{parameter} by {size:.2g} {'' if unit in ('1', '-') else unit}".rstrip()
