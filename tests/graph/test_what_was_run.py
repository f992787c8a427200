"""What a run counts is what was recorded: each moment once, of this recording, as far as it was played."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import small

from livedeform.common.types import MarkerFrame, Prediction
from livedeform.run.running import RunOptions, run

SIZE = float(np.linalg.norm(small.OFFSET))


def measured(direct: list[Prediction], sigma: float = 5e-5) -> list[MarkerFrame]:
    return [small.frame(p.stamp_ns, p.ids, p.markers + small.OFFSET, sigma) for p in direct]


def of(frame: MarkerFrame, rows: slice) -> MarkerFrame:
    """Some of a frame's markers."""
    return replace(frame, ids=frame.ids[rows], points=frame.points[rows], covariances=frame.covariances[rows],
                   reprojection_error_px=frame.reprojection_error_px[rows])  # fmt: skip


def results(out: Path) -> dict[str, Any]:
    return json.loads((out / "metrics.json").read_text())


def silent(*_: object) -> None:
    """No progress."""


SENT: dict[str, tuple[Callable[[MarkerFrame], list[MarkerFrame]], int]] = {
    "twice": (lambda f: [f, f], 12),
    "thrice": (lambda f: [f, f, f], 24),
    "in two halves": (lambda f: [of(f, slice(0, 6)), of(f, slice(6, None))], 0),
    "in two halves, one twice": (lambda f: [of(f, slice(0, 6)), of(f, slice(6, None)), of(f, slice(0, 6))], 12),
}


@pytest.mark.parametrize("name", SENT)
def test_a_moment_counts_once_however_often_it_is_sent(
    name: str, experiment: Path, direct: list[Prediction], tmp_path: Path
):
    """Twice made "only 12 of 24 measured frames were compared", halves lost the second half of the markers."""
    send, left_out = SENT[name]
    frames = [sent for frame in measured(direct) for sent in send(frame)]
    run(RunOptions(experiment, small.write_bag(tmp_path / "b.mcap", small.press(), frames), tmp_path / "out"), silent)
    told = results(tmp_path / "out")
    coverage = told["coverage"]
    assert (coverage["frames_measured"], coverage["frames_compared"], coverage["repeated"]) == (12, 12, left_out)
    assert told["error"]["n"] == 12 * 11 and told["error"]["rmse"] == pytest.approx(SIZE, abs=1e-8)
    assert (f"{left_out} measured frames were left out: their stamp was there already" in told["reason"]) == (
        left_out > 0
    )
