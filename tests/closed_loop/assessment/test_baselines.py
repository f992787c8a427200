"""Baselines: simpler methods, on made-up data: each finds what it can find, and no more."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest

from livedeform.closed_loop.assessment.baselines import (
    by_bic,
    by_signature,
    not_falsified,
    process_discrepancy,
    process_inputs,
)
from livedeform.closed_loop.inference.screening import DictionaryEntry
from livedeform.closed_loop.settings import BaselineSettings

N, BASELINES = 600, BaselineSettings()


@dataclass
class _Rows:
    marker: np.ndarray


@dataclass
class _Covariance:
    blocks: tuple[np.ndarray, ...]


@dataclass
class _Nuisance:
    columns: np.ndarray


@dataclass
class _Problem:
    """As much of a `Problem` as these methods look at: noise of variance one, and nothing else uncertain."""

    rows: _Rows
    residual: np.ndarray
    covariance: _Covariance = field(default_factory=lambda: _Covariance((np.eye(N),)))
    nuisance: _Nuisance = field(default_factory=lambda: _Nuisance(np.zeros((N, 1))))


def entry(name: str, column: int) -> DictionaryEntry:
    one = np.ones(1)
    return DictionaryEntry(name, 0, (column,), one, -np.inf * one, np.inf * one, np.inf * one)


@pytest.fixture
def made():
    rng = np.random.default_rng(3)
    dictionary = rng.normal(size=(N, 2))
    return rng, dictionary, [entry("one", 0), entry("two", 1)], _Rows(np.zeros(N, int))


def test_bic_names_nothing_in_noise_and_the_right_column_otherwise(made):
    rng, dictionary, entries, rows = made
    noise = rng.normal(size=N)
    assert by_bic(_Problem(rows, noise), dictionary, entries) == ""
    assert by_bic(_Problem(rows, noise + dictionary[:, 1]), dictionary, entries) == "two"


def test_a_signature_is_the_most_similar_column_if_any_is_similar(made):
    rng, dictionary, entries, rows = made
    noise = rng.normal(size=N)
    assert by_signature(_Problem(rows, noise), dictionary, entries, BASELINES)[0] == ""
    name, cosine = by_signature(_Problem(rows, noise + 2.0 * dictionary[:, 0]), dictionary, entries, BASELINES)
    assert name == "one"
    assert cosine == pytest.approx(2.0 / np.sqrt(5.0), abs=0.05)


def test_falsification_leaves_what_explains_every_datum(made):
    rng, dictionary, entries, rows = made
    noise = rng.normal(size=N)
    assert not_falsified(_Problem(rows, noise), dictionary, entries) == ("", "one", "two")
    assert not_falsified(_Problem(rows, noise + 5.0 * dictionary[:, 1]), dictionary, entries) == ("two",)
    noise[17] = 9.0  # one datum that nothing explains falsifies everything
    assert not_falsified(_Problem(rows, noise), dictionary, entries) == ()


def test_falsification_survives_as_often_as_it_says(made):
    _, dictionary, entries, rows = made
    rng = np.random.default_rng(8)
    survived = [not_falsified(_Problem(rows, rng.normal(size=N)), dictionary, entries)[:1] == ("",) for _ in range(400)]
    assert 0.92 < np.mean(survived) < 0.98


def test_a_gaussian_process_predicts_a_smooth_discrepancy_between_what_it_knows():
    rng = np.random.default_rng(4)
    places, moved = rng.uniform(-0.04, 0.04, (40, 3)), rng.uniform(0.0, 1.0, 20)
    points = places + moved[:, None, None] * 0.004 * np.array([0.0, 0.0, -1.0])
    inputs = process_inputs(points, places)
    truth = 2e-4 * np.sin(inputs[:, :3] / 0.02) * (inputs[:, 5:] / 0.004)
    known = np.arange(len(inputs)) % 2 == 0
    noisy = truth[known] + 2e-5 * rng.normal(size=(known.sum(), 3))
    error = process_discrepancy(inputs[known], noisy, inputs[~known], BASELINES) - truth[~known]
    assert np.sqrt(np.mean(error**2)) < 3e-5  # 2.2e-5 m; there are 8e-5 rms to be found
