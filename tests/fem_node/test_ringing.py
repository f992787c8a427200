"""What rings: period and damping against closed forms, hung masses, and the spectrum of a power law."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bodies import EXACT, block_space, moment, plane, soft, symmetry
from scipy.optimize import least_squares, newton

from livedeform.fem_node.effects import viscoelasticity
from livedeform.fem_node.items.loads import hung_masses
from livedeform.fem_node.path.mechanics import Mechanics
from livedeform.fem_node.physics.record import DeadLoad, Inertia, MaterialSpec, Prony

L, SIDE, E, RHO = 0.1, 0.02, 4000.0, 1000.0
OMEGA = np.pi / 2 * np.sqrt(E / RHO) / L  # of the first longitudinal mode
PRONY = Prony((0.25, 0.1), (0.02, 0.2))


def _let_go(inertia, prony=None, seconds=1.2):
    """Times and the end's displacement of a bar (nu = 0) that was pulled, in the steps that it takes by itself."""
    space = block_space((SIDE, SIDE, L), (1, 1, 4), kind="p2")
    load = DeadLoad("pull", plane(2, L), np.array([0.0, 0.0, 200.0 * SIDE**2]))
    physics = replace(
        soft(0.0, E),
        supports=symmetry(0, 1, 2),
        loads=(load,),
        inertia=inertia,
        prony=prony,
        material=MaterialSpec("linear", E, 0.0),
    )
    mechanics = Mechanics(space, physics, settings=EXACT)
    mechanics.advance(moment(load=1.0))
    top = np.argmax(space.nodes.sum(axis=1))
    times, motion = [0.0], [mechanics.u[top, 2]]
    while times[-1] < seconds:
        dt = mechanics.pace()
        mechanics.advance(moment(load=0.0, dt=dt, still=False))
        times.append(times[-1] + dt)
        motion.append(mechanics.u[top, 2])
    return np.array(times), np.array(motion)


def _root(times, motion, first, creeping=()):
    """The complex frequency s of exp(s t), fitted from the time ``first`` on: later the higher modes have died out;
    what creeps back beside it fades with the times ``creeping``."""
    t, z = times[times > first], motion[times > first] / motion[0]

    def off(p):
        swing = np.exp(-p[0] * t)[:, None] * np.column_stack([np.cos(p[1] * t), np.sin(p[1] * t)])
        A = np.column_stack([swing, *(np.exp(-t / tau) for tau in creeping)])
        return A @ np.linalg.lstsq(A, z, rcond=None)[0] - z

    found = least_squares(off, [0.05 * OMEGA, OMEGA], x_scale=[1.0, 1.0], xtol=1e-12, ftol=1e-12).x
    return complex(-found[0], found[1])


def test_stiffness_proportional_damping_is_the_damped_oscillator():
    beta = 0.1 / OMEGA
    s = _root(*_let_go(Inertia(beta)), first=0.3)
    exact = OMEGA * complex(-0.05, np.sqrt(1.0 - 0.05**2))
    assert s.imag == pytest.approx(exact.imag, rel=2.5e-3)  # measured 1.8e-3
    assert s.real == pytest.approx(exact.real, rel=1e-2)  # measured 5e-3


def test_a_relaxing_body_rings_as_its_complex_modulus_says():
    """s^2 = -omega^2 E(s)/E, E(s) = 9 K mu(s) / (3 K + mu(s)), mu(s) = mu (1 + sum beta_i s tau_i / (1 + s tau_i))."""
    g, tau = np.array(PRONY.g), np.array(PRONY.tau)
    K, mu, weight = E / 3.0, E / 2.0, g / (1.0 - g.sum())

    def off(s):
        now = mu * (1.0 + np.sum(weight * s * tau / (1.0 + s * tau)))
        return s**2 + OMEGA**2 * 9.0 * K * now / (3.0 * K + now) / E

    creeping = [-1.0 / newton(off, start) for start in (-4.3, -41.6)]
    exact = newton(off, complex(-2.0, OMEGA))
    s = _root(*_let_go(Inertia(0.0), PRONY), first=0.3, creeping=creeping)
    assert s.imag == pytest.approx(abs(exact.imag), rel=3e-3)  # measured 1.5e-3, a third of it time steps'
    assert s.real == pytest.approx(exact.real, rel=1e-2)  # measured 1e-3


def test_a_hung_mass_is_no_less_than_nothing_anywhere():
    """Corners of a quadratic facet have no share in a force that is spread over it, and must have one in the mass."""
    space = block_space((SIDE, SIDE, L), (2, 2, 3))
    for lower in (0.0, 0.013):  # the whole face, and a strip whose edge crosses facets
        weight = DeadLoad("weight", lambda X, a=lower: (X[:, 2] > L - 1e-6) & (X[:, 0] > a), np.array([0, 0, -0.981]))
        (hung,) = hung_masses(space, replace(soft(), loads=(weight,), gravity=np.array([0.0, 0.0, -9.81])))
        assert hung.blocks.sum() == pytest.approx(0.1)
        assert np.linalg.eigvalsh(hung.blocks).min() > -1e-12


@pytest.mark.parametrize("exponent", [0.2, 0.3, 0.5])
def test_the_terms_of_a_power_law_relax_as_it_does(exponent):
    values = viscoelasticity.POWER_LAW.expand({"strength": np.array(0.3), "exponent": np.array(exponent)})
    g, tau = values["g"], values["tau"]
    t = np.geomspace(0.01, 10.0, 40)
    over = (g[:, None] / (1.0 - g.sum()) * np.exp(-t / tau[:, None])).sum(axis=0)
    law = 0.3 * (t / viscoelasticity.T0) ** -exponent
    rate = np.gradient(over, np.log(t)) / np.gradient(law, np.log(t))
    assert g.sum() < 1.0
    assert np.abs(rate - 1.0).max() < 0.25  # one term per decade ripples; measured 0.05, 0.06 and 0.18
