"""Find what the recordings of a campaign have in common: read, fitted together, and said."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from livedeform.campaign.evidence import KeptEvidence, Label, in_common_units, read_evidence
from livedeform.campaign.jobs import Job
from livedeform.campaign.row import INTERVAL, interval_words
from livedeform.campaign.shared_causes import Pooled, Scope, Shared, pool
from livedeform.closed_loop.candidates import all_effects
from livedeform.common.types import Array
from livedeform.outputs import write_json

SHARED = "shared.json"
KEPT = "diagnosis/linearised.npz"


def pool_jobs(jobs: Sequence[Job], out: Path) -> list[dict[str, Any]]:
    """Fit all recordings that were diagnosed together, write ``out/shared.json`` and return the shared causes."""
    evidence = in_common_units(_read(jobs))
    found = pool(evidence, scopes_of(evidence))
    causes = [document(s, evidence) for s in found.named]
    write_json(out / SHARED, {"version": 1, "shared": causes, "own": _own(found, evidence)})
    return causes


def _read(jobs: Sequence[Job]) -> Iterator[KeptEvidence]:
    """Read what is kept of each take once: copies of it, which have one folder, are no further takes."""
    takes: dict[Path, Job] = {}
    for job in jobs:
        takes.setdefault(job.folder, job)
    for job in takes.values():
        path, recording = job.folder / KEPT, job.recording
        if job.is_done and path.is_file():
            yield read_evidence(path, recording.name, recording.phantom, recording.rig)


def scopes_of(evidence: Sequence[KeptEvidence]) -> list[Scope]:
    """Return what may share a cause: each rig's recordings, then each phantom's. Where a rig has seen one phantom only,
    what measures is the rig's and the rest the phantom's: the recordings cannot tell."""
    rigs = {f"rig {rig}": {e.name for e in evidence if e.rig == rig} for rig in _each(evidence, "rig")}
    phantoms = {f"phantom {p}": {e.name for e in evidence if e.phantom == p} for p in _each(evidence, "phantom")}
    measuring = {name for name, card in all_effects().items() if card.acts_on in ("measuring", "probe")}
    effects = {effect for e in evidence for effect in e.columns}
    out = []
    for groups, others, own in ((rigs, phantoms, measuring), (phantoms, rigs, effects - measuring)):
        for where, names in groups.items():
            alone = names in others.values()
            out.append(Scope(where, frozenset(names), frozenset(effects & own if alone else effects)))
    return out


def _each(evidence: Sequence[KeptEvidence], label: str) -> list[str]:
    return list(dict.fromkeys(getattr(e, label) for e in evidence))


def document(s: Shared, evidence: Sequence[KeptEvidence]) -> dict[str, Any]:
    """A shared cause as it is written: values with 95 % intervals of the common value, the scatter between takes in
    them, and how far single takes are from it; and all of that in words."""
    labels = next(e.labels[s.effect] for e in evidence if e.name in s.scope and s.effect in e.labels)
    sigma = np.sqrt(s.unsure)
    parameters: list[dict[str, Any]] = [
        {
            "name": _name(label),
            "value": label.value(float(s.value[k])),
            "interval_95": _ends(label, s.value[k], sigma[k]),
            "takes_95": _ends(label, s.value[k], s.scatter[k]),
        }
        for k, label in enumerate(labels)
    ]
    return {
        "effect": s.effect,
        "scope": s.where,
        "n_members": len(s.members),
        "n_recordings": len(s.scope),
        "members": sorted(s.members),
        "parameters": parameters,
        "log_evidence": s.gain,
        "said": [f"{p['name']} {interval_words(p['value'], *p['interval_95'])}" for p in parameters],
        "scatter_said": [interval_words(p["value"], *p["takes_95"]).partition(" ")[2] for p in parameters],
    }


def _name(label: Label) -> str:
    return label.parameter if label.index < 0 else f"{label.parameter}[{label.index}]"


def _ends(label: Label, x: float, sigma: float) -> list[float]:
    """Return the ends of a 95 % interval in the parameter's unit, the lower first."""
    return sorted(label.value(float(x + side * INTERVAL * sigma)) for side in (-1.0, 1.0))


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
            out.setdefault(name, []).append(_told(effect, e.labels[effect], *rest.told_with_prior(effect)))
    return out


def _told(effect: str, labels: Sequence[Label], values: Array, variances: Array) -> dict[str, Any]:
    """A cause of a recording's own as it is written."""
    return {
        "effect": effect,
        "parameters": [
            {"name": _name(label), "value": label.value(float(x)), "interval_95": _ends(label, x, float(np.sqrt(v)))}
            for label, x, v in zip(labels, values, variances, strict=True)
        ],
    }
