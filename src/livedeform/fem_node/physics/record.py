"""The physics of a body: everything that the solver needs besides the mesh, in one frozen record.

An effect takes a `Physics` and returns a changed copy (`dataclasses.replace`); nothing in the solver asks for an
effect's name. Units are SI, vectors are in the frame ``phantom``, and regions are functions of the scanned position.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from livedeform.common.errors import ConvergenceError, InputError
from livedeform.common.types import Array

RegionTest = Callable[[Array], NDArray[np.bool_]]  # points (n, 3) m, scanned configuration -> inside (n,)
ALONG = 0.98  # cosine between a load and gravity from which the load is taken for a hung weight
SupportType = Literal["fixed", "sliding", "spring", "friction"]


@dataclass(frozen=True)
class BodyShape:
    """The unloaded body, for modulus fields that depend on it.

    ``nodes`` (n, 3) m are its vertices, ``triangles`` (k, 3) rows of them on the boundary, oriented outward, and
    ``held`` (k,) bool says which triangles lie on a support.
    """

    nodes: Array
    triangles: NDArray[np.int64]
    held: NDArray[np.bool_]


class Parts(Protocol):
    """The small parts of all elements of the unloaded body, ``n`` of each, numbered (p,) element by element
    (`fem_node.element.subcells`): their ``middles`` (p, 3) m, and how far (p,) m they ``reach`` from these."""

    @property
    def n(self) -> int: ...

    @property
    def middles(self) -> Array: ...

    @property
    def reach(self) -> Array: ...

    def corners(self, which: NDArray[np.int64]) -> Array:
        """Return the corners (n, 4, 3) m of some of them, by their numbers (n,)."""
        ...

    def split(self, parts: Array) -> Array:
        """Return the corners (n, 8, 4, 3) m of the eight pieces of each of some parts, by their own (n, 4, 3) m."""
        ...


class ModulusField:
    """A factor of the modulus, as a function of the unloaded place and of time; a subclass writes ``__call__``."""

    @property
    def changes_with_time(self) -> bool:
        """Return whether the factor depends on time. A field that does not say so must not use ``t``."""
        return False

    @property
    def jumps(self) -> bool:
        """Return whether the factor jumps within elements: few points of an element then miss much of it."""
        return False

    def __call__(self, X: Array, t: float) -> Array:
        """Return the factor (q,) at unloaded positions ``X`` (q, 3) m and time ``t`` s on the drifts' clock."""
        raise NotImplementedError

    def over(self, parts: Parts, t: float) -> Array:
        """Return the mean factor (p,) over small parts of elements: of most fields that at their middles."""
        return self(parts.middles, t)

    def bind(self, body: BodyShape) -> ModulusField:
        """Return the field for this unloaded body; most do not depend on its shape."""
        return self

    def at(self, t: float) -> ModulusField:
        """Return the field as it is at the time ``t`` s, which does not change with time any more."""
        return FrozenField(self, t) if self.changes_with_time else self


@dataclass(frozen=True)
class FrozenField(ModulusField):
    """A ``field`` as it is at the ``time`` s."""

    field: ModulusField
    time: float

    def __call__(self, X: Array, t: float) -> Array:
        return self.field(X, self.time)

    @property
    def jumps(self) -> bool:
        return self.field.jumps

    def over(self, parts: Parts, t: float) -> Array:
        return self.field.over(parts, self.time)

    def bind(self, body: BodyShape) -> ModulusField:
        return replace(self, field=self.field.bind(body))


class VolumeRatio:
    """A stress-free, isotropic change of volume as a function of time; a subclass writes ``__call__``."""

    @property
    def changes_with_time(self) -> bool:
        """Return whether the ratio depends on time. One that does not say so must not use ``t``."""
        return False

    def __call__(self, t: float) -> float:
        """Return J at the time ``t`` s on the drifts' clock: the stress-free volume over that of the scanned body."""
        raise NotImplementedError


@dataclass(frozen=True)
class TemperatureCurve:
    """The body's temperature over time, in degrees Celsius or kelvin: ``values`` (k,) at ``times`` (k,) s on the
    drifts' clock, linear in between, held before and after; it was scanned at ``reference``."""

    times: tuple[float, ...]
    values: tuple[float, ...]
    reference: float

    @property
    def varies(self) -> bool:
        """Return whether it changes at all."""
        return len(set(self.values)) > 1

    def above_reference(self, t: float) -> float:
        """Return T(t) - T0 in kelvin at the time ``t`` s."""
        return float(np.interp(t, self.times, self.values)) - self.reference


