"""The record of what the true phantom is like, and of one solved moment."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from livedeform.common.types import Array

Field = Callable[[Array, float], Array]  # stress-free places (n, 3), time -> factor (n,)


@dataclass(frozen=True)
class TruthPhysics:
    """Describe the true phantom; the values mean what the interfaces say of the effects of the same name.

    The fields of ``modulus`` multiply both moduli, and the fields of ``growth`` multiply to the stress-free volume
    ratio; both depend on place and time. ``base_stiffness`` is in Pa/m (None: bonded), ``base_free`` says which places
    of the base are not held. ``prony`` holds pairs (g, tau), ``plastic`` (fraction, threshold), ``fibre``
    (stiffness / mu, direction), and ``tether`` (place on the surface, radius m, end of the string, stiffness N/m, slack
    m): a string that pulls while it is longer than at the start plus slack.
    """

    youngs_modulus: float
    poisson_ratio: float = 0.49
    density: float = 1000.0
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)
    stiffening: float = 0.0
    modulus: tuple[Field, ...] = ()
    growth: tuple[Field, ...] = ()
    prony: tuple[tuple[float, float], ...] = ()
    plastic: tuple[float, float] | None = None
    base_stiffness: float | None = None
    base_free: Callable[[Array], NDArray[np.bool_]] | None = None
    fibre: tuple[float, tuple[float, float, float]] | None = None
    tether: tuple[Array, float, Array, float, float] | None = None
    friction: float = 0.0
    adhesion: float = 0.0

    @property
    def rubs(self) -> bool:
        """Return whether the surface rubs on the probe or sticks to it, so that the probe's path matters."""
        return self.friction > 0.0 or self.adhesion > 0.0

    def changed(self, **changes: object) -> TruthPhysics:
        """Return the physics with some values replaced."""
        return replace(self, **changes)  # type: ignore[arg-type]


@dataclass(frozen=True)
class TruthState:
    """Hold one solved moment.

    ``x`` (n, 3) m are the nodes' places, ``force`` (3,) N and ``torque`` (3,) N m what the probe does to the body (the
    torque about the phantom's origin), ``n_iterations`` the Newton iterations spent.
    """

    time: float
    x: Array
    force: Array
    torque: Array
    n_iterations: int
