"""The breast phantom standing and hanging (thesis 2.6, 3.3): what does its height say of its modulus?

The phantom was scanned while it stood, so the scan is not stress-free. The thesis lets gravity act upwards twice on the
scan. The right method is the inverse problem: find the unloaded shape that sags into the scan, then hang that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import PchipInterpolator

from livedeform.common.errors import ConvergenceError, InputError
from livedeform.common.types import Array
from livedeform.fem_node.element.element import make_space
from livedeform.fem_node.mesh.structured import hemi_ellipsoid_mesh
from livedeform.fem_node.model import PhantomModel
from livedeform.fem_node.physics.record import MaterialSpec, Physics, Support
from livedeform.report.page import Table
from livedeform.studies.own.numbers import Key, named_values, sigmas
from livedeform.studies.study import COLOURS, FAILS, HOLDS, OPEN, PARTLY, Progress, StudyPage, figure

HEIGHT = 0.0945  # m, standing (thesis 3.3)
HANGING, SIGMA = 0.0956, 0.0011  # m, measured and one sigma
SCALE_ERROR = 0.036  # the camera measures short by this part (3.5 to 4 %)
THESIS_E = 4000.0  # Pa, at which the thesis's SOFA model hangs at 95.6 mm
RADII = (0.055, 0.075)  # m, half widths of the base: the thesis states none
MODULI = (1800.0, 2500.0, 3500.0, 5000.0, 8000.0, 14000.0, 28000.0, 56000.0)  # Pa
STIFF = 5000.0  # Pa, one of MODULI: of a phantom as stiff as the thesis's
NOTHING = "no equilibrium"
CELLS = 4
G = 9.81
MM = 1e3
KEYS = {
    "standing": Key("standing height, mm", 1.0, 2000.0),
    "hanging": Key("hanging height, mm", 1.0, 4000.0),
    "base": Key("width of the held base, mm; 0: as wide as the thesis's may be", 0.0, 2000.0, 0.0),
    "density": Key("density, kg/m3", 100.0, 5000.0, 1000.0),
    "nu": Key("Poisson's ratio", 0.0, 0.4999, 0.49),
}


@dataclass(frozen=True)
class Own:
    """The user's heights ``standing``, ``hanging`` and one sigma of each (m), half widths of the base (m), density
    (kg/m3), Poisson's ratio."""

    standing: float
    hanging: float
    sigma_standing: float
    sigma_hanging: float
    radii: tuple[float, ...] = RADII
    density: float = 1000.0
    poisson_ratio: float = 0.49

    @property
    def longer(self) -> float:
        """Hanging minus standing, m."""
        return self.hanging - self.standing

    @property
    def sigma(self) -> float:
        """One sigma of `longer`, m."""
        return float(np.hypot(self.sigma_standing, self.sigma_hanging))

    @property
    def moduli(self) -> Array:
        """`MODULI` of a body that weighs and is as tall as this one, Pa: it bends as rho g L / E says."""
        return np.array(MODULI) * self.density * self.standing / (1000.0 * HEIGHT)


def own_numbers(text: str, sigma: str) -> Own:
    """The user's heights of ``--measured`` and ``--sigma`` (of the standing and the hanging one), in mm."""
    v = named_values(text, KEYS)
    standing = v["standing"] / MM
    radii = (0.5 * v["base"] / MM,) if v["base"] else tuple(r / HEIGHT * standing for r in RADII)
    error = [s / MM for s in sigmas(sigma, ("the standing height", "the hanging height"))]
    own = Own(standing, v["hanging"] / MM, error[0], error[1], radii, v["density"], v["nu"])
    if own.longer < -2.0 * own.sigma:
        raise InputError(
            f"{v['hanging']:g} mm is shorter than standing ({v['standing']:g} mm) by more than two sigmas",
            where="--measured hanging",
            remedy="check whether the two heights are swapped, and --sigma",
        )
    return own


THESIS = Own(HEIGHT, HANGING, 0.0, SIGMA)  # the standing height is the scan's


