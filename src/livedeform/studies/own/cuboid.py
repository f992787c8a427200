"""The user's own cuboid under its weight: which of the formula, the column and the body in 3-D explains its loss of
height, at the modulus that the user states?"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.stats import chi2 as chi2_law

from livedeform.common.errors import ConvergenceError, InputError
from livedeform.common.types import Array
from livedeform.fem_node.physics.record import MaterialSpec
from livedeform.report.page import Table
from livedeform.studies.bodies import Base, quarter_block, quarter_holds, settle
from livedeform.studies.own.numbers import Key, named_values, sigmas
from livedeform.studies.study import COLOURS, FAILS, HOLDS, OPEN, Progress, StudyPage, figure
from livedeform.studies.thesis.column import GRAVITY, HeavyColumn

KEYS = {
    "width": Key("width, mm", 1.0, 2000.0),
    "depth": Key("depth, mm; 0: as the width", 0.0, 2000.0, 0.0),
    "height": Key("unloaded height, mm", 1.0, 2000.0),
    "density": Key("density, kg/m3", 100.0, 5000.0, 1000.0),
    "E": Key("Young's modulus, Pa", 10.0, 1e9),
    "E_sigma": Key("one sigma of E, Pa", 0.0, 1e9, 0.0),
    "nu": Key("Poisson's ratio", 0.0, 0.4999, 0.49),
    "loss": Key("measured loss of height at the top's centre, mm", 0.0, 2000.0),
}
NAMES = ("eq. 2.3", "column, finite strain", "3-D, sliding base", "3-D, bonded base")
FACTORS = (0.5, 0.7, 0.85, 1.0, 1.2, 1.5, 2.2)  # of the stated modulus, at which every body is solved
CELLS, MOST = 4, 8  # per half of the shortest side, and at most
ALPHA = 0.05
MM = 1e3


@dataclass(frozen=True)
class OwnCuboid:
    """``size`` (width, depth, height) m, density kg/m3, modulus with one sigma Pa, the measured ``loss`` with one sigma
    m."""

    size: tuple[float, float, float]
    density: float
    youngs_modulus: float
    youngs_sigma: float
    poisson_ratio: float
    loss: float
    sigma: float


@dataclass(frozen=True)
class Explained:
    """An explanation: its loss (m) with the part of its sigma that the modulus makes, chi-square of the measured loss
    (one degree of freedom), and the moduli (Pa) that the measured loss and one sigma more and less ask for."""

    name: str
    loss: float
    sigma: float
    chi2: float
    wanted: tuple[float, float, float]

    @property
    def p(self) -> float:
        """Probability of so large a chi-square by chance."""
        return float(chi2_law.sf(self.chi2, 1))


def own_numbers(text: str, sigma: str) -> OwnCuboid:
    """The user's cuboid of ``--measured`` and ``--sigma`` (of the loss), in mm."""
    v = named_values(text, KEYS)
    if v["loss"] >= v["height"]:
        raise InputError(
            f"{v['loss']:g} mm is not below the height of {v['height']:g} mm",
            where="--measured loss",
            remedy="give the unloaded height minus the measured one, in mm",
        )
    (error,) = sigmas(sigma, ("the loss",))
    size = (v["width"] / MM, (v["depth"] or v["width"]) / MM, v["height"] / MM)
    return OwnCuboid(size, v["density"], v["E"], v["E_sigma"], v["nu"], v["loss"] / MM, error / MM)


def run_own(out: Path, own: OwnCuboid, progress: Progress) -> dict[str, Any]:
    """The study of the user's cuboid."""
    stated = f"{own.youngs_modulus:g} Pa" + (f" ± {own.youngs_sigma:g} Pa" if own.youngs_sigma else "")
    measured = f"{own.loss * MM:.2f} ± {own.sigma * MM:.2f} mm"
    size = " x ".join(f"{s * MM:g}" for s in own.size)
    page = StudyPage(
        "cuboid",
        "A cuboid under its own weight",
        f"A cuboid of {size} mm and {stated} has lost {measured} of its height. Which formula or model says so?",
        out,
        inputs={"your own": f"{size} mm, {own.density:g} kg/m3", "E": stated, "nu": own.poisson_ratio,
                "measured loss": measured, "g": f"{GRAVITY} m/s2", "element": "P2-P0 tetrahedra, a quarter"},
    )  # fmt: skip
    solved = curves(own, progress)
    explained = [judge(own, name, *solved[name]) for name in NAMES]
    _table(page, explained, measured)
    _figure(page, own, solved)
    _claims(page, explained, measured)
    page.limits += [
        "The loss is that of the top's centre, in 3-D too: a ruler at an edge reads another one.",
        "Eq. 2.3 and the column take no Poisson's ratio (the column is incompressible) and no base that holds.",
        "Soft and bonded, the rim bulges below the plane of the table, which this problem does not have.",
        "One number and one modulus: what is not refused is not proven. " + (
            "" if own.youngs_sigma else "The modulus counts as exact: give E_sigma if it is not."
        ),
    ]  # fmt: skip
    return page.finish()


