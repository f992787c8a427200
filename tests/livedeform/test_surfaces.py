"""Points without ids against a predicted surface: exact for plates and spheres, whatever the triangles are, and with
noise as large as it is."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from livedeform.compare_node.surface_error import surface_error
from livedeform.run.surfaces import Cloud, coverage, distances

SIZE = np.array([0.08, 0.06, 0.03])
NOWHERE = np.full((1, 3, 3), np.nan)


def _box(splits: int = 0) -> trimesh.Trimesh:
    """A closed block with its lower corner at the origin, each triangle split into four so many times."""
    box = trimesh.creation.box(bounds=[[0, 0, 0], SIZE])
    for _ in range(splits):
        box = box.subdivide()
    return box


def _cloud(points: np.ndarray, sigma: float | None = None, stamp_ns: int = 0) -> Cloud:
    C = np.tile(NOWHERE if sigma is None else sigma**2 * np.eye(3), (len(points), 1, 1))
    return Cloud(stamp_ns, points, C)


def _on_top(n: int = 3000, seed: int = 0) -> np.ndarray:
    """Random places on the block's upper face, not at its edges."""
    u = np.random.default_rng(seed).uniform(0.1, 0.9, (n, 2))
    return np.column_stack([u * SIZE[:2], np.full(n, SIZE[2])])


@pytest.mark.parametrize("off", [4e-4, -4e-4])
def test_a_plate_that_lies_off_is_exactly_that_far_with_its_sign(off):
    box = _box()
    found = distances(_cloud(_on_top() + np.array([0.0, 0.0, off]), sigma=5e-5), box.vertices, box.faces)
    assert found.distances == pytest.approx(off, abs=1e-15)  # outside is positive
    assert found.sigmas == pytest.approx(5e-5)
    said = surface_error([found], 1, {})
    assert said.bias.value == pytest.approx(off) and said.rmse.value == pytest.approx(abs(off))
    assert said.noise_from == "stated" and said.noise == pytest.approx(5e-5)


def test_sliding_along_the_surface_is_not_seen_and_that_is_said():
    box = _box()
    found = surface_error([distances(_cloud(_on_top() + np.array([2e-3, -1e-3, 0.0])), box.vertices, box.faces)], 1, {})
    assert found.rmse.value < 1e-15
    assert "blind to sliding" in found.text and "sliding along it is not seen" in str(found.as_dict()["of"])


def test_triangles_do_not_matter():
    cloud = _cloud(np.random.default_rng(1).uniform(-0.2, 1.2, (2000, 3)) * SIZE)  # in, out, beside edges and corners
    coarse, fine = (distances(cloud, b.vertices, b.faces) for b in (_box(), _box(3)))
    assert coarse.distances == pytest.approx(fine.distances, abs=1e-14)
    assert (coarse.distances > 0).any() and (coarse.distances < 0).any()
    inside = ((cloud.points > 0) & (cloud.points < SIZE)).all(axis=1)
    assert np.array_equal(coarse.distances < 0, inside)
    assert coarse.coverage == pytest.approx(fine.coverage, abs=0.02)


def test_a_ball_is_as_far_as_its_radius_says():
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.05)
    at = np.random.default_rng(2).standard_normal((2000, 3))
    at *= (0.05 + 3e-4) / np.linalg.norm(at, axis=1)[:, None]
    found = distances(_cloud(at), ball.vertices, ball.faces)
    assert found.distances == pytest.approx(3e-4, abs=2e-5)  # the chords of 20480 triangles: measured 1.4e-5
    assert found.coverage > 0.99


def test_noise_is_told_by_neighbours_and_leaves_the_mean_alone():
    """Sixty moments of a plate that lies 0.2 mm off and bends, with 50 um of noise along its normal."""
    rng, box, sigma = np.random.default_rng(3), _box(), 5e-5
    frames = []
    for k in range(60):
        p = _on_top(600, seed=k)
        off = 2e-4 + 1e-4 * np.sin(20.0 * p[:, 0])
        shift = np.column_stack([0 * off, 0 * off, off]) + sigma * rng.standard_normal(p.shape)
        frames.append(distances(_cloud(p + shift, stamp_ns=k), box.vertices, box.faces))
    said = surface_error(frames, 60, {})
    truth = np.mean([np.mean(2e-4 + 1e-4 * np.sin(20.0 * _on_top(600, seed=k)[:, 0])) for k in range(60)])
    assert said.noise_from == "neighbours" and said.noise == pytest.approx(sigma, rel=0.05)
    assert said.bias.value == pytest.approx(truth, abs=4.0 * sigma / np.sqrt(36_000))
    assert said.bias.low < said.bias.value < said.bias.high < said.rmse.value
    assert said.n == 36_000 and said.n_frames == 60


def test_the_interval_of_the_mean_holds_as_often_as_it_says():
    """Moments that are off by one constant each, as a camera that shakes makes them: points do not make them more."""
    rng, box, held = np.random.default_rng(4), _box(), 0
    for trial in range(25):
        offs = 1e-4 + 5e-5 * rng.standard_normal(40)
        frames = [
            distances(_cloud(_on_top(30, trial) + np.array([0.0, 0.0, o])), box.vertices, box.faces) for o in offs
        ]
        bias = surface_error(frames, 40, {}).bias
        held += bias.low <= 1e-4 <= bias.high
    assert held >= 20  # 24 of 25 are expected; fewer than 20 come by chance once in a thousand


def test_coverage_is_the_share_of_the_surface_with_points():
    box = _box(2)
    u = np.random.default_rng(5).uniform(0.0, 1.0, (4000, 2))
    top = np.column_stack([u * SIZE[:2], np.full(4000, SIZE[2])])
    area = 2 * (SIZE[0] * SIZE[1] + SIZE[1] * SIZE[2] + SIZE[0] * SIZE[2])
    assert coverage(top, box.vertices, box.faces) == pytest.approx(SIZE[0] * SIZE[1] / area, abs=0.04)


def test_nothing_measured_says_so():
    none = surface_error([], 7, {"gap": 7})
    assert none.n == 0 and "no measured surface point" in none.text
