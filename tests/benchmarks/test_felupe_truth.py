"""The blind test's foreign truth: against closed forms, and as an experiment."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from benchmarks.blind.cases import sized
from benchmarks.blind.felupe_truth import FelupeTruth
from benchmarks.blind.foreign_cases import ForeignCase, foreign
from scipy.integrate import quad
from scipy.optimize import brentq

from livedeform.common.errors import InputError
from livedeform.common.types import Array
from livedeform.synthetic import scenario
from livedeform.synthetic.solved_motion import planned_path
from livedeform.synthetic.true_effects import World
from livedeform.synthetic.truth import hexmesh
from livedeform.synthetic.truth.physics import TruthPhysics
from livedeform.synthetic.truth.probe import TruthProbe

SIDE, HEIGHT = 0.012, 0.04
E, NU, DENSITY = 4000.0, 0.49, 1000.0
PLATE = TruthProbe("box", (0.08, 0.08, 0.02), 0.004)


def column(**changes: object) -> World:
    """A block that slides on its base all but freely: what happens in it is uniaxial."""
    mesh = hexmesh.block([SIDE, SIDE, HEIGHT], [2, 2, 4])
    return World(mesh, TruthPhysics(E, NU, DENSITY, base_stiffness=100.0).changed(**changes))


def nominal_stress(stretch: float, factor: float = 1.0) -> float:
    """Pa of a bar with mu/2 (J^-2/3 I1 - 3) + K/2 (J - 1)^2 at an axial stretch, its sides free."""
    mu, K = factor * E / (2 * (1 + NU)), factor * E / (3 * (1 - 2 * NU))

    def piola(along: float, sideways: float) -> tuple[float, float]:
        J, I1 = along * sideways**2, along**2 + 2 * sideways**2
        a, s = (mu * J ** (-2 / 3) * (v - I1 / (3 * v)) + K * (J - 1) * J / v for v in (along, sideways))
        return a, s

    sideways = brentq(lambda s: piola(stretch, s)[1], 0.8, 1.6)
    return piola(stretch, sideways)[0]


def sinks(factor: float = 1.0) -> float:
    """m that the top of the column sinks by its weight."""

    def stretch(z: float) -> float:
        load = -DENSITY * 9.81 * (HEIGHT - z)
        return float(brentq(lambda s: nominal_stress(s, factor) - load, 0.6, 1.1))

    return HEIGHT - float(quad(stretch, 0.0, HEIGHT)[0])


def top_mean(mesh: hexmesh.HexMesh, x: Array) -> float:
    """m, of the top's heights over its area: sections of a column that widens downwards do not stay flat."""
    points, weights = hexmesh.gauss(3, 2)
    faces = mesh.faces[np.isclose(mesh.nodes[mesh.faces][:, :, 2], HEIGHT).all(1)]
    heights = np.einsum("qa,fa->fq", hexmesh.face_shape(points), x[faces][:, :, 2])
    return float((heights @ weights).mean() / weights.sum())


@pytest.mark.parametrize("factor", [1.0, 1.5])
def test_a_column_sinks_by_its_weight_as_it_must(factor: float) -> None:
    pytest.importorskip("felupe")
    modulus = () if factor == 1.0 else (lambda X, t: np.full(len(X), factor),)
    body = FelupeTruth(column(modulus=modulus), PLATE)
    assert HEIGHT - top_mean(body.mesh, body.rest()) == pytest.approx(sinks(factor), rel=1e-3)


def test_a_weightless_block_pressed_by_a_plate_pushes_back_as_it_must() -> None:
    pytest.importorskip("felupe")
    body = FelupeTruth(column(gravity=(0.0, 0.0, 0.0)), PLATE)
    probe = {"shape": {"box": [0.08, 0.08, 0.02]}, "edge_radius": 0.004, "friction": 0.0}
    plan = {"a": [{"at": [0.0, 0.0], "depth": 0.004}]}
    block = {"shape": "block", "size": [SIDE, SIDE, HEIGHT], "elements": [2, 2, 4]}
    spec = scenario.load({"name": "column", "body": block, "probe": probe, "recordings": plan, "path_step": 0.004})
    path = planned_path(plan["a"], body.rest(), body.mesh, spec)
    states = body.recording(path, 0.0, spec, lambda fraction: None)
    deepest = int(np.argmin(states.force[:, 2]))
    stretch = top_mean(body.mesh, states.x[deepest]) / HEIGHT
    assert stretch == pytest.approx(0.9, abs=1e-4)  # less what the penalty lets in: 10 um per pressure of the modulus
    assert states.force[deepest, 2] == pytest.approx(SIDE**2 * nominal_stress(stretch), rel=1e-4)
    np.testing.assert_allclose(states.torque[deepest], 0.0, atol=1e-6)
    np.testing.assert_allclose(states.x[0], body.mesh.nodes, atol=1e-7)


def test_a_body_that_swells_grows_by_its_share() -> None:
    pytest.importorskip("felupe")
    grown = (lambda X, t: np.full(len(X), 1.01**3),)
    body = FelupeTruth(column(gravity=(0.0, 0.0, 0.0), growth=grown), PLATE)
    nodes = body.mesh.nodes
    np.testing.assert_allclose(np.ptp(body.rest(), axis=0), 1.01 * np.ptp(nodes, axis=0), rtol=1e-6)


def test_it_makes_an_experiment_with_its_recordings(tmp_path: Path) -> None:
    pytest.importorskip("felupe")
    case = ForeignCase("foreign", "single", (sized("probe_offset", 2.0),), 2.0, 7, "cuboid", "ball")
    spec = case.scenario()
    spec["body"] = {**spec["body"], "elements": [4, 3, 2]}
    spec["declared"]["ship_mesh"] = False
    spec["recordings"] = {"a": [{"at": [0.0, 0.0], "depth": 0.004}]}
    scenario.make(spec, tmp_path, 7, solver=FelupeTruth)
    assert (tmp_path / "experiment" / "experiment.yaml").is_file()
    truth = np.load(tmp_path / "truth" / "a.npz")
    assert truth["force"][:, 2].min() < -0.1 and truth["force"][0, 2] == 0.0
    assert np.isfinite(truth["markers"]).all()


@pytest.mark.parametrize("changes", [{"friction": 0.1}, {"prony": ((0.1, 2.0),)}, {"stiffening": 2.0}])
def test_what_it_cannot_solve_is_refused(changes: dict) -> None:
    with pytest.raises(InputError, match="not made for"):
        FelupeTruth(column(**changes), PLATE)


def test_a_bent_slab_stands_on_its_base() -> None:
    mesh = hexmesh.bent_slab([0.1, 0.05, 0.03], [4, 2, 2], 0.1)
    middle = np.linalg.norm(mesh.nodes[:, :2] + [0.0, 0.1], axis=1)
    assert middle.min() == pytest.approx(0.075) and middle.max() == pytest.approx(0.125)
    assert mesh.nodes[:, 2].min() == 0.0 and mesh.nodes[:, 2].max() == pytest.approx(0.03)


def test_the_foreign_cases_cover_the_grid() -> None:
    cases = [c for c in foreign() if isinstance(c, ForeignCase)]
    assert len({c.name for c in cases}) == len(cases) == len({c.seed for c in cases})
    assert len({(c.body, c.probe) for c in cases}) == 9
    assert {c.element for c in cases} == {0.005, 0.008, 0.014} and {c.rate for c in cases} == {10.0, 30.0}
    assert len({c.truth for c in cases if c.truth}) >= 8
    for case in cases:
        spec = scenario.load(case.scenario())
        assert not any(name in spec["name"] for name in case.truth)
