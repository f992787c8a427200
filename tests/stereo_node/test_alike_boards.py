"""Boards that look alike from two or four sides: pairs count them from one end, markers are never turned, and one wrong
pair does not bend the middles of circles in the others."""

import cv2
import numpy as np
import pytest
from scene import make_test_rig
from scipy.spatial.transform import Rotation

from livedeform.common.errors import CalibrationError
from livedeform.common.experiment.surface import Surface
from livedeform.common.experiment.yaml_file import Markers
from livedeform.common.frames import apply, inverse, transform
from livedeform.common.types import Image
from livedeform.stereo_node.boards.boards import Board, BoardView, Pair
from livedeform.stereo_node.boards.find_pairs import find_pairs
from livedeform.stereo_node.calibrate.calibrate import calibrate
from livedeform.stereo_node.detect.settings import DetectorSettings
from livedeform.stereo_node.discs.outlines import area_centre
from livedeform.stereo_node.pipeline import StereoTracker, TrackerSettings
from livedeform.stereo_node.track.register import RegistrationError, register, register_either_way, register_named
from livedeform.stereo_node.track.sides import outward_side

SQUARE, PX = 0.015, 40  # m, fine pixels
UP = np.array([0.0, 0.0, 1.0])
RIG = make_test_rig(960, 720, 800.0, 0.1)


def flat(board: Board) -> np.ndarray:
    """A board's own picture, with two squares of margin; its first point is ``2 * PX`` from the corner."""
    w, h = np.round(board.points[-1, :2] / SQUARE + 4).astype(int) * PX
    picture = np.full((h, w), 230, np.uint8)
    if "circles" in board.kind:
        for x, y in board.points[:, :2] / SQUARE + 2:
            cv2.circle(picture, (round(x * PX), round(y * PX)), 12, 25, -1, cv2.LINE_AA)
    else:
        for j, i in np.argwhere(np.add.outer(np.arange(board.rows + 1), np.arange(board.columns + 1)) % 2 == 0):
            picture[(j + 1) * PX : (j + 2) * PX, (i + 1) * PX : (i + 2) * PX] = 25
    return picture


def seen(board: Board, T_left_board: np.ndarray) -> list[np.ndarray]:
    """The board in the left and the right picture (OpenCV's warp)."""
    first = 2 * PX - (0.0 if "circles" in board.kind else 0.5)  # edges are between fine pixels
    to_board = np.linalg.inv([[PX / SQUARE, 0, first], [0, PX / SQUARE, first], [0, 0, 1]])
    out = []
    for camera, T in ((RIG.left, T_left_board), (RIG.right, RIG.T_right_left @ T_left_board)):
        H = camera.camera_matrix @ T[:3, [0, 1, 3]] @ to_board
        size = (camera.width, camera.height)
        picture = cv2.warpPerspective(flat(board), H, size, flags=cv2.INTER_AREA, borderValue=120)
        out.append(cv2.GaussianBlur(picture, (0, 0), 0.8))
    return out


def poses(board: Board, n: int, seed: int) -> list[np.ndarray]:
    """T_left_board (n, 4, 4): tilted by up to 0.5 rad, and turned anyhow in its plane."""
    rng, out = np.random.default_rng(seed), []
    for turn in np.linspace(-np.pi, np.pi, n, endpoint=False):
        R = (Rotation.from_euler("xy", rng.uniform(-0.5, 0.5, 2)) * Rotation.from_euler("z", turn)).as_matrix()
        out.append(transform(R, rng.uniform([0.04, -0.01, 0.44], [0.06, 0.01, 0.46]) - R @ board.points.mean(axis=0)))
    return out


FACES = (("circles", 7, 6), ("circles", 6, 6), ("checkerboard", 8, 6), ("acircles", 4, 10), ("acircles", 4, 9))


