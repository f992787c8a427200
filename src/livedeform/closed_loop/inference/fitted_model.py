"""The declared model with effects added: which, at which coordinates, and what stays uncertain around them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from livedeform.closed_loop.candidates import Candidate, Coordinate
from livedeform.closed_loop.evidence.noise import ModelErrors
from livedeform.closed_loop.forward import Column, Correction, Name, dictionary_columns
from livedeform.closed_loop.inference.gauss_newton import Fit
from livedeform.common.types import Array, EffectValues


@dataclass(frozen=True)
class Allowed:
    """A candidate that is allowed for, up to ``sigma`` (p,) per amplitude, whatever else is tried: as a table that is
    not quite level. ``per_press``: anew in each press, also where the candidate itself is in the model."""

    candidate: Candidate
    sigma: Array
    per_press: bool = False


@dataclass(frozen=True)
class Uncertain:
    """The uncertainties of every model: sizes of ``errors``, the registration's sigmas ``shift`` m and ``turn`` rad,
    what is ``always`` allowed for, and the ``correction``: what is known of the discretisation error already;
    ``release`` s: the sigma of when each recording's body was let go."""

    errors: ModelErrors
    shift: float
    turn: float
    always: tuple[Allowed, ...] = ()
    correction: Correction = field(default_factory=Correction)
    release: float = 0.0

    def moved(self, added: Sequence[Added]) -> Uncertain:
        """Follow effects to where they are, to first order along their own lines (`Candidate.carried`)."""
        carry = {a.candidate.name: a.candidate.carried for a in added if a.candidate.together is not None}
        return replace(self, correction=self.correction.moved(coordinates_of(added), carry))


@dataclass(frozen=True)
class Added:
    """An effect in the model, at coordinates ``z``."""

    candidate: Candidate
    z: Array

    @property
    def values(self) -> EffectValues:
        """The effect as an experiment holds it."""
        return self.candidate.values(self.z)


@dataclass(frozen=True)
class FittedModel:
    """The declared model with the effects ``added``, their ``joint`` fit (None: it could not be solved, or there are
    none) and what they ``gained`` one after another, in twice the log likelihood."""

    uncertain: Uncertain
    added: tuple[Added, ...] = ()
    joint: Fit | None = None
    gained: float = 0.0

    @property
    def effects(self) -> list[EffectValues]:
        """The added effects as an experiment holds them."""
        return [a.values for a in self.added]

    @property
    def names(self) -> list[str]:
        """Names of the added effects, in their order."""
        return [a.candidate.name for a in self.added]

    @property
    def rings(self) -> bool:
        """Tell whether the body swings with what is in the model."""
        return any(a.candidate.info.rings for a in self.added)

    @property
    def in_step(self) -> bool:
        """Tell whether it relaxes in a form that begins where the body swings as it did: at its own rate."""
        return self.is_whole or (self.rings and any(a.candidate.form and a.candidate.form.alike for a in self.added))

    @property
    def is_whole(self) -> bool:
        """Tell whether it has all that a release shows together, in the form that stands for it."""
        return self.rings and any(a.candidate.form and a.candidate.form.released for a in self.added)

    @property
    def whole_joint(self) -> Fit | None:
        """The joint fit, if it is of all coordinates of the added effects."""
        whole = self.joint is not None and len(self.joint.z) == sum(len(a.z) for a in self.added)
        return self.joint if whole else None

    @property
    def at_bound(self) -> list[tuple[Added, Coordinate]]:
        """The fitted coordinates that are at the end of what is tried, with their effects."""
        every = [(a, c) for a in self.added for c in a.candidate.coordinates]
        fit = self.whole_joint
        return [] if fit is None else [pair for pair, ends in zip(every, fit.at_bound, strict=True) if ends]

    @property
    def columns(self) -> list[Column]:
        """Jacobian columns of all coordinates of the added effects, where they are."""
        return columns_of(self.added)

    @property
    def allowed(self) -> list[Allowed]:
        """Return the part of what is always allowed for that the added effects do not stand for."""
        return [a for a in self.uncertain.always if a.per_press or a.candidate.name not in self.names]

    @property
    def allowed_columns(self) -> list[Column]:
        """Jacobian columns of what is allowed for, to be asked for after all others."""
        at = {a.candidate.name: tuple(float(v) for v in a.z) for a in self.added}
        columns = dictionary_columns([a.candidate for a in self.allowed])
        return [replace(c, z=at.get(c.candidate.name, c.z)) for c in columns]

    def with_fit(self, fit: Fit) -> FittedModel:
        """Put all added effects where their joint ``fit`` has them."""
        ends = np.cumsum([len(a.z) for a in self.added])
        added = tuple(Added(a.candidate, fit.z[end - len(a.z) : end]) for a, end in zip(self.added, ends, strict=True))
        return replace(self, added=added, joint=fit, uncertain=self.uncertain.moved(added))

    def worth(self, number: int, covariance: Array | None = None) -> float:
        """Squared size of the added effect ``number`` in its own sigmas, by a ``covariance`` (p, p) of all coordinates
        or that of the joint fit: twice the log likelihood that it is worth, conditional on the others (Wald 1943)."""
        assert self.joint is not None  # the caller's
        at = sum(len(a.z) for a in self.added[:number])
        i = at + self.added[number].candidate.amplitudes
        if not len(i):  # switched on as a whole
            return np.inf
        z, own = self.joint.z[i], (self.joint.covariance if covariance is None else covariance)[np.ix_(i, i)]
        return float(z @ np.linalg.solve(own, z))


def columns_of(added: Sequence[Added]) -> list[Column]:
    """Jacobian columns of all coordinates, where they are."""
    return [
        Column(a.candidate, tuple(float(v) for v in a.z), i) for a in added for i in range(len(a.candidate.coordinates))
    ]


def coordinates_of(added: Sequence[Added]) -> dict[Name, float]:
    """Map each coordinate's name to where it is."""
    return {(a.candidate.name, i): float(v) for a in added for i, v in enumerate(a.z)}
