"""How well a stereo calibration measures on pictures that it has not seen, beside plain OpenCV, as one table.

    python -m benchmarks.stereo_calibration [--data DATA] [--splits 5] [--seed 1]
        [--only stereo_checkerboard,charuco_wide,laparoscope_boards,drawn_whole,drawn_weak] [--json FILE]

Every set of pairs is split at random into two halves, ``--splits`` times; either half is calibrated, and known lengths
are measured on the other one; of fewer than eight pairs (laparoscope_boards), each is measured by the others, and
calibrations that share most pictures are compared (and with the baseline that its owners state). Published sets come
from ``DATA`` (or LIVEDEFORM_DATA); the drawn ones are exact projections with noise (a lens with a prism term that no
model of ours has; a print with errors of 0.05 mm), of boards all over the field, or of few and nearly parallel ones.

OpenCV is findChessboardCorners with cornerSubPix, or CharucoDetector, calibrateCamera and stereoCalibrate, and
triangulatePoints: of its variants (window of 5 or 11 px, five coefficients or the rational model, intrinsics held or
refined) the one with the smallest standard deviation of one square is shown, which favours it. A pair in which its
detector misses the board is measured by ours alone; lengths that both measure are compared (``n``).

One line per set and length: sd and worst error of ours and OpenCV's on the same lengths (mm), how many of our 95 %
intervals hold; then per set: fx (both cameras) and the baseline of the two halves of each split against each other (and
against truth, where it is known) in units of their 95 % intervals, and the time of finding and calibrating all pairs.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from livedeform.common.frames import apply, transform
from livedeform.importing.board_pictures import Pictures, picture_files
from livedeform.stereo_node.boards.boards import Board, BoardView, Pair
from livedeform.stereo_node.boards.find_pairs import find_pairs
from livedeform.stereo_node.calibrate.calibrate import Calibration, calibrate
from livedeform.stereo_node.calibrate.known_lengths import lengths_of, told

LENGTHS = (1, 8)
Views = dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]  # pair: rows, left and right pixels
Key = tuple[int, str, int, int]  # which calibration, pair, two rows


@dataclass
class Set:
    """Pairs of a board as ours and as OpenCV's variants find them; truth where it is known."""

    name: str
    board: Board
    size: tuple[int, int]
    ours: list[Pair]
    opencv: dict[str, Views]
    seconds: float
    truth: dict[str, float] = field(default_factory=dict)


PUBLIC = {
    "stereo_checkerboard": ("left??.jpg", "right??.jpg", Board("checkerboard", 9, 6, 0.025)),
    "charuco_wide": ("left_*.png", "right_*.png", Board("charuco", 31, 16, 0.04933, 0.03846, "DICT_4X4_250")),
    "laparoscope_boards": ("left_*.png", "right_*.png", Board("checkerboard", 14, 10, 0.003)),
}


STATED = {"laparoscope_boards": {"baseline": 4.66e-3}}  # by its owners


def public(name: str, data: Path) -> Set:
    """A published set."""
    left, right, board = PUBLIC[name]
    pictures = picture_files(str(data / name / left), str(data / name / right))
    since = time.process_time()
    pairs = find_pairs(pictures, board)
    seconds = time.process_time() - since
    if board.kind == "charuco":
        opencv = {"charuco": _opencv_charuco(pictures, board)}
    else:
        opencv = {f"window {n}": _opencv_corners(pictures, board, n) for n in (5, 11)}
    size = pictures[0][1].shape[1], pictures[0][1].shape[0]
    return Set(name, board, size, pairs, opencv, seconds, STATED.get(name, {}))


def _opencv_corners(pictures: Pictures, board: Board, window: int) -> Views:
    criteria, out = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 1e-3), {}
    for name, *both in pictures:
        seen = []
        for picture in both:
            found, corners = cv2.findChessboardCorners(picture, (board.columns, board.rows))
            if found:
                refined = cv2.cornerSubPix(picture, corners, (window, window), (-1, -1), criteria)
                seen.append(refined.reshape(-1, 2).astype(float))
        if len(seen) == 2:
            a, b = seen
            if not board.oriented and (a[-1] - a[0]) @ (b[-1] - b[0]) < 0:
                b = b[::-1]
            out[name] = np.arange(len(a)), a, b
    return out


def _opencv_charuco(pictures: Pictures, board: Board) -> Views:
    detector, out = cv2.aruco.CharucoDetector(board.charuco()), {}
    for name, *both in pictures:
        found = [detector.detectBoard(p)[:2] for p in both]
        if all(ids is not None and len(ids) >= 6 for _, ids in found):
            rows, left, right = np.intersect1d(found[0][1].ravel(), found[1][1].ravel(), return_indices=True)
            out[name] = rows, *(found[k][0].reshape(-1, 2)[at].astype(float) for k, at in ((0, left), (1, right)))
    return out


