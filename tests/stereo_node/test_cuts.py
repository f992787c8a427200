"""Discs with uneven rims, as hands paint them, and small ones, some of them covered by what is as light as the ground.

Pictures are sampled six or eight times finer than their pixels; a disc's middle is that of its rim's ellipse.
"""

from collections import defaultdict

import cv2
import numpy as np
import pytest

from livedeform.stereo_node.camera.triangulate import Triangulated
from livedeform.stereo_node.detect.blobs import detect_blobs
from livedeform.stereo_node.detect.settings import DetectorSettings
from livedeform.stereo_node.pipeline import _rays_meet

ORDERS = np.arange(3, 11)  # harmonics of the rim: those below are the ellipse


def painted(seed, radius, uneven, n=36, cut=0.35, aspect=1.0, blur=0.7, fine=6, deepest=1.0):
    """``n`` dark discs with rims ``uneven`` (rms, of the radius), seen with an ``aspect``; a share ``cut`` of them is
    covered by a half plane as light as the ground, 0.05 to ``deepest`` radii deep. The picture, middles (n, 2), and
    what is cut."""
    rng = np.random.default_rng(seed)
    half, side = int(1.35 * radius) + 11, int(np.ceil(np.sqrt(n)))
    turn = rng.uniform(0, np.pi)
    R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    seen = R @ np.diag([1, 1 / aspect]) @ R.T
    places = (np.arange(2 * half * fine) + 0.5) / fine - 0.5
    clean, middles = np.full((2 * half * side, 2 * half * side), 180.0), np.empty((n, 2))
    covered = rng.random(n) < cut
    for i in range(n):
        corner, middle = 2 * half * np.array([i % side, i // side]), half - 0.5 + rng.uniform(-1, 1, 2)
        waves = rng.normal(size=(2, len(ORDERS))) / ORDERS
        waves *= uneven / np.sqrt((1 / ORDERS**2).sum())
        off = np.stack(np.meshgrid(places, places), axis=2) - middle
        flat = off @ np.linalg.inv(seen).T
        angle = np.arctan2(flat[..., 1], flat[..., 0])
        rim = 1 + sum(a * np.cos(k * angle) + b * np.sin(k * angle) for k, a, b in zip(ORDERS, *waves, strict=True))
        drawn = np.where(np.hypot(flat[..., 0], flat[..., 1]) < radius * rng.uniform(0.95, 1.05) * rim, 50.0, 180.0)
        angle, depth = rng.uniform(0, 2 * np.pi), rng.uniform(0.05, deepest)
        across = np.array([np.cos(angle), np.sin(angle)])
        if covered[i]:
            drawn[off @ across > radius * np.linalg.norm(seen @ across) * (1 - depth)] = 180.0
        drawn = cv2.GaussianBlur(drawn, (0, 0), blur * fine)
        x, y = corner
        clean[y : y + 2 * half, x : x + 2 * half] = drawn.reshape(2 * half, fine, 2 * half, fine).mean(axis=(1, 3))
        middles[i] = corner + middle
    noisy = clean + rng.normal(0, 2.0, clean.shape)
    return np.clip(np.round(noisy), 0, 255).astype(np.uint8), middles, covered


def measured(radius, uneven, seeds, **looks):
    """Chi-square of a coordinate of those that were found, and their share, of open and of covered discs."""
    chi2, found = defaultdict(list), defaultdict(list)
    for seed in seeds:
        picture, middles, covered = painted(seed, radius, uneven, **looks)
        blobs = detect_blobs(picture, DetectorSettings(min_radius=1.0, max_radius=30.0))
        for middle, cut in zip(middles, covered, strict=True):
            e = blobs.centres - middle
            k = int(np.linalg.norm(e, axis=1).argmin())
            found[bool(cut)].append(np.linalg.norm(e[k]) < 0.8 * radius)
            if found[bool(cut)][-1]:
                chi2[bool(cut)].append(e[k] @ np.linalg.inv(blobs.covariances[k]) @ e[k] / 2)
    return {cut: (float(np.mean(chi2[cut])), float(np.mean(found[cut]))) for cut in (False, True)}


@pytest.mark.parametrize(("radius", "uneven", "aspect"), [(5.0, 0.02, 1.0), (8.0, 0.02, 1.0), (8.0, 0.02, 1.5)])
def test_dots_with_uneven_rims_are_found_and_a_cut_of_them_is_told_or_in_their_sigma(radius, uneven, aspect):
    """One in twenty open ones was lost, and chi-squares of covered ones that were said to be sure were 97 to 183."""
    (of_open, found), (of_covered, _) = measured(radius, uneven, range(70000, 70002), aspect=aspect).values()
    assert found == 1.0 and of_open < 1.5  # measured 0.25 to 0.60; all
    assert of_covered < 4.0  # measured 0.85 to 1.03


@pytest.mark.parametrize("radius", [3.0, 4.0])
def test_a_cut_of_a_small_disc_is_told_or_in_its_sigma(radius):
    """Chi-squares of covered ones that were said to be sure were 202 and 75."""
    (of_open, found), (of_covered, _) = measured(radius, 0.0, range(70000, 70003), fine=8).values()
    assert found == 1.0 and of_open < 1.5  # measured 1.21 and 1.07; all
    assert of_covered < 4.0  # measured 2.89 and 0.13


@pytest.mark.parametrize("radius", [3.5, 4.0])
def test_a_light_cut_of_a_small_disc_is_in_its_sigma(radius):
    """It is too light to be told: middles off by 0.16 px were stated to 0.014."""
    (of_open, found), (of_covered, _) = measured(radius, 0.0, range(71000, 71004), cut=0.3, deepest=0.25).values()
    assert found == 1.0 and 0.5 < of_open < 2.0  # measured 1.37 and 1.46; all
    assert of_covered < 3.0  # measured 1.34 and 0.95; without the outline's skewness 3.74 and 1.18


@pytest.mark.parametrize(("radius", "aspect"), [(1.9, 1.0), (2.1, 1.5)])
def test_a_tiny_disc_that_is_tilted_as_its_neighbours_are_is_sure(radius, aspect):
    """What a cut leaves is an ellipse, as of a tilt: middles known to 0.011 px were stated to 0.13 to 0.70."""
    (of_open, found), (of_covered, _) = measured(radius, 0.0, range(70000, 70004), fine=8, aspect=aspect).values()
    assert found > 0.95 and 0.3 < of_open < 1.5  # measured 0.66 and 0.62; all
    assert of_covered < 4.0  # measured 0.61 and 1.70


def test_rays_that_meet_are_told_by_each_markers_own_sigma():
    """A calibration that is off lets all of them miss by as much; the sharpest ones were rejected, and no others."""
    rng = np.random.default_rng(0)
    sigma = np.where(np.arange(40) % 4 == 0, 0.01, 0.15)  # px, of each picture: a quarter is sharp
    missed = 0.15 + rng.normal(0, sigma / np.sqrt(2))
    missed[[8, 9]] = 2.0
    chi2 = 2 * missed**2 / sigma**2
    points = Triangulated(np.zeros((40, 3)), np.zeros((40, 3, 3)), chi2, np.abs(missed))
    assert np.flatnonzero(~_rays_meet(points)).tolist() == [8, 9]
