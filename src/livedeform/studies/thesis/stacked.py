"""Two gelatin cuboids on top of each other (thesis 2.7.2, table 3.1): which explanation do four numbers support?

Every explanation predicts the four shortenings of table 3.1 as functions of the modulus E (and at most one more
parameter). The bodies' own scale is E / (rho g), so each needs only a few solved moduli and a spline between them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline, RectBivariateSpline
from scipy.optimize import least_squares
from scipy.stats import chi2 as chi2_law

from livedeform.common.errors import ConvergenceError, InputError
from livedeform.common.types import Array
from livedeform.fem_node.items.two_bodies import make_interface
from livedeform.fem_node.physics.record import Interface, MaterialSpec, ModulusField
from livedeform.report.page import Table
from livedeform.studies.bodies import (
    Base,
    Deformed,
    cuboid,
    quarter_block,
    quarter_holds,
    quarter_stack,
    settle,
)
from livedeform.studies.study import COLOURS, FAILS, HOLDS, OPEN, PARTLY, Progress, StudyPage, figure
from livedeform.studies.thesis.column import DENSITY, GRAVITY, Column
from livedeform.studies.thesis.cuboid import half_volume_height

SHORT, TALL, WIDTH = 0.035, 0.070, 0.05  # m
NAMES = ("short", "tall", "top of the stack", "bottom of the stack")
MEASURED = np.array([0.0037, 0.0152, 0.0089, 0.0076])  # m, table 3.1
SIGMA_STATED = 0.0011  # m, of dL as table 3.1 states it
SIGMA_HONEST = float(np.hypot(0.0011, 0.0020))  # m: dL = L0 - L, and L0 is known to 2 mm only
SCALE_ERROR, SCALE_SIGMA = 0.036, 0.005  # the camera measures lengths short by this (3.5 to 4 %)
MODULI = (820.0, 900.0, 1000.0, 1150.0, 1400.0, 2000.0, 4000.0)  # Pa; softer, the rim of a bonded base folds over
CELLS = 3  # per half side; finer, the rim of the softest bonded body folds below the table
THESIS_MODULUS = 979.0  # Pa
SLIPPERY = 0.02  # friction of the almost frictionless interface; with none, the rims fold below 1100 Pa
SEED, N_DRAWS = 31, 300
ALPHA = 0.05
MM = 1e3

Prediction = Callable[[float], Array]  # E (Pa) -> shortenings (4,) m, in the order of NAMES


@dataclass(frozen=True)
class Explanation:
    """``predict(E, extra)`` -> (4,) m; ``extra``: bounds of a further free parameter and its unit, None without."""

    name: str
    predict: Callable[[float, float], Array]
    extra: tuple[float, float, str] | None = None
    prior: tuple[float, float] | None = None  # mean and sigma of the further parameter


@dataclass(frozen=True)
class Fitted:
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
class Measured:
    """Shortenings ``values`` (4,) m in the order of `NAMES`, with one sigma m as ``stated`` and with the error of L0
    (``honest``)."""

    values: Array
    stated: float
    honest: float


THESIS = Measured(MEASURED, SIGMA_STATED, SIGMA_HONEST)


def own_numbers(text: str, sigma: str) -> Measured:
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
    return Measured(values, float(sigmas[0]), float(sigmas[-1]))


def run(out: Path, data: Path | None, progress: Progress, own: Measured | None = None) -> dict[str, Any]:
    """The study of table 3.1, or of the user's ``own`` numbers of such cuboids (without the thesis's claims)."""
    del data
    m = own or THESIS
    page = StudyPage(
        "stacked",
        "Two cuboids on top of each other",
        "Stacked, top and bottom shorten alike (0.89 and 0.76 cm), which eq. 2.3 does not predict. What does?",
        out,
        inputs={"your own (mm)" if own else "table 3.1 (mm)": dict(zip(NAMES, m.values * MM, strict=True)),
                "sigma (mm)": f"{m.stated * MM:g} as stated, {m.honest * MM:.2f} with the error of L0",
                "cuboids": "50 x 50 mm, 35 and 70 mm tall", "nu": 0.49},
        seed=SEED,
    )  # fmt: skip
    every = explanations(progress)
    stated, honest = ([fit(e, m.values, s) for e in every.values()] for s in (m.stated, m.honest))
    _table(page, stated, honest, m)
    _figure(page, stated, m)
    _interface(page, every)
    _loop(page, every, m, progress)
    if own is None:
        _claims(page, {f.explanation.name: (f, h) for f, h in zip(stated, honest, strict=True)})
        page.limits.append(
            "The shift of the interface was thought of after the numbers were seen: no p-value counts that."
        )
    page.limits += [
        "Four numbers and at least one free parameter: no explanation is proven by fitting them, several are refuted.",
        f"The slippery interface (friction {SLIPPERY:g}) is two bodies in contact; without any friction the rims fold "
        "below 1100 Pa. From a friction of 0.1 on the interface sticks and is as good as bonded.",
    ]
    return page.finish()


def explanations(progress: Progress) -> dict[str, Explanation]:
    """What table 3.1 can be explained with, by name."""

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
    columns = [Column(SHORT, E), Column(TALL, E), Column(SHORT, E), Column(SHORT, E, overload=weight)]
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
    """As `faces`, but the stack is cut into two halves of the same volume by a plane (the thesis's proposal)."""

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


def fit(explanation: Explanation, measured: Array, sigma: float) -> Fitted:
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
    return Fitted(explanation, E, extra, explanation.predict(E, extra), float(2 * best.cost), len(measured) - free)


def _extra(f: Fitted) -> str:
    if f.explanation.extra is None:
        return ""
    return f"{f.extra * MM:+.1f} mm" if f.explanation.extra[2] == "m" else f"{f.extra:.3g}"


def _table(page: StudyPage, stated: Sequence[Fitted], honest: Sequence[Fitted], m: Measured) -> None:
    rows = [("measured", *(f"{v * 100:.2f}" for v in m.values), "", "", "", "", "")]
    for f, h in zip(stated, honest, strict=True):
        cm = (f"{v * 100:.2f}" for v in f.predicted)
        rows.append(
            (f.explanation.name, *cm, f"{f.E:.0f}", _extra(f), f"{f.chi2:.1f} / {f.dof}", f"{h.chi2:.1f}", f"{h.p:.2g}")
        )
    header = (
        "",
        *(f"{n} (cm)" for n in NAMES),
        "E (Pa)",
        "further",
        f"chi2 / dof, ±{m.stated * 100:.2f} cm",
        f"chi2, ±{m.honest * 100:.2f} cm",
        "p",
    )
    page.section(
        "Explanations of the four numbers",
        "Shortening at the middle of a face; E is fitted to all four numbers by each explanation. The last two "
        "columns count "
        "the error of L0 (±0.2 cm in table 3.1, which leaves it out of dL).",
        tables=[Table(header, tuple(rows), numbers=(1, 2, 3, 4, 5, 6, 7, 8, 9))],
    )
    page.numbers["explanations"] = [
        {"name": f.explanation.name, "youngs_modulus": f.E, "further": f.extra, "predicted_m": f.predicted,
         "chi2_stated": f.chi2, "chi2_honest": h.chi2, "dof": f.dof, "p_stated": f.p, "p_honest": h.p}
        for f, h in zip(stated, honest, strict=True)
    ]  # fmt: skip


def _figure(page: StudyPage, stated: Sequence[Fitted], m: Measured) -> None:
    shown = ["eq. 2.3", "3-D, bonded base", "3-D and the camera's scale", "3-D and a shifted interface"]
    fig, ax = figure(6.4, 3.2)
    x = np.arange(4.0)
    ax.errorbar(
        x, m.values * MM, m.honest * MM, fmt="none", ecolor="#b6bdc4", elinewidth=5, label="± with the error of L0"
    )
    ax.errorbar(x, m.values * MM, m.stated * MM, fmt="ko", capsize=3, label="measured, ± as stated")
    chosen = [f for f in stated if f.explanation.name in shown]
    for k, (f, marker) in enumerate(zip(chosen, "sD^v", strict=True)):
        ax.plot(x + 0.09 * (k - 1.5) + 0.02, f.predicted * MM, marker, color=COLOURS[k], label=f"{f.explanation.name}")
    ax.set_xticks(x, NAMES)
    highest = max(f.predicted.max() for f in chosen) if chosen else 0.0
    ax.set(ylabel="shortening (mm)", ylim=(0, 1.08 * MM * max(m.values.max() + m.honest, highest)))
    ax.legend(loc="upper right", fontsize=7.5)
    page.section(
        "Measured and explained",
        figures=[("stacked_table", fig, "Measured, and four explanations, each with its best E.")],
    )


def _interface(page: StudyPage, every: Mapping[str, Explanation]) -> None:
    """Bonded against slippery at one modulus: the two bounds of what friction between the cuboids can do."""
    E = THESIS_MODULUS
    bonded, loose = every["3-D, bonded base"].predict(E, 0.0), every["3-D, slippery interface"].predict(E, 0.0)
    page.numbers["interface"] = {"youngs_modulus": E, "bonded_m": bonded, "slippery_m": loose}
    rows = tuple(
        (name, *(f"{v * 100:.3f}" for v in p[2:]))
        for name, p in (("bonded", bonded), (f"friction {SLIPPERY:g}", loose))
    )
    page.section(
        "Friction between the cuboids",
        f"At E = {E:g} Pa, two bodies in contact. Whatever the friction, it changes the two numbers by at most "
        f"{np.abs(bonded - loose)[2:].max() * MM:.2f} mm: it cannot make top and bottom alike.",
        tables=[Table(("interface", "top (cm)", "bottom (cm)"), rows, numbers=(1, 2))],
    )


def loop_candidates(every: Mapping[str, Explanation]) -> dict[str, dict[str, Explanation]]:
    """Model -> what the loop may add to it, one thing at a time: name of the addition -> the model with it."""
    fem = every["3-D, bonded base"]
    scale, shift = every["3-D and the camera's scale"], every["3-D and a shifted interface"]

    def column_(E: float) -> Array:
        return column(E)

    def unlike(E: float, ratio: float) -> Array:
        return column(E) / np.array([1.0, 1.0, ratio, 1.0])

    def with_shift(name: str, base: Prediction) -> Explanation:
        return Explanation(name, partial(shifted, base), shift.extra)

    on_column = {
        "finite strain": every["column at finite strain"],
        "3-D body, bonded base": fem,
        "camera's scale": Explanation("eq. 2.3 + scale", partial(scaled, column_), scale.extra, scale.prior),
        "unlike moduli": Explanation("eq. 2.3 + unlike moduli", unlike, (0.15, 1.5, "")),
        "shifted interface": with_shift("eq. 2.3 + shift", column_),
    }
    on_shift = {
        "finite strain": with_shift("finite strain + shift", finite_column()),
        "3-D body, bonded base": shift,
    }
    on_fem = {
        "camera's scale": scale,
        "unlike moduli": every["3-D and unlike moduli (top / bottom)"],
        "shifted interface": shift,
    }
    return {"eq. 2.3": on_column, "eq. 2.3 + shift": on_shift, fem.name: on_fem}


def _loop(page: StudyPage, every: Mapping[str, Explanation], m: Measured, progress: Progress) -> None:
    """The closed loop's rule on four numbers: the largest gain over all candidates against what noise alone gives."""
    additions = loop_candidates(every)
    rows: list[tuple[str, ...]] = []
    chains: dict[str, list[dict[str, Any]]] = {}
    rng = np.random.default_rng(SEED)
    for label, sigma in (("stated", m.stated), ("honest", m.honest)):
        model = every["eq. 2.3"]
        chain: list[dict[str, Any]] = []
        while model.name in additions:
            progress(f"stacked: the loop, {label} errors, from {model.name}", None)
            best, gain, p = best_addition(model, additions[model.name], m.values, sigma, rng)
            chain.append({"model": model.name, "candidate": best, "gain": gain, "p": p, "added": p < ALPHA})
            rows.append((label, model.name, best, f"{gain:.1f}", f"{p:.3f}", "added" if p < ALPHA else "refused"))
            if p >= ALPHA:
                break
            model = additions[model.name][best]
        chains[label] = chain
    page.numbers["loop"] = chains
    added = {k: ", ".join(c["candidate"] for c in v if c["added"]) or "nothing" for k, v in chains.items()}
    page.claim(
        "Something is missing in eq. 2.3 for the stack",
        "“did not consider the interaction between the cuboids”" if m is THESIS else "",
        f"the loop adds {added['stated']} with the errors as stated, {added['honest']} with the error of L0 counted",
        PARTLY if added["honest"] != "nothing" else OPEN,
        "Finite strain and the bonded base are physics, but four numbers of this accuracy do not ask for them.",
    )
    page.section(
        "The loop on four numbers",
        "Forward addition from eq. 2.3: the candidate with the largest drop of chi-square, and how often noise alone "
        "lets any "
        f"candidate gain as much ({N_DRAWS} draws). Below {ALPHA:g} it is added.",
        tables=[Table(("errors", "model", "best candidate", "gain", "p", ""), tuple(rows), numbers=(3, 4))],
    )


def best_addition(
    model: Explanation, additions: Mapping[str, Explanation], measured: Array, sigma: float, rng: np.random.Generator
) -> tuple[str, float, float]:
    """The addition with the largest gain in chi-square, the gain, and its p-value over all additions together."""

    def gains(numbers: Array, null: float) -> dict[str, float]:
        return {name: null - fit(e, numbers, sigma).chi2 for name, e in additions.items()}

    before = fit(model, measured, sigma)
    found = gains(measured, before.chi2)
    best = max(found, key=lambda name: found[name])
    as_large = 0
    for _ in range(N_DRAWS):
        noisy = before.predicted + sigma * rng.standard_normal(4)
        as_large += max(gains(noisy, fit(model, noisy, sigma).chi2).values()) >= found[best]
    return best, found[best], (1 + as_large) / (1 + N_DRAWS)


def _claims(page: StudyPage, by_name: Mapping[str, tuple[Fitted, Fitted]]) -> None:
    column_, fem = by_name["eq. 2.3"], by_name["3-D, bonded base"]
    shift, loose = by_name["3-D and a shifted interface"], by_name["3-D, slippery interface"][0].explanation
    change = (loose.predict(THESIS_MODULUS, 0.0) - fem[0].explanation.predict(THESIS_MODULUS, 0.0))[2] * MM
    page.claim(
        "The bottom cuboid deforms twice as much as the top one (eq. 2.3)",
        "2 : 1",
        f"3 : 1 by eq. 2.3; {fem[0].predicted[3] / fem[0].predicted[2]:.1f} : 1 in 3-D",
        FAILS,
        "The bottom carries the top's weight over its whole height: 1/2 + 1 against 1/2.",
    )
    page.claim(
        "The stack cannot be explained by eq. 2.3",
        "top and bottom deform alike",
        f"chi2 {column_[0].chi2:.0f} with 3 degrees of freedom as stated, {column_[1].chi2:.1f} (p = "
        f"{column_[1].p:.2g}) with the error of L0",
        HOLDS if column_[1].p < 0.05 else OPEN,
        "",
    )
    page.claim(
        "The cuboids' interaction explains it",
        "proposed",
        f"almost without friction {change:+.1f} mm at the top; bonded 3-D leaves chi2 {fem[1].chi2:.1f} (p = "
        f"{fem[1].p:.2g})",
        OPEN,
        f"What is left is as large as {abs(shift[0].extra) * MM:.0f} mm at the interface, or the error of L0.",
    )
    page.numbers["interface_shift_m"] = shift[0].extra
