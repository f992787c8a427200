"""No command changes its inputs, and earlier results stay until new ones are whole."""

from __future__ import annotations

import errno
import hashlib
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from situations import sound

from livedeform import outputs
from livedeform.cli import run as command_line
from livedeform.closed_loop import loop
from livedeform.common.errors import InputError, LivedeformError
from livedeform.outputs import prepared


def content(folder: Path) -> dict[str, str]:
    """Hashes of every file under a folder, by their paths."""
    files = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


@pytest.fixture
def work(tmp_path: Path) -> Path:
    """A folder with an experiment E and its bag, and a result R with a run.mcap, as an input."""
    (tmp_path / "E").mkdir()
    bag = sound(tmp_path / "E").write()
    (tmp_path / "R").mkdir()
    shutil.copy(bag, tmp_path / "R" / "run.mcap")
    for name in ("metrics.json", "report.html", "configuration.json"):
        (tmp_path / "R" / name).write_text("an earlier result")
    return tmp_path


COMMANDS = {
    "run into the experiment": "run E --bag E/press.mcap --out E --force",
    "run into the run that is replayed": "run E --bag R/run.mcap --out R --force",
    "run over a bag": "run E --bag E/press.mcap --out E/press.mcap --force",
    "run above the experiment": "run link/E --bag E/press.mcap --out link/E/../E --force",
    "run the model into its folder": "run E --bag E/press.mcap --model R/experiment.yaml --out R --force",
    "after a recording in the output": "run E --bag E/press.mcap --after R/run.mcap --out R --force",
    "diagnose into the run that is fitted": "diagnose E --fit R/run.mcap --out R --force",
    "live into the experiment": "live E --out E --force",
    "view over a recording": "view R --no-open --out R/run.mcap --force",
    "parameters over the experiment": "parameters E/experiment.yaml --out E/experiment.yaml --force",
    "synth from and to the same folder": "synth S --out S --force",
    "study into its data": "study gravity --data E --out E --force",
    "import dots into its data": "import dots E --out E --force",
    "recover over its input": "recover R/run.mcap --out R/run.mcap",
}


