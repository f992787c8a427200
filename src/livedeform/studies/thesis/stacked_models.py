"""The explanations of the four shortenings of table 3.1: what each predicts of a modulus and one more number."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline, RectBivariateSpline

from livedeform.common.errors import ConvergenceError
from livedeform.common.types import Array
from livedeform.fem_node.items.two_bodies import make_interface
from livedeform.fem_node.physics.record import Interface, MaterialSpec, ModulusField
from livedeform.studies.bodies import (
    Base,
    Deformed,
    cuboid,
    quarter_block,
    quarter_holds,
    quarter_stack,
    settle,
)
from livedeform.studies.study import Progress
from livedeform.studies.thesis.column import DENSITY, GRAVITY, HeavyColumn
from livedeform.studies.thesis.cuboid import half_volume_height

SHORT, TALL, WIDTH = 0.035, 0.070, 0.05  # m
SCALE_ERROR, SCALE_SIGMA = 0.036, 0.005  # the camera measures lengths short by this (3.5 to 4 %)
MODULI = (820.0, 900.0, 1000.0, 1150.0, 1400.0, 2000.0, 4000.0)  # Pa; softer, the rim of a bonded base folds over
CELLS = 3  # per half side; finer, the rim of the softest bonded body folds below the table
SLIPPERY = 0.02  # friction of the almost frictionless interface; with none, the rims fold below 1100 Pa
THESIS_MODULUS = 979.0  # Pa
MM = 1e3
Prediction = Callable[[float], Array]  # E (Pa) -> shortenings (4,) m, in the order of NAMES


@dataclass(frozen=True)
class Explanation:
    """``predict(E, extra)`` -> (4,) m; ``extra``: bounds of a further free parameter and its unit, None without."""

    name: str
    predict: Callable[[float, float], Array]
    extra: tuple[float, float, str] | None = None
    prior: tuple[float, float] | None = None  # mean and sigma of the further parameter


def explanations(progress: Progress) -> dict[str, Explanation]:
    """Return what table 3.1 can be explained with, by name."""

    def solve(height: float, base: Base) -> dict[float, Deformed]:
        out = {}
        for k, E in enumerate(sorted(MODULI, reverse=True)):
            progress(f"stacked: {height * MM:.0f} mm, {base} base", k / len(MODULI))
            out[E] = cuboid(height, E, base, n=CELLS)
        return out

    bonded = {h: solve(h, "bonded") for h in (SHORT, TALL)}
    sliding = {h: solve(h, "sliding") for h in (SHORT, TALL)}
    fem, free = faces(bonded), faces(sliding)
    cut, finite = half_volumes(bonded, fem), finite_column()
    loose = loose_stack(fem, progress)
    stiffer = contrast(fem, progress)
    rows = [
        Explanation("eq. 2.3", lambda E, _: column(E)),
        Explanation("column at finite strain", lambda E, _: finite(E)),
        Explanation("3-D, sliding base", lambda E, _: free(E)),
        Explanation("3-D, bonded base", lambda E, _: fem(E)),
        Explanation("3-D, slippery interface", lambda E, _: loose(E)),
        Explanation("3-D, halves cut by volume", lambda E, _: cut(E)),
        Explanation("3-D and the camera's scale", partial(scaled, fem), (0.0, 0.1, ""), (SCALE_ERROR, SCALE_SIGMA)),
        Explanation("3-D and unlike moduli (top / bottom)", stiffer, (0.3, 1.5, "")),
        Explanation("3-D and a shifted interface", partial(shifted, fem), (-0.01, 0.01, "m")),
    ]
    return {e.name: e for e in rows}


def column(E: float, *, finite: bool = False) -> Array:
    """Eq. 2.3 for the four shortenings; the lower cuboid of the stack carries the upper one."""
    weight = DENSITY * GRAVITY * SHORT
    columns = [
        HeavyColumn(SHORT, E),
        HeavyColumn(TALL, E),
        HeavyColumn(SHORT, E),
        HeavyColumn(SHORT, E, overload=weight),
    ]
    return np.array([c.shortening_finite() if finite else c.shortening_linear() for c in columns])


def finite_column() -> Prediction:
    """`column` at finite strain, as a spline: its roots are too slow to be found in every fit."""
    return _spline({float(E): column(E, finite=True) for E in np.geomspace(500.0, MODULI[-1], 16)})


def _spline(values: Mapping[float, Array]) -> Prediction:
    """A spline in log E through log shortenings."""
    E = np.array(sorted(values))
    through = CubicSpline(np.log(E), np.log(np.stack([values[e] for e in E])))
    return lambda e: np.exp(through(np.log(np.clip(e, E[0], E[-1]))))


def faces(solved: Mapping[float, Mapping[float, Deformed]]) -> Prediction:
    """Shortenings read at the middle of a face, the stack as one body of twice the height (a bonded interface)."""
    half = WIDTH / 2

    def read(E: float) -> Array:
        short, tall = solved[SHORT][E], solved[TALL][E]
        whole, lower = tall.sink((half, 0.0, TALL)), tall.sink((half, 0.0, SHORT))
        return np.array([short.sink((half, 0.0, SHORT)), whole, whole - lower, lower])

    return _spline({E: read(E) for E in MODULI})


def half_volumes(solved: Mapping[float, Mapping[float, Deformed]], fem: Prediction) -> Prediction:
    """Predict as `faces`, but with the stack cut by a plane into halves of equal volume (the thesis's proposal)."""

    def read(E: float) -> Array:
        short, whole, _, _ = fem(E)
        lower = SHORT - half_volume_height(solved[TALL][E])
        return np.array([short, whole, whole - lower, lower])

    return _spline({E: read(E) for E in MODULI})


def loose_stack(fem: Prediction, progress: Progress) -> Prediction:
    """An almost frictionless interface: two bodies in contact that slide under `SLIPPERY`."""
    half, values = WIDTH / 2, {}
    space = quarter_stack((WIDTH, WIDTH, SHORT), (CELLS, CELLS, 4))
    at_edge = np.flatnonzero(np.linalg.norm(space.nodes - (half, 0.0, SHORT), axis=1) < 1e-9)  # of the lower, the upper
    for k, E in enumerate(sorted({*MODULI, THESIS_MODULUS}, reverse=True)):
        progress("stacked: almost frictionless interface", k / len(MODULI))
        item = make_interface(space, Interface(_interface_plane, friction=SLIPPERY, reach=WIDTH / 10), E)
        try:
            d = settle(space, MaterialSpec("neo_hookean", E, 0.49), quarter_holds(space, "bonded"), further=[item])
        except ConvergenceError:
            break  # the rims fold: softer ones would too
        lower, upper = -d.u[at_edge, 2]
        short, tall, _, _ = fem(E)
        values[E] = np.array([short, tall, d.sink((half, 0.0, TALL)) - upper, lower])
    return _spline(values)


def _interface_plane(X: Array) -> NDArray[np.bool_]:
    return np.abs(X[:, 2] - SHORT) < 1e-9


def contrast(fem: Prediction, progress: Progress) -> Callable[[float, float], Array]:
    """The upper cuboid of the stack has ``ratio`` times the modulus of all the others."""
    ratios = np.array([0.3, 0.45, 0.7, 1.0, 1.5])
    moduli = np.array([1000.0, 1300.0, 1800.0, 2600.0])
    half = WIDTH / 2
    top, bottom = np.empty((len(moduli), len(ratios))), np.empty((len(moduli), len(ratios)))
    for i, E in enumerate(moduli):
        for j, ratio in enumerate(ratios):
            progress("stacked: unlike moduli", (i * len(ratios) + j) / (len(moduli) * len(ratios)))
            space = quarter_block((WIDTH, WIDTH, TALL), (3, 3, 8))
            field = _UpperFactor(float(ratio))
            d = settle(space, MaterialSpec("neo_hookean", E, 0.49), quarter_holds(space, "bonded"), fields=(field,))
            bottom[i, j] = d.sink((half, 0.0, SHORT))
            top[i, j] = d.sink((half, 0.0, TALL)) - bottom[i, j]
    grid = (np.log(moduli), np.log(ratios))
    surfaces = [RectBivariateSpline(*grid, np.log(z), kx=3, ky=3) for z in (top, bottom)]

    def predict(E: float, ratio: float) -> Array:
        short, tall, _, _ = fem(E)
        at = (np.log(np.clip(E, moduli[0], moduli[-1])), np.log(ratio))
        return np.array([short, tall, *(float(np.exp(z(*at)[0, 0])) for z in surfaces)])

    return predict


@dataclass(frozen=True)
class _UpperFactor(ModulusField):
    """``ratio`` in the upper cuboid."""

    ratio: float

    def __call__(self, X: Array, t: float) -> Array:
        return np.where(X[:, 2] > SHORT, self.ratio, 1.0)


def scaled(fem: Prediction, E: float, e: float) -> Array:
    """The camera measures a remaining height L as (1 - e) L, so that dL = L0 - (1 - e) L comes out too large by e L."""
    true = fem(E)
    heights = np.array([SHORT, TALL, SHORT, SHORT])
    return true + e * (heights - true)


def shifted(fem: Prediction, E: float, shift: float) -> Array:
    """The interface of the stack was read ``shift`` m too high: the bottom seems to shorten less, the top more."""
    short, tall, top, bottom = fem(E)
    return np.array([short, tall, top + shift, bottom - shift])
