"""What several held-out recordings let expect of another one, and that one says nothing of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import toy
from toy_loop import PLACES, toy_inputs

from livedeform.closed_loop.assessment.held_out import HeldOutErrors, RecordingErrors, next_recording
from livedeform.closed_loop.evidence.recordings import split
from livedeform.closed_loop.loop import investigate


def _errors(name: str, size: float) -> RecordingErrors:
    measured = np.full((4, 5, 3), size / np.sqrt(3.0))
    nothing = np.zeros((4, 5, 3, 3))
    return RecordingErrors(name, 0, np.arange(4), np.arange(5), measured, 0.0 * measured, nothing, np.ones(4),
                           np.arange(4))  # fmt: skip


def test_the_next_recording_is_expected_from_how_recordings_differ():
    before = HeldOutErrors(tuple(_errors(n, 4e-3) for n in "abc"))
    after = HeldOutErrors(tuple(_errors(n, v) for n, v in (("a", 1.0e-3), ("b", 1.1e-3), ("c", 1.21e-3))))
    found = next_recording(before, after)
    assert found is not None and found.error.n == 3 and found.error.value == pytest.approx(1.1e-3)
    half = 4.3027 * np.log(1.1) * np.sqrt(4.0 / 3.0)
    assert np.log(np.array(found.error.next) / 1.1e-3) == pytest.approx([-half, half], rel=1e-3)
    assert found.improvement[0] < 1.0 - 1.1 / 4.0 < found.improvement[1]


def test_one_recording_says_nothing_of_another():
    one = HeldOutErrors((_errors("a", 1e-3), _errors("a", 2e-3)))  # two parts of one
    assert next_recording(one, one) is None


def test_parts_of_what_was_fitted_say_nothing_of_another_recording():
    """Without --test, two recordings: it was "another recording like these 2", from parts that were laid down and
    registered with what was fitted."""
    whole = [toy.record([], seed=k, n=36, name=name) for k, name in enumerate(("monday", "tuesday"))]
    parts = [split(o) for o in whole]
    inputs = replace(
        toy_inputs(*whole, ["gravity_tilt"]),
        fitted=tuple(fitted for fitted, _ in parts),
        held_out=tuple(replace(held, before=fitted) for fitted, held in parts),
    )
    model = toy.ToyModel(toy.ToyBody(PLACES))
    assert investigate(model, inputs, seed=0).next_recording is None
    other = replace(inputs, fitted=(toy.record([], seed=2, n=36, name="sunday"),), held_out=tuple(whole))
    assert investigate(model, other, seed=0).next_recording is not None
