"""Cylinders between platens (Dawood et al. 2026, or one's own): free or bonded, neo-Hookean or stiffening?

Four models of one cylinder, each with a modulus (and b) and an offset of the first touch. Free platens have a formula:

    P = mu exp(b (I1 - 3)) (1/lambda^2 - lambda),  I1 = lambda^2 + 2/lambda,  mu = E/3                (incompressible)

bonded ones are solved once per b and shape with nu = 0.499; the nominal stress P is proportional to E and depends on
the radius over the height, not on the size.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
from scipy.interpolate import RectBivariateSpline
from scipy.optimize import least_squares

from livedeform.common.errors import ConvergenceError
from livedeform.common.types import Array
from livedeform.compare_node.takes import expected
from livedeform.fem_node.element.element import make_space
from livedeform.fem_node.items.continuum import Continuum
from livedeform.fem_node.items.protocol import Item, Moment
from livedeform.fem_node.items.supports import Held
from livedeform.fem_node.mesh.structured import cylinder_mesh
from livedeform.fem_node.physics.record import MaterialSpec, Physics
from livedeform.fem_node.solve.solver import Solver, SolverSettings
from livedeform.report.page import Table
from livedeform.studies.bodies import Moved, on
from livedeform.studies.public.compression_tests import (
    FIRST_STRAIN,
    LAST_STRAIN,
    Size,
    Specimen,
    latest_touch,
    read_materials,
)
from livedeform.studies.study import COLOURS, HOLDS, PARTLY, Progress, StudyPage, figure, need_data

HOME = "GitHub abubakardawood/tissue-phantom-material-database (CC BY 4.0)"
STRAINS = np.linspace(0.0, 0.40, 11)  # nominal; up to here the bonded mesh is too stiff by 3 % at most, and by 5 % in
FURTHER = np.linspace(0.44, 0.52, 3)  # the end of a test whose platen had touched before the compression's zero
STIFFENING = (0.0, 0.1, 0.25, 0.5)
CELLS = 4
AT, ONE = np.array([0.04, 0.20, 0.38]), np.array([1.0, 0.0])  # strains of the comparison; E = 1 Pa, b = 0
TITLE = 22  # letters of a line above a panel
PUBLISHED_SHAPE = 5.0 / 6.0  # radius over height

Curve = Callable[[Array, Array], Array]  # strains (n,), (E, b) -> nominal stress (n,) Pa
Models = Mapping[str, tuple[Curve, bool]]


@dataclass(frozen=True)
class BondedCurve:
    """The curve of the bonded cylinder, as it was solved over b and nominal strains up to ``reach``."""

    surface: RectBivariateSpline
    reach: float

    def __call__(self, strain: Array, p: Array) -> Array:
        at = np.clip(strain, 0.0, self.reach)
        stress: Array = p[0] * self.surface(np.full(np.shape(at), p[1]), at, grid=False)
        return stress


@dataclass(frozen=True)
class FittedLaw:
    """A model fitted to one test: E Pa, b, offset of the touch (m), rms misfit over the mean force."""

    E: float
    b: float
    offset: float
    misfit: float


@dataclass(frozen=True)
class TestedMaterial:
    """The tests of one material, their fits by model, and the misfits of tests that were not fitted."""

    tests: Sequence[Specimen]
    fits: Mapping[str, Sequence[FittedLaw]]
    unseen: Mapping[str, float]
    models: Models


def run(
    out: Path, data: Path | None, progress: Progress, *, folder: Path | None = None, size: Size | None = None
) -> dict[str, Any]:
    """The study, of the public tests, or of those in one's own ``folder``: each folder in it is a material, or it is
    one itself. ``size`` is that of the cylinders, where their files do not say it (or say it wrong)."""
    home = need_data(data, "compression", HOME) if folder is None else folder
    tests, dropped = read_materials(home, size)
    sizes = sorted({(t.radius, t.height) for each in tests.values() for t in each})
    page = StudyPage(
        "compression",
        "Ecoflex between platens" if folder is None else "Cylinders between platens",
        "Do free or bonded platens, a neo-Hookean or a stiffening material explain "
        + ("published compression tests?" if folder is None else "these compression tests?"),
        out,
        inputs={"data": HOME if folder is None else str(folder),
                "cylinder": "; ".join(f"diameter {2e3 * r:g} mm, height {1e3 * h:g} mm" for r, h in sizes),
                "tests": {k: len(v) for k, v in tests.items()},
                "strain": f"{FIRST_STRAIN:g} to {STRAINS[-1]:g}"},
    )  # fmt: skip
    models = {shape: curves(shape, progress) for shape in sorted({t.shape for each in tests.values() for t in each})}
    materials = {name: fitted(each, models[each[0].shape]) for name, each in tests.items()}
    _tables(page, materials)
    _figure(page, materials)
    _claims(page, materials, models)
    notes = [note for each in tests.values() for t in each for note in t.notes]
    page.limits += [*(f"left out: {line}" for line in dropped), *notes, *_unreached(materials)]
    page.numbers |= {"left_out": dropped, "taken": notes}
    page.limits += [
        "The friction on the platens is not stated; free and bonded are its two bounds.",
        "Loading only, at one speed: nothing here tells relaxation from stiffening.",
        "Compression is used up to 40 % of the height.",
        "Repeats of one specimen say nothing of how much the next specimen differs: its interval needs two or more.",
    ]
    return page.finish()


def _unreached(materials: Mapping[str, TestedMaterial]) -> list[str]:
    """Say of which cylinders the bonded platens are not solved as far as the earliest touch would need."""
    out: dict[str, None] = {}
    for m in materials.values():
        reach = min(reach_of(curve) for curve, _ in m.models.values())
        for t in m.tests:
            most = (reach - LAST_STRAIN) * t.height
            if most < latest_touch(t.height):
                size = f"{2e3 * t.radius:g} mm across and {1e3 * t.height:g} mm high"
                far = f"{1e3 * most:.2f} mm before the compression's zero"
                out[f"Of cylinders {size} an early touch is looked for up to {far}."] = None
    return list(out)


def fitted(tests: Sequence[Specimen], models: Models) -> TestedMaterial:
    """Fit every model to every test of a material, and predict each test by the others."""
    fits = {k: [fit(curve, t, b) for t in tests] for k, (curve, b) in models.items()}
    return TestedMaterial(tests, fits, leave_one_out(tests, fits, models), models)


def curves(shape: float, progress: Progress) -> Models:
    """The four models of a cylinder of radius over height ``shape`` by name, and whether each has a free b."""
    bonded, moduli_b, strains = bonded_stresses(shape, progress)
    surface = RectBivariateSpline(moduli_b, strains, bonded, kx=min(3, len(moduli_b) - 1), ky=3)
    bonded_curve = BondedCurve(surface, float(strains[-1]))
    return {
        "free, neo-Hookean": (free_curve, False),
        "free, stiffening": (free_curve, True),
        "bonded, neo-Hookean": (bonded_curve, False),
        "bonded, stiffening": (bonded_curve, True),
    }


def reach_of(curve: Curve) -> float:
    """Return the largest strain at which a curve is known."""
    return curve.reach if isinstance(curve, BondedCurve) else 1.0


def free_curve(strain: Array, p: Array) -> Array:
    """Nominal stress (n,) Pa of the incompressible cylinder on frictionless platens, which do not pull before they
    touch."""
    stretch = 1.0 - np.maximum(strain, 0.0)
    I1 = stretch**2 + 2.0 / stretch
    stress: Array = p[0] / 3.0 * np.exp(p[1] * (I1 - 3.0)) * (1.0 / stretch**2 - stretch)
    return stress


def bonded_stresses(shape: float, progress: Progress) -> tuple[Array, Array, Array]:
    """Nominal stress per E (k, n) of the bonded cylinder for each b and strain, the b (k,), and the strains (n,): with
    the further ones where there is an equilibrium at them, which a slender cylinder has not."""
    strains, rows = np.concatenate([STRAINS, FURTHER]), []
    for k, b in enumerate(STIFFENING):
        progress(f"compression: bonded platens, b = {b:g}", k / len(STIFFENING))
        try:
            rows.append(platen_stress(b, shape=shape, strains=tuple(strains)))
        except ConvergenceError:
            if len(strains) == len(STRAINS):
                raise
            strains = STRAINS
            rows.append(platen_stress(b, shape=shape))
    return np.array([row[: len(strains)] for row in rows]), np.array(STIFFENING), strains


def platen_stress(
    b: float, *, shape: float = PUBLISHED_SHAPE, cells: int = CELLS, strains: Sequence[float] = tuple(STRAINS)
) -> Array:
    """Nominal stress (n,) per E at nominal ``strains`` of a cylinder of radius over height ``shape`` glued to both
    platens (its upper half)."""
    E, height = 1e4, 0.03
    half = 0.5 * height
    space = make_space(cylinder_mesh(shape * height, half, cells), "p2p0")
    physics = Physics(material=MaterialSpec("exponential", E, 0.499, {"b": b}))
    top, middle = np.flatnonzero(on(space, 2, half)), np.flatnonzero(on(space, 2, 0.0))
    radius = np.hypot(space.nodes[middle, 0], space.nodes[middle, 1])
    axis, rim = middle[np.argmin(radius)], middle[np.argmax(space.nodes[middle, 0])]
    # the middle plane is a mirror; its centre, and the turning of one node, take the rigid motion out
    held = Held(np.concatenate([3 * middle + 2, [3 * axis, 3 * axis + 1, 3 * rim + 1]]))
    moved = Moved(top, (0.0, 0.0, -strains[-1] * half))
    items: list[Item] = [Continuum(space, physics), held, moved]
    _, weights, normals = space.facet_rule(1)
    area = weights[normals[:, 2] > 0.999].sum()  # the meshed circle is a polygon
    solver = Solver(items, space.n_dof, space.nodes, SolverSettings(tolerance=1e-9))
    x, forces = np.zeros(space.n_dof), []
    now = Moment(0.0, np.inf, np.zeros(3), load=0.0)
    for strain in strains:
        then = Moment(0.0, np.inf, np.zeros(3), load=strain / strains[-1])
        x = solver.solve(x, then, now).x if strain else x
        now = then
        solver.evaluate(x, solver.system, tangent=False)
        forces.append(-solver.system.r[3 * top + 2].sum() / E)
    stress: Array = np.array(forces) / area
    return stress


def fit(curve: Curve, specimen: Specimen, stiffening: bool) -> FittedLaw:
    """Least squares over E, the touch's offset and, if asked, b. The offset is as large as a test may have it, and
    before zero no larger than the ``curve`` reaches."""
    scale = float(specimen.stress.mean())
    latest = 1e3 * latest_touch(specimen.height)
    earliest = -min(latest, 1e3 * (reach_of(curve) - float(specimen.strain.max())) * specimen.height)

    def unpack(z: Array) -> tuple[Array, float]:
        return np.array([np.exp(z[0]), z[2] if stiffening else 0.0]), z[1] * 1e-3

    def residual(z: Array) -> Array:
        p, offset = unpack(z)
        return (curve(specimen.strain - offset / specimen.height, p) - specimen.stress) / scale

    start = [np.log(3e4), 0.0] + ([0.1] if stiffening else [])
    low = [np.log(1e2), earliest] + ([0.0] if stiffening else [])
    high = [np.log(1e8), latest] + ([0.5] if stiffening else [])
    best = least_squares(residual, start, bounds=(low, high))
    p, offset = unpack(best.x)
    return FittedLaw(float(p[0]), float(p[1]), offset, float(np.sqrt(np.mean(best.fun**2))))


def leave_one_out(
    tests: Sequence[Specimen], fits: Mapping[str, Sequence[FittedLaw]], models: Models
) -> dict[str, float]:
    """Rms of `unseen_misfit` over the tests, each predicted with the others' mean E, b and touch; NaN of one test."""
    out = {}
    for name, (curve, _) in models.items():
        misfits = []
        for k, specimen in enumerate(tests if len(tests) > 1 else ()):
            others = [f for j, f in enumerate(fits[name]) if j != k]
            p = np.array([np.exp(np.mean([np.log(f.E) for f in others])), np.mean([f.b for f in others])])
            misfits.append(unseen_misfit(curve, specimen, p, float(np.mean([f.offset for f in others]))) ** 2)
        out[name] = float(np.sqrt(np.mean(misfits))) if misfits else float("nan")
    return out


