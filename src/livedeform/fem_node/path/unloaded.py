"""The unloaded shape of a body that was scanned while gravity acted: an inverse problem.

Find w (unloaded = scanned + w) such that the scanned shape, u = 0, is in equilibrium under the scan's gravity: r(0;
w) = 0 (Govindjee & Mihalic 1996). As in Sellier (2011) the guess is moved by what its loaded image misses, here to
first order: w <- w + K^-1 r, with the tangent K of the scanned body; Anderson's (1965) acceleration over the last steps
makes it converge fast also at large strain. Gravity is raised in steps that adapt. Springs of a support, and the points
where friction sticks, are slack in the unloaded shape (`fem_node.items.supports`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from livedeform.common.errors import ConvergenceError
from livedeform.common.types import Array
from livedeform.fem_node.element.element import Space
from livedeform.fem_node.items.friction import FrictionSupport
from livedeform.fem_node.items.protocol import Moment
from livedeform.fem_node.items.supports import set_unloaded
from livedeform.fem_node.path.direction import Direction, same_physics
from livedeform.fem_node.path.mechanics import Mechanics
from livedeform.fem_node.physics.memory import as_scanned, memory_of
from livedeform.fem_node.physics.record import Physics
from livedeform.fem_node.solve.anderson import MEMORY, accelerated
from livedeform.fem_node.solve.assembly import System
from livedeform.fem_node.solve.solver import SolverSettings

ACCURACY = 1e-7  # of a changed body's largest difference
ROUND_OFF = 1e-15  # m
TOLERANCE = 1e-10  # of the body's size: the largest change of the last iteration
MAX_ITERATIONS = 60  # per step of gravity
MAX_UPDATES = 25  # of the support's friction, per step of gravity
REFRESH = 12  # iterations with one factor
SMALLEST_STEP = 1.0 / 32.0
MOST_KEPT = 20  # unloaded shapes


class InverseProblem:
    """r(0; w) of a scanned body, and the linear response of that body to it."""

    def __init__(
        self, space: Space, physics: Physics, *, settings: SolverSettings | None = None, threads: int | None = None
    ) -> None:
        self.space, self.physics = space, as_scanned(physics)
        self.mechanics = Mechanics(space, self.physics, settings=settings, threads=threads)
        self._zero = np.zeros(space.n_dof)
        self._held: NDArray[np.int64] | None = None

    def residual(self, w: Array, fraction: float, system: System) -> Array:
        """Return r(0; w) (n_dof,), held dofs at zero, for ``w`` (n, 3)."""
        self._set(w, fraction)
        r = self.mechanics.residual(self._zero, system)
        r[self.held] = 0.0
        return r

    @property
    def held(self) -> NDArray[np.int64]:
        """Dofs that the supports hold."""
        if self._held is None:
            self._held = self.mechanics.held()
        return self._held

    def factorise(self, w: Array, fraction: float) -> None:
        """Take the tangent of the scanned body with the unloaded shape ``w``."""
        self._set(w, fraction)
        self.mechanics.solver.factorise_at(self._zero)

    def linearise(self, w: Array, fraction: float) -> None:
        """Take the tangent with what friction's limits add, for small changes beside the solution ``w``."""
        self._set(w, fraction)
        self.mechanics.solver.linearise_at(self._zero)

    def try_factor(self, w: Array, fraction: float) -> bool:
        """Call `factorise`; return False if that cannot be."""
        try:
            self.factorise(w, fraction)
        except ConvergenceError:
            return False
        return True

    @property
    def slips(self) -> bool:
        """Return whether there is friction with the support."""
        return bool(memory_of(self.physics).slips)

    def take_friction(self, other: InverseProblem) -> None:
        """Take friction limits from a body with the same supports."""
        for mine, known in zip(self.mechanics.items, other.mechanics.items, strict=False):
            if isinstance(mine, FrictionSupport) and isinstance(known, FrictionSupport):
                mine.restore(known.save())

    def update(self, w: Array, fraction: float) -> bool:
        """Take the limits of friction with the support from the pressure; return True while they still move."""
        if not self.slips:
            return False
        self._set(w, fraction)
        return any([item.update(self._zero) for item in self.mechanics.items])  # every item is asked

    def response(self, r: Array) -> Array:
        """Return K^-1 r as nodal displacements (n, 3), or (n, 3, k) of several."""
        solved = self.mechanics.solver.answering.solve_exactly(r)[: 3 * self.space.n_nodes]
        return solved.reshape(-1, 3, *r.shape[1:])

    def _set(self, w: Array, fraction: float) -> None:
        mechanics = self.mechanics
        mechanics.continuum.set_unloaded(w)
        mechanics.weight.set_volumes(mechanics.continuum.mass_weights)
        set_unloaded(mechanics.items, w)
        moment = Moment(0.0, np.inf, fraction * self.physics.scan_fraction * self.physics.scan_gravity)
        mechanics.prepare(moment)


