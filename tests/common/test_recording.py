"""Recordings without ROS: what is written comes back, odd messages are left out with a warning."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from livedeform.common import topics as t
from livedeform.common.bags import layouts
from livedeform.common.bags.recording import header_stamp_ns, load_recording, own_name, read_images
from livedeform.common.bags.recording_writer import RecordingWriter
from livedeform.common.bags.write import BagWriter
from livedeform.common.checks.recorded import check_faults, check_frames
from livedeform.common.errors import RecordingError
from livedeform.common.experiment.yaml_file import load_experiment
from livedeform.common.types import CameraCalibration, Image, MarkerFrame, Pose, Wrench

STILL = np.array([0.0, 0.0, 0.0, 1.0])


def frame(stamp_ns: int, ids, points) -> MarkerFrame:
    n = len(ids)
    covariances = np.tile(np.diag([1e-10, 2e-10, 9e-10]), (n, 1, 1))
    covariances[:, 0, 2] = covariances[:, 2, 0] = 1e-11
    return MarkerFrame(stamp_ns, np.array(ids, np.uint32), np.array(points, float), covariances, np.full(n, 0.1))


@pytest.fixture
def write(tmp_path):
    def make(*items, name="x.mcap"):
        with BagWriter(tmp_path / name, {"who": "test"}) as bag:
            writer = RecordingWriter(bag)
            for method, *arguments in items:
                getattr(writer, method)(*arguments)
        return tmp_path / name

    return make


def test_everything_comes_back(write, rng):
    left = Image(3_000, rng.integers(0, 255, (12, 17), dtype=np.uint8), "mono8", t.FRAME_LEFT)
    right = Image(3_000, rng.integers(0, 255, (12, 17, 3), dtype=np.uint8), "bgr8", t.FRAME_RIGHT)
    camera = CameraCalibration(
        "c", 17, 12, np.diag([900.0, 901.0, 1.0]), np.array([0.1, -0.2, 0, 0, 0]), np.eye(3), np.eye(3, 4)
    )
    path = write(
        ("marker_frame", frame(2_000, [4, 9], [[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]])),
        ("pose", Pose(1_500, np.array([1.0, 2.0, 3.0]), 2 * STILL)),
        ("wrench", Wrench(1_600, np.array([0.0, 0.0, -2.0]), np.array([0.1, 0.0, 0.0]))),
        ("image", left, t.LEFT_IMAGE),
        ("compressed_image", right, t.RIGHT_IMAGE),
        ("camera_info", camera, 1_000, t.LEFT_CAMERA_INFO, t.FRAME_LEFT),
        ("static_transforms", {(t.FRAME_PHANTOM, t.FRAME_LEFT): Pose(0, np.ones(3), STILL)}, 0),
    )
    recording = load_recording(path)
    assert (recording.start_ns, recording.end_ns) == (1_500, 3_000)
    (markers,) = recording.marker_frames
    assert markers.ids.tolist() == [4, 9]
    np.testing.assert_allclose(markers.points[1], [0.4, 0.5, 0.6], rtol=1e-7)
    np.testing.assert_allclose(markers.covariances[0, 0], [1e-10, 0, 1e-11], rtol=1e-6)
    np.testing.assert_allclose(markers.covariances[0], markers.covariances[0].T)
    assert recording.poses[0].orientation_xyzw.tolist() == STILL.tolist()
    assert recording.wrenches[0].force.tolist() == [0.0, 0.0, -2.0]
    np.testing.assert_array_equal(next(recording.left).pixels, left.pixels)
    np.testing.assert_array_equal(next(recording.right).pixels, right.pixels[..., ::-1])  # png comes back as rgb8
    assert next(recording.right).encoding == "rgb8"
    np.testing.assert_array_equal(recording.camera_infos["left"].camera_matrix, camera.camera_matrix)
    assert recording.static_transforms[(t.FRAME_PHANTOM, t.FRAME_LEFT)].position.tolist() == [1, 1, 1]
    assert recording.metadata["who"] == "test"
    assert recording.warnings == []


def test_frames_come_in_the_order_of_their_stamps_and_once(write):
    place = [[0.0, 0.0, 0.0]]
    path = write(*[("marker_frame", frame(stamp, [stamp], place)) for stamp in (30, 10, 20)])
    assert [f.stamp_ns for f in load_recording(path).marker_frames] == [10, 20, 30]
    path = write(*[("marker_frame", frame(stamp, [1], place)) for stamp in (10, 20, 20)], name="twice.mcap")
    recording = load_recording(path)
    assert [f.stamp_ns for f in recording.marker_frames] == [10, 20]
    assert any("stamp was there already" in line for line in recording.warnings)


def test_markers_that_cannot_be_used_are_left_out(write, folder):
    points = [[0, 0, 0.05], [np.nan, 0, 0], [0.0, 0, 0], [0, 0, 0.01], [0, 0, 0.02]]
    path = write(("marker_frame", frame(10, [5, 1, 99, 7, 7], points)))
    recording = load_recording(path, load_experiment(folder))
    assert recording.marker_frames[0].ids.tolist() == [5]
    assert recording.marker_frames[0].points.shape == (1, 3)
    assert len([line for line in recording.warnings if "left out in some frames" in line]) == 3
    assert load_recording(path).marker_frames[0].ids.tolist() == [5, 99]


@pytest.mark.parametrize("places", ["apart", "together", "one is not finite"])
def test_of_two_markers_with_one_id_neither_is_known(places, write):
    """The first counted, and turned an error of 0.09 mm into one of 1.5 mm. Live it is the same, frame by frame."""
    points = np.array([[0.0, 0, 0.05], [0.01, 0, 0.05], [0.02, 0, 0.05], [0.03, 0, 0.05]])
    points[3] = {"apart": points[3], "together": points[1], "one is not finite": [np.nan, 0, 0]}[places]
    sent = frame(10, [5, 7, 9, 7], points)
    recording = load_recording(write(("marker_frame", sent), ("marker_frame", replace(sent, stamp_ns=20))))
    read = layouts.unpack_marker_frame(10, layouts.pack_marker_frame(sent))
    kept = [5, 7, 9] if places == "one is not finite" else [5, 9]
    assert [f.ids.tolist() for f in recording.marker_frames] == [kept, kept]
    assert read.ids[np.isfinite(read.points).all(axis=1)].tolist() == kept
    assert len(read.ids) == len(read.points) == len(read.covariances) == len(read.reprojection_error_px)
    found = [f for f in check_faults(recording, None, None) if "there twice" in f.text]  # type: ignore[arg-type]
    assert [f.level == "WARN" and f.doubts for f in found] == [True] * (len(kept) == 2)


MOVED = {"by 20 mm": (0.02, 0.0), "by 1 mm": (0.001, 0.0), "by a degree": (0.0, 0.0175), "not at all": (1e-6, 1e-5)}


@pytest.mark.parametrize("name", MOVED)
def test_cameras_that_are_said_to_be_elsewhere_in_between_are_doubted(name, write):
    """The last place counted for the whole recording, without a word."""
    by, angle = MOVED[name]
    turn = np.array([0.0, 0.0, np.sin(0.5 * angle), np.cos(0.5 * angle)])
    places = [Pose(0, np.array([0.0, 0.0, 0.35]), STILL), Pose(0, np.array([by, 0.0, 0.35]), -turn)]
    other = [{("base", "tool"): Pose(0, np.array([0.1 * k, 0.0, 0.0]), STILL)} for k in range(2)]  # of nobody's
    said = [({(t.FRAME_PHANTOM, t.FRAME_LEFT): place} | more) for place, more in zip(places, other, strict=True)]
    recording = load_recording(write(*[("static_transforms", each, 10 * k) for k, each in enumerate(said)]))
    found = [f for f in check_faults(recording, None, None) if "cameras" in f.text]  # type: ignore[arg-type]
    assert [f.level == "WARN" and f.doubts for f in found] == [True] * (name != "not at all")


def test_a_pause_of_hours_is_noted_and_a_stretch_that_goes_is_doubted(tmp_path):
    for wrong, n, level in ((0, 105, "NOTE"), (3 * 3600 * 10**9, 100, "WARN")):
        with BagWriter(tmp_path / f"{n}.mcap", {}) as file:
            bag = Late(file)
            writer = RecordingWriter(bag)
            for k in range(105):
                bag.now_ns = 10**18 + k * 50_000_000 + (2 * 3600 * 10**9 if k >= 100 and not wrong else 0)
                writer.pose(Pose(bag.now_ns + wrong * (k >= 100), np.zeros(3), STILL))
        recording = load_recording(tmp_path / f"{n}.mcap")
        assert len(recording.poses) == n
        (found,) = check_faults(recording, None, None)  # type: ignore[arg-type]
        assert found.level == level and found.doubts == (level == "WARN")
        assert ("pauses" if level == "NOTE" else "cannot be right") in found.text


def test_poses_that_are_none_are_left_out(write):
    path = write(("pose", Pose(1, np.zeros(3), np.zeros(4))), ("pose", Pose(2, np.array([np.inf, 0, 0]), STILL)))
    recording = load_recording(path)
    assert recording.poses == []
    assert any("/probe/pose: left out" in line and "(2 messages)" in line for line in recording.warnings)


@pytest.mark.parametrize("options", ["bag: data/tilted.mcap", "7", "", "[", "{}", "bag:"])
def test_a_run_has_the_name_of_its_recording_whatever_else_is_written(options):
    run = {"command": "run", "options": options}
    assert own_name(Path("out/run.mcap"), run) == ("tilted" if "tilted" in options else "run")
    assert own_name(Path("out/press.mcap"), {"options": options}) == "press"


@pytest.mark.parametrize("n", [1, 40], ids=["alone", "among others"])
def test_wrenches_that_are_no_numbers_are_left_out(write, n):
    """One of 3000 made the noise of the force unknown, and that was taken for none."""
    good = [Wrench(10 + i, np.array([0.0, 0.0, 1.0]), np.zeros(3)) for i in range(n)]
    bad = [Wrench(5, np.array([0.0, np.nan, 1.0]), np.zeros(3)), Wrench(7, np.ones(3), np.array([np.inf, 0, 0]))]
    recording = load_recording(write(*[("wrench", w) for w in (*bad, *good)]))
    assert [w.stamp_ns for w in recording.wrenches] == [w.stamp_ns for w in good]
    assert any("not finite" in line and "(2 messages)" in line for line in recording.warnings)


def test_another_frame_is_pointed_out(tmp_path):
    with BagWriter(tmp_path / "x.mcap") as bag:
        RecordingWriter(bag).marker_frame(frame(1, [1], [[0, 0, 0]]), frame_id="qualisys")
    recording = load_recording(tmp_path / "x.mcap")
    (finding,) = check_frames(recording, None, None)  # type: ignore[arg-type]
    assert finding.text == "/stereo/markers is in the frame 'qualisys', and taken to be 'phantom'"
    assert finding.level == "WARN" and finding.doubts


def test_header_stamps_are_read_without_decoding(write):
    from livedeform.common.bags.read import read_bag

    path = write(("pose", Pose(1_234_567_890_123_456_789, np.zeros(3), STILL)))
    with read_bag(path) as bag:
        assert header_stamp_ns(next(bag.messages())) == 1_234_567_890_123_456_789


def test_an_encoding_that_nobody_reads(write):
    path = write(("image", Image(1, np.zeros((4, 4), np.uint8), "bayer_rggb8"), t.LEFT_IMAGE))
    with pytest.raises(RecordingError, match="bayer_rggb8"):
        list(read_images(path, t.LEFT_IMAGE))


@pytest.mark.parametrize(("n_raw", "n_compressed", "raw"), [(3, 20, False), (20, 3, True), (5, 5, True), (0, 4, False)])
def test_of_raw_and_compressed_pictures_those_are_read_that_are_more(n_raw: int, n_compressed: int, raw: bool, write):
    """A raw topic that was recorded in part hid all others."""
    grey = Image(0, np.full((4, 6), 90, np.uint8), "mono8", t.FRAME_LEFT)
    colour = Image(0, np.full((4, 6, 3), 90, np.uint8), "rgb8", t.FRAME_LEFT)
    items = [("image", replace(grey, stamp_ns=10 * k), t.LEFT_IMAGE) for k in range(1, n_raw + 1)]
    items += [("compressed_image", replace(colour, stamp_ns=10 * k), t.LEFT_IMAGE) for k in range(1, n_compressed + 1)]
    path = write(*items)
    found = list(read_images(path, t.LEFT_IMAGE))
    assert [image.stamp_ns for image in found] == [10 * k for k in range(1, max(n_raw, n_compressed) + 1)]
    assert {image.encoding for image in found} == {"mono8" if raw else "rgb8"}
    assert load_recording(path).picture_stamps_ns[-1] == found[-1].stamp_ns
    assert list(read_images(path, t.RIGHT_IMAGE)) == []


def test_recordings_and_experiments_need_no_ros():
    """A subprocess in which rclpy cannot be imported."""
    code = (
        "import sys; sys.modules['rclpy'] = None; sys.modules['sensor_msgs'] = None;"
        "import livedeform.common.bags.recording, livedeform.common.experiment.yaml_file;"
        "import livedeform.importing.c3d, livedeform.inspection"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_clouds_of_one_stamp_that_share_no_marker_are_one_frame(write):
    """A tracker that sends what each camera sees: half of the markers were said to be never seen."""
    sent = [(10, [1, 2]), (10, [7]), (20, [1, 2]), (20, [2, 7]), (30, [7]), (30, [])]
    path = write(*[("marker_frame", frame(stamp, ids, np.zeros((len(ids), 3)))) for stamp, ids in sent])
    recording = load_recording(path)
    assert [(f.stamp_ns, f.ids.tolist()) for f in recording.marker_frames] == [(10, [1, 2, 7]), (20, [1, 2]), (30, [7])]
    assert all(len(f.ids) == len(f.covariances) == len(f.reprojection_error_px) for f in recording.marker_frames)
    repeats = recording.repeats[t.STEREO_MARKERS]
    assert (repeats.joined, repeats.left_out, repeats.n) == (2, 1, 3)
    assert sum("stamp was there already" in line for line in recording.warnings) == 1


class Late:
    """A bag whose messages are received ``after`` ns later than the moment ``now_ns``."""

    def __init__(self, bag: BagWriter) -> None:
        self.bag, self.now_ns, self.after = bag, 0, 0

    def write(self, topic: str, type_name: str, log_time_ns: int, data: bytes) -> None:
        self.bag.write(topic, type_name, self.now_ns + self.after, data)


@pytest.mark.parametrize("late", [0.5, 1.5, 20.0])
def test_what_is_computed_may_be_late(tmp_path, late):
    """Frames after a slow solve were left out of a live session's results: the receive time has the solving in it."""
    n, place = 200, np.zeros((1, 3))
    error = layouts.pack(layouts.COMPARE_MARKERS, points=place, id=np.ones(1, np.uint32))
    with BagWriter(tmp_path / "run.mcap", {}) as file:
        bag = Late(file)
        writer = RecordingWriter(bag)
        for k in range(n):
            bag.now_ns, bag.after = 10**18 + k * 50_000_000, 0
            writer.marker_frame(frame(bag.now_ns, [1], place))
            writer.pose(Pose(bag.now_ns + (k == 100) * 9 * 10**9, np.zeros(3), STILL))
            bag.after = round(1e9 * late) if k % 40 == 20 else 20_000_000
            writer.marker_frame(frame(bag.now_ns, [1], place), topic=t.FEM_MARKERS)
            writer._cloud(t.COMPARE_MARKERS, bag.now_ns, error, t.FRAME_PHANTOM)
    recording = load_recording(tmp_path / "run.mcap")
    assert len(recording.predictions) == len(recording.errors) == n
    assert len(recording.poses) == n - 1 and recording.faults["stamp"] == 1  # of inputs they are still looked for


@pytest.mark.parametrize("filmed", [False, True])
def test_markers_that_are_found_in_pictures_may_be_late(tmp_path, filmed):
    """A tracker's late stamp is wrong; where pictures are there the stereo node made the frame, as late as it was."""
    with BagWriter(tmp_path / "run.mcap", {}) as file:
        bag = Late(file)
        writer = RecordingWriter(bag)
        for k in range(100):
            bag.now_ns, bag.after = 10**18 + k * 50_000_000, 0
            if filmed:
                writer.image(Image(bag.now_ns, np.zeros((4, 6), np.uint8), "mono8"), t.LEFT_IMAGE)
            bag.after = (k == 20) * 3 * 10**9
            writer.marker_frame(frame(bag.now_ns, [1], np.zeros((1, 3))))
    assert len(load_recording(tmp_path / "run.mcap").marker_frames) == 99 + filmed
