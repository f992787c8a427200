"""Apply the closed loop's rule of selection to the four shortenings."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np

from livedeform.common.types import Array
from livedeform.report.page import Table
from livedeform.studies.study import OPEN, PARTLY, Progress, StudyPage
from livedeform.studies.thesis.stacked_fit import THESIS, MeasuredStack, fit
from livedeform.studies.thesis.stacked_models import Explanation, Prediction, column, finite_column, scaled, shifted

SEED, N_DRAWS = 31, 300
ALPHA = 0.05


def loop_candidates(every: Mapping[str, Explanation]) -> dict[str, dict[str, Explanation]]:
    """Model -> what the loop may add to it, one thing at a time: name of the addition -> the model with it."""
    fem = every["3-D, bonded base"]
    scale, shift = every["3-D and the camera's scale"], every["3-D and a shifted interface"]

    def column_(E: float) -> Array:
        return column(E)

    def unlike(E: float, ratio: float) -> Array:
        shortenings: Array = column(E) / np.array([1.0, 1.0, ratio, 1.0])
        return shortenings

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


def loop(page: StudyPage, every: Mapping[str, Explanation], m: MeasuredStack, progress: Progress) -> None:
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
