"""Each added effect earns itself on what was held out, or goes out again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import phantom
import pytest
import toy
from scipy.optimize import lsq_linear
from toy_loop import PLACES, closed, toy_inputs

from livedeform.closed_loop.assessment.called_for import Called
from livedeform.closed_loop.assessment.earning import Earned, Earning, Fall, Predicted, fall, force_fall, left_out
from livedeform.closed_loop.assessment.held_out import HeldOutErrors
from livedeform.closed_loop.borne_out import HeldOutRuns, earning, may_be_nothing, more_than_nothing, refitted_without
from livedeform.closed_loop.evidence.observation import Observation
from livedeform.closed_loop.forward import ForwardModel, Run
from livedeform.closed_loop.inference.fitted_model import Added, FittedModel
from livedeform.closed_loop.inference.forward_selection import ForwardSelection, Selection, SelectionStep
from livedeform.closed_loop.inference.gauss_newton import Fit
from livedeform.closed_loop.inputs import Inputs
from livedeform.closed_loop.model.fem_model import Body
from livedeform.closed_loop.model.workers import FemModel
from livedeform.fem_node.contact.probe_shapes import make_shape
from livedeform.fem_node.physics.record import Probe

RULE = toy.SETTINGS.verdict
FLOOR = 1.8e-4  # m, noise of a single frame
SIGMA = FLOOR / np.sqrt(3.0)  # of a coordinate
MATTERS = (RULE.min_excess * FLOOR) ** 2
RELAXES = toy.effect("viscoelasticity", g=[0.2], tau=[2.0])
TILTS = toy.effect("gravity_tilt", angle_x=0.08, angle_y=0.03)


def earned(taken: float, called: float, sigma: float, moved: float = 2.0, force: Fall | None = None) -> Earned:
    """Earn by moving the markers by that many times what matters, in squares."""
    same = Fall(0.0, MATTERS, FLOOR**2)
    return Earned("skin", taken, Called(called, sigma, moved * RULE.min_excess**2), same, force, FLOOR, FLOOR)


def test_an_effect_has_to_do_both_beat_chance_and_matter():
    assert earned(30.0, 1.0, 0.2).is_enough(RULE)
    assert not earned(RULE.against - 0.1, 1.0, 0.2).is_enough(RULE)  # chance
    assert not earned(600.0, 1.0, 0.0, 0.9).is_enough(RULE)  # beyond chance, and too small to matter
    assert not earned(600.0, 1.0, 0.6).is_enough(RULE)  # not known to matter: it betters one press and worsens others
    assert not earned(600.0, -2.0, 0.2).is_enough(RULE)  # chi2 falls by the force, and the markers call for none
    assert not earned(float("nan"), 1.0, 0.2).is_enough(RULE)


def test_an_effect_of_a_set_that_earns_itself_together_has_to_beat_chance():
    """Without the stiffness of a released beam its level is still right, as the others follow, and its swing wrong."""
    assert earned(524.0, -1.0, 0.8).is_enough(RULE, of_a_set=True)
    assert not earned(RULE.against - 0.1, 1.0, 0.2).is_enough(RULE, of_a_set=True)


def test_what_shows_itself_in_the_force_alone_stays_if_it_is_beyond_what_is_allowed_there():
    assert earned(600.0, 0.0, 0.1, force=Fall(2.0, 0.5, 1.0)).is_enough(RULE)
    assert not earned(600.0, 0.0, 0.1, force=Fall(0.9, 0.0, 1.0)).is_enough(RULE)


def test_why_an_effect_went_out_has_its_figures():
    """Chi2 and millimetres are of a cuboid of another solver without an effect; what is called for is made up."""
    same = Fall(0.0, MATTERS, FLOOR**2)
    one = Earned("skin", 23.0, Called(0.62, 0.21, 0.04), same, None, 1.799e-4, 1.810e-4)
    text = one.sentence(RULE)
    assert not one.is_enough(RULE)
    assert "takes 23.0 off chi2: they call for 0.62 +- 0.21 of it" in text
    assert "moves the markers by 0.20 of their noise, where 0.1 matters" in text
    assert "0.1799 to 0.1810 mm" in text and text.endswith(": taken out")


def errors(
    measured: np.ndarray, predicted: np.ndarray, blocks: np.ndarray, sigma: float | np.ndarray = SIGMA
) -> HeldOutErrors:
    k, m, _ = measured.shape
    covariances = np.broadcast_to(np.eye(3) * sigma**2, (k, m, 3, 3))
    weights = np.linspace(1.0, 2.0, k)
    one = toy.recording_errors(measured, predicted, covariances, weights, blocks + 1, blocks=blocks)
    return HeldOutErrors((one,))


def test_the_fall_is_that_of_the_mean_square_and_its_error_counts_presses_not_points():
    """The same scatter over ten presses and over as many points of one press: one is known, the other is not."""
    rng = np.random.default_rng(0)
    k, m = 40, 30
    truth = rng.normal(size=(k, m, 3)) * FLOOR
    noise = rng.normal(size=(k, m, 3)) * FLOOR / np.sqrt(3.0)
    blocks = np.arange(k) // 4
    found = fall(errors(truth + noise, 0.0 * truth, blocks), errors(truth + noise, truth, blocks), FLOOR**2)
    assert found.value / found.of == pytest.approx(3.0, rel=0.1)
    assert 0.0 < found.sigma < 0.1 * found.value
    sign = np.where(blocks < 5, 1.0, -1.0)[:, None, None]  # right in half of the presses, as wrong in the others
    wrong = fall(
        errors(sign * truth + noise, 0.0 * truth, blocks), errors(sign * truth + noise, truth, blocks), FLOOR**2
    )
    assert wrong.sigma > 0.2 * wrong.of and not wrong.matters(RULE.min_excess**2)
    once = fall(errors(truth, 0.0 * truth, 0 * blocks), errors(truth, truth, 0 * blocks), FLOOR**2)
    assert not once.matters(RULE.min_excess**2)  # one press says nothing of the next
    let_go = fall(errors(truth, 0.0 * truth, 0 * blocks), errors(truth, truth, 0 * blocks), FLOOR**2, pressed=False)
    assert let_go.matters(RULE.min_excess**2)


def test_an_effect_that_worsens_the_error_in_millimetres_does_not_stay():
    good, bad = Called(1.0, 0.1, 0.1), Fall(-3.0 * MATTERS, MATTERS, FLOOR**2)
    assert not Earned("skin", 600.0, good, bad, None, FLOOR, FLOOR).is_enough(RULE)
    assert Earned("skin", 600.0, good, replace(bad, sigma=4.0 * MATTERS), None, FLOOR, FLOOR).is_enough(RULE)


def test_a_marker_that_was_not_seen_does_not_count():
    points = np.zeros((8, 3, 3))
    measured = np.full_like(points, FLOOR)
    measured[:, 1] = np.nan
    found = fall(
        errors(measured, points, np.arange(8) // 2), errors(measured, points + FLOOR, np.arange(8) // 2), FLOOR**2
    )
    assert found.value == pytest.approx(3.0 * FLOOR**2)


def test_the_force_is_compared_with_what_is_allowed_for():
    o = replace(toy.record([], seed=0, n=12), forces=np.tile([0.0, 0.0, 1.0], (12, 1)), force_sigma=0.01)
    runs = [[Run(o.points, f * o.forces, np.zeros((*o.points.shape, 0)), None)] for f in (0.9, 1.0)]
    found = force_fall([o], *runs, 0.03)
    assert found.value == pytest.approx(0.01) and found.of == pytest.approx(3e-4 + 9e-4)
    assert force_fall([replace(o, forces=None)], *runs, 0.03) is None


def _two_alike(*truth: float) -> tuple[FittedModel, np.ndarray, np.ndarray]:
    """Two effects of three coordinates that look alike, with the linear problem's Jacobian and data."""
    rng = np.random.default_rng(1)
    known = toy.candidates(PLACES, ["gravity_tilt", "density"])
    J = rng.normal(size=(60, 3))
    J[:, 2] = J[:, 0] + 0.3 * J[:, 2]
    y = J @ truth + 0.01 * rng.normal(size=60)
    z = np.linalg.solve(J.T @ J, J.T @ y)
    fit = Fit(z, np.linalg.inv(J.T @ J), z, z > 9.0, 100.0, y - J @ z, J, 1, True)
    added = (Added(known["gravity_tilt"], z[:2]), Added(known["density"], z[2:]))
    return FittedModel(toy.uncertain(PLACES), added, fit), J, y