def curves(own: OwnCuboid, progress: Progress) -> dict[str, tuple[Array, Array]]:
    """Return, by explanation, moduli (n,) Pa, ascending, and the losses (n,) m.

    Softer bodies without equilibrium are left out; the stated modulus must have one.
    """
    E = own.youngs_modulus * np.array(FACTORS)
    columns = [HeavyColumn(own.size[2], float(e), own.density) for e in E]
    out = {
        NAMES[0]: (E, np.array([c.shortening_linear() for c in columns])),
        NAMES[1]: (E, np.array([c.shortening_finite() for c in columns])),
    }
    bases: tuple[Base, Base] = ("sliding", "bonded")
    for name, base in zip(NAMES[2:], bases, strict=True):
        losses = np.full(len(E), np.nan)
        for k in reversed(range(len(E))):
            progress(f"cuboid: {base} base, E = {E[k]:.0f} Pa", 1 - (k + 1) / len(E))
            try:
                losses[k] = sink(own, float(E[k]), base)
            except ConvergenceError as error:
                if FACTORS[k] < 1.0:
                    break  # softer ones would fold too
                scale = own.density * GRAVITY * own.size[2]
                raise InputError(
                    f"a body of {E[k]:.0f} Pa finds no equilibrium with a {base} base",
                    where="--measured E",
                    remedy=f"check E (Pa), density and height: E is {E[k] / scale:.2g} times density * g * height",
                ) from error
        found = np.isfinite(losses)
        out[name] = (E[found], losses[found])
    return out


def sink(own: OwnCuboid, youngs_modulus: float, base: Base) -> float:
    """Loss of height (m) at the top's centre."""
    space = quarter_block(own.size, cells(own.size))
    material = MaterialSpec("neo_hookean", youngs_modulus, own.poisson_ratio)
    d = settle(space, material, quarter_holds(space, base), gravity=GRAVITY, density=own.density)
    return d.sink((0.0, 0.0, own.size[2]))


def cells(size: tuple[float, float, float]) -> list[int]:
    """Cells (3) of the quarter: as near to cubes as `MOST` allows."""
    sides = np.array([0.5 * size[0], 0.5 * size[1], size[2]])
    return [int(n) for n in np.clip(np.round(CELLS * sides / sides.min()), 2, MOST)]


def judge(own: OwnCuboid, name: str, moduli: Array, losses: Array) -> Explained:
    """The loss at the stated modulus against the measured one; both sigmas count."""
    through = PchipInterpolator(np.log(moduli), np.log(losses))
    log_E = np.log(own.youngs_modulus)
    loss = float(np.exp(through(log_E)))
    sigma = loss * abs(float(through(log_E, 1))) * own.youngs_sigma / own.youngs_modulus
    chi2 = (own.loss - loss) ** 2 / (own.sigma**2 + sigma**2)

    def wanted(target: float) -> float:
        """E (Pa) of a loss; NaN where it lies outside what was solved."""
        if not losses[-1] <= target <= losses[0]:
            return float("inf") if target <= 0.0 else float("nan")
        return float(np.exp(PchipInterpolator(np.log(losses[::-1]), np.log(moduli[::-1]))(np.log(target))))

    return Explained(name, loss, sigma, chi2, tuple(wanted(own.loss + k * own.sigma) for k in (0, 1, -1)))  # type: ignore[arg-type]


def _modulus(E: float) -> str:
    return "∞" if np.isinf(E) else "not in what was solved" if np.isnan(E) else f"{E:.0f}"


def _table(page: StudyPage, explained: list[Explained], measured: str) -> None:
    rows = []
    for x in explained:
        best, low, high = (_modulus(E) for E in x.wanted)
        interval = f"{low} to {high}" if np.isfinite(x.wanted[0]) else ""
        rows.append(
            (x.name, f"{x.loss * MM:.2f}", f"{x.sigma * MM:.2f}", f"{x.chi2:.1f}", f"{x.p:.2g}", best, interval)
        )
    page.section(
        "The measured loss and what explains it",
        f"Measured: {measured}. Loss in mm at the stated modulus; chi-square with one degree of freedom. The last two "
        "columns: the modulus at which the explanation gives the measured loss, within one sigma of the loss.",
        tables=[
            Table(
                ("", "loss (mm)", "± by E", "chi2", "p", "E wanted (Pa)", "within one sigma"),
                tuple(rows),
                numbers=(1, 2, 3, 4, 5, 6),
            )
        ],
    )
    page.numbers["explanations"] = [
        {"name": x.name, "loss_m": x.loss, "sigma_m": x.sigma, "chi2": x.chi2, "p": x.p,
         "youngs_modulus_wanted": x.wanted}
        for x in explained
    ]  # fmt: skip


def _figure(page: StudyPage, own: OwnCuboid, solved: dict[str, tuple[Array, Array]]) -> None:
    fig, ax = figure(6.4, 3.2)
    for (name, (E, losses)), colour, style in zip(solved.items(), COLOURS, (":", "--", "-", "-"), strict=False):
        ax.plot(E, losses * MM, style, color=colour, label=name)
    ax.errorbar(
        own.youngs_modulus, own.loss * MM, own.sigma * MM, own.youngs_sigma or None, fmt="ko", capsize=3, label="yours"
    )
    ax.set(xlabel="Young's modulus (Pa)", ylabel="loss of height (mm)", ylim=(0, None))
    ax.legend()
    page.section(
        "Loss against modulus", figures=[("cuboid_own", fig, "Four explanations, and what you measured (one sigma).")]
    )


def _claims(page: StudyPage, explained: list[Explained], measured: str) -> None:
    left = [x.name for x in explained if x.p >= ALPHA]
    for x in explained:
        kept = HOLDS if left == [x.name] else OPEN
        page.claim(
            f"{x.name} explains the loss",
            measured,
            f"{x.loss * MM:.2f} mm, chi2 {x.chi2:.1f} (p = {x.p:.2g})",
            kept if x.p >= ALPHA else FAILS,
        )
    page.numbers["not_refused"] = left
    page.section(
        "Verdict",
        f"Not refused at p < {ALPHA:g}: {', '.join(left)}."
        + ("" if len(left) == 1 else " This measurement does not tell them apart.")
        if left
        else f"All four are refused at p < {ALPHA:g}: one of modulus, density, size, loss is not as given.",
    )
