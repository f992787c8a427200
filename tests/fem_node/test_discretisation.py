"""How much of a prediction the elements get wrong: told before anybody asks, and not told too small."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from livedeform.common.types import Pose
from livedeform.fem_node.contact.probe_shapes import Sphere
from livedeform.fem_node.discretisation import DiscretisationError, discretisation_error
from livedeform.fem_node.element.element import make_space
from livedeform.fem_node.mesh.refine import refined
from livedeform.fem_node.mesh.structured import block_mesh
from livedeform.fem_node.model import PhantomModel
from livedeform.fem_node.physics.record import DeadLoad, MaterialSpec, Physics, Probe, Support
from livedeform.fem_node.simulator import Recorded

SIZE = (0.06, 0.06, 0.04)
DOWN = np.array([1.0, 0.0, 0.0, 0.0])
POSES = [Pose(k * 1_000_000_000, np.array([0.003, 0.002, z]), DOWN) for k, z in enumerate((0.05, 0.036))]
GRID = np.linspace(-0.025, 0.025, 5)
MARKERS = np.array([[x, y, 0.04] for x in GRID for y in GRID])


def body(mesh, *, probe: bool) -> PhantomModel:
    physics = Physics(
        MaterialSpec("neo_hookean", 4000.0, 0.49),
        supports=(Support(lambda X: X[:, 2] < 1e-6),),
        probe=Probe(Sphere(0.02)) if probe else None,
        loads=() if probe else (DeadLoad("press", lambda X: (np.hypot(X[:, 0], X[:, 1]) < 0.012) & (X[:, 2] > 0.03),
                                         np.array([0.0, 0.0, -0.3])),),
    )  # fmt: skip
    return PhantomModel(make_space(mesh), physics, markers=MARKERS)


def error_of(mesh, *, probe: bool):
    recorded = Recorded("r", [p.stamp_ns for p in POSES], 0, POSES if probe else [])
    return discretisation_error(body(mesh, probe=probe), recorded)


def truly(mesh, *, probe: bool) -> float:
    """The rms (m) by which markers move otherwise with all elements halved twice."""
    finest = refined(mesh, np.arange(len(mesh.tets)))
    finest = refined(finest, np.arange(len(finest.tets)))
    moments = [body(m, probe=probe).predict(POSES[1] if probe else None, 10**9).markers for m in (mesh, finest)]
    return float(np.sqrt(np.mean(np.sum((moments[1] - moments[0]) ** 2, axis=1))))


@pytest.mark.parametrize("probe", [True, False], ids=["ball", "load"])
def test_the_estimate_is_of_the_size_of_the_error(probe):
    """Measured: 0.60 times the error under a ball, 1.20 under a load."""
    coarse = block_mesh(SIZE, (4, 4, 3))
    told = error_of(coarse, probe=probe)
    assert told.unknowns[1] > told.unknowns[0]
    ratio = told.rms / truly(coarse, probe=probe)
    assert 0.5 < ratio < 2.0
    assert told.largest >= told.rms


def test_smaller_elements_err_by_less():
    """Measured: 0.62 of it with elements of two thirds."""
    coarse, finer = (error_of(block_mesh(SIZE, cells), probe=True) for cells in ((4, 4, 3), (6, 6, 4)))
    assert finer.rms < 0.75 * coarse.rms


def test_what_stands_in_the_file():
    numbers = error_of(block_mesh(SIZE, (3, 3, 2)), probe=True).as_dict()
    assert numbers["share_of_motion"] == pytest.approx(numbers["rms"] / numbers["motion"])
    assert set(numbers) == {"rms", "largest", "motion", "stamp_ns", "unknowns", "share_of_motion"}


def test_the_pose_is_the_probes_own():
    """A clock that is late by a quarter of a second, with poses stamped late by it: the same press."""
    mesh = block_mesh(SIZE, (3, 3, 2))
    late = [replace(p, stamp_ns=p.stamp_ns + 250_000_000) for p in POSES]
    stamps, delayed = [p.stamp_ns for p in POSES], body(mesh, probe=True)
    delayed.physics = delayed.physics.with_probe(time_offset=0.25)
    one = discretisation_error(body(mesh, probe=True), Recorded("r", stamps, 0, POSES))
    other = discretisation_error(delayed, Recorded("r", stamps, 0, late))
    assert other.rms == pytest.approx(one.rms, rel=1e-6)


@pytest.mark.parametrize(("motion", "said"), [(0.002, "5.0 % of their motion"), (0.0, "they do not move")])
def test_of_markers_that_do_not_move_no_share_is_said(motion: float, said: str):
    line = DiscretisationError(1e-4, 2e-4, motion, 0, (10, 80), np.zeros((1, 3))).line()
    assert said in line and "nan" not in line


def test_where_a_probe_moves_no_marker_their_motion_is_the_weights():
    """A probe that stays in the air: the error of the sag is not without a motion to compare it with."""
    away = [replace(p, position=np.array([0.0, 0.0, 0.06])) for p in POSES]
    heavy = body(block_mesh(SIZE, (4, 4, 3)), probe=True)
    heavy.physics = replace(heavy.physics, density=1000.0)
    found = discretisation_error(heavy, Recorded("r", [p.stamp_ns for p in away], 0, away))
    sag = np.sqrt(np.mean(np.sum((found.markers - MARKERS) ** 2, axis=1)))
    assert found.motion == pytest.approx(sag) and 0.0 < found.share < 1.0