@dataclass(frozen=True)
class Curves:
    """Hanging heights (n,) m at ``moduli`` (n,) Pa of a body with the base's half width ``radius`` m that stands
    ``standing`` m tall; NaN where no equilibrium was found."""

    radius: float
    moduli: Array
    inverse: Array
    doubled: Array
    standing: float = HEIGHT

    def modulus_at(self, height: float) -> float:
        """E (Pa) at which the body hangs that long (by the inverse solution); infinite if it must be rigid."""
        if height <= self.standing:
            return float("inf")
        solved = np.isfinite(self.inverse)
        # lengthening is near to c / E: interpolate its logarithm
        x, y = np.log(self.inverse[solved][::-1] - self.standing), np.log(self.moduli[solved][::-1])
        wanted = np.log(height - self.standing)
        if wanted < x[0]:
            return float(np.exp(y[0] - (wanted - x[0])))
        return float(np.exp(PchipInterpolator(x, y)(min(wanted, x[-1]))))

    @property
    def longest(self) -> float:
        """Hanging height (m) at the softest modulus that was solved; what hangs longer is softer still."""
        return float(np.nanmax(self.inverse))


def run(out: Path, data: Path | None, progress: Progress, own: Own | None = None) -> dict[str, Any]:
    """The study of the thesis's heights, or of the user's ``own`` (without the thesis's claims)."""
    del data
    if own is not None:
        return _run_own(out, own, progress)
    page = StudyPage(
        "gravity",
        "The phantom standing and hanging",
        "The phantom is 94.5 mm tall standing and 95.6 ± 1.1 mm hanging. What is its modulus?",
        out,
        inputs={
            "shape": f"half ellipsoids {HEIGHT * MM:g} mm tall, base held (the thesis states no shape)",
            "half widths of the base": " and ".join(f"{r * MM:g} mm" for r in RADII),
            "density": "1000 kg/m3",
            "nu": 0.49,
        },
    )
    curves = [hang(radius, progress) for radius in RADII]
    _figure(page, curves, THESIS)
    _twice(page, curves)
    _interval(page, curves)
    page.limits += [
        "The phantom's shape is not in the thesis, so the moduli below are those of half ellipsoids of its height. The "
        "scaling with 1/E of the thesis's own curve needs no shape.",
    ]
    return page.finish()


def hang(radius: float, progress: Progress, body: Own = THESIS) -> Curves:
    """Solve by both methods for every modulus."""
    space = make_space(hemi_ellipsoid_mesh((radius, radius, body.standing), CELLS), "p2p0")
    support = (Support(lambda X: X[:, 2] < 1e-6),)
    heights = np.full((2, len(body.moduli)), np.nan)
    for k, E in enumerate(body.moduli):
        progress(f"gravity: half width {radius * MM:g} mm, E = {E:g} Pa", k / len(body.moduli))
        material = MaterialSpec("neo_hookean", float(E), body.poisson_ratio)
        down, up = np.array([0.0, 0.0, -G]), np.array([0.0, 0.0, G])
        common: dict[str, Any] = {"material": material, "density": body.density, "supports": support}
        methods = (
            Physics(gravity=up, scan_gravity=down, scan_fraction=1.0, **common),
            Physics(gravity=2.0 * up, scan_gravity=down, scan_fraction=0.0, **common),
        )
        for method, physics in enumerate(methods):
            rest = PhantomModel(space, physics).rest()
            if rest.converged:
                heights[method, k] = float(rest.surface[:, 2].max())
    return Curves(radius, body.moduli, heights[0], heights[1], body.standing)


