"""The record of the loop's numbers: every one says what it is, is used, is written, and is handed in."""

from __future__ import annotations

import json
import re
from dataclasses import FrozenInstanceError, fields, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import toy
import toy_loop as loop

from benchmarks import house
from livedeform.closed_loop.inputs import Inputs
from livedeform.closed_loop.settings import Settings, n_deciding
from livedeform.closed_loop.write import write_diagnosis

LOOP = Path(__file__).parents[2] / "src" / "livedeform" / "closed_loop"
NUMBERS = [(part.name, f) for part in fields(Settings) for f in fields(getattr(Settings(), part.name))]


@cache
def words() -> set[str]:
    """What stands after a dot in the closed loop's code."""
    sources = [p.read_text() for p in LOOP.rglob("*.py") if p.name != "settings.py"]
    return {word for s in sources for word in re.findall(r"\.(\w+)\b", s)}


@pytest.mark.parametrize(("part", "number"), NUMBERS, ids=lambda x: x if isinstance(x, str) else x.name)
def test_every_number_says_what_it_is_and_is_used(part, number):
    card = number.metadata
    assert card["role"] in ("decides", "allows", "effort") and card["unit"] and card["what"] and card["measured"]
    assert number.name in words(), f"{part}.{number.name} is read nowhere"


def test_pages_of_evidence_are_there():
    pages = {page for _, f in NUMBERS for page in re.findall(r"evidence/([\w-]+)", f.metadata["measured"])}
    assert pages and all((LOOP.parents[2] / "docs" / "evidence" / f"{page}.md").exists() for page in pages)


def test_few_numbers_decide():
    assert n_deciding(Settings()) <= 45  # measured 45


def test_no_number_that_decides_stands_elsewhere():
    """Constants beside the code are definitions, guards and steps of differences, each named by the figures."""
    counted = house.thresholds(house.Tree(house.SRC))[0].counted
    assert not [row for row in counted if "Settings." not in row]


def test_they_are_frozen():
    with pytest.raises(FrozenInstanceError):
        Settings().selection.alpha = 0.5


def test_a_verdict_follows_the_settings_that_are_handed_in():
    tilt = [toy.effect("gravity_tilt", angle_x=0.06, angle_y=0.02)]
    default = Settings()
    strict = replace(default, selection=replace(default.selection, min_score=1e9))
    found = loop.closed(tilt, settings=strict)
    assert not found.added and found.verdict == "unexplained"
    deaf = replace(strict, verdict=replace(strict.verdict, p_value=0.0))
    assert loop.closed(tilt, settings=deaf).verdict == "undecided"  # nothing could have been found
    deaf = replace(deaf, verdict=replace(deaf.verdict, matters=np.inf))
    assert loop.closed(tilt, settings=deaf).verdict == "none"


def test_they_lie_beside_the_diagnosis(tmp_path):
    settings = replace(Settings(), verdict=replace(Settings().verdict, min_explained=0.8))
    result = loop.closed([], settings=settings)
    places = np.zeros((1, 3))
    inputs = Inputs((), (), {}, toy.uncertain(places), places, loop.ProbeReach(places[0], places[0]), settings=settings)
    write_diagnosis(result, inputs, tmp_path)
    written = json.loads((tmp_path / "settings.json").read_text())
    assert written["verdict"]["min_explained"] == {
        "value": 0.8,
        "role": "decides",
        "unit": "1",
        **{k: settings.as_dict()["verdict"]["min_explained"][k] for k in ("what", "measured")},
    }
    assert set(written) == {part.name for part in fields(Settings)}
