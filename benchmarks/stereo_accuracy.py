"""How near the stereo measuring is to what the pictures' noise allows, as one table: goal, others, ours.

    python benchmarks/stereo_accuracy.py [--data DATA] [--presses 10] [--seed 1000] [--pictures DIR]
        [--only discs,tags,boards,phantom,internal,false,identities,checkerboard,dots,shipped] [--experiment FOLDER]

- checkerboard, dots: published pictures (``DATA``, or LIVEDEFORM_DATA), lengths and places that took no part in the
  calibration.
- discs: rendered, radius 5 px, contrast 120, noise 2 grey values: rms error of the centre over the Cramer-Rao bound of
  a disc of which all but one coordinate is known; OpenCV, scikit-image and trackpy (where they are installed) on the
  same pictures.
- tags: rendered AprilTags; OpenCV's sub-pixel corners and pupil-apriltags (where it is installed).
- boards: rendered boards in perspective: corners of a checkerboard and of ChArUco, circles' outlines; OpenCV's
  cornerSubPix, ChArUco detector and findCirclesGrid on the same pictures.
- phantom: a rendered dome (baseline 0.1 m, 0.4 m away, 1000 px) with discs that are flat, or painted on: scatter over
  what centres at the bound give through the same geometry, chi-square of the points against truth.
- internal: dark balls inside a transparent dome, ray-traced; their error as seen and corrected for refraction.
- false: published markers that are not where their name is, on textured grounds.
- identities: presses of 30 s (``--presses`` of them) that hide a third of 60
  markers.
- shipped: the shipped phantom's recordings (or ``--experiment``, what ``livedeform synth`` made with pictures), with
  the exact calibration, at rest and pressed; its truth is beside it. Errors of one marker are much the same in all
  pictures, so that the chi-square is as uncertain as that of the number of markers: that is stated.

One line per figure: what, goal, others, ours, n. ``--pictures`` keeps a picture of each rendered check, with what was
found drawn on it.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "stereo_node"))
from glass import measure_through_a_body
from press import simulate_press
from scene import (
    DOME,
    Look,
    disc_picture,
    dome_markers,
    looking_down,
    make_test_rig,
    photographed,
    render,
    tag_picture,
)

from livedeform.common.bags.recording import load_recording
from livedeform.common.experiment.yaml_file import load_experiment
from livedeform.common.frames import apply, inverse
from livedeform.common.types import Image
from livedeform.stereo_node.boards.boards import find_board
from livedeform.stereo_node.camera.triangulate import triangulate
from livedeform.stereo_node.detect.blobs import detect_blobs
from livedeform.stereo_node.detect.fiducials import detect_markers
from livedeform.stereo_node.detect.settings import DetectorSettings
from livedeform.stereo_node.pipeline import StereoTracker, TrackerSettings

ROOT = Path(__file__).parents[1]
Row = tuple[str, str, str, str, str]
PARTS = ("discs", "tags", "boards", "phantom", "internal", "false", "identities", "checkerboard", "dots", "shipped")
PICTURES: list[Path] = []  # the folder for them, if any
FIRST_SEED = [1000]  # of what is drawn at random: the tracker was tuned on smaller ones


def discs(n_pictures: int = 20, radius: float = 5.0, contrast: float = 120.0, noise: float = 2.0) -> Iterator[Row]:
    """rms centre error over the Cramer-Rao bound, ours and others'."""
    rng = np.random.default_rng(FIRST_SEED[0])
    others = {"SimpleBlobDetector": _opencv_blobs, "scikit-image": _skimage_blobs, "trackpy": _trackpy_blobs}
    errors: dict[str, list[np.ndarray]] = {"ours": [], **{name: [] for name in others}}
    chi2, bound = [], []
    for _ in range(n_pictures):
        grid = np.array([[60 + 50 * i, 60 + 50 * j] for j in range(6) for i in range(8)])
        centres = grid + rng.uniform(-1, 1, grid.shape)
        clean, information = disc_picture(centres, radius, 180.0, -contrast, 0.7, (500, 380))
        picture = np.clip(np.round(clean + rng.normal(0, noise, clean.shape)), 0, 255).astype(np.uint8)
        bound.append(noise / np.sqrt(information))
        blobs = detect_blobs(picture, DetectorSettings(polarity="dark", min_radius=3))
        rows = _nearest(blobs.centres, centres)
        errors["ours"].append(blobs.centres[rows] - centres)
        _keep("discs", picture, blobs.centres)
        chi2.append((errors["ours"][-1] ** 2 / blobs.covariances[rows][:, [0, 1], [0, 1]]).mean())
        for name, find in others.items():
            found = find(picture)
            if found is not None:
                errors[name].append(found[_nearest(found, centres)] - centres)
    limit = float(np.sqrt(np.mean(np.square(bound))))
    ratio = {name: float(np.sqrt(np.mean(np.square(e)))) / limit for name, e in errors.items() if e}
    theirs = ", ".join(f"{name} {ratio[name]:.2f}" for name in others if name in ratio)
    n = str(2 * sum(len(e) for e in errors["ours"]))
    yield f"discs: centre error / bound of {limit:.4f} px", "<= 1.5", theirs, f"{ratio['ours']:.2f}", n
    yield "discs: chi2 per coordinate", "0.9-1.1", "-", f"{np.mean(chi2):.2f}", n


