"""No green tick over something wrong: every wrong situation is refused or warned of, and a sound one is not."""

from __future__ import annotations

from pathlib import Path

import pytest
import situations
from situations import EXPERIMENTS, LARGE, PAIRS, RECORDINGS, judged, judged_pair

from livedeform.common.bags.read import read_bag
from livedeform.common.bags.recording import load_recording
from livedeform.common.checks.recorded import load_checked
from livedeform.common.experiment.yaml_file import load_experiment
from livedeform.inspection import fit_findings


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_an_experiment_that_cannot_be_is_refused(name: str, tmp_path: Path):
    word, text = judged(name, tmp_path)
    assert word == "refused", text
    assert text.count("\n") == 0 and str(tmp_path) in text


@pytest.mark.parametrize("name", LARGE)
def test_what_is_large_but_can_be_is_loaded(name: str, tmp_path: Path):
    case = situations.sound(tmp_path)
    LARGE[name](case)
    case.write()
    load_experiment(case.experiment)


@pytest.mark.parametrize("name", RECORDINGS)
def test_a_recording_that_may_be_wrong_is_refused_or_warned_of(name: str, tmp_path: Path):
    word, _ = judged(name, tmp_path)
    assert word in ("refused", "warned")


@pytest.mark.parametrize("name", PAIRS)
def test_what_was_fitted_does_not_test(name: str, tmp_path: Path):
    word, text = judged_pair(tmp_path, name)
    assert word == "refused" and ("--fit" in text or "among the recordings" in text)


def test_a_sound_recording_is_accepted_and_its_contact_is_told(tmp_path: Path):
    case = situations.sound(tmp_path)
    bag = case.write()
    experiment = load_experiment(case.experiment)
    with read_bag(bag) as reader:
        findings = fit_findings(reader, experiment, load_recording(bag, experiment))
    assert [f.level for f in findings if f.level != "NOTE"] == []
    assert any("first contact at 0.2 s, deepest 3.0 mm at 1.0 s" in f.text for f in findings)
    other = situations.frames(situations.moved(dz=1e-5))
    other(case)
    later = situations.small.write_bag(tmp_path / "other.mcap", case.poses, case.frames)
    assert len(load_checked([bag], [later], experiment)) == 2  # the same path of the probe, measured another time


def test_a_mistyped_key_is_named_before_the_one_that_is_missing(tmp_path: Path):
    _, text = judged("a key mistyped", tmp_path)
    assert "unknown key 'youngs_modlus'" in text and "did you mean 'youngs_modulus'?" in text


def test_poses_in_millimetres_are_told_as_such(tmp_path: Path):
    assert "millimetres" in judged("poses in mm", tmp_path)[1]


def test_poses_in_another_frame_are_not_taken_for_millimetres(tmp_path: Path):
    assert "millimetres" not in judged("poses in another frame", tmp_path)[1]