def test_the_others_follow_to_where_their_fit_then_is():
    """Without the one, the other takes its place, as a fit of a linear problem has it."""
    model, J, y = _two_alike(0.1, -0.2, 0.05)
    for number, kept in ((0, [2]), (1, [0, 1])):
        free, change, covariance = left_out(model, number)
        expected = np.zeros(3)
        expected[kept] = np.linalg.lstsq(J[:, kept], y, rcond=None)[0]
        assert free.tolist() == kept
        np.testing.assert_allclose(model.joint.z + change, expected, atol=1e-9)
        np.testing.assert_allclose(covariance, np.linalg.inv(J[:, kept].T @ J[:, kept]), atol=1e-9)


def test_the_others_follow_no_further_than_they_may():
    """A time that the data hardly tell went to ages, and its law below zero: it seemed as good without the effect."""
    model, J, y = _two_alike(0.7, -0.2, 0.35)
    upper, low = model.added[0].candidate.array("upper"), model.added[0].candidate.array("lower")
    unbounded = np.linalg.lstsq(J[:, :2], y, rcond=None)[0]
    free, change, covariance = left_out(model, 1)
    z = model.joint.z + change
    assert ((unbounded > upper) | (unbounded < low)).any()
    assert np.all(z[:2] <= upper + 1e-9) and np.all(z[:2] >= low - 1e-9)
    np.testing.assert_allclose(z[:2], lsq_linear(J[:, :2], y, bounds=(low, upper)).x, atol=1e-6)
    assert free.tolist() == [1] and covariance == pytest.approx(1.0 / (J[:, 1] @ J[:, 1]))  # the other is at its bound


