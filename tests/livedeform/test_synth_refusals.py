"""Scenarios that make no sense: one line that says what, where and what to do, before anything is solved."""

from __future__ import annotations

import copy
import inspect
import json
import math
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmarks.blind import cases

from livedeform.cli import run as command_line
from livedeform.common.errors import InputError
from livedeform.common.experiment.yaml_file import load_experiment
from livedeform.synthetic import render, scenario
from livedeform.synthetic.body_markers import aimed_rig, place_markers
from livedeform.synthetic.checks import effect_values, scenario_schema
from livedeform.synthetic.rig import stereo_rig
from livedeform.synthetic.solved_motion import build_world, refuse_misdeclared
from livedeform.synthetic.trajectory import Press
from livedeform.synthetic.true_effects import EFFECTS, OUTSIDE

INCLUSION = {"name": "inclusion", "centre": [0.0, 0.01, 0.025], "radius": 0.006, "ratio": 3.0}
WHOLE: dict[str, Any] = {  # every section is there, with every kind of value
    "version": 1,
    "name": "whole",
    "body": {"shape": "block", "size": [0.05, 0.05, 0.03], "elements": [3, 3, 2], "focus": 1.2},
    "declared": {
        "youngs_modulus": 4000.0,
        "poisson_ratio": 0.49,
        "density": 1000.0,
        "configuration": "unloaded",
        "element_size": 0.012,
        "ship_mesh": False,
        "sigmas": {"youngs_modulus": 200.0, "density": 5.0},
        "effects": [{"name": "viscoelasticity", "g": [0.2], "tau": [1.0]}, {"name": "base_slip", "stiffness": 3e5}],
    },
    "probe": {"shape": {"box": [0.02, 0.01, 0.04]}, "edge_radius": 0.002, "friction": 0.1},
    "markers": {"surface": 12, "internal": 2, "support": 4},
    "lesions": [{"name": "t1", "centre": [0.0, 0.0, 0.02], "diameter": 0.01}],
    "temperature": {"time": [0.0, 10.0], "value": [20.0, 30.0], "reference": 20.0},
    "measuring": {"kind": "markers", "rate": 10.0, "noise_px": 0.08, "dropout": 0.0, "jitter": 0.0},
    "rig": {"distance": 0.4, "elevation_deg": 50.0, "baseline": 0.1, "f": 900.0, "size": [640, 480], "k": [0.1, 0.0]},
    "pose_rate": 20.0,
    "wrench": {"noise": 0.005},
    "gap": 30.0,
    "path_step": 0.002,
    "time_step": 0.5,
    "truth": [INCLUSION, {"name": "viscoelasticity", "g": [0.2, 0.1], "tau": [1.0, 5.0]}],
    "paint": {"noise": 0.8, "radius": 0.002},
    "threshold": 0.005,
    "recordings": {
        "a": [{"at": [0.0, 0.0], "depth": 0.003, "hold": 0.5, "stroke": [0.002, 0.0], "tilt": [0.1, 0.0]}],
        "b c": [{"at": [0.004, 0.0], "depth": 0.002, "speed": 0.01, "retreat_speed": 0.02, "pause": 0.5}],
    },
}


def places(value: Any, path: tuple = ()) -> Iterator[tuple[tuple, Any]]:
    """Return every part of a scenario with the keys that lead to it."""
    yield path, value
    pairs = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, one in pairs:
        yield from places(one, (*path, key))


def changed(path: tuple, value: Any) -> dict[str, Any]:
    """Return the whole scenario with another value at a place."""
    spec: Any = copy.deepcopy(WHOLE)
    here = spec
    for key in path[:-1]:
        here = here[key]
    here[path[-1]] = value
    return dict(spec)


def refusal(spec: Any, seed: int = 0) -> str:
    """Return the line by which a scenario is refused before its body is solved; anything else is no InputError."""
    with pytest.raises(InputError) as caught:
        scenario.generator(seed)
        full = scenario.load(spec)
        refuse_misdeclared(full, build_world(full)[0].mesh)
    said = str(caught.value)
    assert "\n" not in said and caught.value.where and caught.value.remedy
    return said


