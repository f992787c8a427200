"""What a report says of how often its intervals hold."""

from livedeform.closed_loop.candidates import all_effects
from livedeform.closed_loop.measured_coverage import MEASURED, Proved, coverage_notes, family_of

CARDS = all_effects()


def test_every_effect_has_a_family_and_those_with_a_shape_have_their_own():
    families = {name: family_of(info) for name, info in CARDS.items()}
    assert families["skin"] == "layers"
    assert families["inclusion"] == "inclusions"
    assert families["stiffness"] == "the body's material"
    assert families["gravity_tilt"] == families["base_slip"] == "support and weight"
    assert families["probe_offset"] == "the probe"
    assert families["camera_motion"] == "measuring"


def test_a_family_that_was_measured_is_said_once():
    measured = {"support and weight": Proved(47, 50, ("gravity_tilt", "base_slip"))}
    said = coverage_notes([CARDS["gravity_tilt"], CARDS["base_slip"]], measured)
    assert said == ["95 % intervals of this family (support and weight) held in 94 % of 50 blind values"]


def test_an_effect_that_was_not_measured_borrows_no_other_s_number():
    measured = {"the body's material": Proved(47, 50, ("stiffness",))}
    said = coverage_notes([CARDS["viscoelasticity"]], measured)
    assert said == ["how often 95 % intervals of viscoelasticity hold has not been measured"]


def test_what_was_measured_is_of_known_effects_in_their_family():
    for family, proved in MEASURED.items():
        assert 0 < proved.held <= proved.n
        assert {family_of(CARDS[name]) for name in proved.effects} == {family}
