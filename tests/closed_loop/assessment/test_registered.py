"""Cameras that were registered to the markers at rest: what two cameras see worse does not turn what they see well."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import toy
from scipy.spatial.transform import Rotation
from toy_loop import PLACES

from livedeform.closed_loop.assessment.held_out import errors_of
from livedeform.closed_loop.evidence.observation import Observation
from livedeform.closed_loop.forward import Run

SIDEWAYS, DEPTH, PER_MEAN = 5e-5, 5e-4, 2  # m, m, and frames in a mean


def filmed(o: Observation, true: np.ndarray, view: Rotation, rng: np.random.Generator) -> Observation:
    """Return the recording of markers that are at ``true`` (k, m, 3), seen by cameras that look along the z of a
    ``view``, in a frame that is a little off."""
    spread = view.as_matrix() @ np.diag([SIDEWAYS, SIDEWAYS, DEPTH]) @ view.as_matrix().T
    noise = np.broadcast_to(spread @ spread.T, o.covariances.shape)
    off = Rotation.from_rotvec(rng.normal(scale=2e-3, size=3))
    single, means = (
        off.apply((true + rng.normal(size=true.shape) @ spread / n).reshape(-1, 3)).reshape(true.shape) + 1e-4
        for n in (1.0, np.sqrt(PER_MEAN))
    )
    phases = np.where(np.arange(o.n_moments) > 0, "press", "rest")
    return replace(
        o, phases=phases, points=means, single=single, covariances=noise / PER_MEAN, single_covariances=noise
    )


@pytest.mark.parametrize("angles", [(0.0, 0.0), (0.6, 0.0), (0.9, 0.4), (0.0, -1.2)])
def test_errors_of_the_true_model_are_noise_from_wherever_the_cameras_look(angles: tuple[float, float]) -> None:
    """Measured: 1.02. By millimetres alone it was 1.09 to 1.23, most where cameras look at an angle; a skin that was
    there raised the error on held-out data by 17 % of the noise, and went out (blind test, `random-075`)."""
    rng, body = np.random.default_rng(0), toy.ToyBody(PLACES)
    model, o = toy.ToyModel(body), toy.record([], seed=3, body=body, n=24)
    true = model.predict([], o)
    run = Run(true, None, np.zeros((*true.shape, 0)), None)
    view = Rotation.from_euler("xy", angles)
    chi2 = [errors_of([filmed(o, true, view, rng)], [run], registered=True).chi2() for _ in range(20)]
    assert np.mean(chi2) == pytest.approx(1.0, abs=0.05)
