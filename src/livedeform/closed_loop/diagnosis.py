"""The diagnosis: its values as they are written, the notes on them, and how the graph repeats them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from livedeform.closed_loop.assessment.baselines import Baselines
from livedeform.closed_loop.assessment.called_for import Called
from livedeform.closed_loop.assessment.detectable import Detectable
from livedeform.closed_loop.assessment.discrepancy import Discrepancy
from livedeform.closed_loop.assessment.held_out import (
    HeldOutErrors,
    NextRecording,
    RecordingErrors,
    coverage_of,
    next_recording,
    noise_floor,
)
from livedeform.closed_loop.assessment.next_experiment import Proposal
from livedeform.closed_loop.assessment.ranking import Ranked
from livedeform.closed_loop.assessment.verdict import Conclusion, Verdict, headline, rivals_of, share_of_evidence
from livedeform.closed_loop.candidates import all_effects, doubt, that_stay
from livedeform.closed_loop.evidence.measuring_noise import Source
from livedeform.closed_loop.evidence.observation import Observation, are_pressed, are_untouched
from livedeform.closed_loop.forward import Run
from livedeform.closed_loop.inference.fitted_model import Added, FittedModel
from livedeform.closed_loop.inference.forward_selection import Selection, SelectionStep
from livedeform.closed_loop.inference.gauss_newton import Fit, Prior, Problem
from livedeform.closed_loop.inference.interval import (
    SIGMAS,
    covariance_of_values,
    drawn_along,
    followed,
    mesh_patterns,
)
from livedeform.closed_loop.inputs import Inputs
from livedeform.closed_loop.measured_coverage import coverage_notes
from livedeform.closed_loop.settings import FitSettings, Settings, VerdictSettings
from livedeform.common import frames
from livedeform.common.published_effects import is_last, with_others
from livedeform.common.types import Array, EffectValues
from livedeform.compare_node.coverage import Coverage
from livedeform.compare_node.metrics import ErrorSummary
from livedeform.fem_node.effects import apply_effects
from livedeform.fem_node.physics.memory import memory_of
from livedeform.fem_node.physics.record import Physics


@dataclass(frozen=True)
class Replay:
    """The way in which the graph predicts a recording with the fitted model: its ``bag``, and the bags that a body with
    a set went through before (``after``, the earliest first)."""

    bag: Path
    after: tuple[Path, ...] = ()


@dataclass(frozen=True)
class RecordingNoise:
    """The measuring noise of one recording: ``value`` m, Euclidean sigma of a point in one frame, its 95 % ``interval``
    m and the ``n`` points that tell it (NaN and 0 where the recording does not); ``correlation_time`` s (NaN: not told)
    and ``inflation`` of the variance of a window's mean; where it comes from, and the measured over the stated variance
    as ``ratio`` (NaN where one is missing)."""

    name: str
    held_out: bool
    value: float
    interval: tuple[float, float]
    n: int
    correlation_time: float
    inflation: float
    source: Source
    ratio: float

    @classmethod
    def of(cls, o: Observation, held_out: bool) -> RecordingNoise:
        """Take it from an observation."""
        n = o.noise
        return cls(o.name, held_out, n.value, n.interval, n.n, n.correlation_time, n.inflation, n.source, n.ratio)


@dataclass(frozen=True)
class Diagnosis:
    """A diagnosis: what was found, and what stands behind it.

    ``errors_before`` and ``errors_after`` are the residuals of the declared and of the given model on the same held-out
    data; all numbers and figures about them come from there. ``explained``: see `verdict.explained_share`; ``doubts``:
    what keeps the verdict from being certain, one line each. ``detectable``: what could have been seen of each
    candidate, and ``matters`` m rms the size from which on it matters.
    """

    verdict: Verdict
    effects: tuple[EffectValues, ...]
    added: tuple[Added, ...]
    ranking: tuple[Ranked, ...]
    errors_before: HeldOutErrors
    errors_after: HeldOutErrors
    improvement: tuple[float, float]
    explained: float
    discrepancy: Discrepancy
    text: str
    selection: Selection
    held_out: tuple[Observation, ...]
    proposal: Proposal | None = None
    baselines: Baselines | None = None
    notes: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()
    replays: tuple[Replay, ...] = ()
    seconds: float = 0.0
    detectable: Mapping[str, Detectable] = field(default_factory=dict)
    matters: float = float("nan")

    @property
    def before(self) -> ErrorSummary:
        """Errors of the declared model."""
        return self.errors_before.metrics()

    @property
    def after(self) -> ErrorSummary:
        """Errors of the given model."""
        return self.errors_after.metrics()

    @property
    def floor(self) -> float:
        """The rmse (m) that the measuring noise alone would leave of the same errors; never more than these are."""
        return noise_floor(self.errors_before, self.errors_after)

    @property
    def next_recording(self) -> NextRecording | None:
        """Expect another recording's errors, where two or more were held out whole: parts of those that were fitted
        were registered and laid down with them."""
        if {o.name for o in self.held_out} & {o.name for o in self.selection.observations}:
            return None
        return next_recording(self.errors_before, self.errors_after)

    @property
    def noise(self) -> tuple[RecordingNoise, ...]:
        """The measuring noise of each recording."""
        of = [(o, False) for o in self.selection.observations] + [(o, True) for o in self.held_out]
        return tuple(RecordingNoise.of(o, held_out) for o, held_out in of)

    @property
    def coverage(self) -> Coverage:
        """The part of what was held out that was compared."""
        return coverage_of(self.held_out, self.errors_after)

    @property
    def rivals(self) -> dict[str, tuple[str, ...]]:
        """Candidates that the data cannot tell from each effect that was added, and that are not in the model."""
        return rivals_of([e.name for e in self.effects], {r.name: r.indistinguishable_from for r in self.ranking})

    @property
    def headline(self) -> str:
        """The verdict in one line."""
        return headline(self.verdict, self.rivals, self.doubts, self.differing)

    @property
    def differing(self) -> list[str]:
        """Names of the candidates that are differences from declared effects."""
        return [name for name, c in self.selection.candidates.items() if c.undeclared is not None]


def elements_notes(inputs: Inputs, others: Baselines | None, rmse: float) -> list[str]:
    """Say what smaller elements would do to the error that is left, if a better mesh was solved."""
    if others is None or not inputs.uncertain.correction.points:
        return []
    said = (
        f"of the {1e3 * rmse:.3f} mm that are left on held-out data, elements half as large under the probe leave "
        f"{1e3 * others.finer_after:.3f} mm"
    )
    better = others.finer_after < rmse
    return [f"{said}: mesh the experiment more finely (element_size) if that matters" if better else said]


def noise_notes(observations: Sequence[Observation], settings: VerdictSettings) -> list[str]:
    """Say of which recordings the noise could not be told, and where it is not what was stated."""
    out = []
    for o in observations:
        n = o.noise
        if not n.measured:
            taken = {"stated": "what the tracker states is taken", "second differences": "second differences are taken"}
            out.append(
                f"{o.name}: its noise cannot be told from motion (too few markers or frames, or too much motion): "
                f"{taken.get(n.source, 'a usual size is taken')}, {1e3 * n.value:.3f} mm"
            )
        elif np.isfinite(n.ratio) and not 1.0 / settings.stated_ratio < n.ratio < settings.stated_ratio:
            out.append(
                f"{o.name}: the tracker states {1e3 * n.value / np.sqrt(n.ratio):.3f} mm of noise, "
                f"{1e3 * n.value:.3f} mm are measured"
            )
    return out


def noise_reasons(observations: Sequence[Observation]) -> list[str]:
    """Say of which recordings the noise is neither stated nor told, so that nothing can be held against it."""
    names = [o.name for o in observations if o.noise.source in ("assumed", "second differences")]
    if not names:
        return []
    return [f"the noise of {', '.join(names)} is neither stated by the tracker nor told by the recording"]


def slow_noise_reasons(left: Discrepancy, observations: Sequence[Observation]) -> tuple[str, ...]:
    """Say where what is ``left`` is no larger than an error that the tracker states, that frames do not show, and of
    which the recording does not tell whether it lasts."""
    out = []
    for o in observations:
        stated, shown = o.noise.value, np.sqrt(o.noise.repeated) * o.noise.value
        if o.noise.measured or not left.excess**2 < stated**2 - shown**2:
            continue
        out.append(
            f"the tracker of {o.name} states {1e3 * stated:.3f} mm, of which {1e3 * shown:.3f} mm show from frame to "
            "frame: if the rest changes slowly, it looks like what is left"
        )
    return tuple(out)


def one_press_reasons(steps: Sequence[SelectionStep]) -> list[str]:
    """Say which candidates predict left-out data better, and were not added as one press alone speaks for them."""
    names = list(dict.fromkeys(name for step in steps for name in step.by_one_press))
    if not names:
        return []
    return [f"one press alone speaks for {' and '.join(names)}, which would predict left-out data better"]


def floor_notes(before: HeldOutErrors, after: HeldOutErrors, settings: VerdictSettings) -> list[str]:
    """Say where noise was taken for larger than the error is, beyond chance."""
    said, rmse = before.noise_floor(), min(before.metrics().rmse, after.metrics().rmse)
    chance = settings.below_floor / np.sqrt(2.0 * 3.0 * max(before.metrics().n, 1))
    if not rmse < said * (1.0 - chance):
        return []
    return [
        f"the noise was taken for {1e3 * said:.3f} mm, which is more than the whole error of {1e3 * rmse:.3f} mm: what "
        "the tracker states is too large, and effects below it may have been missed"
    ]


def steady_notes(after: HeldOutErrors, places: Array, settings: VerdictSettings) -> list[str]:
    """Say how much of what is left is there all the time: then the stated rest (its ``places`` (m,) m are known to so
    much) contradicts the model, whatever the body does."""
    said, known = [], 1e3 * float(np.median(places))
    for r in after.recordings:
        mean, seen, whole = _steady(r)
        steady = _rms(mean, seen)
        if steady > settings.there_always * whole:
            said.append(
                f"{r.name}: {1e3 * steady:.3f} mm of the {1e3 * whole:.3f} mm that are left are there all the time, as "
                f"an offset of the stated rest would be; its places are known to {known:.3f} mm"
            )
    return said


def odd_marker_doubts(after: HeldOutErrors, inputs: Inputs, floor: float) -> list[str]:
    """Name the markers that are off all the time by more than the ``floor`` m of a frame's noise, and by far more than
    the others, their places and the noise of their mean are: they are trusted less, so that nothing else shows it."""
    said, most = [], inputs.settings.allowance.outlier
    for r in after.recordings:
        off = np.linalg.norm(_steady(r)[0], axis=1)
        noise = np.where(np.isfinite(r.size), np.trace(r.covariances, axis1=2, axis2=3), 0.0)
        of_mean = np.sqrt(noise.sum(axis=0)) / np.maximum(np.isfinite(r.size).sum(axis=0), 1)
        usual = np.maximum.reduce([np.full(len(off), np.nanmedian(off)), inputs.uncertain.errors.place_sigma, of_mean])
        odd = np.flatnonzero(np.nan_to_num(off) > np.maximum(most * usual, floor))
        if len(odd):
            each = ", ".join(f"{r.ids[i]} by {1e3 * off[i]:.2f} mm" for i in odd)
            said.append(
                f"{r.name}: off all the time are the markers {each}, the others by {1e3 * np.nanmedian(off):.2f} mm "
                "(median): check their places in markers.csv, and their ids"
            )
    return said


def registration_reasons(after: HeldOutErrors, inputs: Inputs) -> list[str]:
    """Say of which recordings what is left is there all the time as one rigid motion of all markers: as registration
    that is allowed for, and so it is evidence for nothing."""
    said, uncertain, settings = [], inputs.uncertain, inputs.settings.verdict
    for r in after.recordings:
        mean, seen, whole = _steady(r)
        if (seen > 0.0).sum() < 3:
            continue
        at, mean, seen = inputs.places[seen > 0.0], mean[seen > 0.0], seen[seen > 0.0]
        rest = at + mean - frames.apply(frames.fit_rigid(at, at + mean, seen), at)
        # what it takes away: one that turns by much is larger than that
        rigid = float(np.sqrt(max(_rms(mean, seen) ** 2 - _rms(rest, seen) ** 2, 0.0)))
        if rigid > settings.there_always * whole:
            said.append(
                f"{r.name}: {1e3 * rigid:.3f} mm of the {1e3 * whole:.3f} mm that are left are one rigid motion of all "
                f"markers all the time, which is allowed for as registration ({1e3 * uncertain.shift:.1f} mm, "
                f"{1e3 * uncertain.turn:.0f} mrad): the tracker's frame may be off, or the stated "
                "rest, from which markers on the support would tell it"
            )
    return said


def _steady(r: RecordingErrors) -> tuple[Array, Array, float]:
    """Find each marker's mean error (m, 3) m, NaN where never seen, the time (m,) s for which it was, and the rms of
    the whole error, m."""
    error = r.measured - r.predicted
    weights = np.where(np.isfinite(error).all(axis=2), r.weights[:, None], 0.0)
    total = weights.sum(axis=0)
    mean = np.einsum("km,kmi->mi", weights, np.nan_to_num(error)) / np.where(total > 0.0, total, np.nan)[:, None]
    whole = float(np.sqrt(np.sum(weights * np.sum(np.nan_to_num(error) ** 2, axis=2)) / weights.sum()))
    return mean, total, whole


def _rms(vectors: Array, weights: Array) -> float:
    """Return the rms of ``vectors`` (m, 3) where they have ``weights`` (m,)."""
    return float(np.sqrt(weights @ np.sum(np.nan_to_num(vectors) ** 2, axis=1) / weights.sum()))


def chi2_notes(chi2: float, settings: VerdictSettings) -> list[str]:
    """Say that what is left is far from what noise and allowances would leave, either way."""
    low, high = settings.usual_chi2
    if chi2 < low:
        return [f"chi2 per datum is {chi2:.2f}: the noise, or what is allowed for elements and places, is too large"]
    if chi2 > high:
        return [f"chi2 per datum is {chi2:.2f}: the noise is too small, or something is not described"]
    return []


def held_out_notes(model: FittedModel, taken: float, called: Called) -> list[str]:
    """Say how held-out data judge what was found."""
    if not model.added:
        return []
    names = ", ".join(model.names)
    tells = called.sigma < 1.0  # all of it from nothing
    take = "takes" if len(model.names) == 1 else "take"
    return [f"on held-out data {names} {take} {taken:.1f} off chi2", *([_amount(names, called)] if tells else [])]


def _amount(names: str, called: Called) -> str:
    return f"held-out data call for {called.share:.2f} +- {called.sigma:.2f} times what {names} was fitted to move"


def unsolved_notes(which: str, runs: Sequence[Run]) -> list[str]:
    """Say at how many moments of the recordings ``which`` the model has no prediction, and the first reason: they are
    left out."""
    lost = np.concatenate([np.isnan(run.points).all(axis=(1, 2)) for run in runs] or [np.zeros(0, bool)])
    if not lost.any():
        return []
    reasons = [reason for run in runs for reason in run.reasons]
    why = f" ({reasons[0]})" if reasons else ""
    return [f"{lost.sum()} of {len(lost)} {which} moments are left out: no equilibrium was found there{why}"]


def lost_with_effects(found: Selection) -> list[str]:
    """Say how many of the moments that were fitted the model has no equilibrium for with the effects in it."""
    if found.first is None or found.problem is None or not found.added:
        return []
    before, after = (np.unique(problem.rows.moment) for problem in (found.first.problem, found.problem))
    lost, n = len(np.setdiff1d(before, after)), sum(o.n_moments for o in found.observations)
    if not lost:
        return []
    return [f"{lost} of {n} fitted moments are left out: no equilibrium was found there with the effects"]


def aside_notes(run: Run | None) -> list[str]:
    """Name the candidates that could not be screened."""
    found = {} if run is None else run.aside
    return [f"set aside: {name} ({why})" for name, why in found.items()]


def rubbing_doubts(model: FittedModel, inputs: Inputs) -> tuple[str, ...]:
    """Say of a probe that begins to rub or stick where no refined mesh has told what the elements get wrong of that."""
    if inputs.forward is not None and memory_of(inputs.forward.setting.physics).rubs:
        return ()
    told = {name for name, _ in model.uncertain.correction.z}
    return tuple(
        f"elements drag more than the body does, and by how much is not told of {a.candidate.name}: its value may be "
        "too small, by more than its interval says; smaller elements (element_size) show how far"
        for a in model.added
        if a.candidate.info.rubs and a.candidate.name not in told
    )


def fit_notes(fit: Fit | None, problem: Problem | None, settings: VerdictSettings) -> list[str]:
    """Say whether the last fit was still on its way, and whether it leaves more of what was fitted than is allowed for:
    then what else is there may bend its values, which their intervals know nothing of."""
    if fit is None:
        return []
    said = []
    if not fit.converged:
        said.append(
            f"the fit had not settled after {fit.n_runs} runs of the model: its values may be further off than said"
        )
    chi2 = float("nan") if problem is None else problem.left(fit)
    if chi2 > settings.usual_chi2[1]:
        said.append(
            f"chi2 per datum is {chi2:.1f} where the effects were fitted: something else is there, and may bend "
            "their values further than their intervals say"
        )
    return said


def untouched_doubts(inputs: Inputs) -> list[str]:
    """Say that nothing held out shows what a press does."""
    if not are_untouched(inputs.held_out, inputs.fitted):
        return []
    return ["no press is held out: what presses showed where they were fitted is neither confirmed nor contradicted"]


def lost_doubts(selection: Selection, model: FittedModel) -> list[str]:
    """Say which leading candidates could not be fitted, and whether the effects of the ``model`` were not together."""
    lost, said = selection.lost, []
    if lost:
        it = "it" if len(lost) == 1 else "them"
        said.append(
            f"{', '.join(lost)} led by first order and could not be fitted: the model finds no equilibrium with {it}, "
            f"nor with less of {it}"
        )
    if len(model.added) > 1 and model.joint is None:
        said.append("the effects were fitted one after another, not together, as the model finds no equilibrium there")
    return said


def cut_off_doubts(selection: Selection) -> list[str]:
    """Say that the search ended at the most effects that it may add, and what it would have gone on with."""
    if not selection.cut_off:
        return []
    return [
        f"{selection.cut_off} would predict unseen data better, but no more effects may be added (--max-effects): "
        "it is left, and may bend the values of those that are given"
    ]


def bound_doubts(model: FittedModel) -> list[str]:
    """Name the values that are at the end of what is tried, and not of what can be: their intervals end there too."""
    ends = [(a.candidate.name, c, c.value(float(a.z[a.candidate.coordinates.index(c)]))) for a, c in model.at_bound]
    which = dict.fromkeys(f"{c.parameter} of {name}" for name, c, v in ends if not is_last(name, c.parameter, v))
    return [
        f"{name} is at the end of what is tried: so is its interval, and the true value may lie beyond"
        for name in which
    ]


def stated_doubts(model: FittedModel, most: float) -> list[str]:
    """Name the values that are further from what the experiment states of them than costs the ``most`` that doubting it
    can."""
    said = []
    for a in model.added:
        away = np.abs(a.z / a.candidate.stated)
        if doubt(a.z, a.candidate.stated, np.inf) < most:
            continue
        which = a.candidate.coordinates[int(np.argmax(away))].parameter
        said.append(
            f"{which} of {a.candidate.name} is {away.max():.1f} of the sigmas off that the experiment states, and is "
            "told without it: correct that sigma, or what is declared"
        )
    return said


def declared_doubts(conclusion: Conclusion, inputs: Inputs) -> list[str]:
    """Name what the experiment declares, of which there may be more than declared, where that cannot be tried."""
    names = that_stay(inputs.declared)
    if conclusion.verdict not in ("effect", "unexplained") or not names:
        return []
    return [
        f"other values of {', '.join(names)}, as the experiment declares {'it' if len(names) == 1 else 'them'}, cannot "
        "be tried: what is left, or named, may stand for that"
    ]


def in_their_place(model: FittedModel, covariance: Array | None) -> str:
    """Say which effects of a model take the place of declared ones, and which of them may not be there at all by the
    `stated_covariance` (p, p); empty where none does."""
    said, at = [], 0
    for a in model.added:
        here, at = slice(at, at + len(a.z)), at + len(a.z)
        if a.candidate.declared is None:
            continue
        values = a.candidate.declared.values.items()
        text = ", ".join(f"{name} {a.candidate.info.in_words(name, value)}" for name, value in values)
        i = a.candidate.strengths
        sigma = np.inf if covariance is None else np.sqrt(np.diag(covariance)[here])[i]
        off = bool(np.all(np.abs(a.candidate.off(a.z)[i]) < SIGMAS * sigma))
        nothing = ", and may be nothing" if off else ""
        said.append(f"{a.candidate.name} takes the place of the declared one ({text}){nothing}.")
    return " ".join(said)


def left_doubts(conclusion: Conclusion, left: Discrepancy, settings: VerdictSettings) -> tuple[str, ...]:
    """Say that something is left beside the effects that are given as the cause, which may stand for what it is: too
    much, or most of what there was to explain, however little."""
    if conclusion.verdict != "effect":
        return ()
    share = "" if conclusion.loud else f"; {share_of_evidence(conclusion.explained)} % are explained"
    least = left.p_value < settings.p_value and conclusion.explained < settings.min_explained
    if not conclusion.loud and not least:
        return ()
    return (
        f"{1e3 * left.excess:.3f} mm rms are left beside the added effects, beyond noise (chi2 per datum "
        f"{left.chi2:.2f}{share}): they are not the whole cause, or stand for another one",
    )


def force_doubts(left: Discrepancy, settings: VerdictSettings) -> tuple[str, ...]:
    """Say that the forces are not those of the model: what is left of the markers does not tell it."""
    if not left.chi2_forces > settings.usual_chi2[1]:
        return ()
    return (
        f"the measured forces are not those of the model (chi2 per datum {left.chi2_forces:.3g} of {left.n_forces}): "
        "check their sign, frame, unit and zero, and the declared modulus",
    )


def replays(inputs: Inputs, held_out: Sequence[Observation], effects: Sequence[EffectValues]) -> tuple[Replay, ...]:
    """Say how the graph repeats what was held out, as far as it came from bags."""
    if not inputs.recordings:
        return ()
    declared = Physics() if inputs.forward is None else inputs.forward.setting.physics
    sets = memory_of(apply_effects(declared, with_others(inputs.declared, effects))).sets
    out = []
    for o in held_out:
        names: list[str] = []
        earlier = o.before if sets else None
        while earlier is not None:
            if earlier.name not in (o.name, *names):  # a recording's last part goes on from its first
                names.insert(0, earlier.name)
            earlier = earlier.before
        if o.name in inputs.recordings:
            out.append(Replay(inputs.recordings[o.name].path, tuple(inputs.recordings[n].path for n in names)))
    return tuple(out)


@dataclass(frozen=True)
class Stated:
    """The ``effects`` that are given, with how sure their values are, ``notes`` and ``doubts`` on that, and the
    sentence on those that are ``in_place`` of declared ones."""

    effects: tuple[EffectValues, ...]
    notes: tuple[str, ...]
    doubts: tuple[str, ...]
    in_place: str

    @classmethod
    def of(cls, model: FittedModel, problem: Problem | None, inputs: Inputs) -> Stated:
        """State a model's effects; ``problem``: the linear one on the rows of its joint fit."""
        covariance = stated_covariance(model, problem, inputs.fitted, inputs.settings, inputs.element_size)
        infos = [a.candidate.info for a in model.added]
        notes = (*together_notes(model, covariance), *coverage_notes(infos, all_effects().values()))
        doubts = (
            *rubbing_doubts(model, inputs),
            *bound_doubts(model),
            *stated_doubts(model, inputs.settings.screening.doubt),
        )
        return cls(tuple(fitted_values(model, covariance)), notes, doubts, in_their_place(model, covariance))


