"""``recordings:`` says what acts otherwise in some recordings."""

from __future__ import annotations

import pytest
import yaml

from livedeform.common.errors import InputError
from livedeform.common.experiment.yaml_file import load_experiment, save_experiment
from livedeform.fem_node.declared import declared_physics

WEIGHT = {"name": "weight", "region": {"above_z": 0.049}, "force": [0.0, 0.0, -0.9]}


def test_the_recordings_that_a_line_fits_have_what_it_says(change):
    folder = change(
        "recordings", {"load*": {"loads": [WEIGHT], "release": 0.2}, "load_side": {"gravity": [0, 9.81, 0]}}
    )
    experiment = load_experiment(folder)
    assert experiment.of_recording("rest") is experiment
    heavy, side = experiment.of_recording("load52"), experiment.of_recording("load_side")
    assert declared_physics(heavy).loads[0].force.tolist() == [0.0, 0.0, -0.9]
    assert (heavy.timeline.release, heavy.phantom.gravity) == (0.2, experiment.phantom.gravity)
    assert (side.timeline.release, side.phantom.gravity) == (0.2, (0.0, 9.81, 0.0))
    assert heavy.acting != experiment.acting
    assert "weight 0 0 -0.9 N" in heavy.acting.text and "release 0.2 s" in heavy.acting.text


def test_no_loads_are_none_and_not_those_of_the_experiment(change):
    experiment = load_experiment(change("recordings", {"bare": {"loads": []}}))
    assert experiment.loads and not experiment.of_recording("bare").loads


def test_it_is_kept_where_the_experiment_is_written(change, tmp_path):
    experiment = load_experiment(change("recordings", {"load*": {"loads": [WEIGHT]}}))
    save_experiment(experiment, tmp_path / "experiment.fitted.yaml", effects=[])
    again = load_experiment(tmp_path / "experiment.fitted.yaml")
    assert again.of_recording("load52").acting == experiment.of_recording("load52").acting


@pytest.mark.parametrize(
    ("said", "what"),
    [
        ({"load*": {}}, "nothing is said"),
        ({"load*": {"load": []}}, "unknown key 'load'"),
        ({"a": {"release": -1}}, "greater than or equal"),
    ],
)
def test_what_cannot_be_meant_is_refused(change, said, what):
    folder = change("recordings", said)
    with pytest.raises(InputError, match=what):
        load_experiment(folder)
    assert yaml.safe_load((folder / "experiment.yaml").read_text())["recordings"] == said
