"""The verdict and its sentence, by one rule: is there something, and is it explained?

What is left is *loud* where it is neither chance (``settings.p_value``) nor too small to matter
(``settings.min_excess``). Verdict and sentence are made of that one answer, so they cannot contradict each other:

- nothing was added: ``unexplained`` if what is left is loud, else ``none``;
- held-out data contradict what was added (``settings.against``): it is no cause. There was something all the same if
  what is left is loud or if the effects gained much where they were fitted (``settings.much``); one that was over
  before the held-out recording changes nothing there;
- where it would be ``none`` but effects of a size that matters would not have been seen, or nothing was added and not
  everything was tried: ``undecided``;
- else ``effect``, unless what is left is loud and the effects explain too little of what there was
  (``settings.min_explained``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from livedeform.closed_loop.settings import VerdictSettings

Verdict = Literal["none", "effect", "unexplained", "undecided"]

EVIDENCE = "the evidence against the declared model on held-out data"  # what a smooth black box gains; see the share


@dataclass(frozen=True)
class Findings:
    """The findings that a verdict is made of.

    ``names`` of the effects that were added and what they ``gained`` where they were fitted. On held-out data: the
    ``p_value`` of what is left under noise alone, its ``excess`` m rms beyond noise and ``chi2`` per datum, the noise's
    ``floor`` m on single frames, the chi2 that the effects have ``taken`` away, and the share of what a black box could
    take away that they ``explained`` (NaN: there was nothing); ``of_size``: the share of its mean square in m2, which
    may be less. ``hidden``: why effects that matter could not have been seen, a reason each. ``rough``: what is left
    swings, which a black box that is smooth in time does not see; ``unfinished``: why not everything
    was tried.
    """

    names: tuple[str, ...]
    gained: float
    p_value: float
    excess: float
    chi2: float
    floor: float
    taken: float
    explained: float
    hidden: tuple[str, ...] = ()
    unfinished: tuple[str, ...] = ()
    rough: bool = False
    of_size: float = float("nan")

    @property
    def share(self) -> float:
        """Return the share that is explained where something is left: of the evidence or of the size, the less."""
        return self.explained if np.isnan(self.of_size) else min(self.explained, self.of_size)


@dataclass(frozen=True)
class Conclusion:
    """The ``verdict``, its ``sentence`` (what is left and whether something explains it), whether what is left is
    ``loud``: neither chance nor too small to matter, and the share that the sentence says is ``explained`` (NaN where
    it says none)."""

    verdict: Verdict
    sentence: str
    loud: bool
    explained: float


def judge(found: Findings, settings: VerdictSettings) -> Conclusion:
    """Say verdict and sentence; see the module's text for the rule."""
    smooth = found.p_value < settings.p_value and found.excess > settings.min_excess * found.floor
    loud = smooth or found.rough
    contradicted = bool(found.names) and found.taken < -settings.against
    if not found.names:
        verdict: Verdict = "unexplained" if loud else "none"
    elif contradicted:
        verdict = "unexplained" if loud or found.gained > settings.much else "none"
    elif loud and not found.share >= settings.min_explained:
        verdict = "unexplained"
    else:
        verdict = "effect"
    if (verdict == "none" and found.hidden) or (found.unfinished and not found.names):
        verdict = "undecided"
    told = bool(found.names) and verdict not in ("none", "undecided") and not contradicted
    explained = (found.share if loud else found.explained) if told else float("nan")
    sentence = f"{_cause(verdict, explained, found)} {_left(loud, found, settings)}"
    return Conclusion(verdict, sentence, loud, explained)


def headline(verdict: str, effects: Sequence[str], rivals: Sequence[str], doubts: Sequence[str]) -> str:
    """Say the verdict in one line: ``effects`` that were added, ``rivals`` that the data cannot tell from the first;
    ``doubts`` are what keeps it from being certain."""
    names = " and ".join(_words(effects))
    if verdict == "none":
        said = "The declared model explains the data: nothing was added"
    elif verdict == "effect":
        said = f"Traced to {names}" + (f", or to {' or '.join(_words(rivals))}" if rivals else "")
    elif verdict == "undecided":
        said = "These recordings cannot tell whether the declared model lacks something"
    else:
        said = "There is an error that no known effect explains" + (f"; {names} accounts for a part" if names else "")
    return f"{said}, with doubts" if doubts else said


def _words(names: Sequence[str]) -> list[str]:
    return [name.replace("_", " ") for name in names]


def share_of_evidence(explained: float) -> str:
    """The share that is explained as text, in percent; a dash where there was nothing to explain."""
    return f"{100.0 * explained:.0f}" if np.isfinite(explained) else "–"


def _cause(verdict: Verdict, explained: float, found: Findings) -> str:
    """Say what explains the recordings, and the share that is ``explained``."""
    share = f"{share_of_evidence(explained)} % of {EVIDENCE}"
    names, why = " and ".join(found.names), "; ".join((*found.unfinished, *found.hidden))
    if verdict == "none":
        return "The declared model explains the recordings within their noise."
    if verdict == "undecided":
        return f"These recordings cannot tell whether the declared model lacks something: {why}."
    if verdict == "effect" and np.isfinite(explained):
        return f"The added effects explain {share}."
    if verdict == "effect":
        return "What the added effects explain is small against the noise of held-out data."
    if not found.names:
        return "There is a residual that no candidate accounts for."
    if np.isnan(explained):
        return (
            f"There is a residual that no candidate accounts for, in what was fitted: what {names} explains there does "
            "not hold on held-out data. On held-out data, with it:"
        )
    does = f"takes away only {share}" if explained >= 0.0 else f"makes what was held out worse ({share})"
    nearest = f"the nearest, {names}, {does}, and is not given as the cause"
    return f"There is a residual that no candidate accounts for: {nearest}."


def _left(loud: bool, found: Findings, settings: VerdictSettings) -> str:
    """Say how much is left."""
    size, numbers = f"{1e3 * found.excess:.3f} mm rms", f"p = {found.p_value:.2g}, chi2 per datum {found.chi2:.2f}"
    if found.rough:
        return f"What is left swings: chi2 per datum is {found.chi2:.1f}, {size} of it smooth."
    if loud:
        return f"A smooth residual of {size} is left beyond the measuring noise ({numbers})."
    if found.excess <= 0.0:
        return "Nothing smooth is left beyond the noise."
    if found.p_value >= settings.p_value:
        return f"What is left is within the noise and what is allowed for elements and marker places ({numbers})."
    return (
        f"What is left, {size} ({numbers}), is too small to matter: less than {100.0 * settings.min_excess:.0f} % of "
        f"the {1e3 * found.floor:.3f} mm of noise of a single frame."
    )


def explained_share(gain_before: float, gain_after: float, taken: float = 0.0) -> float:
    """Find the share of what a flexible black box could take away (twice its log evidence on held-out data) that the
    effects leave it no more; NaN where it could take away nothing to begin with.

    A black box that is smooth in time cannot follow what rings: where the effects have ``taken`` away more chi2 than
    it could have, what there was to take is that and what it finds now.
    """
    there = max(gain_before, max(taken, 0.0) + max(gain_after, 0.0))
    return 1.0 - max(gain_after, 0.0) / there if there > 0.0 else float("nan")
