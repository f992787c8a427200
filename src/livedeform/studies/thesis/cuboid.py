"""The gelatin cuboid under its own weight (thesis 2.7, 3.2): the column formula, its limits, and the body in 3-D."""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from livedeform.report.page import Table
from livedeform.studies.bodies import GRADED_CELLS, Base, Deformed, cuboid, on
from livedeform.studies.own.cuboid import OwnCuboid, run_own
from livedeform.studies.study import COLOURS, FAILS, HOLDS, PARTLY, Progress, StudyPage, figure
from livedeform.studies.thesis.column import HeavyColumn, minimum_modulus, modulus_linear

HEIGHT, WIDTH = 0.07, 0.05  # m
STIFF, SOFT = 2896.0, 1599.0  # Pa
CELLS = 4  # per half side
MODELS = {"linear": "linear", "neo_hookean": "neo_hookean_isochoric", "neo_hookean_log": "neo_hookean_log"}
MM = 1e3


def run(out: Path, data: Path | None, progress: Progress, own: OwnCuboid | None = None) -> dict[str, Any]:
    """The study of the thesis's cuboid, or of the user's ``own`` (without the thesis's claims)."""
    del data
    if own is not None:
        return run_own(out, own, progress)
    page = StudyPage(
        "cuboid",
        "A gelatin cuboid under its own weight",
        "How far does a 50 x 50 x 70 mm gelatin cuboid sink under its weight, and which formula or model says so?",
        out,
        inputs={"height": f"{HEIGHT} m", "width": f"{WIDTH} m", "density": "1000 kg/m3", "g": "9.81 m/s2",
                "E": f"{STIFF:g} and {SOFT:g} Pa",
                "element": "P2-P0 tetrahedra, a quarter of the body, graded towards the rim of the base"},
    )  # fmt: skip
    reference = _reference(page, progress)
    solved = {(E, base): cuboid(HEIGHT, E, base, graded=True) for E in (STIFF, SOFT) for base in ("bonded", "sliding")}
    _table_3_2(page, solved, reference)
    _sweep(page, progress)
    _outline(page, solved)
    _doubling(page)
    page.limits += [
        "The cuboid's real width is not in the thesis's formulas; 50 mm is from its abstract.",
        "Soft and bonded, the rim bulges below the plane of the table (up to 1.8 mm on fine meshes): a real gel "
        "would roll "
        "onto the table, and this problem has no table contact. Mesh and reference values agree, gel and table may "
        "not.",
    ]
    return page.finish()


def reference_values() -> list[Mapping[str, Any]]:
    """Shortenings by independent FEM codes (FEniCSx; CalculiX, felupe, scikit-fem and SOFA agree on equal meshes)."""
    text = (files("livedeform.studies.thesis") / "reference" / "cuboid_fem.json").read_text()
    values: list[Mapping[str, Any]] = json.loads(text)["values"]
    return values


def _reference(page: StudyPage, progress: Progress) -> list[dict[str, Any]]:
    """Every tabulated case beside ours, nu = 0.49 and 0.3."""
    rows = []
    cases = [r for r in reference_values() if r["poisson_ratio"] in (0.3, 0.49)]
    ours = {theirs: name for name, theirs in MODELS.items()}
    for k, case in enumerate(cases):
        progress("cuboid: reference values", k / len(cases))
        deformed = cuboid(
            HEIGHT, case["youngs_modulus"], case["base"], model=ours[case["model"]],
            poisson_ratio=case["poisson_ratio"], graded=True,
        )  # fmt: skip
        rows.append({**case, "ours": deformed.sink((0.0, 0.0, HEIGHT)), "iterations": deformed.n_iterations})
    difference = np.array([r["ours"] / r["shortening_top_centre"] - 1.0 for r in rows])
    table = Table(
        ("model", "base", "E (Pa)", "nu", "others (mm)", "ours (mm)", "difference (%)"),
        tuple(_row(r, d) for r, d in zip(rows, difference, strict=True)),
        numbers=(2, 3, 4, 5, 6),
    )  # fmt: skip
    page.numbers["reference"] = [
        {k: r[k] for k in ("model", "base", "youngs_modulus", "poisson_ratio", "shortening_top_centre", "ours")}
        for r in rows
    ]
    page.numbers["largest_difference_percent"] = 100 * float(np.abs(difference).max())
    soft = [abs(d) for r, d in zip(rows, difference, strict=True) if r["youngs_modulus"] == STIFF]
    page.section(
        "Beside independent codes",
        f"Shortening of the top's centre in {len(rows)} cases, a quarter of the body in "
        f"{' x '.join(map(str, GRADED_CELLS))} cells that shrink towards the rim of the base. The largest "
        f"difference is {100 * np.abs(difference).max():.1f} % ({100 * max(soft):.1f} % at 2896 Pa); the soft bonded "
        "body is the hard "
        "one, since its rim is singular and the others' values are extrapolated.",
        tables=[table],
    )
    return rows


