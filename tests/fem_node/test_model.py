"""The phantom model: markers carried, failed frames forgotten, release, loaded scans, files, the notebook's body."""

from __future__ import annotations

from dataclasses import replace

import meshio
import numpy as np
import pytest
from bodies import plane, soft
from described import Body
from scipy.spatial.transform import Rotation

from livedeform.common.errors import ConvergenceError, InputError
from livedeform.common.types import Pose
from livedeform.fem_node.contact.probe_shapes import Box
from livedeform.fem_node.element.element import make_space
from livedeform.fem_node.embedded_points import EmbeddedPoints
from livedeform.fem_node.mesh.structured import block_mesh, hemi_ellipsoid_mesh
from livedeform.fem_node.model import PhantomModel
from livedeform.fem_node.output import write_series, write_step
from livedeform.fem_node.path.walk import WALK
from livedeform.fem_node.physics.record import DeadLoad, Inertia, PlasticSet, Probe, Prony, Support
from livedeform.fem_node.simulator import Recorded, Simulator
from livedeform.fem_node.solve import solver as solver_module

DOWN = np.array([1.0, 0.0, 0.0, 0.0])
SIZE, HEIGHT = 0.04, 0.03
MARKERS = np.array([[0.0, 0.012, HEIGHT], [0.0, 0.0, HEIGHT + 0.004], [SIZE / 2, 0.0, 0.01], [0.0, 0.0, 0.0]])


@pytest.fixture(scope="module")
def space():
    return make_space(block_mesh((SIZE, SIZE, HEIGHT), (3, 3, 2), origin=(-SIZE / 2, -SIZE / 2, 0.0)))


def _physics(**changes):
    return soft(0.49, 4000.0, supports=(Support(plane(2, 0.0)),), **changes)


def _model(space, **changes):
    still = np.array([False, False, False, True])
    return PhantomModel(space, _physics(**changes), markers=MARKERS, still=still, lesions=np.array([[0.0, 0.0, 0.02]]))


def _pose(k, z=HEIGHT):
    return Pose(k * 100_000_000, np.array([0.0, 0.0, z]), DOWN)


def test_carried_points_follow_a_rigid_motion(space):
    carried = EmbeddedPoints(space, np.concatenate([MARKERS, [[0.005, 0.003, 0.02]]]))
    R = Rotation.from_rotvec([0.3, 0.5, -0.2]).as_matrix()
    u = space.nodes @ R.T + [0.01, 0.0, 0.02] - space.nodes
    np.testing.assert_allclose(carried.positions(u), carried.points @ R.T + [0.01, 0.0, 0.02], atol=1e-12)


def test_a_ball_on_a_sheared_surface_turns_with_its_normal(space):
    carried = EmbeddedPoints(space, MARKERS[1:2])
    u = np.zeros(space.nodes.shape)
    u[:, 2] = 0.5 * space.nodes[:, 0]  # the top tilts by atan 0.5
    n = np.array([-0.5, 0.0, 1.0]) / np.sqrt(1.25)
    np.testing.assert_allclose(carried.positions(u)[0], [0, 0, HEIGHT] + 0.004 * n, atol=1e-12)


def test_rest_sags_and_support_markers_stay(space):
    model = _model(space)
    rest = model.rest()
    assert rest.converged
    assert np.all(rest.markers[:3, 2] < MARKERS[:3, 2]) and np.array_equal(rest.markers[3], MARKERS[3])
    assert rest.lesions[0, 2] < 0.02
    assert rest.surface.shape == (len(rest.surface_nodes), 3) and rest.triangles.max() < len(rest.surface)


def test_a_press_pushes_back_and_leaving_forgets(space):
    model = _model(space, probe=Probe(Box(0.02, 0.012, 0.02, 0.002)))
    rest = model.rest()
    pressed = [model.predict(_pose(k, HEIGHT - 0.0015 * k)) for k in range(3)]
    assert all(p.converged for p in pressed)
    assert pressed[-1].force[2] < -0.01 and pressed[-1].markers[1, 2] < rest.markers[1, 2] - 1e-3
    left = model.predict(_pose(4, HEIGHT + 0.02))
    np.testing.assert_allclose(left.markers, rest.markers, atol=1e-7)
    np.testing.assert_allclose(left.force, 0.0, atol=1e-12)


