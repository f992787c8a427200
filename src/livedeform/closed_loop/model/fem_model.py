"""The finite-element phantom as the closed loop asks for it: effects and recordings in, key moments out as the cameras
report them, with Jacobian columns with respect to any candidate's coordinates.

What is simulated, and how its sensitivities are worked out, is `fem_node.simulator`'s. Here effects become physics,
columns become directions (a small step in one coordinate), and predicted places go through the measuring effects.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from livedeform.closed_loop.evidence.observation import Observation
from livedeform.closed_loop.forward import Column, Key, Run
from livedeform.common.published_effects import with_others
from livedeform.common.types import Array, EffectValues
from livedeform.fem_node.effects import EFFECTS as MECHANICAL
from livedeform.fem_node.effects import apply_effects, makes_rub
from livedeform.fem_node.mesh.tet_mesh import TetMesh
from livedeform.fem_node.physics.memory import Memory, memory_of, without_rubbing
from livedeform.fem_node.physics.record import Physics
from livedeform.fem_node.simulator import Direction, ElementKind, Kind, Recorded, Simulation, Simulator, WalkSettings
from livedeform.stereo_node.effects import Surface, View, distort_all

STEP = 0.002  # of a coordinate's step: residuals are smooth, and accurate to round-off
CLOCK_STEP = 0.02  # s, over which a recorded force's rate is taken: its noise is that of single readings
WALK = WalkSettings(
    path_step=1e-3,  # m that a probe that rubs moves at a time: 4 um rms against half of it (evidence/memory)
    between=4.0,  # contact on the path between two moments, as many times less exactly than at them
    corrections=1,  # of sensitivities: Gauss-Newton needs no more than tangents
)


@dataclass(frozen=True)
class Setting:
    """All that does not change while the loop runs: the mesh, the declared physics (with the experiment's own
    effects), the markers in the scanned configuration, how each recording looks at them (by its name), and the physics
    ``acting`` in recordings for which other loads are declared."""

    mesh: TetMesh
    element: ElementKind
    physics: Physics
    declared: tuple[EffectValues, ...]
    markers: Array
    still: np.ndarray
    views: Mapping[str, View]
    clock_start_ns: int
    acting: Mapping[str, Physics] = field(default_factory=dict)

    def declared_in(self, recording: str) -> Physics:
        """Return what is declared for a recording."""
        return self.acting.get(recording, self.physics)


class Body:
    """Simulates one recording at a time; keeps solved moments and unloaded shapes for the next."""

    def __init__(self, setting: Setting, walk_settings: WalkSettings = WALK) -> None:
        self.setting, self.walk_settings = setting, walk_settings
        self._simulator = Simulator(setting.mesh, setting.element, setting.markers, setting.still)
        self.solved = self._simulator.solved

    @property
    def element_size(self) -> float:
        """Mean edge of the elements, m."""
        return self._simulator.space.typical_size

    @property
    def unknowns(self) -> int:
        """Number of the model's unknowns."""
        return self._simulator.space.n_dof

    def simulate(
        self,
        effects: Sequence[EffectValues],
        o: Observation,
        columns: Sequence[Column],
        *,
        path_steps: bool = True,
        most_iterations: float = np.inf,
    ) -> Run:
        """Simulate one recording with ``effects`` on top of the declared ones, and its columns. What rubs or sticks
        goes from moment to moment in short ``path_steps``, or at once: roughly. After ``most_iterations`` no moment is
        found any more."""
        began = time.perf_counter()
        physics = self.physics(effects, o.name)
        directions = self._directions(effects, physics, columns, o.name)
        whole = _remembered(o, memory_of(physics))
        recorded = _recorded(whole)
        walk_settings = self.walk_settings if path_steps else replace(self.walk_settings, path_step=None)
        simulated = self._simulator.simulate(
            physics, recorded, directions, walk_settings, kind_of(effects), most_iterations
        )
        last = slice(-o.n_moments, None)
        points = np.array([p.markers for p in simulated.predictions])[last]
        surfaces = self._surfaces(simulated)
        points, d_points = self._measured(effects, o, points, simulated.d_markers[last], columns, surfaces)
        forces = d_forces = None
        if physics.probe is not None and o.forces is not None:
            late, d_late = _late_wrench(o, physics, directions)
            forces = np.array([p.force for p in simulated.predictions])[last] - late
            d_forces = np.zeros((*forces.shape, len(columns)))
            acting = [c.candidate.name in MECHANICAL for c in columns]
            d_forces[..., acting] = simulated.d_forces[last] - d_late
        reasons = tuple({p.message: None for p in simulated.predictions[last] if not p.converged})
        return Run(points, forces, d_points, d_forces, time.perf_counter() - began, reasons)

    def unload(self, effects: Sequence[EffectValues], recording: str, columns: Sequence[Column]) -> None:
        """Find the unloaded shapes that a recording with ``effects`` and its columns needs: they take longer than some
        moments, and are kept."""
        physics = self.physics(effects, recording)
        self._simulator.unload(physics, self._directions(effects, physics, columns, recording))

    def astray(self, o: Observation, moment: int) -> str:
        """Say how far a ``moment`` of the declared model is from where the graph comes to that follows the recorded
        poses; empty where they are alike (`Simulator.astray`)."""
        return self._simulator.astray(self.physics([], o.name), _recorded(o), int(o.stamps_ns[moment]))

    def rubs_on_sharp_edges(self, o: Observation) -> str:
        """Say why the declared model's path through a recording may end in several equilibria
        (`Simulator.rubs_on_sharp_edges`)."""
        return self._simulator.rubs_on_sharp_edges(self.physics([], o.name)) if o.path else ""

    @property
    def started(self) -> set[Key]:
        """The moments that another mesh has solved."""
        return set(self._simulator.elsewhere)

    def start_from(self, other: Body) -> None:
        """Start the moments at which the same body on another mesh was pressed from what is known of them there."""
        self._simulator.start_from(other._simulator, self.physics([]))

    def rest(self, recording: str = "") -> Array:
        """Return the declared model's markers at rest (m, 3) m, under its weight and loads, without the probe."""
        return self._simulator.rest(self.physics([], recording))

    def slippery(self) -> Body:
        """Return the body under a probe that neither rubs nor sticks; itself if it does neither."""
        setting = self.setting
        if not memory_of(self.physics([])).rubs:
            return self
        kept = tuple(e for e in setting.declared if not makes_rub(e.name))
        acting = {name: without_rubbing(physics) for name, physics in setting.acting.items()}
        return Body(replace(setting, physics=without_rubbing(setting.physics), declared=kept, acting=acting))

    def physics(self, effects: Sequence[EffectValues], recording: str = "") -> Physics:
        """Return the physics declared (for a recording) with effects; one of a name that is declared already replaces
        it."""
        physics = apply_effects(self.setting.declared_in(recording), with_others(self.setting.declared, effects))
        return replace(physics, clock_start_ns=self.setting.clock_start_ns)

    def _directions(
        self, effects: Sequence[EffectValues], physics: Physics, columns: Sequence[Column], recording: str
    ) -> list[Direction]:
        """Return the directions of the columns that act on the body."""
        mechanical = [c for c in columns if c.candidate.name in MECHANICAL]
        return [self._direction(effects, physics, column, recording) for column in mechanical]

    def _direction(
        self, effects: Sequence[EffectValues], physics: Physics, column: Column, recording: str
    ) -> Direction:
        """Return the physics a small step away in the column's coordinate."""
        c, k, z = column.candidate, column.coordinate, np.array(column.z)
        inside = any(e.name == c.name for e in effects)
        reference = physics if inside else self.physics([*effects, c.values(z)], recording)
        h = STEP * c.coordinates[k].step
        if c.kick[k] and abs(z[k]) < 1e-12:
            h = float(c.kick[k])  # a support gives way: to first order, in this strip
        h = c.coordinates[k].beside(z[k], h)
        z[k] += h
        values = c.values(z)
        others = [values if e.name == c.name else e for e in effects]  # in the leader's order
        changed = self.physics(others if inside else [*effects, values], recording)
        return Direction((c.name, k), changed, h, reference, at=float(column.z[k]))

    # -- the way through the cameras -----------------------------------------------------------------------------------

    def _surfaces(self, simulated: Simulation) -> dict[int, Surface]:
        """Return the predicted surface by stamp: vertices (n, 3) m and triangles."""
        return {p.stamp_ns: (p.surface, p.triangles) for p in simulated.predictions if p.converged}

    def _measured(
        self,
        effects: Sequence[EffectValues],
        o: Observation,
        true: Array,
        d_true: Array,
        columns: Sequence[Column],
        surfaces: Mapping[int, Surface],
    ) -> tuple[Array, Array]:
        """Return what an uncorrected rig reports, and its derivatives for all columns."""
        view = self.setting.views.get(o.name) or next(iter(self.setting.views.values()))
        view = replace(view, surface=surfaces.get)
        active = [e for e in with_others(self.setting.declared, effects) if e.name not in MECHANICAL]
        points = _distorted(true, o, active, view)
        out = np.zeros((*points.shape, len(columns)))
        mechanical = 0
        for i, column in enumerate(columns):
            c = column.candidate
            if c.name in MECHANICAL:
                d = d_true[..., mechanical]
                mechanical += 1
                if active:
                    e = 1e-6 / max(float(np.nanmax(np.abs(d))), 1e-12)
                    d = (_distorted(true + e * d, o, active, view) - points) / e
                out[..., i] = d
            else:
                others = [e for e in active if e.name != c.name]
                z = np.array(column.z)
                h = c.coordinates[column.coordinate].beside(z[column.coordinate], c.coordinates[column.coordinate].step)
                high = z.copy()
                high[column.coordinate] += h
                low = _distorted(true, o, [*others, c.values(z)], view)
                out[..., i] = (_distorted(true, o, [*others, c.values(high)], view) - low) / h
        return points, out


