"""Ecoflex cylinders between platens (Dawood et al. 2026): free or bonded, neo-Hookean or stiffening?

Four models of one cylinder, each with a modulus (and b) and an offset of the first touch. Free platens have a formula:

    P = mu exp(b (I1 - 3)) (1/lambda^2 - lambda),  I1 = lambda^2 + 2/lambda,  mu = E/3                (incompressible)

bonded ones are solved once per b with nu = 0.499; the force is proportional to E.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import RectBivariateSpline
from scipy.optimize import least_squares
from scipy.stats import t as student

from livedeform.common.errors import InputError
from livedeform.common.types import Array
from livedeform.fem_node.element.element import make_space
from livedeform.fem_node.items.continuum import Continuum
from livedeform.fem_node.items.protocol import Item, Moment
from livedeform.fem_node.items.supports import Held
from livedeform.fem_node.mesh.structured import cylinder_mesh
from livedeform.fem_node.physics.record import MaterialSpec, Physics
from livedeform.fem_node.solve.solver import Solver, SolverSettings
from livedeform.report.page import Table
from livedeform.studies.bodies import Moved, on
from livedeform.studies.study import COLOURS, HOLDS, PARTLY, Progress, StudyPage, figure, need_data

HOME = "GitHub abubakardawood/tissue-phantom-material-database (CC BY 4.0)"
RADIUS, HEIGHT = 0.025, 0.030  # m
AREA = np.pi * RADIUS**2
STRAINS = np.linspace(0.0, 0.40, 11)  # nominal; the bonded mesh is good up to here
STIFFENING = (0.0, 0.1, 0.25, 0.5)
FIRST_STRAIN = 0.02  # below it the specimen is still being seated
CELLS = 4
AT, ONE = np.array([0.04, 0.20, 0.38]), np.array([1.0, 0.0])  # strains of the comparison; E = 1 Pa, b = 0

Curve = Callable[[Array, Array], Array]  # strains (n,), (E, b) -> force (n,) N


@dataclass(frozen=True)
class Specimen:
    """One test: ``strain`` (n,) nominal compression and ``force`` (n,) N."""

    name: str
    strain: Array
    force: Array


@dataclass(frozen=True)
class FittedLaw:
    """A model fitted to one specimen: E Pa, b, offset of the touch (m), rms misfit over the mean force."""

    E: float
    b: float
    offset: float
    misfit: float


def run(out: Path, data: Path | None, progress: Progress) -> dict[str, Any]:
    """The study, on every material in the data's folder (each a folder of ``*.csv``, one per specimen)."""
    folder = need_data(data, "compression", HOME)
    materials = {p.name: [read(f) for f in sorted(p.glob("*.csv"))] for p in sorted(folder.iterdir()) if p.is_dir()}
    materials = {name: tests for name, tests in materials.items() if len(tests) >= 3}
    if not materials:
        raise InputError(
            "no folder holds three or more *.csv files", where=str(folder), remedy="one folder per material"
        )
    page = StudyPage(
        "compression",
        "Ecoflex between platens",
        "Do free or bonded platens, a neo-Hookean or a stiffening material explain published compression tests?",
        out,
        inputs={"data": HOME, "cylinder": f"diameter {2 * RADIUS * 1e3:g} mm, height {HEIGHT * 1e3:g} mm",
                "specimens": {k: len(v) for k, v in materials.items()},
                "strain": f"{FIRST_STRAIN:g} to {STRAINS[-1]:g}"},
    )  # fmt: skip
    models = curves(progress)
    results = {m: {k: [fit(c, s, b) for s in tests] for k, (c, b) in models.items()} for m, tests in materials.items()}
    held_out = {m: leave_one_out(materials[m], r, models) for m, r in results.items()}
    _tables(page, results, held_out)
    _figure(page, materials, results, models)
    _claims(page, held_out, models)
    page.limits += [
        "The friction on the platens is not stated; free and bonded are its two bounds.",
        "Loading only, at one speed: nothing here tells relaxation from stiffening.",
        "Compression is used up to 40 % of the height, the tests go to 67 %.",
    ]
    return page.finish()


FEWEST = 20  # lines of a test