@pytest.mark.parametrize(("kind", "columns", "rows"), FACES)
def test_both_pictures_count_from_one_end(kind: str, columns: int, rows: int):
    """And from the front: OpenCV counts grids of circles mirrored in 9 of 24 pictures, in one of a pair at times,
    and every second row of an asymmetric one before the one above it."""
    board = Board(kind, columns, rows, SQUARE)
    pairs = find_pairs([(str(k), *seen(board, T)) for k, T in enumerate(poses(board, 10, 0))], board)
    assert len(pairs) == 10
    for pair, T in zip(pairs, poses(board, 10, 0), strict=True):
        ways = []
        for view, camera, to in ((pair.left, RIG.left, np.eye(4)), (pair.right, RIG.right, RIG.T_right_left)):
            X = apply(to @ T, board.points)
            truth = (X / X[:, 2:]) @ camera.camera_matrix[:2].T
            errors = [np.linalg.norm(view.pixels - truth[turn[view.rows]], axis=1).mean() for turn in board.turns]
            assert min(errors) < 0.5  # px; measured 0.14
            ways.append(int(np.argmin(errors)))
        assert ways[0] == ways[1]


def circles(n: int, turned: int | None) -> tuple[Board, list[Pair]]:
    """Exact outlines (OpenCV projects 200 points of every rim) of circles of 5 mm; ``turned``: a pair whose right
    picture counts from the other end."""
    board, rng, pairs = Board("circles", 7, 5, 0.02), np.random.default_rng(5), []
    angle = 2 * np.pi * np.arange(200) / 200
    rim = 0.005 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    for k in range(n):
        R = Rotation.from_euler("xyz", rng.uniform([-0.6, -0.6, -0.3], [0.6, 0.6, 0.3])).as_matrix()
        T = transform(R, rng.uniform([0.02, -0.02, 0.3], [0.06, 0.02, 0.4]) - R @ board.points.mean(axis=0))
        views = []
        for camera, to_camera in ((RIG.left, np.eye(4)), (RIG.right, RIG.T_right_left)):
            X = apply(to_camera @ T, (board.points[:, None] + rim).reshape(-1, 3))
            px, _ = cv2.projectPoints(X, np.zeros(3), np.zeros(3), camera.camera_matrix, camera.dist_coeffs)
            outlines = px.reshape(-1, 200, 2)
            middles = area_centre(outlines)
            offset = outlines - middles[:, None]
            values, axes = np.linalg.eigh(2 * np.einsum("nki,nkj->nij", offset, offset) / 200)
            shapes = axes @ (values[:, :, None] ** -0.5 * np.swapaxes(axes, 1, 2))
            views.append(BoardView(np.arange(35), middles + rng.normal(0, 0.01, middles.shape), shapes))
        if k == turned:
            views[1] = BoardView(np.arange(35), views[1].pixels[::-1], views[1].shapes[::-1])
        pairs.append(Pair(str(k), *views))
    return board, pairs


@pytest.mark.slow
def test_an_outlier_does_not_bend_the_middles_of_the_others():
    """They are taken anew without it: the baseline came out 529 mm too long."""
    board, pairs = circles(14, turned=3)
    found = calibrate(pairs, board, (960, 720))
    baseline, sigma = found.parameters["baseline"]
    assert [name for name, _ in found.outliers] == ["3"]
    assert abs(baseline - RIG.baseline) < 3 * sigma < 1e-4  # m; measured 0.009 mm, sigma 0.007 mm
    assert found.reprojection_rms_px < 0.02  # measured 0.0136; the noise is 0.014


def test_pictures_that_give_no_calibration_are_refused():
    """Half of the pairs are of two moments."""
    board, pairs = circles(8, turned=None)
    mixed = [Pair(p.name, p.left, pairs[(k + 2) % 8].right if k % 2 else p.right) for k, p in enumerate(pairs)]
    with pytest.raises(CalibrationError, match=r"give no calibration: the corners are .* px rms from"):
        calibrate(mixed, board, (960, 720))