def fitted_values(model: FittedModel, covariance: Array | None) -> list[EffectValues]:
    """Give the added effects with values, and with sigmas and intervals by the `stated_covariance` (p, p)."""
    out, at = [], 0
    for a in model.added:
        here = slice(at, at := at + len(a.z))
        sigmas, intervals = {}, {}
        if covariance is not None:
            own = covariance[here, here]
            sigmas = a.candidate.sigmas(a.z, own)
            intervals = a.candidate.intervals(a.z, own, SIGMAS)
        declared = a.candidate.declared
        before = {} if declared is None else declared.values
        out.append(EffectValues(a.candidate.name, a.values.values, sigmas, intervals, before))
    return out


def stated_covariance(
    model: FittedModel,
    problem: Problem | None,
    observations: Sequence[Observation],
    settings: Settings,
    element_size: float = 0.0,
) -> Array | None:
    """Return the covariance (p, p) of all coordinates of the fit to the ``observations``, through elements of a size in
    m; None without a joint fit. ``problem``: the linear one on the rows of the fit."""
    fit = model.whole_joint
    if fit is None:
        return None
    errors = errors_by_elements(model, fit, settings.fit, element_size)
    # blocks of what is let go are no repeats
    if problem is None or not are_pressed(observations) or len(fit.columns) != problem.rows.n:
        return np.asarray(fit.covariance + errors @ errors.T)
    common, remains = settings.allowance.force_common, settings.discretisation.remains
    mesh = remains * mesh_patterns(model.uncertain.correction, observations, problem, common)
    errors = np.column_stack([errors, followed(problem, fit, mesh)])
    prior = Prior.of([a.candidate for a in model.added], fit.z)
    return covariance_of_values(problem, fit, prior, errors, settings.fit)


