"""The graph on pictures, in one process: what arrives is what direct calls of the tracker and the model give."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import small
from small import Filmed

from livedeform.common import topics as t
from livedeform.common.bags.read import read_bag
from livedeform.common.bags.recording import load_recording
from livedeform.common.bags.recording_writer import RecordingWriter
from livedeform.common.bags.write import BagWriter
from livedeform.common.errors import InputError
from livedeform.common.experiment.markers_file import read_markers
from livedeform.common.experiment.yaml_file import load_experiment
from livedeform.run import replay
from livedeform.run.running import RunOptions, run
from livedeform.stereo_node.correction import parse_pose
from livedeform.stereo_node.pipeline import StereoTracker


@pytest.fixture(scope="module")
def out(filmed: Filmed, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pictures") / "out"
    run(RunOptions(filmed.folder, filmed.bag, folder), lambda *_: None)
    return folder


def test_markers_are_those_of_direct_calls(out: Path, filmed: Filmed):
    rest = read_markers(out / "rest_markers.csv").points
    tracker = StereoTracker.from_experiment(load_experiment(filmed.folder), None, rest)
    recording = load_recording(out / "run.mcap")
    assert len(recording.marker_frames) == len(filmed.pairs)
    for (left, right), frame in zip(filmed.pairs, recording.marker_frames, strict=True):
        expected, status = tracker.process(left, right)
        assert status.level == "ok"
        np.testing.assert_array_equal(frame.ids, expected.ids)
        np.testing.assert_allclose(frame.points, expected.points, atol=4e-9)  # float32 on the wire
        np.testing.assert_allclose(frame.covariances, expected.covariances, rtol=1e-6)


def test_the_error_is_the_measuring_noise(out: Path):
    """The pictures show the model's own markers: what is left is the tracker's noise and the registration's."""
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["counts"]["stereo"] == {"pairs": 6, "unpaired": 0}
    assert metrics["n_frames"] == 6 and metrics["error"]["n"] >= 0.95 * 6 * 24
    assert metrics["error"]["rmse"] < 1e-4  # measured 0.03 mm
    assert metrics["error"]["rmse"] < 3 * metrics["noise_floor"]


def test_the_cameras_place_is_in_the_recording(out: Path):
    transforms = load_recording(out / "run.mcap").static_transforms
    assert set(transforms) == {(t.FRAME_PHANTOM, t.FRAME_LEFT), (t.FRAME_LEFT, t.FRAME_RIGHT)}
    assert np.linalg.norm(transforms[t.FRAME_LEFT, t.FRAME_RIGHT].position) == pytest.approx(0.06, abs=1e-4)


@pytest.mark.parametrize(("n_raw", "played"), [(2, t.COMPRESSED_IMAGES), (6, t.IMAGES)])
def test_raw_pictures_of_a_part_do_not_hide_compressed_ones(n_raw: int, played: tuple, filmed: Filmed, tmp_path: Path):
    with BagWriter(tmp_path / "film.mcap", {}) as bag:
        writer = RecordingWriter(bag)
        for k, pair in enumerate(filmed.pairs):
            for image, topic in zip(pair, t.IMAGES, strict=True):
                writer.compressed_image(image, topic)
                if k < n_raw:
                    writer.image(image, topic)
    with read_bag(tmp_path / "film.mcap") as read:
        assert set(replay.plan(read, load_experiment(filmed.folder)).topics) == set(played)


@pytest.mark.parametrize("n", [1, 6])
def test_the_last_pair_is_measured(n: int, filmed: Filmed, tmp_path: Path):
    """Cameras a millisecond apart, and a pause of a minute before the last pair: the next one would tell whether they
    are of one moment, and none comes."""
    late = [60_000_000_000 * (k == n - 1) for k in range(n)]
    poses = [replace(pose, stamp_ns=pose.stamp_ns + by) for pose, by in zip(small.press(6)[:n], late, strict=True)]
    pairs = [
        (replace(left, stamp_ns=pose.stamp_ns), replace(right, stamp_ns=pose.stamp_ns + 1_000_000))
        for pose, (left, right) in zip(poses, filmed.pairs, strict=False)
    ]
    bag = small.write_picture_bag(tmp_path / "film.mcap", poses, pairs)
    run(RunOptions(filmed.folder, bag, tmp_path / "out"), lambda *_: None)
    document = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert document["counts"]["stereo"] == {"pairs": n, "unpaired": 0} and document["n_frames"] == n


@pytest.mark.parametrize("pose", ["1 2 3", "one", "0 0 0 0 0 0 0", "0 0 0 0 0 0 1 1"])
def test_a_camera_pose_that_is_none_is_refused_in_a_line(pose: str):
    with pytest.raises(InputError, match=r"seven numbers|unit quaternion"):
        parse_pose(pose)