def drawn(name: str, rng: np.random.Generator, n: int = 14, sigma: float = 0.08) -> Set:
    """Exact projections with noise: ``drawn_whole`` fills the field, ``drawn_weak`` is small and hardly tilted."""
    board, size = Board("checkerboard", 9, 6, 0.025), (1280, 960)
    whole = name == "drawn_whole"
    tilt, wide = (0.6, 0.11) if whole else (0.12, 0.02)
    print_error = np.append(rng.normal(0, 5e-5, (54, 2)), np.zeros((54, 1)), axis=1)
    K = np.array([[1060.0, 0, 645], [0, 1062, 475], [0, 0, 1]])
    lens = np.array([-0.26, 0.10, 8e-4, -6e-4, -0.02, 0, 0, 0, 1.5e-3, 0, -1e-3, 0])
    R = Rotation.from_rotvec([0.01, 0.15, -0.005]).as_matrix()
    to_right = transform(R, R @ np.array([-0.083, 0.001, 0.002]))
    views: Views = {}
    while len(views) < n:
        Rb = Rotation.from_euler("xyz", rng.uniform([-tilt, -tilt, -0.3], [tilt, tilt, 0.3])).as_matrix()
        middle = np.array([0.04, 0.0, 0.4]) + rng.uniform(-1, 1, 3) * [wide, 0.7 * wide, 0.1 if whole else 0.02]
        T = transform(Rb, middle - Rb @ board.points.mean(axis=0))
        seen = [
            cv2.projectPoints(apply(E @ T, board.points + print_error), np.zeros(3), np.zeros(3), K, lens)[0]
            for E in (np.eye(4), to_right)
        ]
        a, b = (p.reshape(-1, 2) + rng.normal(0, sigma, (54, 2)) for p in seen)
        if all((p > 0).all() and (p < size).all() for p in (a, b)):
            views[f"{len(views):02d}"] = np.arange(54), a, b
    pairs = [Pair(k, BoardView(rows, a), BoardView(rows, b)) for k, (rows, a, b) in views.items()]
    truth = {"left.fx": 1060.0, "right.fx": 1060.0, "baseline": float(np.linalg.norm(to_right[:3, 3]))}
    return Set(name, board, size, pairs, {"exact": views}, 0.0, truth)


def splits(n: int, count: int, rng: np.random.Generator) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Random halves of n pairs; of fewer than eight, whose halves the command refuses, each pair and the others."""
    if n < 8:
        for i in range(n):
            yield np.delete(np.arange(n), i), np.array([i])
        return
    for _ in range(count):
        order = rng.permutation(n)
        yield np.sort(order[: (n + 1) // 2]), np.sort(order[(n + 1) // 2 :])


def opencv_calibration(points: np.ndarray, views: Views, names: Sequence[str], size: Any, flags: int, refine: bool):
    """Plain OpenCV: camera matrices, distortions, rotation and translation; None where it fails."""
    chosen = [views[n] for n in names if n in views]
    objects = [points[rows].astype(np.float32) for rows, _, _ in chosen]
    pixels = [[v[side].astype(np.float32) for v in chosen] for side in (1, 2)]
    try:
        singles = [cv2.calibrateCamera(objects, p, size, None, None, flags=flags) for p in pixels]
        more = cv2.CALIB_USE_INTRINSIC_GUESS if refine else cv2.CALIB_FIX_INTRINSIC
        out = cv2.stereoCalibrate(
            objects, *pixels, singles[0][1], singles[0][2], singles[1][1], singles[1][2], size, flags=flags | more
        )
    except cv2.error:
        return None
    return out[1:7]


def opencv_points(rig: Any, left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Triangulated points (n, 3) m."""
    K1, d1, K2, d2, R, t = rig
    a, b = cv2.undistortPoints(left.reshape(-1, 1, 2), K1, d1), cv2.undistortPoints(right.reshape(-1, 1, 2), K2, d2)
    X = cv2.triangulatePoints(np.eye(3, 4), np.hstack([R, t]), a.reshape(-1, 2).T, b.reshape(-1, 2).T)
    return (X[:3] / X[3]).T


def opencv_errors(s: Set, halves: Sequence[tuple[list[str], list[str]]]) -> tuple[str, dict[Key, float]]:
    """Errors of lengths by the best variant, and its name."""
    best: tuple[float, str, dict[Key, float]] = (np.inf, "", {})
    models = {"5 coefficients": 0, "rational": cv2.CALIB_RATIONAL_MODEL}
    for (corners, views), (model, flags), refine in itertools.product(s.opencv.items(), models.items(), (False, True)):
        errors: dict[Key, float] = {}
        for k, (inside, outside) in enumerate(halves):
            rig = opencv_calibration(s.board.points, views, inside, s.size, flags, refine)
            for name in (n for n in outside if rig is not None and n in views):
                rows, left, right = views[name]
                errors |= _errors(k, name, rows, opencv_points(rig, left, right), s.board)
        one = [e for key, e in errors.items() if _squares(key, s.board) == 1]
        if one and np.std(one) < best[0]:
            label = f"{corners}, {model}, {'refined' if refine else 'held'}"
            best = float(np.std(one)), label, errors
    return best[1], best[2]


