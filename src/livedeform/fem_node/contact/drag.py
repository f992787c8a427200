"""A probe that begins to rub: what friction adds to a solution without it, with the body as it answers to first order.

The pressures p at a frictionless solution x are known, and so are the limits mu p of the tractions (Tresca's friction).
Then the tractions t(d) on the surface that moves by d are those of a convex energy, and with the compliance C of the
surface under the probe, which keeps to its face,

    d + C f(d) = 0,    f: what t adds to the residual,

is a small problem that has one solution (Kikuchi & Oden 1988, chapter 10). It is followed from moment to moment: what
stuck goes on from where it stuck. Nothing here has to settle: a whole run with friction may not.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from livedeform.common.types import Array
from livedeform.fem_node.contact.contact import ContactState, ProbeContact
from livedeform.fem_node.items.protocol import Moment

STIFFER = 10.0  # times the contact's penalty: what sticks gives way by less than a tenth of a micrometre
NEAR = 1e-9  # m, within which the surface's motion is solved
MOST = 40  # iterations, of which a few are usual
HALVINGS = 8  # of a step
ENOUGH = 1e-4  # of what a step promises, that it must better the energy by (Armijo)
NONE = -1e30  # Pa, a multiplier by which a point bears no pressure

Compliance = Callable[[NDArray[np.int64]], Array]  # of dofs (k,): how they move (k, k) under forces at each of them


class Drag:
    """The friction of a ``contact`` on the path of a body that slides without any."""

    def __init__(self, contact: ProbeContact) -> None:
        self.contact = contact
        self._bears: ContactState = contact.state  # with the pressures of the solution
        self._d = self._q = np.zeros(contact.space.n_dof)

    def prepare(self, moment: Moment) -> None:
        """Put the probe at the moment's pose."""
        self.contact.prepare(moment)
        self.contact.stiffening = STIFFER

    def load(self, x: Array, free: ProbeContact, compliance: Compliance) -> Array:
        """Return what friction adds to the residual (n_dof,) at the solution ``x`` of a contact that is ``free`` of
        it."""
        contact, rows, pressure, gap = self.contact, *free.pressed(x)
        n, out = len(contact.state.multiplier), np.zeros_like(x)
        multiplier, limit = np.zeros(n), np.zeros(n)
        multiplier[rows] = pressure + STIFFER * contact.law.penalty * gap
        limit[rows] = contact.law.friction * pressure
        self._d, self._bears = np.zeros_like(x), replace(contact.state, multiplier=multiplier, limit=limit)
        if not len(rows):
            return out
        contact.state = replace(self._bears, multiplier=np.full(n, NONE))
        facets = np.unique(rows // contact.weights.shape[1])
        dofs = np.unique(contact.dofs[facets])
        self._d[dofs], out[dofs] = self._solved(x, dofs, compliance(dofs))
        self._q = out
        return out

    def commit(self, x: Array) -> None:
        """Drag the anchors along that slid by the last `load`."""
        self.contact.state = self._bears
        self.contact.commit(x + self._d)

    def _solved(self, x: Array, dofs: NDArray[np.int64], C: Array) -> tuple[Array, Array]:
        """Return the motion (k,) m of the dofs and the friction's forces (k,) N there.

        With the forces q that the body feels, d = -C q, Newton's method seeks the least of q C q / 2 + E(-C q), where q
        is what the tractions give.
        """
        C = 0.5 * (C + C.T)
        q = self._q[dofs]
        f, H, energy = self._forces(x, dofs, -C @ q)
        for _ in range(MOST):
            wrong = C @ (f - q)
            if np.abs(wrong).max() < NEAR:
                break
            step = np.linalg.solve(np.eye(len(q)) + H @ C, f - q)
            level, slope, length = 0.5 * q @ C @ q + energy, -float(wrong @ step), 1.0
            for _ in range(HALVINGS):
                new = q + length * step
                f, H, energy = self._forces(x, dofs, -C @ new)
                if 0.5 * new @ C @ new + energy <= level + ENOUGH * length * slope:
                    break
                length *= 0.5
            q = new
        return -C @ f, f

    def _forces(self, x: Array, dofs: NDArray[np.int64], d: Array) -> tuple[Array, Array, float]:
        """Return the friction's forces (k,) N, their derivative (k, k) N/m and its energy (J) as the dofs move by ``d``
        (k,) m."""
        moved = x.copy()
        moved[dofs] += d
        f, H = np.zeros(len(dofs) + 1), np.zeros((len(dofs) + 1, len(dofs) + 1))
        part = self.contact.local(moved, tangent=True, safe=True)
        if part is not None and part.blocks is not None:
            of = self.contact.dofs[part.facets]
            place = np.searchsorted(dofs, of)
            place[place == len(dofs)] = 0
            at = np.where(dofs[place] == of, place, len(dofs))  # of facets that bear nothing: nothing
            np.add.at(f, at, part.vectors)
            np.add.at(H, (at[:, :, None], at[:, None, :]), part.blocks)
        return f[:-1], H[:-1, :-1], 0.0 if part is None else part.energy