def together_notes(model: FittedModel, covariance: Array | None) -> list[str]:
    """Say what the numbers of an effect make together, as its card names it, where that is known twice as well as each
    of them; by the `stated_covariance` (p, p)."""
    notes, at = [], 0
    for a in model.added:
        here = slice(at, at := at + len(a.z))
        whole = a.candidate.together
        if covariance is None or whole is None:
            continue
        value, own, slope = a.candidate.made_together(a.z), covariance[here, here], a.candidate.slope_of_together(a.z)
        sigma = float(np.sqrt(slope @ own @ slope))
        if sigma < 0.5 * abs(value) * np.sqrt(np.diag(own).max()):
            notes.append(
                f"{a.candidate.name}: {whole.name} = {value:.3g} ± {sigma:.2g} {whole.unit} is known better than each"
            )
    return notes


def errors_by_elements(model: FittedModel, fit: Fit, settings: FitSettings, element_size: float) -> Array:
    """Return by how much elements of a size in m put the coordinates of a joint fit off (p, k), one sigma each: each
    number by itself, and each length of the body with those that follow it. An edge within elements is as blurred as
    they are large: a layer seems too thick, and less stiff."""
    columns = list(np.diag(np.concatenate([elements_error(a, settings, element_size) for a in model.added])))
    coordinates = [(a, c) for a in model.added for c in a.candidate.coordinates]
    for i, (a, c) in enumerate(coordinates):
        if c.transform == "log" and a.candidate.parameter(c.parameter).unit == "m":
            columns.append(drawn_along(fit, i, settings.elements_edge * element_size / c.value(float(fit.z[i]))))
    return np.column_stack(columns)


def elements_error(added: Added, settings: FitSettings, element_size: float) -> Array:
    """Size what (p,) elements of a size in m get wrong of an added effect, which no repeat shows: a share of its size,
    however much of it is declared, or of a length or a time, and of theirs where a place is told. What acts on
    measuring is not theirs."""
    coordinates = (added.candidate.undeclared or added.candidate).coordinates
    if added.candidate.measuring:
        return np.zeros(len(coordinates))
    parameters = [added.candidate.parameter(c.parameter) for c in coordinates]
    shares = [settings.elements_size if (e := p.wrong_by_elements) is None else e for p in parameters]
    off = added.candidate.off(added.z)
    size = [abs(v) if c.amplitude else float(c.transform == "log") for c, v in zip(coordinates, off, strict=True)]
    place = [element_size * (c.index in p.placed_by_elements) for c, p in zip(coordinates, parameters, strict=True)]
    return np.asarray(np.hypot(np.multiply(shares, size), np.multiply(settings.elements_place, place)))