def _run_own(out: Path, own: Own, progress: Progress) -> dict[str, Any]:
    """The user's heights: the modulus that they allow, and no claims of the thesis's."""
    measured = f"{own.longer * MM:.2f} ± {own.sigma * MM:.2f} mm"
    page = StudyPage(
        "gravity",
        "A phantom standing and hanging",
        f"The phantom is {own.standing * MM:g} mm tall standing and {own.hanging * MM:g} mm hanging ({measured} "
        "longer). What is its modulus?",
        out,
        inputs={
            "your own (mm)": f"standing {own.standing * MM:g} ± {own.sigma_standing * MM:g}, "
            f"hanging {own.hanging * MM:g} ± {own.sigma_hanging * MM:g}",
            "shape": "half ellipsoids of the standing height, base held",
            "half widths of the base": " and ".join(f"{r * MM:.1f} mm" for r in own.radii),
            "density": f"{own.density:g} kg/m3",
            "nu": own.poisson_ratio,
        },
    )
    curves = [hang(radius, progress, own) for radius in own.radii]
    if not all(np.isfinite(c.inverse).any() for c in curves):
        raise ConvergenceError(
            "no modulus gives an equilibrium", where="--measured", remedy="check base, nu and the standing height"
        )
    _figure(page, curves, own)
    _own_numbers_of(page, own, curves, _own_claims(page, own, curves))
    return page.finish()


def _own_claims(page: StudyPage, own: Own, curves: Sequence[Curves]) -> list[tuple[str, ...]]:
    """Judge whether the heights tell the modulus; return a row of it for each body."""
    rows: list[tuple[str, ...]] = []
    for c in curves:
        best, *low_high = (modulus_text(c, own.longer + k * own.sigma) for k in (0.0, 1.0, -1.0, 2.0, -2.0))
        one, two = " to ".join(low_high[:2]), " to ".join(low_high[2:])
        name = f"half width {c.radius * MM:.1f} mm"
        rows.append((name, best, one, two))
        page.claim(
            f"The heights tell the modulus ({name})",
            f"{own.longer * MM:.2f} ± {own.sigma * MM:.2f} mm",
            f"{best} Pa, {one} Pa within one sigma, {two} Pa within two",
            OPEN if own.longer <= 2.0 * own.sigma else PARTLY,
            "Within two sigmas of no lengthening: there is no upper bound."
            if own.longer <= 2.0 * own.sigma
            else "An interval with two ends, of a half ellipsoid of that height.",
        )
    return rows


def _own_numbers_of(page: StudyPage, own: Own, curves: Sequence[Curves], rows: Sequence[tuple[str, ...]]) -> None:
    """Put the moduli that the heights allow on the page, with what limits them."""
    page.numbers["lengthening_m"] = {"measured": own.longer, "sigma": own.sigma}
    page.numbers["modulus_pa"] = [
        {"radius": c.radius}
        | {k: c.modulus_at(own.standing + own.longer + n * own.sigma) for k, n in
           (("best", 0), ("low_1_sigma", 1), ("high_1_sigma", -1), ("low_2_sigma", 2), ("high_2_sigma", -2))}
        for c in curves
    ]  # fmt: skip
    page.section(
        "The interval of E",
        "Longer is softer; a phantom that does not lengthen may be as stiff as one likes. A value with < is that of "
        "the softest body that was solved, which hangs less long than yours.",
        tables=[Table(("by", "E (Pa)", "within one sigma", "within two"), tuple(rows), numbers=(1, 2, 3))],
    )
    page.limits += [
        "A half ellipsoid stands for your phantom: another shape of the same height has another modulus. Compare the "
        "two widths where no base is given.",
        "An error of the scale that the two heights do not share (one from a scan, one from the cameras) counts in "
        "full as lengthening: put it into --sigma.",
    ]


def modulus_text(curves: Curves, longer: float) -> str:
    """E (Pa) of a body that hangs ``longer`` m than it stands, as text: a bound where it is outside what was solved."""
    E = curves.modulus_at(curves.standing + longer)
    if np.isinf(E):
        return "∞"
    return f"{'< ' if curves.standing + longer > curves.longest else ''}{E:.0f}"