def test_a_failed_frame_does_not_poison_the_next(space, monkeypatch):
    physics = {"probe": Probe(Box(0.02, 0.012, 0.02, 0.002)), "prony": Prony((0.3,), (0.5,))}
    model, clean = _model(space, **physics), _model(space, **physics)
    for m in (model, clean):
        m.predict(_pose(0, HEIGHT))
        m.predict(_pose(1, HEIGHT - 0.002))
    monkeypatch.setattr(solver_module.Solver, "_newton", _fail)
    failed = model.predict(_pose(2, HEIGHT - 0.003))
    monkeypatch.undo()
    assert not failed.converged and "worst at" in failed.message and np.isnan(failed.markers).all()
    after, expected = model.predict(_pose(3, HEIGHT - 0.001)), clean.predict(_pose(3, HEIGHT - 0.001))
    assert after.converged
    np.testing.assert_allclose(after.markers, expected.markers, atol=2e-8)


def _fail(self, *arguments):
    raise solver_module.Lost("made to fail", 0)


def test_an_impossible_weight_is_a_convergence_error_with_a_remedy():
    body = Body.of(block_mesh((0.02, 0.02, 0.1), (1, 1, 3), origin=(0, 0, 0)), youngs_modulus=30.0).held(plane(2, 0.0))
    with pytest.raises(ConvergenceError, match="mm") as caught:
        body.solve()
    assert caught.value.remedy


def test_a_loaded_scan_is_its_own_equilibrium():
    space = make_space(hemi_ellipsoid_mesh((0.05, 0.05, 0.05), 4))
    model = PhantomModel(space, replace(_physics(), scan_fraction=1.0))
    rest = model.rest()
    size = 0.1
    assert np.abs(rest.surface - space.nodes[rest.surface_nodes]).max() < 1e-6 * size  # measured 5e-13 of the size
    assert 5e-4 < np.abs(model.mechanics.unloaded).max() < 5e-3


def test_the_unloaded_shape_loads_back_at_large_strain():
    """Forward from the unloaded mesh itself, with other items than the inverse problem's: the scan comes back."""
    mesh = hemi_ellipsoid_mesh((0.05, 0.05, 0.05), 4)
    space = make_space(mesh)
    soft_body = replace(_physics().with_material(youngs_modulus=900.0), scan_fraction=1.0)
    model = PhantomModel(space, soft_body)
    unloaded = replace(space, nodes=space.nodes)  # same connectivity
    w = model.mechanics.unloaded
    assert np.abs(w).max() > 0.005
    back = PhantomModel(unloaded, soft_body)
    back.mechanics.x[: w.size] = w.ravel()  # started from the unloaded shape
    np.testing.assert_allclose(back.rest().surface, space.nodes[back.surface[0]], atol=1e-7)


@pytest.mark.parametrize(
    ("support", "bound"),
    [  # measured, of the size: 6e-14, 5e-14, 4e-13; friction 3e-8
        (Support(plane(2, 0.0), "spring", stiffness=1e9), 1e-10),
        (Support(plane(2, 0.0), "spring", stiffness=3e5), 1e-10),
        (Support(plane(2, 0.0), "spring", stiffness=1e4), 1e-10),
        (Support(plane(2, 0.0), "friction", mu=0.5), 1e-6),
    ],
)
def test_a_loaded_scan_on_a_yielding_support_is_its_own_equilibrium(support, bound):
    """Tilted gravity, so that the base is pushed sideways: springs and friction act from the unloaded place on."""
    space, tilted = make_space(hemi_ellipsoid_mesh((0.05, 0.05, 0.05), 4)), np.array([1.0, 0.0, -9.7])
    physics = replace(soft(0.49, 4000.0, supports=(support,)), scan_fraction=1.0, scan_gravity=tilted, gravity=tilted)
    model = PhantomModel(space, physics)
    rest = model.rest()
    assert np.abs(rest.surface - space.nodes[rest.surface_nodes]).max() < bound * 0.1
    base = np.abs(model.mechanics.unloaded[space.nodes[:, 2] < 1e-9]).max()
    if support.stiffness == 1e9:  # ever stiffer springs are the fixed support
        fixed = PhantomModel(space, replace(physics, supports=(Support(plane(2, 0.0)),)))
        np.testing.assert_allclose(model.mechanics.unloaded, fixed.mechanics.unloaded, atol=2e-6)  # measured 7e-7 m
    else:
        assert base > 2e-5  # m; the base has moved while the weight came on


