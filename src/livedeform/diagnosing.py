"""``livedeform diagnose``: the closed loop, its files, and its report."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from livedeform.closed_loop.diagnosis import Diagnosis
from livedeform.closed_loop.loop import diagnose as close_the_loop
from livedeform.common.experiment.yaml_file import load_experiment
from livedeform.report.diagnosis.page import diagnosis_verdict, write_report


def diagnose(
    experiment: Path,
    fit: Sequence[Path],
    test: Sequence[Path],
    out: Path,
    candidates: Sequence[str] | None,
    max_effects: int,
    seed: int,
    progress: Callable[[str, float | None], None],
) -> list[str]:
    """Closes the loop and writes its files and ``report.html``; gives the lines that the terminal shows."""
    result = close_the_loop(
        experiment, fit, test, out, candidates=candidates, max_effects=max_effects, seed=seed, progress=progress
    )
    progress("writing the report", None)
    write_report(out, result, load_experiment(experiment))
    return summary(result)


def summary(result: Diagnosis) -> list[str]:
    """The answer in a few lines."""
    from livedeform.closed_loop.write import as_json

    verdict = diagnosis_verdict(as_json(result))
    lines = [f"verdict: {result.verdict}. {verdict.said}", verdict.because]
    for effect in result.effects:
        values = ", ".join(f"{name} = {value}" for name, value in effect.values.items())
        lines.append(f"  {effect.name}: {values}")
    return lines
