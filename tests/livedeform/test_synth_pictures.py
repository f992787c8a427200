"""What measuring effects do to a synthetic experiment's pictures: each shows in them, or is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from benchmarks.blind import cases

from livedeform.common.bags.recording import load_recording
from livedeform.common.errors import InputError
from livedeform.common.types import Array
from livedeform.synthetic import scenario
from livedeform.synthetic.body_markers import aimed_rig, place_markers
from livedeform.synthetic.measuring.measure import Seen, Tracker
from livedeform.synthetic.record import ScenePainter
from livedeform.synthetic.repaint import repaint
from livedeform.synthetic.solved_motion import build_world
from livedeform.synthetic.true_effects import EFFECTS

ONSET, STEP = 1.0, 0.010  # s, m
SPEC = {
    "version": 1,
    "name": "seen",
    "body": {"shape": "block", "size": [0.06, 0.05, 0.04], "elements": [3, 2, 2]},
    "declared": {"ship_mesh": False, "element_size": 0.015},
    "markers": {"surface": 10, "internal": 2, "support": 3},
    "measuring": {"kind": "pictures", "rate": 1.0},
    "rig": {"size": [320, 240], "f": 500.0},
    "path_step": 0.002,
    "temperature": cases.WARMING,
    "recordings": {"a": [{"at": [0.0, 0.0], "depth": 0.002, "hold": 0.2}]},
}
STEPS = {"name": "camera_motion", "translation": [STEP, 0.0, 0.0], "rotation": [0.0, 0.0, 0.0], "onset": ONSET}
FAR = np.diag([1.0, -1.0, -1.0, 1.0]) + np.array([[0.0] * 4, [0.0] * 4, [0.0, 0.0, 0.0, 0.5], [0.0] * 4])


def painted(effects: list[dict], clock: float, **changes: object) -> list[Array]:
    """Return both pictures of the body as it is meshed, under a probe that is far above."""
    spec = scenario.load({**SPEC, "truth": effects, **changes})
    world, shape = build_world(spec)
    rest = world.mesh.nodes
    rig = aimed_rig(spec, rest)
    markers = place_markers(spec, world.mesh, rest, rig)
    seen = Seen(np.arange(len(markers.kinds)).astype(np.uint32), markers.kinds)
    tracker = Tracker(rig, world.measuring, seen, shape, np.random.default_rng(0))
    painter = ScenePainter(spec, world.mesh, rest, markers, tracker)
    return [pixels.astype(float) for _, pixels in painter.pictures(rest, FAR, clock, 3)]


def measuring_effects() -> list[str]:
    """Return the effects that change what is measured, and not the body or the probe."""
    kinds = {"measuring": {"kind": "markers"}}
    plain = build_world(scenario.load({**SPEC, **kinds}))[0].measuring
    return [
        name
        for name in EFFECTS
        if build_world(scenario.load({**SPEC, **kinds, "truth": [cases.sized(name, 1.0)]}))[0].measuring != plain
    ]


def test_every_measuring_effect_shows_in_pictures_or_is_refused() -> None:
    names = measuring_effects()
    assert {"camera_motion", "stereo_scale", "lens_distortion", "refraction"} <= set(names)
    plain, refused = painted([], 99.0), []
    for name in names:
        try:
            seen = painted([cases.sized(name, 10.0)], 99.0)
        except InputError as error:
            assert name in str(error)
            refused.append(name)
            continue
        # grey values; measured 82 to 114, and the noise has the same seed
        assert max(np.abs(a - b).max() for a, b in zip(seen, plain, strict=True)) > 30.0, name
    assert refused == ["refraction"]


def test_refraction_without_internal_markers_is_refused() -> None:
    markers = {"surface": 10, "internal": 0, "support": 3}
    with pytest.raises(InputError, match=r"refraction acts on internal markers"):
        painted([{"name": "refraction", "index": 1.3}], 0.0, measuring={"kind": "markers"}, markers=markers)


def test_cameras_that_move_aside_see_the_body_go_the_other_way_from_the_onset_on() -> None:
    plain, before, after = painted([], 0.0), painted([STEPS], ONSET - 1e-6), painted([STEPS], ONSET)
    for one, other in zip(plain, before, strict=True):
        np.testing.assert_array_equal(one, other)
    spec = scenario.load(SPEC)
    rest = build_world(spec)[0].mesh.nodes
    rig = aimed_rig(spec, rest)
    in_left = (rest - rig.T_phantom_left[:3, 3]) @ rig.T_phantom_left[:3, :3]
    for k, T in enumerate((np.eye(4), rig.T_right_left)):
        away = [x @ T[:3, :3].T + T[:3, 3] for x in (in_left, in_left - [STEP, 0.0, 0.0])]
        expected = np.subtract(*((500.0 * x[:, :2] / x[:, 2:]).mean(axis=0) for x in away[::-1]))
        moved = np.subtract(*(np.argwhere(p[k] > 30.0).mean(axis=0)[::-1] for p in (after, plain)))
        assert np.linalg.norm(expected) > 10.0
        assert np.abs(moved - expected).max() < 0.5  # measured at most 0.10 px


def test_what_is_recorded_and_painted_again_has_moved_too(tmp_path: Path) -> None:
    """After the onset the recorded pictures differ from those of still cameras, and new ones show the same."""
    for name, truth in (("still", []), ("moved", [STEPS])):
        scenario.make({**SPEC, "temperature": None, "truth": truth}, tmp_path / name, seed=1)
    repaint(tmp_path / "moved", tmp_path / "again", seed=2)
    still, moved, again = (load_recording(tmp_path / name / "bags" / "a") for name in ("still", "moved", "again"))
    start = np.load(tmp_path / "moved" / "truth" / "a.npz")["stamps_ns"][0]
    acted = []
    all_of = [[*r.left, *r.right] for r in (still, moved, again)]
    for a, b, c in zip(*all_of, strict=True):
        pictures = [np.asarray(p.pixels, float) for p in (a, b, c)]
        acted.append((a.stamp_ns - start) * 1e-9 >= ONSET - 2e-3)
        assert (np.abs(pictures[1] - pictures[0]).max() > 50.0) == acted[-1]  # measured 152 to 160, and 0 before
        assert np.abs(pictures[2] - pictures[1]).max() < 9.0  # nothing but the noise is another
    assert {True, False} == set(acted)