def test_a_scan_that_cannot_be_an_equilibrium_is_refused():
    space = make_space(block_mesh((0.02, 0.02, 0.1), (1, 1, 3), origin=(0, 0, 0)))
    with pytest.raises(ConvergenceError, match="scanned shape is no equilibrium"):
        PhantomModel(
            space,
            replace(
                _physics().with_material(youngs_modulus=40.0), scan_fraction=1.0, scan_gravity=np.array([9.81, 0, 0])
            ),
        )


def test_weight_acts_from_the_release_on(space):
    model = _model(space, release=0.25, loads=(DeadLoad("w", plane(2, HEIGHT), np.array([0.0, 0.0, -0.05])),))
    before, after = model.predict(None, 0), model.predict(None, 300_000_000)
    np.testing.assert_allclose(before.markers, MARKERS, atol=1e-9)
    np.testing.assert_allclose(after.markers, model.rest().markers, atol=1e-7)


@pytest.mark.parametrize("inertia", [None, Inertia(0.001)])
def test_until_the_release_a_body_is_held_as_it_was_scanned(space, inertia):
    """Scanned with a part of its weight on it, it stays there, and sinks by what is left of the weight."""
    model = _model(space, release=0.25, scan_fraction=0.3, inertia=inertia)
    before, rest = model.predict(None, 0), model.rest().markers
    np.testing.assert_allclose(before.markers, MARKERS, atol=1e-7)
    np.testing.assert_allclose(model.predict(None, 200_000_000).markers, MARKERS, atol=1e-7)  # measured 1e-8 m
    whole = _model(space, release=0.25).rest().markers
    np.testing.assert_allclose(rest - MARKERS, 0.7 * (whole - MARKERS), atol=2e-2 * np.abs(whole - MARKERS).max())


@pytest.mark.parametrize("fraction", [0.0, 0.3, 1.0])
@pytest.mark.parametrize(
    "changes", [{}, {"prony": Prony((0.3,), (0.5,)), "held_for": 1.0}, {"inertia": Inertia(0.001)}, {"release": 0.0}]
)
def test_the_loop_s_body_rests_where_its_recording_begins(space, fraction, changes):
    """Held or not, scanned hung sideways or not. A released one sprang back to its unloaded shape by 1.6 and 5.4 mm."""
    acting = {"loads": (DeadLoad("w", plane(2, HEIGHT), np.array([0.0, 0.0, -0.05])),), "release": 0.25, **changes}
    physics = _physics(scan_gravity=np.array([9.81, 0.0, 0.0]), scan_fraction=fraction, **acting)
    simulator = Simulator(block_mesh((SIZE, SIZE, HEIGHT), (3, 3, 2), origin=(-SIZE / 2, -SIZE / 2, 0.0)), "p2p0",
                          MARKERS, np.array([False, False, False, True]))  # fmt: skip
    first = simulator.simulate(physics, Recorded("a", [0], 0, ()), (), WALK).predictions[0].markers
    rest = simulator.rest(physics)
    np.testing.assert_allclose(rest, first, atol=1e-9)  # measured 1.2e-11 m


@pytest.mark.parametrize("loads", [(), (DeadLoad("w", plane(2, HEIGHT), np.array([0.0, 0.0, -0.05])),)])
@pytest.mark.parametrize("ms", [[0, 250, 300, 600], [0, 250], [0, 200, 300]])
def test_the_loop_s_body_falls_where_a_frame_is_taken_as_it_is_let_go(space, ms, loads):
    """Its rest of that stamp was given back for the loaded body, which never moved (0.0 mm of 22.5)."""
    physics, stamps = _physics(release=0.25, loads=loads), [round(1e6 * t) for t in ms]
    simulator = Simulator(space.mesh, "p2p0", MARKERS, np.array([False, False, False, True]))
    cold = _model(space, release=0.25, loads=loads).simulate(None, stamps, start_ns=0).predictions
    for _ in range(2):  # the second knows what the first has solved
        found = simulator.simulate(physics, Recorded("a", stamps, 0, ()), (), WALK).predictions
        for one, other in zip(found, cold, strict=True):
            np.testing.assert_allclose(one.markers, other.markers, atol=1e-8)
    assert np.abs(cold[-1].markers - MARKERS).max() > 1e-4


