"""Shared out over processes, a run says what it says in one."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import phantom
import pytest
import toy

from livedeform.closed_loop.candidates import Candidate
from livedeform.closed_loop.evidence.observation import Observation
from livedeform.closed_loop.forward import Column, Run, dictionary_columns
from livedeform.closed_loop.model.fem_model import Body, Setting
from livedeform.closed_loop.model.workers import FemModel, shares, simulate_each
from livedeform.common.types import EffectValues, Pose
from livedeform.fem_node.contact.probe_shapes import make_shape
from livedeform.fem_node.mesh.structured import block_mesh
from livedeform.fem_node.path import rubbing
from livedeform.fem_node.path.mechanics import Mechanics
from livedeform.fem_node.physics.memory import memory_of
from livedeform.fem_node.physics.record import MaterialSpec, Probe, Support
from livedeform.fem_node.simulator import NOT_ENOUGH
from livedeform.fem_node.solve.linear_solver import SolvedColumns

DOWN = np.array([1.0, 0.0, 0.0, 0.0])
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


def test_parts_of_a_recording_share_its_unloaded_shapes() -> None:
    """Those of the body and of its columns are found once, before the parts, and kept: workers know them."""
    g = np.array([0.0, 0.0, -9.81])
    body, o = Body(phantom.setting(2, scan_fraction=1.0, scan_gravity=g, gravity=g)), phantom.moments(SECONDS)
    stiffness = toy.candidates(toy.markers(), ["stiffness"])["stiffness"]
    columns = dictionary_columns([stiffness])
    whole = body.simulate([], o, columns)
    again = Body(body.setting)
    parts = simulate_each([again], [], [o], columns, processes=2)[0]
    assert len(again._simulator._shapes._followed[1]) == 1
    np.testing.assert_allclose(parts.points, whole.points, atol=2e-7)


def test_columns_of_a_body_in_motion_are_shared_out_if_it_is_alone() -> None:
    known = toy.candidates(toy.markers(), ["stiffness", "density", "gravity_tilt"])
    moves = [toy.effect("inertia", rayleigh_beta=1e-3)]
    columns = dictionary_columns([known[n] for n in known])
    o, model = phantom.moments(SECONDS), FemModel(phantom.setting(2), 2)
    (one,) = model._plan(moves, 0, o, columns)
    both = list(model._plan(moves, 0, o, columns, alone=True))
    assert len(one.columns) == 4 and sorted(i for j in both for i in j.columns) == [0, 1, 2, 3]
    assert [(j.worker, len(j.columns), len(j.moments)) for j in both] == [(0, 2, o.n_moments), (1, 2, o.n_moments)]


RUBBING = Probe(make_shape("box", (0.06, 0.015, 0.04), 0.002), friction=0.3)


@pytest.mark.parametrize(("name", "z", "step"), [("gravity_tilt", 0.0, 0.02), ("probe_friction", 0.2, 0.02)])
def test_columns_know_what_slid_and_stuck_on_the_way(name: str, z: float, step: float) -> None:
    """Central differences of whole runs where the probe rubs: off by 0.007 for a tilt, 0.12 for the friction itself (a
    derivative at the moments alone: 0.22 and 0.97)."""
    o = phantom.moments([0.5, 2.9, 3.0, 3.5, 4.5])
    model = FemModel(phantom.setting(2, probe=RUBBING), processes=1)
    candidate = toy.candidates(toy.markers(), [name])[name]
    effects = [candidate.values(np.array([z]))] if z else []
    at = tuple(z if i == 0 else 0.0 for i in range(len(candidate.coordinates)))
    column = model.run(effects, [o], [Column(candidate, at, 0)])[0].d_points[..., 0]
    low, high = (
        model.run([candidate.values(np.array(at) + d * np.eye(len(at))[0])], [o])[0].points for d in (-step, step)
    )
    difference = (high - low) / (2.0 * step)
    assert np.linalg.norm(column - difference) < 0.2 * np.linalg.norm(difference)


def test_a_friction_that_begins_is_followed_without_a_run():
    """Beside a run with friction, from moment to moment: measured a cosine of 0.9997 and a size of 1.03."""
    o = phantom.moments(list(SECONDS))
    model = FemModel(phantom.setting(2), processes=1)
    friction = toy.candidates(toy.markers(), ["probe_friction"])["probe_friction"]
    base = model.run([], [o], [Column(friction, (0.0,), 0)])[0]
    mu = float(friction.kick[0])
    run = model.body.simulate([friction.values(friction.kick)], o, (), path_steps=False)
    column, secant = base.d_points[..., 0], (run.points - base.points) / mu
    size = np.linalg.norm(secant)
    assert (column * secant).sum() > 0.98 * np.linalg.norm(column) * size
    assert 0.9 * size < np.linalg.norm(column) < 1.1 * size


def test_a_candidate_whose_own_run_does_not_end_is_set_aside():
    o = phantom.moments(list(SECONDS))
    known = toy.candidates(toy.markers(), ["probe_adhesion", "stiffness"])
    columns = dictionary_columns([known["probe_adhesion"], known["stiffness"]])
    for own_run, aside in ((1.0, {"probe_adhesion"}), (np.inf, set())):
        run = FemModel(phantom.setting(2), processes=1, own_run=own_run).run([], [o], columns)[0]
        assert set(run.aside) == aside
        assert run.d_points[..., 0].any() != ("probe_adhesion" in aside)
        assert np.isfinite(run.points).all() and run.d_points[..., 1].any()


@pytest.mark.parametrize("n_lost", [2, 6])
def test_a_candidate_whose_own_run_is_lost_at_many_moments_is_set_aside(
    n_lost: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of 17 moments a fifth may be lost: where no equilibrium is, a column of nothing costs a candidate nothing."""
    o = phantom.moments(list(SECONDS))
    columns = dictionary_columns([toy.candidates(toy.markers(), ["probe_adhesion"])["probe_adhesion"]])
    model = FemModel(phantom.setting(2), processes=1, most_lost=0.2)
    simulate = model.body.simulate

    def loses_moments(effects: list[EffectValues], o: Observation, *more: object, **options: Any) -> Run:
        run = simulate(effects, o, *more, **options)
        if any(e.name == "probe_adhesion" for e in effects):
            run.points[-n_lost:] = np.nan
        return run

    monkeypatch.setattr(model.body, "simulate", loses_moments)
    run = model.run([], [o], columns)[0]
    few = n_lost <= 0.2 * o.n_moments
    assert run.d_points[:-n_lost].any() == few and np.isfinite(run.points).all()
    assert run.aside == ({} if few else {"probe_adhesion": "its run finds no equilibrium at 6 of 17 moments"})


