"""Spots in pictures as they are: the centre's error against the Cramer-Rao bound, uneven light, glare, hidden rims,
texture.
"""

import cv2
import numpy as np
import pytest
from scene import disc_picture

from livedeform.common.errors import InputError
from livedeform.stereo_node.detect.blobs import detect_blobs
from livedeform.stereo_node.detect.picture import grey, noise_level
from livedeform.stereo_node.detect.settings import DetectorSettings

SIZE = (400, 300)
GRID = np.array([[50 + 50 * i, 50 + 50 * j] for j in range(5) for i in range(7)], float)


def picture(seed=0, radius=5.0, contrast=-120.0, noise=2.0, blur=0.7, change=None):
    rng = np.random.default_rng(seed)
    centres = GRID + rng.uniform(-0.5, 0.5, GRID.shape)
    clean, information = disc_picture(centres, radius, 180.0 if contrast < 0 else 60.0, contrast, blur, SIZE)
    if change is not None:
        clean = change(clean, centres)
    noisy = np.clip(np.round(clean + rng.normal(0, noise, clean.shape)), 0, 255).astype(np.uint8)
    return noisy, centres, noise / np.sqrt(information)


def errors(blobs, centres):
    distance = np.linalg.norm(blobs.centres[:, None] - centres[None], axis=2)
    nearest = distance.argmin(axis=0)
    assert distance.min(axis=0).max() < 1.0  # every marker was found
    return blobs.centres[nearest] - centres, blobs.covariances[nearest]


def test_centres_reach_the_cramer_rao_bound():
    """Radius 5 px, contrast 120, noise 2 grey values."""
    squares, chi2, bounds = [], [], []
    for seed in range(6):
        noisy, centres, bound = picture(seed)
        e, C = errors(detect_blobs(noisy, DetectorSettings()), centres)
        squares.append(e**2)
        chi2.append(e**2 / C[:, [0, 1], [0, 1]])
        bounds.append(bound**2)
    ratio = np.sqrt(np.mean(squares) / np.mean(bounds))
    assert ratio < 1.5  # measured 1.14 over 420 coordinates; SimpleBlobDetector 2.00
    assert 0.8 < np.mean(chi2) < 1.2  # measured 1.00 over 420 coordinates


@pytest.mark.parametrize("polarity", ["dark", "light"])
def test_both_polarities(polarity):
    noisy, centres, _ = picture(contrast=-100.0 if polarity == "dark" else 100.0)
    e, _ = errors(detect_blobs(noisy, DetectorSettings(polarity=polarity)), centres)
    assert np.abs(e).max() < 0.06  # measured 0.036 (dark), 0.039 (light)
    other = "light" if polarity == "dark" else "dark"
    assert len(detect_blobs(noisy, DetectorSettings(polarity=other))) == 0


def test_uneven_light_and_blur():
    def shade(clean, centres):
        u = np.arange(clean.shape[1])[None] / clean.shape[1]
        return clean * (0.35 + 0.75 * u**1.5)

    noisy, centres, _ = picture(blur=1.8, change=shade)
    e, _ = errors(detect_blobs(noisy, DetectorSettings()), centres)
    assert np.abs(e).max() < 0.15  # measured 0.083: the darkest have a contrast of 46
    assert np.sqrt((e**2).mean()) < 0.05  # measured 0.036


def test_glare_moves_a_centre_little_or_drops_the_marker():
    def glare(clean, centres):
        spots = np.zeros_like(clean)
        for x, y in centres:
            cv2.circle(spots, (round(x + 2.5), round(y - 1.5)), 1, 255.0, -1)
        return np.minimum(clean + cv2.GaussianBlur(spots, (0, 0), 0.7), 255)

    noisy, centres, _ = picture(radius=7.0, change=glare)
    blobs = detect_blobs(noisy, DetectorSettings(max_misfit=0.3))
    distance = np.linalg.norm(blobs.centres[:, None] - centres[None], axis=2)
    assert len(blobs) > 25  # measured 35: all
    assert distance.min(axis=1).max() < 0.15  # px; measured 0.056; the weighted mean of the ink is off by 0.15 to 0.25


def test_half_hidden_markers_are_not_measured():
    def cover(clean, centres):
        out = clean.copy()
        for x, y in centres:
            out[:, :] = out  # each marker loses its right half to something light
            out[round(y) - 9 : round(y) + 10, round(x) : round(x) + 10] = 180.0
        return out

    noisy, _, _ = picture(radius=6.0, change=cover)
    blobs = detect_blobs(noisy, DetectorSettings(max_aspect=1.6))
    assert len(blobs) == 0


