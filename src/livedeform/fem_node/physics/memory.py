"""Temporary stand-in with the interface of the memory record."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from livedeform.fem_node.physics.record import Physics

Reasons = tuple[str, ...]


@dataclass(frozen=True)
class Memory:
    drifts: Reasons = ()
    relaxes: Reasons = ()
    rubs: Reasons = ()
    slips: Reasons = ()
    sets: Reasons = ()
    rings: Reasons = ()

    @property
    def of_the_way(self) -> Reasons:
        return self.rubs + self.slips + self.relaxes + self.sets + self.rings

    @property
    def reasons(self) -> Reasons:
        return self.of_the_way + self.drifts


def memory_of(physics: Physics) -> Memory:
    probe = physics.probe
    drifts = physics.swelling is not None or any(type(f).__name__ == "Drift" for f in physics.modulus_fields)
    return Memory(
        drifts=("drift",) * drifts,
        relaxes=("relaxation",) * (physics.prony is not None),
        rubs=("friction",) * (probe is not None and (probe.rubs or probe.formulation == "prescribed")),
        slips=("support",) * (any(s.type == "friction" for s in physics.supports) or bool(physics.interfaces)),
        sets=("set",) * (physics.plastic_set is not None),
        rings=("inertia",) * (physics.inertia is not None),
    )


def as_scanned(physics: Physics) -> Physics:
    return replace(
        physics,
        probe=None,
        gravity=np.zeros(3),
        loads=(),
        prony=None,
        plastic_set=None,
        inertia=None,
        swelling=None,
        modulus_fields=tuple(f for f in physics.modulus_fields if type(f).__name__ != "Drift"),
    )
