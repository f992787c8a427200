"""Read runs as takes of one press: the same experiment and model, another recording."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from livedeform.common.bags.read import read_bag
from livedeform.common.errors import InputError, RecordingError
from livedeform.common.experiment.markers_file import read_markers
from livedeform.common.experiment.yaml_file import FILE_NAME
from livedeform.compare_node.judgement import judge
from livedeform.compare_node.metrics import Level, RunMetrics
from livedeform.compare_node.takes import NUMBERS, Takes, expected, expected_of_markers
from livedeform.comparing.identity import LETTERS, digest_of
from livedeform.outputs import CONFIGURATION, RECORDING

PHANTOM = ("unit", "configuration", "density", "material", "gravity", "scan_gravity", "support", "lesions")
ELSE = ("name", "effects", "loads", "probe")


@dataclass(frozen=True)
class Take:
    """One run's ``numbers`` (rmse, mean, p95; m) and its ``markers``' rms errors (m) by id, of a recording that
    ``source`` tells from others; ``model`` says what was predicted with, and ``mesh`` on which elements: alike for
    alike models. Not ``whole``: a part of the recording was run, the run was interrupted, or most was not compared."""

    name: str
    source: str
    model: str
    numbers: Mapping[str, float]
    markers: Mapping[int, float]
    mesh: str = ""
    whole: bool = True
    path: Path = Path()


def read_take(path: Path, name: str = "") -> Take:
    """Read a run's folder (or its ``run.mcap``); ``InputError`` where it is none, or compared nothing."""
    folder = path.parent if path.name == RECORDING else path
    try:
        document = json.loads((folder / "metrics.json").read_text())
        model = read_model(folder / FILE_NAME)
        numbers = {key: document["error"][key] for key in NUMBERS}
        bag = str(document["bag"])
        written = folder / CONFIGURATION
        options = json.loads(written.read_text())["options"] if written.is_file() else {}
        markers = {m["id"]: m["rmse"] for m in document["markers"]}
    except (OSError, ValueError, KeyError, TypeError, AttributeError, yaml.YAMLError) as error:
        raise InputError("is no run", where=str(path), remedy="name the folder that livedeform run wrote") from error
    if not all(isinstance(v, float) and v > 0.0 for v in numbers.values()):
        raise InputError("compared nothing with a model", where=str(path), remedy="name a run that did")
    part = bool(options.get("start") or options.get("duration"))
    ran = (document.get("recording") or {}).get("whole", not part) and not document.get("interrupted", False)
    return Take(
        name or Path(bag).stem, _source(folder, document, options, whole=ran), model, numbers, markers,
        mesh=str((document.get("mesh") or {}).get("digest", "")),
        whole=ran and document.get("verdict") != str(Level.STALE), path=path,
    )  # fmt: skip


def _source(folder: Path, document: Mapping[str, Any], options: Mapping[str, Any], *, whole: bool) -> str:
    """Return what tells a run's recording from others: its digest, as the run says it or, where an older version
    wrote it, as its recording has it; else where it lay, if that was said in full; else nothing but the run itself."""
    said = (document.get("recording") or {}).get("digest")
    if said:
        return str(said)
    if whole and (folder / RECORDING).is_file():
        with suppress(RecordingError), read_bag(folder / RECORDING) as recorded:
            return digest_of(recorded)
    bag = Path(str(options.get("bag", "")))
    return str(bag.resolve() if bag.is_absolute() else folder.resolve())


def read_repeats(paths: Sequence[Path], bag: Path, digest: str, model: str) -> list[Take]:
    """Read runs of other takes of what is in ``bag``, whose ``digest`` is that; ``InputError`` for one of another
    ``model`` (`read_model`), of a recording that counts already, or of a part of one."""
    known, out = {digest, str(bag.resolve())}, []
    for path in paths:
        take = read_take(path)
        if take.model != model:
            raise _another_model(path)
        if not take.whole:
            remedy = "name runs of whole recordings"
            raise InputError("ran or compared only a part of its recording", where=f"--repeat {path}", remedy=remedy)
        if take.source in known:
            remedy = "name runs of other takes of the same press"
            raise InputError(f"is of a recording that counts already ({bag.name})", where=f"--repeat {path}",
                             remedy=remedy)  # fmt: skip
        known.add(take.source)
        out.append(take)
    return out