@pytest.mark.parametrize("processes", [1, 2])
def test_a_motion_that_was_only_planned_is_given_up_after_its_iterations(processes: int) -> None:
    o = phantom.moments(SECONDS)
    columns = dictionary_columns([toy.candidates(toy.markers(), ["stiffness"])["stiffness"]])
    with FemModel(phantom.setting(2), processes) as model:
        hasty = model.run([], [replace(o, patience=0.1)], columns)[0]
        assert not hasty.whole and any(NOT_ENOUGH in reason for reason in hasty.reasons)
        assert model.run([], [o], columns)[0].whole  # what was recorded is solved at any price


def is_low(points: np.ndarray) -> np.ndarray:
    return points[:, 2] < 1e-3


def test_what_a_body_has_solved_is_not_solved_again(monkeypatch):
    o, setting = phantom.moments(list(SECONDS)), phantom.setting(2)
    body = Body(replace(setting, physics=replace(setting.physics, supports=(Support(is_low),))))
    stiffer = toy.candidates(toy.markers(), ["stiffness"])["stiffness"]
    first = body.simulate([], o, ())
    again = body.simulate([], o, dictionary_columns([stiffer]))
    np.testing.assert_array_equal(again.points, first.points)
    monkeypatch.setattr(Mechanics, "solve", lambda *_: pytest.fail("solved again"))
    np.testing.assert_array_equal(body.simulate([], o, ()).points, first.points)
    with pytest.raises(pytest.fail.Exception):
        body.simulate([stiffer.values(np.array([0.1]))], o, ())