def tags(n_pictures: int = 12) -> Iterator[Row]:
    """rms error of the middles of AprilTags (36h11) of 25 to 60 px."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    opencv = cv2.aruco.ArucoDetector(family, parameters)
    try:
        from pupil_apriltags import Detector

        apriltag = Detector(families="tag36h11", quad_decimate=1.0)
    except ImportError:
        apriltag = None
    errors: dict[str, list[np.ndarray]] = {"ours": [], "OpenCV, sub-pixel corners": [], "pupil-apriltags": []}
    chi2 = []
    for k in range(n_pictures):
        picture, truth = tag_picture(FIRST_SEED[0] + k)
        blobs = detect_markers(picture, DetectorSettings(type="apriltag"))
        _keep("tags", picture, blobs.centres)
        for centre, covariance, code in zip(blobs.centres, blobs.covariances, blobs.codes, strict=True):
            e = centre - truth[int(code)]
            errors["ours"].append(e)
            chi2.append(e @ np.linalg.inv(covariance) @ e / 2)
        corners, ids, _ = opencv.detectMarkers(picture)
        for quad, code in zip(corners, ids.ravel(), strict=True):
            a, b, c, d = quad.reshape(4, 2).astype(float)
            share = np.linalg.solve(np.stack([c - a, b - d], axis=1), b - a)[0]
            errors["OpenCV, sub-pixel corners"].append(a + share * (c - a) - truth[int(code)])
        for found in apriltag.detect(picture) if apriltag is not None else ():
            errors["pupil-apriltags"].append(found.center - 0.5 - truth[found.tag_id])  # it counts from pixels' corners
    rms = {name: float(np.sqrt(np.mean(np.square(e)))) for name, e in errors.items() if e}
    theirs = ", ".join(f"{name} {rms[name]:.3f}" for name in list(errors)[1:] if name in rms)
    n = str(2 * len(errors["ours"]))
    yield "tags: error of the middle, px", "-", theirs, f"{rms['ours']:.3f}", n
    yield "tags: chi2 per coordinate", "0.9-1.1", "-", f"{np.mean(chi2):.2f}", n


def boards(n_pictures: int = 20) -> Iterator[Row]:
    """rms error of boards' points, ours and OpenCV's."""
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 60, 1e-4)
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE

    def corner_sub_pix(picture: np.ndarray, size: tuple[int, int]) -> np.ndarray | None:
        found, corners = cv2.findChessboardCorners(picture, size, flags=flags)
        return cv2.cornerSubPix(picture, corners, (5, 5), (-1, -1), criteria).reshape(-1, 2) if found else None

    def circles_grid(picture: np.ndarray, size: tuple[int, int]) -> np.ndarray | None:
        found, centres = cv2.findCirclesGrid(picture, size, flags=cv2.CALIB_CB_SYMMETRIC_GRID)
        return centres.reshape(-1, 2) if found else None

    for kind, what, name, theirs in (
        ("checkerboard", "corner", "cornerSubPix", corner_sub_pix),
        ("charuco", "corner", "ChArUco detector", None),
        ("circles", "middle of the outline", "findCirclesGrid", circles_grid),
    ):
        ours_px, theirs_px = [], []
        for k in range(n_pictures):
            board, picture, truth = photographed(kind, FIRST_SEED[0] + k)
            view = find_board(picture, board)
            if view is not None:
                ours_px.append(_either_end(view.pixels, truth[view.rows]))
                _keep(f"board_{kind}", picture, view.pixels)
            if theirs is None:
                corners, ids, _, _ = cv2.aruco.CharucoDetector(board.charuco()).detectBoard(picture)
                found = (corners.reshape(-1, 2), truth[ids.ravel()]) if ids is not None else None
            else:
                pixels = theirs(picture, (board.columns, board.rows))
                found = None if pixels is None else (pixels, truth)
            if found is not None:
                theirs_px.append(_either_end(*found))
        rms = [float(np.sqrt(np.mean(np.concatenate(e) ** 2))) for e in (ours_px, theirs_px)]
        other = f"{name} {rms[1]:.3f} ({len(theirs_px)} of {n_pictures} found)"
        ours = f"{rms[0]:.3f} ({len(ours_px)} of {n_pictures} found)"
        yield f"boards: error of a {kind}'s {what}, px", "-", other, ours, str(2 * sum(len(e) for e in ours_px))


def _either_end(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """found - truth (n, 2) px, for a board that may be counted from its other end."""
    error, turned = found - truth, found[::-1] - truth
    return turned if (turned**2).sum() < (error**2).sum() else error


def internal(n_seeds: int = 5) -> Iterator[Row]:
    """Internal markers through a refracting surface."""
    seen, left = [], []
    for k in range(n_seeds):
        _, inside, as_seen, corrected = measure_through_a_body(
            FIRST_SEED[0] + k, lambda picture, pixels: _keep("internal", picture, pixels)
        )
        seen.append(as_seen[inside])
        left.append(corrected[inside])
    theirs = f"{1e3 * np.min(seen):.1f}-{1e3 * np.max(seen):.1f} mm uncorrected"
    ours = f"{1e3 * np.sqrt(np.mean(np.concatenate(left) ** 2)):.3f} mm rms"
    yield "internal markers 6-14 mm deep, n = 1.41: error", "-", theirs, ours, str(sum(len(x) for x in left))


def phantom(n_frames: int = 25, noise: float = 2.0) -> Iterator[Row]:
    """Scatter of 60 markers against the bound, and chi-square, for flat discs and painted ones."""
    rig, (markers, normals), T = make_test_rig(), dome_markers(60, seed=FIRST_SEED[0]), looking_down()
    for kind, body in (("flat", None), ("painted", DOME)):
        rng, look = np.random.default_rng(FIRST_SEED[0]), Look(noise=0, painted_on=body)
        clean = [render(rig, T, markers.points, normals, look, rng, side, rounded=False) for side in ("left", "right")]
        settings = TrackerSettings(detector=DetectorSettings(marker=kind))
        tracker = StereoTracker(rig, markers, settings, T_phantom_left=T)
        places = apply(inverse(T), markers.points)
        pixels = rig.project(places)[:2]
        covariances = [_bound(c, p, noise) for c, p in zip(clean, pixels, strict=True)]
        limit = np.einsum("nii->ni", triangulate(rig, *pixels, *covariances).covariances)
        errors, bounds, chi2 = [], [], []
        for k in range(n_frames):
            pictures = [np.clip(np.round(c + rng.normal(0, noise, c.shape)), 0, 255).astype(np.uint8) for c in clean]
            frame, _ = tracker.process(Image(k + 1, pictures[0]), Image(k + 1, pictures[1]))
            _keep(f"dome_{kind}", pictures[0], rig.project(apply(inverse(T), frame.points))[0])
            rows = frame.ids - markers.ids[0]
            e = frame.points - markers.points[rows]
            errors.append(e @ T[:3, :3])
            bounds.append(limit[rows])
            chi2.append(np.einsum("ni,nij,nj->n", e, np.linalg.inv(frame.covariances), e) / 3)
        e, b, n = np.concatenate(errors), np.concatenate(bounds), str(sum(len(x) for x in errors))
        sideways = np.sqrt(np.median(((e**2) / b)[:, :2]) / 0.4549)  # the median of chi-square, one degree of freedom
        depth = np.sqrt(np.median(e[:, 2] ** 2 / b[:, 2]) / 0.4549)
        rms = 1e6 * np.sqrt((e**2).mean(axis=0))
        what = f"rms {np.sqrt((rms[:2] ** 2).mean()):.1f} um sideways, {rms[2]:.1f} um in depth"
        yield f"phantom, {kind} discs: sideways / limit", "<= 1.5", "-", f"{sideways:.2f} ({what})", n
        yield f"phantom, {kind} discs: depth / limit", "<= 1.5", "-", f"{depth:.2f}", n
        yield f"phantom, {kind} discs: chi2 of points", "0.9-1.1", "-", f"{np.concatenate(chi2).mean():.2f}", n


def _bound(clean: np.ndarray, pixels: np.ndarray, noise: float) -> np.ndarray:
    """(n, 2, 2) px2: Cramer-Rao bound of a spot's place where all else is known, noise^2 (sum grad I grad I^T)^-1."""
    h, w = clean.shape
    spectrum = np.fft.fft2(clean)
    dx = np.fft.ifft2(2j * np.pi * np.fft.fftfreq(w)[None] * spectrum).real
    dy = np.fft.ifft2(2j * np.pi * np.fft.fftfreq(h)[:, None] * spectrum).real
    out = np.empty((len(pixels), 2, 2))
    for k, (u, v) in enumerate(pixels):
        x, y = round(float(u)), round(float(v))
        patch = np.s_[max(y - 10, 0) : y + 11, max(x - 10, 0) : x + 11]
        g = np.stack([dx[patch].ravel(), dy[patch].ravel()])
        out[k] = noise**2 * np.linalg.inv(g @ g.T + 1e-6 * np.eye(2))
    return out