def unseen_misfit(curve: Curve, specimen: Specimen, p: Array, offset: float) -> float:
    """Rms misfit over the mean force of a test predicted with ``p`` = (E, b) and the touch's ``offset`` (m): nothing
    of it is fitted."""
    residual = curve(specimen.strain - offset / specimen.height, p) - specimen.stress
    return float(np.sqrt(np.mean(residual**2)) / specimen.stress.mean())


def interval(values: Sequence[float]) -> tuple[float, float, float]:
    """Geometric mean and the 95 % interval of that mean (Student's t on the logarithms); NaN of one value."""
    (found,) = expected([values])
    return (found.value, *found.mean)


def next_interval(values: Sequence[float]) -> tuple[float, float]:
    """The 95 % interval of the next value (of a specimen, from those of others); NaN of one value."""
    return expected([values])[0].next


def held_out(groups: Sequence[Sequence[float]]) -> tuple[int, int]:
    """Count the values that lie in the interval of the next one of their group from all others, and all for which
    there is one: two others in the group at least."""
    held = n = 0
    for g, values in enumerate(groups):
        for k, value in enumerate(values if len(values) > 2 else ()):
            others = [*groups[:g], [*values[:k], *values[k + 1 :]], *groups[g + 1 :]]
            low, high = expected(others)[g].next
            held, n = held + (low <= value <= high), n + 1
    return held, n


