"""An error of each marker that lasts, and that a tracker states, is evidence for nothing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import toy
from toy_loop import PLACES, toy_inputs

from livedeform.closed_loop.diagnosis import Diagnosis
from livedeform.closed_loop.evidence.noise import ModelErrors, Steady, covariance_of, rows_of
from livedeform.closed_loop.evidence.observation import Observation, observe, poses_at
from livedeform.closed_loop.evidence.track import track
from livedeform.closed_loop.inference.steady import (
    far_apart,
    looks_at,
    steady_of,
    unshared_by_neighbours,
    varying_share,
)
from livedeform.closed_loop.loop import investigate
from livedeform.common.types import Array, EffectValues, MarkerFrame

ALLOWANCE = toy.SETTINGS.allowance
REPEATS = 5e-5  # m, of a coordinate from frame to frame
PLACE = 4e-5  # m, to which places are known by default
NAMES = ("stiffness", "gravity_tilt", "stiffness_gradient", "swelling", "skin", "viscoelasticity")


def observed(
    lasting: Array | float, stated: float, seed: int, name: str, n: int, effects: tuple[EffectValues, ...] = ()
) -> Observation:
    """A tracker whose points have errors that ``lasting`` (..., m, 3) m has, and states so much (m) of a coordinate."""
    rng, poses = np.random.default_rng(seed), toy.path(seed=seed)
    stamps = (np.arange(0.05, 29.9, 0.04) * 1e9).astype(np.int64)
    points = toy.ToyBody(PLACES).points(effects, 1e-9 * stamps, poses_at(poses, stamps)[0])
    points = points + lasting + REPEATS * rng.standard_normal(points.shape)
    ids, said = np.arange(len(PLACES)).astype(np.uint32), np.tile(stated**2 * np.eye(3), (len(PLACES), 1, 1))
    frames = [MarkerFrame(int(s), ids, p, said, np.full(len(ids), np.nan)) for s, p in zip(stamps, points, strict=True)]
    return observe(name, track(frames, ids), poses, n_moments=n, start_ns=0, settings=toy.SETTINGS)


def diagnosed(size: float, seed: int, *effects: EffectValues, names: Sequence[str] = toy.NAMES) -> Diagnosis:
    """Diagnose two recordings with one error (m, sigma of a coordinate) of each marker in both, stated as it is."""
    constant = size * np.random.default_rng(seed).standard_normal(PLACES.shape)
    stated = float(np.hypot(REPEATS, size))
    parts = [(seed, "fit", 30), (seed + 1000, "test", 20)]
    inputs = toy_inputs(*(observed(constant, stated, *part, effects) for part in parts), names)
    errors = replace(inputs.uncertain.errors, place_sigma=np.full(len(PLACES), PLACE))
    inputs = replace(inputs, uncertain=replace(inputs.uncertain, errors=errors))
    return investigate(toy.ToyModel(toy.ToyBody(PLACES)), inputs, seed=seed)


def test_a_marker_back_at_its_place_is_looked_at_as_before():
    """Looks were numbered anew in each press, and ended for all markers when some had moved."""
    points = np.zeros((60, 40, 3))
    points[3:6, 0] = points[33:36, 0] = [0.0, 0.0, 1e-3]  # marker 0 is pressed twice, in two recordings perhaps
    looks, pressed = looks_at(points, ALLOWANCE.look), points[:, 0, 2] > 0.0
    assert [len(np.unique(looks[:, i])) for i in range(40)] == [2] + [1] * 39
    assert len(np.unique(looks[pressed, 0])) == len(np.unique(looks[~pressed, 0])) == 1


LASTS, NOISE = 1e-4, 3e-5  # m, Euclidean: of one look or for good, and of a window's mean


@pytest.mark.parametrize("varies", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("worse", [0.0, 3e-3])
def test_how_long_an_error_lasts_is_told_by_the_markers(varies: float, worse: float):
    """The model is as wrong as it may be, by a share ``worse`` of a motion of up to 10 mm, and a camera has moved."""
    rng, k, m = np.random.default_rng(3), 60, 40
    motion = 1e-2 * np.outer(np.abs(np.sin(0.4 * np.arange(k))), rng.random(m) ** 2)
    points = PLACES + motion[..., None] * [0.0, 0.0, -1.0]
    looks = looks_at(points, ALLOWANCE.look)
    each = rng.standard_normal((k, m, 3))[looks, np.arange(m)]
    error = np.sqrt(1.0 - varies) * rng.standard_normal((m, 3)) + np.sqrt(varies) * each
    error = (LASTS * error + NOISE * rng.standard_normal(error.shape)) / np.sqrt(3.0)
    error += worse * motion[..., None] * rng.standard_normal((m, 3)) + np.linspace(0.0, 1e-3, k)[:, None, None]
    error[rng.random((k, m)) < 0.05] = np.nan
    alone, one = unshared_by_neighbours(error, PLACES), np.ones((k, m, 3)) / 3.0
    model = np.repeat((worse * motion[..., None]) ** 2, 3, axis=2)
    found = varying_share(alone, np.repeat(looks[..., None], 3, axis=2), LASTS**2 * one, NOISE**2 * one, model)
    assert found == pytest.approx(varies, abs=0.08)


def test_markers_that_have_one_look_each_do_not_tell_how_long_an_error_lasts():
    one = np.ones((9, 5, 3))
    assert varying_share(0.0 * one, np.zeros((9, 5, 3), int), one, one, one) == 1.0


def test_a_marker_that_moves_by_less_than_a_pixel_does_not_tell_it_where_others_do():
    points = np.zeros((9, 3, 3))
    points[:, 0, 2], points[:, 1, 0] = np.linspace(0.0, 1e-3, 9), np.linspace(0.0, 1e-4, 9)
    assert far_apart(points, 4e-4).sum() == far_apart(points, 4e-4)[0, 2] == 1
    assert far_apart(points[:, 1:], 4e-4).all()


@pytest.mark.parametrize("n_looks", [1, 5, 30])
def test_an_error_for_good_is_one_datum_however_often_it_is_looked_at(n_looks: int):
    """It was averaged down by the root of the number of looks."""
    k, m = 30, 4
    points = np.zeros((k, m, 3))
    rows = rows_of(points, None, np.zeros(k, int))
    noise, roots = np.tile(REPEATS**2 * np.eye(3), (k, m, 1, 1)), np.tile(LASTS * np.eye(3), (k, m, 1, 1))
    looks = np.tile(np.arange(k)[:, None] % n_looks, (1, m))
    constant = rows.take(np.full(points.shape, LASTS))

    def size(varies: float) -> float:
        still, exact = np.zeros((k, m)), ModelErrors(np.full(m, 1e-9))
        steady = Steady(looks, roots, varies)
        C = covariance_of(rows, noise, still, np.zeros(k, int), exact, steady=steady, settings=ALLOWANCE)
        return float(np.sum(C.whitener.whiten(constant) ** 2)) / (3 * m)

    assert 0.9 < size(0.0) <= 1.0
    assert size(1.0) == pytest.approx(n_looks / (1.0 + n_looks / k * (REPEATS / LASTS) ** 2), rel=0.01)


def test_recordings_of_unlike_trackers_share_one_error():
    """One states three times the other's sigma: the mean of their covariances between them were none."""
    o = observed(0.0, 1e-4, 0, "a", 5)
    both = []
    for size in (1e-4, 3e-4):
        shape = np.tile(size**2 * np.diag([1.0, 1.0, 4.0]), (len(PLACES), 1, 1))
        both.append(replace(o, noise=replace(o.noise, covariance=shape, ratio=0.2)))
    points = np.tile(PLACES, (2 * o.n_moments, 1, 1))
    errors, still = ModelErrors(np.full(len(PLACES), PLACE)), np.zeros(points.shape[:2])
    steady = steady_of(both, points, np.zeros(points.shape), errors, still, np.zeros(len(points), int), ALLOWANCE.look)
    C = steady.of(7, np.repeat([0, o.n_moments], 3), np.tile([0, 1, 2], 2))
    assert np.diag(C) == pytest.approx(0.8e-8 * np.array([1.0, 1.0, 4.0, 9.0, 9.0, 36.0]))
    assert np.linalg.eigvalsh(C).min() > -1e-12 * C.max()
    assert C[2, 5] == pytest.approx(np.sqrt(C[2, 2] * C[5, 5]))


def test_what_a_tracker_states_of_a_constant_error_is_no_residual():
    """Of 0.15 mm four in ten were `unexplained` (p = 4e-5 at chi2 0.55), though nothing was missing."""
    found = diagnosed(1.5e-4, 0, names=NAMES)
    assert found.verdict == "undecided" and not found.effects
    assert "could have stayed unseen" in found.text


@pytest.mark.statistical
@pytest.mark.parametrize("size", [1e-4, 1.5e-4, 3e-4])
def test_no_constant_error_that_is_stated_is_an_effect(size):
    verdicts = [diagnosed(size, seed).verdict for seed in range(10)]
    assert set(verdicts) <= {"none", "undecided"}
