"""Find what the recordings of a campaign have in common: read, fitted together, and said."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from livedeform.campaign.evidence import (
    UNREADABLE,
    KeptEvidence,
    KeptShape,
    Label,
    effect_of,
    in_common_units,
    read_evidence,
)
from livedeform.campaign.jobs import Job
from livedeform.campaign.row import INTERVAL, interval_words, unit_words
from livedeform.campaign.shared_causes import Pooled, Scope, Shared, pool
from livedeform.closed_loop.candidates import all_effects
from livedeform.common.types import Array
from livedeform.outputs import write_json

SHARED = "shared.json"
KEPT = "diagnosis/linearised.npz"


@dataclass(frozen=True)
class PooledCampaign:
    """The ``shared`` causes as they are written, and why recordings are ``left_out``, by name."""

    shared: list[dict[str, Any]]
    left_out: dict[str, str]


def pool_jobs(jobs: Sequence[Job], out: Path) -> PooledCampaign:
    """Fit all recordings that were diagnosed together, and write ``out/shared.json``."""
    kept, left_out = _read(jobs)
    evidence = in_common_units(kept)
    found = pool(evidence, scopes_of(evidence))
    causes = [document(s, evidence) for s in found.named]
    own = _own(found, evidence)
    write_json(out / SHARED, {"version": 1, "shared": causes, "own": own, "left_out": left_out})
    return PooledCampaign(causes, left_out)


def _read(jobs: Sequence[Job]) -> tuple[list[KeptEvidence], dict[str, str]]:
    """Read what is kept of each take once: copies of it, which have one folder, are no further takes. Also say of which
    it cannot be read."""
    kept: list[KeptEvidence] = []
    left_out: dict[str, str] = {}
    takes: dict[Path, Job] = {}
    for job in jobs:
        takes.setdefault(job.folder, job)
    for job in takes.values():
        path, recording = job.folder / KEPT, job.recording
        if not job.is_done or not path.is_file():
            continue
        try:
            kept.append(read_evidence(path, recording.name, recording.phantom, recording.rig))
        except UNREADABLE as error:
            why = " ".join(str(error).split())
            left_out[recording.name] = (
                f"{path}: cannot be read ({why}); delete its folder {job.folder}, and start again"
            )
    return kept, left_out


def scopes_of(evidence: Sequence[KeptEvidence]) -> list[Scope]:
    """Return what may share a cause: each rig's recordings, then each phantom's. Where a rig has seen one phantom only,
    what measures is the rig's and the rest the phantom's: the recordings cannot tell."""
    rigs = {f"rig {rig}": {e.name for e in evidence if e.rig == rig} for rig in _each(evidence, "rig")}
    phantoms = {f"phantom {p}": {e.name for e in evidence if e.phantom == p} for p in _each(evidence, "phantom")}
    measuring = {name for name, card in all_effects().items() if card.acts_on in ("measuring", "probe")}
    out = []
    for groups, others, is_rigs in ((rigs, phantoms, True), (phantoms, rigs, False)):
        for where, names in groups.items():
            count = Counter(effect for e in evidence if e.name in names for effect in e.columns)
            effects = {effect for effect, n in count.items() if n > 1}
            if names in others.values():
                effects = {effect for effect in effects if (effect_of(effect) in measuring) == is_rigs}
            out.append(Scope(where, frozenset(names), frozenset(effects)))
    return out


def _each(evidence: Sequence[KeptEvidence], label: str) -> list[str]:
    return list(dict.fromkeys(getattr(e, label) for e in evidence))


def document(s: Shared, evidence: Sequence[KeptEvidence]) -> dict[str, Any]:
    """A shared cause as it is written: values with 95 % intervals of the common value, the scatter between takes in
    them, and of another take's; and all of that in words."""
    labels = next(e.labels[s.effect] for e in evidence if e.name in s.scope and s.effect in e.labels)
    sigma = np.sqrt(s.unsure)
    parameters: list[dict[str, Any]] = [
        {
            "name": _name(label),
            "value": label.value(float(s.value[k])),
            "interval_95": _ends(label, s.value[k], INTERVAL * sigma[k]),
            "takes_95": _ends(label, s.value[k], s.ahead[k]),
            "of": label.of,
        }
        for k, label in enumerate(labels)
    ]
    unit = partial(_unit, effect_of(s.effect))
    at = _usual_shape([e.shapes.get(s.effect, ()) for e in evidence if e.name in s.members])
    return {
        "effect": effect_of(s.effect),
        "scope": s.where,
        "n_members": len(s.members),
        "n_recordings": len(s.scope),
        "members": sorted(s.members),
        "parameters": parameters,
        "at": at,
        "log_evidence": s.gain,
        "said": [
            *(f"{p['name']} {interval_words(p['value'], *p['interval_95'])}{unit(p)}" for p in parameters),
            *(f"at {p['name']} {p['value']:.3g}{unit(p)}" for p in at),
        ],
        "scatter_said": [interval_words(p["value"], *p["takes_95"]).partition(" ")[2] + unit(p) for p in parameters],
    }


def _usual_shape(shapes: Sequence[Sequence[KeptShape]]) -> list[dict[str, Any]]:
    """Return what amplitudes are the strength of, in the middle of the recordings that have it."""
    middle = [(each[0], float(np.median([shape.value for shape in each]))) for each in zip(*shapes, strict=True)]
    return [{"name": _name(shape), "value": value} for shape, value in middle]


def _unit(effect: str, parameter: Mapping[str, Any]) -> str:
    """Return the unit of a parameter of an effect as it stands behind its value, or what it is a ratio to."""
    of = f" of {parameter['of']:g}" if np.isfinite(parameter.get("of", np.nan)) else ""
    return unit_words(effect, str(parameter["name"]).partition("[")[0]) + of


def _name(label: Label | KeptShape) -> str:
    if not label.parameter:  # an effect that is switched as a whole: how much of it there is
        return "amount"
    return label.parameter if label.index < 0 else f"{label.parameter}[{label.index}]"


def _ends(label: Label, x: float, half: float) -> list[float]:
    """Return the ends of an interval of ``half`` a width on either side in the parameter's unit, the lower first."""
    return sorted(label.value(float(x + side * half)) for side in (-1.0, 1.0))


def _own(found: Pooled, evidence: Sequence[KeptEvidence]) -> Mapping[str, list[dict[str, Any]]]:
    """The causes of each recording's own, with the values that it tells beside all others that it has."""
    of_name = {e.name: e for e in evidence}
    out: dict[str, list[dict[str, Any]]] = {}
    for name, x in found.explanations.items():
        e = of_name[name]
        for effect in x.own:
            rest = e
            for other in x.own:
                rest = rest if other == effect else rest.given(other)
            for k in x.belongs:
                s = found.shared[k]
                rest = rest.given(s.effect, s.value, s.spread)
            told = _told(effect, e.labels[effect], *rest.told_with_prior(effect))
            out.setdefault(name, []).append(told | {"at": _usual_shape([e.shapes.get(effect, ())])})
    return out


def _told(effect: str, labels: Sequence[Label], values: Array, variances: Array) -> dict[str, Any]:
    """A cause of a recording's own as it is written."""
    return {
        "effect": effect_of(effect),
        "parameters": [
            {
                "name": _name(label),
                "value": label.value(float(x)),
                "interval_95": _ends(label, x, INTERVAL * sigma),
                "of": label.of,
            }
            for label, x, sigma in zip(labels, values, np.sqrt(variances), strict=True)
        ],
    }
