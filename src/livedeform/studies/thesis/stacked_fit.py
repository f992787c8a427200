"""The four measured shortenings, and the fit of an explanation to them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import chi2 as chi2_law

from livedeform.common.errors import InputError
from livedeform.common.types import Array
from livedeform.studies.thesis.stacked_models import MODULI, Explanation

NAMES = ("short", "tall", "top of the stack", "bottom of the stack")
MEASURED = np.array([0.0037, 0.0152, 0.0089, 0.0076])  # m, table 3.1
SIGMA_STATED = 0.0011  # m, of dL as table 3.1 states it
SIGMA_HONEST = float(np.hypot(0.0011, 0.0020))  # m: dL = L0 - L, and L0 is known to 2 mm only


@dataclass(frozen=True)
class FittedStack:
    """An explanation at its best: ``E`` Pa, the further parameter, predictions (4,) m, chi-square and its freedom."""

    explanation: Explanation
    E: float
    extra: float
    predicted: Array
    chi2: float
    dof: int

    @property
    def p(self) -> float:
        """Probability of so large a chi-square by chance; NaN without freedom."""
        return float(chi2_law.sf(self.chi2, self.dof)) if self.dof > 0 else float("nan")


@dataclass(frozen=True)
class MeasuredStack:
    """Shortenings ``values`` (4,) m in the order of `NAMES`, with one sigma m as ``stated`` and with the error of L0
    (``honest``)."""

    values: Array
    stated: float
    honest: float


THESIS = MeasuredStack(MEASURED, SIGMA_STATED, SIGMA_HONEST)


def own_numbers(text: str, sigma: str) -> MeasuredStack:
    """The user's: four shortenings, and one sigma or two (as stated, and with everything counted), in mm; without a
    sigma the thesis's."""
    try:
        parts = (text, sigma or "1.1,2.3")
        values, sigmas = (np.array([float(v) for v in part.split(",")]) * 1e-3 for part in parts)
    except ValueError as error:
        raise InputError(
            str(error), where="--measured, --sigma", remedy="as 3.7,15.2,8.9,7.6 and 1.1,2.3, in mm"
        ) from error
    if len(values) != 4 or len(sigmas) not in (1, 2) or not (np.isfinite(values).all() and (sigmas > 0.0).all()):
        raise InputError(
            f"{len(values)} shortenings with {len(sigmas)} sigmas",
            where="--measured, --sigma",
            remedy=f"four are needed ({', '.join(NAMES)}), as 3.7,15.2,8.9,7.6, and one sigma or two, in mm",
        )
    return MeasuredStack(values, float(sigmas[0]), float(sigmas[-1]))


def fit(explanation: Explanation, measured: Array, sigma: float) -> FittedStack:
    """Least squares over log E and the further parameter."""
    bounds = ([np.log(MODULI[0])], [np.log(MODULI[-1])])
    start = [np.log(1000.0)]
    scale = 1.0
    if explanation.extra is not None:
        low, high, _ = explanation.extra
        scale = high - low
        bounds[0].append(low / scale)
        bounds[1].append(high / scale)
        start.append(
            (explanation.prior[0] if explanation.prior else np.clip(0.0 if low < 0 else 0.9, low, high)) / scale
        )

    def residual(z: Array) -> Array:
        extra = z[1] * scale if len(z) > 1 else 0.0
        r = (measured - explanation.predict(float(np.exp(z[0])), extra)) / sigma
        return np.append(r, (extra - explanation.prior[0]) / explanation.prior[1]) if explanation.prior else r

    best = least_squares(residual, start, bounds=bounds, x_scale=[0.1] + [0.1] * (len(start) - 1))
    extra = float(best.x[1] * scale) if len(best.x) > 1 else 0.0
    E = float(np.exp(best.x[0]))
    free = len(start) - (explanation.prior is not None)  # a prior is a fifth number
    return FittedStack(explanation, E, extra, explanation.predict(E, extra), float(2 * best.cost), len(measured) - free)
