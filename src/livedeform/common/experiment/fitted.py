"""Put a fitted body into the experiment that a recording was made in."""

from __future__ import annotations

from collections.abc import Iterator

from livedeform.common.experiment.schema import Experiment

OF_THE_BODY = ("unit", "configuration", "density", "material", "scan_gravity", "support", "lesions")
OF_THE_RECORDING = ("probe", "stereo", "thresholds")


def in_setting_of(fitted: Experiment, declared: Experiment) -> tuple[Experiment, list[str]]:
    """Return the ``fitted`` model as the experiment ``declared`` presses, measures and judges it, and say a line each
    of what they declare differently.

    Of a fitted model that is the body, with its effects; what acts on it, the probe, the cameras, the temperature and
    the thresholds are the experiment's.
    """
    said = list(_differences(fitted, declared))
    if fitted.acting != declared.acting:
        said.append(f"is declared under {fitted.acting.text}; this recording is run under {declared.acting.text}")
    of_recording = {name: getattr(declared, name) for name in OF_THE_RECORDING}
    of_recording["recordings"] = declared.recordings
    together = fitted.model_copy(update=of_recording)
    if declared.temperature is not None:
        together = together.model_copy(update={"temperature": declared.temperature})
        together._temperatures = declared.temperatures
    return together.under(declared.acting), said


def _differences(fitted: Experiment, declared: Experiment) -> Iterator[str]:
    """Yield a line for each part that is not the same in both."""
    for name in OF_THE_RECORDING:
        if getattr(fitted, name) != getattr(declared, name):
            yield f"was fitted with another '{name}'; this recording is run with the experiment's"
    for name in OF_THE_BODY:
        if getattr(fitted.phantom, name) != getattr(declared.phantom, name):
            yield f"has another 'phantom.{name}' than the experiment; this recording is run with the model's"
    if declared.temperature is None and fitted.temperature is not None:
        yield "has a 'temperature', and the experiment has none; this recording is run with the model's"
