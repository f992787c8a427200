"""Live prediction: contact solved exactly on a body that has been linearised about a nearby solution of the full model.

The library holds full solutions at some poses, each with the body's tangent condensed onto the surface near the probe
(`fem_node.live.condensed`). For a new pose the nearest one's body answers in a few milliseconds: contact is as in the
full
model, the body's large deformation is that of the library's solution, and what is missing is of second order in the
distance d between the two,

    error ~ c d^2,    d = max |x - x_library|,

with c measured: every library solution is predicted from its neighbours. A frictionless probe with sharp edges on a
coarse mesh has more than one equilibrium, and which one is found depends on the path to it; the library is therefore
solved there and back, with a pose a little off the path at each; how far the two differ, and what the prediction
off the path lacks beyond c d^2, is added to the bound. Where c d^2 exceeds the tolerance, and for bodies with a
memory or a drift (`fem_node.physics.memory`), the full model predicts; its solution joins the library. Beforehand the
library is trained along the poses that are expected (a recorded or planned path).
"""

from __future__ import annotations

import copy
import hashlib
import time as clock
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from livedeform.common import frames
from livedeform.common.types import Array, Pose, Prediction
from livedeform.fem_node.contact.contact import ProbeContact
from livedeform.fem_node.contact.small_problem import NotCovered, NotSettled, touch
from livedeform.fem_node.items.protocol import Moment
from livedeform.fem_node.live.condensed import Condensed, condense
from livedeform.fem_node.live.library import Entry, Library, read_library, write_library
from livedeform.fem_node.model import PhantomModel
from livedeform.fem_node.physics.memory import memory_of
from livedeform.fem_node.physics.record import Physics
from livedeform.fem_node.solve.assembly import System
from livedeform.fem_node.solve.solver import Solver

REACH = 0.012  # m beyond the probe's box: surface that is condensed onto
OFF_PATH = 1.5e-4, 5e-3  # m, rad: how far off the path the estimate is measured
EXACTNESS = 0.5  # of the contact's gap tolerance: multipliers come from a pose nearby
MAX_UPDATES = 3  # of the multipliers, per frame
JUDGED = 0.2  # of the contact's gap tolerance, to which the full model is solved where live answers are judged by it:
# along the surface a gap's error is seen up to 25 times larger
START_COEFFICIENT = 60.0  # 1/m: c before it has been measured (twice what was measured on the breast phantom)
SAFETY = 1.5  # on the largest measured c, and on what is measured off the path
NODES_WITHIN = 99.0  # per cent of the surface's nodes that the estimate is for


@dataclass(frozen=True)
class LiveSettings:
    """``tolerance`` m: error estimate above which the full model answers; ``spacing`` m: how far the probe's face moves
    between two solutions when the library is trained; ``max_entries`` of the library; ``n_nearest`` that are tried."""

    tolerance: float = 1e-4
    spacing: float = 1e-3
    max_entries: int = 120
    n_nearest: int = 2


@dataclass
class LiveCounts:
    """Counts of how the frames were answered."""

    live: int = 0
    full: int = 0


@dataclass(frozen=True)
class _Start:
    """The state that the small contact problem starts from: pose, forces (n_dof,) N and multipliers Pa of another
    answer."""

    T: Array
    force: Array
    multiplier: Array


@dataclass(frozen=True)
class _Found:
    """An answer: x (n_dof,), right at the rows, its error estimate ``bound`` m, and where the next may start."""

    x: Array
    bound: float
    start: _Start


