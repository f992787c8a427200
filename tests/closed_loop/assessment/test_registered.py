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
from livedeform.closed_loop.evidence.recordings import split
from livedeform.closed_loop.forward import Run
from livedeform.common.types import Pose

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


@pytest.mark.parametrize("rests_after", [True, False])
def test_a_part_that_begins_in_a_press_is_not_registered_to_it(rests_after: bool) -> None:
    """A probe is 2 mm deeper than declared in a press of 12 s, whose end is held out: what of the error is rigid where
    it pressed was taken off, and put on elsewhere."""
    times = np.array([0.0, 4.0, 5.2, 17.2, 17.7, 30.0 if rests_after else 17.8])
    depths = np.array([-0.01, -0.005, 0.010, 0.010, -0.005, -0.005])
    stamps = np.arange(0.0, times[-1], 0.01)
    down = np.interp(stamps, times, depths)
    path = [
        Pose(int(t * 1e9), np.array([0.01, 0.0, toy.HEIGHT - d]), np.array([1.0, 0.0, 0.0, 0.0]))
        for t, d in zip(stamps, down, strict=True)
    ]
    o = toy.record([toy.effect("probe_offset", translation=[0.0, 0.0, 0.002])], seed=1, poses=path, n=30)
    held = split(o)[1]
    later = np.isin(o.stamps_ns, held.stamps_ns)
    model = toy.ToyModel(toy.ToyBody(PLACES))
    (whole,), (part,) = (errors_of([r], model.run([], [r]), registered=True).recordings for r in (o, held))
    assert held.phases[0] != "rest" and bool((held.phases == "rest").any()) is rests_after
    off = np.linalg.norm(part.measured - whole.measured[later], axis=2)
    assert np.nanmax(off) < 6e-5  # measured 2.7e-5
