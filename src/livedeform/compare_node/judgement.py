"""Judge what a run's numbers mean, in the one sentence that terminal, page and JSON show."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from livedeform.compare_node.coverage import FEW, Coverage
from livedeform.compare_node.metrics import Level, RunMetrics
from livedeform.compare_node.surface_error import SurfaceError

ENOUGH, HALF = 0.9, 0.5  # of the measured frames, and of the deepest moments: below it WARN at best, and STALE
MATTERS = 0.5  # of the threshold, by which interpolation can have changed what is judged: it may be within, or not
SMALL = 0.0095  # mm, below which two decimals are 0.01 or 0.00
REFUSED = {
    "extrapolation": "before the first or after the last prediction",
    "gap": "between predictions too far apart",
    "not_converged": "the model found no equilibrium",
    "out_of_order": "stamps ran backwards or jumped",
    "no_common_marker": "no marker of the model was seen",
    "waiting": "waited too long for a prediction",
    FEW: "fewer than half of the markers were seen",
    "unpaired": "pictures that gave no frame",
}


@dataclass(frozen=True)
class Judgement:
    """``level``; ``said`` the headline; ``because`` what it rests on, and what is to be kept in mind."""

    level: Level
    said: str
    because: str

    @property
    def sentence(self) -> str:
        return f"{self.said}: {self.because}" if self.because else self.said


def judge(metrics: RunMetrics) -> Judgement:
    """The verdict on a run: its errors against the threshold, and whether enough of the run was compared."""
    limit = f"{metrics.threshold * 1e3:g} mm"
    coverage = metrics.coverage
    poor = _too_little(coverage)
    if metrics.wrong:
        return Judgement(Level.STALE, "Nothing can be concluded from these inputs", _sentence(*metrics.wrong))
    if not metrics.n and metrics.surface is not None and metrics.surface.n:
        return _of_surface(metrics, metrics.surface, limit)
    if not metrics.n:
        none = "no marker was both measured and predicted"
        return Judgement(Level.STALE, "There is nothing to judge", _sentence(none, *_doubts(metrics)))
    numbers = _numbers(metrics)
    doubts = [doubt for doubt in _doubts(metrics) if doubt != poor]
    notes = [numbers, *doubts, *_notes(metrics)]
    if poor:
        return Judgement(Level.STALE, "There is too little to judge", _sentence(poor, *notes))
    if metrics.rmse.value > metrics.threshold >= np.sqrt(max(metrics.rmse.value**2 - metrics.places**2, 0.0)):
        said = f"Whether the model is within {limit} is less than the stated marker places tell"
        return Judgement(Level.WARN, said, _sentence(*notes))
    if metrics.rmse.value > metrics.threshold:
        cause = "`livedeform diagnose` looks for the cause"
        return Judgement(Level.ERROR, f"The model is not within {limit}", _sentence(*notes, cause))
    if metrics.p95.value > metrics.threshold:
        more = "more than one error in twenty is larger"
        said = f"The model is within {limit} on average, but not everywhere"
        return Judgement(Level.WARN, said, _sentence(numbers, more, *notes[1:]))
    if doubts:
        said = f"The model is within {limit} where it was compared, with doubts"
        return Judgement(Level.WARN, said, _sentence(*doubts, numbers, *_notes(metrics)))
    return Judgement(Level.OK, f"The model is within {limit}", _sentence(*notes))


def level_of(errors: Level, n_compared: int, n_measured: int) -> Level:
    """Return the level of ``errors`` of so many compared frames, as `judge` has it where nothing else is in doubt."""
    if not n_compared or n_compared < HALF * n_measured:
        return Level.STALE
    return Level.WARN if errors is Level.OK and n_compared < ENOUGH * n_measured else errors


def doubts_so_far(n_markers: int, most_markers: int, n_compared: int, n_decided: int) -> list[str]:
    """Return what keeps the level of one frame from being OK while a session goes on: it has ``n_markers`` where
    another had ``most_markers``, and so many of the frames that were ``n_decided`` up to it were compared."""
    out = [REFUSED[FEW]] if n_markers < HALF * most_markers else []
    if n_compared < HALF * n_decided:
        out.append(f"only {n_compared} of {n_decided} measured frames were compared so far")
    return out


def _of_surface(metrics: RunMetrics, surface: SurfaceError, limit: str) -> Judgement:
    """Judge by points without ids alone. They can show that a model is wrong; that it is right they cannot, since they
    do not see what slides along the surface."""
    notes = (surface.text, *_doubts(metrics))
    if surface.n_frames < HALF * surface.n_measured:
        few = f"only {surface.n_frames} of {surface.n_measured} measured moments were compared"
        return Judgement(Level.STALE, "There is too little to judge", _sentence(few, *notes))
    if surface.rmse.value > metrics.threshold > surface.rmse.value - 2.0 * np.nan_to_num(surface.registration):
        said = f"Whether the model's surface is within {limit} is less than the registration tells"
        return Judgement(Level.WARN, said, _sentence(*notes))
    if surface.rmse.value > metrics.threshold:
        return Judgement(Level.ERROR, f"The model's surface is not within {limit}", _sentence(*notes))
    said = f"The model's surface is within {limit}, which does not show that its points are"
    return Judgement(Level.WARN, said, _sentence(*notes))


def _too_little(coverage: Coverage | None) -> str:
    """Return why less than half was compared; empty where it was more."""
    if coverage is None:
        return ""
    if coverage.frames_compared < HALF * coverage.frames_measured:
        return _of_frames(coverage)
    if coverage.deepest_compared < HALF * coverage.deepest:
        return f"only {coverage.deepest_compared} of the {coverage.deepest} deepest moments were compared"
    return ""


def _doubts(metrics: RunMetrics) -> list[str]:
    """Return what keeps the verdict from being OK."""
    c = metrics.coverage
    out = list(metrics.doubts)
    if _interpolated_by(metrics) > MATTERS * metrics.threshold:
        bound = f"interpolation between predictions may be wrong by up to {_mm(metrics.interpolation_bound)} mm"
        out.append(f"{bound}: {_more_predictions(c)}")
    if c is None:
        return out
    if c.interrupted:
        out.insert(0, "the run was interrupted")
    if c.frames_compared < ENOUGH * c.frames_measured:
        out.append(_of_frames(c))
    if c.deepest_compared < ENOUGH * c.deepest:
        out.append(f"only {c.deepest_compared} of the {c.deepest} deepest moments were compared")
    if c.presses_compared < c.presses:
        out.append(f"only {c.presses_compared} of {c.presses} presses were compared")
    return out


def _interpolated_by(metrics: RunMetrics) -> float:
    """Return by how much (m) interpolation can have changed the rmse or the 95th percentile; in a run that does not say
    it, by how much in any frame."""
    judged = metrics.interpolation_judged
    return judged if np.isfinite(judged) else metrics.interpolation_bound


def _more_predictions(coverage: Coverage | None) -> str:
    """Say how predictions get closer together: where poses were overtaken, recording more of them helps nothing."""
    if coverage is None or not coverage.skipped:
        return "record the poses more often"
    return (
        f"{coverage.skipped} poses were overtaken by newer ones: run the recording at `--rate max` or with larger "
        "elements, or else record the poses more often"
    )


def _notes(metrics: RunMetrics) -> list[str]:
    """Return what is to be kept in mind."""
    c = metrics.coverage
    out = []
    if c is not None and 0.0 < c.motion_largest < metrics.threshold:
        out.append(
            f"the markers moved by {_mm(c.motion_largest)} mm rms at most, less than the threshold: "
            "not even a model that does not move could be over it"
        )
    if metrics.places > 0.0:
        out.append(f"the stated uncertainty of the marker places alone would leave {_mm(metrics.places)} mm")
    if metrics.noise_floor > metrics.threshold:
        out.append(f"the measuring noise alone, {_mm(metrics.noise_floor)} mm, is over the threshold")
    if c is not None and c.repeated:
        out.append(f"{c.repeated} measured frames were left out: their stamp was there already")
    if c is not None and c.lost:
        out.append(f"{c.lost} messages were lost between the nodes")
    return out


def _numbers(metrics: RunMetrics) -> str:
    interval = ""
    if np.isfinite(metrics.rmse.low):
        interval = f" (95 %, this recording: {_mm(metrics.rmse.low)} to {_mm(metrics.rmse.high)})"
    share = ""
    if np.isfinite(metrics.relative):
        share = f", {100 * metrics.relative:.0f} % of the motion"
    return f"rmse {_mm(metrics.rmse.value)} mm{interval}{share}, 95 % of errors below {_mm(metrics.p95.value)} mm"


def _of_frames(coverage: Coverage) -> str:
    why = _refusals(coverage)
    text = f"only {coverage.frames_compared} of {coverage.frames_measured} measured frames were compared"
    return f"{text} ({why})" if why else text


def _refusals(coverage: Coverage | None) -> str:
    """Return why frames were not compared, most frequent first."""
    if coverage is None:
        return ""
    parts = sorted(coverage.refused.items(), key=lambda item: -item[1])
    said = [f"{n}: {REFUSED.get(reason, reason)}" for reason, n in parts]
    said += [f"mostly since {reason}" for reason in list(coverage.reasons)[:1]]
    return ", ".join([*said, *([f"{coverage.skipped} poses overtaken"] if coverage.skipped else [])])


def _sentence(*parts: str) -> str:
    return "; ".join(parts) + "."


def _mm(value: float) -> str:
    """Say a length in mm; one that two decimals would show as next to nothing has two digits."""
    return f"{value * 1e3:.{decimals(value) if abs(value) * 1e3 < SMALL else 2}f}"


def decimals(*values: float, least: int = 2, most: int = 6) -> int:
    """Return how many decimals (mm) lengths in m need, so that the smallest but zero has two significant ones."""
    sizes = [abs(v) * 1e3 for v in values if np.isfinite(v) and v != 0.0]
    return int(np.clip(1 - np.floor(np.log10(min(sizes))), least, most)) if sizes else least
