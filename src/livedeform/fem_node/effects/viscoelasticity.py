"""The body relaxes and creeps.

In silicone damping, stiffening with the frequency and creep are one thing: a spectrum of times. The search fits one
term first, and then what the data ask for: more terms, or the spectrum of a power law (a spring beside a fractional
element), whose two numbers stand for as many terms as a recording spans decades,

    G(t) / G(inf) = 1 + strength (t / t0)^-exponent = 1 + sum_i b_i exp(-t / tau_i),   t0 = 0.03 s,
    b_i = strength h (tau_i / t0)^-exponent / Gamma(exponent),   tau_i apart by exp h,   g_i = b_i / (1 + sum b)

(Bagley & Torvik 1983; the sum over times is the integral of Bernstein's representation, Tschoegl 1989). Such a law is
never relaxed: it stiffens the slow as well, and damps what other damping had stood in for. So it is fitted together
with the modulus, from where the body swings as it did: with the same complex modulus at the swing's rate w,

    E(w) = ratio (1 + i w rayleigh_beta + sum_i b_i i w tau_i / (1 + i w tau_i)),   b_i = g_i / (1 - sum g).

What is never relaxed never forgets either. A body that hung, was lifted and ``held`` as it was scanned for some seconds
before the recording has recovered what recovers in these only: let go it returns at once to the rest of what it had
crept, and creeps less. By superposition (Boltzmann), the overstress left when the recording begins is

    Q_i = b_i (S_held - S_hung) exp(-held / tau_i),

S the stress that relaxes (`fem_node.items.viscoelastic`). Nobody notes for how long a body is held, so it is a number
of the law of one that was let go, told by its creep: one number for all recordings that are fitted together.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.special import gamma

from livedeform.common.effect import EffectInfo, Form, Parameter, Start, Surroundings
from livedeform.common.types import Array
from livedeform.fem_node.physics.record import Physics, Prony

SHORTEST, N_TIMES = 0.1, 7  # s, and how many times from it to beyond the recording are tried
SPECTRUM = np.geomspace(1e-3, 1e2, 9)  # s, of a power law: shorter ones act at once, longer ones never
T0 = 0.03  # s, the time of a radian of a swing of 5 Hz: strength and exponent are told apart where bodies swing
USUAL, LEFT = 0.3, 0.1  # exponent where a power law begins, and share of the other damping that is left beside it
WEAKEST, STRONGEST = 0.03, 3.0  # where it begins
SHARE, HELD = (0.05, 0.5), 10.0  # of a body that was held: the share of its weight that acted, for how long (s)
LOADS = ("late_load", "load_friction")  # what a release shows of what hangs


def _starts(around: Surroundings) -> list[Start]:
    """Return relaxation times from a tenth of a second to beyond the recording."""
    longest = max(around.duration, 2.0)
    return [{"tau": float(t)} for t in np.geomspace(SHORTEST, 1.5 * longest, N_TIMES)]


def _power_law(numbers: Mapping[str, Array]) -> dict[str, Array]:
    """Return the terms of a power law, see the module's text."""
    b = float(numbers["strength"]) * _weights(float(numbers["exponent"]))
    held = {"held": np.asarray(numbers["held"], float)} if "held" in numbers else {}
    return {"g": b / (1.0 + b.sum()), "tau": SPECTRUM.copy(), **held}


def _weights(exponent: float) -> Array:
    """Return the b (9,) of a power law of strength one."""
    return np.asarray(np.log(SPECTRUM[1] / SPECTRUM[0]) * (SPECTRUM / T0) ** -exponent / gamma(exponent))


def _swinging(b: Array, tau: Array, rate: float) -> complex:
    """Return what terms add to the modulus at a ``rate`` in rad/s, relative to the relaxed one."""
    turns = 1j * rate * tau
    return complex(np.sum(b * turns / (1.0 + turns)))


def _alike(now: Mapping[str, Mapping[str, Array]], rate: float) -> dict[str, Mapping[str, Array]]:
    """Return a power law with the complex modulus that the effects ``now`` have at a ``rate`` in rad/s, the modulus
    that it asks for, and little of the other damping."""
    own, damping = now["viscoelasticity"], float(now["inertia"]["rayleigh_beta"]) if "inertia" in now else 0.0
    ratio = float(now["stiffness"]["ratio"]) if "stiffness" in now else 1.0
    g, tau = np.atleast_1d(own["g"]), np.atleast_1d(own["tau"])
    modulus = ratio * (1.0 + 1j * rate * damping + _swinging(g / (1.0 - g.sum()), tau, rate))
    of_one, loss = _swinging(_weights(USUAL), SPECTRUM, rate), modulus.imag / modulus.real
    strength = (loss - rate * LEFT * damping) / max(of_one.imag - loss * of_one.real, 1e-9)
    strength = float(np.clip(strength, WEAKEST, STRONGEST))
    found = {
        "viscoelasticity": {"strength": np.array(strength), "exponent": np.array(USUAL)},
        "stiffness": {"ratio": np.array(modulus.real / (1.0 + strength * of_one.real))},
    }
    return found | ({"inertia": {"rayleigh_beta": np.array(LEFT * damping)}} if damping > 0.0 else {})