def _row(r: Mapping[str, Any], difference: float) -> tuple[str, ...]:
    others = f"{r['shortening_top_centre'] * MM:.3f} ± {r['uncertainty'] * MM:.3f}"
    model, E, nu = r["model"].replace("_", " "), f"{r['youngs_modulus']:g}", f"{r['poisson_ratio']:g}"
    return model, r["base"], E, nu, others, f"{r['ours'] * MM:.3f}", f"{100 * difference:+.2f}"


def _table_3_2(page: StudyPage, solved: Mapping[tuple[float, str], Deformed], rows: list[dict[str, Any]]) -> None:
    """Table 3.2 of the thesis with ours beside it."""
    top = (0.0, 0.0, HEIGHT)
    lines = []
    for E in (STIFF, SOFT):
        column = HeavyColumn(HEIGHT, E)
        thesis = {STIFF: ("0.50", "0.47 ± 0.03"), SOFT: ("1.50", "fails")}[E]
        bonded, sliding = solved[E, "bonded"].sink(top), solved[E, "sliding"].sink(top)
        lines.append(
            (f"{E:g}", thesis[0], thesis[1], *(f"{v * 100:.2f}" for v in
             (column.shortening_linear(), column.shortening_finite(), sliding, bonded)))
        )  # fmt: skip
    header = (
        "E (Pa)",
        "thesis, theory",
        "thesis, SOFA",
        "eq. 2.3",
        "column, finite strain",
        "3-D, sliding",
        "3-D, bonded",
    )
    page.section(
        "Table 3.2 again",
        "Shortening of the 7 cm cuboid in cm, 3-D at the top's centre.",
        tables=[Table(header, tuple(lines), numbers=tuple(range(7)))],
    )
    _claims_of_table_3_2(page, solved)


def _claims_of_table_3_2(page: StudyPage, solved: Mapping[tuple[float, str], Deformed]) -> None:
    """Judge what the thesis says of the two moduli."""
    top = (0.0, 0.0, HEIGHT)
    stiff = HeavyColumn(HEIGHT, STIFF).shortening_linear()
    soft = solved[SOFT, "bonded"].sink(top)
    page.numbers["shortening_3d_m"] = {f"{E:g} {base}": d.sink(top) for (E, base), d in solved.items()}
    page.claim(
        "E = 2896 Pa shortens 7 cm by 0.50 cm (theory)",
        "0.50 cm",
        f"{stiff * 100:.2f} cm by eq. 2.3; 0.50 cm needs {modulus_linear(HEIGHT, 0.005):.0f} Pa",
        FAILS,
        "The thesis's own formula does not give its number.",
    )
    page.claim(
        "SOFA agrees with theory within 6 % at 2896 Pa",
        "0.47 against 0.50 cm",
        f"{solved[STIFF, 'bonded'].sink(top) * 100:.2f} cm bonded, {solved[STIFF, 'sliding'].sink(top) * 100:.2f} cm "
        "sliding",
        FAILS,
        "0.47 cm is 31 % below the locking-free body: linear tetrahedra that lock give that number.",
    )
    page.claim(
        "A cuboid of 1599 Pa cannot be simulated",
        "fails in SOFA",
        f"{soft * 100:.2f} cm bonded, in {solved[SOFT, 'bonded'].n_iterations} Newton iterations (others: 1.155 ± "
        "0.008)",
        FAILS,
        "A neo-Hookean body without locking is no hard problem; corotational and Saint-Venant-Kirchhoff bodies "
        "collapse.",
    )
    _claims_of_the_formula(page, soft)


