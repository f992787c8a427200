"""After a gap (a late start, a pause, a release long before the first frame) a body is where it is in a run of the
whole: one that rings rings on for as long as its damping lets it, and one that relaxes has crept as far."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from unittest.mock import Mock

import numpy as np
import pytest
from bodies import EXACT, block_space, plane, soft, symmetry
from scipy.optimize import newton

from livedeform.fem_node.effects import viscoelasticity
from livedeform.fem_node.element.element import make_space
from livedeform.fem_node.items.dynamics import MEMORY, STEP_ERROR
from livedeform.fem_node.items.swinging import seconds_of_swing
from livedeform.fem_node.mesh.structured import block_mesh
from livedeform.fem_node.model import PhantomModel
from livedeform.fem_node.path.direction import Direction
from livedeform.fem_node.path.mechanics import Mechanics
from livedeform.fem_node.path.timeline import MOST_FADING_STEPS, Timeline
from livedeform.fem_node.physics.record import Inertia, MaterialSpec, Physics, Prony, Support

SECOND, RELEASE, E = 1_000_000_000, 0.2, 300.0
SPACE = make_space(block_mesh((0.03, 0.03, 0.07), (1, 1, 2), origin=(-0.015, -0.015, 0.0)))
TOP = np.array([[0.0, 0.0, 0.07]])
BODY = Physics(
    material=MaterialSpec("linear", E, 0.4),
    supports=(Support(plane(2, 0.0)),),
    gravity=np.array([0.05, 0.0, -0.03]),
    release=RELEASE,
)
LIGHT, MIDDLE, HEAVY = 2e-3, 3e-2, 0.2  # s, of stiffness-proportional damping


def power_law(strength: float, exponent: float) -> Prony:
    law = viscoelasticity.POWER_LAW.expand({"strength": np.array(strength), "exponent": np.array(exponent)})
    return Prony(tuple(law["g"]), tuple(law["tau"]))


RELAXING = {
    "one term": Prony((0.5,), (2.0,)),
    "three terms": Prony((0.1, 0.2, 0.2), (0.05, 0.5, 3.0)),
    "a power law": power_law(0.3, 0.3),
}
GAPS = {"late start": (0.0, 4.5), "pause": (0.3, 4.5), "long before": (0.25, 9.0)}  # s, from and to


def top(physics: Physics, seconds: np.ndarray) -> np.ndarray:
    """Return how far (n, 3) m the top has moved at ``seconds`` (n,) of a recording, one predicted after another."""
    model = PhantomModel(SPACE, physics, markers=TOP)
    model.reset(0)
    return np.array([model.predict(None, round(SECOND * t)).markers[0] for t in seconds]) - TOP[0]


def after_a_gap(physics: Physics, gap: str, seconds: np.ndarray, whole: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the top (n, 3) m after a gap, of the ``whole`` and of a run without the frames in the gap."""
    begins, ends = GAPS[gap]
    kept = (seconds < begins) | (seconds >= ends)
    return whole[seconds >= ends], top(physics, seconds[kept])[seconds[kept] >= ends]


RINGING = {
    "lightly": replace(BODY, inertia=Inertia(LIGHT)),
    "somewhat": replace(BODY, inertia=Inertia(MIDDLE)),
    "well": replace(BODY, inertia=Inertia(HEAVY)),
    "lightly, and creeps": replace(BODY, inertia=Inertia(LIGHT), prony=Prony((0.2,), (30.0,))),
}
FRAMES = np.arange(0.0, 5.3, 0.1)  # s


@cache
def ringing(damped: str) -> np.ndarray:
    """Return the top (n, 3) m at all ``FRAMES``."""
    return top(RINGING[damped], FRAMES)


@pytest.mark.parametrize("gap", ["late start", "pause"])
@pytest.mark.parametrize("damped", [pytest.param(d, marks=[pytest.mark.slow] * (d[-1] != "y")) for d in RINGING])
def test_a_body_that_rings_rings_on_after_a_gap(damped: str, gap: str) -> None:
    """It was put to rest four seconds before each frame, whatever its damping."""
    whole, found = after_a_gap(RINGING[damped], gap, FRAMES, ringing(damped))
    swing, size = np.ptp(whole[:, 0]), np.abs(whole).max()
    assert swing > 0.1 * size or "lightly" not in damped
    assert np.abs(found - whole).max() < 0.1 * swing + 1e-3 * size  # other steps of time: of the period 0.2 % each


@pytest.mark.parametrize("gap", GAPS)
@pytest.mark.parametrize("law", RELAXING)
def test_a_body_that_creeps_has_crept_as_far_after_a_gap(law: str, gap: str) -> None:
    """One step over the gap was wrong by 1 to 4 %, and crept falsely afterwards."""
    seconds = np.arange(0.0, 11.0, 0.1)
    physics = replace(BODY, prony=RELAXING[law])
    whole, found = after_a_gap(physics, gap, seconds, top(physics, seconds))
    assert np.abs(found - whole).max() < 2.5e-3 * np.abs(whole).max()


