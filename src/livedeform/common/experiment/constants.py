"""The own constants of material models: what stiffness at small strain they have, and which cannot be.

Each follows the formula of its model in `docs/items.md`. The stiffness of a body is that of ``youngs_modulus`` and
``poisson_ratio``; constants are scaled to it, so that only their ratios count.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

OGDEN_1972 = "W = sum mu / alpha (l1^alpha + l2^alpha + l3^alpha - 3)"  # his own, with mu_p alpha_p / 2 for our mu_p


def shear_modulus_of(model: str, constants: Mapping[str, Any]) -> float | None:
    """Return the shear modulus at small strain that the constants of a ``model`` have by its formula, in their unit
    (Pa, or relative); None where they have none of their own."""
    if model == "yeoh" and "c1" in constants:
        return 2.0 * float(constants["c1"])
    if model == "mooney_rivlin" and {"c10", "c01"} <= constants.keys():
        return 2.0 * (float(constants["c10"]) + float(constants["c01"]))
    if model == "ogden" and "mu" in constants:
        return float(np.sum(constants["mu"]))
    return None


def ogden_1972(constants: Mapping[str, Any]) -> list[float]:
    """Return the constants mu of docs/items.md, where those that are given follow Ogden's own formula of 1972."""
    return [float(m) for m in 0.5 * np.atleast_1d(constants["mu"]) * np.atleast_1d(constants.get("alpha", 2.0))]


def nonsense_of(model: str, constants: Mapping[str, Any]) -> tuple[str, str]:
    """Return what is physically impossible about a model's own constants, and what to do; empty where nothing is."""
    remedy = "correct the constant: such a material has no stiffness"
    for key in ("c1", "b", "ratio"):
        if key in constants and not np.all(np.asarray(constants[key], float) >= 0.0):
            return f"'{key}' of the model {model} is {constants[key]}, and cannot be negative", remedy
    if model == "ogden" and (wrong := _nonsense_of_ogden(constants)) != ("", ""):
        return wrong
    modulus = shear_modulus_of(model, constants)
    if modulus is not None and not modulus > 0.0:
        said = {"yeoh": "c1", "mooney_rivlin": "c10 + c01", "ogden": "the sum of mu"}[model]
        return f"{said} of the model {model} is not positive", remedy
    return "", ""


def _nonsense_of_ogden(constants: Mapping[str, Any]) -> tuple[str, str]:
    """Return what cannot be about the terms of Ogden's model, where mu_p is the shear modulus of a term; a negative one
    is mostly from a table of his own formula, in which mu_p and alpha_p have the same sign."""
    mu, alpha = (np.atleast_1d(np.asarray(constants.get(key, 1.0), float)) for key in ("mu", "alpha"))
    if {"mu", "alpha"} <= constants.keys() and len(mu) != len(alpha):
        what = f"the model ogden has {len(mu)} constants mu and {len(alpha)} alpha: each term has one of both"
        return what, "give as many of one as of the other"
    if (alpha == 0.0).any():
        return "an alpha of the model ogden is 0, a term without any energy", "leave the term out"
    if (mu < 0.0).any():
        term = f"mu of the model ogden is {mu.min():g} in a term"
        what = f"{term}: by W = sum 2 mu / alpha^2 (l1^alpha + l2^alpha + l3^alpha - 3) it has a negative stiffness"
        own = ogden_1972(constants)
        if min(own) < 0.0:
            return what, "leave the term out, or fit the constants again with each mu > 0"
        return what, f"of Ogden's own formula, {OGDEN_1972}, give mu alpha / 2: [{', '.join(f'{m:g}' for m in own)}]"
    return "", ""