def by_repeats(tests: Sequence[Specimen], values: Sequence[float]) -> dict[str, list[float]]:
    """Group values by the specimen that they are of."""
    out: dict[str, list[float]] = {}
    for test, value in zip(tests, values, strict=True):
        out.setdefault(test.specimen, []).append(value)
    return out


def by_specimen(tests: Sequence[Specimen], values: Sequence[float]) -> dict[str, float]:
    """The geometric mean of each specimen's repeats."""
    return {n: float(np.exp(np.mean(np.log(repeats)))) for n, repeats in sorted(by_repeats(tests, values).items())}


def _tables(page: StudyPage, materials: Mapping[str, TestedMaterial]) -> None:
    rows, numbers = [], {}
    for material, m in materials.items():
        for model in m.fits:
            found = numbers[f"{material}, {model}"] = _numbers(m, model)
            held, of = found["next_repeat_held"]
            n = len(found["specimens"])
            mean = found["interval_of_the_specimens_mean"] if n > 1 else found["interval_of_the_repeats_mean"]
            rows.append(
                (material.replace("_", " "), model, f"{found['youngs_modulus'] / 1e3:.1f}", _span(mean),
                 _repeats(found), f"{held} of {of}" if of else "–",
                 _span(found["interval_of_the_next_specimen"]) if n > 1 else f"unknown ({n} specimen)",
                 f"{found['b']:.2f}", f"{100 * found['misfit']:.1f}", f"{100 * found['held_out']:.1f}")
            )  # fmt: skip
    header = ("material", "model", "E (kPa)", "its mean, 95 %", "next repeat, 95 %", "left out, held",
              "next specimen, 95 %",
              "b", "misfit (%)", "unseen test (%)")  # fmt: skip
    page.numbers["fits"] = numbers
    page.section(
        "Fits",
        "Misfits are rms over the mean force. In the last column each test is predicted with the mean of the others, "
        "touch included; 'left out, held' counts the repeats that lie in the interval of the next one from the others. "
        "Repeats are tests of one specimen; a file's name tells its specimen (EF10_A3: specimen A). The interval of "
        "the mean is of one specimen's repeats, or, with several specimens, of the mean over specimens; then the next "
        "repeat is said about its specimen's own mean, by the scatter of all specimens' repeats.",
        tables=[Table(header, tuple(rows), numbers=(2, 3, 4, 5, 6, 7, 8, 9))],
    )


