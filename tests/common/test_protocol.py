"""The protocol for a press: every step is judged on made recordings, and the page lists the same steps in order."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from livedeform.common.bags.recording import Recording
from livedeform.common.checks.protocol import STEPS, MarkerTrack, protocol
from livedeform.common.types import MarkerFrame

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "real-press.md"
GOOD = [
    (3.0, 3.0, 6.0, 0, 3e-3),
    (18.0, 3.0, 1.0, 0, 6e-3),
    (28.0, 0.6, 1.0, 1, 4e-3),
    (33.0, 3.0, 1.0, 1, 6e-3),
    (43.0, 3.0, 6.0, 0, 3e-3),
]


def recorded(presses, n=24, rate=20.0, noise=3e-5, lasts=58.0) -> Recording:
    """Presses (begins s, rise s, hold s, place, depth m) of a body whose markers follow near the place."""
    rng = np.random.default_rng(0)
    rest = rng.uniform(-0.04, 0.04, (n, 3))
    centres = np.array([[-0.02, 0, 0.04], [0.03, 0.01, 0.04]])
    t = np.arange(0, lasts, 1 / rate)
    points = np.tile(rest, (len(t), 1, 1))
    for begins, rise, hold, place, depth in presses:
        share = np.clip((t - begins) / rise, 0, 1) * np.clip((begins + 2 * rise + hold - t) / rise, 0, 1)
        reach = np.exp(-((np.linalg.norm(rest - centres[place], axis=1) / 0.03) ** 2))
        points[:, :, 2] -= depth * share[:, None] * reach
    points += rng.normal(0, noise, points.shape)
    ids, nothing = np.arange(1, n + 1, dtype=np.uint32), np.full(n, np.nan)
    unknown = np.full((n, 3, 3), np.nan)
    frames = [MarkerFrame(round(s * 1e9), ids, p, unknown, nothing) for s, p in zip(t, points, strict=True)]
    return Recording(Path("x"), 0, round(lasts * 1e9), frames, [], [], {}, {})


def kept(recording: Recording) -> dict[str, bool | None]:
    return {step.name: step.kept for step in protocol(recording)}


def test_a_recording_by_the_protocol_keeps_every_step() -> None:
    assert all(kept(recorded(GOOD)).values()), protocol(recorded(GOOD))
    presses = MarkerTrack(recorded(GOOD)).presses
    assert [p.begins for p in presses] == pytest.approx([3.0, 18.0, 28.0, 33.0, 43.0], abs=0.6)
    assert presses[0].hold == pytest.approx(6.0, abs=0.8)


@pytest.mark.parametrize(
    ("changes", "broken"),
    [
        ({"n": 10}, {"markers"}),
        ({"rate": 5.0}, {"rate"}),
        ({"noise": 2.2e-4}, {"noise", "deep enough"}),
        ({"presses": [(1.0, *GOOD[0][1:]), *GOOD[1:]]}, {"still time before"}),
        ({"presses": GOOD[:2] + GOOD[3:4]}, {"presses", "speeds", "repeats"}),
        ({"presses": [(*p[:3], 0, p[4]) for p in GOOD]}, {"places"}),
        ({"presses": [(*p[:4], 5e-3) for p in GOOD]}, {"depths"}),
        ({"presses": [(*p[:2], 1.0, *p[3:]) for p in GOOD]}, {"hold"}),
        ({"presses": [*GOOD[:2], (27.0, 1.5, 1.0, 1, 4e-3), *GOOD[3:]]}, {"speeds"}),
        ({"presses": [*GOOD[:4], (43.0, 3.0, 6.0, 0, 4.5e-3)]}, {"repeats"}),
        ({"presses": [*GOOD[:3], (31.0, 3.0, 1.0, 1, 6e-3), GOOD[4]]}, {"still time between"}),
        ({"lasts": 56.0}, {"still time after"}),
    ],
    ids=lambda x: "+".join(sorted(x)) if isinstance(x, set) else "",
)  # fmt: skip
def test_a_step_that_was_not_kept_is_named(changes, broken) -> None:
    options = {"presses": GOOD, **changes}
    found = {name for name, k in kept(recorded(options.pop("presses"), **options)).items() if not k}
    assert broken <= found <= broken | {"depths", "deep enough", "hold", "places"}, found


def test_markers_that_are_hidden_are_not_seen() -> None:
    recording = recorded(GOOD)
    for frame in recording.marker_frames[: len(recording.marker_frames) // 2]:
        object.__setattr__(frame, "ids", frame.ids[1:])
        object.__setattr__(frame, "points", frame.points[1:])
    assert [name for name, k in kept(recording).items() if not k] == ["seen"]


def test_frames_that_show_only_what_was_hidden_at_first_tell_nothing() -> None:
    """In a press, or while the body rests: where that marker rests is not known."""
    recording = recorded(GOOD)
    for k, frame in enumerate(recording.marker_frames):
        rows = slice(0, 1) if k % 40 == 20 else slice(1 if k < 40 else 0, None)
        for name in ("ids", "points"):
            object.__setattr__(frame, name, getattr(frame, name)[rows])
    track = MarkerTrack(recording)
    assert np.isnan(track.rest[0]).all() and np.isnan(track.moved[20::40]).all()
    assert [p.begins for p in track.presses] == pytest.approx([3.0, 18.0, 28.0, 33.0, 43.0], abs=0.6)
    assert all(np.isfinite([p.size, p.rise, p.hold]).all() for p in track.presses)


def test_without_markers_every_step_is_unknown() -> None:
    assert set(kept(Recording(Path("x"), 0, 10**9, [], [], [], {}, {})).values()) == {None}


def test_the_page_lists_the_same_steps_in_the_same_order() -> None:
    rows = re.findall(r"^\| ([^|]+) \| [^|]+ \| ([^|]+) \|$", PAGE.read_text().split("## Record\n")[1], re.M)
    listed = [(a.strip(), b.strip()) for a, b in rows if a.strip() != "step" and not a.startswith("-")]
    assert listed == [(name, asks) for name, asks, _ in STEPS]
