"""Read runs as takes of one press: the same experiment and model, another recording."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from livedeform.common.errors import InputError
from livedeform.compare_node.metrics import RunMetrics
from livedeform.compare_node.takes import NUMBERS, Takes, expected, expected_of_markers
from livedeform.outputs import CONFIGURATION, RECORDING

PHANTOM = ("unit", "configuration", "density", "material", "gravity", "scan_gravity", "support", "lesions")
ELSE = ("name", "effects", "loads", "probe")


@dataclass(frozen=True)
class Take:
    """One run's ``numbers`` (rmse, mean, p95; m) and its ``markers``' rms errors (m) by id, of the recording at
    ``source``; ``model`` says what was predicted with, alike for alike models."""

    name: str
    source: Path
    model: str
    numbers: dict[str, float]
    markers: dict[int, float]


def read_take(path: Path, name: str = "") -> Take:
    """Read a run's folder (or its ``run.mcap``); ``InputError`` where it is none, or compared nothing."""
    folder = path.parent if path.name == RECORDING else path
    try:
        document = json.loads((folder / "metrics.json").read_text())
        model = model_text(yaml.safe_load((folder / "experiment.yaml").read_text()))
        numbers = {key: document["error"][key] for key in NUMBERS}
        bag = str(document["bag"])
        written = folder / CONFIGURATION
        options = json.loads(written.read_text())["options"] if written.is_file() else {}
    except (OSError, ValueError, KeyError, yaml.YAMLError) as error:
        raise InputError("is no run", where=str(path), remedy="name the folder that livedeform run wrote") from error
    if not all(isinstance(v, float) and v > 0.0 for v in numbers.values()):
        raise InputError("compared nothing with a model", where=str(path), remedy="name a run that did")
    markers = {m["id"]: m["rmse"] for m in document["markers"]}
    source = Path(str(options.get("bag", bag))).resolve()
    return Take(name or Path(bag).stem, source, model, numbers, markers)


def read_repeats(paths: Sequence[Path], bag: Path, experiment: Path) -> list[Take]:
    """Read runs of other takes of what is in ``bag``; ``InputError`` for one of another model than that of
    ``experiment`` (a YAML file), or of a recording that counts already."""
    model, known, out = model_text(yaml.safe_load(experiment.read_text())), {bag.resolve()}, []
    for path in paths:
        take = read_take(path)
        if take.model != model:
            remedy = "name runs of the same experiment with the same model"
            raise InputError("was run with another experiment or model", where=f"--repeat {path}", remedy=remedy)
        if take.source in known:
            remedy = "name runs of other takes of the same press"
            raise InputError(f"is of a recording that counts already ({bag.name})", where=f"--repeat {path}",
                             remedy=remedy)  # fmt: skip
        known.add(take.source)
        out.append(take)
    return out


def model_text(document: dict[str, Any]) -> str:
    """Return what an experiment predicts with, without its files, its recordings and what is only judged by."""
    phantom = document.get("phantom") or {}
    said = {key: document[key] for key in ELSE if document.get(key)}
    return json.dumps(said | {key: phantom[key] for key in PHANTOM if key in phantom}, sort_keys=True, default=str)


def with_repeats(metrics: RunMetrics, name: str, repeats: Sequence[Take]) -> Takes | None:
    """Put this run of the recording ``name`` and those of other takes together; None where there are none."""
    if not repeats or not metrics.n:
        return None
    numbers = {"rmse": metrics.rmse.value, "mean": metrics.mean.value, "p95": metrics.p95.value}
    return together([Take(name, Path(), "", numbers, {m.id: m.rmse for m in metrics.markers}), *repeats])


def together(takes: Sequence[Take]) -> Takes:
    """Say what takes of one press, with one model, let expect of the next. A take that is there twice counts once."""
    takes = [t for k, t in enumerate(takes) if all(t.numbers != other.numbers for other in takes[:k])]
    found = {key: expected([[t.numbers[key] for t in takes]])[0] for key in NUMBERS}
    common = sorted(set.intersection(*(set(t.markers) for t in takes)))
    markers = expected_of_markers(np.array([[t.markers[m] for m in common] for t in takes])) if common else []
    return Takes(tuple(t.name for t in takes), found, dict(zip(common, markers, strict=True)))


def groups(takes: Iterable[Take]) -> list[list[Take]]:
    """Sort takes by their models: groups of two or more recordings each."""
    by_model: dict[str, list[Take]] = {}
    for take in takes:
        known = by_model.setdefault(take.model, [])
        if all(take.source != other.source for other in known):
            known.append(take)
    return [group for group in by_model.values() if len(group) > 1]


def sharing(found: Sequence[Sequence[Take]]) -> list[Takes]:
    """Say what each group of takes lets expect of its next, with one relative scatter between takes for all groups."""
    by_number = {key: expected([[t.numbers[key] for t in g] for g in found]) for key in NUMBERS}
    out = []
    for k, group in enumerate(found):
        out.append(replace(together(group), expected={key: by_number[key][k] for key in NUMBERS}))
    return out