def _released(now: Mapping[str, Mapping[str, Array]], rate: float) -> dict[str, Mapping[str, Array]]:
    """Return `_alike` with how the body was held until it was let go: for a while, in which a share of its weight
    acted, so that after a second it rests where it does with the effects ``now``; its loads pull a little later, and
    rub."""
    found = _alike(now, rate)
    ratio = float(now["stiffness"]["ratio"]) if "stiffness" in now else 1.0
    borne = float(now["scan_gravity"]["fraction"]) if "scan_gravity" in now else 0.0
    after_a_second = 1.0 + float(found["viscoelasticity"]["strength"]) * (1.0 / T0) ** -USUAL
    softer = float(found["stiffness"]["ratio"]) * after_a_second / ratio
    share = float(np.clip(1.0 - softer * (1.0 - borne), *SHARE))
    law = {**found["viscoelasticity"], "held": now["viscoelasticity"].get("held", np.array(HELD))}
    loads = {name: now.get(name, {}) for name in LOADS}
    return found | {"viscoelasticity": law, "scan_gravity": {"fraction": np.array(share)}} | loads


def _terms(numbers: Mapping[str, Array]) -> dict[str, Array]:
    """Return the terms as they are."""
    return {name: np.asarray(values) for name, values in numbers.items()}


def _form(n: int) -> Form:
    """Return ``n`` terms, whose times begin spread over decades."""
    tau = tuple(float(t) for t in np.geomspace(0.05, 2.0, n))
    return Form(
        f"{n} terms",
        (
            Parameter("g", "1", (0.1,) * n, 0.0, 0.95 / n, sigma=0.3, neutral=0.0, size=n, step=0.05),
            Parameter("tau", "s", tau, 0.005, 1000.0, sigma=1.0, size=n, scale="log"),
        ),
        _terms,
    )


LAW = (
    Parameter("strength", "1", start=0.3, lower=0.0, upper=9.0, sigma=0.9, neutral=0.0, step=0.06),
    Parameter("exponent", "1", start=USUAL, lower=0.02, upper=0.95, sigma=0.2, step=0.02),
)
HOLD = Parameter("held", "s", start=HELD, lower=0.3, upper=1e4, sigma=2.0, scale="log")
POWER_LAW = Form("power law", LAW, _power_law, alike=_alike)
HELD_LAW = Form(
    "power law of a held body",
    (replace(LAW[0], lower=1e-3), LAW[1], HOLD),
    _power_law,
    released=_released,
    spare=LOADS,
)

INFO = EffectInfo(
    name="viscoelasticity",
    acts_on="body",
    summary="the body relaxes under a held press and creeps under a held load",
    equation="G(t) = G_0 (1 - sum g_i (1 - exp(-t/tau_i))), isochoric; the declared modulus is the relaxed one, "
    "G_0 (1 - sum g_i)",
    source="Simo 1987; Holzapfel 2000, section 6.10",
    parameters=(
        Parameter("g", "1", start=0.2, lower=0.0, upper=0.95, sigma=0.3, neutral=0.0, size=-1, step=0.05),
        Parameter("tau", "s", start=2.0, lower=0.02, upper=1000.0, sigma=1.0, size=-1, scale="log"),
    ),
    shown_by="press, hold, fast retreat, wait; a release",
    confused_with=("softening", "plastic_set", "time_offset"),
    starts=_starts,
    forms=(POWER_LAW, HELD_LAW, _form(2), _form(3)),
    optional=(HOLD,),
)


def apply(physics: Physics, values: Mapping[str, Array]) -> Physics:
    """Return the physics with a Prony series; terms with g = 0 are left out. ``held`` acts in recordings with a release
    and without a probe."""
    g, tau = np.atleast_1d(values["g"]), np.atleast_1d(values["tau"])
    keep = [i for i in np.argsort(tau) if g[i] != 0.0]
    if not keep:
        return replace(physics, prony=None)
    prony = Prony(tuple(float(g[i]) for i in keep), tuple(float(tau[i]) for i in keep))
    return replace(physics, prony=prony, held_for=float(values.get("held", np.inf)))
