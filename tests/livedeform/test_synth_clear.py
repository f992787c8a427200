"""Recordings begin with nothing pressed: the probe, as wide and tilted as it is, is clear of it between presses."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from livedeform.common.types import Array
from livedeform.synthetic import scenario
from livedeform.synthetic.solved_motion import SLACK, build_world, planned_path, solved_times
from livedeform.synthetic.trajectory import CLEARANCE, Press, ProbePath, presses, turned
from livedeform.synthetic.truth import hexmesh
from livedeform.synthetic.truth.probe import TruthProbe

BODIES: dict[str, dict[str, Any]] = {
    "block": {"shape": "block", "size": [0.05, 0.05, 0.03], "elements": [3, 3, 2]},
    "dome": {"shape": "hemi_ellipsoid", "semi_axes": [0.05, 0.05, 0.045], "elements": [4, 1]},
}
PROBES: dict[str, dict[str, Any]] = {
    "ball": {"shape": {"sphere": 0.03}},
    "cylinder": {"shape": {"cylinder": [0.03, 0.04]}, "edge_radius": 0.002},
    "box": {"shape": {"box": [0.03, 0.015, 0.04]}, "edge_radius": 0.002},
}
PLANS: dict[str, list[dict[str, Any]]] = {
    "middle": [{"at": [0.0, 0.0], "depth": 0.003}],
    "side": [{"at": [0.02, 0.005], "depth": 0.003}],
    "tilted": [{"at": [0.0, 0.0], "depth": 0.003, "tilt": [0.0, 0.35]}],
    "tilted both": [{"at": [0.015, -0.005], "depth": 0.002, "tilt": [-0.3, 0.2]}],
    "over the top": [{"at": [-0.02, 0.0], "depth": 0.002}, {"at": [0.02, 0.0], "depth": 0.003}],
    "up a slope": [{"at": [-0.02, 0.0], "depth": 0.001, "stroke": [0.018, 0.0]}],
    "turning": [{"at": [-0.01, 0.0], "depth": 0.002, "tilt": [0.0, -0.4]}, {"at": [0.01, 0.0], "depth": 0.002}],
}


def planned(body: str, probe: str, plan: str) -> tuple[ProbePath, TruthProbe, hexmesh.HexMesh, dict[str, Any]]:
    spec = scenario.load({"name": "x", "body": BODIES[body], "probe": PROBES[probe], "recordings": {"a": PLANS[plan]}})
    world, shape = build_world(spec)
    return planned_path(PLANS[plan], world.mesh.nodes, world.mesh, spec), shape, world.mesh, spec


def clearance(shape: TruthProbe, mesh: hexmesh.HexMesh, T: Array) -> float:
    """Return how far the probe is from the body's surface, m: from places that the plan does not know."""
    weights, faces, _ = hexmesh.surface_triangles(mesh, 7)
    surface = np.einsum("pa,pad->pd", weights, mesh.nodes[mesh.faces[faces]])
    return float(shape.distance((surface - T[:3, 3]) @ T[:3, :3])[0].min())


@pytest.mark.parametrize("plan", PLANS)
@pytest.mark.parametrize("probe", PROBES)
@pytest.mark.parametrize("body", BODIES)
def test_the_probe_is_clear_between_presses_and_touches_in_each(body: str, probe: str, plan: str) -> None:
    path, shape, mesh, _ = planned(body, probe, plan)
    least = CLEARANCE - SLACK if path.contact is None else CLEARANCE
    high = path.positions[:, 2].max()
    for t in np.linspace(0.0, path.duration, 40):
        if path(t)[2, 3] == high:
            assert clearance(shape, mesh, path(t)) > least - 5e-5  # m; measured 9.9e-6 below at most
    for k, press in enumerate(PLANS[plan]):
        deepest = np.flatnonzero(path.positions[:, 2] < high)[0] if k == 0 else np.argmin(path.positions[:, 2])
        T = path(float(path.times[deepest]))
        assert -press["depth"] - SLACK - 1e-4 < clearance(shape, mesh, T) < 0.0


@pytest.mark.parametrize("plan", ["middle", "over the top"])
@pytest.mark.parametrize("probe", PROBES)
def test_what_was_right_is_planned_as_it_was(probe: str, plan: str) -> None:
    """On a flat top the middle of a probe that is not tilted touches first."""
    path, _, mesh, _ = planned("block", probe, plan)
    before = presses([Press.of(p) for p in PLANS[plan]], [float(mesh.nodes[:, 2].max())] * len(PLANS[plan]))
    assert path.contact is None
    for name in ("times", "positions", "tilts"):
        np.testing.assert_allclose(getattr(path, name), getattr(before, name), rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("plan", ["side", "tilted", "over the top"])
@pytest.mark.parametrize("probe", ["cylinder", "box"])
def test_states_are_solved_before_it_touches(probe: str, plan: str) -> None:
    """Of two states that follow each other the second touches only within a step from the first."""
    path, shape, mesh, spec = planned("dome", probe, plan)
    physics = build_world(spec)[0].physics
    times = solved_times(physics, path, float(mesh.nodes[:, 2].max()), spec)
    T = [path(float(t)) for t in times]
    for one, two in pairwise(T):
        touches = clearance(shape, mesh, two) < 0.0
        if touches and one[2, 3] > two[2, 3]:
            assert one[2, 3] - two[2, 3] < 2e-3  # m; measured 0.98e-3


@pytest.mark.parametrize("gap", [0.0, 0.004])
def test_a_ball_comes_down_to_where_it_touches_a_slope(gap: float) -> None:
    s = np.linspace(-0.05, 0.05, 401)
    plane = np.stack(np.meshgrid(s, s, indexing="ij"), axis=-1).reshape(-1, 2)
    slope = 0.3
    body = np.column_stack([plane, slope * plane[:, 0]])
    ball = TruthProbe("sphere", (0.02,))
    expected = slope * 0.005 + (0.02 + gap) * np.hypot(1.0, slope) - 0.02  # its lowest point, over the place (0.005, 0)
    assert ball.comes_down_to(body, turned((0.0, 0.0)), np.array([0.005, 0.0]), gap) == pytest.approx(
        expected, abs=2e-6
    )
    assert ball.comes_down_to(body, turned((0.0, 0.0)), np.array([0.2, 0.0]), gap) == -np.inf


@pytest.mark.parametrize(("body", "probe", "plan"), [("block", "box", "tilted"), ("dome", "cylinder", "side")])
def test_a_recording_begins_at_rest(body: str, probe: str, plan: str, tmp_path: Path) -> None:
    """They began with 0.25 N and markers 0.45 mm from rest, and the tilted box in contact."""
    spec: dict[str, Any] = {
        "name": "clear",
        "body": BODIES[body],
        "declared": {"ship_mesh": False, "element_size": 0.012},
        "probe": PROBES[probe],
        "markers": {"surface": 12},
        "path_step": 0.002,
        "recordings": {"a": PLANS[plan]},
    }
    scenario.make(spec, tmp_path / "out", kept=tmp_path / "kept")
    truth = np.load(tmp_path / "out" / "truth" / "a.npz")
    assert np.abs(truth["force"][0]).max() == 0.0
    assert np.abs(truth["markers"][0] - truth["rest"]).max() < 1e-6  # m; measured 0
    assert truth["force"][:, 2].min() < -0.05  # N; measured -0.10 and -0.36
    assert [p.stem.endswith("-clear") for p in (tmp_path / "kept").iterdir()] == [True]