def _claims_of_the_formula(page: StudyPage, soft: float) -> None:
    """Judge what eq. 2.3 gives for the soft modulus, whose body sinks by ``soft`` m, and as the least modulus."""
    page.claim(
        "E = 1599 Pa gives 1.5 cm",
        "1.5 cm",
        f"{HeavyColumn(HEIGHT, SOFT).shortening_linear() * 100:.2f} cm by eq. 2.3, {soft * 100:.2f} cm in 3-D",
        PARTLY,
        "The arithmetic holds; at 21 % mean strain the small-strain formula overstates the sinking by a third.",
    )
    page.claim(
        "The modulus is at least 343 Pa at 7 cm",
        "343 Pa",
        f"{minimum_modulus(HEIGHT):.0f} Pa by eq. 2.3",
        PARTLY,
        "Right arithmetic of a small-strain formula at 100 % strain: at finite strain there is no such bound.",
    )


def _sweep(page: StudyPage, progress: Progress) -> None:
    """Shortening against modulus, by formula and in 3-D."""
    E = np.geomspace(1200.0, 12000.0, 9)
    fig, ax = figure(6.4, 3.4)
    fine = np.geomspace(1000.0, 12000.0, 200)
    ax.plot(
        fine,
        [HeavyColumn(HEIGHT, e).shortening_linear() * MM for e in fine],
        "--",
        label="eq. 2.3 (small strain, sliding)",
    )
    ax.plot(fine, [HeavyColumn(HEIGHT, e).shortening_finite() * MM for e in fine], label="column, finite strain")
    bases: tuple[tuple[Base, str], ...] = (("sliding", "o"), ("bonded", "s"))
    for base, marker in bases:
        sunk = []
        for k, e in enumerate(E[::-1]):
            progress(f"cuboid: sweep of the modulus, {base} base", k / len(E))
            sunk.append(cuboid(HEIGHT, e, base, n=3).sink((0.0, 0.0, HEIGHT)))
        ax.plot(E, np.array(sunk[::-1]) * MM, marker, label=f"3-D, {base} base")
        page.numbers[f"sweep_{base}_m"] = {"youngs_modulus": E, "shortening": sunk[::-1]}
    ax.errorbar([STIFF], [4.7], [0.3], fmt="^", color="k", ms=5, capsize=2, label="thesis, SOFA")
    ax.plot([STIFF], [5.0], "kx", ms=6, label="thesis, theory")
    ax.set(xscale="log", xlabel="Young's modulus (Pa)", ylabel="shortening of the top's centre (mm)", ylim=(0, 26))
    ax.set_xticks([1000, 2000, 4000, 8000], ["1000", "2000", "4000", "8000"])
    ax.minorticks_off()
    ax.legend()
    page.section(
        "Where the formula stops",
        "Eq. 2.3 assumes small strain and a base that slides. Finite strain matters below some 3000 Pa, the bonded "
        "base everywhere.",
        figures=[
            ("cuboid_sweep", fig, "Shortening of a 50 x 50 x 70 mm cuboid against its modulus (nu = 0.49 in 3-D).")
        ],
    )


def _outline(page: StudyPage, solved: Mapping[tuple[float, str], Deformed]) -> None:
    """Figure 2.6: the outline of the deformed cuboid, with the plane that halves its volume."""
    fig, halves = _figure_of_outlines(solved)
    page.numbers["half_volume_height_m"] = halves
    page.section(
        "The deformed outline",
        "Figure 2.6 of the thesis, through the middle of a face. The column widens most at its foot; a bonded foot "
        "cannot, and "
        "bulges above it. The dash-dotted plane has half of the bonded body's volume below it.",
        figures=[
            ("cuboid_outline", fig, "Outline of the cuboid under its weight, cut through the middle of two faces.")
        ],
    )


