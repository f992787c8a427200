"""Shared out over processes, a run says what it says in one."""

from __future__ import annotations

import numpy as np
import phantom
import pytest
import toy

from closed_loop.catalogue import Candidate
from closed_loop.forward import Run, dictionary_columns
from closed_loop.workers import FemModel
from livedeform_common.types import EffectValues

SECONDS = (0.5, 1.5, 2.2, 2.5, 2.9, 3.0, 3.5, 4.0, 4.2, 5.0, 5.5, 6.0, 6.5, 7.0, 7.5, 8.0, 8.5)


def run_on(processes: int, effects: list[EffectValues], candidates: list[Candidate]) -> Run:
    o = phantom.moments(SECONDS)
    with FemModel(phantom.setting(2), processes) as model:
        return model.run(effects, [o], dictionary_columns(candidates))[0]


@pytest.mark.parametrize(
    "names",
    [
        ("stiffness", "probe_offset"),  # a part of the moments each
        ("viscoelasticity",),  # remembers: in one piece
        ("stiffness", "base_slip"),  # with a run of its own
        ("stiffness", "density", "gravity_tilt", "viscoelasticity", "swelling", "probe_offset"),  # columns shared out
    ],
)
def test_two_processes_give_what_one_gives(names: tuple[str, ...]) -> None:
    known = toy.candidates(toy.markers(), names)
    candidates = [known[n] for n in names]
    stiffer = toy.candidates(toy.markers(), ["strain_stiffening"])["strain_stiffening"]
    effects = [stiffer.values(stiffer.shapes[0])]
    one, two = run_on(1, effects, candidates), run_on(2, effects, candidates)
    assert np.isfinite(one.points).all()
    np.testing.assert_allclose(two.points, one.points, atol=2e-7)  # m; measured 3e-8
    for c in range(one.d_points.shape[-1]):
        difference = np.linalg.norm(two.d_points[..., c] - one.d_points[..., c])
        assert difference <= 2e-2 * np.linalg.norm(one.d_points[..., c])
