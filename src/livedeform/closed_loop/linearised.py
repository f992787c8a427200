"""Write what a diagnosis keeps for fits over several recordings: its Jacobians and residuals as normal equations.

With everything that is always uncertain integrated out and the noise whitened (`inference.gauss_newton`), residuals r~
and Jacobian columns J~ enter every further Gaussian fit only through J~^T J~, J~^T r~ and r~^T r~: a few kilobytes that
lose nothing. They are taken where the search ended: about the fitted model for its own effects, whose amplitudes are
then added to the residual again, so that zero is the declared model for all of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from livedeform.closed_loop.candidates import Candidate, Coordinate
from livedeform.closed_loop.evidence.noise import Nuisance, join
from livedeform.closed_loop.inference.forward_selection import Linearised, Selection, entries_of
from livedeform.closed_loop.inference.gauss_newton import Fit, Problem, Ridge, normal_equations
from livedeform.common.experiment.schema import Experiment
from livedeform.common.types import Array


@dataclass(frozen=True)
class KeptEffect:
    """One effect as it is kept: the ``candidate``, numbered as it was fitted, at ``z`` (p,), and the ``columns`` (n, d)
    of its strengths there."""

    candidate: Candidate
    z: Array
    columns: Array

    @property
    def shape(self) -> list[tuple[Coordinate, float]]:
        """Return the coordinates that say what it is the strength of (places, times), with their values."""
        rest = np.setdiff1d(np.arange(len(self.z)), self.candidate.strengths)
        chosen = [(self.candidate.coordinates[int(k)], float(self.z[k])) for k in rest]
        return [(c, c.value(z)) for c, z in chosen]


def write_linearised(selection: Selection, path: Path, experiment: Experiment | None = None) -> bool:
    """Write the normal equations of all candidates' amplitudes, and ``of``, what the ``experiment`` declares of that
    which a ratio is of (NaN: none); False where nothing was linearised."""
    if selection.first is None:
        return False
    said = normal_equations_of(selection)
    names = zip(said["effect"].tolist(), said["parameter"].tolist(), strict=True)
    of = [_declared(experiment, selection.candidates.get(effect), parameter) for effect, parameter in names]
    np.savez_compressed(path, **said, of=np.array(of, float))
    return True


def _declared(experiment: Experiment | None, candidate: Candidate | None, parameter: str) -> float:
    """Return what an experiment declares of that which a candidate's parameter is a ratio to; NaN where it is none."""
    found = [] if candidate is None else [p for p in candidate.info.parameters if p.name == parameter]
    if experiment is None or not found or not found[0].stated_by or found[0].neutral != 1.0:
        return float("nan")
    return float(attrgetter(found[0].stated_by)(experiment))


def normal_equations_of(selection: Selection) -> dict[str, Any]:
    """Return ``G`` (p, p), ``b`` (p,), ``c``, ``n``, and of each column its ``effect``, ``parameter`` and ``index``
    (-1: a scalar), the ``sigma`` of its prior, the ``transform`` and the ``neutral`` value of its coordinate, and
    ``fitted``: whether it was taken about the fitted model. What an effect's columns are the strength of, is in
    ``shape_*``: of each such coordinate the effect, parameter, index, ``value``, transform, sigma of the prior and the
    ``width`` of what is tried, these two in the coordinate."""
    first = selection.first
    assert first is not None  # the caller's
    chosen = _columns(first, _tried(first, selection.candidates))
    fit, last = selection.model.joint, selection.last
    added: list[str] = []
    problem = first.problem
    if fit is not None and last is not None and _is_about_the_fit(selection, fit, first, last):
        problem, own = _about_the_fit(selection, fit, last.problem)
        chosen |= _columns(last, _tried(last, selection.candidates)) | own
        added = list(own)
    stacked = np.column_stack([kept.columns for kept in chosen.values()])
    ridge = normal_equations(problem.marginal, problem.residual, stacked)
    return _document(ridge, problem.rows.n, chosen, added) | _shapes(chosen)


def _is_about_the_fit(selection: Selection, fit: Fit, first: Linearised, last: Linearised) -> bool:
    """Tell whether the fit, the last step and the first one are on the same rows, and every effect has an amplitude."""
    same = len(fit.residual) == last.problem.rows.n == first.problem.rows.n
    return same and all(len(a.candidate.amplitudes) for a in selection.added)


