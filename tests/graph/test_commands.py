"""The command line: help with examples everywhere, lists of bags, the viewer, the doctor."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from livedeform.cli import app, repeat_lists
from livedeform.cli import run as command_line
from livedeform.common.bags.recording_writer import RecordingWriter
from livedeform.doctor import CHECKS, Check, NotBetter, examine
from livedeform.run.running import RunOptions, run
from livedeform.studies import STUDIES

COMMANDS = [c.name or c.callback.__name__ for c in app.registered_commands if c.callback is not None]
COMMANDS += [f"{g.name}" for g in app.registered_groups]
STUDY_NAMES = [*STUDIES, "all"]


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_help_with_an_example(name: str, capsys: pytest.CaptureFixture[str]):
    assert command_line([name, "--help"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "Example" in text and f"livedeform {name}" in text


@pytest.mark.parametrize("name", STUDY_NAMES)
def test_every_study_is_a_command_with_help_and_an_example(name: str, capsys: pytest.CaptureFixture[str]):
    assert command_line(["study", name, "--help"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "Example" in text and f"livedeform study {name}" in text and "--out" in text


def test_a_study_refuses_the_options_of_another(capsys: pytest.CaptureFixture[str]):
    assert command_line(["study", "beam", "--board", "9x6"]) == 2
    assert "--board: the study 'beam' takes no board" in capsys.readouterr().err
    assert command_line(["study", "nowhere"]) == 2
    assert "nowhere" in capsys.readouterr().err


def test_the_interfaces_commands_are_there():
    assert {"demo", "run", "live", "diagnose", "calibrate", "study", "synth", "info", "view", "doctor"} <= set(COMMANDS)


def test_options_that_take_several_values():
    words = ["diagnose", "E", "--fit", "a", "b", "--max-effects", "2", "--test", "c", "--out", "o"]
    assert repeat_lists(words) == [
        "diagnose",
        "E",
        "--fit",
        "a",
        "--fit",
        "b",
        "--max-effects",
        "2",
        "--test",
        "c",
        "--out",
        "o",
    ]
    once_each = ["diagnose", "E", "--fit", "a", "--fit", "b", "--out", "o"]
    assert repeat_lists(once_each) == once_each


def test_defects_are_one_line_too(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    def broken(*_: object) -> None:
        raise ZeroDivisionError("a defect")

    monkeypatch.setattr("livedeform.inspection.inspect", broken)
    assert command_line(["info", "."]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "--debug" in error
    assert command_line(["info", ".", "--debug"]) == 2
    assert "Traceback" in capsys.readouterr().err


def test_a_run_in_three_dimensions(experiment: Path, bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    run(RunOptions(experiment, bag, tmp_path / "run"), lambda *_: None)
    assert command_line(["view", str(tmp_path / "run"), "--no-open"]) == 0
    page = (tmp_path / "run" / "view.html").read_text()
    assert "predicted surface" in page and "measured markers" in page and "addFrames" in page
    assert "https://cdn" not in page.split("<body>")[1][:2000]  # plotly itself is in the file
    capsys.readouterr()
    assert command_line(["view", str(tmp_path / "nothing"), "--no-open"]) == 2


def test_parameter_file_names_every_parameter(tmp_path: Path):
    assert command_line(["parameters", "phantom", "--out", str(tmp_path / "nodes.yaml")]) == 0
    document = yaml.safe_load((tmp_path / "nodes.yaml").read_text())
    assert set(document) == {"stereo_node", "fem_node", "compare_node"}
    assert document["fem_node"]["ros__parameters"]["experiment"] == "phantom"
    shipped = yaml.safe_load((Path(__file__).parents[2] / "config" / "nodes.yaml").read_text())
    assert shipped == document  # config/nodes.yaml was written by this command


def test_the_doctor_finds_this_installation_whole():
    quick = [c for c in CHECKS if c[0] not in ("dds", "mesher")]
    assert len(quick) == len(CHECKS) - 2
    for name, check, _ in quick:
        if name not in ("solver", "cores", "kernels"):  # scipy's solver serves, too; a busy machine, a new one
            assert check()[0], name


@pytest.mark.parametrize("lost", ["nothing is written", "another value is written"])
def test_the_doctor_reads_back_what_it_wrote(monkeypatch: pytest.MonkeyPatch, lost: str):
    real = RecordingWriter.pose
    other = lambda writer, pose: real(writer, replace(pose, position=pose.position + 1.0))  # noqa: E731
    bad = (lambda writer, pose: None) if lost == "nothing is written" else other
    check = next(check for name, check, _ in CHECKS if name == "bags")
    assert check() == (True, "a recording was written and read back")
    monkeypatch.setattr(RecordingWriter, "pose", bad)
    with pytest.raises(RuntimeError, match="of one message that was written"):
        check()


def test_the_doctor_says_what_is_missing(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    def missing() -> tuple[bool, str]:
        raise ImportError("No module named 'rclpy'")

    def slow() -> tuple[bool, str]:
        raise NotBetter("slow")

    checks = (("ros 2", missing, "pip install it"), ("solver", slow, "pip install that"))
    monkeypatch.setattr("livedeform.doctor.CHECKS", checks)
    found = list(examine())
    assert found[0] == Check("ros 2", False, "ImportError: No module named 'rclpy'", "pip install it")
    assert found[1].ok is None
    assert command_line(["doctor"]) == 1
    assert "MISSING" in capsys.readouterr().out