class UnloadedShapes:
    """The unloaded shapes of bodies on one mesh, kept by what they depend on."""

    def __init__(self, space: Space, settings: SolverSettings | None = None, threads: int | None = None) -> None:
        self._space, self._settings, self._threads = space, settings, threads
        self._known: list[tuple[Physics, Array]] = []
        self._followed: tuple[Physics | None, list[tuple[Physics, Array | None]]] = (None, [])  # of the last leader

    def of(self, physics: Physics) -> Array | None:
        """Return the displacement (n, 3) m from the scanned to the unloaded shape; None if that is the scanned one.
        `ConvergenceError` if there is none."""
        if physics.scan_fraction == 0.0:
            return None
        key = as_scanned(physics)
        for known, shape in self._known:
            if same_physics(known, key):
                return shape
        inverse = self._inverse(physics)
        near = self._known[-1][1] if self._known and not inverse.slips else None  # friction goes by the way there
        shape = unloaded_shape(inverse, near)
        self._known = [*self._known[-MOST_KEPT:], (key, shape)]
        return shape

    def along(self, physics: Physics, unloaded: Array | None, directions: Sequence[Direction]) -> list[Array | None]:
        """Return the unloaded shape of each direction from that of the leader; the same object where it does not
        change. One that cannot be followed keeps the leader's: its derivative leaves out the change of shape."""
        wanted = [k for k, direction in enumerate(directions) if _reshapes(physics, direction)]
        shapes = [unloaded] * len(directions)
        if not wanted:
            return shapes
        w = np.zeros_like(self._space.nodes) if unloaded is None else unloaded
        for k, shape in zip(wanted, self._beside(physics, w, [directions[k].physics for k in wanted]), strict=True):
            shapes[k] = unloaded if shape is None else shape
        return shapes

    def _beside(self, physics: Physics, w: Array, changed: Sequence[Physics]) -> list[Array | None]:
        """Return the shapes with ``changed`` physics beside the shape ``w`` (n, 3) of a body, None where it cannot be
        followed; those of the last body are kept: its recordings, and parts of these, ask for the same."""
        leader, keys = as_scanned(physics), [as_scanned(one) for one in changed]
        if self._followed[0] is None or not same_physics(self._followed[0], leader):
            self._followed = leader, []
        known = self._followed[1]
        new = [i for i, key in enumerate(keys) if not any(same_physics(key, other) for other, _ in known)]
        if new:
            inverse, asked = self._inverse(physics), [changed[i] for i in new]
            try:
                found: list[Array | None] = list(changed_shapes(inverse, w, asked))
            except ConvergenceError:  # of one of them: the others are still wanted
                found = [_one_shape(inverse, w, one) for one in asked]
            known += zip([keys[i] for i in new], found, strict=True)
        return [next(shape for other, shape in known if same_physics(key, other)) for key in keys]

    def _inverse(self, physics: Physics) -> InverseProblem:
        return InverseProblem(self._space, physics, settings=self._settings, threads=self._threads)


def _reshapes(leader: Physics, direction: Direction) -> bool:
    """Return whether the direction changes the unloaded shape."""
    reference, changed = direction.reference or leader, direction.physics
    loaded = bool(reference.scan_fraction or changed.scan_fraction)
    return loaded and not same_physics(as_scanned(reference), as_scanned(changed))


def _one_shape(inverse: InverseProblem, w: Array, physics: Physics) -> Array | None:
    """Return one changed unloaded shape; None where the iteration does not follow."""
    try:
        return changed_shapes(inverse, w, [physics])[0]
    except ConvergenceError:
        return None


