"""livedeform.recording.Writer: plain arrays come back from the bag as they were given, and mistakes are one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from livedeform.common.bags.recording import load_recording
from livedeform.common.errors import InputError
from livedeform.common.frames import transform
from livedeform.recording import Writer

POINTS = np.array([[0.01, 0.0, 0.05], [0.0, 0.02, 0.05], [np.nan, 0.0, 0.0]])
LARGEST = 2**32 - 1
MARCH = 1_772_361_000 * 10**9  # 2026-03-01 10:30 UTC


def test_what_is_written_is_read(tmp_path: Path) -> None:
    with Writer(tmp_path / "a.mcap", begins="2026-03-01 10:30") as recording:
        recording.points(0.25, [3, 1, 2], POINTS, sigma=0.0002)
        recording.points(0.5, [3, 1, 2], POINTS)
        recording.pose(0.25, [0.0, 0.0, 0.06])
        recording.force(0.25, [0.0, 0.0, -1.5])
        for side in ("left", "right"):
            recording.picture(side, 0.25, np.full((4, 6), 7, np.uint8))
    read = load_recording(tmp_path / "a.mcap")
    first, second = read.marker_frames
    assert first.stamp_ns == MARCH + 250_000_000
    assert first.ids.tolist() == [3, 1]  # the third was not seen
    np.testing.assert_allclose(first.points, POINTS[:2], atol=1e-8)  # float32
    np.testing.assert_allclose(first.covariances[0], 4e-8 * np.eye(3), rtol=1e-6)
    assert np.isnan(second.covariances).all()
    np.testing.assert_allclose(read.poses[0].orientation_xyzw, (1.0, 0.0, 0.0, 0.0))
    np.testing.assert_allclose(read.wrenches[0].force, (0.0, 0.0, -1.5))
    assert read.picture_stamps_ns == (MARCH + 250_000_000,)  # of the left one


def test_a_trackers_frame_is_taken_to_the_phantoms(tmp_path: Path) -> None:
    """A force's torque is about the phantom's origin: M' = R M + p x R F."""
    T = transform(Rotation.from_euler("z", 90, degrees=True).as_matrix(), np.array([0.1, 0.0, 0.0]))
    with Writer(tmp_path / "a.mcap", begins="2026-03-01", T_phantom_tracker=T) as recording:
        recording.points(1.0, [1], [[0.02, 0.0, 0.0]], covariances=np.diag([4e-8, 1e-8, 1e-8])[None])
        recording.pose(1.0, [0.02, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])
        recording.force(1.0, [1.0, 0.0, 0.0])
    read = load_recording(tmp_path / "a.mcap")
    np.testing.assert_allclose(read.marker_frames[0].points, [[0.1, 0.02, 0.0]], atol=1e-8)
    np.testing.assert_allclose(np.diag(read.marker_frames[0].covariances[0]), [1e-8, 4e-8, 1e-8], rtol=1e-5)
    np.testing.assert_allclose(read.poses[0].position, [0.1, 0.02, 0.0])
    np.testing.assert_allclose(read.wrenches[0].force, [0.0, 1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(read.wrenches[0].torque, [0.0, 0.0, 0.1], atol=1e-12)


def write(tmp_path: Path, what: str, *arguments: object, **options: object) -> None:
    with Writer(tmp_path / "a.mcap", begins="2026-03-01") as recording:
        getattr(recording, what)(*arguments, **options)


@pytest.mark.parametrize(
    ("what", "arguments", "options", "said"),
    [
        ("points", (0.0, [1], [[20.0, 0.0, 50.0]]), {}, "give metres"),
        ("points", (0.0, [1, 1], np.zeros((2, 3))), {}, "twice"),
        ("points", (0.0, [1.5], np.zeros((1, 3))), {}, "whole numbers"),
        ("points", (0.0, [1], [0.0, 0.0, 0.0]), {}, "not n x 3"),
        ("points", (0.0, [1], np.zeros((1, 3))), {"sigma": 0.0}, "sigma is not positive"),
        ("points", (0.0, [1], np.zeros((1, 3))), {"sigma": [float("inf")]}, "sigma is not positive"),
        ("points", (0.0, [1, 2], np.zeros((2, 3))), {"sigma": [1e-4] * 3}, r"2 points, and sigma is .* shape \(3,\)"),
        ("points", (0.0, [1, 2], np.zeros((2, 3))), {"sigma": np.ones((2, 3))}, r"shape \(2, 3\)"),
        ("points", (0.0, [1], np.zeros((1, 3))), {"sigma": "fine"}, "no array of numbers"),
        ("points", (0.0, [2**32], np.zeros((1, 3))), {}, "from 0 to 4294967295"),
        ("points", (0.0, [2**32 + 5, 5], np.zeros((2, 3))), {}, "from 0 to 4294967295"),
        ("points", (0.0, [2**70], np.zeros((1, 3))), {}, "from 0 to 4294967295"),
        ("points", (0.0, [-1], np.zeros((1, 3))), {}, "from 0 to 4294967295"),
        ("points", (0.0, ["A"], np.zeros((1, 3))), {}, "whole numbers"),
        ("points", (0.0, [[1], [1, 2]], np.zeros((2, 3))), {}, "whole numbers"),
        ("points", (0.0, [1], []), {}, "0 points need as many ids"),
        ("points", (0.0, [1, 2], [[0.0, 0.0, 0.0], [0.0, 0.0]]), {}, "rows are of different lengths"),
        ("points", (0.0, [1], [["a", "b", "c"]]), {}, "a text or nothing is among them"),
        ("points", (0.0, [1], None), {}, "not n x 3"),
        ("points", (0.0, [1], np.zeros((1, 3))), {"covariances": "none"}, "no array of numbers"),
        ("pose", (0.0, "here"), {}, "no array of numbers"),
        ("pose", ("0.1", [0.0, 0.0, 0.0]), {}, "the time is '0.1', no number; give seconds"),
        ("pose", (None, [0.0, 0.0, 0.0]), {}, "the time is None, no number"),
        ("pose", ([0.1], [0.0, 0.0, 0.0]), {}, r"the time is \[0.1\], no number"),
        ("camera", ("left", 0.0, 5), {}, "the calibration is a int"),
        ("pose", (0.0, [0.0, 0.0, 0.0], [1.0, 1.0, 0.0, 0.0]), {}, "norm"),
        ("pose", (float("nan"), [0.0, 0.0, 0.0]), {}, "give seconds"),
        ("force", (0.0, [0.0, 0.0, -1e5]), {}, "newtons"),
        ("picture", ("top", 0.0, np.zeros((2, 2), np.uint8)), {}, "'left' or 'right'"),
        ("picture", ("left", 0.0, np.zeros((2, 2))), {}, "uint8"),
    ],
)
def test_a_mistake_is_one_line(tmp_path: Path, what: str, arguments: tuple, options: dict, said: str) -> None:
    with pytest.raises(InputError, match=said):
        write(tmp_path, what, *arguments, **options)


def test_seconds_since_the_start_need_a_date(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="begins="), Writer(tmp_path / "a.mcap") as recording:
        recording.pose(0.5, [0.0, 0.0, 0.1])
    with pytest.raises(InputError, match="no date"):
        Writer(tmp_path / "b.mcap", begins="yesterday")
    with pytest.raises(InputError, match="T_phantom_tracker"):
        Writer(tmp_path / "b.mcap", T_phantom_tracker=1000 * np.eye(4))
    assert not (tmp_path / "b.mcap").exists()


@pytest.mark.parametrize(
    ("second", "begins"),
    [(1.7e12, None), (1.7e18, None), (1.77e9, "2026-03-01"), (1.7e12, "2026-03-01"), (-1.8e9, "2026-03-01")],
)
def test_a_time_that_no_stamp_holds_is_one_line(tmp_path: Path, second: float, begins: str | None) -> None:
    """Milliseconds and nanoseconds since 1970, and a date beside `begins`; what was written before stays."""
    good = 1.0 if begins else 1.7e9
    with Writer(tmp_path / "a.mcap", begins=begins) as recording:
        recording.points(good, [1], POINTS[:1])
        for write in (
            lambda: recording.points(second, [1], POINTS[:1]),
            lambda: recording.pose(second, [0.0, 0.0, 0.1]),
            lambda: recording.force(second, [0.0, 0.0, 0.1]),
            lambda: recording.picture("left", second, np.zeros((4, 6), np.uint8)),
        ):
            with pytest.raises(InputError, match=r"Writer\..*is no time of a stamp; give seconds \(not milli"):
                write()
    assert len(load_recording(tmp_path / "a.mcap").marker_frames) == 1


@pytest.mark.parametrize("begins", [1772447400.0, 5, True])
def test_a_beginning_that_is_no_date_is_one_line(tmp_path: Path, begins: object) -> None:
    with pytest.raises(InputError, match=f"begins: {begins} is no date; .*since 1970"):
        Writer(tmp_path / "a.mcap", begins=begins)  # type: ignore[arg-type]
    assert not (tmp_path / "a.mcap").exists()


def test_a_trackers_frame_in_millimetres_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"T_phantom_tracker: a coordinate of 250 m .*give metres"):
        Writer(tmp_path / "a.mcap", T_phantom_tracker=transform(np.eye(3), np.array([250.0, 0.0, 0.0])))


def test_nothing_is_written_after_the_end(tmp_path: Path) -> None:
    """It was accepted, and lost."""
    with Writer(tmp_path / "a.mcap", begins="2026-03-01") as recording:
        recording.pose(0.0, [0.0, 0.0, 0.1])
    recording.close()
    for write in (
        lambda: recording.points(1.0, [1], POINTS[:1]),
        lambda: recording.pose(1.0, [0.0, 0.0, 0.1]),
        lambda: recording.force(1.0, [0.0, 0.0, 0.1]),
        lambda: recording.picture("left", 1.0, np.zeros((4, 6), np.uint8)),
        lambda: recording.camera("left", 1.0, tmp_path / "left.yaml"),
    ):
        with pytest.raises(InputError, match=r"Writer\..*the recording is closed: .*; write before close"):
            write()
    assert len(load_recording(tmp_path / "a.mcap").poses) == 1


def test_a_moment_without_a_marker_is_a_frame(tmp_path: Path) -> None:
    nothing = [([], []), ([], np.zeros((0, 3))), (np.zeros(0, int), []), ([3], [[np.nan] * 3])]
    with Writer(tmp_path / "a.mcap", begins="2026-03-01") as recording:
        for second, (ids, points) in enumerate(nothing):
            recording.points(float(second), ids, points)
        recording.points(9.0, [], [], sigma=1e-4)
        recording.points(10.0, [LARGEST, 0], POINTS[:2], sigma=[1e-4, np.nan])
        recording.points(np.float32(11.0), [5, 6], [[0.0, 0.0, 0.0], [np.nan] * 3], sigma=[1e-4, np.nan])
    frames = load_recording(tmp_path / "a.mcap").marker_frames
    assert [frame.ids.tolist() for frame in frames] == [[]] * 5 + [[LARGEST, 0], [5]]
    assert np.isnan(frames[5].covariances[1]).all() and frames[6].covariances[0, 0, 0] == pytest.approx(1e-8)