def looking_at_the_middle(azimuth: float) -> np.ndarray:
    """T_left_phantom of a camera 0.4 m away, 60 degrees above the plane z = 0."""
    a, e = np.radians(azimuth), np.radians(60)
    c = 0.4 * np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    z = -c / np.linalg.norm(c)
    x = np.cross(z, [0, 0, 1.0]) / np.linalg.norm(np.cross(z, [0, 0, 1.0]))
    R = np.stack([x, np.cross(z, x), z])
    return transform(R, -R @ c + [0.05, 0, 0])


BOARDS = (("checkerboard", 8, 6), ("circles", 8, 6), ("circles", 6, 6), ("checkerboard", 9, 6))


@pytest.mark.parametrize(("kind", "columns", "rows"), BOARDS)
def test_markers_of_a_board_are_never_turned(kind: str, columns: int, rows: int):
    """By +3 mm along x: it was -3 mm from three sides of five, with level ok. Without the cameras' pose a board that
    looks alike from two sides is refused."""
    board, down = Board(kind, columns, rows, SQUARE), np.diag([1.0, -1.0, -1.0])
    detector = DetectorSettings(type="circle_grid" if kind == "circles" else kind, board=f"{columns}x{rows}")
    T = transform(down, -down @ board.points.mean(axis=0))  # T_phantom_board
    points = apply(T, board.points)
    n = len(points)
    markers = Markers(np.arange(n, dtype=np.uint32), points, np.full(n, np.nan), np.array(["surface"] * n))
    for azimuth in (0, 45, 180):
        T_left_phantom = looking_at_the_middle(azimuth)
        given = StereoTracker(RIG, markers, TrackerSettings(detector=detector), T_phantom_left=inverse(T_left_phantom))
        found = StereoTracker(RIG, markers, TrackerSettings(detector=detector), outward=UP)
        for k, x in enumerate((0.0, 0.003)):
            pair = [
                Image(10**9 + k * 33_000_000, p)
                for p in seen(board, T_left_phantom @ transform(np.eye(3), [x, 0, 0]) @ T)
            ]
            for tracker in (given, found):
                frame, status = tracker.process(*pair)
                if tracker is found and not board.oriented:
                    assert status.level == "error" and "looks alike from two sides" in status.message
                    continue
                assert status.level == "ok" and len(frame.ids) == n
                error = frame.points - points[frame.ids] - [x, 0, 0]
                assert np.linalg.norm(error.mean(axis=0)) < 5e-5  # m; measured 2.7e-5
                assert np.abs(error).max() < 5e-4  # m; measured 2.8e-4


@pytest.mark.parametrize(("columns", "rows"), [(9, 6), pytest.param(6, 9, marks=pytest.mark.slow)])
@pytest.mark.parametrize("natural", [False, True])
def test_a_press_goes_into_the_body_however_a_board_is_numbered(columns: int, rows: int, natural: bool):
    """By -3 mm along z it was +3 mm, with level ok, of places that run to the right and up with z up: a flat pattern
    fits mirrored as a half turn out of its plane. The side that the cameras see decides."""
    board, down = Board("checkerboard", columns, rows, SQUARE), np.diag([1.0, -1.0, -1.0])
    detector = TrackerSettings(detector=DetectorSettings(type="checkerboard", board=f"{columns}x{rows}"))
    T = transform(down, -down @ board.points.mean(axis=0))  # T_phantom_board
    places = apply(T, board.points)[board.mirrored[0] if natural else slice(None)]
    n = len(places)
    markers = Markers(np.arange(n, dtype=np.uint32), places, np.full(n, np.nan), np.array(["surface"] * n))
    for azimuth in (0, 200):
        T_left_phantom = looking_at_the_middle(azimuth)
        given = StereoTracker(RIG, markers, detector, T_phantom_left=inverse(T_left_phantom))
        found, blind = StereoTracker(RIG, markers, detector, outward=UP), StereoTracker(RIG, markers, detector)
        for k, moved in enumerate(([0, 0, 0], [0, 0, -0.003], [0.002, 0.001, -0.003])):
            pictures = seen(board, T_left_phantom @ transform(np.eye(3), moved) @ T)
            pair = [Image(10**9 + k * 33_000_000, picture) for picture in pictures]
            for tracker in (given, found):
                frame, status = tracker.process(*pair)
                assert status.level == "ok" and len(frame.ids) == n
                error = (frame.points - places[frame.ids]).mean(axis=0) - moved
                assert np.linalg.norm(error) < 1e-4  # m; measured 4e-5
            _, status = blind.process(*pair)
            assert status.level == "error" and "which side of it is out of the body is not known" in status.message


