"""The comparison as tables (CSV, JSON) and as one page."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from livedeform.compare_node.judgement import decimals
from livedeform.compare_node.metrics import Level, Statistic, rmse
from livedeform.compare_node.takes import Takes
from livedeform.comparing.runs import ComparedRun, Difference, MarkerDifference
from livedeform.comparing.takes import groups, sharing
from livedeform.outputs import write_json
from livedeform.report import plots
from livedeform.report.page import Chart, Table, Tile, Verdict, write_page
from livedeform.report.text import MM, interval, mm

COLOURS = (plots.BLUE, plots.ORANGE, plots.GREEN, plots.VERMILLION, plots.SKY, "#CC79A7", plots.GREY)
HEADER = ("run", "recording", "verdict", "errors", "frames", "rmse (mm)", "95 % interval (mm)", "mean (mm)",
          "p95 (mm)", "max (mm)")  # fmt: skip
AGAINST = ("run", "common errors", "common frames", "rmse of the first (mm)", "its own rmse (mm)", "difference (mm)",
           "95 % interval (mm)")  # fmt: skip

STALE = str(Level.STALE)
FEW_COMMON = 0.9  # of a run's frames: a difference of fewer is one of a part
LEAST_PERCENT = 0.01  # below, a difference is said to be less than that
TAKES = ("takes", "n", "mean rmse (mm)", "mean of takes, 95 % (mm)", "next take, 95 % (mm)")


def write_comparison(out: Path, runs: Sequence[ComparedRun], differences: Sequence[Difference | None]) -> None:
    """Write ``compare.json``, ``runs.csv``, ``markers.csv`` and ``compare.html`` to the folder ``out``."""
    document = {
        "version": 1,
        "unit": "m",
        "reference": runs[0].name,
        "runs": [
            {"name": run.name, "path": run.path, "verdict": run.verdict, "bag": run.bag, "n": run.metrics.n,
             "n_frames": run.metrics.n_frames, "rmse": asdict(run.metrics.rmse), "mean": asdict(run.metrics.mean),
             "p95": asdict(run.metrics.p95), "max": run.metrics.max, "whole": run.take is None or run.take.whole}
            for run in runs
        ],
        "differences": [asdict(d) if d is not None else None for d in differences],
        "next_takes": [takes.as_dict() for takes in takes_of(runs)],
    }  # fmt: skip
    write_json(out / "compare.json", document)
    _write_table(out / "runs.csv", HEADER, [table_row(run) for run in runs])
    _write_table(out / "markers.csv", ("run", *_marker_header(runs[0])), _marker_rows(differences))
    write_page(
        out / "compare.html",
        "compare.html.j2",
        title=" · ".join(run.name for run in runs),
        kind="comparison",
        charts=[chart for chart in (_curves(runs), _bars(runs), _rises(differences)) if chart is not None],
        verdict=verdict_of(runs, differences),
        tiles=[_tile(run) for run in runs],
        table=Table(HEADER, tuple(tuple(table_row(run)) for run in runs), numbers=tuple(range(3, 10))),
        against=Table(AGAINST, tuple(against_row(d) for d in differences if d), numbers=tuple(range(1, 7))),
        markers=Table(("run", *_marker_header(runs[0])), tuple(_marker_rows(differences)), numbers=tuple(range(1, 7))),
        takes=Table(TAKES, tuple(takes_row(t) for t in takes_of(runs)), numbers=(1, 2, 3, 4)),
        reference=runs[0].name,
        parts=parts_of(runs),
        unpaired=[run.name for run, d in zip(runs[1:], differences, strict=True) if d is None],
    )


def _tile(run: ComparedRun) -> Tile:
    error = run.metrics.rmse
    digits = decimals(error.value, least=3)
    return Tile(run.name, mm(error.value, digits), "mm rms", interval(error, digits))


def table_row(run: ComparedRun) -> tuple[str, ...]:
    """A run's numbers, in the order of ``HEADER``."""
    m = run.metrics
    digits = decimals(m.rmse.value, m.mean.value, least=3)
    numbers = (
        mm(m.rmse.value, digits),
        _between(m.rmse, digits),
        *(mm(v, digits) for v in (m.mean.value, m.p95.value, m.max)),
    )
    return (run.name, Path(run.bag).name, run.verdict, str(m.n), str(m.n_frames), *numbers)