def test_a_scenario_is_used_as_it_is_given() -> None:
    spec = copy.deepcopy(WHOLE)
    full = scenario.load(spec)
    assert json.dumps(full, sort_keys=True) == json.dumps(WHOLE, sort_keys=True) and spec == WHOLE
    build_world(full)


@pytest.mark.parametrize("path", [p for p, v in places(WHOLE) if isinstance(v, dict) and p != ("recordings",)], ids=str)
def test_a_key_that_nobody_knows_is_named_wherever_it_stands(path: tuple) -> None:
    said = refusal(changed((*path, "colour"), 1.0))
    assert "colour" in said or path == ("probe", "shape")  # two shapes, then
    for key in path:
        assert str(key) in said or key in (0, 1)


@pytest.mark.parametrize("wrong", [None, "much", math.nan, math.inf, True, [], {}], ids=repr)
def test_no_number_can_be_something_else(wrong: Any) -> None:
    """Every number of a scenario in turn: each is refused in one line, and names the section."""
    numbers = [p for p, v in places(WHOLE) if isinstance(v, int | float) and not isinstance(v, bool)]
    assert len(numbers) > 50  # measured 74
    for path in numbers:
        said = refusal(changed(path, wrong))
        assert str(path[0]) in said, (path, said)


@pytest.mark.parametrize("section", [k for k in WHOLE if k not in ("temperature", "wrench")])
@pytest.mark.parametrize("wrong", [None, 5, "much"], ids=repr)
def test_no_section_can_be_something_else(section: str, wrong: Any) -> None:
    if (wrong == 5 and section in ("pose_rate", "gap", "time_step")) or (wrong == "much" and section == "name"):
        return
    said = refusal(changed((section,), wrong))
    assert section in said


LENGTHS = ["body.size.0", "declared.element_size", "probe.shape.box.0", "probe.edge_radius", "lesions.0.centre.2",
           "lesions.0.diameter", "rig.distance", "rig.baseline", "path_step", "threshold", "truth.0.centre.2",
           "truth.0.radius", "recordings.a.0.depth"]  # fmt: skip


@pytest.mark.parametrize("key", LENGTHS)
def test_lengths_in_millimetres_are_refused(key: str) -> None:
    path = tuple(int(k) if k.isdigit() else k for k in key.split("."))
    value = dict((p, v) for p, v in places(WHOLE))[path]
    assert path[0] in refusal(changed(path, 1000.0 * value))


IMPOSSIBLE = {  # where: a value, and a word of the line
    "version": (7, "version"),
    "declared.youngs_modulus": (-1.0, "youngs_modulus"),
    "declared.poisson_ratio": (0.5, "below 0.5"),
    "declared.density": (0.0, "density"),
    "declared.configuration": ("loadad", "configuration"),
    "declared.sigmas.density": (0.0, "density"),
    "body.shape": ("cube", "shape"),
    "body.elements": ([0, 3, 2], "elements"),
    "markers.support": (9, "support"),
    "markers.surface": (-1, "surface"),
    "measuring.kind": ("markres", "kind"),
    "measuring.rate": (0, "rate"),
    "measuring.dropout": (1.0, "dropout"),
    "rig.elevation_deg": (90.0, "elevation_deg"),
    "pose_rate": (-5.0, "pose_rate"),
    "temperature.time": ([10.0, 0.0], "do not rise"),
    "temperature.value": ([1.0], "temperatures"),
    "recordings.a": ([], "recordings.a"),
    "recordings.a.0.speed": (0.0, "speed"),
    "recordings.a.0.hold": (-1.0, "hold"),
    "truth.0.ratio": (-1.0, "ratio"),
    "truth.0.name": ("gremlins", "gremlins"),
    "truth.0.edge": ("blunt", "blunt"),
    "truth.1.g": ([0.8, 0.7], "add up"),
    "truth.1.tau": ([1.0], "each term"),
    "paint.blur_px": (0.0, "blur_px"),
}