def unloaded_shape(problem: InverseProblem, guess: Array | None = None) -> Array:
    """Return the displacement (n, 3) m from the scanned to the unloaded shape; `ConvergenceError` if there is none."""
    found = None if guess is None else _iterate(problem, guess, 1.0)
    if found is not None:
        return found
    w, done, step = np.zeros((problem.space.n_nodes, 3)), 0.0, 1.0
    while done < 1.0:
        target = min(done + step, 1.0)
        found = _iterate(problem, w, target)
        if found is not None:
            w, done, step = found, target, 2.0 * step
            continue
        step = 0.5 * min(step, 1.0 - done)
        if step < SMALLEST_STEP:
            raise ConvergenceError(
                f"no unloaded shape was found: beyond {100.0 * done:.0f} % of the weight the scanned shape is no "
                "equilibrium",
                where="unloaded shape",
                remedy="the modulus may be too low for this shape and weight, or scan_gravity, support or density "
                "wrong; check them, or declare the configuration unloaded",
            )
    return w


def changed_shapes(problem: InverseProblem, w: Array, changed: Sequence[Physics]) -> list[Array]:
    """Return the unloaded shapes with changed physics, from the shape ``w`` of ``problem``.

    They follow it with its factor; one whose support holds other dofs is solved for itself.
    """
    bodies = [InverseProblem(problem.space, physics) for physics in changed]
    alike = [np.array_equal(body.held, problem.held) for body in bodies]
    following = iter(_followed(problem, w, [body for body, same in zip(bodies, alike, strict=True) if same]))
    return [next(following) if same else unloaded_shape(body, w) for body, same in zip(bodies, alike, strict=True)]


def _followed(problem: InverseProblem, w: Array, changed: Sequence[InverseProblem]) -> list[Array]:
    """Return the unloaded shapes of the changed bodies.

    The unchanged body is iterated along, and its remaining drift taken off: differences are exact for small changes.
    """
    if not changed:
        return []
    problem.linearise(w, 1.0)
    bodies = [problem, *changed]
    for body in changed:
        body.take_friction(problem)
    for body in bodies:
        body.update(w, 1.0)  # limits of its own: with the leader's a change of friction alone moves nothing
    system = System(problem.mechanics.solver.pattern)
    shapes = [[w] for _ in bodies]
    steps: list[list[Array]] = [[] for _ in bodies]
    for _ in range(MAX_ITERATIONS):
        block = np.stack(
            [body.residual(own[-1], 1.0, system).copy() for body, own in zip(bodies, shapes, strict=True)], axis=1
        )
        response = problem.response(block)
        for k, body in enumerate(bodies):
            steps[k] = [*steps[k][-MEMORY:], response[:, :, k]]
            shapes[k] = [*shapes[k][-MEMORY:], accelerated(shapes[k], steps[k])]
            body.update(shapes[k][-1], 1.0)
        moved = np.abs(response - response[:, :, :1]).max(axis=(0, 1))
        sizes = np.array([np.abs(own[-1] - shapes[0][-1]).max() for own in shapes])
        if np.all(moved <= ACCURACY * sizes + ROUND_OFF):
            return [w + own[-1] - shapes[0][-1] for own in shapes[1:]]
    raise ConvergenceError(
        "the unloaded shape does not follow a change of the physics",
        where="unloaded shape",
        remedy="change the parameter less, or solve the inverse problem anew",
    )


def _iterate(problem: InverseProblem, w: Array, fraction: float) -> Array | None:
    """Return w with r(0; w) = 0, from a guess, and friction with the support in balance with it; None if it is not
    found."""
    for _ in range(MAX_UPDATES):
        found = _settle(problem, w, fraction)
        if found is None or not problem.update(found, fraction):
            return found
        w = found
    return None


def _settle(problem: InverseProblem, w: Array, fraction: float) -> Array | None:
    """Return w with r(0; w) = 0, from a guess; None if it is not found. Anderson acceleration keeps as many guesses as
    steps."""
    system = System(problem.mechanics.solver.pattern)
    size = float(np.ptp(problem.space.nodes, axis=0).max())
    steps: list[Array] = []
    guesses: list[Array] = []
    with np.errstate(all="ignore"):
        for iteration in range(MAX_ITERATIONS):
            if iteration % REFRESH == 0:
                if not problem.try_factor(w, fraction):
                    return None
                guesses, steps = [], []
            step = problem.response(problem.residual(w, fraction, system))
            largest = float(np.abs(step).max())
            if not np.isfinite(largest) or largest > size:
                return None
            if largest < TOLERANCE * size:
                return w + step
            guesses, steps = [*guesses[-MEMORY:], w], [*steps[-MEMORY:], step]
            w = accelerated(guesses, steps)
    return None