class LivePredictor:
    """``predict`` as `PhantomModel` has it, but fast; ``Prediction.error_bound`` (m) is always filled: the estimated
    error of 99 % of the surface's nodes against the converged full model, whichever way it comes; 0 where that has
    answered."""

    def __init__(
        self,
        model: PhantomModel,
        *,
        settings: LiveSettings | None = None,
        progress: Callable[[str], None] | None = None,
    ) -> None:
        self.model, self.settings = model, settings or LiveSettings()
        self.counts, self.library = LiveCounts(), list[Entry]()
        self._tell = progress or (lambda text: None)
        self._coefficient = 0.0
        self._floor = 0.0  # m, of the error estimate
        mechanics, space = model.mechanics, model.space
        self.why_not = why_not_live(model.physics)
        if self.why_not:
            self._tell(f"live: the full model answers every pose, because of {self.why_not}")
            return
        self._contact, self._measuring = self._a_contact(), self._a_contact()
        self._offset: Array = model.physics.probe.offset  # type: ignore[union-attr] # there is a probe
        self._solver = Solver(
            [item for item in mechanics.items if item is not mechanics.contact],
            space.n_dof,
            space.nodes,
            threads=mechanics.threads,
        )
        self._surface = np.unique(space.facets)
        self._rows = (3 * model.seen_nodes[:, None] + np.arange(3)).ravel()
        low, high = self._contact.shape.bounds
        self._face = np.array([[x, y, 0.0] for x in (low[0], high[0]) for y in (low[1], high[1])])
        self._last: _Start | None = None  # the last answer

    def _a_contact(self) -> ProbeContact:
        """Return the model's contact with a state of its own: what answers and what learns may be two threads."""
        contact: ProbeContact = copy.copy(self.model.mechanics.contact)  # type: ignore[assignment] # there is a probe
        contact.exactness = EXACTNESS
        return contact

    # -- the library -------------------------------------------------------------------------------------------------

    def train(self, poses: Iterable[Pose], cache: Path | None = None) -> None:
        """Solve the full model along ``poses`` (thinned to the spacing) and linearise it there.

        With ``cache`` (a folder) the library is kept, and found again for the same mesh, physics and poses.
        """
        if self.why_not:
            return
        chosen = self._thinned([frames.pose_matrix(pose) for pose in poses])
        path = None if cache is None else cache / f"live-{self._key(chosen)}.npz"
        kept = None if path is None else read_library(path, self._rows, self._tell)
        if kept is not None:
            self.library, self._coefficient, self._floor = kept
            self._tell(f"live: {len(self.library)} solutions from {path}")
            return
        self.model.reset()
        for k, T in enumerate(chosen):
            self._tell(f"live: solution {k + 1} of {len(chosen)}")
            pose = frames.matrix_pose(T)
            if self.model.predict(pose).converged:
                self._add(self._placed(pose))
        self._solve_back()
        self.model.reset()
        if path is not None:
            library = Library(self.library, self._coefficient, self._floor)
            if not write_library(path, self._rows, library):
                self._tell(f"live: {path.parent} cannot be written, the next start takes as long")

    def _thinned(self, poses: list[Array]) -> list[Array]:
        """Return every pose that is further than the spacing from those chosen before."""
        chosen: list[Array] = []
        for T in poses:
            if len(chosen) < self.settings.max_entries and all(
                self._distance(T, other) >= self.settings.spacing for other in chosen
            ):
                chosen.append(T)
        return chosen

    def _distance(self, a: Array, b: Array) -> float:
        """Return how far the corners of the probe's face are apart, m."""
        return float(np.abs(frames.apply(a, self._face) - frames.apply(b, self._face)).max())

    def _add(self, T: Array) -> None:
        """Let the model's solution join the library; c is measured on it with its nearest neighbours."""
        mechanics = self.model.mechanics
        body = condense(self._solver, mechanics.x, self._nodes_near(mechanics.x, T), self._rows)
        entry = Entry(T, body, self._multiplier(), self._forces(mechanics.x)[body.dofs])
        for neighbour in sorted(self.library, key=lambda e: self._distance(e.T, T))[:2]:
            self._measure(neighbour, entry)
            self._measure(entry, neighbour)
        self.library.append(entry)

    def _solve_back(self) -> None:
        """Go the way back through the library, with a pose near each, more exactly than on the way there: what is found
        otherwise is no error of the linearisation, and what is wrong off the path is more than c d^2 along it says."""
        contact: ProbeContact = self.model.mechanics.contact  # type: ignore[assignment] # there is a probe
        usual, contact.gap_tolerance = contact.gap_tolerance, JUDGED * contact.gap_tolerance
        rng = np.random.default_rng(0)
        for k in range(len(self.library) - 1, -1, -1):
            entry = self.library[k]
            self._tell(f"live: the way back, {k + 1} of {len(self.library)} left")
            if self.model.predict(self._recorded(entry.T)).converged:
                self.library[k] = replace(entry, spread=self._apart(entry.body.x))
            T = _off_path(entry.T, rng)
            if self.model.predict(self._recorded(T)).converged:
                self._measure_off_path(entry, T)
        contact.gap_tolerance = usual

    def _apart(self, x: Array) -> float:
        """Return how far the full model's last solution is from ``x`` (k,) at the rows, for 99 % of them, m."""
        return float(np.percentile(np.abs(self.model.mechanics.x[self._rows] - x), NODES_WITHIN))

    def _measure_off_path(self, entry: Entry, T: Array) -> None:
        """Measure what an entry's answer at ``T``, where the full model has just been solved, lacks beyond c d^2."""
        try:
            x, d, _ = self._answer(self._measuring, entry, T, self._start(entry))
        except (NotCovered, NotSettled):
            return
        self._floor = max(self._floor, self._apart(x[self._rows]) - self.coefficient * d * d)

    def _forces(self, x: Array) -> Array:
        """Return the full model's contact forces (n_dof,) N on the body in its last solution ``x``."""
        contact, out = self.model.mechanics.contact, np.zeros(len(x))
        part = None if contact is None else contact.local(x, tangent=False)
        if part is not None and contact is not None:
            np.add.at(out, contact.dofs[part.facets], -part.vectors)
        return out

    def _multiplier(self) -> Array:
        """Return the full model's contact pressures of its last solution."""
        contact = self.model.mechanics.contact
        return np.zeros(0) if contact is None else contact.state.multiplier

    def _measure(self, source: Entry, target: Entry) -> None:
        """Predict one entry's solution from another: c = error / d^2."""
        try:
            x, d, _ = self._answer(self._measuring, source, target.T, self._start(source))
        except (NotCovered, NotSettled):
            return
        error = float(np.percentile(np.abs(x[self._rows] - target.body.x), NODES_WITHIN))
        if 2e-4 < d < 3e-3:
            self._coefficient = max(self._coefficient, error / d**2)

    @property
    def coefficient(self) -> float:
        """c of the error estimate c d^2, 1/m."""
        return SAFETY * self._coefficient if self._coefficient else START_COEFFICIENT

    def _nodes_near(self, x: Array, T: Array) -> NDArray[np.int64]:
        """Return free surface nodes within reach of the probe's box at ``T``."""
        space, surface = self.model.space, self._surface
        u = x[: 3 * space.n_nodes].reshape(-1, 3)
        y = frames.apply(frames.inverse(T), space.nodes[surface] + u[surface])
        low, high = self._contact.shape.bounds
        away = np.linalg.norm(np.maximum(np.maximum(low - y, y - high), 0.0), axis=1)
        near = surface[away < REACH]
        return np.asarray(near[~np.isin(3 * near, self.model.mechanics.held())])

    # -- predicting --------------------------------------------------------------------------------------------------

    def predict(self, pose: Pose | None, stamp_ns: int | None = None) -> Prediction:
        """Return the prediction at ``pose``: live where the library is near enough, else by the full model."""
        return self.answer(pose, stamp_ns) or self.learn(pose, stamp_ns)

    def answer(self, pose: Pose | None, stamp_ns: int | None = None) -> Prediction | None:
        """Return the live prediction at ``pose``; None where the library is not near enough."""
        began = clock.perf_counter()
        found = None if pose is None or self.why_not else self._live(self._placed(pose))
        if pose is None or found is None:
            return None
        self.counts.live += 1
        return self._prediction(self.model.moment_of(pose) if stamp_ns is None else stamp_ns, *found, began)

    def learn(self, pose: Pose | None, stamp_ns: int | None = None) -> Prediction:
        """Return the full model's prediction at ``pose``, which joins the library; a thread may do so while another one
        has `answer` tell others."""
        self.counts.full += 1
        prediction = self.model.predict(pose, stamp_ns)
        is_full = self.why_not or len(self.library) >= self.settings.max_entries
        if prediction.converged and pose is not None and not is_full:
            self._add(self._placed(pose))
        return replace(prediction, error_bound=0.0 if prediction.converged else np.nan)

    def knows(self, pose: Pose | None) -> bool:
        """Return whether the library is near enough to ``pose`` to answer it."""
        return pose is not None and self._found(self._measuring, self._placed(pose), None) is not None

    def warm_up(self) -> None:
        """Answer once where the library is best, so that the first pose does not wait for kernels to be loaded."""
        for entry in self.library[:1]:
            self._found(self._contact, entry.T, None)

    def _placed(self, pose: Pose) -> Array:
        """Return T_phantom_probe with the physics' tool offset, as entries have it."""
        T = frames.pose_matrix(pose)
        T[:3, 3] += T[:3, :3] @ self._offset
        return T

    def _recorded(self, T: Array) -> Pose:
        """Return the pose, without the tool offset, that is placed at ``T``."""
        return frames.matrix_pose(frames.transform(T[:3, :3], T[:3, 3] - T[:3, :3] @ self._offset))

    def _start(self, entry: Entry) -> _Start:
        """Return the entry's own solution, to start from."""
        force = np.zeros(self.model.space.n_dof)
        force[entry.body.dofs] = entry.force
        return _Start(entry.T, force, entry.multiplier)

    def _live(self, T: Array) -> tuple[Array, float] | None:
        """Return x (right at the rows) and its error estimate; None where the estimate is above the tolerance."""
        found = self._found(self._contact, T, self._last)
        self._last = None if found is None else found.start
        return None if found is None else (found.x, found.bound)

    def _found(self, contact: ProbeContact, T: Array, last: _Start | None) -> _Found | None:
        """Return the answer of the nearest entry whose estimate is within the tolerance, starting from that or from the
        ``last`` answer, whichever is nearer."""
        for entry in sorted(self.library, key=lambda e: self._distance(e.T, T))[: self.settings.n_nearest]:
            near = last is not None and self._distance(last.T, T) < self._distance(entry.T, T)
            start = last if near and last is not None else self._start(entry)
            try:
                x, d, answered = self._answer(contact, entry, T, start)
            except (NotCovered, NotSettled):
                continue
            bound = self.coefficient * d * d
            if bound <= self.settings.tolerance and self._means_contact(contact, entry, T, x):
                return _Found(x, bound + max(entry.spread, SAFETY * self._floor), answered)
        return None

    def _means_contact(self, contact: ProbeContact, entry: Entry, T: Array, x: Array) -> bool:
        """Return whether the probe may go at once from the entry's pose to ``T``, and touches the body at ``x`` as it
        should."""
        return contact.approach.admissible(self._state(entry.body), entry.T, T) and not contact.flaw(
            x, self.settings.tolerance
        )

    def _answer(self, contact: ProbeContact, entry: Entry, T: Array, start: _Start) -> tuple[Array, float, _Start]:
        """Solve ``contact`` at ``T`` on the entry's body, from forces and multipliers at another pose (``start``): x,
        its largest distance d from the entry's own solution, and what an answer nearby may start from."""
        body = entry.body
        contact.state = replace(contact.state, multiplier=start.multiplier)
        contact.prepare(Moment(0.0, np.inf, np.zeros(3), pose=T))
        force, free = start.force[body.dofs], np.zeros(len(start.force))
        free[body.rows] = body.free
        shift: Array | None = self._carried(body, start.T, T)
        for _ in range(MAX_UPDATES):
            x, force = touch(body, contact, force, free, shift)
            shift = None
            if not contact.update(x):
                break
        x[self._rows] = body.spread(force)
        everywhere = np.zeros(len(free))
        everywhere[body.dofs] = force
        d = float(np.abs(x[self._rows] - body.x).max())
        return x, d, _Start(T, everywhere, contact.state.multiplier)

    def _state(self, body: Condensed) -> Array:
        """Return the displacements (n_dof,) m that the body was linearised about; 0 where they are not asked for."""
        x = np.zeros(self.model.space.n_dof)
        x[self._rows] = body.x
        return x

    def _carried(self, body: Condensed, before: Array, T: Array) -> Array:
        """Return how far (m,) the body's dofs move if they stick to the probe that goes from ``before`` to ``T``."""
        at = (self.model.space.nodes.ravel()[body.dofs] + self._state(body)[body.dofs]).reshape(-1, 3)
        return (frames.apply(T @ frames.inverse(before), at) - at).ravel()

    def _prediction(self, stamp_ns: int, x: Array, bound: float, began: float) -> Prediction:
        force, torque = self._contact.wrench(x)
        return replace(
            self.model.prediction_of(x, stamp_ns),
            force=force,
            torque=torque,
            error_bound=bound,
            n_iterations=1,
            solve_seconds=clock.perf_counter() - began,
        )

    # -- the cache ---------------------------------------------------------------------------------------------------

    def _key(self, poses: list[Array]) -> str:
        """Return the cache's key, of the mesh, the poses, and the physics: its forces at some displacement say
        something of all of it."""
        mechanics, space = self.model.mechanics, self.model.space
        mechanics.prepare(Moment(0.0, np.inf, self.model.physics.gravity, pose=poses[0]))
        x = 1e-4 * np.random.default_rng(0).normal(size=space.n_dof)
        forces = np.round(mechanics.residual(x, System(self._solver.pattern)), 9)
        how = f"there and back, entries with the tool offset, judged to {JUDGED}"
        digest = hashlib.sha256(f"{how}, {self.model.physics.probe!r}".encode())  # a shape's repr says all of it
        rounded = np.round(np.array(poses), 9)  # a pose that was worked out from a solution differs in its last bits
        for array in (space.nodes, space.cells, rounded, forces, mechanics.held(), self._rows):
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()[:16]


def _off_path(T: Array, rng: np.random.Generator) -> Array:
    """Return a pose that is displaced and turned a little."""
    turn = Rotation.from_rotvec(OFF_PATH[1] * rng.normal(size=3)).as_matrix()
    return frames.transform(turn @ T[:3, :3], T[:3, 3] + OFF_PATH[0] * rng.normal(size=3))


def why_not_live(physics: Physics) -> str:
    """Return what in the physics makes the answer depend on more than the pose, so that no library holds; "" if
    nothing."""
    if physics.probe is None:
        return "having no probe"
    return ", ".join(memory_of(physics).beyond_the_pose)