def test_places_of_flat_dots_that_are_mirrored_are_refused():
    """An axis that runs the wrong way fits as a half turn: the cameras came out below the body, with level ok."""
    rng = np.random.default_rng(0)
    places = np.column_stack([rng.uniform(-0.04, 0.04, (20, 2)), rng.normal(0, 5e-5, 20)])
    points = apply(looking_at_the_middle(0), places) + rng.normal(0, 2e-5, places.shape)
    noise = np.tile(np.eye(3) * 4e-10, (20, 1, 1))
    found = register(points, noise, places, 1e-3, outward=UP)
    assert np.allclose(found.T_phantom_left, inverse(looking_at_the_middle(0)), atol=1e-3)  # measured 3e-4
    for axis in range(2):
        mirrored = places * np.where(np.arange(3) == axis, -1, 1)
        with pytest.raises(RegistrationError, match="only as seen from inside the body"):
            register(points, noise, mirrored, 1e-3, outward=UP)
        rows = np.arange(20)
        with pytest.raises(RegistrationError, match="only as seen from inside the body"):
            register_either_way(points, noise, mirrored, [rows], 6e-3, outward=UP)


def test_flat_dots_that_are_their_own_mirror_image_are_known_by_the_side():
    """A triangle and its mirror image fit in two ways, of which the cameras see one."""
    half = np.array([[0.0, 0.03, 0], [0.01, 0.02, 0], [0.02, -0.01, 0], [0.035, -0.03, 0]])
    places = np.vstack([half, half[1:] * [-1, 1, 1]])
    points, noise = apply(looking_at_the_middle(0), places), np.tile(np.eye(3) * 4e-10, (7, 1, 1))
    with pytest.raises(RegistrationError, match="fits in two ways"):
        register(points, noise, places, 1e-3)
    found = register(points, noise, places, 1e-3, outward=UP)
    np.testing.assert_array_equal(found.marker_rows[np.argsort(found.point_rows)], np.arange(7))


def block(width: float, thick: float) -> Surface:
    """A block from the origin on, ``width`` m along x and y and ``thick`` m along z."""
    corners = np.array([[x, y, z] for x in (0, width) for y in (0, width) for z in (0, thick)])
    faces = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    return Surface(corners, np.array([t for a, b, c, d in faces for t in ((a, b, c), (a, c, d))]))


@pytest.mark.parametrize("thick", [0.002, 0.05])
def test_the_bodys_surface_tells_its_side(thick: float):
    body = block(0.1, thick)
    assert np.isclose(body.volume, 0.01 * thick)  # outward
    x, y = np.meshgrid([0.02, 0.05, 0.08], [0.02, 0.05, 0.08])
    for z, out in ((thick + 3e-4, 1.0), (thick - 3e-4, 1.0), (2e-4, -1.0)):  # declared beside the surface
        side = outward_side(body, np.column_stack([x.ravel(), y.ravel(), np.full(9, z)]))
        np.testing.assert_allclose(side, out * UP, atol=1e-9)
    assert outward_side(body, np.column_stack([x.ravel() + 0.3, y.ravel(), np.full(9, thick)])) is None


@pytest.mark.parametrize(("width", "off"), [(0.06, 0.0032), (0.1, 0.00635), (0.06, 0.02)])
def test_the_side_of_balls_and_pins_that_stand_off_the_body_is_known(width: float, off: float):
    """Their middles lie farther from the surface than a part of the body's size."""
    body = block(width, 0.05)
    x, y = (a.ravel() for a in np.meshgrid(width * np.linspace(0.05, 0.95, 5), width * np.linspace(0.05, 0.95, 5)))
    for z, out in ((0.05 + off, 1.0), (-off, -1.0)):
        np.testing.assert_allclose(outward_side(body, np.column_stack([x, y, np.full(25, z)])), out * UP, atol=1e-9)