def false_markers(n_scenes: int = 12, n_frames: int = 6) -> Iterator[Row]:
    """Published markers over 1 mm from where their name is, on grounds with texture of 12 grey values."""
    rig = make_test_rig()
    published = wrong = 0
    for scene in range(n_scenes):
        seed = FIRST_SEED[0] + scene
        (markers, normals), rng = dome_markers(60, seed=seed), np.random.default_rng(seed)
        T = looking_down(turn=float(rng.uniform(-3, 3)))
        look = Look(texture=12.0, grain=seed, noise=0, painted_on=DOME)
        clean = [render(rig, T, markers.points, normals, look, rng, side, rounded=False) for side in ("left", "right")]
        tracker = StereoTracker(rig, markers)
        for k in range(n_frames):
            pictures = [np.clip(np.round(c + rng.normal(0, 2, c.shape)), 0, 255).astype(np.uint8) for c in clean]
            frame, _ = tracker.process(Image(k + 1, pictures[0]), Image(k + 1, pictures[1]))
            _keep("texture", pictures[0], rig.project(apply(inverse(T), frame.points))[0])
            error = np.linalg.norm(frame.points - markers.points[frame.ids - markers.ids[0]], axis=1)
            published, wrong = published + len(error), wrong + int((error > 1e-3).sum())
    upper = 3.0 / published if wrong == 0 else (wrong + 2 * np.sqrt(wrong) + 2) / published  # 95 %
    ours = f"{wrong} (below {100 * upper:.2f} % by 95 %)"
    yield f"false markers on texture, {n_scenes} scenes", "< 0.1 %", "-", ours, str(published)