def _figure_of_outlines(solved: Mapping[tuple[float, str], Deformed]) -> tuple[Figure, dict[str, float]]:
    """Draw the outlines; returns the figure and the heights of half the volume (m)."""
    fig, axes = figure(6.4, 3.7, 2, sharey=True)
    halves = {}
    for ax, E in zip(axes, (STIFF, SOFT), strict=True):
        ax.plot([-25, -25, 25, 25, -25], [0, 70, 70, 0, 0], color="#b6bdc4", lw=1, ls=":", label="unloaded")
        _, finite, wide = HeavyColumn(HEIGHT, E).outline()
        column = {
            "color": COLOURS[1],
            "lw": 1.2,
            "ls": "--",
            "zorder": 3,
        }  # over the sliding body, which it hides behind
        ax.plot(25 * wide, finite * MM, label="column, finite strain", **column)
        ax.plot(-25 * wide, finite * MM, **column)
        for base, colour in (("bonded", COLOURS[0]), ("sliding", COLOURS[2])):
            d = solved[E, base]
            side, top = face_outline(d)
            for sign in (-1, 1):
                ax.plot(
                    sign * side[:, 0] * MM, side[:, 1] * MM, color=colour, label=f"3-D, {base}" if sign > 0 else None
                )
                ax.plot(sign * top[:, 0] * MM, top[:, 1] * MM, color=colour)
            halves[f"{E:g} {base}"] = half_volume_height(d)
        cut = halves[f"{E:g} bonded"] * MM
        ax.axhline(cut, color=COLOURS[0], lw=0.8, ls="-.")
        ax.annotate(
            f"half the volume: {cut:.1f} mm", (0, cut), ha="center", va="bottom", fontsize=7.5, color=COLOURS[0]
        )
        ax.set(title=f"E = {E:g} Pa", xlabel="half width at mid-face (mm)", aspect="equal", xlim=(-42, 42))
    axes[0].set_ylabel("height (mm)")
    fig.legend(*axes[1].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return fig, halves


def face_outline(d: Deformed) -> tuple[np.ndarray, np.ndarray]:
    """Half width and height (n, 2) m of the deformed middle of the face x = width/2, and of the top above it."""
    space, half = d.space, float(d.space.nodes[:, 0].max())
    middle = on(space, 1, 0.0)
    side = d.nodes_where(middle & on(space, 0, half), 2)
    top = d.nodes_where(middle & on(space, 2, float(space.nodes[:, 2].max())), 0)
    return d.x[side][:, [0, 2]], d.x[top][:, [0, 2]]


def half_volume_height(d: Deformed) -> float:
    """Height (m) of the horizontal plane with half of the deformed volume below it (midpoints of the tetrahedra)."""
    corners = d.x[d.space.cells[:, :4]]
    volume = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6.0
    # each tetrahedron is spread over its quadrature points: a cloud that is fine enough for a tenth of a millimetre
    z = np.einsum("qa,eai->eqi", d.space.values, d.x[d.space.cells])[:, :, 2]
    share = np.repeat(volume[:, None] / z.shape[1], z.shape[1], axis=1).ravel()
    order = np.argsort(z.ravel())
    below = np.cumsum(share[order]) - 0.5 * share[order]
    return float(np.interp(0.5 * share.sum(), below, z.ravel()[order]))


def _doubling(page: StudyPage) -> None:
    """Show what doubling the height does (2.7.1), with the error of a ratio propagated as it must be."""
    E = 979.0
    ratios = {
        "eq. 2.4": 4.0,
        "column, finite strain": HeavyColumn(0.07, E).shortening_finite() / HeavyColumn(0.035, E).shortening_finite(),
    }
    bases: tuple[Base, Base] = ("bonded", "sliding")
    for base in bases:
        tall, short = (cuboid(h, E, base, n=CELLS).sink((0.025, 0.0, h)) for h in (0.07, 0.035))
        ratios[f"3-D, {base}"] = tall / short
    measured, sigma = 1.52 / 0.37, 1.52 / 0.37 * np.hypot(0.11 / 1.52, 0.11 / 0.37)
    page.numbers["doubling"] = {"measured": measured, "sigma": sigma, **ratios}
    page.claim(
        "Doubling the height makes the deformation four times as large",
        "4.1 ± 0.37",
        f"{ratios['eq. 2.4']:.1f} by eq. 2.4, {ratios['3-D, bonded']:.2f} in 3-D (bonded, at mid-face); measured "
        f"{measured:.1f} ± {sigma:.1f}",
        HOLDS,
        "0.37 is the relative error of the ratio, not its absolute one; with the right one the test is weak.",
    )
    rows = (*tuple((k, f"{v:.2f}") for k, v in ratios.items()), ("measured", f"{measured:.2f} ± {sigma:.2f}"))
    page.section(
        "Doubling the height",
        f"Shortening of 7 cm over that of 3.5 cm, E = {E:g} Pa (fitted to the tall cuboid), at the middle of the face.",
        tables=[Table(("from", "ratio"), rows, numbers=(1,))],
    )
