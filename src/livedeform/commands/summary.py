"""What commands that judge print about a run, and their exit code."""

from __future__ import annotations

import math
from pathlib import Path

import typer

from compare_node.metrics import RunMetrics, Statistic


def tell_metrics(metrics: RunMetrics, out: Path) -> None:
    """The verdict and the numbers, in mm."""
    limit = f"threshold {metrics.threshold * 1e3:g} mm"
    typer.echo(f"verdict: {metrics.level} ({limit}), {metrics.n} errors of {len(metrics.markers)} markers")
    rows = (("rmse", metrics.rmse), ("mean", metrics.mean), ("p95", metrics.p95))
    for name, statistic in rows:
        typer.echo(f"  {name + '_mm':10}{_mm(statistic.value)}{_interval(statistic)}")
    typer.echo(f"  {'max_mm':10}{_mm(metrics.max)}")
    if math.isfinite(metrics.noise_floor):
        typer.echo(
            f"  {'noise_mm':10}{_mm(metrics.noise_floor)}  (the rmse that the measuring noise alone would leave)"
        )
    typer.echo(f"report: {out / 'report.html'}")


def judge(metrics: RunMetrics, limit: float | None) -> None:
    """Exit code 1 where the rmse is over ``limit`` (m), or where a limit is given and there is nothing to judge."""
    if limit is not None and not metrics.rmse.value <= limit:
        typer.echo(f"failed: the rmse is not within {limit * 1e3:g} mm", err=True)
        raise typer.Exit(1)


def _mm(value: float) -> str:
    return f"{value * 1e3:8.3f}" if math.isfinite(value) else "       -"


def _interval(statistic: Statistic) -> str:
    if not math.isfinite(statistic.low):
        return ""
    return f"  (95 %: {statistic.low * 1e3:.3f} to {statistic.high * 1e3:.3f})"
