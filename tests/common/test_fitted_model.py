"""A fitted model is a body: what presses, measures and judges it is the experiment's of the recording."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
import trimesh

from livedeform.common.experiment.fitted import in_setting_of
from livedeform.common.experiment.yaml_file import load_experiment, save_experiment
from livedeform.common.published_effects import PUBLISHED
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


SOME = (
    "stiffness",
    "inclusion",
    "density",
    "base_slip",
    "probe_offset",
    "time_offset",
    "stereo_scale",
    "camera_motion",
)
ELSEWHERE = {"left.yaml": "camera_name: other\n"}  # files that are other ones in another experiment


def copied(folder, to, files=None, **replaced):
    """Copy an experiment with other ``files``, and other texts in its experiment.yaml."""
    shutil.copytree(folder, to)
    text = (to / "experiment.yaml").read_text()
    for old, new in replaced.values():
        assert old in text
        text = text.replace(old, new)
    for name, content in ({} if files is None else files).items():
        (to / name).write_text(content)
    (to / "experiment.yaml").write_text(text)
    return load_experiment(to)


def acting(name, by=1.0):
    """Return an effect with some value of each parameter."""
    parameters = PUBLISHED[name].parameters
    return EffectValues(
        name, {p: np.full(() if v.size is None else abs(v.size), 0.9 * by) for p, v in parameters.items()}
    )


@pytest.mark.parametrize("name", SOME)
def test_effects_of_probe_and_cameras_stay_with_them(folder, tmp_path, name):
    """A scale that was fitted to one rig corrected the lengths that another rig measured."""
    fitted = load_experiment(folder).with_effects([SOFTER, acting(name)] if name != "stiffness" else [acting(name)])
    part = PUBLISHED[name].goes_with
    for changed, other, files in (
        ("probe", {"probe": ("edge_radius: 0.002", "edge_radius: 0.003")}, {}),
        ("stereo", {}, ELSEWHERE),
        ("nothing", {}, {}),
    ):
        declared = copied(folder, tmp_path / changed, files, **other)
        together, said = in_setting_of(fitted, declared)
        stays = part != changed
        assert [e.name for e in together.effects] == [e.name for e in fitted.effects if stays or e.name != name]
        assert any(f"the effect '{name}'" in line and "without it" in line for line in said) != stays
        assert len(said) == (changed != "nothing") + (not stays)
        own = declared.with_effects([acting(name, 1.01)])  # and what the experiment says of its own is not lost
        together, said = in_setting_of(fitted, own)
        values = next(e.values for e in together.effects if e.name == name)
        assert values is (fitted if stays else own).effects[-1].values
        assert any(f"the effect '{name}'" in line for line in said)


@pytest.mark.parametrize("name", SOME)
def test_an_effect_that_only_the_experiment_has_is_kept_or_said_to_be_left_out(folder, tmp_path, name):
    """It was dropped without a line; of the body the model knows better, of probe and cameras the experiment."""
    fitted = load_experiment(folder)
    together, said = in_setting_of(fitted, fitted.with_effects([acting(name)]))
    kept = PUBLISHED[name].goes_with != "phantom"
    assert [e.name for e in together.effects] == [name] * kept
    assert said == [
        f"lacks the effect '{name}' that the experiment declares; this recording is run with{'' if kept else 'out'} it"
    ]


def test_a_copy_of_the_folder_is_the_same_experiment(folder, tmp_path):
    """Paths were compared, and each copy had another 'stereo'."""
    (folder / "left.yaml").write_text("image_width: 640\ncamera_name: left\n")
    again = copied(folder, tmp_path / "copy", {"left.yaml": "{camera_name: left, image_width: 640}\n"})
    assert in_setting_of(load_experiment(folder), again)[1] == []


def test_another_detector_makes_no_other_cameras(folder, tmp_path):
    fitted = load_experiment(folder).with_effects([acting("stereo_scale")])
    declared = copied(
        folder, tmp_path / "aruco", stereo=("right: right.yaml", "right: right.yaml\n  detector: {type: aruco}")
    )
    together, (line,) = in_setting_of(fitted, declared)
    assert together.effects == fitted.effects and "'stereo'" in line


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("1,0.03,0.0,0.02,surface", "1,0.03,0.004,0.02,surface", "1 of 4 are up to 4 mm from where"),
        ("7,0.0,0.0,0.02,internal", "7,0.0,0.0,0.0200001,internal", ""),
        ("7,0.0,0.0,0.02,internal", "7,0.0,0.0,0.02,surface", "1 of 4 are of another kind"),
        ("7,0.0,0.0,0.02,internal\n", "", "1 that the experiment has not (id 7)"),
        ("7,0.0,0.0,0.02,internal\n", "7,0.0,0.0,0.02,internal\n8,0.0,0.0,0.03,internal\n",
         "only the experiment has (id 8)"),
    ],
)  # fmt: skip
def test_other_markers_are_said(folder, tmp_path, old, new, says):
    text = (folder / "markers.csv").read_text()
    assert old in text
    fitted = load_experiment(folder)
    together, said = in_setting_of(fitted, copied(folder, tmp_path / "other", {"markers.csv": text.replace(old, new)}))
    assert together.markers is fitted.markers
    assert [says in line and "'phantom.markers'" in line and "the model's" in line for line in said] == [True] * bool(
        says
    )


def test_another_body_is_said(folder, tmp_path):
    fitted = load_experiment(folder)
    lower = trimesh.load(folder / "block.stl")
    lower.apply_scale((1.0, 1.0, 1.02))
    declared = copied(folder, tmp_path / "lower", mesh=("element_size: 0.01", "element_size: 0.011"))
    lower.export(tmp_path / "lower" / "block.stl")
    said = in_setting_of(fitted, declared)[1]
    assert [name for name in ("surface", "element_size") if any(f"'phantom.{name}'" in line for line in said)] == [
        "surface", "element_size",
    ]  # fmt: skip


def test_another_temperature_is_said(folder, change):
    fitted = load_experiment(change("temperature", {"time": [0, 10], "value": [20, 25], "reference": 20}))
    declared = load_experiment(change("temperature", {"time": [0, 10], "value": [20, 30], "reference": 20}))
    together, (line,) = in_setting_of(fitted, declared)
    assert together.temperatures == declared.temperatures and "'temperature'" in line
