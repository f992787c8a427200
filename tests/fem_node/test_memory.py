"""What a body remembers is said once, by `memory_of`, and everybody keeps to it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from bodies import block_space, soft, solve, symmetry

from livedeform.fem_node.contact.probe_shapes import Box
from livedeform.fem_node.effects import EFFECTS
from livedeform.fem_node.live.live_model import why_not_live
from livedeform.fem_node.path.tangents import answers_linearly
from livedeform.fem_node.path.timeline import Instant, Timeline
from livedeform.fem_node.path.unloaded import InverseProblem, unloaded_shape
from livedeform.fem_node.physics.fields import Ball, Drift, HeightGradient, Skin, Uniform
from livedeform.fem_node.physics.memory import as_scanned, memory_of, without_rubbing
from livedeform.fem_node.physics.record import (
    Inertia,
    Interface,
    ModulusField,
    Physics,
    PlasticSet,
    Probe,
    Prony,
    Support,
    VolumeRatio,
)

SHAPE = Box(0.02, 0.02, 0.02, 0.002)
STATIC = (Uniform(1.2), Ball((0.0, 0.0, 0.01), 0.005, 4.0), HeightGradient(3.0), Skin(0.003, 2.0), Drift(0.0))


def everywhere(points):
    return np.ones(len(points), bool)


@dataclass(frozen=True)
class Thaw(ModulusField):
    """A field that the model has never heard of."""

    changes_with_time = True
    rate: float = 0.1

    def __call__(self, X, t):
        return np.full(len(X), 2.0 + self.rate * t)


class Drying(VolumeRatio):
    changes_with_time = True

    def __call__(self, t):
        return 1.0 - 1e-3 * t


class Soaked(VolumeRatio):
    def __call__(self, t):
        return 1.06


@pytest.mark.parametrize(
    ("kind", "changes"),
    [
        ("rubs", {"probe": Probe(SHAPE, friction=0.3)}),
        ("rubs", {"probe": Probe(SHAPE, adhesion=200.0)}),
        ("rubs", {"probe": Probe(SHAPE, formulation="prescribed")}),
        ("slips", {"supports": (Support(everywhere, "friction", mu=0.4),)}),
        ("slips", {"interfaces": (Interface(everywhere, friction=0.3),)}),
        ("relaxes", {"prony": Prony((0.3,), (2.0,))}),
        ("sets", {"plastic_set": PlasticSet(0.1, 0.05)}),
        ("rings", {"inertia": Inertia()}),
        ("drifts", {"modulus_fields": (Thaw(),)}),
        ("drifts", {"volume_ratios": (Drying(),)}),
    ],
)
def test_what_is_remembered_is_said_once_and_everybody_keeps_to_it(kind, changes):
    physics = Physics(**{"probe": Probe(SHAPE), **changes})
    memory = memory_of(physics)
    assert [name for name in ("drifts", "relaxes", "rubs", "slips", "sets", "rings") if getattr(memory, name)] == [kind]
    (reason,) = memory.reasons
    assert reason in why_not_live(physics)
    assert (not memory.path_dependent) == (kind == "drifts")
    assert answers_linearly(physics, []) == (kind in ("drifts", "relaxes"))
    assert not memory_of(without_rubbing(physics)).rubs


def test_what_depends_on_the_pose_alone_is_no_memory():
    bonded = Interface(everywhere, bonded=True)
    physics = Physics(
        probe=Probe(SHAPE), modulus_fields=STATIC, volume_ratios=(Soaked(),), interfaces=(bonded,),
        supports=(Support(everywhere, "spring", stiffness=1e5),),
    )  # fmt: skip
    assert memory_of(physics).reasons == () and why_not_live(physics) == ""


def test_a_surface_that_sticks_is_pressed_in_short_path_steps():
    """What touches first sticks first: a prescribed surface goes the same way as one with friction."""
    line, way = Timeline(0, 0, 0.0), [Instant(1_000_000_000, 1.0, active=True)]
    down = lambda stamp_ns: np.block([[np.eye(3), np.array([[0.0], [0.0], [-5e-12 * stamp_ns]])], [0, 0, 0, 1]])  # noqa: E731
    steps = {
        law: len(list(line.in_path_steps(way, Physics(probe=Probe(SHAPE, **how)), down)))
        for law, how in (
            ("prescribed", {"formulation": "prescribed"}), ("friction", {"friction": 0.3}), ("smooth", {})
        )
    }  # fmt: skip
    assert steps["prescribed"] == steps["friction"] > steps["smooth"] == 1


def test_volumetric_effects_add():
    """J = J_1 J_2: each step stretches what the one before has left, so that strains add to first order."""
    held = replace(soft(), supports=symmetry(0, 1, 2))
    grown = EFFECTS["swelling"].apply(held, {"rate": np.array(0.01), "offset": np.array(0.0)})
    both = replace(grown, volume_ratios=(*grown.volume_ratios, Soaked()))
    mechanics = solve(block_space(), both, time=5.0)
    expected = ((1.05 * 1.06) ** (1 / 3) - 1.0) * mechanics.space.nodes
    np.testing.assert_allclose(mechanics.u, expected, atol=1e-14)
    twice = EFFECTS["swelling"].apply(grown, {"rate": np.array(0.0), "offset": np.array(0.06)})
    np.testing.assert_allclose(solve(block_space(), twice, time=5.0).u, expected, atol=1e-14)


def test_a_field_of_its_own_is_frozen_at_the_scan():
    """The unloaded shape is that of the modulus at the clock's start, whatever the field is called."""
    hung = replace(soft(), supports=(Support(lambda X: X[:, 2] < 1e-6),), scan_fraction=1.0, modulus_fields=(Thaw(),))
    assert not memory_of(as_scanned(hung)).reasons
    space = block_space()
    drifting = unloaded_shape(InverseProblem(space, hung))
    twice_as_stiff = unloaded_shape(InverseProblem(space, replace(hung, modulus_fields=(Uniform(2.0),))))
    np.testing.assert_allclose(drifting, twice_as_stiff, atol=1e-12)
    slow, fast = (as_scanned(replace(hung, modulus_fields=(Drift(rate),))) for rate in (0.1, 0.2))
    assert slow.modulus_fields == fast.modulus_fields  # what drifts later does not change the shape
