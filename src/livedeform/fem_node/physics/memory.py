"""The body's memory: what its equilibrium depends on besides the pose and the loads of the moment, and why.

Everybody who treats a body with a memory otherwise (the timeline, warm starts, sensitivities, the unloaded shape, the
live model, earlier recordings, the search and its workers) asks the record that `memory_of` makes of a `Physics`. Each
field of it holds the reasons, in words for the user; an empty one says that there is none.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from livedeform.fem_node.physics.record import Interface, Physics, Probe, Support

Reasons = tuple[str, ...]


@dataclass(frozen=True)
class Memory:
    """The reasons why the same pose under the same loads may find another equilibrium.

    ``drifts``: a law changes with the clock, whatever the body went through. ``relaxes``: stress fades with time.
    ``rubs``: the surface rubs on the probe or sticks to it. ``slips``: a support or another body does so. ``sets``:
    deformation stays for good. ``rings``: the body has inertia. ``lets_go``: its hold changes at one moment of the
    recording, before and after which the pose may still decide. ``hung``: stress that has not faded since it hung, when
    it was lifted and held for a while before it was let go.
    """

    drifts: Reasons = ()
    relaxes: Reasons = ()
    rubs: Reasons = ()
    slips: Reasons = ()
    sets: Reasons = ()
    rings: Reasons = ()
    lets_go: Reasons = ()
    hung: Reasons = ()

    @property
    def path_dependent(self) -> Reasons:
        """Return why the path matters that the body went through; empty: any moment may be solved for itself."""
        return self.rubs + self.slips + self.relaxes + self.sets + self.rings

    @property
    def reasons(self) -> Reasons:
        """All reasons; empty: the pose and the loads alone decide."""
        return self.path_dependent + self.drifts

    @property
    def beyond_the_pose(self) -> Reasons:
        """All reasons why the pose alone does not decide over a whole recording."""
        return self.reasons + self.lets_go


def memory_of(physics: Physics) -> Memory:
    """Collect what the body of ``physics`` remembers, and why."""
    volumes = any(volume.changes_with_time for volume in physics.volume_ratios)
    moduli = any(field.changes_with_time for field in physics.modulus_fields)
    late = any(load.delay > 0.0 for load in physics.loads)
    hung = physics.release > 0.0 and physics.prony is not None and bool(np.isfinite(physics.held_for))
    return Memory(
        drifts=_said("a modulus that changes with time", moduli)
        + _said("a volume that changes with time", volumes)
        + _said("a load that pulls later than gravity", late),
        relaxes=_said("relaxation", physics.prony is not None),
        rubs=rubbing(physics.probe),
        slips=_of_supports(physics.supports)
        + _of_interfaces(physics.interfaces)
        + _said("a load that rubs where it hangs", any(load.friction > 0.0 for load in physics.loads)),
        sets=_said("plastic set", physics.plastic_set is not None),
        rings=_said("inertia", physics.inertia is not None),
        lets_go=_said("a release during the recording", physics.release > 0.0),
        hung=_said("having hung until shortly before a release", hung),
    )


def without_rubbing(physics: Physics) -> Physics:
    """Return the physics with a probe that neither rubs on the surface nor sticks to it."""
    if physics.probe is None or not rubbing(physics.probe):
        return physics
    kept = "lagrange" if physics.probe.formulation == "prescribed" else physics.probe.formulation
    return physics.with_probe(friction=0.0, adhesion=0.0, formulation=kept)


def pulls(probe: Probe | None) -> bool:
    """Return whether the surface sticks to a probe that is lifted."""
    return probe is not None and (probe.adhesion > 0.0 or probe.formulation == "prescribed")


def as_scanned(physics: Physics) -> Physics:
    """Return the part of the physics that decides the unloaded shape: the relaxed body at the clock's start, held as it
    is, before probe, loads and history, with the stress-free volume that it was scanned with."""
    return replace(
        physics,
        probe=None,
        gravity=np.zeros(3),
        loads=(),
        prony=None,
        plastic_set=None,
        inertia=None,
        held_for=np.inf,
        volume_ratios=(),
        modulus_fields=tuple(field.at(0.0) for field in physics.modulus_fields),
    )


def _said(reason: str, holds: bool) -> Reasons:
    return (reason,) if holds else ()


def rubbing(probe: Probe | None) -> Reasons:
    """Say why the surface is dragged along by the probe; empty: its pose alone decides."""
    if probe is None:
        return ()
    return (
        _said("friction", probe.friction > 0.0)
        + _said("adhesion", probe.adhesion > 0.0)
        + _said("a prescribed surface", probe.formulation == "prescribed")
    )


def _of_supports(supports: tuple[Support, ...]) -> Reasons:
    return _said("friction with the support", any(support.type == "friction" for support in supports))


def _of_interfaces(interfaces: tuple[Interface, ...]) -> Reasons:
    """Say that two bodies that are not bonded may slide and part: who lies opposite of whom depends on the path."""
    return _said("two bodies in contact", any(not interface.bonded for interface in interfaces))
