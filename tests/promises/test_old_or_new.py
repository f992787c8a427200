"""The old result or the new one, never neither, whichever write fails and whenever the process is killed."""

from __future__ import annotations

import errno
import json
import os
import resource
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "trust"))  # a small experiment and its recording

from situations import sound

from livedeform import drafts, outputs
from livedeform.cli import run as command_line

FAULTS = {
    "ENOSPC": "the disk is full",
    "EROFS": "read-only",
    "EACCES": "permission is denied",
    "EIO": "the disk has a fault",
}


def attempts(faults: str, out: Path, *how: str) -> list[dict[str, Any]]:
    """What `faults.py` prints."""
    out.mkdir(parents=True, exist_ok=True)
    words = [sys.executable, str(Path(__file__).with_name("faults.py")), faults, str(out), *how]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


def judge(found: list[dict[str, Any]], there: str) -> None:
    """A failed attempt leaves what was ``there`` ("old" or "nothing"), says why in one line, and leaves no draft; one
    that is not failed leaves the new result."""
    for a in found:
        if a["code"] in (0, 1):
            assert a["state"] == "new", a
        elif a["fault"] in FAULTS:
            assert a["code"] == 2 and a["state"] == there and not a["left"], a
            line = a["said"].strip().splitlines()[-1]
            assert FAULTS[a["fault"]] in line and "internal error" not in line, a
        else:
            assert a["code"] < 0 and a["state"] in (there, "new"), a
    for fault in sorted({a["fault"] for a in found}):
        print(fault, sum(a["fault"] == fault for a in found), "attempts")
        assert len([a for a in found if a["fault"] == fault and a["code"] not in (0, 1)]) >= 5


@pytest.mark.parametrize("there", ["old", pytest.param("nothing", marks=pytest.mark.slow)])
def test_every_write_fails_once(there: str, tmp_path: Path):
    out = tmp_path / "work" / "out"
    if there == "old":
        out.mkdir(parents=True)
        (out / "metrics.json").write_text("earlier")
    judge(attempts(",".join([*FAULTS, "KILL"]), out, "toy"), there)


