"""What a diagnosis keeps for pooled fits says the same as its own fit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import toy

from livedeform.closed_loop.inference.fitted_model import Added
from livedeform.closed_loop.inference.forward_selection import ForwardSelection, Selection
from livedeform.closed_loop.linearised import write_linearised

PLACES = toy.markers()
NAMES = ("stiffness", "gravity_tilt", "viscoelasticity")


def found(*effects: object) -> Selection:
    """The search's result on a toy recording with these undeclared effects."""
    observation = toy.record(list(effects), seed=3, body=toy.ToyBody(PLACES), n=30)
    model = toy.ToyModel(toy.ToyBody(PLACES))
    candidates, uncertain = toy.candidates(PLACES, NAMES), toy.uncertain(PLACES)
    return ForwardSelection.of(toy.SETTINGS, model, [observation], candidates, uncertain, max_effects=2).find()


def test_the_kept_normal_equations_give_the_fitted_value_again(tmp_path: Path) -> None:
    selection = found(toy.effect("gravity_tilt", angle_x=0.06, angle_y=0.02))
    assert selection.model.names == ["gravity_tilt"] and selection.model.joint is not None
    assert write_linearised(selection, tmp_path / "linearised.npz")
    with np.load(tmp_path / "linearised.npz", allow_pickle=False) as kept:
        assert set(kept["effect"].tolist()) == set(NAMES)
        mine = np.flatnonzero(kept["effect"] == "gravity_tilt")
        A = kept["G"][np.ix_(mine, mine)] + np.diag(1.0 / kept["sigma"][mine] ** 2)
        z, sigma = np.linalg.solve(A, kept["b"][mine]), np.sqrt(np.diag(np.linalg.inv(A)))
        assert kept["fitted"][mine].all() and not kept["fitted"][kept["effect"] == "stiffness"].any()
        assert kept["parameter"][mine].tolist() == ["angle_x", "angle_y"]
        assert float(kept["c"]) >= float(kept["b"][mine] @ z)
    fit = selection.model.joint
    assert np.all(np.abs(z - fit.z) < 0.2 * fit.sigma)
    assert sigma == pytest.approx(fit.sigma, rel=0.05)
    assert (tmp_path / "linearised.npz").stat().st_size < 20_000


def test_shapes_are_integrated_out_and_nothing_found_is_kept_too(tmp_path: Path) -> None:
    selection = found(toy.effect("viscoelasticity", g=[0.1], tau=[2.0]))
    assert write_linearised(selection, tmp_path / "linearised.npz")
    with np.load(tmp_path / "linearised.npz", allow_pickle=False) as kept:
        assert (kept["effect"] == "viscoelasticity").sum() == 1  # g; tau is a shape
        assert kept["fitted"][kept["effect"] == "viscoelasticity"].all()
    assert write_linearised(found(), tmp_path / "nothing.npz")


@pytest.mark.parametrize("form", [0, 2], ids=["power law", "two terms"])
def test_what_is_kept_is_labelled_as_it_was_fitted(tmp_path: Path, form: int) -> None:
    """A relaxation of two terms had the label of one for its two columns, and no campaign could read it; the strength
    of a power law was called g. Which times or exponents they are of is kept too."""
    selection = found(toy.effect("viscoelasticity", g=[0.1], tau=[2.0]))
    fit = selection.model.joint
    assert fit is not None
    candidate = selection.candidates["viscoelasticity"].forms[form]
    columns = np.repeat(fit.columns[:, :1], len(candidate.coordinates), axis=1)
    model = replace(
        selection.model,
        added=(Added(candidate, candidate.beginning),),
        joint=replace(fit, columns=columns, z=candidate.beginning),
    )
    write_linearised(replace(selection, model=model), tmp_path / "kept.npz")
    with np.load(tmp_path / "kept.npz", allow_pickle=False) as kept:
        mine = kept["effect"] == "viscoelasticity"
        wanted = [c.parameter for c in candidate.coordinates if c.amplitude]
        assert kept["parameter"][mine].tolist() == wanted and len(wanted) == (1, 0, 2)[form]
        assert kept["G"].shape == 2 * (len(mine),)
        shape = kept["shape_parameter"][kept["shape_effect"] == "viscoelasticity"].tolist()
        assert shape == [c.parameter for c in candidate.coordinates if not c.amplitude]
        values = kept["shape_value"][kept["shape_effect"] == "viscoelasticity"]
        starts = [
            c.value(z) for c, z in zip(candidate.coordinates, candidate.beginning, strict=True) if not c.amplitude
        ]
        assert values == pytest.approx(starts)