def soft_column() -> tuple[Setting, Observation]:
    """Return a column of gelatin, which a box presses beside its axis as the shipped cuboid, and the moments."""
    n = len(toy.markers())
    places = np.random.default_rng(0).uniform((-0.025, -0.025, 0.02), (0.025, 0.025, 0.07), (n, 3))
    places[:, 1] = -0.025
    material = MaterialSpec(youngs_modulus=2896.0, poisson_ratio=0.49)
    probe = Probe(make_shape("box", (0.02, 0.015, 0.04), 0.003), friction=0.5)
    setting = phantom.setting(2, material=material, probe=probe)
    depth = {0.0: -0.01, 1.0: 0.007, 3.0: 0.016, 4.0: 0.016}  # of which 8 mm are the column's own sag
    poses = [
        Pose(round(1e9 * t), np.array([0.006, 0.0, 0.07 - np.interp(t, list(depth), list(depth.values()))]), DOWN)
        for t in np.arange(0.0, 4.0, 0.05)
    ]
    o = phantom.moments([0.0, 1.5, 2.0, 2.5, 3.0, 3.5], poses)
    return replace(setting, mesh=block_mesh((0.05, 0.05, 0.07), (4, 4, 5)), markers=places), o


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "k", "step"),
    [
        ("stiffness", 0, 0.1),
        ("gravity_tilt", 0, 0.02),
        ("probe_offset", 2, 2e-4),
    ],
)
def test_columns_are_those_of_whole_runs_where_only_friction_keeps_a_soft_body_upright(
    name: str, k: int, step: float
) -> None:
    """Beside central differences of runs: measured cosines of 0.996, 0.984 and 0.990, sizes of 1.00, 1.06 and 0.99."""
    setting, o = soft_column()
    candidate = toy.candidates(toy.markers(), [name])[name]
    model, z = FemModel(setting, processes=1), candidate.shapes[0]
    run = model.run([], [o], [Column(candidate, tuple(z), k)])[0]
    low, high = (model.run([candidate.values(z + d * np.eye(len(z))[k])], [o])[0] for d in (-step, step))
    assert run.rough and not low.rough
    column, difference = run.d_points[..., 0], (high.points - low.points) / (2.0 * step)
    size = np.linalg.norm(difference)
    assert np.sum(column * difference) > 0.98 * size * np.linalg.norm(column)
    assert 0.9 * size < np.linalg.norm(column) < 1.1 * size


def test_columns_where_the_probe_rubs_need_no_fast_solver(monkeypatch) -> None:
    o = phantom.moments([0.5, 2.9, 3.0, 3.5])
    columns = dictionary_columns([toy.candidates(toy.markers(), ["stiffness"])["stiffness"]])
    setting = phantom.setting(2, probe=RUBBING)
    one = Body(setting).simulate([], o, columns)
    monkeypatch.setattr(rubbing, "make_condensing", SolvedColumns)
    two = Body(setting).simulate([], o, columns)
    assert np.abs(two.forces).max() > 0.0
    np.testing.assert_allclose(two.d_points, one.d_points, atol=1e-3 * np.abs(one.d_points).max())


@pytest.mark.slow
def test_a_soft_body_stands_elsewhere_without_the_friction_that_keeps_it_upright() -> None:
    """Why nothing is told of it under a probe that slips: measured 0.66 of its motion apart."""
    setting, o = soft_column()
    body = Body(setting)
    rubs, slips = (each.simulate([], o, ()).points for each in (body, body.slippery()))
    apart, motion = (np.sqrt(np.mean(d**2)) for d in ((slips - rubs)[-1], (rubs[-1] - rubs[0])))
    assert apart > 0.2 * motion


def test_other_loads_of_a_recording_slip_as_well() -> None:
    setting = phantom.setting(2, probe=RUBBING)
    body = Body(replace(setting, acting={"heavier": replace(setting.physics, density=1200.0)})).slippery()
    for recording in ("", "heavier"):
        assert not memory_of(body.physics([], recording)).rubs
    assert body.physics([], "heavier").density == 1200.0
    assert body.slippery() is body


def test_columns_go_to_who_has_less_to_do() -> None:
    weights = [1.0] * 6 + [25.0] + [1.0] * 20
    one, two = shares(weights, [40.0, 0.0])
    assert sorted([*one, *two]) == list(range(len(weights)))
    assert 6 in two
    assert abs(40.0 + len(one) - (25.0 + len(two) - 1)) <= 1.0
    assert shares([1.0] * 3, [0.0, 50.0]) == [[0, 1, 2], []]
    assert shares(weights, [40.0, 0.0]) == [one, two]


def test_runs_of_their_own_are_dealt_out_and_columns_go_to_who_has_less_of_them() -> None:
    names = [
        "stiffness",
        "density",
        "gravity_tilt",
        "poisson_ratio",
        "scan_gravity",
        "skin",
        "probe_adhesion",
        "base_slip",
    ]
    known = toy.candidates(toy.markers(), names)
    columns = dictionary_columns([known[n] for n in names])
    o, model = phantom.moments(SECONDS), FemModel(phantom.setting(2), 2)
    jobs = list(model._plan([], 0, o, columns))
    own = {columns[j.columns[0]].candidate.name: j.worker for j in jobs if j.secant}
    tangents = {j.worker: len(j.columns) for j in jobs if not j.secant}
    assert own.keys() == {"probe_adhesion", "base_slip"}
    assert own["probe_adhesion"] != own["base_slip"]
    assert tangents.get(own["base_slip"], 0) > tangents.get(own["probe_adhesion"], 0)  # one that pulls takes longer
    assert all(len(j.moments) == o.n_moments for j in jobs)
    assert sorted(i for j in jobs for i in j.columns) == list(range(len(columns)))