def identities(n_presses: int) -> Iterator[Row]:
    """Swaps and returns over presses."""
    results = [simulate_press(FIRST_SEED[0] + k, watch=_draw_press) for k in range(n_presses)]
    wrong, never = sum(r.wrong for r in results), sum(r.never for r in results)
    returns = np.concatenate([r.returns for r in results])
    hidden = np.mean([r.hidden_share for r in results])
    published = str(sum(r.published for r in results))
    yield f"identities: swaps in {n_presses} presses ({hidden:.0%} hidden)", "0", "-", str(wrong), published
    late = f"{returns.max()} at most, {never} never"
    yield "identities: frames until a marker is back", "<= 3", "-", late, str(len(returns))


def _draw_press(time: float, spots: np.ndarray, pixels: np.ndarray, covered: np.ndarray, out: np.ndarray) -> None:
    """Keeps a scheme of the first press when it is deepest: spots dark, covered markers as rings."""
    if not PICTURES or time < 4.0:
        return
    picture = np.full((720, 1280), 170, np.uint8)
    for u, v in spots:
        cv2.circle(picture, (round(16 * u), round(16 * v)), 80, 50, -1, cv2.LINE_AA, shift=4)
    for u, v in pixels[covered]:
        cv2.circle(picture, (round(16 * u), round(16 * v)), 80, 110, 1, cv2.LINE_AA, shift=4)
    _keep("identities", picture, pixels[out])


