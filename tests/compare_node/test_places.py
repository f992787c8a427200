"""What the markers' stated places leave of an error is in the run's intervals and in its verdict."""

from __future__ import annotations

import numpy as np
import pytest

from livedeform.common.experiment.schema import Markers
from livedeform.compare_node.judgement import judge
from livedeform.compare_node.metrics import Level, run_metrics
from livedeform.compare_node.places import with_places
from livedeform.compare_node.residual import Residual

N, FRAMES, NOISE = 20, 80, 2e-5


def _markers(sigma: float, n: int = N) -> Markers:
    return Markers(np.arange(n, dtype=np.uint32), np.zeros((n, 3)), np.full(n, sigma), np.full(n, "surface"))


def _recording(own: float, sigma: float, seed: int = 0) -> list[Residual]:
    """A model that errs by ``own`` (m) along x everywhere, markers that are declared ``sigma`` beside their places."""
    rng, out = np.random.default_rng(seed), []
    beside = sigma * rng.standard_normal((N, 3))
    for k in range(FRAMES):
        predicted = rng.standard_normal((N, 3))
        measured = predicted + beside + [own, 0.0, 0.0] + NOISE * rng.standard_normal((N, 3))
        out.append(
            Residual(k, np.arange(N, dtype=np.uint32), measured, predicted, np.tile(NOISE**2 * np.eye(3), (N, 1, 1)))
        )
    return out


def test_places_alone_are_no_error_of_the_model():
    """1.73 mm rms of places that are known to 1 mm, where 1 mm is allowed; a model that errs by 4 mm is still wrong."""
    fine, wrong = _recording(0.0, 1e-3), _recording(4e-3, 1e-3)
    for residuals, level in ((fine, Level.WARN), (wrong, Level.ERROR)):
        assert judge(run_metrics(residuals, 1e-3)).level == Level.ERROR
        said = judge(metrics := with_places(run_metrics(residuals, 1e-3), residuals, _markers(1e-3)))
        assert said.level == level and "marker places alone would leave 1.73 mm" in said.sentence
        assert metrics.places == pytest.approx(1e-3 * np.sqrt(3.0))


def test_no_number_of_frames_makes_places_known():
    """The interval holds the error as it is without the places' draw in it; that of the frames alone does not."""
    held = alone = 0
    for seed in range(60):
        residuals = _recording(3e-3, 1e-3, seed)
        bare = run_metrics(residuals, 5e-3)
        wide = with_places(bare, residuals, _markers(1e-3))
        expected = np.sqrt(3e-3**2 + 3.0 * 1e-3**2 + 3.0 * NOISE**2)
        held += wide.rmse.low <= expected <= wide.rmse.high
        alone += bare.rmse.low <= expected <= bare.rmse.high
        assert wide.rmse.value == bare.rmse.value and wide.p95.low < bare.p95.low and wide.p95.high > bare.p95.high
    assert held >= 53 and alone < 10  # 57 of 60 are expected


def test_places_that_nobody_doubts_change_nothing():
    residuals = _recording(1e-3, 0.0)
    bare = run_metrics(residuals, 5e-3)
    assert with_places(bare, residuals, _markers(np.nan)) == bare and with_places(bare, [], _markers(1e-3)) == bare