def recorded(truth: list, seed: int = 3) -> tuple[Observation, Observation]:
    return toy.record(truth, seed=seed, name="fit", n=36), toy.record(truth, seed=seed + 1000, name="test", n=36)


@dataclass(frozen=True)
class Case:
    """A toy body's recordings with a model that was fitted to the first, whatever it earns."""

    method: ForwardSelection
    found: Selection
    tested: HeldOutRuns
    inputs: Inputs


def fitted(records: Sequence[Observation], given: list, model: ForwardModel | None = None) -> Case:
    fit, test = records
    names = [e.name for e in given]
    inputs, model = toy_inputs(fit, test, names), model or toy.ToyModel(toy.ToyBody(PLACES))
    method = ForwardSelection.of(toy.SETTINGS, model, inputs.fitted, inputs.candidates, inputs.uncertain)
    last = method.linearised(method.declared, None, None)
    added = tuple(Added(inputs.candidates[e.name], inputs.candidates[e.name].coordinates_of(e.values)) for e in given)
    joint = method.fitter.refit(last.problem, replace(method.declared, added=added))
    assert joint is not None
    step = SelectionStep(method.screen(method.declared, last.problem, last.dictionary), {}, names[-1], "given")
    found = Selection(inputs.fitted, inputs.candidates, joint, (step,), last, last, last.problem)
    return Case(method, found, HeldOutRuns.of(model, inputs, method, found, []), inputs)


def test_to_first_order_it_earns_what_it_does_by_a_fit_without_it():
    case = fitted(recorded([RELAXES, TILTS]), [RELAXES, TILTS])
    rule = Earning(toy.SETTINGS, case.inputs.held_out, False)
    for number in range(2):
        quick = rule.of_part(number, case.tested.given)
        again = refitted_without(case.method, case.found, number)
        whole = rule.of(quick.name, case.tested.by(case.method, case.inputs, again).given, case.tested.given)
        assert quick.is_enough(RULE) and whole.is_enough(RULE)
        assert quick.taken == pytest.approx(whole.taken, rel=0.1)
        assert quick.called.share == pytest.approx(whole.called.share, rel=0.1)
        assert quick.called.moved == pytest.approx(whole.called.moved, rel=0.1)