@pytest.mark.parametrize(
    ("physics", "within"),
    [
        (replace(BODY, prony=RELAXING["one term"]), 4e-3),
        pytest.param(RINGING["lightly"], 0.1, marks=pytest.mark.slow),
    ],
    ids=["creeps", "rings"],
)
def test_moments_far_apart_are_simulated_with_their_sensitivities_as_dense_ones(
    physics: Physics, within: float
) -> None:
    """As a diagnosis has it, whose moments are chosen: of a swing, and of creep."""
    dense, few = np.arange(0.0, 5.5, 0.1), [0.3, 0.5, 5.0, 5.2, 5.4]
    direction, runs = Direction("modulus", physics.with_material(youngs_modulus=E * (1.0 + 1e-5)), 1e-5), []
    for seconds in (dense, np.array(few)):
        stamps = [round(SECOND * t) for t in seconds]
        run = PhantomModel(SPACE, physics, markers=TOP).simulate(None, stamps, [direction], start_ns=0)
        at = [stamps.index(round(SECOND * t)) for t in few]
        runs.append((np.array([run.predictions[k].markers[0] for k in at]) - TOP[0], run.d_markers[at, 0, :, 0]))
    for whole, found in zip(*runs, strict=True):
        np.testing.assert_allclose(found, whole, atol=within * np.abs(whole).max())


# -- for how long it swings ------------------------------------------------------------------------------------------

L, SIDE, RHO = 0.1, 0.02, 1000.0
OMEGA = np.pi / 2 * np.sqrt(E / RHO) / L  # of the first longitudinal mode
BAR = replace(soft(0.0, E), supports=symmetry(0, 1, 2), material=MaterialSpec("linear", E, 0.0))


@pytest.mark.parametrize("inertia", [Inertia(LIGHT), Inertia(0.02), Inertia(0.0, 0.3), Inertia(0.0)])
def test_a_swing_lasts_as_the_slowest_mode_fades(inertia: Inertia) -> None:
    bar = Mechanics(block_space((SIDE, SIDE, L), (1, 1, 4), kind="p2"), replace(BAR, inertia=inertia), settings=EXACT)
    fades = 0.5 * (inertia.rayleigh_alpha + inertia.rayleigh_beta * OMEGA**2)
    exact = np.inf if fades == 0.0 else -np.log(STEP_ERROR) / fades
    before = bar.save()
    assert bar.swings_for() == pytest.approx(exact, rel=2e-3)
    assert bar.moment is before.moment and bar.x is before.x


def test_a_swing_of_a_body_that_relaxes_lasts_as_its_complex_modulus_says() -> None:
    """Of a bar, which is stiff by its bulk as well (as in `test_ringing`)."""
    g, tau, K, mu = np.array([0.25, 0.1]), np.array([0.02, 0.2]), E / 3.0, E / 2.0

    def off(s: complex) -> complex:
        now = mu * (1.0 + np.sum(g / (1.0 - g.sum()) * s * tau / (1.0 + s * tau)))
        return s**2 + OMEGA**2 * 9.0 * K * now / (3.0 * K + now) / E

    exact = -np.log(STEP_ERROR) / -newton(off, complex(-2.0, OMEGA)).real
    found = seconds_of_swing(replace(BAR, inertia=Inertia(), prony=Prony(tuple(g), tuple(tau))), OMEGA)
    assert exact < found < 1.15 * exact  # it must not be less; measured 1.10


def test_too_strong_a_damping_is_no_short_memory() -> None:
    """The slower part of an overdamped mode fades ever more slowly, the more it is damped."""
    for beta in (1.0, 3.0, 9.0):
        c = beta * OMEGA**2
        slower = c / 2.0 - np.sqrt(c**2 / 4.0 - OMEGA**2)
        lasts = seconds_of_swing(replace(BAR, inertia=Inertia(beta)), OMEGA)
        assert -np.log(STEP_ERROR) / slower <= lasts < -np.log(STEP_ERROR) / slower * 1.1


# -- what it costs ---------------------------------------------------------------------------------------------------


def passed(body: Mock, *, dynamic: bool, now: float, then: float) -> list[tuple[float, bool]]:
    """Return where (s) the steps end, and whether they are without inertia."""
    line = Timeline(0, 0, release=RELEASE, dynamic=dynamic)
    steps = line.instants(round(SECOND * now), round(SECOND * then), body)
    return [(i.stamp_ns / SECOND, i.still) for i in steps]


def test_a_well_damped_body_is_followed_for_no_longer_than_it_was() -> None:
    body = Mock(pace=lambda: 0.04, pace_at_rest=lambda: np.inf, swings_for=lambda: 1.0)
    (first, still), *more = passed(body, dynamic=True, now=1.0, then=60.0)
    assert still and first == pytest.approx(60.0 - MEMORY) and len(more) == pytest.approx(MEMORY / 0.04, abs=1)
    body.swings_for = Mock(return_value=1.0)
    assert all(not still for _, still in passed(body, dynamic=True, now=1.0, then=1.0 + MEMORY))
    body.swings_for.assert_not_called()  # costs a factorisation


def test_frames_that_scatter_take_a_step_each_and_a_gap_few() -> None:
    """A power law's shortest time is far below the frames', which a run of the whole does not resolve either."""
    steps, n, rng = [], [], np.random.default_rng(2)
    model = PhantomModel(SPACE, replace(BODY, prony=RELAXING["a power law"], release=0.0), markers=TOP)
    advance = model.mechanics.commit
    model.mechanics.commit = lambda x, moment: (steps.append(moment.dt), advance(x, moment))  # type: ignore[method-assign]
    seconds = np.cumsum(rng.uniform(0.025, 0.045, 20))
    for t in seconds:
        model.predict(None, round(SECOND * t))
        n.append(len(steps))
    assert n[-1] - n[4] == len(n) - 5 and n[4] < 2 * MOST_FADING_STEPS  # once the body has begun
    model.predict(None, round(SECOND * (seconds[-1] + 30.0)))
    assert 1 < len(steps) - n[-1] <= MOST_FADING_STEPS
