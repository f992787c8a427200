"""The verdict and its sentence, by one rule: is there something, and is it explained?

What a model leaves is *loud* where it is neither chance (``settings.p_value``) nor too small to matter
(``settings.min_excess``). Verdict and sentence are made of that one answer, so they cannot contradict each other, and
what is said to be left is left by the model that is given: with the added effects if they are the cause, else the
declared one.

- nothing was added: ``unexplained`` if what is left is loud, else ``none``;
- held-out data contradict what was added (``settings.against``, or what is left is loud and more than before): it is no
  cause. There was something all the same if what the declared model leaves is loud: ``unexplained``. Else what was
  fitted may have something that what was held out has not, if the effects gained much there (``settings.much``):
  ``undecided``; one that was over before the held-out recording changes nothing there;
- held-out data do not confirm what was added, effect by effect (`earning`): ``undecided``; what happened once, before
  cameras were registered for them, counts with what it explains where it was fitted (``over``);
- where it would be ``none`` but effects of a size that matters would not have been seen, or nothing was added and not
  everything was tried, or ``unexplained`` but no larger than what a tracker states and its frames do not show:
  ``undecided``;
- else ``effect``, unless what is left is loud and the effects explain too little of what there was
  (``settings.min_explained``).

A part of the whole that is too small to count in it, as creep after a swing, is named where it is missed, and then not
everything is said to be explained.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from livedeform.closed_loop.settings import VerdictSettings

Verdict = Literal["none", "effect", "unexplained", "undecided"]

EVIDENCE = "the evidence against the declared model on data that were not fitted"  # what a smooth black box gains


@dataclass(frozen=True)
class Left:
    """Says what a model leaves of held-out data: how likely it is noise alone (``p_value``), its ``excess`` m rms
    beyond noise, ``chi2`` per datum. ``rough``: it swings, which a black box that is smooth in time does not see."""

    p_value: float
    excess: float
    chi2: float
    rough: bool = False


@dataclass(frozen=True)
class Findings:
    """The findings that a verdict is made of.

    ``names`` of the effects that were added and what they ``gained`` where they were fitted. On held-out data: what the
    ``declared`` model and what the one with the effects leaves (``left``; the same if nothing was added), the noise's
    ``floor`` m on single frames, the chi2 that the effects have ``taken`` away, and the share of what a black box could
    take away that they ``explained`` (NaN: there was nothing); ``of_size``: the share of its mean square in m2, which
    may be less. ``over``: effects that did not happen in what was held out; their part of the shares is of data that
    were left out where they were fitted. ``hidden``: why effects that matter could not have been seen, a reason each;
    ``slow``: which trackers' errors, if they change slowly, look like what the declared model leaves; ``unfinished``:
    why not everything was tried; ``missed``: what the effects have too little of, though it is a small part of the
    whole; ``unconfirmed``: why held-out data do not confirm the effects (`earning`).
    """

    names: tuple[str, ...]
    gained: float
    declared: Left
    left: Left
    floor: float
    taken: float
    explained: float
    hidden: tuple[str, ...] = ()
    slow: tuple[str, ...] = ()
    unfinished: tuple[str, ...] = ()
    of_size: float = float("nan")
    missed: str = ""
    unconfirmed: str = ""
    over: tuple[str, ...] = ()

    @property
    def share(self) -> float:
        """Return the share that is explained where something is left: of the evidence or of the size, the less."""
        return self.explained if np.isnan(self.of_size) else min(self.explained, self.of_size)


@dataclass(frozen=True)
class Conclusion:
    """The ``verdict``, its ``sentence`` (what is left and whether something explains it), whether what the given model
    leaves is ``loud``: neither chance nor too small to matter, and the share that the sentence says is ``explained``
    (NaN where it says none)."""

    verdict: Verdict
    sentence: str
    loud: bool
    explained: float


def judge(found: Findings, settings: VerdictSettings) -> Conclusion:
    """Say verdict and sentence; see the module's text for the rule."""
    declared, loud = (_loud(left, found.floor, settings) for left in (found.declared, found.left))
    contradicted = bool(found.names) and (found.taken < -settings.against or (loud and found.share < 0.0))
    if not found.names:
        verdict: Verdict = "unexplained" if loud else "none"
    elif contradicted:
        verdict = "unexplained" if declared else "undecided" if found.gained > settings.much else "none"
    elif loud and not found.share >= settings.min_explained:
        verdict = "unexplained"
    else:
        verdict = "undecided" if found.unconfirmed else "effect"
    found = found if verdict == "unexplained" else replace(found, slow=())  # a reason only where something is left
    untold = {"none": found.hidden, "unexplained": found.slow}.get(verdict)
    if untold or (found.unfinished and not found.names):
        verdict = "undecided"
    told = bool(found.names) and verdict not in ("none", "undecided") and not contradicted
    explained = (found.share if loud else found.explained) if told else float("nan")
    if found.missed and not np.isnan(explained):
        explained = min(explained, settings.not_all)
    given, loud = (found.left, loud) if verdict == "effect" else (found.declared, declared)
    rest = _left(given, loud, found.floor, settings)
    if found.names and verdict == "unexplained":
        rest = f"Without {'it' if len(found.names) == 1 else 'them'}, {rest[0].lower()}{rest[1:]}"
    more = [found.missed, _over(found.over)] if verdict == "effect" else []
    cause = _cause(verdict, explained, found, contradicted=contradicted)
    return Conclusion(verdict, " ".join(filter(None, [cause, rest, *more])), loud, explained)