def bind_fields(fields: tuple[ModulusField, ...], body: BodyShape) -> tuple[ModulusField, ...]:
    """Bind the fields to the unloaded body. The model calls this once it knows the unloaded shape."""
    return tuple(field.bind(body) for field in fields)


@dataclass(frozen=True)
class MaterialSpec:
    """A material model with its constants.

    ``youngs_modulus`` Pa is the relaxed one; ``extra`` has the model's own constants.
    """

    model: str = "neo_hookean"
    youngs_modulus: float = 4000.0
    poisson_ratio: float = 0.49
    extra: Mapping[str, Any] = field(default_factory=dict)

    @property
    def shear_modulus(self) -> float:
        """mu = E / 2(1 + nu), Pa."""
        return self.youngs_modulus / (2.0 * (1.0 + self.poisson_ratio))

    @property
    def bulk_modulus(self) -> float:
        """K = E / 3(1 - 2 nu), Pa."""
        return self.youngs_modulus / (3.0 * (1.0 - 2.0 * self.poisson_ratio))


@dataclass(frozen=True)
class Prony:
    """Isochoric Prony series: ``g`` relative to the instantaneous shear modulus (sum < 1), ``tau`` s."""

    g: tuple[float, ...]
    tau: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.g) != len(self.tau):
            raise InputError(f"{len(self.g)} weights g but {len(self.tau)} times tau", remedy="give one tau per g")
        if sum(self.g) >= 1.0 or min(self.tau, default=1.0) <= 0.0:
            raise InputError("the Prony weights must sum below 1 and the times be positive", remedy="correct g and tau")


@dataclass(frozen=True)
class PlasticSet:
    """A set that stays: the isochoric plastic Hencky strain is ``fraction`` (1 - ``threshold``/|h|) h, with h the
    largest Hencky strain so far."""

    fraction: float
    threshold: float


@runtime_checkable
class PartialRegion(Protocol):
    """A part of a larger region."""

    @property
    def region(self) -> RegionTest:
        """The whole region."""
        ...

    def ramp(self, base: Array, width: float) -> float:
        """Return over how many m the part may fade on a ``base`` (m, 3) m: ``width``, or what is left of it at its end;
        0 of a part that is the whole."""
        ...

    def share(self, points: Array, base: Array, width: float) -> Array:
        """Return how much (n,) of the support there is at ``points`` (n, 3) m on a ``base`` (m, 3) m: it falls from 1
        to 0 over ``width`` m across the part's edge."""
        ...


@dataclass(frozen=True)
class Support:
    """A support: a place where the body is held.

    ``fixed`` holds all directions; ``sliding`` the surface normal only; ``spring`` the normal, and the tangents by
    springs of ``stiffness`` Pa/m; ``friction`` the normal, and the tangents by Coulomb friction ``mu`` (``stiffness``
    then regularises the sticking; 0: chosen from the modulus and the mesh).
    """

    region: RegionTest
    type: SupportType = "fixed"
    stiffness: float = 0.0
    mu: float = 0.0


@dataclass(frozen=True)
class DeadLoad:
    """A force (3,) N in all, spread evenly over the region's surface; its direction does not turn with the body. It
    acts ``delay`` s after gravity does. Dry friction of up to ``friction`` N opposes the motion of its place along it,
    and gives by some ``give`` m before it slides (`items.rubbing_load`)."""

    name: str
    region: RegionTest
    force: Array
    delay: float = 0.0
    friction: float = 0.0
    give: float = 1e-4

    def is_weight(self, gravity: Array) -> bool:
        """Return whether the load pulls along ``gravity`` (3,) m/s2, and is taken for a weight that hangs there."""
        force, g = np.asarray(self.force, float), float(np.linalg.norm(gravity))
        return g > 0.0 and bool(force @ gravity > ALONG * float(np.linalg.norm(force)) * g)