def _about_the_fit(selection: Selection, fit: Fit, problem: Problem) -> tuple[Problem, dict[str, KeptEffect]]:
    """State the problem about the fitted model, with the added effects' amplitudes back in the residual; their shapes
    (places, times) stay uncertain as the prior has them. Also return them, by name."""
    own: dict[str, KeptEffect] = {}
    residual, shapes, at = fit.residual.copy(), [], 0
    for a in selection.added:
        columns = fit.columns[:, at : at + len(a.z)]
        at += len(a.z)
        i = a.candidate.strengths
        own[a.candidate.name] = KeptEffect(a.candidate, a.z, columns[:, i])
        residual += columns[:, i] @ a.z[i]
        rest = np.setdiff1d(np.arange(len(a.z)), i)
        sigma = a.candidate.array("sigma")[rest]
        shapes.append(Nuisance(columns[:, rest] * sigma, tuple(f"{a.candidate.name}[{k}]" for k in rest)))
    nuisance = join([problem.nuisance, *(s for s in shapes if len(s.names))])
    return Problem(problem.rows, residual, problem.covariance, nuisance), own


def _columns(step: Linearised, candidates: Mapping[str, Candidate]) -> dict[str, KeptEffect]:
    """Return each candidate in the shape that explains most, at a step of the search."""
    ridge = normal_equations(step.problem.marginal, step.problem.residual, step.dictionary)
    best: dict[str, tuple[float, KeptEffect]] = {}
    for entry in entries_of(list(candidates.values())):
        fit = ridge.part(entry.columns).solve(entry.sigma, entry.lower, entry.upper)
        if entry.name not in best or fit.gain > best[entry.name][0]:
            c = candidates[entry.name]
            told = np.isin(c.amplitudes, c.strengths) if len(c.amplitudes) else [True]
            columns = step.dictionary[:, np.array(entry.columns)[told]]
            best[entry.name] = fit.gain, KeptEffect(c, np.asarray(c.shapes[entry.shape]), columns)
    return {name: kept for name, (_, kept) in best.items()}


def _tried(step: Linearised, candidates: Mapping[str, Candidate]) -> dict[str, Candidate]:
    """Return the candidates of a step's dictionary, in its order; keys of what is only allowed for have no place."""
    names = {name for name, _, place in step.keys if place is not None}
    return {name: c for name, c in candidates.items() if name in names}


def _document(ridge: Ridge, n: int, chosen: Mapping[str, KeptEffect], added: list[str]) -> dict[str, Any]:
    """Put the arrays of ``n`` data together; an effect that is switched as a whole has a column without a parameter."""
    labels: list[tuple[str, str, int, float, str, float, bool]] = []
    for name, kept in chosen.items():
        amplitudes = [kept.candidate.coordinates[int(i)] for i in kept.candidate.strengths]
        for k in amplitudes:
            labels.append((name, k.parameter, _place(k), k.sigma, k.transform, k.neutral, name in added))
        if not amplitudes:
            labels.append((name, "", -1, 1.0, "linear", 0.0, name in added))
    effect, parameter, index, sigma, transform, neutral, fitted = (np.array(v) for v in zip(*labels, strict=True))
    return {
        "version": 1, "G": ridge.G, "b": ridge.b, "c": ridge.c, "n": n, "effect": effect, "parameter": parameter,
        "index": index, "sigma": sigma, "transform": transform, "neutral": neutral, "fitted": fitted,
    }  # fmt: skip


def _shapes(chosen: Mapping[str, KeptEffect]) -> dict[str, Any]:
    """Put together what the columns are the strength of: a row for each coordinate of each effect's shape."""
    rows = [(name, c, value) for name, kept in chosen.items() for c, value in kept.shape]
    return {
        "shape_effect": np.array([name for name, _, _ in rows], str),
        "shape_parameter": np.array([c.parameter for _, c, _ in rows], str),
        "shape_index": np.array([_place(c) for _, c, _ in rows], int),
        "shape_value": np.array([value for _, _, value in rows], float),
        "shape_transform": np.array([c.transform for _, c, _ in rows], str),
        "shape_sigma": np.array([c.sigma for _, c, _ in rows], float),
        "shape_width": np.array([np.ptp(c.edges) if c.edges else c.upper - c.lower for _, c, _ in rows], float),
    }


def _place(c: Coordinate) -> int:
    return -1 if c.index is None else c.index