def test_a_needless_effect_goes_out_and_the_true_one_stays():
    needless = toy.effect("stiffness_gradient", slope=0.5)
    case = fitted(recorded([RELAXES]), [needless, RELAXES])
    found, tested, outs = earning(case.inputs, case.method, case.found, case.tested, [])
    assert found.model.names == tested.model.names == ["viscoelasticity"]
    assert [e.name for e in outs] == ["stiffness_gradient"]
    assert found.steps[-1].reason == outs[0].sentence(RULE) and not found.steps[-1].added
    none = Predicted(FittedModel(case.inputs.uncertain), tested.before, [])
    assert Earning(toy.SETTINGS, case.inputs.held_out, False).of("viscoelasticity", none, tested.given).is_enough(RULE)


def test_an_effect_whose_stated_values_may_be_nothing_goes_out_however_sure_the_fit_is_of_it() -> None:
    """Presses disagree on what stands for another cause. Blind, a probe_offset of (-2.0 +- 1.6, -0.6 +- 0.8, 0.0 +-
    0.2) mm was named beside an inclusion (203), and a tilt of 1.7 sigmas for what a tether did (193)."""
    case = fitted(recorded([RELAXES]), [toy.effect("stiffness_gradient", slope=0.5), RELAXES])
    assert may_be_nothing(case.inputs, case.found, case.found.model) == ["stiffness_gradient"]
    found, tested = more_than_nothing(case.inputs, case.method, case.found, case.tested)
    assert found.model.names == tested.model.names == ["viscoelasticity"]
    assert found.steps[-1].reason.startswith("stiffness_gradient may be nothing") and not found.steps[-1].added
    joint = found.model.joint
    assert joint is not None and not may_be_nothing(case.inputs, found, found.model)
    unsure = replace(joint, covariance=1e4 * joint.covariance)
    case = replace(case, found=replace(found, model=replace(found.model, joint=unsure)))
    assert may_be_nothing(case.inputs, case.found, case.found.model) == ["viscoelasticity"]
    alone, _ = more_than_nothing(case.inputs, case.method, case.found, tested)
    assert alone is case.found  # it is judged with the verdict


def test_where_nothing_is_missing_nothing_stays():
    case = fitted(recorded([]), [toy.effect("stiffness_gradient", slope=0.5), TILTS])
    found, _, outs = earning(case.inputs, case.method, case.found, case.tested, [])
    assert len(outs) == 2 and len(found.model.names) == 1  # the last one is judged with the verdict


def test_what_another_solver_gets_different_is_not_named_piece_by_piece():
    """A body of more detail than the model's: an offset takes a tenth of the noise off, and a Poisson's ratio half of
    that. Without the rule both were named."""
    said = closed([], seed=6, detail=0.05, names=("viscoelasticity", "probe_offset", "poisson_ratio"))
    assert said.verdict == "undecided" and not said.effects
    assert "poisson_ratio" in said.text and "probe_offset" in said.text and said.text.count("taken out") == 2


def in_fem(o: Observation, body: Body, effects: Sequence) -> Observation:
    """Replace what a toy body does in a recording by what a finite-element body does."""
    run = body.simulate(list(effects), o, [])
    more = run.points - toy.ToyBody(PLACES).points([], o.seconds, np.array([p.position for p in o.poses]))
    return replace(o, points=o.points + more, single=o.single + more)


@pytest.mark.slow
def test_in_finite_elements_a_tilt_stays_and_what_was_fitted_beside_it_goes_out():
    """The truth's probe is wider by 0.5 mm, which no candidate says; the tilt is 1.5 times as large as the noise."""
    tilt = toy.effect("gravity_tilt", angle_x=0.06, angle_y=0.02)
    names = ("fit", "test")
    plain = phantom.setting(2, names)
    other = phantom.setting(2, names, probe=Probe(make_shape("box", (0.06, 0.0155, 0.04), 0.002)))
    records = [toy.record([], seed=s, name=n, n=14) for s, n in zip((1, 2), names, strict=True)]
    fit, test = (in_fem(o, Body(other), [tilt]) for o in records)
    with FemModel(plain, 1) as model:
        case = fitted((fit, test), [toy.effect("skin", ratio=1.1, thickness=0.005), tilt], model)
        found, tested, outs = earning(case.inputs, case.method, case.found, case.tested, [])
    assert found.model.names == ["gravity_tilt"] and [e.name for e in outs] == ["skin"]
    alone = Predicted(FittedModel(case.inputs.uncertain), tested.before, [])
    assert Earning(toy.SETTINGS, case.inputs.held_out, False).of("gravity_tilt", alone, tested.given).is_enough(RULE)