def checkerboard(data: Path) -> Iterator[Row]:
    """Leave one pair out of the published checkerboard, all 13 pairs and without the one that moved."""
    from livedeform.calibrating import length_table
    from livedeform.importing.board_pictures import picture_files
    from livedeform.stereo_node.boards.boards import Board
    from livedeform.stereo_node.boards.find_pairs import find_pairs
    from livedeform.stereo_node.calibrate.calibrate import calibrate

    folder = data / "stereo_checkerboard"
    board = Board("checkerboard", 9, 6, 0.025)
    pictures = picture_files(str(folder / "left??.jpg"), str(folder / "right??.jpg"))
    pairs = find_pairs(pictures, board)
    _keep("checkerboard", pictures[0][1], pairs[0].left.pixels)
    result = calibrate(pairs, board, (640, 480))
    everything = {r["n_squares"]: r for r in length_table(result.lengths)}
    inlying = {r["n_squares"]: r for r in length_table([x for x in result.lengths if not x.outlier])}
    for n, goal, plain in ((1, "<= 0.15", 0.206), (8, "<= 0.30", 0.407)):
        ours = f"{1e3 * everything[n]['sd']:.3f} mm; without left08 {1e3 * inlying[n]['sd']:.3f}"
        yield f"checkerboard: sd of {25 * n} mm", f"{goal} mm", f"OpenCV {plain} mm", ours, str(everything[n]["count"])
    inside = [abs(x.measured - x.printed) < 1.96 * x.sigma for x in result.lengths if not x.outlier]
    yield "checkerboard: 95 % intervals that hold", ">= 95 %", "-", f"{np.mean(inside):.1%}", str(len(inside))


def dots(data: Path) -> Iterator[Row]:
    """Leave one column out of the published dot cylinder."""
    from livedeform.studies.public.dots import detected, leave_one_column_out, read_dots

    published = read_dots(data / "dot_cylinder")
    centroids, _ = detected(published)
    seen = centroids[0].reshape(-1, 2)
    _keep("dots", published.pictures[0], seen[np.isfinite(seen).all(axis=1)])
    result = leave_one_column_out(published, centroids, "k1k2")
    n = str(len(result.errors))
    yield "dots: 3-D rms of a column left out", "<= 0.20 mm", "OpenCV 0.289 mm", f"{1e3 * result.rms:.3f} mm", n
    yield "dots: sd of the 12 mm spacing", "<= 0.03 mm", "OpenCV 0.031 mm", f"{1e3 * result.spacing_sd:.3f} mm", n


def shipped(folder: Path) -> Iterator[Row]:
    """The shipped phantom: points against truth, at rest and where the body has moved, by the registered cameras."""
    chi2, errors, moved, names = [], [], [], []
    for name in ("a", "b"):
        experiment = load_experiment(folder / "experiment", geometry=False)
        recording, truth = load_recording(folder / "bags" / name), np.load(folder / "truth" / f"{name}.npz")
        tracker = StereoTracker.from_experiment(experiment, rest_points=truth["rest"])
        row = {int(i): k for k, i in enumerate(experiment.markers.ids)}
        for left, right, true in zip(recording.left, recording.right, truth["markers"], strict=True):
            frame, _ = tracker.process(left, right)
            rows = np.array([row[int(i)] for i in frame.ids])
            if tracker.T_phantom_left is not None and np.abs(true - truth["rest"]).max() > 2e-3:
                places = apply(inverse(tracker.T_phantom_left), frame.points)
                _keep("soft_phantom_pressed", left.pixels, tracker.rig.project(places)[0])
            e = frame.points - true[rows]
            chi2.append(np.einsum("ni,nij,nj->n", e, np.linalg.inv(frame.covariances), e) / 3)
            errors.append((e**2).sum(axis=1))
            names.append(frame.ids)
            moved.append(np.linalg.norm(true[rows] - truth["rest"][rows], axis=1) > 1e-4)
    c, e, m, who = (np.concatenate(x) for x in (chi2, errors, moved, names))
    for what, part in (("at rest", ~m), ("pressed", m)):
        own = [c[part & (who == i)].mean() for i in np.unique(who[part])]
        sigma = np.std(own) / np.sqrt(len(own))
        rms, middle = 1e6 * np.sqrt(e[part].mean()), 1e6 * np.sqrt(np.median(e[part]))
        ours = f"{c[part].mean():.2f} +- {sigma:.2f} ({rms:.0f} um rms, {middle:.0f} median)"
        n = f"{part.sum()} of {len(own)} markers"
        yield f"{experiment.name}, {what}: chi2 of points", "0.9-1.1", "-", ours, n