def refuse_other_meshes(repeats: Sequence[Take], mesh: str) -> None:
    """Raise ``InputError`` for a take that was predicted on other elements than those of the digest ``mesh``."""
    for take in repeats:
        if take.mesh != mesh:
            raise _another_model(take.path)


def _another_model(path: Path) -> InputError:
    remedy = "name runs of the same experiment with the same model, mesh and markers"
    return InputError("was run with another experiment or model", where=f"--repeat {path}", remedy=remedy)


def read_model(file: Path) -> str:
    """Return what the experiment in a YAML ``file`` predicts with: its words and its markers, whatever their files are
    called, without its recordings and what is only judged by."""
    document = yaml.safe_load(file.read_text())
    phantom = document.get("phantom") or {}
    said = {key: document[key] for key in ELSE if document.get(key)}
    said |= {key: phantom[key] for key in PHANTOM if key in phantom}
    if phantom.get("markers"):
        said["markers"] = _markers_digest(file.parent / str(phantom["markers"]))
    return json.dumps(said, sort_keys=True, default=str)


def _markers_digest(path: Path) -> str:
    """Return a digest of declared markers, their places, sigmas and kinds; empty where the file is no more there."""
    try:
        markers = read_markers(path)
    except InputError:
        return ""
    order = np.argsort(markers.ids)
    parts = (markers.ids[order], markers.points[order], markers.sigmas[order], markers.kinds[order].astype("U8"))
    return hashlib.sha256(b"".join(part.tobytes() for part in parts)).hexdigest()[:LETTERS]


def with_repeats(metrics: RunMetrics, name: str, repeats: Sequence[Take]) -> Takes | None:
    """Put this run of the recording ``name`` and those of other takes together; None where there are none, or where
    this run was interrupted, or most of it was not compared."""
    if not repeats or not metrics.n or judge(metrics).level is Level.STALE:
        return None
    if metrics.coverage is not None and metrics.coverage.interrupted:
        return None
    numbers = {"rmse": metrics.rmse.value, "mean": metrics.mean.value, "p95": metrics.p95.value}
    return together([Take(name, "", "", numbers, {m.id: m.rmse for m in metrics.markers}), *repeats])


def together(takes: Sequence[Take]) -> Takes:
    """Say what takes of one press, with one model, let expect of the next. A take that is there twice counts once."""
    takes = distinct(takes)
    found = {key: expected([[t.numbers[key] for t in takes]])[0] for key in NUMBERS}
    common = sorted(set.intersection(*(set(t.markers) for t in takes)))
    markers = expected_of_markers(np.array([[t.markers[m] for m in common] for t in takes])) if common else []
    return Takes(tuple(t.name for t in takes), found, dict(zip(common, markers, strict=True)))


def distinct(takes: Iterable[Take]) -> list[Take]:
    """Leave out a recording that is there already, or one whose numbers are those of another to the last digit."""
    out: list[Take] = []
    for take in takes:
        if all(take.source != other.source and take.numbers != other.numbers for other in out):
            out.append(take)
    return out


def groups(takes: Iterable[Take]) -> list[list[Take]]:
    """Sort takes of whole recordings by their models: groups of two or more recordings each."""
    by_model: dict[tuple[str, str], list[Take]] = {}
    for take in takes:
        if take.whole:
            by_model.setdefault((take.model, take.mesh), []).append(take)
    found = [distinct(group) for group in by_model.values()]
    return [group for group in found if len(group) > 1]


def sharing(found: Sequence[Sequence[Take]]) -> list[Takes]:
    """Say what each group of takes lets expect of its next, with one relative scatter between takes for all groups."""
    by_number = {key: expected([[t.numbers[key] for t in g] for g in found]) for key in NUMBERS}
    out = []
    for k, group in enumerate(found):
        out.append(replace(together(group), expected={key: by_number[key][k] for key in NUMBERS}))
    return out