@pytest.mark.parametrize("key", IMPOSSIBLE)
def test_what_cannot_be_is_refused(key: str) -> None:
    value, word = IMPOSSIBLE[key]
    assert word in refusal(changed(tuple(int(k) if k.isdigit() else k for k in key.split(".")), value))


@pytest.mark.parametrize(
    "name",
    ["../../esc", "a/b", "/tmp/esc", "..", ".", "", ".hidden", "a\\b", "c:d", "a\nb", "a\0b", "ü" * 101, 1, None],
)
def test_a_recording_has_a_plain_name(name: Any, tmp_path: Path) -> None:
    """What is made lies in --out: its bag and its truth are named after the recording."""
    said = refusal(changed(("recordings",), {name: WHOLE["recordings"]["a"]}))
    assert said.startswith("whole: recordings")
    with pytest.raises(InputError):
        scenario.make(changed(("recordings",), {name: WHOLE["recordings"]["a"]}), tmp_path / "in" / "out")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["a", "b c", "take-01", "2026.03.01", "Übung", "a..b"])
def test_usual_names_of_recordings_stay(name: str) -> None:
    scenario.load(changed(("recordings",), {name: WHOLE["recordings"]["a"]}))


@pytest.mark.parametrize("missing", ["at", "depth"])
def test_a_press_says_what_it_lacks(missing: str) -> None:
    press = {key: value for key, value in WHOLE["recordings"]["a"][0].items() if key != missing}
    assert f"recordings.a.0: key '{missing}' is missing" in refusal(changed(("recordings", "a"), [press]))


@pytest.mark.parametrize(("surface", "support"), [(0, 0), (0, 2), (1, 0), (2, 0), (1, 1)])
def test_too_few_markers_to_register_by_are_refused(surface: int, support: int) -> None:
    assert "registered by three" in refusal(changed(("markers",), {"surface": surface, "support": support}))


@pytest.mark.parametrize("name", [*EFFECTS, *OUTSIDE])
def test_every_effect_of_a_truth_is_checked(name: str) -> None:
    """An effect with its values is right; with one mistyped, missing, of another size or twice it is not."""
    right = cases.sized(name, 1.0)
    spec = {**WHOLE, "body": cases.STANDARD["body"], "truth": [right]}
    build_world(scenario.load(spec))
    given = [key for key in right if key != "name"]
    for key in given:
        without = {k: v for k, v in right.items() if k != key}
        assert f"unknown key '{key}x'" in refusal({**spec, "truth": [{**without, f"{key}x": right[key]}]})
        assert key in refusal({**spec, "truth": [{**right, key: [[right[key]]]}]})
        assert key in refusal({**spec, "truth": [{**right, key: math.inf}]})
        if name != "swelling":
            assert f"needs the value '{key}'" in refusal({**spec, "truth": [without]})
    if name not in ("inclusion", "skin", "cavity"):
        assert "2 times" in refusal({**spec, "truth": [right, right]})


def test_a_body_that_has_swollen_need_not_go_on_but_does_one() -> None:
    for value in ("rate", "offset"):
        build_world(scenario.load({**WHOLE, "truth": [{"name": "swelling", value: 1e-4}]}))
    assert "needs the value" in refusal({**WHOLE, "truth": [{"name": "swelling"}]})


@pytest.mark.parametrize(
    "effect",
    [
        {**INCLUSION, "centre": [0.0, 10.0, 25.0]},
        {**cases.sized("cavity", 1.0), "centre": [0.1, 0.0, 0.02]},
        {**cases.sized("tether", 1.0), "place": [0.0, 0.0, 0.06]},
        {"name": "skin", "thickness": 2.0, "ratio": 2.0},
    ],
    ids=lambda e: e["name"],
)
def test_an_effect_that_is_nowhere_in_the_body_is_refused(effect: dict) -> None:
    assert effect["name"] in refusal({**WHOLE, "truth": [effect]})