def _errors(k: int, name: str, rows: np.ndarray, X: np.ndarray, board: Board) -> dict[Key, float]:
    places = board.points[rows]
    out = {}
    for i, j in zip(*np.triu_indices(len(rows), 1), strict=True):
        d = np.abs(places[j] - places[i]) / board.square
        if min(d[0], d[1]) < 1e-6 and round(d.sum()) in LENGTHS:
            true = float(np.linalg.norm(places[j] - places[i]))
            out[k, name, int(rows[i]), int(rows[j])] = float(np.linalg.norm(X[j] - X[i])) - true
    return out


def _squares(key: Key, board: Board) -> int:
    P = board.points
    return round(float(np.abs(P[key[3]] - P[key[2]]).sum()) / board.square)


def our_errors(
    s: Set, halves: Sequence[tuple[list[str], list[str]]]
) -> tuple[dict[Key, tuple[float, bool]], list[Calibration | None], int]:
    """Errors of lengths with whether their interval holds, the calibrations (None: refused), and how many corners they
    leave out because they do not tell the lens there."""
    by_name = {p.name: p for p in s.ours}
    errors: dict[Key, tuple[float, bool]] = {}
    results: list[Calibration | None] = []
    beyond = 0
    for k, (inside, outside) in enumerate(halves):
        try:
            result = calibrate([by_name[n] for n in inside if n in by_name], s.board, s.size)
        except Exception as error:  # a benchmark counts what fails
            print(f"{s.name}: {type(error).__name__}: {error}", flush=True)
            results.append(None)
            continue
        results.append(result)
        for pair in (by_name[n] for n in outside if n in by_name):
            of_pair, left_out = _our_errors(k, pair, result, s)
            errors, beyond = errors | of_pair, beyond + left_out
    return errors, results, beyond


def _our_errors(k: int, pair: Pair, result: Calibration, s: Set) -> tuple[dict[Key, tuple[float, bool]], int]:
    rows = np.intersect1d(pair.left.rows, pair.right.rows)
    left, right = (v.pixels[np.searchsorted(v.rows, rows)] for v in (pair.left, pair.right))
    known = told(result.bundle, s.size, left, right)
    rows, left, right = rows[known], left[known], right[known]
    found = lengths_of(pair.name, s.board.points, rows, left, right, result.bundle, s.board, s.size, False)
    P = s.board.points[rows]
    a, b = np.triu_indices(len(rows), 1)
    step = np.abs(P[a] - P[b]) / s.board.square
    straight = step[:, :2].min(axis=1) < 1e-6
    out = {}
    for i, j, x in zip(a[straight], b[straight], found, strict=True):
        if x.n_squares in LENGTHS:
            held = abs(x.measured - x.printed) < 1.96 * x.sigma
            out[k, pair.name, int(rows[i]), int(rows[j])] = (x.error, bool(held))
    return out, int((~known).sum())


def against_each_other(results: Sequence[Calibration | None], truth: dict[str, float]) -> dict[str, float]:
    """|difference| over its 95 % interval, of the two halves of every split and against truth: share that holds."""
    out: dict[str, float] = {}
    for name in ("fx", "baseline"):
        keys = ("left.fx", "right.fx") if name == "fx" else ("baseline",)
        ratios, own = [], []
        halved = len(results) % 2 == 0
        for a, b in zip(results[::2], results[1::2], strict=True) if halved else itertools.combinations(results, 2):
            for key in keys:
                if a is not None and b is not None:
                    (x, sx), (y, sy) = a.parameters[key], b.parameters[key]
                    ratios.append(abs(x - y) / (1.96 * np.hypot(sx, sy)))
                for c in (a, b):
                    if c is not None and key in truth:
                        own.append(abs(c.parameters[key][0] - truth[key]) / (1.96 * c.parameters[key][1]))
        sigmas = [c.parameters[k][1] / c.parameters[k][0] for c in results if c is not None for k in keys]
        out |= {f"{name} held": float(np.mean(np.array(ratios) < 1)), f"{name} worst": float(np.max(ratios))}
        out |= {f"{name} n": len(ratios), f"{name} interval %": 196 * float(np.median(sigmas))}
        if own:
            out[f"{name} truth held"] = float(np.mean(np.array(own) < 1))
    return out


