"""The temperature curve of an experiment: in the file or in a file of its own, and every mistake is one line."""

from __future__ import annotations

import pytest

from livedeform.common.errors import InputError
from livedeform.common.experiment.yaml_file import json_schema, load_experiment, save_experiment
from livedeform.fem_node.declared import declared_physics

LISTS = {"time": [0.0, 10.0, 30.0], "value": [20.0, 24.0, 22.0], "reference": 20.0}


def test_lists_and_file_say_the_same(change, tmp_path):
    folder = change("temperature", LISTS)
    curve = declared_physics(load_experiment(folder)).temperature
    assert [curve.above_reference(t) for t in (-5.0, 0.0, 5.0, 20.0, 99.0)] == [0.0, 0.0, 2.0, 3.0, 2.0]
    assert curve.varies
    (folder / "temperature.csv").write_text("# logger 3\ntime,temperature\n0,20\n10,24\n30,22\n")
    folder = change("temperature", {"file": "temperature.csv", "reference": 20.0})
    experiment = load_experiment(folder)
    assert declared_physics(experiment).temperature == curve
    save_experiment(experiment, tmp_path / "elsewhere.yaml")
    assert load_experiment(tmp_path / "elsewhere.yaml").temperatures == experiment.temperatures
    assert "reference" in json_schema()["$defs"]["Temperature"]["description"]


def test_without_one_nothing_is_known(folder):
    assert declared_physics(load_experiment(folder)).temperature is None


@pytest.mark.parametrize(
    ("value", "text", "words"),
    [
        ({**LISTS, "file": "temperature.csv"}, "time,temperature\n0,20\n", "give one of the two"),
        ({"reference": 20.0}, "", "give one of the two"),
        ({**LISTS, "value": [20.0]}, "", "one temperature per time"),
        ({**LISTS, "time": [0.0, 10.0, 10.0]}, "", "do not rise"),
        ({"file": "temperature.csv", "reference": 20.0}, "t,T\n0,20\n", "time,temperature"),
        ({"file": "temperature.csv", "reference": 20.0}, "time,temperature\n0,warm\n", "temperature.csv:2"),
        ({"file": "temperature.csv", "reference": 20.0}, "time,temperature\n5,20\n0,21\n", "do not rise"),
        ({"file": "temperature.csv", "reference": 20.0}, "time,temperature\n", "0 times"),
        ({"file": "temperature.csv"}, "time,temperature\n0,20\n", "reference"),
        ({"file": "temperature.csv", "reference": 20.0}, "time,temperature\n0,nan\n", "temperature.csv:2"),
        ({**LISTS, "reference": 293.0}, "", "all in degrees Celsius, or all in kelvin"),
        ({**LISTS, "value": [293.0, 297.0, 295.0]}, "", "all in degrees Celsius, or all in kelvin"),
        ({**LISTS, "value": [20.0, 297.0, 22.0]}, "", "of 297 is 277 degrees from the reference 20"),
        ({"file": "temperature.csv", "reference": 20.0}, "time,temperature\n0,293\n9,301\n", "or all in kelvin"),
        ({**LISTS, "value": [20.0, -400.0, 22.0]}, "", "-400 degrees Celsius is below absolute zero"),
        ({**LISTS, "reference": -300.0}, "", "-300 degrees Celsius is below absolute zero"),
    ],
)
def test_mistakes(change, folder, value, text, words):
    (folder / "temperature.csv").write_text(text)
    with pytest.raises(InputError) as caught:
        load_experiment(change("temperature", value))
    said = f"{caught.value} {caught.value.remedy}"
    assert words in said and "\n" not in said


@pytest.mark.parametrize(
    ("reference", "value"), [(20.0, [-60.0, 180.0]), (293.0, [213.0, 453.0]), (-190.0, [-190.0, 5.0])]
)
def test_frost_and_an_oven_are_temperatures(change, reference, value):
    section = {"time": [0.0, 600.0], "value": value, "reference": reference}
    assert load_experiment(change("temperature", section)).temperatures == ((0.0, 600.0), tuple(value))
