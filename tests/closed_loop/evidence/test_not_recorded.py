"""What was not recorded is not compared: gaps in poses and wrenches, and what one recording alone can tell."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import toy
from toy_loop import PLACES, toy_inputs

from livedeform.closed_loop.candidates import catalogue
from livedeform.closed_loop.evidence import recordings
from livedeform.closed_loop.evidence.observation import Observation, observe
from livedeform.closed_loop.evidence.recordings import names_of, read_evidence, split
from livedeform.closed_loop.evidence.track import track
from livedeform.closed_loop.inputs import _that_cannot_act
from livedeform.closed_loop.loop import investigate
from livedeform.common.errors import InputError, RecordingError
from livedeform.common.types import MarkerFrame, Pose, Wrench

IDS = np.arange(len(PLACES)).astype(np.uint32)
STIFFNESS = 100.0  # N/m of the made-up force


def frames(poses: Sequence[Pose], seconds: float = 29.9) -> list[MarkerFrame]:
    """Markers of the toy body at 25 Hz, as they are, with the covariances of 0.1 mm."""
    stamps = (np.arange(0.05, seconds, 0.04) * 1e9).astype(np.int64)
    position, _ = toy.poses_at(poses, stamps)
    points = toy.ToyBody(PLACES).points([], 1e-9 * stamps, position)
    points = points + 1e-4 * np.random.default_rng(0).standard_normal(points.shape)
    covariances, unknown = np.broadcast_to(1e-8 * np.eye(3), (len(IDS), 3, 3)).copy(), np.full(len(IDS), np.nan)
    return [MarkerFrame(int(s), IDS, p, covariances, unknown) for s, p in zip(stamps, points, strict=True)]


def observed(poses: Sequence[Pose], wrenches: Sequence[Wrench] = ()) -> Observation:
    """Reduce a recording of the toy body whose probe moved as `toy.path`, however much of that was recorded."""
    settings = toy.SETTINGS
    return observe("a", track(frames(toy.path()), IDS), poses, wrenches, n_moments=48, start_ns=0, settings=settings)


def between(poses: Sequence[Pose], begin: float, end: float) -> list[Pose]:
    """Leave the poses ``begin`` to ``end`` s out."""
    return [p for p in poses if not begin < 1e-9 * p.stamp_ns < end]


@pytest.mark.parametrize(("begin", "end", "n"), [(1.9, 6.0, 0), (10.0, 10.9, 0), (10.0, 10.3, None)])
def test_where_poses_are_too_far_apart_nothing_is_compared(begin: float, end: float, n: int | None) -> None:
    """In the first of these gaps, a press, seven moments were predicted on a straight line, 0.77 for 0.17 mm off."""
    o = observed(between(toy.path(), begin, end))
    inside = (o.seconds > begin) & (o.seconds < end)
    assert inside.sum() == n or (n is None and inside.any())  # poses 0.3 s apart are interpolated
    run = toy.ToyModel(toy.ToyBody(PLACES)).run([], [o])[0]
    worst = np.nanmax(np.linalg.norm(o.points - run.points, axis=2))
    assert worst < 7e-4  # m, measured 0.00042: the noise's largest


def test_poses_that_are_always_too_far_apart_are_said() -> None:
    with pytest.raises(RecordingError, match=r"more than 0.5 s apart wherever.*record poses more often"):
        observed(toy.path()[::60])


def wrenches_of(poses: Sequence[Pose], until: float, pause: tuple[float, float] = (0.0, 0.0)) -> list[Wrench]:
    """A force as deep as the probe is, measured until so many s and not in the ``pause``."""
    rng = np.random.default_rng(1)
    kept = [p for p in poses if 1e-9 * p.stamp_ns < until and not pause[0] < 1e-9 * p.stamp_ns < pause[1]]
    deep = [np.array([0.0, 0.0, STIFFNESS * max(toy.HEIGHT - p.position[2], 0.0)]) for p in kept]
    forces = [f + 0.01 * rng.standard_normal(3) for f in deep]
    return [Wrench(p.stamp_ns, f, np.zeros(3)) for p, f in zip(kept, forces, strict=True)]


@pytest.mark.parametrize(("until", "pause"), [(4.2, (0.0, 0.0)), (30.0, (9.0, 12.0)), (30.0, (0.0, 8.0))])
def test_a_force_is_known_only_where_it_was_measured(until: float, pause: tuple[float, float]) -> None:
    """A sensor that stopped while the probe pressed held 0.59 N at the 42 moments that came after it."""
    path = toy.path()
    o = observed(path, wrenches_of(path, until, pause))
    assert o.forces is not None
    told = np.isfinite(o.forces).all(axis=1)
    near = 0.25  # s, half of the longest window over which frames are averaged
    inside, ended = (o.seconds > pause[0] + near) & (o.seconds < pause[1] - near), o.seconds > until + near
    measured = (o.seconds < until) & ~((o.seconds > pause[0]) & (o.seconds < pause[1]))
    assert told[measured & (o.seconds > 0.1)].all() and not told[inside | ended].any()
    assert measured.sum() >= 5 and (inside | ended).sum() >= 4
    deep = np.array([max(toy.HEIGHT - p.position[2], 0.0) for p in o.poses if p is not None])
    assert np.abs(o.forces[told, 2] - STIFFNESS * deep[told]).max() < 0.05  # N, measured 0.024


def test_a_force_that_was_measured_at_no_moment_is_none() -> None:
    path = toy.path()
    early = [replace(w, stamp_ns=w.stamp_ns - 40_000_000_000) for w in wrenches_of(path, 30.0)]
    assert observed(path, early).forces is None


def test_one_recording_alone_is_diagnosed() -> None:
    """Of four blocks one was held out, which has no scatter: whatever was found, nobody could tell."""
    effects = [toy.effect("strain_stiffening", b=1.5)]
    o = toy.record(effects, seed=3, body=toy.ToyBody(PLACES), name="only", n=36)
    fitted, held_out = split(o)
    assert len(np.unique(o.blocks)) == 4 and len(np.unique(held_out.blocks)) == 2
    inputs = toy_inputs(fitted, replace(held_out, before=fitted), ("stiffness", "skin", "strain_stiffening"))
    found = investigate(toy.ToyModel(toy.ToyBody(PLACES)), inputs)
    assert (found.verdict, [e.name for e in found.effects]) == ("effect", ["strain_stiffening"])
    assert float(found.effects[0].values["b"]) == pytest.approx(1.5, rel=0.1)  # measured 1.477


@pytest.mark.parametrize("presses", [5, 48])
def test_blocks_that_have_no_moment_have_no_number(presses: int) -> None:
    """More presses than key moments left numbers out, so that the last third of them could be one block."""
    t = np.arange(0.0, 60.0, 0.01)
    depth = np.where(t > 2.0, 0.008 * np.sin(2.0 * np.pi * (t - 2.0) * presses / 58.0), -0.004)
    down = np.array([1.0, 0.0, 0.0, 0.0])
    poses = [Pose(int(1e9 * s), np.array([0.0, 0.0, toy.HEIGHT - d]), down) for s, d in zip(t, depth, strict=True)]
    seen = track(frames(poses, 59.9), IDS)
    o = observe("a", seen, poses, n_moments=30, start_ns=0, settings=toy.SETTINGS)
    assert np.array_equal(np.unique(o.blocks), np.arange(o.blocks.max() + 1))
    fitted, held_out = split(o)
    assert len(np.unique(held_out.blocks)) >= 2 and len(np.unique(fitted.blocks)) >= 2


def test_recordings_of_one_name_have_what_is_declared_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """The second of two bags called alike was diagnosed with the gravity of all others; and cameras were registered to
    where markers rest without what acts in their recording, which the sag between the two made an effect of."""
    asked: list[str] = []
    acting = SimpleNamespace(timeline=SimpleNamespace(release=0.0), sigma=lambda _: None)
    experiment = SimpleNamespace(
        of_recording=lambda name: asked.append(name) or acting,
        markers=SimpleNamespace(ids=IDS),
        probe=None,
    )
    paths = [Path("day1/upside_down"), Path("day2/upside_down.mcap")]
    names = names_of(paths)
    assert names == ["upside_down", "upside_down-2"]
    seen = frames(toy.path(), seconds=3.0)
    recorded = {"uncorrected_marker_frames": seen, "warnings": [], "start_ns": 0, "wrenches": [], "poses": []}
    own = [SimpleNamespace(own_name="upside_down", **recorded) for _ in paths]
    views = {name: SimpleNamespace(rest=PLACES + 1e-3 * k) for k, name in enumerate(names)}
    registered: list[tuple[object, np.ndarray]] = []
    measured = recordings.marker_frames

    def noted(of: object, recording: object, rest: np.ndarray, *how: object) -> object:
        registered.append((of, rest))
        return measured(of, recording, rest, *how)  # type: ignore[arg-type]

    monkeypatch.setattr(recordings, "marker_frames", noted)
    read_evidence(experiment, dict(zip(names, own, strict=True)), 1, views, toy.SETTINGS, lambda *_: None)  # type: ignore[arg-type]
    assert asked == ["upside_down", "upside_down"]
    assert all(of is acting and rest is views[name].rest for name, (of, rest) in zip(names, registered, strict=True))


def test_candidates_that_cannot_act_are_said() -> None:
    """With cameras' effects alone and no camera, nothing was tried, and it was said that nothing is missing."""
    around = toy.surroundings(PLACES)
    asked = ["stiffness", "lens_distortion"]
    (note,) = _that_cannot_act(asked, catalogue(around, asked))
    assert "lens_distortion" in note and "stiffness" not in note
    with pytest.raises(InputError, match=r"--candidates.*lens_distortion"):
        _that_cannot_act(asked[1:], catalogue(around, asked[1:]))
    assert not _that_cannot_act([], catalogue(around))