@pytest.mark.parametrize("name", COMMANDS)
def test_no_command_touches_an_input(
    name: str, work: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    (work / "S" / "truth").mkdir(parents=True)
    (work / "S" / "truth" / "truth.json").write_text("{}")
    shutil.copy(work / "E" / "experiment.yaml", work / "R" / "experiment.yaml")
    for file in ("block.vtu", "markers.csv"):
        shutil.copy(work / "E" / file, work / "R" / file)
    (work / "link").symlink_to(work)
    before = content(work)
    monkeypatch.chdir(work)
    assert command_line(COMMANDS[name].split()) == 2
    assert content(work) == before
    assert capsys.readouterr().err.count("\n") == 1


def test_a_folder_within_the_experiments_is_fine(work: Path):
    with prepared(work / "E" / "out", ("a.json",), force=False, inputs=[work / "E" / "experiment.yaml"]) as draft:
        (draft / "a.json").write_text("new")
    with prepared(work / "E" / "out", ("a.json",), force=True, inputs=[work / "E" / "experiment.yaml"]) as draft:
        (draft / "a.json").write_text("newer")
    assert (work / "E" / "out" / "a.json").read_text() == "newer"


NAMES = ("a.json", "b.html", "parts")


def write(folder: Path, text: str) -> None:
    (folder / "parts").mkdir()
    for path in ("a.json", "b.html", "parts/c"):
        (folder / path).write_text(text)


@pytest.fixture
def old(tmp_path: Path) -> Path:
    """A folder with a result."""
    with prepared(tmp_path / "out", NAMES, force=False) as draft:
        write(draft, "old")
    return tmp_path / "out"


def test_new_results_replace_old_ones_together(old: Path):
    with prepared(old, NAMES, force=True) as draft:
        write(draft, "new")
        assert {path.read_text() for path in old.rglob("*") if path.is_file()} == {"old"}
    assert sorted(content(old)) == ["a.json", "b.html", "parts/c"]
    assert {path.read_text() for path in old.rglob("*") if path.is_file()} == {"new"}
    assert [path.name for path in old.parent.iterdir()] == ["out"]


def test_what_is_not_a_result_stays(old: Path):
    (old / "notes.txt").write_text("mine")
    with prepared(old, NAMES, force=True) as draft:
        write(draft, "new")
        (draft / "b.html").unlink()
    assert sorted(content(old)) == ["a.json", "notes.txt", "parts/c"]  # an old page would not go with new numbers
    assert (old / "notes.txt").read_text() == "mine" and (old / "a.json").read_text() == "new"


@pytest.mark.parametrize("error", [ValueError(), KeyboardInterrupt(), OSError(errno.ENOSPC, "no space")])
def test_what_fails_leaves_the_old_result(old: Path, error: BaseException):
    before = content(old)
    expected = LivedeformError if isinstance(error, OSError) else type(error)
    with pytest.raises(expected) as raised, prepared(old, NAMES, force=True) as draft:
        (draft / "a.json").write_text("new")
        raise error
    assert content(old) == before and [path.name for path in old.parent.iterdir()] == ["out"]
    assert not isinstance(error, OSError) or "the disk is full" in str(raised.value)


def test_a_write_that_fails_at_any_point_leaves_the_old_result(old: Path, monkeypatch: pytest.MonkeyPatch):
    """Every rename of the last step fails once: what is there then is the old result or the new one."""
    rename: Callable[..., None] = os.rename
    for fails in range(12):
        calls = 0

        def broken(*arguments: object, fails: int = fails) -> None:
            nonlocal calls
            calls += 1
            if calls > fails:
                raise OSError(errno.EIO, "broken")
            rename(*arguments)

        with monkeypatch.context() as patch:
            patch.setattr(os, "rename", broken)
            patch.setattr(os, "replace", broken)
            try:
                with prepared(old, NAMES, force=True) as draft:
                    write(draft, "new")
            except LivedeformError:
                pass
        assert len({path.read_text() for path in old.rglob("*") if path.is_file()}) == 1


def test_a_killed_process_leaves_the_old_result(old: Path):
    before = content(old)
    child = os.fork()
    if child == 0:  # pragma: no cover
        with prepared(old, NAMES, force=True) as draft:
            write(draft, "new")
            os._exit(9)
    os.waitpid(child, 0)
    assert content(old) == before


def test_what_is_recorded_in_place_stays(tmp_path: Path):
    with pytest.raises(ValueError), prepared(tmp_path / "out", NAMES, force=False, in_place=True) as draft:
        assert draft == tmp_path / "out"
        (draft / "a.json").write_text("half")
        raise ValueError
    assert (tmp_path / "out" / "a.json").read_text() == "half"


def test_paths_in_a_draft_are_told_by_their_final_names(tmp_path: Path):
    with (
        prepared(tmp_path / "all", ("one",), force=False) as whole,
        prepared(whole / "one", NAMES, force=False) as draft,
    ):
        outputs.write_json(draft / "a.json", {"path": draft / "b.html"})
    assert str(tmp_path / "all" / "one" / "b.html") in (tmp_path / "all" / "one" / "a.json").read_text()


def test_a_folder_that_is_an_input_is_refused(tmp_path: Path):
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "metadata.yaml").write_text("")
    for out in (tmp_path / "bag", tmp_path / "bag" / "out"):
        with pytest.raises(InputError), prepared(out, NAMES, force=True, inputs=[tmp_path / "bag"]):
            raise AssertionError("nothing may be written")
    assert list((tmp_path / "bag").iterdir()) == [tmp_path / "bag" / "metadata.yaml"]


def test_a_diagnosis_that_fails_leaves_the_old_one(work: Path, monkeypatch: pytest.MonkeyPatch):
    def fails(experiment: Path, fit: object, test: object, draft: Path, **_: object) -> None:
        (draft / "diagnosis.json").write_text("half a new one")
        raise LivedeformError("no equilibrium")

    (work / "why").mkdir()
    (work / "why" / "diagnosis.json").write_text("old")
    before = content(work)
    monkeypatch.chdir(work)
    monkeypatch.setattr(loop, "diagnose", fails)
    assert command_line(["diagnose", "E", "--fit", "E/press.mcap", "--out", "why", "--force"]) == 2
    assert content(work) == before
