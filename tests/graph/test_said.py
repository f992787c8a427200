"""What the stereo node says of its own measurement, as the run's verdict takes it."""

from __future__ import annotations

from pathlib import Path

import pytest

from livedeform.common import topics as t
from livedeform.common.bags.write import BagWriter
from livedeform.common.ros import messages as m
from livedeform.run.said import stereo_said

EPIPOLAR = "{n} of 24 markers; the epipolar error of 0.{n} px asks for a new calibration"
FEW = "{n} of 24 markers"


def said_of(path: Path, statuses: list[tuple[str, str]]) -> list[str]:
    """The doubts that so many statuses (level, text with its number) make."""
    with BagWriter(path) as bag:
        for k, (level, text) in enumerate(statuses):
            values = {"n_identified": k, "n_markers": 24}
            message = m.to_diagnostics(k, "stereo_node", level, text.format(n=k), values)
            bag.write(t.STEREO_STATUS, t.DIAGNOSTICS, k, bytes(m.serialize_message(message)))
    return [finding.text for finding in stereo_said(path).findings if finding.doubts]


@pytest.mark.parametrize(("n", "text", "doubted"), [
    (0, EPIPOLAR, False),
    (4, EPIPOLAR, False),  # 10 % of the frames: the errors have their say
    (6, EPIPOLAR, True),  # a camera that was pushed late in a session
    (40, EPIPOLAR, True),
    (6, FEW, False),  # the probe hides markers in every press
    (19, FEW, False),
    (21, FEW, True),
])  # fmt: skip
def test_what_holds_for_many_frames_is_a_doubt(n: int, text: str, doubted: bool, tmp_path: Path):
    """Numbers differ from frame to frame: what is said is one thing all the same, with the last numbers."""
    statuses = [("OK", FEW)] * (40 - n) + [("WARN", text)] * n
    found = said_of(tmp_path / "run.mcap", statuses)
    assert found == ([f"stereo_node says of {n} of 40 frames: {text.format(n=39)}"] if doubted else [])


def test_two_things_are_two(tmp_path: Path):
    statuses = [("WARN", EPIPOLAR), ("ERROR", "the left picture is black")] * 10
    assert len(said_of(tmp_path / "run.mcap", statuses)) == 2


@pytest.mark.parametrize(("n", "doubted"), [((3, 2), True), ((2, 2), False), ((2, 2, 2), True), ((4,), False)])
def test_errors_of_several_kinds_count_together(n: tuple[int, ...], doubted: bool, tmp_path: Path):
    """A frame is wrong whatever is wrong with it: several kinds of less than a tenth each may be a third together."""
    texts = ("the left picture is black", "no marker was identified", EPIPOLAR)
    statuses = [("ERROR", text) for times, text in zip(n, texts, strict=False) for _ in range(times)]
    hidden = [("WARN", FEW)] * 10  # which does not count with them
    found = said_of(tmp_path / "run.mcap", [*statuses, *hidden, *[("OK", FEW)] * (40 - len(statuses) - len(hidden))])
    assert found == (
        [f"stereo_node says of {sum(n)} of 40 frames: {len(n)} kinds of faults, most often ({n[0]}): {texts[0]}"]
        if doubted
        else []
    )


def test_without_pictures_nothing_is_said(tmp_path: Path):
    assert said_of(tmp_path / "run.mcap", []) == []
