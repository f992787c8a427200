"""The dot cylinder and the loop: parts against closed forms, and the published dots themselves (data)."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import numpy as np
import pytest

from livedeform.common.frames import transform
from livedeform.stereo_node.camera.rig import StereoRig, make_rig
from livedeform.studies.public import dots_loop
from livedeform.studies.public.dots import detected, read_dots

DATA = Path(os.environ.get("LIVEDEFORM_DATA", Path(__file__).parents[2] / ".." / "shared" / "data"))


def make(k1: float, k2: float = 0.0) -> StereoRig:
    """Two cameras side by side, 0.18 m apart."""
    matrix = np.array([[2600.0, 0, 1232], [0, 2600, 1640], [0, 0, 1]])
    cameras = [(side, 2464, 3280, matrix, np.array([k1, k2, 0, 0, 0]), "plumb_bob") for side in ("left", "right")]
    return make_rig(cameras[0], cameras[1], transform(np.eye(3), np.array([-0.18, 0.0, 0.0])))


def seen(rig: StereoRig) -> dots_loop.DotsSeen:
    """Dots of five columns and twenty rows on a cylinder, as the ``rig`` sees them."""
    angle, z = np.meshgrid(np.radians(np.arange(-24, 25, 12)), np.linspace(-0.114, 0.114, 20), indexing="ij")
    places = np.column_stack(
        [(0.057 * np.sin(angle) + 0.09).ravel(), z.ravel(), (0.34 - 0.057 * np.cos(angle)).ravel()]
    )
    left, right, _, _ = rig.project(places)
    ids = np.array([100 * (j + 1) + i + 1 for j in range(5) for i in range(20)], np.uint32)
    return dots_loop.DotsSeen(ids, places, left, right)


def test_one_term_stands_for_itself_and_for_two() -> None:
    points = seen(make(0.0)).places
    assert dots_loop.one_term(make(0.15), points) == pytest.approx(0.15)
    assert 0.1 < dots_loop.one_term(make(0.18, -0.35), points) < 0.18


def test_the_columns_take_away_what_they_are() -> None:
    dots = seen(make(0.003))
    shares = dots_loop.hidden_shares(make(0.0), dots)  # 0.003 off: small enough for columns at 0
    assert shares["lens"] > 0.999 and shares["both"] > 0.999
    shifted = dots_loop.hidden_shares(dots_loop.varied(make(0.0), 3.0 * dots_loop.STEPS * (np.arange(15) < 14)), dots)
    assert shifted["both"] > 0.99 > shifted["lens"]


def test_what_is_held_out_takes_no_part_in_the_registration() -> None:
    """The phantom's pose was fitted to the odd rows as well, on which the loop is judged."""
    rig = make(0.0)
    dots = seen(rig)
    T, _ = dots_loop.measure(rig, dots)
    moved = dots.places + np.where(dots.fitted, 0.0, 3e-3)[:, None]  # the target's statement of the odd rows is wrong
    assert dots_loop.measure(rig, dataclasses.replace(dots, places=moved))[0] == pytest.approx(T, abs=1e-12)
    left = dots.left + np.where(dots.fitted, 0.0, 5.0)[:, None]  # or they are picked wrongly
    assert dots_loop.measure(rig, dataclasses.replace(dots, left=left))[0] == pytest.approx(T, abs=1e-12)
    assert dots.fitted.sum() == 50


def test_varied_by_nothing_is_the_same_rig() -> None:
    rig = make(0.1)
    same = dots_loop.varied(rig, np.zeros(15))
    assert same.T_right_left == pytest.approx(rig.T_right_left, abs=1e-12)
    assert same.left.camera_matrix == pytest.approx(rig.left.camera_matrix)


@pytest.fixture(scope="module")
def cylinder():
    folder = DATA / "dot_cylinder"
    if not folder.is_dir():
        pytest.skip(f"the public data set dot_cylinder is not in {DATA}; name its folder with LIVEDEFORM_DATA")
    dots = read_dots(folder)
    return dots, detected(dots)[0]


@pytest.mark.data
def test_a_distortion_that_is_not_applied_is_named(cylinder, tmp_path: Path) -> None:
    answer = dots_loop.ask(*cylinder, dots_loop.DROPPED, tmp_path, lambda text, fraction=None: None)
    names = [e.name for e in answer.result.effects]
    assert answer.result.verdict == "effect" and names == ["lens_distortion"]
    assert answer.k1 is not None
    assert answer.k1[0] == pytest.approx(answer.one_term, rel=0.05)  # measured 0.1169 for 0.1172
    assert answer.result.after.rmse < 0.25 * answer.result.before.rmse  # measured 0.154 of 0.977 mm


@pytest.mark.data
def test_a_calibration_without_distortion_hides_it_in_the_cameras(cylinder) -> None:
    dots, centroids = cylinder
    rig = dots_loop.calibrated_rig(dots, centroids, dots_loop.PINHOLE.model)
    shares = dots_loop.hidden_shares(rig, dots_loop.seen_by_both(dots, centroids))
    assert shares["both"] > 0.9  # measured 0.96
    assert shares["lens"] < 0.3 and shares["calibration"] < 0.3  # measured 0.15, 0.11