def read(path: Path) -> Specimen:
    """One test: header lines, then Time (s), Compression (mm), Load (N), ..."""
    lines = path.read_text().splitlines()
    first = next((k for k, line in enumerate(lines) if line.startswith("Time")), None)
    if first is None:
        raise InputError("has no line that begins with 'Time'", where=str(path), remedy="name the tests' CSV files")
    try:
        table = np.loadtxt(lines[first + 1 :], delimiter=",", usecols=(1, 2), ndmin=2)
    except (ValueError, IndexError) as error:
        raise InputError(f"is torn ({error})", where=str(path), remedy="get the file again") from error
    strain = table[:, 0] * 1e-3 / HEIGHT
    keep = (strain >= FIRST_STRAIN) & (strain <= STRAINS[-1] - 0.01)
    if keep.sum() < FEWEST or strain.max(initial=0.0) < STRAINS[-1] - 0.01:
        reach = f"{100 * strain.max(initial=0.0):.0f} % in {len(strain)} lines"
        raise InputError(
            f"ends at a compression of {reach}; {100 * (STRAINS[-1] - 0.01):.0f} % are needed",
            where=str(path),
            remedy="get the file again, it may be torn",
        )
    return Specimen(path.stem, strain[keep][::5], table[keep, 1][::5])


def curves(progress: Progress) -> dict[str, tuple[Curve, bool]]:
    """The four models by name, and whether each has a free b."""
    bonded, moduli_b = bonded_forces(progress)
    surface = RectBivariateSpline(moduli_b, STRAINS, bonded, kx=min(3, len(moduli_b) - 1), ky=3)

    def bonded_curve(strain: Array, p: Array) -> Array:
        force: Array = p[0] * surface(p[1], np.clip(strain, 0.0, STRAINS[-1]))[0]
        return force

    return {
        "free, neo-Hookean": (free_curve, False),
        "free, stiffening": (free_curve, True),
        "bonded, neo-Hookean": (bonded_curve, False),
        "bonded, stiffening": (bonded_curve, True),
    }


def free_curve(strain: Array, p: Array) -> Array:
    """Force (n,) N of the incompressible cylinder on frictionless platens."""
    stretch = 1.0 - strain
    I1 = stretch**2 + 2.0 / stretch
    force: Array = p[0] / 3.0 * np.exp(p[1] * (I1 - 3.0)) * (1.0 / stretch**2 - stretch) * AREA
    return force


def bonded_forces(progress: Progress) -> tuple[Array, Array]:
    """Force per Pa of E (k, n) of the bonded cylinder for each b and strain, and the b (k,)."""
    rows = []
    for k, b in enumerate(STIFFENING):
        progress(f"compression: bonded platens, b = {b:g}", k / len(STIFFENING))
        rows.append(platen_force(b))
    return np.array(rows), np.array(STIFFENING)


def platen_force(b: float, *, cells: int = CELLS, strains: Sequence[float] = tuple(STRAINS)) -> Array:
    """Force (n,) N per Pa of E at nominal ``strains`` of a cylinder glued to both platens (its upper half)."""
    E = 1e4
    half = 0.5 * HEIGHT
    space = make_space(cylinder_mesh(RADIUS, half, cells), "p2p0")
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
    on_the_cylinder: Array = np.array(forces) * AREA / area
    return on_the_cylinder


def fit(curve: Curve, specimen: Specimen, stiffening: bool) -> FittedLaw:
    """Least squares over E, the touch's offset and, if asked, b."""
    scale = float(specimen.force.mean())

    def unpack(z: Array) -> tuple[Array, float]:
        return np.array([np.exp(z[0]), z[2] if stiffening else 0.0]), z[1] * 1e-3

    def residual(z: Array) -> Array:
        p, offset = unpack(z)
        return (curve(specimen.strain - offset / HEIGHT, p) - specimen.force) / scale

    start = [np.log(3e4), 0.0] + ([0.1] if stiffening else [])
    low, high = [np.log(1e2), -1.0] + ([0.0] if stiffening else []), [np.log(1e7), 1.0] + ([0.5] if stiffening else [])
    best = least_squares(residual, start, bounds=(low, high))
    p, offset = unpack(best.x)
    return FittedLaw(float(p[0]), float(p[1]), offset, float(np.sqrt(np.mean(best.fun**2))))


def leave_one_out(
    tests: Sequence[Specimen], results: Mapping[str, Sequence[FittedLaw]], models: Mapping[str, tuple[Curve, bool]]
) -> dict[str, float]:
    """Rms of `unseen_misfit` over the specimens, each predicted with the others' mean E and b."""
    out = {}
    for name, (curve, _) in models.items():
        misfits = []
        for k, specimen in enumerate(tests):
            others = [f for j, f in enumerate(results[name]) if j != k]
            p = np.array([np.exp(np.mean([np.log(f.E) for f in others])), np.mean([f.b for f in others])])
            misfits.append(unseen_misfit(curve, specimen, p) ** 2)
        out[name] = float(np.sqrt(np.mean(misfits)))
    return out