def measure(s: Set, count: int, seed: int) -> dict[str, Any]:
    """All figures of one set."""
    names = sorted({p.name for p in s.ours} | {n for views in s.opencv.values() for n in views})
    halves = []
    for a, b in splits(len(names), count, np.random.default_rng(seed)):
        inside, outside = [names[i] for i in a], [names[i] for i in b]
        halves += [(inside, outside), (outside, inside)] if len(outside) > 1 else [(inside, outside)]
    label, theirs = opencv_errors(s, halves)
    ours, results, beyond = our_errors(s, halves)
    since = time.process_time()
    whole = calibrate(s.ours, s.board, s.size)
    seconds = s.seconds + time.process_time() - since
    rows = []
    for n in LENGTHS:
        mine = {k: e for k, e in ours.items() if _squares(k, s.board) == n}
        other = {k: e for k, e in theirs.items() if _squares(k, s.board) == n}
        both = sorted(set(mine) & set(other))
        a, b = np.array([mine[k][0] for k in both]), np.array([other[k] for k in both])
        everything = np.array([e for e, _ in mine.values()])
        rows.append(
            {
                "squares": n, "n": len(both), "sd": a.std(), "sd opencv": b.std(), "worst": np.abs(a).max(),
                "worst opencv": np.abs(b).max(), "held": np.mean([h for _, h in mine.values()]),
                "n ours": len(mine), "n opencv": len(other), "sd of all ours": everything.std(),
                "sd of all opencv": np.std(list(other.values())), "worst of all ours": np.abs(everything).max(),
                "worst of all opencv": max(map(abs, other.values())),
            }
        )  # fmt: skip
    models = sorted({f"{r.lens_model}{' + shape' if r.bundle.released else ''}" for r in results if r is not None})
    return {
        "set": s.name, "pairs": len(s.ours), "opencv": label, "seconds": seconds, "rows": rows, "models": models,
        "refused": sum(r is None for r in results), "beyond": beyond,
        "parameters": against_each_other(results, s.truth),
        "whole": f"{whole.lens_model}, fx {whole.parameters['left.fx'][0]:.1f} +- "
        f"{1.96 * whole.parameters['left.fx'][1]:.1f} px, baseline {1e3 * whole.parameters['baseline'][0]:.3f} +- "
        f"{1.96e3 * whole.parameters['baseline'][1]:.3f} mm",
    }  # fmt: skip


def show(d: dict[str, Any]) -> None:
    """Print one set's lines."""
    print(f"\n{d['set']}: {d['pairs']} pairs, found and fitted in {d['seconds']:.0f} s of a processor: {d['whole']}")
    print(
        f"  OpenCV: {d['opencv']}; lens models of the halves: {', '.join(d['models'])}; refused: {d['refused']}; "
        f"corners left out because their half does not tell the lens there: {d['beyond']}"
    )
    for r in d["rows"]:
        print(
            f"  {r['squares']} square(s): sd {1e3 * r['sd']:.3f} (OpenCV {1e3 * r['sd opencv']:.3f}) mm, "
            f"worst {1e3 * r['worst']:.2f} ({1e3 * r['worst opencv']:.2f}) mm, n = {r['n']}; "
            f"{r['held']:.1%} of {r['n ours']} intervals hold; all lengths of each: "
            f"sd {1e3 * r['sd of all ours']:.3f} ({1e3 * r['sd of all opencv']:.3f}) mm, worst "
            f"{1e3 * r['worst of all ours']:.2f} ({1e3 * r['worst of all opencv']:.2f}) mm, "
            f"n = {r['n ours']} ({r['n opencv']})"
        )
    p = d["parameters"]
    for name in ("fx", "baseline"):
        truth = f", {p[f'{name} truth held']:.0%} against truth" if f"{name} truth held" in p else ""
        print(
            f"  {name}: {p[f'{name} held']:.0%} of {p[f'{name} n']} differences of halves within their 95 % interval, "
            f"worst {p[f'{name} worst']:.2f} of it{truth}; median interval +- {p[f'{name} interval %']:.2f} %",
            flush=True,
        )


def main() -> int:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("LIVEDEFORM_DATA", "../shared/data")))
    parser.add_argument("--splits", type=int, default=5)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default=",".join([*PUBLIC, "drawn_whole", "drawn_weak"]))
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    out = []
    for name in given.only.split(","):
        if name in PUBLIC and not (given.data / name).is_dir():
            print(f"\n{name}: not in {given.data}; name the folder with --data or LIVEDEFORM_DATA")
            continue
        one = public(name, given.data) if name in PUBLIC else drawn(name, np.random.default_rng(given.seed))
        out.append(measure(one, given.splits, given.seed))
        show(out[-1])
    if given.json:
        given.json.write_text(json.dumps(out, indent=1, default=float) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