def _distorted(points: Array, o: Observation, effects: Sequence[EffectValues], view: View) -> Array:
    """Return points (k, m, 3) after the measuring effects, moment by moment."""
    if not effects:
        return points
    out = np.full_like(points, np.nan)
    for k, stamp in enumerate(o.stamps_ns):
        if np.isfinite(points[k]).all():
            out[k] = distort_all(points[k], int(stamp), effects, view)
    return out


def _remembered(o: Observation, memory: Memory) -> Observation:
    """Return the moments with those before that the body remembers: what stays was put there by all presses; what
    fades, rubs or swings goes on from the earlier part of the same recording."""
    if memory.sets:
        return o.with_all_before()
    return o.with_part_before() if memory.path_dependent else o


def _late_wrench(o: Observation, physics: Physics, directions: Sequence[Direction]) -> tuple[Array, Array]:
    """Return how the recorded forces (k, 3) N differ from those at the moments because a late probe's wrench is late as
    well, and the derivatives (k, 3, p) of that along directions."""
    offset = 0.0 if physics.probe is None else physics.probe.time_offset
    d_late = np.zeros((o.n_moments, 3, len(directions)))
    for j, direction in enumerate(directions):
        before, after = (direction.reference or physics).probe, direction.physics.probe
        if before is not None and after is not None and before.time_offset != after.time_offset:
            rate = o.force_later(offset + CLOCK_STEP) - o.force_later(offset - CLOCK_STEP)
            d_late[..., j] = rate / (2.0 * CLOCK_STEP)
    return o.force_later(offset), d_late


def _recorded(o: Observation) -> Recorded:
    return Recorded(o.name, [int(s) for s in o.stamps_ns], o.start_ns, o.path)


def kind_of(effects: Sequence[EffectValues]) -> Kind:
    """Return the names of those that act on the body."""
    return frozenset(e.name for e in effects if e.name in MECHANICAL)
