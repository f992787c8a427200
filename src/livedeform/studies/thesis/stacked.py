"""Two gelatin cuboids on top of each other (thesis 2.7.2, table 3.1): which explanation do four numbers support?

Every explanation predicts the four shortenings of table 3.1 as functions of the modulus E (and at most one more
parameter). The bodies' own scale is E / (rho g), so each needs only a few solved moduli and a spline between them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from livedeform.report.page import Table
from livedeform.studies.study import COLOURS, FAILS, HOLDS, OPEN, Progress, StudyPage, figure
from livedeform.studies.thesis.stacked_fit import NAMES, THESIS, FittedStack, MeasuredStack, fit
from livedeform.studies.thesis.stacked_loop import SEED, loop
from livedeform.studies.thesis.stacked_models import MM, SLIPPERY, THESIS_MODULUS, Explanation, explanations


def run(out: Path, data: Path | None, progress: Progress, own: MeasuredStack | None = None) -> dict[str, Any]:
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
    loop(page, every, m, progress)
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


def _extra(f: FittedStack) -> str:
    if f.explanation.extra is None:
        return ""
    return f"{f.extra * MM:+.1f} mm" if f.explanation.extra[2] == "m" else f"{f.extra:.3g}"


def _table(page: StudyPage, stated: Sequence[FittedStack], honest: Sequence[FittedStack], m: MeasuredStack) -> None:
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


def _figure(page: StudyPage, stated: Sequence[FittedStack], m: MeasuredStack) -> None:
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
        figures=[("stacked_table", fig, "MeasuredStack, and four explanations, each with its best E.")],
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


def _claims(page: StudyPage, by_name: Mapping[str, tuple[FittedStack, FittedStack]]) -> None:
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
        f"The discrepancy is as large as {abs(shift[0].extra) * MM:.0f} mm at the interface, or the error of L0.",
    )
    page.numbers["interface_shift_m"] = shift[0].extra