def cut(share):
    """The upper part of every disc of 7 px radius, a ``share`` of its radius deep, lies behind a grey bar."""

    def cover(clean, centres):
        out = clean.copy()
        for x, y in centres:
            edge = y - 7.0 * (1 - share)
            rows = np.arange(int(y) - 30, int(np.ceil(edge)) + 1)
            hidden = np.clip(edge + 0.5 - rows, 0, 1)[:, None]  # a pixel that is cut shows both
            columns = slice(int(x) - 25, int(x) + 25)
            out[rows, columns] = out[rows, columns] * (1 - hidden) + 85.0 * hidden
        return cv2.GaussianBlur(out, (0, 0), 0.5)

    return cover


@pytest.mark.parametrize(("share", "bound"), [(0.15, 0.05), (0.25, 0.06)])
def test_a_disc_that_the_probe_cuts_is_measured_by_the_rest_of_its_rim(share, bound):
    noisy, centres, _ = picture(radius=7.0, change=cut(share))
    blobs = detect_blobs(noisy, DetectorSettings())
    distance = np.linalg.norm(blobs.centres[:, None] - centres[None], axis=2).min(axis=1)
    near = distance < 3.0
    assert near.sum() > 28  # measured 33 of 35
    assert np.sqrt((distance[near] ** 2).mean()) < bound  # measured 0.043 and 0.042 px; fitted whole, all were refused


