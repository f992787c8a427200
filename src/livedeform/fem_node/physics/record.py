"""Everything that the solver needs beside the mesh, in one frozen record.

An effect takes a `Physics` and returns a changed copy (`dataclasses.replace`); nothing in the solver asks for an
effect's name.
Units are SI, vectors are in the frame ``phantom``, and regions are functions of the scanned position.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from livedeform.common.errors import InputError
from livedeform.common.types import Array

RegionTest = Callable[[Array], NDArray[np.bool_]]  # points (n, 3) m, scanned configuration -> inside (n,)
ModulusField = Callable[[Array, float], Array]  # unloaded positions (q, 3) m, time s -> factor (q,) of the modulus
# a field that depends on the body's shape (skin, height) also has ``bind(body: BodyShape) -> ModulusField``: see
# `bind_fields`
SupportType = Literal["fixed", "sliding", "spring", "friction"]


@dataclass(frozen=True)
class BodyShape:
    """The unloaded body, for modulus fields that depend on it: vertices ``nodes`` (n, 3) m, outward boundary
    ``triangles`` (k, 3)
    rows of ``nodes``, ``held`` (k,) bool: the triangles that lie on a support."""

    nodes: Array
    triangles: NDArray[np.int64]
    held: NDArray[np.bool_]


def bind_fields(fields: tuple[ModulusField, ...], body: BodyShape) -> tuple[ModulusField, ...]:
    """The fields, bound to the unloaded body where they depend on it. The model calls this once it knows the
    unloaded shape."""
    return tuple(field.bind(body) if hasattr(field, "bind") else field for field in fields)


@dataclass(frozen=True)
class MaterialSpec:
    """A material model with its constants: Young's modulus Pa (relaxed), Poisson ratio, and the model's own
    (``extra``)."""

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
    """Isochoric plastic Hencky strain = ``fraction`` (1 - ``threshold``/|h|) h at the largest Hencky strain h so
    far."""

    fraction: float
    threshold: float


@runtime_checkable
class PartialRegion(Protocol):
    """A part of ``region``: ``share`` (n,) of the support at points (n, 3), on a base (m, 3), falls from 1 to 0 over
    ``width`` m across the part's edge."""

    @property
    def region(self) -> RegionTest: ...

    def share(self, points: Array, base: Array, width: float) -> Array: ...


@dataclass(frozen=True)
class Support:
    """Where the body is held.

    ``fixed``: all directions; ``sliding``: along the surface normal only; ``spring``: along the normal, and by
    tangential
    springs of ``stiffness`` Pa/m; ``friction``: along the normal, and by Coulomb friction ``mu`` (tangential
    ``stiffness``
    regularises the sticking; 0: chosen from the modulus and the mesh).
    """

    region: RegionTest
    type: SupportType = "fixed"
    stiffness: float = 0.0
    mu: float = 0.0


@dataclass(frozen=True)
class DeadLoad:
    """A force (3,) N in all, spread evenly over the region's surface; its direction does not turn with the body."""

    name: str
    region: RegionTest
    force: Array


@dataclass(frozen=True)
class Probe:
    """The rigid probe. ``shape`` is an object of `fem_node.contact.probe_shapes`; ``adhesion`` Pa; ``offset`` (3,) m
    in the probe frame
    is added to the recorded pose; ``time_offset`` s > 0 means that the probe's stamps are late."""

    shape: Any
    formulation: Literal["lagrange", "penalty", "prescribed"] = "lagrange"
    friction: float = 0.0
    adhesion: float = 0.0
    offset: Array = field(default_factory=lambda: np.zeros(3))
    time_offset: float = 0.0

    @property
    def rubs(self) -> bool:
        """Whether it rubs or sticks, so that it matters which way it came."""
        return self.friction > 0.0 or self.adhesion > 0.0


@dataclass(frozen=True)
class Interface:
    """Where two bodies of the mesh (parts that share no node) touch: ``region`` holds the touching faces of both.

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

    ``density`` kg/m3 of the unloaded body; ``gravity`` and ``scan_gravity`` (3,) m/s2; ``scan_fraction``: the
    fraction of
    ``scan_gravity`` that acted while the surface was scanned (1: declared loaded, 0: declared unloaded); ``swelling``:
    time s -> stress-free volume ratio; ``modulus_fields`` multiply each other; ``release`` s after the recording's
    start
    from which gravity and loads act; ``clock_start_ns``: the stamp at which the drifts' time is 0 (None: the first
    stamp that the model sees).
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
    modulus_fields: tuple[ModulusField, ...] = ()
    swelling: Callable[[float], float] | None = None
    prony: Prony | None = None
    plastic_set: PlasticSet | None = None
    probe: Probe | None = None
    inertia: Inertia | None = None
    clock_start_ns: int | None = None

    def with_material(self, **changes: Any) -> Physics:
        """A copy whose material is changed."""
        return replace(self, material=replace(self.material, **changes))

    def with_probe(self, **changes: Any) -> Physics:
        """A copy whose probe is changed; unchanged if there is no probe."""
        return self if self.probe is None else replace(self, probe=replace(self.probe, **changes))