def _numbers(m: TestedMaterial, model: str) -> dict[str, Any]:
    """Return what is known of a material with one of the models: moduli and their intervals in Pa."""
    fits = m.fits[model]
    moduli = [f.E for f in fits]
    groups, each = by_repeats(m.tests, moduli), by_specimen(m.tests, moduli)
    E = interval(list(each.values()))
    return {
        "youngs_modulus": E[0],
        "interval_of_the_repeats_mean": interval(moduli)[1:] if len(each) == 1 else None,
        "interval_of_the_specimens_mean": E[1:] if len(each) > 1 else None,
        "interval_of_the_next_repeat": dict(
            zip(groups, (e.next for e in expected(list(groups.values()))), strict=True)
        ),
        "next_repeat_held": list(held_out(list(groups.values()))),
        "specimens": each,
        "interval_of_the_next_specimen": next_interval(list(each.values())),
        "b": float(np.mean([f.b for f in fits])),
        "misfit": float(np.sqrt(np.mean([f.misfit**2 for f in fits]))),
        "held_out": m.unseen[model],
    }


def _repeats(found: Mapping[str, Any]) -> str:
    """Put the interval of the next repeat in words: of the one specimen in kPa, else about each one's own mean."""
    spans = found["interval_of_the_next_repeat"]
    if len(spans) == 1:
        return _span(next(iter(spans.values())))
    off = 100 * max(high / found["specimens"][name] - 1.0 for name, (_, high) in spans.items())
    return f"its own mean ± {off:.0f} %" if np.isfinite(off) else "unknown"


