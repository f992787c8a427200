"""Newton's method for a body that a probe presses, with the contact solved whole in each of its steps.

Only the body is linearised; what the probe touches, and how hard, is found on the surface under it, with the body
condensed onto these dofs (`fem_node.contact.small_problem`). With K the body's tangent without contact, r(x) what is
out of balance with it, f the contact's nodal forces on the body and C = (K^-1) at the surface, a step is

    d = -K^-1 r(x) + K^-1 (f_new - f),    f_new = -grad psi(x + d) at the surface,

multipliers and friction limits included. So a step ends where contact is settled for the body as it answers there to
first order, and what is left is the body's own nonlinearity: some six steps with one factor, where Newton's method on
both together takes forty and nine, since each point that touches or lets go is a kink.

In its first step the contact is first solved on softer springs: multipliers that are about right lead on in two or
three small steps, from none it takes tens. Where all this does not converge the solver goes its ordinary way.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from livedeform.common.errors import ConvergenceError
from livedeform.common.types import Array
from livedeform.fem_node.contact.contact import RELAXED_AFTER, Local, ProbeContact
from livedeform.fem_node.contact.small_problem import NotCovered, NotSettled, Surface, carried_forces, touch
from livedeform.fem_node.items.protocol import Item
from livedeform.fem_node.solve.assembly import Pattern, System
from livedeform.fem_node.solve.linear_solver import Condensing, FactorisationError

NEAR = 1e-3  # m from the probe: surface that it may touch within a step
WITHIN_REACH = 0.005  # m from the probe: surface onto which the body is condensed
MOST_DOFS = 900  # of it: others are solved for when they are touched
SOFT = (0.03, 0.03, 0.2)  # of the contact's penalty, in the first step
ROUGHLY, EXACTLY = 1e-6, 1e-10  # m: how exactly the small problem is solved, on soft springs and in the end
MOST_SMALL = 80  # steps of the small problem
MOST_UPDATES = 30  # of multipliers in a step
MOST_STEPS = 25
SLOW = 0.4  # of the step before: a longer step asks for a fresh factor
LARGE = 2e-3  # m: as much of a step is taken at most
MOST_SLOW = 5  # steps that ask for one
FARTHER = 3.0  # times the step before: a longer one leads away
CYCLES = 0.7  # of the step before: of a longer one half is taken
HALVINGS = 5


class NotFound(Exception):
    """The search does not lead there."""


class CondensedSearch:
    """The search for the equilibrium of the ``items``, of which one is a probe's contact; `of` makes it."""

    def __init__(self, items: Sequence[Item], contact: ProbeContact, pattern: Pattern, linear: Condensing) -> None:
        self.contact, self.others = contact, [item for item in items if item is not contact]
        self._linear, self._system, self._pattern = linear, System(pattern), pattern
        self._compliance: Array | None = None  # None: there is no factor
        self._dofs = np.zeros(0, np.int64)  # that it is of
        self._place = np.full(pattern.n_dof, -1, np.int64)  # of a dof among them
        self._held, self._touching = np.zeros(0, np.int64), np.zeros(0, np.int64)
        self.n_steps = self.n_factorisations = 0

    @classmethod
    def of(
        cls, items: Sequence[Item], pattern: Pattern, threads: int | None, *, in_motion: bool
    ) -> CondensedSearch | None:
        """Make it for a contact with multipliers where the probe rubs or the body is ``in_motion``, and the fast linear
        solver is installed. At rest and without friction the ordinary way is the faster one on refined meshes, and as
        fast where the surface sticks to the probe; in motion, many steps have one factor without contact."""
        contact = next((item for item in items if isinstance(item, ProbeContact)), None)
        if contact is None or not pattern.symmetric or contact.law.formulation != "lagrange":
            return None
        if contact.law.sticks == 0.0 and not in_motion:
            return None
        try:
            return cls(items, contact, pattern, Condensing(pattern, threads))
        except ImportError:
            return None

    def find(self, x: Array, held: NDArray[np.int64], tolerance: float, size: float) -> Array:
        """Return the equilibrium (n_dof,) at the prepared moment from ``x``, whose ``held`` dofs are where they are
        held, to a last step of ``tolerance`` m; no step is larger than the body's ``size`` m. Raises `NotFound`."""
        self.n_steps = self.n_factorisations = 0
        self._hold(held)
        try:
            return self._search(x.copy(), tolerance, size)
        except (FactorisationError, ConvergenceError, NotSettled) as error:
            raise NotFound from error
        finally:
            self.contact.stiffening = 1.0

    def response(self, part: Local, load: Array, x: Array) -> Array | None:
        """Return how the body (n_dof,) yields to a ``load`` (n_dof,) N on the facets of the contact's ``part`` at
        ``x``, which the probe holds, by the last factor; None where there is none."""
        if self._compliance is None:
            return None
        dofs, force = np.unique(self.contact.dofs[part.facets]), np.zeros_like(x)
        surface = Surface(dofs, self._compliance_of(dofs))
        force[dofs] = carried_forces(surface, self.contact, part, load[dofs], x)
        force[self._held] = 0.0
        return self._linear.solve(force)

    def forget(self) -> None:
        """Let the next search begin with a fresh factor."""
        self._compliance = None

    def begin_anew(self) -> None:
        """Forget the last factor, and onto which surface it was condensed."""
        self.forget()
        self._linear.cover(np.zeros(0, np.int64))

    # -- steps -----------------------------------------------------------------------------------------------------

    def _search(self, x: Array, tolerance: float, size: float) -> Array:
        last, before, slow = np.inf, np.inf, 0
        self._evaluate(x)
        for k in range(MOST_STEPS):
            self.n_steps += 1
            step = self._step(x, k)
            length = float(np.abs(step[: 3 * self.contact.space.n_nodes]).max())
            if not length <= min(FARTHER * before, size):
                raise NotFound
            most = LARGE if k < 2 or length < CYCLES * before else 0.5 * length
            x, whole = self._along(x, step * min(1.0, most / max(length, most)))
            whole &= length <= most
            before = length
            if whole and length < tolerance:
                moved = any([item.update(x) for item in self.others])  # every item is asked
                if not moved and not self.contact.let_go(x):
                    return x
                self._evaluate(x)  # what was in balance with the limits before is not with those now
                before = last = np.inf  # the body jumps
                continue
            if length > SLOW * last or not whole:
                slow += 1
                if slow > MOST_SLOW:
                    raise NotFound
                self._factorise(x)
                length = np.inf
            last = length
        raise NotFound

    def _along(self, x: Array, step: Array) -> tuple[Array, bool]:
        """Return where the ``step`` leads, or as much of it as has an energy, and whether that is the whole of it."""
        for k in range(HALVINGS):
            there = x + 0.5**k * step
            if np.isfinite(self._evaluate(there)) and np.all(np.isfinite(self._system.r)):
                return there, k == 0
        raise NotFound

    def _step(self, x: Array, k: int) -> Array:
        """Return step number ``k`` from ``x``, at which the items have been evaluated; the contact's state is then that
        of its end."""
        if self._compliance is None:
            self._factorise(x)
        r, force = self._system.r.copy(), self._forces(x)
        free = -self._linear.solve(r - force)
        dofs = self._near(x)
        if not len(dofs):
            dofs = self._near(x + free)
        if not len(dofs):
            return free
        dofs, new = self._touched(x + free, dofs, force, k)
        change = np.zeros_like(x)
        change[dofs] = new - force[dofs]
        change[self._held] = 0.0
        return free + self._linear.solve(change)

    def _touched(self, free: Array, dofs: NDArray[np.int64], before: Array, k: int) -> tuple[NDArray[np.int64], Array]:
        """Return which dofs (m,) the probe may touch, these ``dofs`` or more, and the contact's forces (m,) N on them
        when it has settled in step number ``k``, from those ``before`` (n_dof,), with which the body would be at
        ``free`` (n_dof,)."""
        force, contact = before.copy(), self.contact
        # limits that go all of the way in each step alternate between two steps, of which none is the last
        contact.outer = min(k, RELAXED_AFTER)
        stages = [*(SOFT if k == 0 else ()), *([1.0] * MOST_UPDATES)]
        while stages:
            contact.stiffening = stages[0]
            surface = Surface(dofs, self._compliance_of(dofs))
            base = free.copy()
            base[dofs] -= surface.compliance @ before[dofs]
            tolerance = EXACTLY if stages[0] == 1.0 else ROUGHLY
            try:
                there, force[dofs] = touch(surface, contact, force[dofs], base, tolerance=tolerance, most=MOST_SMALL)
            except NotCovered as more:
                dofs = np.union1d(dofs, contact.dofs[more.facets])  # more than before: they were outside
                continue
            again = contact.settle(there)
            if stages.pop(0) < 1.0:
                contact.outer = 0
            elif not again:
                return dofs, force[dofs]
        raise NotFound

    # -- parts -----------------------------------------------------------------------------------------------------

    def _evaluate(self, x: Array) -> float:
        """Sum the residual of all items but the contact; return their energy."""
        self._system.clear(tangent=False)
        energy = sum(item.evaluate(x, self._system, tangent=False) for item in self.others)
        self._system.r[self._held] = 0.0
        return energy

    def _forces(self, x: Array) -> Array:
        """Return the contact's forces (n_dof,) N on the body at ``x``."""
        out, part = np.zeros_like(x), self.contact.local(x, tangent=False)
        if part is not None:
            np.add.at(out, self.contact.dofs[part.facets], -part.vectors)
            out[self._held] = 0.0
        return out

    def _hold(self, held: NDArray[np.int64]) -> None:
        if not np.array_equal(held, self._held):
            self._held, self._touching = held, self._pattern.touching(held)
            self.forget()

    def _factorise(self, x: Array) -> None:
        """Factorise the body's tangent at ``x``, or a safe one where that is not positive definite, with the compliance
        of the dofs within reach; the residual is that at ``x`` then."""
        self._compliance, dofs = None, self._within_reach(x)
        if np.isin(dofs, self._linear.dofs).all():
            dofs = self._linear.dofs  # analysed already
        self._linear.cover(dofs)
        self._dofs = dofs
        self._place[:] = -1
        self._place[dofs] = np.arange(len(dofs))
        for safe in (False, True):
            self._tangent_at(x, safe=safe)
            self.n_factorisations += 1
            try:
                self._compliance = self._linear.factorise(self._system)
                fixed = np.isin(dofs, self._held)
                self._compliance[fixed] = self._compliance[:, fixed] = 0.0
                break
            except FactorisationError:
                if safe:
                    raise
        self._evaluate(x)

    def _tangent_at(self, x: Array, *, safe: bool) -> None:
        system = self._system
        system.safe = safe
        system.clear(tangent=True)
        for item in self.others:
            item.evaluate(x, system, tangent=True)
        system.safe = False
        diagonal = self._pattern.diagonal
        scale = float(np.abs(system.values[diagonal]).mean())
        system.values[self._touching] = 0.0
        system.values[diagonal[self._held]] = scale

    def _compliance_of(self, dofs: NDArray[np.int64]) -> Array:
        """Return the compliance (m, m) m/N of the dofs; what the last factor came without is solved for."""
        assert self._compliance is not None  # `_step` makes a factor
        new = dofs[self._place[dofs] < 0]
        if len(new):
            known, m = self._compliance, len(self._compliance)
            self._dofs = np.concatenate([self._dofs, new])
            self._place[new] = np.arange(m, m + len(new))
            unit = np.zeros((len(self._place), len(new)), order="F")
            free = ~np.isin(new, self._held)
            unit[new[free], np.flatnonzero(free)] = 1.0
            columns = self._linear.solve(unit)[self._dofs]
            columns[np.isin(self._dofs, self._held)] = 0.0
            columns[m:] = 0.5 * (columns[m:] + columns[m:].T)
            self._compliance = np.block([[known, columns[:m]], [columns[:m].T, columns[m:]]])
        at = self._place[dofs]
        return self._compliance[np.ix_(at, at)]

    def _near(self, x: Array) -> NDArray[np.int64]:
        """Return the dofs (m,) of facets that are near the probe, or bear something."""
        contact = self.contact
        facets, gap = contact.gaps(x)
        bears: NDArray[np.bool_] = np.any(contact.state.multiplier.reshape(contact.weights.shape), axis=1)
        return np.unique(contact.dofs[facets[(gap < NEAR) | bears[facets]]])

    def _within_reach(self, x: Array) -> NDArray[np.int64]:
        """Return the dofs of facets that are within reach of the probe, the nearest first to be kept."""
        facets, gap = self.contact.gaps(x)
        order = facets[np.argsort(gap)][: np.count_nonzero(gap < WITHIN_REACH)]
        if not len(order):
            order = np.zeros(1, np.int64)  # some facet: PARDISO has no complement of nothing
        dofs = np.unique(self.contact.dofs[order])
        while len(dofs) > MOST_DOFS:
            order = order[: -max(1, len(order) // 10)]
            dofs = np.unique(self.contact.dofs[order])
        return dofs