@dataclass(frozen=True)
class Probe:
    """The rigid probe.

    ``shape`` is an object of `fem_node.contact.probe_shapes`; ``adhesion`` is in Pa; ``offset`` (3,) m, in the probe
    frame, is added to the recorded pose; a ``time_offset`` > 0 s means that the probe's stamps are late.
    """

    shape: Any
    formulation: Literal["lagrange", "penalty", "prescribed"] = "lagrange"
    friction: float = 0.0
    adhesion: float = 0.0
    offset: Array = field(default_factory=lambda: np.zeros(3))
    time_offset: float = 0.0

    @property
    def law(self) -> tuple[str, float, float]:
        """Formulation, friction and adhesion: what the contact's law is made of."""
        return self.formulation, self.friction, self.adhesion


@dataclass(frozen=True)
class Interface:
    """An interface at which two bodies of the mesh (parts that share no node) touch: ``region`` holds the touching
    faces of both.

    ``bonded``: they stay together; else Coulomb ``friction`` (0: frictionless, inf: no slip while pressed), and they
    may part. ``reach`` m: the largest slip that is provided for.
    """

    region: RegionTest
    friction: float = 0.0
    bonded: bool = False
    reach: float = 0.0


@dataclass(frozen=True)
class Inertia:
    """Implicit dynamics with Rayleigh damping C = ``rayleigh_alpha`` M + ``rayleigh_beta`` K (1/s, s)."""

    rayleigh_beta: float = 0.0
    rayleigh_alpha: float = 0.0


@dataclass(frozen=True)
class Physics:
    """The body, how it is held and loaded, and the probe.

    ``density`` kg/m3 is that of the unloaded body; ``gravity`` and ``scan_gravity`` (3,) are in m/s2; ``scan_fraction``
    is the fraction of ``scan_gravity`` that acted while the surface was scanned (1: declared loaded, 0: declared
    unloaded). ``modulus_fields`` multiply each other, and so do ``volume_ratios``. Gravity and loads act from
    ``release`` s after the recording's start; a body that relaxes hung under them for long, and then was held as it was
    scanned for ``held_for`` s until the recording (inf: for long). The drifts' time is 0 at ``clock_start_ns`` (None:
    the first stamp that the model sees). The ``temperature`` does nothing by itself: effects use it.
    """

    material: MaterialSpec = field(default_factory=MaterialSpec)
    density: float = 1000.0
    gravity: Array = field(default_factory=lambda: np.array([0.0, 0.0, -9.81]))
    scan_gravity: Array = field(default_factory=lambda: np.array([0.0, 0.0, -9.81]))
    scan_fraction: float = 0.0
    supports: tuple[Support, ...] = ()
    interfaces: tuple[Interface, ...] = ()
    loads: tuple[DeadLoad, ...] = ()
    release: float = 0.0
    held_for: float = np.inf
    modulus_fields: tuple[ModulusField, ...] = ()
    volume_ratios: tuple[VolumeRatio, ...] = ()
    prony: Prony | None = None
    plastic_set: PlasticSet | None = None
    probe: Probe | None = None
    inertia: Inertia | None = None
    clock_start_ns: int | None = None
    temperature: TemperatureCurve | None = None

    def volume_ratio(self, t: float) -> float:
        """Return the stress-free volume ratio at the time ``t`` s.

        Stress-free changes of volume follow each other, F = F_e J_1^(1/3) J_2^(1/3), so that their ratios multiply; to
        first order their strains add. ``ConvergenceError`` where one leaves nothing of the body: a fit may try that.
        """
        ratios = [ratio(t) for ratio in self.volume_ratios]
        if not all(ratio > 0.0 for ratio in ratios):
            raise ConvergenceError(
                "swelling or thermal expansion leaves nothing of the body: its stress-free volume is "
                f"{min(ratios):.3g} times that of the scanned one, {t:.3g} s after the drifts' clock starts",
                where="effects",
                remedy="correct the effect's values, or timeline.clock_start_ns",
            )
        return float(np.prod(ratios))

    def with_material(self, **changes: Any) -> Physics:
        """Return a copy whose material is changed."""
        return replace(self, material=replace(self.material, **changes))

    def with_probe(self, **changes: Any) -> Physics:
        """Return a copy whose probe is changed; unchanged if there is no probe."""
        return self if self.probe is None else replace(self, probe=replace(self.probe, **changes))