def _figure(page: StudyPage, curves: list[Curves], body: Own) -> None:
    standing = body.standing
    fig, ax = figure(6.4, 3.4)
    for c, colour in zip(curves, COLOURS, strict=False):
        name = f"half width {c.radius * MM:.3g} mm"
        ax.plot(c.moduli, (c.inverse - standing) * MM, "o-", color=colour, label=f"inverse solution, {name}")
        ax.plot(c.moduli, (c.doubled - standing) * MM, "s--", color=colour, mfc="white", label=f"gravity twice, {name}")
    low, high = max(body.longer - body.sigma, 0.0), body.longer + body.sigma
    ax.axhspan(low * MM, high * MM, color="#b6bdc4", alpha=0.35, lw=0, label="measured, 1 sigma")
    ax.set(xscale="log", yscale="log", xlabel="Young's modulus (Pa)", ylabel="longer when hanging (mm)")
    if body is THESIS:
        ax.set_ylim(0.1, 60)
        E = np.geomspace(1500.0, 60000.0, 50)
        ax.plot(E, body.longer * MM * THESIS_E / E, ":", color="k", label="thesis, scaled with 1/E")
        ax.plot([THESIS_E], [body.longer * MM], "k^")
        ax.set_xticks(*zip(*((E, f"{E:g}") for E in (2000, 4000, 8000, 16000, 32000)), strict=True))
    else:
        ax.set_xticks(*zip(*((E, f"{E:.3g}" if E < 1e3 else f"{E:.0f}") for E in body.moduli[::2]), strict=True))
    ax.xaxis.minorticks_off()
    ax.set_yticks(*zip(*((mm, f"{mm:g}") for mm in (0.1, 1, 10)), strict=True))
    ax.legend(fontsize=7.5)
    page.section(
        "Longer by how much?",
        f"Figure 3.3 of the thesis, with the unloaded shape recovered. The measured lengthening is "
        f"{body.longer * MM:.1f} ± {body.sigma * MM:.1f} mm.",
        figures=[("gravity_sweep", fig, "Hanging minus standing height against the modulus.")],
    )
    page.numbers["hanging_height_m"] = [
        {"radius": c.radius, "moduli": c.moduli, "inverse": c.inverse, "doubled": c.doubled} for c in curves
    ]


def _twice(page: StudyPage, curves: list[Curves]) -> None:
    """Show how wrong gravity reversed twice is, by body and modulus."""
    rows: list[tuple[str, ...]] = []
    for c in curves:
        for E, right, twice in zip(c.moduli, c.inverse, c.doubled, strict=True):
            said = [f"{(h - HEIGHT) * MM:.2f}" if np.isfinite(h) else NOTHING for h in (right, twice)]
            if np.isfinite(twice - right):
                relative = (twice - right) / (right - HEIGHT)
                said += [f"{(twice - right) * MM:+.2f}", f"{100 * relative:+.1f}"]
            rows.append((f"{c.radius * MM:g}", f"{E:g}", *said, *["–"] * (4 - len(said))))
    page.section(
        "Gravity reversed twice",
        "Lengthening (mm) by both methods. The shortcut is right in a linear body only (Whiteley 2005).",
        tables=[
            Table(
                ("half width (mm)", "E (Pa)", "inverse", "twice", "difference", "%"),
                tuple(rows),
                numbers=tuple(range(6)),
            )
        ],
    )
    page.numbers["twice_minus_inverse_m"] = [
        {"radius": c.radius, "by_modulus_pa": dict(zip(c.moduli.tolist(), c.doubled - c.inverse, strict=True))}
        for c in curves
    ]
    ours, worst = error_of_twice(curves)
    page.claim(
        "Gravity acting twice upwards on the scan gives the hanging shape",
        "used",
        ours,
        OPEN if not np.isfinite(worst) else HOLDS if worst < SIGMA else PARTLY,
        "Far below the measuring error for a stiff phantom, not for a soft one." if worst >= SIGMA else "",
    )


