"""``livedeform demo``: the main job on the shipped experiment, from a recording to a better model."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from livedeform import outputs
from livedeform.closed_loop.loop import diagnose
from livedeform.common.experiment.yaml_file import load_experiment
from livedeform.compare_node.metrics import RunMetrics
from livedeform.report.diagnosis.page import write_report
from livedeform.run.running import RunOptions, run
from livedeform.shipped import BREAST, shipped

FIT, TEST = "a", "b"  # the recordings: one to fit, one that is only predicted
WRITES = ("before", "diagnosis", "after")


def demonstrate(out: Path, force: bool, tell: Callable[..., None]) -> list[str]:
    """Runs the declared model, finds what it lacks, runs the fitted model; gives what there is to say, a line each."""
    began = time.monotonic()
    folder = shipped(BREAST)
    experiment, bags = folder / "experiment", folder / "bags"
    with outputs.prepared(out, WRITES, force=force, inputs=[folder]) as draft:
        outputs.write_configuration(draft, outputs.configuration("demo", {"experiment": experiment}, seed=0))
        lines = _steps(experiment, bags, draft, out, tell)
    return [*lines, f"{time.monotonic() - began:.0f} s"]


def _steps(experiment: Path, bags: Path, draft: Path, out: Path, tell: Callable[..., None]) -> list[str]:
    """The three steps, written to ``draft``; gives a line about each, by the names that the pages will have."""
    tell("1 of 3: the declared model, through the three nodes")
    before = _run(RunOptions(experiment, bags / TEST, draft / "before", at_frames=True), tell)
    tell("2 of 3: closing the loop")
    diagnosis = diagnose(experiment, [bags / FIT], [bags / TEST], draft / "diagnosis", progress=tell)
    write_report(draft / "diagnosis", diagnosis, load_experiment(experiment))
    tell("3 of 3: the fitted model, through the three nodes")
    fitted = draft / "diagnosis" / "experiment.fitted.yaml"
    after = _run(RunOptions(experiment, bags / TEST, draft / "after", model=fitted, at_frames=True), tell)
    effects = ", ".join(effect.name for effect in diagnosis.effects) or "nothing"
    return [
        f"declared model: {_line(before)}   {out / 'before' / 'report.html'}",
        f"diagnosis: {diagnosis.verdict}; added {effects}   {out / 'diagnosis' / 'report.html'}",
        f"fitted model:   {_line(after)}   {out / 'after' / 'report.html'}",
        f"recording '{TEST}' was only predicted, the effect was fitted to '{FIT}'",
    ]


def _run(options: RunOptions, tell: Callable[..., None]) -> RunMetrics:
    metrics = run(options, tell)
    if metrics.coverage is not None and metrics.coverage.interrupted:
        raise KeyboardInterrupt
    return metrics


def _line(metrics: RunMetrics) -> str:
    return f"rmse {metrics.rmse.value * 1e3:.3f} mm, max {metrics.max * 1e3:.3f} mm, {metrics.level}"