def test_the_side_of_beads_amid_the_body_is_not_known_nor_that_of_markers_beside_it():
    """Cameras may see either through it: nothing is guessed."""
    body = block(0.06, 0.05)
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(0.01, 0.05, 5), np.linspace(0.01, 0.05, 5)))
    for z in (0.025, 0.03, 0.015):
        assert outward_side(body, np.column_stack([x, y, np.full(25, z)])) is None
    for z in (0.0, 0.03, 0.05):  # on the table, on a stand
        assert outward_side(body, np.column_stack([x + 0.1, y, np.full(25, z)])) is None


@pytest.mark.parametrize("off", [0.008, 0.02])
def test_a_given_pose_that_is_wrong_is_named_where_pictures_name_the_markers(off: float):
    """By 20 mm: all markers were 19.99 mm beside their places, with level ok."""
    board, down = Board("checkerboard", 9, 6, SQUARE), np.diag([1.0, -1.0, -1.0])
    T = transform(down, -down @ board.points.mean(axis=0))
    places, T_left_phantom = apply(T, board.points), looking_at_the_middle(0)
    markers = Markers(np.arange(54, dtype=np.uint32), places, np.full(54, np.nan), np.array(["surface"] * 54))
    detector = TrackerSettings(detector=DetectorSettings(type="checkerboard", board="9x6"))
    pair = [Image(10**9, picture) for picture in seen(board, T_left_phantom @ T)]
    wrong = transform(np.eye(3), np.array([off, 0.0, 0.0])) @ inverse(T_left_phantom)
    frame, status = StereoTracker(RIG, markers, detector, T_phantom_left=wrong).process(*pair)
    assert status.level == "error" and len(frame.ids) == 0
    assert f"{off * 1e3:.0f}.0 mm (median) from where they should be; check the given pose" in status.message


def test_a_board_on_a_body_that_is_not_symmetric_is_registered():
    """What looks alike in pictures need not lie alike: printed on a slope it fits one way."""
    board = Board("circles", 7, 5, 0.01)
    places = board.points + [[0, 0, 0.3 * x**2 / 0.06 + 0.1 * y] for x, y, _ in board.points]
    R = Rotation.from_euler("xyz", [0.2, 0.1, 2.0]).as_matrix()
    points = apply(transform(R, [0.1, 0.0, 0.4]), places) + np.random.default_rng(0).normal(0, 2e-5, places.shape)
    noise = np.tile(np.eye(3) * 4e-10, (35, 1, 1))
    for turn in board.turns:
        ways = [way[turn] for way in board.turns]
        found = register_either_way(points, noise, places, ways, 5e-3)
        np.testing.assert_array_equal(found.marker_rows, np.arange(35))
        assert found.rms < 1e-4  # m; measured 3.2e-5
    with pytest.raises(
        RegistrationError, match="looks alike from two sides, and fits its places both ways; use a chec"
    ):
        register_either_way(points, noise, board.points, board.turns, 2e-2, outward=-UP)


@pytest.mark.parametrize("seen_rows", [np.arange(3), np.arange(7), np.array([0, 8, 16])])
def test_corners_on_a_line_leave_open_how_the_cameras_are_turned(seen_rows):
    places = Board("checkerboard", 7, 5, SQUARE).points  # a line of corners of a board that is half covered
    T = transform(Rotation.from_rotvec([0.4, -0.2, 0.9]).as_matrix(), np.array([0.05, 0.0, 0.45]))
    points, noise = apply(T, places[seen_rows]), np.tile(np.eye(3) * 1e-10, (len(seen_rows), 1, 1))
    with pytest.raises(RegistrationError, match=f"the {len(points)} coded markers .* lie on a line"):
        register_named(points, noise, places[seen_rows], seen_rows, seen_rows, 2e-3)
