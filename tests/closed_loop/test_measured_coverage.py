"""What a report says of how often its intervals hold."""

import re
from dataclasses import replace
from pathlib import Path

from livedeform.closed_loop.candidates import all_effects
from livedeform.closed_loop.measured_coverage import coverage_notes, family_of

CARDS = all_effects()


def test_every_effect_has_a_family_and_those_with_a_shape_have_their_own():
    families = {name: family_of(info) for name, info in CARDS.items()}
    assert families["skin"] == "layers"
    assert families["inclusion"] == "inclusions"
    assert families["stiffness"] == "the body's material"
    assert families["gravity_tilt"] == families["base_slip"] == "support and weight"
    assert families["probe_offset"] == "the probe"
    assert families["camera_motion"] == "measuring"


def test_a_family_is_said_once_with_all_that_was_measured_of_it():
    two = [replace(CARDS["gravity_tilt"], proved=(27, 30)), replace(CARDS["base_slip"], proved=(20, 20))]
    said = coverage_notes(two, two)
    assert said == [
        "95 % intervals of this family (support and weight) held in 94 % of 50 blind values, given the effect"
    ]


def test_an_effect_that_was_not_measured_borrows_no_other_s_number():
    cards = [replace(CARDS["stiffness"], proved=(47, 50)), CARDS["viscoelasticity"]]
    said = coverage_notes(cards[1:], cards)
    assert said == ["how often 95 % intervals of viscoelasticity hold has not been measured"]


def test_reports_say_what_the_evidence_has_of_seeds_that_nobody_had_looked_at():
    """Cards counted seeds by which the code had been changed: layers were said to hold in 48 of 48 values."""
    text = (Path(__file__).parents[2] / "docs" / "evidence" / "intervals.md").read_text()
    rows = re.findall(r"^\| ([a-z' ]+) \| \**(\d+) of (\d+)\**[ :]", text, flags=re.MULTILINE)
    told = {family: (int(held), int(n)) for family, held, n in rows}
    claimed: dict[str, tuple[int, int]] = {"all": (0, 0)}
    for info in CARDS.values():
        for family in {family_of(info), "all"} if info.proved[1] else ():
            held, n = claimed.get(family, (0, 0))
            claimed[family] = held + info.proved[0], n + info.proved[1]
    assert claimed == told
