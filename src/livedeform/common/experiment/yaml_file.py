"""Reading and writing ``experiment.yaml``; every mistake in it is one line with the place, the key and the remedy.

``load_experiment`` gives the frozen objects of ``schema``; the geometry is checked by ``plausibility``.
"""

from __future__ import annotations

import datetime
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from livedeform.common.effect import EFFECT_PARAMETERS, EffectInfo
from livedeform.common.errors import InputError
from livedeform.common.experiment.markers_file import no_markers, read_markers
from livedeform.common.experiment.mistakes import first_mistake, in_words, locate
from livedeform.common.experiment.plausibility import check_geometry
from livedeform.common.experiment.schema import (
    Experiment,
    Lesion,
    Load,
    Markers,
    Material,
    Phantom,
    Probe,
    ProbeShape,
    Region,
    Stereo,
    Support,
)
from livedeform.common.experiment.temperature_file import read_temperatures
from livedeform.common.types import EffectValues
from livedeform.common.yaml_text import parse_settings

__all__ = [
    "Experiment",
    "Lesion",
    "Load",
    "Markers",
    "Material",
    "Phantom",
    "Probe",
    "ProbeShape",
    "Region",
    "Stereo",
    "Support",
    "files_of",
    "json_schema",
    "keep_experiment",
    "load_experiment",
    "save_experiment",
]

FILE_NAME = "experiment.yaml"
KEPT_MARKERS = "declared_markers.csv"  # beside the experiment that was run


def load_experiment(
    path: Path | str, *, effects: Mapping[str, EffectInfo] | None = None, geometry: bool = True
) -> Experiment:
    """The experiment in a folder (its ``experiment.yaml``) or a YAML file.

    ``effects`` is a registry to check effect names and parameters against (default: the published names). ``geometry``
    False leaves out the checks that read the surface (closed, markers on it, lesions in it).
    """
    file = Path(path)
    if file.is_dir():
        file = file / FILE_NAME
    node, document = _parse(file)
    known = EFFECT_PARAMETERS
    if effects is not None:
        known = {name: {p.name: p.size for p in info.parameters} for name, info in effects.items()}
    try:
        experiment = Experiment.model_validate(document, context={"folder": file.resolve().parent, "effects": known})
    except ValidationError as error:
        raise _explain(error, file, node) from error
    experiment._path = file.resolve()
    markers = experiment.phantom.markers
    experiment._markers = read_markers(markers) if markers is not None else no_markers()
    if experiment.temperature is not None:
        experiment._temperatures = read_temperatures(experiment.temperature)
    if geometry:
        check_geometry(experiment)
    return experiment


def save_experiment(experiment: Experiment, path: Path | str, *, effects: Sequence[EffectValues] | None = None) -> None:
    """Writes the experiment with other ``effects`` (default: its own) as a YAML file that loads from anywhere.

    The files that it names are written as absolute paths, save those in the new file's own folder.
    """
    file = Path(path)
    changed = experiment if effects is None else experiment.with_effects(effects)
    document = _relative(changed.model_dump(mode="json"), file.resolve().parent)
    document.setdefault("effects", [])
    written = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    beside = experiment.path.parent == file.resolve().parent  # which may be moved, as a draft is
    text = f"# written by livedeform {written} from {experiment.path.name if beside else experiment.path}\n"
    file.write_text(text + yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=120))


def keep_experiment(experiment: Experiment, folder: Path) -> None:
    """Write an experiment to a ``folder`` with its markers beside it: what was run stays, whatever becomes of the file
    that it names."""
    kept = experiment
    if experiment.phantom.markers is not None:
        shutil.copyfile(experiment.phantom.markers, folder / KEPT_MARKERS)
        markers = {"markers": folder.resolve() / KEPT_MARKERS}
        kept = experiment.model_copy(update={"phantom": experiment.phantom.model_copy(update=markers)})
    save_experiment(kept, folder / FILE_NAME)


def files_of(experiment: Experiment) -> list[Path]:
    """The file of the experiment and every file that it names."""
    phantom, stereo, probe = experiment.phantom, experiment.stereo, experiment.probe
    named = [experiment.path, phantom.surface, phantom.mesh, phantom.markers]
    named += [stereo.left, stereo.right] if stereo is not None else []
    named += [probe.shape.mesh] if probe is not None else []
    named += [experiment.temperature.file] if experiment.temperature is not None else []
    return [path for path in named if path is not None]


def json_schema() -> dict[str, Any]:
    """The JSON schema of ``experiment.yaml``, for editors."""
    schema: dict[str, Any] = _on_one_line(Experiment.model_json_schema())
    schema["$schema"] = "https://json-schema.org/draft/2020-12/schema"
    schema["title"] = "livedeform experiment"
    return schema


def _on_one_line(node: Any) -> Any:
    """The schema with every description on one line."""
    if isinstance(node, dict):
        return {
            key: " ".join(value.split()) if key == "description" and isinstance(value, str) else _on_one_line(value)
            for key, value in node.items()
        }
    return [_on_one_line(item) for item in node] if isinstance(node, list) else node


def _relative(document: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Paths that lie directly in ``folder`` become bare names."""
    files = {"phantom": ("surface", "mesh", "markers"), "stereo": ("left", "right"), "temperature": ("file",)}
    for section, keys in files.items():
        for key in keys:
            value = document.get(section, {}).get(key)
            if value is not None and Path(value).parent == folder:
                document[section][key] = Path(value).name
    shape = document.get("probe", {}).get("shape", {})
    if "mesh" in shape and Path(shape["mesh"]).parent == folder:
        shape["mesh"] = Path(shape["mesh"]).name
    return document


def _parse(file: Path) -> tuple[yaml.Node, Any]:
    """The YAML tree with line numbers, and its value."""
    if not file.is_file():
        raise InputError(
            "the experiment does not exist", where=str(file), remedy=f"name a folder that holds {FILE_NAME}"
        )
    try:
        text = file.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        what = f"not valid YAML, {' '.join(str(error).split())}"
        raise InputError(what, where=str(file), remedy="save it as plain UTF-8 text") from error
    node, document = parse_settings(text, str(file))
    if not isinstance(node, yaml.MappingNode) or not isinstance(document, dict):
        raise InputError("is not a mapping of keys", where=str(file), remedy="begin with 'version: 1'")
    return node, document


def _explain(error: ValidationError, file: Path, root: yaml.Node) -> InputError:
    """The first mistake that pydantic found, as one line.

    A union reports a mistake once per alternative; the deepest report is about the alternative that was meant.
    """
    details = max(error.errors(), key=lambda d: len(d["loc"])) if _same_place(error) else first_mistake(error)
    keys, line = locate(root, details["loc"])
    what, remedy = in_words(details, "add it; docs/experiment.md describes every key")
    where = f"{file}:{line}: {keys}" if keys else f"{file}:{line}"
    return InputError(what, where=where, remedy=remedy)


def _same_place(error: ValidationError) -> bool:
    first = error.errors()[0]["loc"]
    return len(first) > 2 and all(d["loc"][:2] == first[:2] for d in error.errors()) and first[:2] == ("stereo", "pose")
