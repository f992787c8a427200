"""``livedeform calibrate`` and ``study stereo`` on one's own pictures, from files and from a bag; their refusals."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from livedeform.calibrating import _longest
from livedeform.cli import run as command_line
from livedeform.common import topics as t
from livedeform.common.bags.recording_writer import RecordingWriter
from livedeform.common.bags.write import BagWriter
from livedeform.common.frames import inverse, transform
from livedeform.common.types import Array, Image
from livedeform.importing.board_pictures import picture_files
from livedeform.stereo_node.camera.calibration_file import read_camera
from livedeform.stereo_node.camera.calibration_uncertainty import read_bundle
from livedeform.stereo_node.camera.rig import StereoRig, make_rig

SIZE, SQUARE, BASELINE = (480, 360), 0.02, 0.08
K = np.array([[450.0, 0, 240.0], [0, 450.0, 178.0], [0, 0, 1.0]])


def board_picture(T: Array, rng: np.random.Generator, square: float) -> NDArray[np.uint8]:
    """A board of 7 x 6 squares, its first inner corner at the origin of T_camera_board, seen by a pinhole."""
    scale = 4
    cells = (np.add.outer(np.arange(6), np.arange(7)) % 2).astype(np.uint8)
    flat = np.full((8 * 40, 9 * 40), 235, np.uint8)
    flat[40:-40, 40:-40] = np.where(np.kron(cells, np.ones((40, 40))) > 0, 235, 30)
    # texels to metres: the first inner corner lies two cells in, at the border between texels 79 and 80
    to_board = np.array([[square / 40, 0, -79.5 * square / 40], [0, square / 40, -79.5 * square / 40], [0, 0, 1.0]])
    H = np.diag([scale, scale, 1.0]) @ _half(scale) @ K @ T[:3, [0, 1, 3]] @ to_board
    big = cv2.warpPerspective(flat, H, (SIZE[0] * scale, SIZE[1] * scale), flags=cv2.INTER_LINEAR, borderValue=120)
    picture = cv2.GaussianBlur(cv2.resize(big, SIZE, interpolation=cv2.INTER_AREA).astype(float), (0, 0), 0.6)
    return np.clip(np.round(picture + rng.normal(0, 1.0, picture.shape)), 0, 255).astype(np.uint8)


def _half(scale: int) -> Array:
    """Pixel centres lie at whole numbers in the picture and in the finer one."""
    shift = 0.5 - 0.5 / scale
    return np.array([[1, 0, shift], [0, 1, shift], [0, 0, 1.0]])


def rig() -> StereoRig:
    R = Rotation.from_rotvec([0.0, 0.06, 0.0]).as_matrix()
    T = transform(R, -R @ np.array([BASELINE, 0.0, 0.0]))
    one = (*SIZE, K, np.zeros(5), "plumb_bob")
    return make_rig(("left", *one), ("right", *one), T)


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """left00.png .. right09.png, of which 7.. show another board, of 21 mm; and both sets as bags."""
    folder, rng, cameras = tmp_path_factory.mktemp("boards"), np.random.default_rng(2), rig()
    tilts = rng.uniform([-0.5, -0.5, -0.3], [0.5, 0.5, 0.3], (10, 3))
    with BagWriter(folder / "boards.mcap", {}) as one, BagWriter(folder / "other.mcap", {}) as two:
        for k, tilt in enumerate(tilts):
            square, writer = (SQUARE, one) if k < 7 else (0.021, two)
            R = Rotation.from_euler("xyz", tilt).as_matrix()
            place = rng.uniform([-0.02, -0.02, 0.34], [0.04, 0.02, 0.44])
            T = transform(R, place - R @ np.array([2.5 * square, 2 * square, 0.0]))
            for side, to_camera in (("left", np.eye(4)), ("right", cameras.T_right_left)):
                picture = board_picture(to_camera @ T, rng, square)
                cv2.imwrite(str(folder / f"{side}{k:02d}.png"), picture)
                topic, frame = (t.LEFT_IMAGE, t.FRAME_LEFT) if side == "left" else (t.RIGHT_IMAGE, t.FRAME_RIGHT)
                stamp_ns = 10**9 * (k + 1) + (0 if side == "left" else 2_000_000)
                RecordingWriter(writer).image(Image(stamp_ns, picture, "mono8", frame), topic)
    return folder


def test_the_longest_lengths_that_are_told_have_a_scatter():
    rows = [{"n_squares": float(n), "count": count} for n, count in ((1, 40), (2, 12), (3, 1))]
    assert _longest(rows)["n_squares"] == 2
    assert _longest(rows[2:])["n_squares"] == 3


def words(folder: Path, first: str = "left0[0-6].png", **options: object) -> list[str]:
    given = {"left": folder / first, "right": folder / first.replace("left", "right"), "board": "6x5", "square": SQUARE}
    given |= options
    return [w for key, v in given.items() if v is not None for w in (f"--{key.replace('_', '-')}", str(v))]


@pytest.mark.slow
def test_from_files_with_a_check_of_the_scale(pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    check = {"check_left": pictures / "left0[789].png", "check_right": pictures / "right0[789].png"}
    out = tmp_path / "out"
    assert command_line(["calibrate", *words(pictures, out=out, check_square=0.021, **check)]) == 0
    assert "agrees with the scale" in capsys.readouterr().out
    found = json.loads((out / "calibration.json").read_text())
    assert found["parameters"]["baseline"]["value"] == pytest.approx(BASELINE, abs=2e-4)
    assert abs(found["scale_check"]["scale"] - 1) < 3e-3
    cameras = StereoRig(read_camera(out / "left.yaml"), read_camera(out / "right.yaml"))
    assert read_bundle(out / "left.yaml", cameras) is not None
    turn = inverse(cameras.T_right_left) @ rig().T_right_left
    assert np.linalg.norm(Rotation.from_matrix(turn[:3, :3]).as_rotvec()) < 4e-3
    assert command_line(["calibrate", *words(pictures, out=out, check_square=0.0215, **check)]) == 2  # results there
    assert command_line(["calibrate", *words(pictures, out=out, check_square=0.0215, **check), "--force"]) == 0
    assert "contradicts the scale" in capsys.readouterr().out


def test_from_a_bag_and_the_study(pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    bag = {"left": None, "right": None, "bag": pictures / "boards.mcap"}
    options = words(pictures, **bag, out=tmp_path / "out", check_bag=pictures / "other.mcap", check_square=0.021)
    assert command_line(["calibrate", *options]) == 0
    assert "agrees with the scale" in capsys.readouterr().out
    assert command_line(["study", "stereo", *words(pictures, **bag, out=tmp_path / "study")]) == 0
    study = json.loads((tmp_path / "study" / "study.json").read_text())
    numbers = study["numbers"]
    assert study["claims"] == []  # the thesis's are of its own pictures; two goals of a board of 25 mm were judged too
    assert "thesis" not in re.sub(r"data:image/\S+", "", (tmp_path / "study" / "index.html").read_text()).lower()
    assert {row["n_squares"] for row in numbers["by_squares"]} == {1, 2, 3, 4, 5}
    assert numbers["by_squares"][0]["sd"] < 2e-4


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"square": 20.0}, "--square: a square of 20 m is not plausible; give metres (0.025 for 25 mm)"),
        ({"square": -0.02}, "--square: a square of -0.02 m is not plausible"),
        ({"board": "6by5"}, "--board: '6by5' is not columns x rows"),
        pytest.param({"board": "9x6"}, "was found in 0 of 7 pairs", marks=pytest.mark.slow),
        ({"exchanged": True}, "the right camera comes out left of the left one; exchange --left and --right"),
        ({"right": "left"}, "left and right are the same picture: the baseline would be zero"),
        ({"right": "small"}, "the right picture is 240x180, the first is 480x360"),
        ({"right": None}, "--right: no pictures are named"),
        ({"check_board": "6x5"}, "--check-square: a square of 0 m"),
        ({"check_left": "same", "check_square": 0.02}, "the pictures of the check are those of the calibration"),
    ],
)
def test_refusals_are_one_line(
    changes: dict[str, object], said: str, pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    options = dict(changes)
    if options.pop("exchanged", False):
        options |= {"left": pictures / "right0[0-6].png", "right": pictures / "left0[0-6].png"}
    if options.get("right") == "left":
        options["right"] = pictures / "left0[0-6].png"
    if options.get("right") == "small":
        for k in range(7):
            picture = cv2.imread(str(pictures / f"right{k:02d}.png"))
            cv2.imwrite(str(tmp_path / f"right{k:02d}.png"), cv2.resize(picture, (240, 180)))
        options["right"] = tmp_path / "right0[0-6].png"
    if options.get("check_left") == "same":
        options |= {"check_left": pictures / "left0[0-6].png", "check_right": pictures / "right0[0-6].png"}
    assert command_line(["calibrate", *words(pictures, out=tmp_path / "out", **options)]) == 2
    error = capsys.readouterr().err.strip().splitlines()
    assert said in error[-1] and error[-1].startswith("livedeform: ")
    assert not (tmp_path / "out" / "left.yaml").exists()


def test_one_camera_with_fewer_pictures(pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    shutil.copytree(pictures, tmp_path / "fewer")
    (tmp_path / "fewer" / "right03.png").unlink()
    assert command_line(["calibrate", *words(tmp_path / "fewer", out=tmp_path / "out")]) == 2
    assert "7 left and 6 right pictures, number 03 is on one side only" in capsys.readouterr().err


def test_a_file_that_is_no_picture_costs_its_pair_alone(
    pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    shutil.copytree(pictures, tmp_path / "some")
    (tmp_path / "some" / "right03.png").write_text("no picture")
    (tmp_path / "some" / "left05.png").write_bytes(b"")
    assert command_line(["calibrate", *words(tmp_path / "some", out=tmp_path / "out")]) == 0
    said = capsys.readouterr().out
    assert "right03.png: cannot be read as a picture; its pair is left out" in said and "left05.png: cannot" in said
    assert ", 5 pairs" in said
    for k in range(7):
        (tmp_path / "some" / f"left{k:02d}.png").write_text("no picture")
    assert command_line(["calibrate", *words(tmp_path / "some", out=tmp_path / "none")]) == 2
    assert "left00.png: cannot be read as a picture; give png" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("left", "right", "said"),
    [
        ("broken.mp4", "broken.mp4", "broken.mp4: cannot be read as a video"),
        ("none.mp4", "none.mp4", "none.mp4: cannot be read as a video"),
        ("broken.mp4", "right0*.png", "--left, --right: one is a video, the other is not; give two videos"),
    ],
)
def test_videos_that_are_none(
    left: str, right: str, said: str, pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    (pictures / "broken.mp4").write_bytes(b"no video")
    given = words(pictures, left=pictures / left, right=pictures / right, out=tmp_path / "out")
    assert command_line(["calibrate", *given]) == 2
    assert said in capsys.readouterr().err


NAMES = [("camera1.image{}.png", "camera2.image{}.png"), ("L{:02d}.png", "R{}.png"), ("p{}_{}", "q{}_{}")]


@pytest.mark.parametrize(
    ("left", "right"),
    [
        ("2024-01-03_cam0_{k}", "2024-01-03_cam1_{k:04d}"),
        ("a_{k}_{left_clock}", "b_{k}_{right_clock}"),
        ("a_{left_clock}_{k:03d}", "b_{k}"),
    ],
)
def test_numbers_from_nought_and_clocks_that_differ(left: str, right: str, tmp_path: Path):
    for k in (0, 1, 10):
        for name, grey in ((left, k), (right, 100 + k)):
            name = name.format(k=k, left_clock=1_700_000_000 + 7 * k, right_clock=1_700_000_003 + 7 * k)
            cv2.imwrite(str(tmp_path / f"{name}.png"), np.full((4, 4), grey, np.uint8))
    patterns = ("2024*cam0*", "2024*cam1*") if left.startswith("2024") else ("a_*", "b_*")
    found = picture_files(*(str(tmp_path / pattern) for pattern in patterns))
    assert [(int(a[0, 0]), int(b[0, 0])) for _, a, b in found] == [(0, 100), (1, 101), (10, 110)]


@pytest.mark.parametrize(("left", "right"), NAMES)
def test_pictures_are_paired_by_the_numbers_that_change(left: str, right: str, tmp_path: Path):
    for k in (1, 2, 10):
        for name, grey in ((left, k), (right, 100 + k)):
            path = tmp_path / Path(name.format(k, 3 * k)).with_suffix(".png")
            cv2.imwrite(str(path), np.full((4, 4), grey, np.uint8))
    found = picture_files(*(str(tmp_path / f"{name[:7] if 'camera' in name else name[0]}*") for name in (left, right)))
    assert [(int(a[0, 0]), int(b[0, 0])) for _, a, b in found] == [(1, 101), (2, 102), (10, 110)]


def test_a_file_without_a_number_among_the_pictures_is_named(
    pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    shutil.copytree(pictures, tmp_path / "more")
    (tmp_path / "more" / "left_intrinsics.yml").write_text("%YAML:1.0\n")
    given = words(tmp_path / "more", out=tmp_path / "out", left=tmp_path / "more" / "left*")
    assert command_line(["calibrate", *given]) == 2
    assert "left_intrinsics.yml is on one side only" in capsys.readouterr().err
