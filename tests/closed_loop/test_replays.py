"""What the diagnosis says of running the fitted model: with the recordings before, where a set stays."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import toy

from livedeform.closed_loop.assessment.next_experiment import ProbeReach
from livedeform.closed_loop.diagnosis import Replay, replays
from livedeform.closed_loop.evidence.recordings import split
from livedeform.closed_loop.inputs import Inputs

SET = toy.effect("plastic_set", fraction=0.1, threshold=0.05)


def test_a_set_needs_the_recordings_before() -> None:
    places = toy.markers()
    a = toy.record([], seed=0, name="a")
    a2 = replace(toy.record([], seed=1, name="a2"), before=a)
    b = replace(toy.record([], seed=2, name="b"), before=a2)
    paths: dict[str, Any] = {name: SimpleNamespace(path=Path(name)) for name in ("a", "a2", "b")}
    reach = ProbeReach(places[0], places[1])
    inputs = Inputs((a, a2), (b,), {}, toy.uncertain(places), places, reach, recordings=paths)
    assert replays(inputs, [b], [SET]) == (Replay(Path("b"), (Path("a"), Path("a2"))),)
    assert replays(inputs, [b], [toy.effect("stiffness", ratio=1.2)]) == (Replay(Path("b")),)
    assert replays(replace(inputs, declared=(SET,)), [b], [])[0].after == (Path("a"), Path("a2"))
    first, last = split(b)  # the held-out part of a recording goes on from its own first part
    assert replays(inputs, [replace(last, before=first)], [SET])[0].after == (Path("a"), Path("a2"))
    assert replays(replace(inputs, recordings={}), [b], [SET]) == ()