def test_a_released_body_with_inertia_overshoots(space):
    model = _model(space, release=0.0, inertia=Inertia(0.001))
    model.reset(start_ns=0)
    dropped = _model(space, release=0.01, inertia=Inertia(0.001))
    lowest = min(dropped.predict(None, int(k * 1e7)).markers[0, 2] for k in range(12))
    rest = model.rest().markers[0, 2]
    assert MARKERS[0, 2] - lowest > 1.5 * (MARKERS[0, 2] - rest)


@pytest.mark.parametrize(
    "memory",
    [
        {},
        {"prony": Prony((0.4,), (2.0,))},
        {"plastic_set": PlasticSet(0.2, 0.0)},
        {"inertia": Inertia(0.01)},
        {"loads": (DeadLoad("w", plane(2, HEIGHT), np.array([0.0, 0.0, -0.05])),), "prony": Prony((0.4,), (2.0,))},
    ],
    ids=["none", "relaxes", "sets", "rings", "loaded"],
)
def test_a_late_probe_stamp_takes_no_weight_off_a_body_that_always_bore_it(space, memory):
    """A pose that is stamped where the recording starts is of a moment before: weight and loads act there, too."""
    start, poses = 10**9, [replace(_pose(k, HEIGHT + 0.05), stamp_ns=10**9 + k * 50_000_000) for k in range(4)]
    model = _model(space, probe=Probe(Box(0.02, 0.012, 0.02, 0.002), time_offset=0.1), **memory)
    model.reset(start_ns=start)
    live = [model.predict(pose) for pose in poses]
    stamps = [pose.stamp_ns - 100_000_000 for pose in poses]
    rest = model.rest().markers
    assert live[0].stamp_ns < start and np.abs(rest - MARKERS).max() > 1e-4
    for prediction in [*live, *model.simulate(poses, stamps, start_ns=start).predictions]:
        np.testing.assert_allclose(prediction.markers, rest, atol=1e-7)


def test_simulate_repeats_predict(space):
    model = _model(space, probe=Probe(Box(0.02, 0.012, 0.02, 0.002)), prony=Prony((0.3,), (0.5,)))
    poses = [_pose(k, HEIGHT - 0.001 * k) for k in range(4)]
    one = [model.predict(p) for p in poses]
    again = model.simulate(poses, [p.stamp_ns for p in poses]).predictions
    for a, b in zip(one, again, strict=True):
        np.testing.assert_allclose(a.markers, b.markers, atol=2e-7)  # contact is solved to 1e-5 m of complementarity


def test_files_open_again_and_stress_balances_the_weight(space, tmp_path):
    solved = Body.of(space.mesh).held(plane(2, 0.0)).solve()
    write_step(tmp_path / "step.vtu", solved)
    read = meshio.read(tmp_path / "step.vtu")
    np.testing.assert_allclose(read.point_data["displacement"], solved.u)
    assert read.cells_dict["tetra10"].shape[1] == 10
    write_series(tmp_path / "series.xdmf", [(0.0, solved), (1.0, solved)])
    with meshio.xdmf.TimeSeriesReader(tmp_path / "series.xdmf") as reader:
        reader.read_points_cells()
        assert reader.num_steps == 2
    weight = 1000.0 * 9.81 * SIZE**2 * HEIGHT
    stress = solved.continuum.stress(solved.x)[1]
    # div sigma = -f: the volume integral of sigma_zz is minus the first moment of the weight about the base
    total = np.sum(space.weights * stress[..., 2, 2])
    assert total == pytest.approx(-weight * HEIGHT / 2, rel=0.1)  # of the deformed body, hence not exactly


def test_regions_without_surface_are_refused(space):
    with pytest.raises(InputError, match="enlarge the region"):
        _ = Body.of(space.mesh).held(plane(2, 0.5)).solve()
    with pytest.raises(InputError, match="load 'w'"):
        Body.of(space.mesh).held(plane(2, 0.0)).loaded(plane(2, 0.5), (0, 0, -1), "w").solve()
