"""Pictures that must not be measured, through the graph as a user runs it: a message, a status, and no wrong point."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import small
from scene import make_test_rig
from small import Filmed

from livedeform.cli import run as command_line
from livedeform.common import topics as t
from livedeform.common.bags.read import read_bag
from livedeform.common.bags.recording import load_recording
from livedeform.common.bags.recording_writer import RecordingWriter
from livedeform.common.bags.types import decode
from livedeform.common.bags.write import BagWriter
from livedeform.common.types import Image, Pose
from livedeform.stereo_node.camera.calibration_file import write_camera

Pairs = list[tuple[Image, Image]]
GOOD = 3  # pairs, before they go bad


def right(change: Callable[[Image, Pairs], Image]) -> Callable[[Pairs], Pairs]:
    """Changes the right pictures after the good ones."""
    return lambda pairs: [(a, change(b, pairs) if k >= GOOD else b) for k, (a, b) in enumerate(pairs)]


def sixteen_bits(image: Image, factor: int) -> Image:
    return replace(image, pixels=image.pixels.astype(np.uint16) * factor, encoding="mono16")


def exchanged(pairs: Pairs) -> Pairs:
    return [(replace(b, frame_id=a.frame_id), replace(a, frame_id=b.frame_id)) for a, b in pairs]


CASES = {
    "black": (right(lambda i, p: replace(i, pixels=np.zeros_like(i.pixels))), GOOD, "the right picture is black"),
    "frozen": (right(lambda i, p: replace(i, pixels=p[GOOD - 1][1].pixels)), GOOD, "the right picture is the same as"),
    "12 of 16 bits": (right(lambda i, p: sixteen_bits(i, 16)), GOOD, "that 16-bit pictures use all bits"),
    "size": (right(lambda i, p: replace(i, pixels=i.pixels[:240, :320].copy())), GOOD, "is 320x240, its calibration"),
    "exchanged": (exchanged, 0, "exchange the cameras' topics"),
}


def replayed(folder: Path, bag: Path, out: Path) -> tuple[list[int], list[tuple[int, str]], list[tuple[int, str]]]:
    """Markers of every published frame, and level and message of the stereo node's and of the metrics' statuses."""
    code = command_line(["run", str(folder), "--bag", str(bag), "--out", str(out)])
    assert code == (json.loads((out / "metrics.json").read_text())["verdict"] == "STALE")  # less than half measured
    said: dict[str, list[tuple[int, str]]] = {t.STEREO_STATUS: [], t.COMPARE_METRICS: []}
    with read_bag(out / "run.mcap") as run:
        for raw in run.messages(list(said)):
            status = decode(raw).status[0]
            said[raw.topic].append((int.from_bytes(status.level) if isinstance(status.level, bytes) else status.level,
                                    status.message))  # fmt: skip
    counts = [len(frame.ids) for frame in load_recording(out / "run.mcap").marker_frames]
    return counts, said[t.STEREO_STATUS], said[t.COMPARE_METRICS]


@pytest.mark.parametrize("case", CASES)
def test_bad_pictures_give_a_status_and_no_point(filmed: Filmed, tmp_path: Path, case: str):
    change, n_good, message = CASES[case]
    bag = small.write_picture_bag(tmp_path / "film.mcap", small.press(6), change(filmed.pairs))
    counts, stereo, metrics = replayed(filmed.folder, bag, tmp_path / "out")
    assert all(n > 20 for n in counts[:n_good]) and not any(counts[n_good:])
    bad = [text for level, text in stereo if level == 2]
    assert bad and all(message in text for text in bad)
    assert [level for level, _ in metrics][n_good:] and all(level != 0 for level, _ in metrics[n_good:-1])


def test_sixteen_bits_are_measured_by_their_high_byte(filmed: Filmed, tmp_path: Path):
    pairs = [(sixteen_bits(a, 256), sixteen_bits(b, 256)) for a, b in filmed.pairs]
    bag = small.write_picture_bag(tmp_path / "film.mcap", small.press(6), pairs)
    counts, stereo, _ = replayed(filmed.folder, bag, tmp_path / "out")
    assert counts == [24] * 6 and all(level == 0 for level, _ in stereo)


def test_the_calibration_of_another_camera_gives_no_point(filmed: Filmed, tmp_path: Path):
    folder = tmp_path / "experiment"
    shutil.copytree(filmed.folder, folder, ignore=shutil.ignore_patterns("*.mcap"))
    other = make_test_rig(width=640, height=480, focal=810.0, baseline=0.075, converge=0.22)
    write_camera(other.left, folder / "left.yaml")
    write_camera(other.right, folder / "right.yaml")
    counts, stereo, _ = replayed(folder, filmed.bag, tmp_path / "out")
    assert not any(counts) and len(stereo) == 6 and all(level == 2 for level, _ in stereo)


def test_a_calibration_that_does_not_fit_the_body_is_a_doubt(filmed: Filmed, tmp_path: Path):
    """A baseline that is too long: every status warned of it, and the run was OK without a word."""
    folder, out = tmp_path / "experiment", tmp_path / "out"
    shutil.copytree(filmed.folder, folder, ignore=shutil.ignore_patterns("*.mcap"))
    wide = make_test_rig(width=640, height=480, focal=700.0, baseline=1.11 * 0.06, converge=0.15)
    write_camera(wide.left, folder / "left.yaml")
    write_camera(wide.right, folder / "right.yaml")
    _, stereo, _ = replayed(folder, filmed.bag, out)
    assert all(level == 1 and "check scale, configuration and calibration" in text for level, text in stereo)
    document = json.loads((out / "metrics.json").read_text())
    assert document["verdict"] in ("WARN", "ERROR") and list(document["counts"]["stereo"]["reasons"].values()) == [6]
    said = f"stereo_node says of 6 of 6 frames: {stereo[-1][1]}"
    assert said in document["doubts"] and said in document["reason"]
    assert stereo[-1][1] in (out / "report.html").read_text()


def write(path: Path, poses: Sequence[Pose], pairs: Sequence[tuple[Image, Image | None]]) -> Path:
    """A bag of pairs of which some right pictures are missing."""
    with BagWriter(path, {"made_by": "tests"}) as bag:
        writer = RecordingWriter(bag)
        for pose, (left, right) in zip(poses, pairs, strict=True):
            writer.pose(pose)
            writer.image(left, t.LEFT_IMAGE)
            if right is not None:
                writer.image(right, t.RIGHT_IMAGE)
    return path


def test_a_camera_that_stops_is_named(filmed: Filmed, tmp_path: Path):
    step = 6 * small.STEP_NS
    later = [(replace(a, stamp_ns=a.stamp_ns + k * step), None if k else b) for k in range(3) for a, b in filmed.pairs]
    poses = [replace(pose, stamp_ns=pose.stamp_ns + k * step) for k in range(3) for pose in small.press(6)]
    counts, stereo, _ = replayed(filmed.folder, write(tmp_path / "film.mcap", poses, later), tmp_path / "out")
    assert len(counts) == 6 and min(counts) > 20
    assert next(text for level, text in stereo if level == 2).startswith("5 left pictures came without a right one")


def test_cameras_whose_clocks_differ_are_told_by_how_much(filmed: Filmed, tmp_path: Path):
    step = 6 * small.STEP_NS
    late = [
        (replace(a, stamp_ns=a.stamp_ns + k * step), replace(b, stamp_ns=b.stamp_ns + k * step + 8_000_000))
        for k in range(2) for a, b in filmed.pairs
    ]  # fmt: skip
    poses = [replace(pose, stamp_ns=pose.stamp_ns + k * step) for k in range(2) for pose in small.press(6)]
    counts, stereo, metrics = replayed(filmed.folder, write(tmp_path / "film.mcap", poses, late), tmp_path / "out")
    assert counts == [] and metrics[-1][0] == 3  # STALE
    assert next(text for level, text in stereo if level == 2).startswith("left and right stamps are +8.0 ms apart")