def against_row(d: Difference) -> tuple[str, ...]:
    """A difference's numbers, in the order of ``AGAINST``."""
    return (d.name, str(d.n), str(d.n_frames), *_numbers_of(d))


def _numbers_of(d: Difference | MarkerDifference) -> tuple[str, ...]:
    """Both rms errors and their difference with its interval, with as many decimals as show it and its sign."""
    ends = (d.difference.value, d.difference.low, d.difference.high)
    digits = decimals(*ends, d.difference.high - d.difference.low, least=3)
    between = _between(d.difference, digits, signed=True)
    return mm(d.reference, digits), mm(d.other, digits), _signed(d.difference.value, digits), between


def takes_of(runs: Sequence[ComparedRun]) -> list[Takes]:
    """Say of runs of several recordings with one model what the next recording is expected to show; runs of several
    presses share what is between takes, relative to their error."""
    return sharing(groups(run.take for run in runs if run.take is not None))


def parts_of(runs: Sequence[ComparedRun]) -> list[str]:
    """Name the runs of a part of a recording, which are no takes."""
    return [run.name for run in runs if run.take is not None and not run.take.whole]


def takes_row(takes: Takes) -> tuple[str, ...]:
    """The numbers of takes, in the order of ``TAKES``."""
    e = takes.expected["rmse"]
    digits = decimals(e.value, least=3)
    spans = (_between(Statistic(e.value, *span), digits) for span in (e.mean, e.next))
    return (", ".join(takes.names), str(e.n), mm(e.value, digits), *spans)


def sentence(d: Difference, reference: str) -> str:
    """Say which of two runs is the better one, or that the data do not tell."""
    low, high = d.difference.low, d.difference.high
    if not np.isfinite(low):
        return f"{d.name} and {reference}: too few frames for an interval of their difference"
    if low <= 0.0 <= high:
        return f"{d.name} and {reference} cannot be told apart: their difference may be zero"
    word = "smaller" if high < 0 else "larger"
    share = f"{_share(abs(d.difference.value) / d.reference)} " if d.reference > 0.0 else ""
    return f"the error of {d.name} is {share}{word} than that of {reference}"


def _share(share: float) -> str:
    """Say a share that is not nothing in percent."""
    percent = 100.0 * share
    if percent < LEAST_PERCENT:
        return f"less than {LEAST_PERCENT:g} %"
    return f"{percent:.0f} %" if percent >= 9.5 else f"{percent:.2g} %"


def verdict_of(runs: Sequence[ComparedRun], differences: Sequence[Difference | None]) -> Verdict:
    """Say what the differences come to: good where a run is told to be better than the first, and none to be worse, nor
    left out where either had no answer."""
    said = [sentence(d, runs[0].name) for d in differences if d is not None]
    if not said:
        return Verdict(
            "neutral",
            "Not paired",
            "The runs are of other recordings than the first: only their own numbers are shown.",
        )
    intervals = [d.difference for d in differences if d is not None and np.isfinite(d.difference.low)]
    better, worse = any(i.high < 0.0 for i in intervals), any(i.low > 0.0 for i in intervals)
    doubts = doubts_of(runs, differences)
    tone = "warn" if worse or doubts else "good" if better else "neutral"
    because = "; ".join([*said, *doubts])
    return Verdict(tone, because[:1].upper() + because[1:] + ".", "Paired by stamp and marker.")