def _keep(name: str, picture: np.ndarray, centres: np.ndarray) -> None:
    """The first picture of this name, with crosses where markers were found."""
    if not PICTURES or (PICTURES[0] / f"{name}.png").exists():
        return
    shown = cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR)
    for u, v in centres:
        place = round(16 * float(u)), round(16 * float(v))
        for dx, dy in ((64, 0), (0, 64)):
            ends = (place[0] - dx, place[1] - dy), (place[0] + dx, place[1] + dy)
            cv2.line(shown, *ends, (40, 160, 255), 1, cv2.LINE_AA, shift=4)
    PICTURES[0].mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(PICTURES[0] / f"{name}.png"), shown)


def _opencv_blobs(picture: np.ndarray) -> np.ndarray | None:
    return np.array([k.pt for k in cv2.SimpleBlobDetector_create().detect(picture)])


def _skimage_blobs(picture: np.ndarray) -> np.ndarray | None:
    """Otsu's threshold and the intensity-weighted centroids of regions, a common way with scikit-image."""
    try:
        from skimage.filters import threshold_otsu
        from skimage.measure import label, regionprops
    except ImportError:
        return None
    ink = 255.0 - picture
    near = cv2.dilate((picture < threshold_otsu(picture)).astype(np.uint8), np.ones((5, 5), np.uint8))
    regions = regionprops(label(near), intensity_image=ink - np.median(ink))
    return np.array([r.centroid_weighted[::-1] for r in regions if r.area > 30])


def _trackpy_blobs(picture: np.ndarray) -> np.ndarray | None:
    """trackpy.locate (Crocker & Grier 1996)."""
    try:
        import trackpy
    except ImportError:
        return None
    trackpy.quiet()
    found = trackpy.locate(picture, 15, invert=True, minmass=2000)
    return found[["x", "y"]].to_numpy()


def _nearest(found: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    return np.linalg.norm(found[:, None] - wanted[None], axis=2).argmin(axis=0)


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("LIVEDEFORM_DATA", "../shared/data")))
    parser.add_argument("--only", default=",".join(PARTS))
    parser.add_argument("--presses", type=int, default=10)
    parser.add_argument("--seed", type=int, default=FIRST_SEED[0], help="of what is drawn at random")
    parser.add_argument("--pictures", type=Path)
    parser.add_argument("--experiment", type=Path, default=ROOT / "bags" / "breast_phantom")
    options = parser.parse_args()
    FIRST_SEED[0] = options.seed
    PICTURES.extend([options.pictures] if options.pictures else [])
    parts: dict[str, Callable[[], Iterator[Row]]] = {
        "discs": discs,
        "tags": tags,
        "boards": boards,
        "phantom": phantom,
        "internal": internal,
        "false": false_markers,
        "identities": lambda: identities(options.presses),
        "checkerboard": lambda: checkerboard(options.data),
        "dots": lambda: dots(options.data),
        "shipped": lambda: shipped(options.experiment),
    }
    print(f"{'what':52} {'goal':12} {'others':58} {'ours':52} n")
    for name in options.only.split(","):
        if name in ("checkerboard", "dots") and not options.data.is_dir():
            print(f"{name}: no data; give --data")
            continue
        for what, goal, others, ours, n in parts[name]():
            print(f"{what:52} {goal:12} {others:58} {ours:52} {n}", flush=True)


if __name__ == "__main__":
    main()