def unseen_misfit(curve: Curve, specimen: Specimen, p: Array) -> float:
    """Rms misfit over the mean force of a specimen predicted with ``p`` = (E, b); only its first touch is fitted."""
    scale = float(specimen.force.mean())

    def residual(z: Array) -> Array:
        return (curve(specimen.strain - z[0] * 1e-3 / HEIGHT, p) - specimen.force) / scale

    best = least_squares(residual, [0.0], bounds=([-1.0], [1.0]))
    return float(np.sqrt(np.mean(best.fun**2)))


def interval(values: Sequence[float]) -> tuple[float, float, float]:
    """Geometric mean and its 95 % interval over specimens (Student's t on the logarithms)."""
    logs = np.log(values)
    half = student.ppf(0.975, len(logs) - 1) * logs.std(ddof=1) / np.sqrt(len(logs))
    return float(np.exp(logs.mean())), float(np.exp(logs.mean() - half)), float(np.exp(logs.mean() + half))


def _tables(page: StudyPage, results: Mapping[str, Any], held_out: Mapping[str, Any]) -> None:
    rows, numbers = [], {}
    for material, by_model in results.items():
        for model, fits in by_model.items():
            E = interval([f.E for f in fits])
            b, own = float(np.mean([f.b for f in fits])), float(np.sqrt(np.mean([f.misfit**2 for f in fits])))
            unseen = held_out[material][model]
            numbers[f"{material}, {model}"] = {
                "youngs_modulus": E[0],
                "interval": E[1:],
                "b": b,
                "misfit": own,
                "held_out": unseen,
            }
            rows.append(
                (material.replace("_", " "), model, f"{E[0] / 1e3:.1f}", f"{E[1] / 1e3:.1f} to {E[2] / 1e3:.1f}",
                 f"{b:.2f}", f"{100 * own:.1f}", f"{100 * unseen:.1f}")
            )  # fmt: skip
    header = ("material", "model", "E (kPa)", "95 % over specimens", "b", "misfit (%)", "unseen specimen (%)")
    page.numbers["fits"] = numbers
    page.section(
        "Fits",
        "Misfits are rms over the mean force. In the last column each specimen is predicted with the mean of the "
        "others.",
        tables=[Table(header, tuple(rows), numbers=(2, 3, 4, 5, 6))],
    )


def _figure(
    page: StudyPage, materials: Mapping[str, Any], results: Mapping[str, Any], models: Mapping[str, Any]
) -> None:
    fig, axes = figure(6.9, 2.9, len(materials), sharex=True)
    for ax, (material, tests) in zip(np.atleast_1d(axes), materials.items(), strict=True):
        for s in tests:
            ax.plot(100 * s.strain, s.force, color="#b6bdc4", lw=2.5, label="measured" if s is tests[0] else None)
        strain = np.linspace(0.0, 0.38, 80)
        for (model, (curve, _)), colour, dash in zip(models.items(), COLOURS, ("--", "-", "--", "-"), strict=False):
            p = np.array(
                [np.mean([f.E for f in results[material][model]]), np.mean([f.b for f in results[material][model]])]
            )
            ax.plot(100 * strain, curve(strain, p), dash, color=colour, lw=1.1, label=model)
        ax.set(title=material.replace("_", " "), xlabel="compression (%)")
    np.atleast_1d(axes)[0].set_ylabel("force (N)")
    fig.legend(*np.atleast_1d(axes)[0].get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=7)
    page.section(
        "Curves", figures=[("compression_curves", fig, "Published tests and the four models, mean parameters.")]
    )


def _claims(page: StudyPage, held_out: Mapping[str, Any], models: Mapping[str, Any]) -> None:
    best = {m: min(h, key=lambda k: h[k]) for m, h in held_out.items()}
    text = "; ".join(f"{m.replace('_', ' ')}: {b} ({100 * held_out[m][b]:.1f} %)" for m, b in best.items())
    same = len(set(best.values())) == 1
    page.claim(
        "Which model explains the curves?",
        "not stated",
        text,
        HOLDS if same else PARTLY,
        "Judged by specimens that were not fitted. Bonded and stiffening pull the curve the same way; only its shape "
        "tells them apart.",
    )
    ratio = models["bonded, neo-Hookean"][0](AT, ONE) / models["free, neo-Hookean"][0](AT, ONE)
    page.numbers["bonded_over_free"] = dict(zip(map(str, AT), ratio, strict=True))
    page.claim(
        "A bonded disc of this shape seems 1.35 times as stiff as a free one",
        "1.35",
        ", ".join(f"{r:.2f} at {100 * e:g} %" for e, r in zip(AT, ratio, strict=True)),
        HOLDS if abs(ratio[0] - 1.35) < 0.05 else PARTLY,
        "At small strain; the advantage shrinks with compression.",
    )
