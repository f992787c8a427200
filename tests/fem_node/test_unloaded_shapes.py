"""Unloaded shapes are found once for each body and each direction, and near one that is known from there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bodies import block_space, soft

from livedeform.fem_node.path import unloaded
from livedeform.fem_node.path.direction import Direction
from livedeform.fem_node.path.unloaded import InverseProblem, UnloadedShapes, unloaded_shape
from livedeform.fem_node.physics.fields import Uniform
from livedeform.fem_node.physics.record import Physics, Support

HUNG = replace(soft(), supports=(Support(lambda X: X[:, 2] < 1e-6),), scan_fraction=1.0)


def stiffer(ratio: float) -> Physics:
    return replace(HUNG, modulus_fields=(Uniform(ratio),))


def along(shapes: UnloadedShapes, physics: Physics, ratios: list[float]) -> list[np.ndarray]:
    directions = [Direction((str(ratio), 0), stiffer(ratio), 1e-3, None) for ratio in ratios]
    return [shape for shape in shapes.along(physics, shapes.of(physics), directions) if shape is not None]


def test_directions_that_were_followed_are_not_followed_again(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    plain = unloaded.changed_shapes

    def counted(problem: InverseProblem, w: np.ndarray, changed: list[Physics]) -> list[np.ndarray]:
        asked.append(len(changed))
        return plain(problem, w, changed)

    monkeypatch.setattr(unloaded, "changed_shapes", counted)
    shapes = UnloadedShapes(block_space())
    one = along(shapes, stiffer(2.0), [2.1, 2.2])
    two = along(shapes, stiffer(2.0), [2.2, 2.3, 2.1])
    assert asked == [2, 1] and two[0] is one[1] and two[2] is one[0]
    other = along(shapes, stiffer(2.05), [2.1])  # of another body, whose drift is taken off
    assert asked == [2, 1, 1] and other[0] is not one[0]


def test_a_body_starts_from_the_last_one_and_is_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    guesses: list[bool] = []
    plain = unloaded.unloaded_shape

    def seen(problem: InverseProblem, guess: np.ndarray | None = None) -> np.ndarray:
        guesses.append(guess is not None)
        return plain(problem, guess)

    monkeypatch.setattr(unloaded, "unloaded_shape", seen)
    shapes = UnloadedShapes(space := block_space())
    for ratio in (2.0, 2.1):
        found = shapes.of(stiffer(ratio))
        np.testing.assert_allclose(found, unloaded_shape(InverseProblem(space, stiffer(ratio))), atol=1e-11)
    assert guesses == [False, True]
