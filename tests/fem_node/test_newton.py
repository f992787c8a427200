"""The search for an equilibrium, on energies that are known in full."""

import numpy as np

from livedeform.fem_node.solve.newton import Learned, Lost, Newton

SHORT = 1e-5  # m, over which the energy below is a parabola; further out it is a cone, and a full step is too far


class Bowl:
    """The energy s sqrt(s^2 + x^2) of each unknown, as the part of a solver that a search needs."""

    def __init__(self) -> None:
        self.system = self.linear = self
        self.size, self.learns, self.learned, self.has_factor = 0.1, True, Learned(), False

    def evaluate(self, x, system, *, tangent):
        root = np.sqrt(SHORT**2 + x**2)
        self.r = SHORT * x / root
        if tangent:
            self.K = SHORT**3 / root**3
        return float(SHORT * root.sum())

    def factorise(self, x):
        self.factor, self.has_factor = self.K.copy(), True

    def solve(self, b):
        return b / self.factor

    def free(self, r):
        return r.copy()

    def step_size(self, dx):
        return float(np.abs(dx).max())

    def expect(self, x, dx):
        pass


def test_a_rough_search_ends_at_an_equilibrium_as_an_exact_one_does():
    """A full step of 0.1 mm from a fresh factor that does not better the energy is too far; it is no round-off."""
    start = np.array([2.0 * SHORT, -1.5 * SHORT])
    for tolerance in (2e-7, 1e-8):
        bowl = Bowl()
        energy = bowl.evaluate(start, bowl, tangent=True)
        found = Newton(bowl, start, energy, tolerance, 0.5).run(80)
        assert np.abs(found).max() < tolerance


def test_a_step_on_trial_that_leads_to_where_there_is_no_factor_is_taken_back():
    """It may have crushed elements, whose tangent is indefinite whatever is left out of it: the moment was lost."""
    refused = []

    class Cliff(Bowl):
        def factorise(self, x):
            if np.abs(x).max() > 4.0 * SHORT:
                refused.append(x)
                raise Lost("no factor")
            super().factorise(x)

    cliff, start = Cliff(), np.array([2.0 * SHORT, -1.5 * SHORT])
    found = Newton(cliff, start, cliff.evaluate(start, cliff, tangent=True), 1e-8, 0.5).run(80)
    assert refused and np.abs(found).max() < 1e-8