def doubts_of(runs: Sequence[ComparedRun], differences: Sequence[Difference | None]) -> list[str]:
    """Say of which runs most was not compared, and where a difference is of a part of what either compared: what one
    model has no answer for may be what it is worst at."""
    said = [f"of {run.name} most was not compared (STALE)" for run in runs if run.verdict == STALE]
    for run, d in zip(runs[1:], differences, strict=True):
        for one in (runs[0], run) if d is not None else ():
            if d is not None and d.n_frames < FEW_COMMON * one.metrics.n_frames:
                both = f"{d.n_frames} of the {one.metrics.n_frames} frames that {one.name} compared"
                said.append(f"{d.name} and {runs[0].name} are told apart by {both}")
    return said


def _curves(runs: Sequence[ComparedRun]) -> Chart:
    lines = [
        plots.Line(
            run.name,
            np.array([(r.stamp_ns - run.start_ns) * 1e-9 for r in run.residuals]),
            np.array([rmse(r.distances) for r in run.residuals]) * MM,
            COLOURS[i % len(COLOURS)],
            weights=np.array([len(r.ids) for r in run.residuals]),
        )
        for i, run in enumerate(runs)
    ]
    return Chart("curves", plots.error_over_time(lines, None, {}), "The rms error of every frame, run by run.")


def _bars(runs: Sequence[ComparedRun]) -> Chart:
    groups = {}
    for run in runs:
        markers = run.metrics.markers
        ids = np.array([m.id for m in markers], np.uint32)
        none = np.full(len(ids), np.nan)
        rms, n = np.array([m.rmse for m in markers]), np.array([m.n for m in markers], float)
        groups[run.name] = plots.Bars(ids, rms, none, n)
    colours = [COLOURS[i % len(COLOURS)] for i in range(len(runs))]
    return Chart("markers", plots.error_per_marker(groups, colours), "The rms error of every marker, run by run.")


def _rises(differences: Sequence[Difference | None]) -> Chart | None:
    """The differences per marker with their intervals."""
    known = [d for d in differences if d is not None and d.markers]
    if not known:
        return None
    import plotly.graph_objects as go

    figure = go.Figure()
    for i, d in enumerate(known):
        value = np.array([m.difference.value for m in d.markers]) * MM
        low = value - np.array([m.difference.low for m in d.markers]) * MM
        high = np.array([m.difference.high for m in d.markers]) * MM - value
        figure.add_bar(
            x=[str(m.id) for m in d.markers], y=value, name=d.name, error_y=plots.whiskers(high, low),
            marker_color=COLOURS[(i + 1) % len(COLOURS)], hovertemplate="marker %{x}: %{y:+.3f} mm",
        )  # fmt: skip
    layout = plots.base_layout(height=340)
    layout["xaxis"] = {"title": "marker id", "type": "category"}
    layout["yaxis"] = {"title": "difference of rms errors (mm)"}
    layout["showlegend"] = len(known) > 1
    figure.update_layout(**layout)
    caption = "Below zero the marker's error is smaller than in the first run. Whiskers: 95 % intervals of the pairs."
    return Chart("rises", figure, caption)


def _marker_header(reference: ComparedRun) -> tuple[str, ...]:
    return ("marker", "common frames", f"rms of {reference.name} (mm)", "its own rms (mm)", "difference (mm)",
            "95 % interval (mm)")  # fmt: skip


def _marker_rows(differences: Sequence[Difference | None]) -> list[tuple[str, ...]]:
    return [(d.name, str(m.id), str(m.n), *_numbers_of(m)) for d in differences if d is not None for m in d.markers]


def _between(statistic: Statistic, digits: int, *, signed: bool = False) -> str:
    if not np.isfinite(statistic.low):
        return "–"
    say = _signed if signed else mm
    return f"{say(statistic.low, digits)} to {say(statistic.high, digits)}"


def _signed(value: float, digits: int) -> str:
    """A difference in millimetres with its sign; that of what is shown as zero would say nothing."""
    if not np.isfinite(value):
        return "–"
    shown = round(MM * value, digits)
    return f"{shown:+.{digits}f}" if shown else f"{0.0:.{digits}f}"


def _write_table(path: Path, header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows(rows)