def _span(ends: tuple[float, float]) -> str:
    return f"{ends[0] / 1e3:.1f} to {ends[1] / 1e3:.1f}" if np.isfinite(ends).all() else "unknown"


def _figure(page: StudyPage, materials: Mapping[str, TestedMaterial]) -> None:
    """One panel per material, four beside each other, rows as needed."""
    columns = min(len(materials), 4)
    rows = -(-len(materials) // columns)
    fig, axes = figure(6.9, 0.6 + 2.3 * rows, columns, rows=rows, sharex=True, squeeze=False)
    for ax in axes.ravel()[len(materials) :]:
        ax.set_visible(False)
    for ax, (material, m) in zip(axes.ravel(), materials.items(), strict=False):
        for s in m.tests:
            ax.plot(
                100 * s.strain, 1e-3 * s.stress, color="#b6bdc4", lw=2.5, label="measured" if s is m.tests[0] else None
            )
        strain = np.linspace(0.0, 0.38, 80)
        for (model, (curve, _)), colour, dash in zip(m.models.items(), COLOURS, ("--", "-", "--", "-"), strict=False):
            p = np.array([np.mean([f.E for f in m.fits[model]]), np.mean([f.b for f in m.fits[model]])])
            touched = strain - np.mean([f.offset for f in m.fits[model]]) / m.tests[0].height
            ax.plot(100 * strain, 1e-3 * curve(touched, p), dash, color=colour, lw=1.1, label=model)
        ax.set_title(fill(material.replace("_", " "), TITLE), fontsize=8)
    for ax in axes[:, 0]:
        ax.set_ylabel("stress (kPa)")
    for k, ax in enumerate(axes.ravel()[: len(materials)]):
        if k + columns >= len(materials):  # the lowest of its column
            ax.set_xlabel("compression (%)")
            ax.tick_params(labelbottom=True)
    fig.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=7)
    page.section("Curves", figures=[("compression_curves", fig, "The tests and the four models, mean parameters.")])


def _claims(page: StudyPage, materials: Mapping[str, TestedMaterial], models: Mapping[float, Models]) -> None:
    judged = {k: m for k, m in materials.items() if len(m.tests) > 1}
    best = {k: min(m.unseen, key=lambda name: m.unseen[name]) for k, m in judged.items()}
    text = "; ".join(f"{k.replace('_', ' ')}: {b} ({100 * judged[k].unseen[b]:.1f} %)" for k, b in best.items())
    same = len(set(best.values())) == 1
    page.claim(
        "Which model explains the curves?",
        "not stated",
        text or "no material has two tests",
        HOLDS if same else PARTLY,
        "Judged by tests that were not fitted, not even their touch. Bonded and stiffening pull the curve the same "
        "way; only its shape tells them apart.",
    )
    shape, own = next(iter(models.items()))
    ratio = own["bonded, neo-Hookean"][0](AT, ONE) / own["free, neo-Hookean"][0](AT, ONE)
    page.numbers["bonded_over_free"] = dict(zip(map(str, AT), ratio, strict=True))
    if abs(shape - PUBLISHED_SHAPE) < 1e-6:
        page.claim(
            "A bonded disc of this shape seems 1.35 times as stiff as a free one",
            "1.35",
            ", ".join(f"{r:.2f} at {100 * e:g} %" for e, r in zip(AT, ratio, strict=True)),
            HOLDS if abs(ratio[0] - 1.35) < 0.05 else PARTLY,
            "At small strain; the advantage shrinks with compression.",
        )