def error_of_twice(curves: Sequence[Curves]) -> tuple[str, float]:
    """Say by how much gravity reversed twice is off at ``STIFF`` and at most, over all bodies; also return the latter
    (m), NaN where no body has an equilibrium by both methods."""
    off = [(abs(twice - right), float(E), c.radius) for c in curves
           for E, right, twice in zip(c.moduli, c.inverse, c.doubled, strict=True)]  # fmt: skip
    solved = [o for o in off if np.isfinite(o[0])]
    lost = [f"{E / 1e3:g} kPa (half width {radius * MM:g} mm)" for d, E, radius in off if not np.isfinite(d)]
    without = f"; {NOTHING} at {', '.join(lost)}" if lost else ""
    if not solved:
        return without[2:], float("nan")
    there = sorted(d * MM for d, E, _ in solved if E == STIFF)
    ends = list(dict.fromkeys(f"{d:.2f}" for d in (there[:1] + there[-1:])))
    at = f"{' to '.join(ends)} mm at {STIFF / 1e3:g} kPa and " if ends else ""
    worst, E, radius = max(solved)
    return f"wrong by {at}up to {worst * MM:.1f} mm at {E / 1e3:g} kPa (half width {radius * MM:g} mm){without}", worst


def _interval(page: StudyPage, curves: list[Curves]) -> None:
    """Show which moduli 95.6 +- 1.1 mm allows."""
    high = HANGING + SIGMA
    scaled_low = THESIS_E * (HANGING - HEIGHT) / (high - HEIGHT)
    true = HANGING / (1.0 - SCALE_ERROR)
    scaled_true = THESIS_E * (HANGING - HEIGHT) / (true - HEIGHT)
    rows = [("thesis's curve, scaled with 1/E", f"{THESIS_E:.0f}", f"{scaled_low:.0f} to ∞", f"{scaled_true:.0f}")]
    for c in curves:
        values = [c.modulus_at(h) for h in (HANGING, high, true)]
        rows.append(
            (
                f"half ellipsoid, half width {c.radius * MM:g} mm",
                f"{values[0]:.0f}",
                f"{values[1]:.0f} to ∞",
                f"{values[2]:.0f}",
            )
        )
    page.numbers["modulus_interval_pa"] = {r[0]: r[1:] for r in rows}
    page.section(
        "The interval of E",
        f"One sigma below, the height is {(HANGING - SIGMA) * MM:.1f} mm, that of the standing phantom: there is no "
        "upper bound. The last column "
        f"reads the hanging height as {true * MM:.1f} mm, with the camera's scale error of {100 * SCALE_ERROR:.1f} % "
        "corrected; that is as large as "
        "everything else together, because the standing height comes from the scan, not from the camera.",
        tables=[
            Table(
                ("by", "E at 95.6 mm (Pa)", "E within one sigma", "E, scale corrected"), tuple(rows), numbers=(1, 2, 3)
            )
        ],
    )
    _claims_of_the_interval(page, curves, scaled_low, scaled_true)


def _claims_of_the_interval(page: StudyPage, curves: Sequence[Curves], scaled_low: float, scaled_true: float) -> None:
    """Judge what the thesis says of the modulus."""
    page.claim(
        "E = 4000 Pa causes exactly the same deformation as the real phantom",
        "4000 Pa",
        f"{scaled_low:.0f} Pa to infinity within one sigma; {scaled_true:.0f} Pa if the camera's scale error was not "
        "corrected",
        OPEN,
        "1.1 ± 1.1 mm bounds nothing from above.",
    )
    page.claim(
        "The modulus could be 2750 Pa and up",
        "2750 Pa",
        f"{scaled_low:.0f} Pa and up by scaling the thesis's own curve",
        FAILS,
        "Twice the lengthening is half the modulus.",
    )
    ours = curves[-1]
    length = float(np.interp(np.log(THESIS_E), np.log(ours.moduli), ours.inverse)) - HEIGHT
    page.claim(
        "A phantom of 4000 Pa hangs 1.1 mm longer than it stands",
        "1.1 mm in SOFA",
        f"{length * MM:.0f} mm for a solid half ellipsoid of that height (half width {ours.radius * MM:g} mm)",
        OPEN,
        "Either the phantom is held by more than its base, or the simulated body was far too stiff (linear "
        "tetrahedra lock).",
    )
