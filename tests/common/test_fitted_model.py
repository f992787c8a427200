"""A fitted model is a body: what presses, measures and judges it is the experiment's of the recording."""

from __future__ import annotations

from livedeform.common.experiment.fitted import in_setting_of
from livedeform.common.experiment.yaml_file import load_experiment, save_experiment
from livedeform.common.types import EffectValues

SOFTER = EffectValues("stiffness", {"ratio": 0.8})


def fitted_to(folder, path):
    """Write what a diagnosis of the experiment in ``folder`` leaves behind."""
    save_experiment(load_experiment(folder), path, effects=[SOFTER])
    return load_experiment(path)


def test_a_model_of_the_same_experiment_brings_its_effects(folder, tmp_path):
    fitted = fitted_to(folder, tmp_path / "experiment.fitted.yaml")
    together, said = in_setting_of(fitted, load_experiment(folder))
    assert together.effects == fitted.effects and not said


def test_probe_thresholds_temperature_and_loads_are_those_of_the_recording(folder, change, tmp_path):
    fitted = fitted_to(folder, tmp_path / "experiment.fitted.yaml")
    change("thresholds", {"error": 0.0005})
    change("loads", [])
    change("temperature", {"time": [0, 10], "value": [20, 25], "reference": 20})
    declared = load_experiment(change("probe", {"shape": {"sphere": 0.012}}))
    together, said = in_setting_of(fitted, declared)
    assert together.effects == fitted.effects
    assert (together.probe, together.thresholds, together.loads) == (declared.probe, declared.thresholds, ())
    assert together.temperatures == declared.temperatures
    assert [word for word in ("'probe'", "'thresholds'", "loads none") if any(word in line for line in said)] == [
        "'probe'", "'thresholds'", "loads none",
    ]  # fmt: skip
    save_experiment(together, tmp_path / "again.yaml")  # as a run keeps it, and its nodes read it
    again = load_experiment(tmp_path / "again.yaml")
    assert (again.probe, again.thresholds, again.temperatures) == (
        declared.probe, declared.thresholds, declared.temperatures,
    )  # fmt: skip


def test_another_material_in_the_experiment_is_said(folder, change, tmp_path):
    fitted = fitted_to(folder, tmp_path / "experiment.fitted.yaml")
    phantom = {"model": "neo_hookean", "youngs_modulus": 8000.0, "poisson_ratio": 0.49}
    declared = load_experiment(change("phantom.material", phantom))
    together, (line,) = in_setting_of(fitted, declared)
    assert together.phantom.material.youngs_modulus == 4000.0
    assert "'phantom.material'" in line and "the model's" in line
