"""``recordings:`` says what acts otherwise in some recordings."""

from __future__ import annotations

import numpy as np
import pytest
import yaml

from livedeform.common.bags.recording_writer import RecordingWriter
from livedeform.common.bags.write import BagWriter
from livedeform.common.checks.recorded import load_checked
from livedeform.common.errors import InputError
from livedeform.common.experiment.yaml_file import load_experiment, save_experiment
from livedeform.common.types import MarkerFrame, Pose
from livedeform.fem_node.declared import declared_physics
from livedeform.inspection import inspect

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


def test_a_standard_deviation_goes_with_what_is_said(change):
    change("timeline", {"release": 0.1, "release_sigma": 0.005})
    said = {"a": {"release": 0.2, "release_sigma": 0.02}, "b": {"release": 0.3}, "c": {"loads": []}}
    experiment = load_experiment(change("recordings", said))
    sigmas = [experiment.of_recording(name).sigma("timeline.release") for name in "abcd"]
    assert sigmas == [0.02, 0.005, 0.005, 0.005] and experiment.sigma("timeline.release") == 0.005


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
        ({"bags/a": {"release": 0.1}}, "'bags/a' is a path"),
    ],
)
def test_what_cannot_be_meant_is_refused(change, said, what):
    folder = change("recordings", said)
    with pytest.raises(InputError, match=what):
        load_experiment(folder)
    assert yaml.safe_load((folder / "experiment.yaml").read_text())["recordings"] == said


@pytest.mark.parametrize("line", ["a", "a.mcap", "?", "*.mcap"])
def test_a_line_may_name_the_file_or_the_recording(change, line):
    side = load_experiment(change("recordings", {line: {"gravity": [9.81, 0, 0]}})).of_recording("a")
    assert side.phantom.gravity == (9.81, 0.0, 0.0)


@pytest.mark.parametrize(("line", "level"), [("monday", "NOTE"), ("mon*.mcap", "NOTE"), ("mondya", "WARN")])
def test_what_is_declared_of_a_recording_is_told_and_so_is_a_line_that_misses_it(change, tmp_path, line, level):
    bag, place = tmp_path / "monday.mcap", np.array([[0.03, 0.0, 0.02]])
    with BagWriter(bag) as writer:
        recording = RecordingWriter(writer)
        for stamp in range(1_000_000_000, 3_000_000_000, 100_000_000):
            covariance, unknown = np.full((1, 3, 3), np.nan), np.full(1, np.nan)
            recording.marker_frame(MarkerFrame(stamp, np.array([1], np.uint32), place, covariance, unknown))
            recording.pose(Pose(stamp, np.array([0.0, 0.0, 0.2]), np.array([1.0, 0.0, 0.0, 0.0])))
    folder = change("recordings", {line: {"gravity": [9.81, 0, 0]}})
    said = [f for f in inspect(bag, folder).findings if "monday" in f.text]
    assert [f.level for f in said] == [level]
    assert ("gravity 9.81 0 0 m/s2" if level == "NOTE" else f"no line of recordings ({line})") in said[0].text
    loaded = load_checked([bag], [], load_experiment(folder))[0]  # of a diagnosis
    assert any("no line of recordings" in text for text in loaded.warnings) == (level == "WARN")