def covered(radius, depth, grey, seed):
    """A dark disc on a ground of 180, eight times oversampled; a half plane of ``grey`` lies over it, ``depth`` of its
    radius deep, from any side. Returns the picture and the disc's middle."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(39.5, 40.5, 2)
    angle = rng.uniform(0, 2 * np.pi)
    v, u = (np.mgrid[0:640, 0:640] + 0.5) / 8 - 0.5
    fine = np.where(np.hypot(u - x, v - y) < radius, 50.0, 180.0)
    fine[(u - x) * np.cos(angle) + (v - y) * np.sin(angle) > radius * (1 - depth)] = grey
    clean = cv2.GaussianBlur(fine, (0, 0), 6.4).reshape(80, 8, 80, 8).mean(axis=(1, 3))
    return np.clip(np.round(clean + rng.normal(0, 2, clean.shape)), 0, 255).astype(np.uint8), np.array([x, y])


@pytest.mark.parametrize("grey", [180.0, 165.0, 145.0])
@pytest.mark.parametrize("radius", [6.0, 8.0, 12.0])
def test_what_covers_a_disc_and_is_as_light_as_the_ground_moves_no_centre(radius, grey):
    """A smaller ellipse fits a disc that is cut off along a chord: by 0.2 to 5 px beside it, up to 60 sigmas."""
    far, sigmas, n_shallow = [], [], 0
    for seed, depth in enumerate((0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.6, 0.7, 0.85, 1.0)):
        noisy, middle = covered(radius, depth, grey, seed)
        blobs = detect_blobs(noisy, DetectorSettings())
        if len(blobs) == 0:
            continue
        e = blobs.centres[0] - middle
        far.append(np.linalg.norm(e))
        sigmas.append(np.sqrt(e @ np.linalg.inv(blobs.covariances[0]) @ e / 2))
        n_shallow += depth <= 0.25
    assert max(far) < 0.12  # px; measured 0.095, where it hides too little to show (5.1)
    assert max(sigmas) < 7  # measured 6.3 there, 3.8 and less elsewhere (89)
    assert n_shallow >= 3  # measured 4 of 5: up to an eighth of the width is no reason to lose a marker


def test_half_of_a_small_disc_is_not_measured():
    """Its rim is too short to tell a chord; what is left is skewed by more than bodies stretch discs."""
    for seed in range(8):
        for depth in (0.7, 0.9, 1.1):
            noisy, _ = covered(4.0, depth, 180.0, seed)
            assert len(detect_blobs(noisy, DetectorSettings())) == 0


@pytest.mark.parametrize("radius", [1.6, 2.0])
def test_the_sigma_of_a_tiny_disc_holds_what_a_cut_that_does_not_show_does(radius):
    """Something as light as the ground cuts it: up to 39 sigmas, and said to be sure."""
    sigmas = []
    for seed in range(3):
        for depth in (0.0, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0):
            noisy, middle = covered(radius, depth, 180.0, seed)
            blobs = detect_blobs(noisy, DetectorSettings(min_radius=1.0))
            for centre, covariance in zip(blobs.centres, blobs.covariances, strict=True):
                e = centre - middle
                sigmas.append(np.sqrt(e @ np.linalg.inv(covariance) @ e / 2))
    assert np.sqrt(np.mean(np.square(sigmas))) < 2.0 and max(sigmas) < 7


@pytest.mark.parametrize("radius", [2.5, 4.0, 6.0, 10.0])
def test_the_centroid_of_a_covered_marker_is_refused_or_its_sigma_holds(radius):
    """It had no test of what covers a marker: up to 580 sigmas."""
    sigmas, n_whole = [], 0
    for seed in range(3):
        for depth in (0.0, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0):
            noisy, middle = covered(radius, depth, 180.0, seed)
            blobs = detect_blobs(noisy, DetectorSettings(centre="moments"))
            assert not len(blobs) or depth < 0.7 or radius < 4.0
            for centre, covariance in zip(blobs.centres, blobs.covariances, strict=True):
                e = centre - middle
                sigmas.append(np.sqrt(e @ np.linalg.inv(covariance) @ e / 2))
            n_whole += len(blobs) == 1 and depth == 0.0
    assert n_whole == 3
    assert np.sqrt(np.mean(np.square(sigmas))) < 2.0 and max(sigmas) < 5


def test_egg_shaped_outlines_show():
    """A rim displaced by 0.3 cos(3 a) px; round ones show nothing beyond noise."""
    v, u = np.mgrid[0 : SIZE[1], 0 : SIZE[0]].astype(float)
    clean = np.full(SIZE[::-1], 180.0)
    for x, y in GRID:
        d, angle = np.hypot(u - x, v - y), np.arctan2(v - y, u - x)
        clean -= 120.0 * np.clip(0.5 + (7.0 + 0.3 * np.cos(3 * angle) - d), 0, 1)
    rng = np.random.default_rng(0)
    eggs = np.clip(np.round(cv2.GaussianBlur(clean, (0, 0), 0.6) + rng.normal(0, 2, clean.shape)), 0, 255)
    found = detect_blobs(eggs.astype(np.uint8), DetectorSettings())
    assert np.abs(found.skewness_px - 0.3).max() < 0.06
    round_ones = detect_blobs(picture(radius=7.0)[0], DetectorSettings())
    assert (round_ones.skewness_px > 0).mean() < 0.1 and round_ones.skewness_px.max() < 0.05


def test_a_marker_on_a_small_bright_plate_before_a_black_wall():
    clean = np.zeros(SIZE[::-1])
    clean[120:170, 180:240] = 150.0
    disc, _ = disc_picture([(210.3, 144.6)], 8.0, 0.0, -120.0, 0.7, SIZE)
    noisy = np.clip(np.round(clean + disc + np.random.default_rng(0).normal(0, 1, clean.shape)), 0, 255)
    blobs = detect_blobs(noisy.astype(np.uint8), DetectorSettings())
    assert np.linalg.norm(blobs.centres - [210.3, 144.6], axis=1).min() < 0.02


def test_texture_hides_no_marker():
    grain = cv2.GaussianBlur(np.random.default_rng(1).normal(size=SIZE[::-1]), (0, 0), 3.0)

    def ground(clean, centres):
        return clean + 12.0 * grain / grain.std()

    noisy, centres, _ = picture(change=ground)
    blobs = detect_blobs(noisy, DetectorSettings(min_contrast=45.0))
    errors(blobs, centres)
    assert len(blobs) <= 1.5 * len(centres)  # measured 36 of 35: epipolar geometry and identities sort the others out


def test_noise_is_known_from_the_picture():
    for noise in (0.8, 2.0, 5.0):
        noisy, _, _ = picture(noise=noise)
        assert noise_level(noisy) == pytest.approx(np.hypot(noise, 0.29), rel=0.1)  # measured 4 %


def test_moments_for_squares():
    clean = np.full((200, 200), 200.0)
    fine = np.full((1600, 1600), 200.0)
    fine[600:760, 500:660] = 40.0  # 20 px wide, from 62.5 to 82.5 (pixel middles at +0.5)
    clean = fine.reshape(200, 8, 200, 8).mean(axis=(1, 3))
    noisy = np.clip(np.round(clean + np.random.default_rng(0).normal(0, 1, clean.shape)), 0, 255).astype(np.uint8)
    blobs = detect_blobs(noisy, DetectorSettings(centre="moments", max_radius=30, max_misfit=0.5))
    assert len(blobs) == 1
    assert np.allclose(blobs.centres[0], [72.0, 84.5], atol=3e-3)  # measured 7e-4


def test_settings_and_pictures_are_checked():
    with pytest.raises(
        InputError, match=r"unknown key 'radius'.*stereo.detector|stereo.detector.*unknown key 'radius'"
    ):
        DetectorSettings.from_mapping({"radius": 3})
    for wrong, said in (
        ({"min_radius": "tiny"}, "not a number"),
        ({"max_radius": -1.0}, "not a number of 0 or more"),
        ({"min_radius": 9, "max_radius": 4}, "not below max_radius"),
        ({"marker": "star"}, "use one of painted, flat, ball"),
        ({"levels": 1.5}, "not a whole number"),
    ):
        with pytest.raises(InputError, match=said):
            DetectorSettings.from_mapping(wrong)
    with pytest.raises(InputError, match="mono16"):
        grey(np.zeros((4, 4), np.uint16), "mono16")
