"""Summaries that the judging commands print about a run, and their exit code."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from livedeform.closed_loop.diagnosis import Diagnosis
    from livedeform.compare_node.metrics import RunMetrics, Statistic


def tell_metrics(metrics: RunMetrics, out: Path) -> None:
    """The verdict and the numbers, in mm."""
    from livedeform.compare_node.judgement import judge as judged
    from livedeform.compare_node.takes import ONE_TAKE

    judgement = judged(metrics)
    limit = f"threshold {metrics.threshold * 1e3:g} mm"
    counted = f"{metrics.n} errors of {len(metrics.markers)} markers"
    if metrics.surface is not None and not metrics.n:
        counted = f"{metrics.surface.n} distances of points without ids"
    typer.echo(f"verdict: {judgement.level} ({limit}), {counted}")
    typer.echo(f"  {judgement.sentence}")
    if metrics.surface is not None and metrics.n:
        typer.echo(f"  {metrics.surface.text}")
    rows = (("rmse", metrics.rmse), ("mean", metrics.mean), ("p95", metrics.p95)) if metrics.n else ()
    for name, statistic in rows:
        typer.echo(f"  {name + '_mm':10}{_mm(statistic.value)}{_interval(statistic)}")
    if metrics.n:
        typer.echo(f"  {'max_mm':10}{_mm(metrics.max)}")
        typer.echo(f"  {metrics.takes.text if metrics.takes is not None else ONE_TAKE}")
    if math.isfinite(metrics.noise_floor):
        typer.echo(
            f"  {'noise_mm':10}{_mm(metrics.noise_floor)}  (the rmse that the measuring noise alone would leave)"
        )
    c = metrics.coverage
    if c is not None and c.sent:
        before = f"; {c.before} more were published before the first that came" if c.before else ""
        typer.echo(f"  messages: {c.sent} sent = {c.received} received + {c.lost} lost, over all listeners{before}")
    for rest in metrics.rest:
        if rest.contradicts:
            typer.echo(f"  {rest.text}")
    for line in metrics.mesh:
        typer.echo(f"  mesh: {line}")
    typer.echo(f"report: {out / 'report.html'}")


def tell_diagnosis(result: Diagnosis, out: Path) -> None:
    """The verdict, the effects with values and sigmas, the error before and after on what was held out, and how to run
    the fitted model on that."""
    from livedeform.closed_loop.candidates import all_effects
    from livedeform.closed_loop.write import as_json
    from livedeform.report.diagnosis.collect import commands
    from livedeform.report.diagnosis.page import next_recording

    typer.echo(f"verdict: {result.verdict}")
    typer.echo(f"  {result.headline}")
    for doubt in result.doubts:
        typer.echo(f"  doubt: {doubt}")
    for effect in result.effects:
        said = all_effects()[effect.name].in_words
        values = [f"{name} = {said(name, value, effect.sigmas.get(name))}" for name, value in effect.values.items()]
        typer.echo(f"  {effect.name}: {', '.join(values)}")
    before, after = result.before, result.after
    typer.echo(f"  rmse_mm before {_mm(before.rmse).strip()}, after {_mm(after.rmse).strip()} on what was held out")
    typer.echo(f"  noise_mm {_mm(result.floor).strip()}, {after.n} errors")
    if result.effects:
        typer.echo(f"  {next_recording(as_json(result))}")
    typer.echo(f"  {result.text}")
    for command in commands(result, out):
        typer.echo(f"run it: {command}")
    typer.echo(f"report: {out / 'report.html'}")


def judge(metrics: RunMetrics, limit: float | None) -> None:
    """Exit code 1 where there is too little to judge, where the run was interrupted, and where the rmse is over
    ``limit`` (m) or cannot be compared with it."""
    interrupted = metrics.coverage is not None and metrics.coverage.interrupted
    if interrupted or metrics.level == "STALE":
        typer.echo(f"failed: the run {'was interrupted' if interrupted else 'cannot be judged'}", err=True)
        raise typer.Exit(1)
    rmse = metrics.surface.rmse if metrics.surface is not None and not metrics.n else metrics.rmse
    if limit is not None and not rmse.value <= limit:
        typer.echo(f"failed: the rmse is not within {limit * 1e3:g} mm", err=True)
        raise typer.Exit(1)


def _mm(value: float) -> str:
    return f"{value * 1e3:8.3f}" if math.isfinite(value) else "       -"


def _interval(statistic: Statistic) -> str:
    if not math.isfinite(statistic.low):
        return ""
    return f"  (95 % interval, this recording: {statistic.low * 1e3:.3f} to {statistic.high * 1e3:.3f})"
