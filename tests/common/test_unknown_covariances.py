"""A covariance of zero says that it is unknown, as is usual in ROS: it is counted and said, and never taken for
certain."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from livedeform.common.bags import layouts
from livedeform.common.bags.recording import load_recording
from livedeform.common.bags.recording_writer import RecordingWriter
from livedeform.common.bags.write import BagWriter
from livedeform.common.checks.recorded import check_faults
from livedeform.common.errors import InputError
from livedeform.common.types import MarkerFrame
from livedeform.recording import Writer

SOUND = np.diag([1e-10, 2e-10, 9e-10])
ALONG = np.array([1.0, 2.0, 2.0]) / 3.0
CASES = {  # a covariance in m2, and whether it says nothing
    "sound": (SOUND, False),
    "zero": (np.zeros((3, 3)), True),
    "negative": (-SOUND, True),
    "indefinite": (np.diag([1e-10, -1e-10, 9e-10]), True),
    "exact in one direction": (np.diag([0.0, 2e-10, 9e-10]), False),
    "along one direction": (1e-10 * np.outer(ALONG, ALONG), False),
    "tiny": (1e-12 * SOUND, False),
    "unknown": (np.full((3, 3), np.nan), False),
}


@pytest.mark.parametrize("name", CASES)
def test_which_covariances_say_nothing(name):
    covariance, wrong = CASES[name]
    assert layouts.wrong_covariances(np.stack([SOUND, covariance])).tolist() == [False, wrong]


@pytest.mark.parametrize("which", ["all", "one marker", "one frame", "one marker of one frame"])
def test_a_covariance_of_zero_is_read_as_unknown_and_said(tmp_path: Path, which: str) -> None:
    zero = np.zeros((6, 4), bool)
    zero[{"all": np.s_[:], "one marker": np.s_[:, 2], "one frame": np.s_[3]}.get(which, np.s_[3, 2])] = True
    covariances = np.where(zero[..., None, None], 0.0, SOUND)
    with BagWriter(tmp_path / "a.mcap") as bag:
        for k, stated in enumerate(covariances):
            frame = MarkerFrame(10 + k, np.arange(4, dtype=np.uint32), np.zeros((4, 3)), stated, np.full(4, np.nan))
            RecordingWriter(bag).marker_frame(frame)
    recording = load_recording(tmp_path / "a.mcap")
    read = np.stack([f.covariances for f in recording.marker_frames])
    np.testing.assert_array_equal(np.isnan(read).all(axis=(2, 3)), zero)
    assert recording.faults["covariance"] == zero.sum()
    assert any("zero" in line and "taken as unknown" in line for line in recording.warnings)
    (finding,) = check_faults(recording, None, None)  # type: ignore[arg-type]
    assert finding.level == "WARN" and "zero" in finding.text and "taken as unknown" in finding.text


@pytest.mark.parametrize("name", CASES)
def test_a_writer_refuses_what_says_nothing(tmp_path: Path, name: str) -> None:
    """It refused a sigma of zero, and wrote a covariance of zero."""
    covariance, wrong = CASES[name]
    places = [[0.0, 0.0, 0.05], [np.nan] * 3, [0.0, 0.02, 0.05]]
    covariances = np.stack([SOUND, np.zeros((3, 3)), covariance])  # the second is not seen
    with Writer(tmp_path / "a.mcap", begins="2026-03-01") as recording:
        if not wrong:
            recording.points(1.0, [1, 2, 3], places, covariances=covariances)
            return
        with pytest.raises(InputError, match="covariance"):
            recording.points(1.0, [1, 2, 3], places, covariances=covariances)
