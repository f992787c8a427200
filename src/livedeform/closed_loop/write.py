"""Write what a diagnosis leaves behind: ``diagnosis.json``, ``experiment.fitted.yaml``, ``baselines.json`` (what other
methods say), ``settings.json`` (the numbers that decided), ``linearised.npz`` (for fits over several diagnoses) and the
proposed trajectory as a bag."""

from __future__ import annotations

import json
import math
import time
from pathlib import Path
from typing import Any

import numpy as np

from livedeform.closed_loop.assessment.held_out import NextRecording
from livedeform.closed_loop.assessment.next_experiment import Proposal
from livedeform.closed_loop.diagnosis import Diagnosis
from livedeform.closed_loop.inputs import Inputs
from livedeform.closed_loop.linearised import write_linearised
from livedeform.common.bags.recording_writer import RecordingWriter
from livedeform.common.bags.write import BagWriter
from livedeform.common.experiment.yaml_file import Experiment, save_experiment
from livedeform.common.published_effects import with_others
from livedeform.common.types import EffectValues, Pose


def write_diagnosis(result: Diagnosis, inputs: Inputs, out: Path) -> None:
    """Writes the files into the folder ``out``."""
    out.mkdir(parents=True, exist_ok=True)
    (out / "diagnosis.json").write_text(json.dumps(as_json(result), indent=2) + "\n")
    (out / "settings.json").write_text(json.dumps(inputs.settings.as_dict(), indent=2) + "\n")
    write_linearised(result.selection, out / "linearised.npz", inputs.experiment)
    if result.baselines is not None:
        (out / "baselines.json").write_text(json.dumps(result.baselines.as_dict(), indent=2) + "\n")
    if inputs.experiment is not None:
        effects = with_others(inputs.experiment.effects, result.effects)
        save_experiment(with_clock(inputs), out / "experiment.fitted.yaml", effects=effects)
    if result.proposal is not None and result.proposal.best is not None:
        write_proposal(result.proposal, out / "proposal")


def with_clock(inputs: Inputs) -> Experiment:
    """The experiment with the stamp from which drifts count: they go on into recordings that are made later."""
    assert inputs.experiment is not None  # the caller's
    if inputs.forward is None:
        return inputs.experiment
    clock = {"clock_start_ns": inputs.forward.setting.clock_start_ns}
    return inputs.experiment.model_copy(update={"timeline": inputs.experiment.timeline.model_copy(update=clock)})


def as_json(result: Diagnosis) -> dict[str, Any]:
    """The content of ``diagnosis.json`` (interfaces, section 5)."""
    return {
        "version": 1,
        "verdict": result.verdict,
        "effects": [effect_json(e) for e in result.effects],
        "candidates": [
            {
                "name": c.name,
                "test_rmse": number(c.test_rmse),
                "score": number(c.score),
                "score_gap": number(c.score_gap),
                "indistinguishable_from": list(c.indistinguishable_from),
                "detectable": number(result.detectable[c.name].size) if c.name in result.detectable else None,
                "detectable_parameter": result.detectable[c.name].parameter if c.name in result.detectable else None,
                "declared": c.name in result.differing,
            }
            for c in result.ranking
        ],
        "error_before": {k: number(v) for k, v in result.before.as_dict().items()},
        "error_after": {k: number(v) for k, v in result.after.as_dict().items()},
        "noise_floor": number(result.floor),
        "improvement_of": "the held-out recordings' mean: " + ", ".join(dict.fromkeys(o.name for o in result.held_out)),
        "improvement_interval": [number(v) for v in result.improvement],
        "next_recording": next_json(result.next_recording),
        "explained": number(result.explained),
        "doubts": list(result.doubts),
        "unexplained": result.text,
        "coverage": {
            "frames_compared": result.coverage.frames_compared,
            "frames_measured": result.coverage.frames_measured,
            "presses": result.coverage.presses,
        },
    }


def next_json(expected: NextRecording | None) -> dict[str, Any] | None:
    """Write what another recording is expected to show: 95 % intervals; None where one recording does not say."""
    if expected is None:
        return None
    return {
        "recordings": expected.error.n,
        "error_after_rmse": [number(v) for v in expected.error.next],
        "improvement": [number(v) for v in expected.improvement],
    }


def effect_json(effect: EffectValues) -> dict[str, Any]:
    """One effect with values, sigmas, the ends of their 95 % intervals, and what is declared of them; null is an end
    that is not finite."""
    parameters = {}
    for name, value in effect.values.items():
        entry: dict[str, Any] = {"value": np.asarray(value).tolist()}
        if name in effect.sigmas:
            entry["sigma"] = np.asarray(effect.sigmas[name]).tolist()
        if name in effect.intervals:
            ends = np.array(effect.intervals[name], object)
            ends[~np.isfinite(ends.astype(float))] = None
            entry["interval"] = ends.tolist()
        if name in effect.declared:
            entry["declared"] = np.asarray(effect.declared[name]).tolist()
        parameters[name] = entry
    return {"name": effect.name, "parameters": parameters}


def number(value: float) -> float | int | None:
    """A JSON number; what is not finite becomes null."""
    if isinstance(value, int):
        return value
    return float(value) if math.isfinite(value) else None


def write_proposal(proposal: Proposal, path: Path) -> None:
    """The proposed trajectory as a bag of ``/probe/pose`` that a robot can play; stamps begin now."""
    assert proposal.best is not None  # the caller's
    start = time.time_ns()
    with BagWriter(path, {"livedeform": "proposal", "trajectory": proposal.best.name}) as bag:
        writer = RecordingWriter(bag)
        for pose in proposal.best.poses:
            writer.pose(Pose(start + pose.stamp_ns, pose.position, pose.orientation_xyzw))