def test_the_schema_knows_what_is_used() -> None:
    """No field of a press, of the paint or of the cameras is missing in the schema, and none is there that is not."""
    schema = scenario_schema
    assert set(schema.OnePress.model_fields) == {f.name for f in fields(Press)}
    assert set(schema.Painted.model_fields) == {f.name for f in fields(render.Paint)}
    assert set(schema.CameraPair.model_fields) == set(inspect.signature(stereo_rig).parameters) - {"target"}
    assert set(schema.Scenario.model_fields) == {*scenario.DEFAULTS, "name", "body", "recordings"}
    assert set(effect_values.OUTSIDE) == set(OUTSIDE)


def test_numbers_that_yaml_takes_for_texts_are_numbers(tmp_path: Path) -> None:
    file = tmp_path / "s.yaml"
    file.write_text(
        "name: 1e3\nbody: {shape: block, size: [5e-2, 0.05, 3e-2], elements: [3, 3, 2]}\n"
        "declared: {youngs_modulus: 4e3}\nrecordings: {a: [{at: [0, 0], depth: 3e-3}]}\n"
    )
    spec = scenario.load(file)
    assert spec["declared"]["youngs_modulus"] == 4000.0 and spec["recordings"]["a"][0]["depth"] == 0.003
    assert spec["name"] == "1e3" and spec["body"]["size"] == [0.05, 0.05, 0.03]


def test_a_key_that_stands_twice_is_refused_with_its_line(tmp_path: Path) -> None:
    file = tmp_path / "s.yaml"
    file.write_text("name: x\nrecordings:\n  a: [{at: [0, 0], depth: 0.003}]\n  a: [{at: [0, 0], depth: 0.004}]\n")
    assert "s.yaml:4: key 'a' is there twice" in refusal(file)


def test_a_number_to_the_base_8_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "s.yaml"
    file.write_text("name: x\ndeclared: {youngs_modulus: 04000}\nrecordings: {a: [{at: [0, 0], depth: 0.003}]}\n")
    assert "s.yaml:2: 04000 begins with a zero, and is read as 2048" in refusal(file)


def test_the_command_says_it_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """No internal error: a file that is no text, a key that is no text, a probe that is nothing, a seed below zero."""
    plain = (
        "name: x\nbody: {shape: block, size: [0.05, 0.05, 0.03], elements: [3, 3, 2]}\ndeclared: {ship_mesh: false}\n"
    )
    plan = "recordings: {a: [{at: [0, 0], depth: 0.003}]}\n"
    texts = {
        "no_text": (plain + plan).encode() + b"# \xff\xfe\n",
        "key": (plain + "recordings: {1: [{at: [0, 0], depth: 0.003}]}\n").encode(),
        "probe": (plain + plan + "probe: null\n").encode(),
        "seed": (plain + plan).encode(),
    }
    for name, text in texts.items():
        (tmp_path / f"{name}.yaml").write_bytes(text)
        seed = "-1" if name == "seed" else "0"
        code = command_line(["synth", str(tmp_path / f"{name}.yaml"), "--out", str(tmp_path / name), "--seed", seed])
        said = capsys.readouterr().err.strip()
        assert code == 2 and "internal error" not in said and len(said.splitlines()) == 1, said
        assert not (tmp_path / name).exists()


@pytest.mark.parametrize("kind", ["surface", "internal", "support"])
@pytest.mark.parametrize("n", [0, 1, 3])
def test_there_are_as_many_markers_as_are_asked_for(kind: str, n: int) -> None:
    spec = scenario.load(changed(("markers", kind), n))
    mesh = build_world(spec)[0].mesh
    kinds = place_markers(spec, mesh, mesh.nodes, aimed_rig(spec, mesh.nodes)).kinds
    assert {k: kinds.count(k) for k in ("surface", "internal", "support")} == {**WHOLE["markers"], kind: n}


def test_what_is_made_loads_as_an_experiment(tmp_path: Path) -> None:
    spec = {**WHOLE, "recordings": {"b c": WHOLE["recordings"]["b c"]}, "truth": []}
    folder = scenario.make(spec, tmp_path)
    experiment = load_experiment(folder)
    assert experiment.name == "whole"
    assert [effect.name for effect in experiment.effects] == ["viscoelasticity", "base_slip"]
    assert np.load(tmp_path / "truth" / "b c.npz")["force"][0].tolist() == [0.0, 0.0, 0.0]
