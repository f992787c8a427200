"""A factor in single precision: what is refined is exact, and what cannot be trusted to it is not."""

import gc

import numpy as np
import pytest

from livedeform.fem_node.solve import linear_solver
from livedeform.fem_node.solve.assembly import Pattern, System
from livedeform.fem_node.solve.linear_solver import FactorisationError, Pardiso, make_linear_solver

pytestmark = pytest.mark.skipif(linear_solver.PyPardisoSolver is None, reason="needs PARDISO")
N = 60


def chain(softest):
    """A chain of springs (n, n) that is held at one end, by one that is ``softest``."""
    dofs = np.column_stack([np.arange(N - 1), np.arange(1, N)])
    system = System(Pattern(N, [dofs], symmetric=True))
    system.clear(tangent=True)
    spring = np.array([[1.0, -1.0], [-1.0, 1.0]])
    system.add_blocks(system.pattern.positions(dofs), np.repeat(spring[None], N - 1, axis=0))
    system.values[system.pattern.diagonal[0]] += softest
    return system


def error(solve, system):
    x = np.linspace(-1.0, 1.0, N)
    return np.abs(solve(system.times(x)) - x).max()


def test_what_is_refined_is_exact():
    """4e-6 in single precision, 3e-10 refined."""
    system = chain(1.0)
    linear = make_linear_solver(system.pattern, single=True)
    linear.factorise(system)
    assert 1e-8 < error(linear.solve, system) < 1e-3
    assert error(linear.solve_exactly, system) < 1e-8
    several = np.column_stack([system.times(np.ones(N)), system.times(np.arange(N) / N)])
    np.testing.assert_allclose(linear.solve_exactly(several)[:, 1], np.arange(N) / N, atol=1e-8)


def test_a_nearly_singular_tangent_is_factorised_in_double():
    system = chain(1e-9)
    linear = make_linear_solver(system.pattern, single=True)
    for _ in range(linear_solver.MOST_FAILURES + 1):
        try:
            linear.factorise(system)
        except FactorisationError:
            continue
    plain = Pardiso(system.pattern)
    plain.factorise(system)
    assert error(linear.solve, system) <= 2.0 * error(plain.solve, system) + 1e-12


def test_an_indefinite_tangent_is_refused():
    system = chain(-1.0)
    linear = make_linear_solver(system.pattern, single=True)
    for _ in range(linear_solver.MOST_FAILURES + 1):
        with pytest.raises(FactorisationError):
            linear.factorise(system)


def test_a_pattern_is_analysed_once_for_solvers_that_follow_each_other(monkeypatch):
    phases, call = [], linear_solver._call_pardiso

    def counted(handle, pattern, mtype, phase, *rest):
        phases.append((id(handle), phase))
        return call(handle, pattern, mtype, phase, *rest)

    monkeypatch.setattr(linear_solver, "_call_pardiso", counted)
    system, stiffer = chain(1.0), chain(1.0)
    stiffer.pattern, stiffer.values = system.pattern, 2.0 * system.values
    first = Pardiso(system.pattern)
    first.factorise(system)
    beside = Pardiso(system.pattern)  # the first one is still at work
    beside.factorise(stiffer)
    assert error(first.solve, system) < 1e-10
    assert error(beside.solve, stiffer) < 1e-10
    assert sum(phase == linear_solver._ANALYSE for _, phase in phases) == 2
    del first
    after = Pardiso(system.pattern)
    after.factorise(stiffer)
    assert error(after.solve, stiffer) < 1e-10
    assert sum(phase == linear_solver._ANALYSE for _, phase in phases) == 2
    single = Pardiso(system.pattern, single=True)  # of another kind
    single.factorise(system)
    assert sum(phase == linear_solver._ANALYSE for _, phase in phases) == 3


def test_what_was_given_back_ends_with_its_pattern():
    system = chain(1.0)
    solver = Pardiso(system.pattern)
    solver.factorise(system)
    del solver
    assert linear_solver._given_back[system.pattern]
    before = len(linear_solver._given_back)
    del system
    gc.collect()
    assert len(linear_solver._given_back) < before
