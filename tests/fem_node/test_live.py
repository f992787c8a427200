"""Live prediction: against the full model, its error estimate, its fallback and its cache."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from livedeform.common import frames
from livedeform.fem_node.contact.probe_shapes import Cylinder, make_shape
from livedeform.fem_node.effects.swelling import Growth
from livedeform.fem_node.element.element import make_space
from livedeform.fem_node.live.library import Library, read_library, write_library
from livedeform.fem_node.live.live_model import LivePredictor, LiveSettings, why_not_live
from livedeform.fem_node.mesh.generate import block_mesh
from livedeform.fem_node.model import PhantomModel
from livedeform.fem_node.physics.fields import Ball, Drift, HeightGradient, Skin, Uniform
from livedeform.fem_node.physics.record import MaterialSpec, Physics, Probe, Prony, Support

SPACE = make_space(block_mesh([0.05, 0.05, 0.03], [6, 6, 3]), "p2p0")
DOWN = Rotation.from_euler("x", 180, degrees=True).as_matrix()
MARKERS = np.array([[0.0, 0.0, 0.02], [0.015, 0.01, 0.03], [-0.02, 0.0, 0.03]])


def phantom(*, changes=None, **law) -> PhantomModel:
    physics = Physics(
        MaterialSpec("neo_hookean", 4000.0, 0.49),
        supports=(Support(lambda p: p[:, 2] < 1e-6),),
        probe=Probe(Cylinder(0.01, 0.03, 0.004), **law),
    )
    return PhantomModel(SPACE, replace(physics, **(changes or {})), markers=MARKERS)


def pose(depth, x=0.0, tilt_deg=0.0):
    turn = Rotation.from_euler("y", tilt_deg, degrees=True).as_matrix() @ DOWN
    return frames.matrix_pose(frames.transform(turn, np.array([x, 0.0, 0.0295 - depth])))


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    cache = tmp_path_factory.mktemp("live")
    live = LivePredictor(phantom(), settings=LiveSettings(spacing=5e-4))
    live.train([pose(d) for d in np.arange(-0.0005, 0.0021, 1e-4)], cache)
    return live, cache


def test_live_agrees_with_the_full_model_within_its_estimate(library):
    live, _ = library
    full = phantom()
    before = live.counts.live
    for depth, x, tilt in ((0.0002, 0.0, 0.0), (0.0007, 5e-5, 0.2), (0.0013, -1e-4, 0.0), (0.0018, 0.0, -0.2)):
        there, here = full.predict(pose(depth, x, tilt)), live.predict(pose(depth, x, tilt))
        error = np.linalg.norm(there.surface - here.surface, axis=1)
        assert 0.0 <= here.error_bound <= live.settings.tolerance
        assert np.percentile(error, 99) <= here.error_bound + 1e-5  # contact's own tolerance
        assert np.abs(there.markers - here.markers).max() < 1e-4
        assert np.allclose(there.force, here.force, rtol=0.03, atol=2e-3)
    assert live.counts.live == before + 4


def test_far_from_the_library_the_full_model_answers_and_is_remembered(library):
    live, _ = library
    n, full = len(live.library), live.counts.full
    answer = live.predict(pose(0.003, 0.004))
    assert answer.converged and answer.error_bound == 0.0
    assert live.counts.full == full + 1 and len(live.library) == n + 1
    again = live.predict(pose(0.003, 0.00402))
    assert live.counts.full == full + 1 and np.abs(again.surface - answer.surface).max() < 1e-4


def test_a_probe_that_moves_on_takes_few_contact_evaluations(library, monkeypatch):
    """A retreat by 0.3 mm leaves the last forces outside of the contact: Newton's method threw them away, then needed
    many halved steps to find them again (20 evaluations; 9 at most are measured)."""
    live, _ = library
    evaluations, local = [], live._contact.local
    monkeypatch.setattr(live._contact, "local", lambda *a, **k: evaluations.append(1) or local(*a, **k))
    up = [pose(0.0016 - 0.0003 * k) for k in range(4)]
    aside = [pose(0.0016, 1e-4 * k, 0.3 * k) for k in range(4)]
    before = live.counts.full
    for p in (*up, *up[::-1], *aside):
        evaluations.clear()
        live.predict(p)
        assert len(evaluations) <= 12
    assert live.counts.full == before


def test_away_from_the_body_it_is_at_rest(library):
    live, _ = library
    answer = live.predict(pose(-0.0005))
    assert np.all(answer.force == 0.0) and np.abs(answer.surface - live.model.rest().surface).max() < 1e-8


def test_a_library_is_found_again(library):
    live, cache = library
    told = []
    other = LivePredictor(phantom(), settings=LiveSettings(spacing=5e-4), progress=told.append)
    other.train([pose(d) for d in np.arange(-0.0005, 0.0021, 1e-4)], cache)
    assert any("solutions from" in text for text in told)
    assert np.allclose(other.predict(pose(0.0012)).surface, live.predict(pose(0.0012)).surface, atol=2e-6)


def ball(radius):
    solid = trimesh.creation.icosphere(subdivisions=2, radius=radius)
    return make_shape("mesh", (solid.vertices - [0.0, 0.0, radius], solid.faces))


def test_a_library_is_found_again_for_the_same_probe_only(tmp_path):
    """Also where probes differ in the numbers of their arrays alone: a mesh's, and the tool offset's."""
    shape, offset = ball(0.012), np.array([0.0, 0.0, 1e-4])
    told = {}
    for name, probe in {
        "first": Probe(shape),
        "again": Probe(ball(0.012)),
        "larger": Probe(ball(0.025)),
        "other corners": Probe(replace(shape, vertices=shape.vertices * [1.0, 1.0 + 1e-6, 1.0])),
        "other triangles": Probe(replace(shape, triangles=shape.triangles[::-1])),
        "displaced": Probe(shape, offset=offset),
        "displaced again": Probe(shape, offset=offset.copy()),
    }.items():
        said = told[name] = []
        live = LivePredictor(phantom(changes={"probe": probe}), progress=said.append)
        live.train([pose(-0.003)], tmp_path)
    assert {name for name, said in told.items() if any("solutions from" in text for text in said)} == {
        "again", "displaced again"
    }  # fmt: skip


@pytest.mark.parametrize("offset", [[0.0, 0.0, 5e-4], pytest.param([2e-3, 0.0, 1e-3], marks=pytest.mark.slow)])
def test_a_probe_that_is_displaced_is_learnt_where_it_is(offset):
    """Where the tool offset puts the probe where it was without, everything is as it was, to the contact's tolerance;
    with entries at the recorded poses c was 2097 and 11 704 1/m, and the full model answered every pose."""
    offset = np.array(offset)
    poses = [pose(d) for d in np.arange(0.0, 0.0016, 2e-4)]
    back = [replace(p, position=p.position - frames.pose_matrix(p)[:3, :3] @ offset) for p in poses]
    usual = LivePredictor(phantom(), settings=LiveSettings(spacing=5e-4))
    moved = LivePredictor(phantom(offset=offset), settings=LiveSettings(spacing=5e-4))
    usual.train(poses)
    moved.train(back)
    for one, other in zip(usual.library, moved.library, strict=True):
        np.testing.assert_allclose(one.T, other.T, atol=1e-12)
        np.testing.assert_allclose(one.body.x, other.body.x, atol=2e-6)
    assert moved.coefficient == pytest.approx(usual.coefficient, rel=0.1)
    for p in back:
        moved.predict(p)
    assert moved.counts.full == 0


def test_a_damaged_library_is_not_read(library, tmp_path):
    """A bit is flipped or the file is cut at many places: it is refused, or what is read is what was written."""
    live, cache = library
    whole = next(cache.glob("live-*.npz")).read_bytes()
    rng, refused, file = np.random.default_rng(0), 0, tmp_path / "live-x.npz"
    for k in range(40):
        data, at = bytearray(whole), int(rng.integers(len(whole)))
        data[at] ^= 1 << int(rng.integers(8))
        file.write_bytes(bytes(data) if k % 2 else whole[:at])
        told = []
        found = read_library(file, live._rows, told.append)
        refused += found is None
        assert (found is None) == bool(told)
        for entry, other in zip(live.library, [] if found is None else found.entries, strict=False):
            for one, two in zip(vars(entry.body).values(), vars(other.body).values(), strict=True):
                np.testing.assert_array_equal(one, two)
    assert refused >= 38  # a bit of the zip file's own dates means nothing


def test_a_library_that_cannot_be_written_is_not_half_there(library, tmp_path, monkeypatch):
    live, _ = library
    monkeypatch.setattr("os.replace", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    assert not write_library(tmp_path / "live-x.npz", live._rows, Library(live.library, 1.0, 0.0))
    assert not list(tmp_path.iterdir())


def test_where_nothing_can_be_kept_the_model_is_ready_all_the_same(tmp_path):
    """A file stands where the folder should be, as on a home that cannot be written."""
    (tmp_path / "kept").write_text("")
    told = []
    live = LivePredictor(phantom(), settings=LiveSettings(spacing=1e-3), progress=told.append)
    live.train([pose(0.0005)], tmp_path / "kept" / "live")
    assert len(live.library) == 1 and any("cannot be written" in text for text in told)


def test_bodies_with_a_memory_are_left_to_the_full_model():
    live = LivePredictor(phantom(friction=0.3))
    assert live.why_not == "friction"
    live.train([pose(0.001)])
    assert live.predict(pose(-0.0005)).error_bound == 0.0 and live.counts.full == 1
    assert why_not_live(Physics()) == "having no probe"
    assert why_not_live(Physics(probe=Probe(Cylinder(0.01, 0.03)), prony=Prony((0.3,), (2.0,)))) == "relaxation"


FITTED = {
    "modulus_fields": (
        Uniform(1.2), Ball((0.0, 0.0, 0.015), 0.008, 4.0), HeightGradient(6.0), Skin(0.004, 1.5), Drift(0.0)
    ),
    "volume_ratios": (Growth(0.0, 0.01),),
}  # fmt: skip


def test_a_fitted_model_runs_live():
    """What a diagnosis adds to the body and keeps still (stiffness, inclusion, gradient, skin, an offset of swelling):
    live answers, within their bound of the full model's."""
    model, full = (phantom(changes=FITTED) for _ in range(2))
    live = LivePredictor(model, settings=LiveSettings(spacing=5e-4))
    assert live.why_not == ""
    live.train([pose(d) for d in np.arange(0.0, 0.0016, 2e-4)])
    for depth, x in ((0.0004, 0.0), (0.0009, 5e-5), (0.0013, -5e-5)):
        there, here = full.predict(pose(depth, x)), live.predict(pose(depth, x))
        assert 0.0 < here.error_bound <= live.settings.tolerance + 2e-5
        assert np.percentile(np.linalg.norm(there.surface - here.surface, axis=1), 99) <= here.error_bound + 1e-5
    assert live.counts.full == 0 and live.counts.live == 3
    declared = phantom().predict(pose(0.0013, -5e-5))
    assert np.abs(declared.surface - there.surface).max() > 1e-4  # it is another body


def test_what_cannot_be_live_is_said_and_left_to_the_full_model():
    told = []
    live = LivePredictor(phantom(changes={"modulus_fields": (Uniform(1.2), Drift(0.01))}), progress=told.append)
    assert live.why_not == "a modulus that changes with time" and live.why_not in told[0]
    early, late = (live.predict(pose(-0.0005), stamp_ns) for stamp_ns in (0, 60_000_000_000))
    assert late.surface[:, 2].max() < early.surface[:, 2].max() and live.counts.full == 2


def test_a_late_probe_is_the_same_live_and_full():
    """Without a moment of its own a pose stands for when the probe was there, not for when its stamp says."""
    live, full = LivePredictor(phantom(time_offset=0.05)), phantom(time_offset=0.05)
    late = replace(pose(-0.0005), stamp_ns=1_000_000_000)
    live.predict(late)
    assert live.predict(late).stamp_ns == full.predict(late).stamp_ns == 950_000_000 and live.counts.live == 1
