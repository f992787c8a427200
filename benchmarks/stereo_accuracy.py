"""How near the stereo measuring is to what the pictures' noise allows. Prints one line per figure; takes about a
minute.

    python benchmarks/stereo_accuracy.py

1. Rendered discs (radius 5 px, contrast 120, noise 2 grey values): error of the centre over the Cramer-Rao bound,
ours and OpenCV's.
2. A rendered phantom (baseline 0.1 m, 0.4 m away, 1000 px): sideways and depth scatter over the bound, chi-square
against truth.
3. False markers on a textured ground.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "stereo_node"))
from scene import Look, disc_picture, dome_markers, looking_down, make_test_rig, render

from livedeform_common.types import Image
from stereo_node.detect import DetectorSettings, detect_blobs
from stereo_node.pipeline import StereoTracker, TrackerSettings

FLAT = TrackerSettings(detector=DetectorSettings(marker="flat"))


def discs(n_pictures: int = 20, radius: float = 5.0, contrast: float = 120.0, noise: float = 2.0) -> dict[str, float]:
    """rms centre error over the Cramer-Rao bound: the model fit, its predicted sigma, SimpleBlobDetector,
    findCirclesGrid.
    """
    rng = np.random.default_rng(0)
    errors: dict[str, list[np.ndarray]] = {"ours": [], "SimpleBlobDetector": [], "findCirclesGrid": []}
    chi2, bound = [], []
    for _ in range(n_pictures):
        centres = np.array([[60 + 50 * i, 60 + 50 * j] for j in range(6) for i in range(8)]) + rng.uniform(
            -1, 1, (48, 2)
        )
        clean, information = disc_picture(centres, radius, 180.0, -contrast, 0.7, (500, 380))
        picture = np.clip(np.round(clean + rng.normal(0, noise, clean.shape)), 0, 255).astype(np.uint8)
        bound.append(noise / np.sqrt(information))
        blobs = detect_blobs(picture, DetectorSettings(polarity="dark", min_radius=3))
        d = _nearest(blobs.centres, centres)
        errors["ours"].append(blobs.centres[d] - centres)
        chi2.append((errors["ours"][-1] ** 2 / blobs.covariances[d][:, [0, 1], [0, 1]]).mean())
        keys = np.array([k.pt for k in cv2.SimpleBlobDetector_create().detect(picture)])
        errors["SimpleBlobDetector"].append(keys[_nearest(keys, centres)] - centres)
        found, grid = cv2.findCirclesGrid(picture, (8, 6))
        if found:
            grid = grid.reshape(-1, 2)
            errors["findCirclesGrid"].append(grid[_nearest(grid, centres)] - centres)
    limit = float(np.sqrt(np.mean(np.square(bound))))
    out = {"bound_px": limit, "chi2": float(np.mean(chi2))}
    for name, parts in errors.items():
        if parts:
            out[name] = float(np.sqrt(np.mean(np.square(parts)))) / limit
    return out


def phantom(n_frames: int = 25, noise: float = 2.0) -> dict[str, float]:
    """Sideways and depth scatter of 60 markers against the bound that centres at the Cramer-Rao limit give, and
    chi-square.
    """
    rig, (markers, normals), T = make_test_rig(), dome_markers(60), looking_down()
    rng = np.random.default_rng(1)
    clean = [
        render(rig, T, markers.points, normals, Look(noise=0), rng, side, rounded=False) for side in ("left", "right")
    ]
    tracker = StereoTracker(rig, markers, FLAT, T)
    errors, chi2, predicted = [], [], []
    for k in range(n_frames):
        images = [
            Image(k + 1, np.clip(np.round(c + rng.normal(0, noise, c.shape)), 0, 255).astype(np.uint8)) for c in clean
        ]
        frame, _ = tracker.process(*images)
        e = frame.points - markers.points[frame.ids - 100]
        errors.append(e @ T[:3, :3])
        predicted.append(np.einsum("ji,njk,ki->ni", T[:3, :3], frame.covariances, T[:3, :3]))
        chi2.append(np.einsum("ni,nij,nj->n", e, np.linalg.inv(frame.covariances), e) / 3)
    e, p = np.concatenate(errors), np.sqrt(np.concatenate(predicted).mean(axis=0))
    rms = np.sqrt((e**2).mean(axis=0))
    return {
        "n": float(len(e)),
        "sideways_um": 1e6 * float(np.sqrt((rms[:2] ** 2).mean())),
        "depth_um": 1e6 * float(rms[2]),
        "sideways_ratio": float(np.sqrt((rms[:2] ** 2).mean() / (p[:2] ** 2).mean())),
        "depth_ratio": float(rms[2] / p[2]),
        "chi2": float(np.concatenate(chi2).mean()),
        "chi2_median_ratio": float(np.median(np.concatenate(chi2)) / 0.7887),
    }


def false_markers(n_frames: int = 12) -> dict[str, float]:
    """Published markers that are not where their name is (over 1 mm off), on a ground with texture of 12 grey
    values.
    """
    rig, (markers, normals), T = make_test_rig(), dome_markers(60), looking_down()
    tracker = StereoTracker(rig, markers)
    look = Look(texture=12.0)
    published = wrong = spots = 0
    for k in range(n_frames):
        rng = np.random.default_rng(100 + k)
        images = [Image(k + 1, render(rig, T, markers.points, normals, look, rng, side)) for side in ("left", "right")]
        frame, status = tracker.process(*images)
        error = np.linalg.norm(frame.points - markers.points[frame.ids - 100], axis=1)
        published, wrong = published + len(error), wrong + int((error > 1e-3).sum())
        spots += status.n_found_left + status.n_found_right - 2 * len(error)
    return {
        "published": published,
        "wrong": wrong,
        "share": wrong / max(published, 1),
        "spots_not_used_per_pair": spots / n_frames,
    }


def _nearest(found: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    return np.linalg.norm(found[:, None] - wanted[None], axis=2).argmin(axis=0)


def main() -> None:
    """Prints the figures."""
    for name, part in (("discs", discs), ("phantom", phantom), ("false markers", false_markers)):
        print(f"{name:14}" + "  ".join(f"{k} {v:.4g}" for k, v in part().items()), flush=True)


if __name__ == "__main__":
    main()