@pytest.mark.parametrize("fault", FAULTS)
def test_a_single_file_that_cannot_be_written_is_said_in_words(
    fault: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """By the commands whose result is a file, not a folder."""

    def fails(self: Path, *_: object, **__: object) -> None:
        number = getattr(errno, fault)
        raise OSError(number, os.strerror(number), str(self))

    out = tmp_path / "nodes.yaml"
    out.write_text("old")
    monkeypatch.setattr(Path, "write_text", fails)
    assert command_line(["parameters", "phantom", "--out", str(out), "--force"]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and FAULTS[fault] in said and f"{out}:" in said and "internal" not in said
    assert out.read_text() == "old" and [path.name for path in tmp_path.iterdir()] == [out.name]


def test_a_recovered_recording_that_does_not_fit_leaves_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Every write beyond so many bytes fails, as on a full disk."""
    (tmp_path / "E").mkdir()
    bag, out = sound(tmp_path / "E").write(), tmp_path / "out"
    out.mkdir()
    whole, before = bag.stat().st_size, resource.getrlimit(resource.RLIMIT_FSIZE)
    for share in (0.2, 0.5, 0.9):
        resource.setrlimit(resource.RLIMIT_FSIZE, (round(share * whole), before[1]))
        try:
            code = command_line(["recover", str(bag), "--out", str(out / "x.mcap")])
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
        assert code == 2 and "no file may be that large here" in capsys.readouterr().err
        assert not list(out.iterdir())


def test_what_a_killed_command_left_is_cleaned_up_or_named(tmp_path: Path):
    out = tmp_path / "out"
    with outputs.prepared(out, ("a",), force=False) as draft:
        (draft / "a").write_text("old")
    (tmp_path / ".out-draft-1").mkdir()
    (tmp_path / ".out-draft-1" / "a").write_text("half")
    (tmp_path / ".out-recording-1").mkdir()
    with (
        pytest.warns(UserWarning, match=r"what it had recorded is in .*\.out-recording-1"),
        outputs.prepared(out, ("a",), force=True) as draft,
    ):
        (draft / "a").write_text("new")
        drafts.tidy(out)
        assert draft.exists()  # a command that runs holds its draft
    assert sorted(p.name for p in tmp_path.iterdir()) == [".out-recording-1", "out"]
    (out / ".a.draft-999999999").write_text("half")
    outputs.write_text(out / "a", "newer")
    assert [p.name for p in out.iterdir()] == ["a"]


# --- real commands ---------------------------------------------------------------------------------------------------


@pytest.fixture
def work(tmp_path: Path) -> Path:
    """A folder with an experiment E, its bag, and a folder for results."""
    (tmp_path / "E").mkdir()
    sound(tmp_path / "E").write()
    (tmp_path / "work").mkdir()
    return tmp_path


def run_words(work: Path) -> list[str]:
    return ["run", str(work / "E"), "--bag", str(work / "E" / "press.mcap"), "--out", str(work / "work" / "out")]


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["ENOSPC", "EIO"])
def test_every_write_of_a_run_fails_once(fault: str, work: Path):
    assert command_line(run_words(work)) in (0, 1)
    judge(attempts(fault, work / "work" / "out", "command", *run_words(work), "--force"), "old")


@pytest.mark.slow
def test_every_write_of_a_report_fails_once(work: Path):
    """It is made again in place: the page is the old one or the new one."""
    assert command_line(run_words(work)) in (0, 1)
    found = attempts("ENOSPC,EIO", work / "work" / "out", "command", "report", str(work / "work" / "out"))
    for a in found:
        assert a["state"] in ("old", "new") and "internal error" not in a["said"], a
        assert a["code"] == 0 or FAULTS[a["fault"]] in a["said"], a
    print(len(found), "attempts")


@pytest.mark.slow
def test_every_write_of_a_diagnosis_fails_once(work: Path):
    """One candidate only, to be quick."""
    out = work / "work" / "out"
    words = ["diagnose", str(work / "E"), "--fit", str(work / "E" / "press.mcap"), "--out", str(out)]
    words += ["--candidates", "stiffness", "--max-effects", "1"]
    assert command_line(words) in (0, 1)
    judge(attempts("EIO", out, "command", *words, "--force"), "old")


@pytest.mark.slow
def test_a_run_is_killed_at_fifty_random_times(work: Path):
    out = work / "work" / "out"
    assert command_line(run_words(work)) in (0, 1)
    found = attempts("TIME", out, "command", *run_words(work), "--force")
    assert len(found) == 50 and all(a["state"] in ("old", "new") for a in found)
    assert command_line([*run_words(work), "--force"]) in (0, 1)
    assert [p.name for p in out.parent.iterdir()] == ["out"]


@pytest.mark.slow
def test_a_full_disk_leaves_the_old_run(work: Path):
    """A real one: a file system in memory, of so many kB that other parts of the results fit in it."""
    for size in (200, 700, 2000, 6500):
        disk = work / f"disk{size}"
        disk.mkdir()
        made = subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}k", "none", str(disk)], check=False)
        if made.returncode:
            pytest.skip("nothing may be mounted here")
        try:
            out = disk / "out"
            out.mkdir()
            (out / "metrics.json").write_text("earlier")
            words = ["run", str(work / "E"), "--bag", str(work / "E" / "press.mcap"), "--out", str(out), "--force"]
            done = subprocess.run(
                [sys.executable, "-c", "from livedeform.cli import main; main()", *words],
                capture_output=True, text=True, env=dict(os.environ), check=False,
            )  # fmt: skip
            if done.returncode == 2:
                assert (out / "metrics.json").read_text() == "earlier" and "the disk is full" in done.stderr
            else:
                assert size > 5500 and json.loads((out / "metrics.json").read_text())["n_frames"]
            assert [p.name for p in disk.iterdir()] == ["out"]
        finally:
            subprocess.run(["umount", str(disk)], check=True)
