"""Evidence that the report of a diagnosis shows beside `diagnosis.json`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from livedeform.closed_loop.evidence.measuring_noise import NoiseReport
from livedeform.common.effect import EffectInfo
from livedeform.common.types import Array, Ids
from livedeform.compare_node.residual import Residual
from livedeform.report.run.evidence import SurfaceMesh


@dataclass(frozen=True)
class Compared:
    """One recording: its residuals with the declared and the fitted model, moment by moment the same markers, and the
    time (k,) s that each moment stands for; ``held_out``: nothing was fitted to it."""

    name: str
    held_out: bool
    start_ns: int
    before: Sequence[Residual]
    after: Sequence[Residual]
    weights: Array


@dataclass(frozen=True)
class NoiseRow:
    """The noise of one recording's markers: ``report`` says its size, correlation and where they come from; ``used`` m,
    rms of a single frame as the diagnosis takes it; ``mesh`` m, rms that the model's elements are allowed to get wrong
    there."""

    name: str
    held_out: bool
    report: NoiseReport
    used: float
    mesh: float


@dataclass(frozen=True)
class FitRow:
    """One fitted number, in ``unit``: value, one sigma, start of the search, bounds, whether it sits on one, and the
    ends of its interval of 95 % (NaN: none is stated)."""

    name: str
    unit: str
    value: float
    sigma: float
    start: float
    lower: float
    upper: float
    at_bound: bool
    interval: tuple[float, float] = (float("nan"), float("nan"))


@dataclass(frozen=True)
class RestingBody:
    """The body at rest: its surface, and the places (m, 3) m of the markers ``ids`` (m,)."""

    shape: SurfaceMesh
    ids: Ids
    places: Array


@dataclass(frozen=True)
class DiagnosisEvidence:
    """Hold what the page shows beside ``diagnosis.json``.

    ``infos`` are the catalogue's cards of the effects; ``correlations`` maps pairs of fitted names to their
    correlation; ``body`` is the surface on which the errors are drawn; ``facts`` (what,
    value) rows on what was fitted, held out, counted and how long it took; ``experiments`` says what would tell
    candidates apart; ``noise`` is of each recording.
    """

    name: str
    recordings: Sequence[Compared]
    infos: Mapping[str, EffectInfo]
    fit: Sequence[FitRow] = ()
    correlations: Mapping[tuple[str, str], float] | None = None
    body: RestingBody | None = None
    facts: Sequence[tuple[str, str]] = ()
    experiments: Sequence[str] = ()
    noise: Sequence[NoiseRow] = ()
    configuration: str = ""
