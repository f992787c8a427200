"""The breast phantom standing and hanging (thesis 2.6, 3.3): what does its height say of its modulus?

The phantom was scanned while it stood, so the scan is not stress-free. The thesis lets gravity act upwards twice on the
scan. The right way is the inverse problem: find the unloaded shape that sags into the scan, then hang that.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import PchipInterpolator

from fem_node.element import make_space
from fem_node.mesh_shapes import hemi_ellipsoid_mesh
from fem_node.model import PhantomModel
from fem_node.physics import MaterialSpec, Physics, Support
from livedeform.page import Table
from livedeform.studies.study import COLOURS, FAILS, OPEN, PARTLY, Progress, StudyPage, figure
from livedeform_common.types import Array

HEIGHT = 0.0945  # m, standing (thesis 3.3)
HANGING, SIGMA = 0.0956, 0.0011  # m, measured and one sigma
SCALE_ERROR = 0.036  # the camera measures short by this part (3.5 to 4 %)
THESIS_E = 4000.0  # Pa, at which the thesis's SOFA model hangs at 95.6 mm
RADII = (0.055, 0.075)  # m, half widths of the base: the thesis states none
MODULI = (1800.0, 2500.0, 3500.0, 5000.0, 8000.0, 14000.0, 28000.0, 56000.0)  # Pa
CELLS = 4
G = 9.81
MM = 1e3


@dataclass(frozen=True)
class Curves:
    """Hanging heights (n,) m at ``moduli`` (n,) Pa of a body with the base's half width ``radius`` m."""

    radius: float
    moduli: Array
    inverse: Array
    doubled: Array

    def modulus_at(self, height: float) -> float:
        """E (Pa) at which the body hangs that long (by the inverse solution); infinite if it must be rigid."""
        if height <= HEIGHT:
            return float("inf")
        # lengthening is near to c / E: interpolate its logarithm
        x, y = np.log(self.inverse[::-1] - HEIGHT), np.log(self.moduli[::-1])
        wanted = np.log(height - HEIGHT)
        if wanted < x[0]:
            return float(np.exp(y[0] - (wanted - x[0])))
        return float(np.exp(PchipInterpolator(x, y)(min(wanted, x[-1]))))


def run(out: Path, data: Path | None, progress: Progress) -> dict[str, Any]:
    """The study; it needs no data."""
    del data
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
    _figure(page, curves)
    _twice(page, curves)
    _interval(page, curves)
    page.limits += [
        "The phantom's shape is not in the thesis, so the moduli below are those of half ellipsoids of its height. The "
        "scaling with 1/E of the thesis's own curve needs no shape.",
    ]
    return page.finish()


def hang(radius: float, progress: Progress) -> Curves:
    """Both ways for every modulus."""
    space = make_space(hemi_ellipsoid_mesh((radius, radius, HEIGHT), CELLS), "p2p0")
    support = (Support(lambda X: X[:, 2] < 1e-6),)
    heights = np.full((2, len(MODULI)), np.nan)
    for k, E in enumerate(MODULI):
        progress(f"gravity: half width {radius * MM:g} mm, E = {E:g} Pa", k / len(MODULI))
        material = MaterialSpec("neo_hookean", E, 0.49)
        down, up = np.array([0.0, 0.0, -G]), np.array([0.0, 0.0, G])
        ways = (
            Physics(material=material, gravity=up, scan_gravity=down, scan_fraction=1.0, supports=support),
            Physics(material=material, gravity=2.0 * up, scan_gravity=down, scan_fraction=0.0, supports=support),
        )
        for way, physics in enumerate(ways):
            rest = PhantomModel(space, physics).rest()
            if rest.converged:
                heights[way, k] = float(rest.surface[:, 2].max())
    return Curves(radius, np.array(MODULI), heights[0], heights[1])


def _figure(page: StudyPage, curves: list[Curves]) -> None:
    fig, ax = figure(6.4, 3.4)
    for c, colour in zip(curves, COLOURS, strict=False):
        name = f"half width {c.radius * MM:g} mm"
        ax.plot(c.moduli, (c.inverse - HEIGHT) * MM, "o-", color=colour, label=f"inverse solution, {name}")
        ax.plot(c.moduli, (c.doubled - HEIGHT) * MM, "s--", color=colour, mfc="white", label=f"gravity twice, {name}")
    E = np.geomspace(1500.0, 60000.0, 50)
    ax.plot(E, (HANGING - HEIGHT) * MM * THESIS_E / E, ":", color="k", label="thesis, scaled with 1/E")
    ax.axhspan(0.0, (HANGING + SIGMA - HEIGHT) * MM, color="#b6bdc4", alpha=0.35, lw=0, label="measured, 1 sigma")
    ax.plot([THESIS_E], [(HANGING - HEIGHT) * MM], "k^")
    ax.set(xscale="log", yscale="log", xlabel="Young's modulus (Pa)", ylabel="longer when hanging (mm)", ylim=(0.1, 60))
    ax.set_xticks(*zip(*((E, f"{E:g}") for E in (2000, 4000, 8000, 16000, 32000)), strict=True))
    ax.set_yticks(*zip(*((mm, f"{mm:g}") for mm in (0.1, 1, 10)), strict=True))
    ax.xaxis.minorticks_off()
    ax.legend(fontsize=7.5)
    page.section(
        "Longer by how much?",
        "Figure 3.3 of the thesis, with the unloaded shape recovered. The measured lengthening is 1.1 ± 1.1 mm.",
        figures=[("gravity_sweep", fig, "Hanging minus standing height against the modulus.")],
    )
    page.numbers["hanging_height_m"] = [
        {"radius": c.radius, "moduli": c.moduli, "inverse": c.inverse, "doubled": c.doubled} for c in curves
    ]


def _twice(page: StudyPage, curves: list[Curves]) -> None:
    """How wrong gravity reversed twice is, by modulus."""
    rows = []
    for c in curves:
        for E, right, twice in zip(c.moduli, c.inverse, c.doubled, strict=True):
            relative = (twice - right) / (right - HEIGHT)
            rows.append((f"{c.radius * MM:g}", f"{E:g}", f"{(right - HEIGHT) * MM:.2f}", f"{(twice - HEIGHT) * MM:.2f}",
                         f"{(twice - right) * MM:+.2f}", f"{100 * relative:+.1f}"))  # fmt: skip
    worst = max((abs(c.doubled - c.inverse).max(), c) for c in curves)[0]
    at = {float(E): (c.doubled - c.inverse)[k] for c in curves[:1] for k, E in enumerate(c.moduli)}
    page.section(
        "Gravity reversed twice",
        "Lengthening (mm) by both ways. The shortcut is right in a linear body only (Whiteley 2005).",
        tables=[
            Table(
                ("half width (mm)", "E (Pa)", "inverse", "twice", "difference", "%"),
                tuple(rows),
                numbers=tuple(range(6)),
            )
        ],
    )
    page.numbers["twice_minus_inverse_m"] = at
    page.claim(
        "Gravity acting twice upwards on the scan gives the hanging shape",
        "used",
        f"wrong by {abs(at[5000.0]) * MM:.2f} mm at 5 kPa and up to {worst * MM:.1f} mm at {MODULI[0] / 1e3:g} kPa",
        PARTLY,
        "Far below the measuring error for a stiff phantom, not for a soft one.",
    )


def _interval(page: StudyPage, curves: list[Curves]) -> None:
    """What 95.6 +- 1.1 mm allows."""
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
