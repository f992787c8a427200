"""Put a fitted body into the experiment that a recording was made in."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from livedeform.common.experiment.schema import Experiment, Markers, Section, Stereo
from livedeform.common.published_effects import PUBLISHED, with_others
from livedeform.common.types import EffectValues

OF_THE_BODY = ("surface", "mesh", "unit", "configuration", "element_size", "density", "material", "scan_gravity",
               "support", "lesions")  # fmt: skip
OF_THE_RECORDING = ("probe", "stereo", "thresholds")
ANOTHER = {"probe": "another probe", "stereo": "other cameras"}  # parts of the recording with effects of their own
SAME_PLACE = 1e-6  # m, by which markers that were written again may differ
MODELS = "this recording is run with the model's"
EXPERIMENTS = "this recording is run with the experiment's"


def in_setting_of(fitted: Experiment, declared: Experiment) -> tuple[Experiment, list[str]]:
    """Return the ``fitted`` model as the experiment ``declared`` presses, measures and judges it, and say a line each
    of what they declare differently.

    Of a fitted model that is the body with its markers and its effects; what acts on it, the probe, the cameras, the
    temperature and the thresholds are the experiment's. Effects of the probe and of the cameras are the model's only
    where these are the same. Files are compared by what is in them, wherever they lie.
    """
    effects, of_effects = _effects(fitted, declared)
    said = [*_differences(fitted, declared), *_of_markers(fitted.markers, declared.markers), *of_effects]
    if fitted.acting != declared.acting:
        said.append(f"is declared under {fitted.acting.text}; this recording is run under {declared.acting.text}")
    of_recording: dict[str, Any] = {name: getattr(declared, name) for name in OF_THE_RECORDING}
    together = fitted.model_copy(update=of_recording | {"recordings": declared.recordings, "effects": effects})
    if declared.temperature is not None:
        together = together.model_copy(update={"temperature": declared.temperature})
        together._temperatures = declared.temperatures
    return together.under(declared.acting), said


def _differences(fitted: Experiment, declared: Experiment) -> Iterator[str]:
    """Yield a line for each part that is not the same in both."""
    for name in OF_THE_RECORDING:
        if _content(getattr(fitted, name)) != _content(getattr(declared, name)):
            yield f"was fitted with another '{name}'; {EXPERIMENTS}"
    for name in OF_THE_BODY:
        if _content(getattr(fitted.phantom, name)) != _content(getattr(declared.phantom, name)):
            yield f"has another 'phantom.{name}' than the experiment; {MODELS}"
    if declared.temperature is None and fitted.temperature is not None:
        yield f"has a 'temperature', and the experiment has none; {MODELS}"
    elif fitted.temperature is not None and _content(fitted.temperature) != _content(declared.temperature):
        yield f"was fitted with another 'temperature'; {EXPERIMENTS}"


def _of_markers(fitted: Markers, declared: Markers) -> Iterator[str]:
    """Yield a line for each way in which the markers differ: their ids, and of those in both what is said of them."""
    alone = [np.setdiff1d(a.ids, b.ids).tolist() for a, b in ((fitted, declared), (declared, fitted))]
    for ids, whose in zip(alone, ("the experiment has not", "only the experiment has"), strict=True):
        if ids:
            which = ", ".join(map(str, ids[:5])) + (" ..." if ids[5:] else "")
            yield f"differs in 'phantom.markers': {len(ids)} that {whose} (id {which}); {MODELS}"
    _, mine, theirs = np.intersect1d(fitted.ids, declared.ids, return_indices=True)
    away = np.linalg.norm(fitted.points[mine] - declared.points[theirs], axis=1)
    if (n := int((away > SAME_PLACE).sum())) > 0:
        where = f"{n} of {len(away)} are up to {1e3 * away.max():.3g} mm from where the experiment has them"
        yield f"differs in 'phantom.markers': {where}; {MODELS}"
    if (n := int((fitted.kinds[mine] != declared.kinds[theirs]).sum())) > 0:
        yield f"differs in 'phantom.markers': {n} of {len(away)} are of another kind; {MODELS}"
    if not np.allclose(fitted.sigmas[mine], declared.sigmas[theirs], atol=0.0, equal_nan=True):
        yield f"differs in 'phantom.markers': sigma is another one; {MODELS}"


def _effects(fitted: Experiment, declared: Experiment) -> tuple[tuple[EffectValues, ...], list[str]]:
    """Return the effects of the model in the experiment, and say where one is not as in both."""
    same = {
        "phantom": True,
        "probe": _content(fitted.probe) == _content(declared.probe),
        "stereo": _content(_cameras(fitted.stereo)) == _content(_cameras(declared.stereo)),
    }
    taken = [effect for effect in fitted.effects if same[_part(effect.name)]]
    own = [effect for effect in declared.effects if _part(effect.name) != "phantom"]
    effects = tuple(with_others(own, taken))
    said = []
    for name in dict.fromkeys(effect.name for effect in (*fitted.effects, *declared.effects)):
        models, experiments, runs = (_values(all_of, name) for all_of in (fitted.effects, declared.effects, effects))
        if models and runs != models:
            which = EXPERIMENTS if runs else "this recording is run without it"
            said.append(f"has the effect '{name}' of {ANOTHER[_part(name)]}; {which}")
        elif models and experiments and models != experiments:
            said.append(f"has other values of the effect '{name}' than the experiment; {MODELS}")
        elif experiments and not models and (same[_part(name)] or not runs):
            which = "with it" if runs else "without it"
            said.append(f"lacks the effect '{name}' that the experiment declares; this recording is run {which}")
    return effects, said


def _part(effect: str) -> str:
    """Name the part of an experiment that an effect belongs to."""
    return PUBLISHED[effect].goes_with if effect in PUBLISHED else "phantom"


def _values(effects: Iterable[EffectValues], name: str) -> list[dict[str, Any]]:
    """Return the values of each effect of a name, by parameter."""
    each = [effect for effect in effects if effect.name == name]
    return [{key: np.asarray(value).tolist() for key, value in effect.values.items()} for effect in each]


def _cameras(stereo: Stereo | None) -> tuple[Any, ...] | None:
    """Return what makes cameras the same ones: how markers are detected in their pictures does not."""
    return None if stereo is None else (stereo.left, stereo.right, stereo.pose)


def _content(value: Any) -> Any:
    """Return what a part of an experiment says, in place of a file's path what is in the file."""
    if isinstance(value, Section):
        return {key: _content(item) for key, item in value} | {"": value._sigmas}
    if isinstance(value, tuple | list):
        return [_content(item) for item in value]
    return _file_content(value) if isinstance(value, Path) else value


def _file_content(path: Path) -> Any:
    """Return the keys of a calibration, however they are written, and a digest of any other file."""
    data = path.read_bytes()
    if path.suffix in (".yaml", ".yml"):
        try:
            return yaml.safe_load(data)
        except (yaml.YAMLError, UnicodeDecodeError):  # as OpenCV writes it
            pass
    return hashlib.sha256(data).hexdigest()