def _loud(left: Left, floor: float, settings: VerdictSettings) -> bool:
    """Return whether what is left is neither chance nor too small to matter."""
    return left.rough or (left.p_value < settings.p_value and left.excess > settings.min_excess * floor)


def headline(
    verdict: str, rivals: Mapping[str, Sequence[str]], doubts: Sequence[str], declared: Collection[str] = ()
) -> str:
    """Say the verdict in one line: the effects that were added, each with the ``rivals`` that the data cannot tell from
    it; ``doubts`` are what keeps it from being certain, and ``declared`` are effects that the experiment has."""
    rivals = {_told(name, declared): [_told(n, declared) for n in others] for name, others in rivals.items()}
    names = " and ".join(_words(rivals))
    if verdict == "none":
        said = "The declared model explains the data: nothing was added"
    elif verdict == "effect":
        said = f"Traced to {_with_rivals(rivals)}"
    elif verdict == "undecided":
        said = "These recordings cannot tell what, if anything, the declared model lacks"
    else:
        said = "There is an error that no known effect explains" + (f"; {names} accounts for a part" if names else "")
    return f"{said}, with doubts" if doubts else said


def rivals_of(given: Sequence[str], alike: Mapping[str, Sequence[str]]) -> dict[str, tuple[str, ...]]:
    """Name, for each effect that is ``given``, the candidates that are not and that the data cannot tell from it, of
    those that each is ``alike``."""
    return {name: tuple(n for n in alike.get(name, ()) if n not in given) for name in given}


def _with_rivals(rivals: Mapping[str, Sequence[str]]) -> str:
    """Name the effects, each with what the data cannot tell from it."""
    if len(rivals) == 1:
        ((name, others),) = rivals.items()
        return ", or to ".join(filter(None, [*_words([name]), " or ".join(_words(others))]))
    said = [" or ".join(_words([name, *others])) for name, others in rivals.items()]
    return " and ".join(f"({names})" if " or " in names else names for names in said)


def _told(name: str, declared: Collection[str]) -> str:
    """Name an effect, or what differs from it where it is declared."""
    return f"another {name} than declared" if name in declared else name


def _words(names: Iterable[str]) -> list[str]:
    return [name.replace("_", " ") for name in names]


def share_of_evidence(explained: float) -> str:
    """The share that is explained as text, in percent; a dash where there was nothing to explain."""
    return f"{100.0 * explained:.0f}" if np.isfinite(explained) else "–"


def _cause(verdict: Verdict, explained: float, found: Findings, *, contradicted: bool) -> str:
    """Say what explains the recordings, and the share that is ``explained``."""
    share = f"{share_of_evidence(explained)} % of {EVIDENCE}"
    names = " and ".join(found.names)
    against = f"what {names} explains where it was fitted does not hold on held-out data"
    reasons = (against if contradicted else "", found.unconfirmed, *found.unfinished, *found.slow, *found.hidden)
    why = "; ".join(reason for reason in reasons if reason)
    if verdict == "none":
        return "The declared model explains the recordings within their noise."
    if verdict == "undecided":
        return f"These recordings cannot tell what, if anything, the declared model lacks: {why}."
    if verdict == "effect" and np.isfinite(explained):
        return f"The added effects explain {share}."
    if verdict == "effect":
        return "What the added effects explain is small against the noise of held-out data."
    if not found.names:
        return "There is a residual that no candidate accounts for."
    if np.isnan(explained):
        return f"There is a residual that no candidate accounts for: {against}."
    return (
        f"There is a residual that no candidate accounts for: the nearest, {names}, takes away only {share}, and is "
        "not given as the cause."
    )


def _over(names: Sequence[str]) -> str:
    """Say of effects that held-out data do not know of how they were judged; nothing of none."""
    if not names:
        return ""
    it = "it is" if len(names) == 1 else "they are"
    return (
        f"{' and '.join(names)} did not happen in what was held out, so that {it} judged by what was left out where it "
        "was fitted."
    )


def chance(p: float) -> str:
    """Return a probability as text; none is zero."""
    return f"p = {p:.2g}" if p > 0.0 else "p < 1e-300"  # it was too small for a number


def _left(left: Left, loud: bool, floor: float, settings: VerdictSettings) -> str:
    """Say how much the given model leaves."""
    size, numbers = f"{1e3 * left.excess:.3f} mm rms", f"{chance(left.p_value)}, chi2 per datum {left.chi2:.2f}"
    if left.rough:
        return f"What is left swings: chi2 per datum is {left.chi2:.1f}, {size} of it smooth."
    if loud:
        return f"A smooth residual of {size} is left beyond the measuring noise ({numbers})."
    if left.excess <= 0.0:
        return "Nothing smooth is left beyond the noise."
    if left.p_value >= settings.p_value:
        return f"What is left is within the noise and what is allowed for elements and marker places ({numbers})."
    return (
        f"What is left, {size} ({numbers}), is too small to matter: less than {100.0 * settings.min_excess:.0f} % of "
        f"the {1e3 * floor:.3f} mm of noise of a single frame."
    )


def explained_share(gain_before: float, gain_after: float, taken: float = 0.0) -> float:
    """Find the share of what a flexible black box could take away (twice its log evidence on held-out data) that the
    effects leave it no more; NaN where it could take away nothing to begin with.

    A black box that is smooth in time cannot follow what rings: where the effects have ``taken`` away more chi2 than
    it could have, what there was to take is that and what it finds now.
    """
    there = max(gain_before, max(taken, 0.0) + max(gain_after, 0.0))
    return 1.0 - max(gain_after, 0.0) / there if there > 0.0 else float("nan")
