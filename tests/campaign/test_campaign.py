"""Campaigns from the command line: all that can be done is done, and nothing twice, whatever is killed."""

from __future__ import annotations

import errno
import os
import random
import signal
import time
from contextlib import suppress
from pathlib import Path

import pytest
import small_laboratory as lab

pytest.importorskip("distributed")

import livedeform
from livedeform.campaign import work as work_module
from livedeform.campaign.campaign import CampaignOptions, alone_in, run_campaign
from livedeform.campaign.jobs import Job, jobs_of
from livedeform.campaign.plan import CampaignFile, CampaignRecording
from livedeform.campaign.table import CSV, PARQUET, read_table
from livedeform.campaign.work import outcome, work
from livedeform.common.errors import InputError


def job(tmp_path: Path, *, torn: bool = False) -> Job:
    """A job that reads one recording, which may be torn."""
    home, out = lab.write_phantom(tmp_path / "phantom"), tmp_path / "out"
    bag = lab.write_take(home / "take.mcap", 0)
    if torn:
        bag.write_bytes(bag.read_bytes()[:40])
    recording = CampaignRecording(name="phantom/take", experiment=home, bag=bag, phantom="phantom", rig="rig")
    out.mkdir(exist_ok=True)
    return next(jobs_of([recording], CampaignFile(run=None, diagnose=None), out))


def in_a_child(job: Job) -> int:
    """Do a job as a worker does: in a process of its own. Its exit code."""
    child = os.fork()
    if child == 0:
        code = 1
        try:
            work(job)
            code = 0
        finally:
            os._exit(code)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def tables(out: Path) -> tuple[bytes, bytes]:
    return (out / PARQUET).read_bytes(), (out / CSV).read_bytes()


def test_a_job_leaves_its_row_and_is_not_done_again(tmp_path: Path) -> None:
    mine = job(tmp_path)
    assert in_a_child(mine) == 0 and mine.is_done
    assert outcome(mine, 0).problem == ""
    before = (mine.folder / "row.parquet").stat().st_mtime_ns
    assert in_a_child(mine) == 0
    assert (mine.folder / "row.parquet").stat().st_mtime_ns == before


def test_a_broken_bag_is_named_with_its_line(tmp_path: Path) -> None:
    mine = job(tmp_path, torn=True)
    ended = outcome(mine, in_a_child(mine))
    assert not mine.is_done and "take.mcap" in ended.problem and not ended.passing
    assert mine.failure == ended.problem


def test_a_full_disk_is_passing_and_leaves_nothing_half_done(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mine = job(tmp_path)

    def full(job: Job) -> dict[str, object]:
        (job.folder / "half").write_text("written")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(work_module, "_steps", full)
    ended = outcome(mine, in_a_child(mine))
    assert ended.passing and "the disk is full" in ended.problem
    assert not (mine.folder / "half").exists() and not mine.is_done


@pytest.mark.parametrize("when", ["before it begins", "while it goes on"])
def test_what_was_changed_meanwhile_is_not_kept_under_the_old_key(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, when: str
) -> None:
    """Taken back later, the change's result was the unchanged experiment's for good."""
    mine = job(tmp_path)
    file = mine.recording.experiment / "experiment.yaml"
    steps = work_module._steps

    def change() -> None:
        file.write_text(file.read_text() + "\n# another\n")

    def changing(job: Job) -> dict[str, object]:
        change()
        return steps(job)

    if when == "before it begins":
        change()
    else:
        monkeypatch.setattr(work_module, "_steps", changing)
    ended = outcome(mine, in_a_child(mine))
    assert not mine.is_done and ended.passing and "changed while the campaign went on" in ended.problem


def test_a_killed_job_may_be_tried_again(tmp_path: Path) -> None:
    ended = outcome(job(tmp_path), -signal.SIGKILL)
    assert ended.passing and "SIGKILL" in ended.problem


def test_a_folder_is_one_campaigns_at_a_time_and_no_others(tmp_path: Path) -> None:
    with (
        alone_in(tmp_path / "out"),
        pytest.raises(InputError, match=f"a campaign runs in it .process {os.getpid()}"),
        alone_in(tmp_path / "out"),
    ):
        pass
    source = lab.write_laboratory(tmp_path / "lab", 1, 1)
    (tmp_path / "else").mkdir()
    (tmp_path / "else" / "thesis.tex").touch()
    with pytest.raises(InputError, match="something else"):
        run_campaign(CampaignOptions(source, tmp_path / "else", 1), print)


def test_errors_in_the_middle_leave_the_others_done_and_are_done_again_when_asked(tmp_path: Path) -> None:
    source, out = lab.write_laboratory(tmp_path / "lab", 3, 2), tmp_path / "out"
    wrong, broken = source / "phantom-01" / "experiment.yaml", source / "phantom-02" / "take-01.mcap"
    right = wrong.read_text()
    whole = broken.read_bytes()
    wrong.write_text(right.replace("density", "densitty"))
    broken.write_bytes(whole[:60])
    result = run_campaign(CampaignOptions(source, out, 2), lambda *_: None)
    assert (result.n, result.n_now, sorted(result.problems)) == (
        *(6, 3),
        ["phantom-01/take-00", "phantom-01/take-01", "phantom-02/take-01"],
    )
    rows = list(read_table(out))
    assert [r["status"] for r in rows] == ["done", "done", "failed", "failed", "done", "failed"]
    assert [r["version"] for r in rows if r["status"] == "done"] == 3 * [livedeform.__version__]
    assert "densitty" in rows[2]["problem"] and "take-01.mcap" in rows[5]["problem"]
    wrong.write_text(right)
    broken.write_bytes(whole)
    result = run_campaign(CampaignOptions(source, out, 2), lambda *_: None)
    assert (result.n_before, result.n_now, result.problems) == (3, 3, {})
    assert (out / "index.html").is_file()


@pytest.mark.parametrize("left", [0, pytest.param(100, marks=pytest.mark.slow)])
def test_a_torn_row_is_done_again(tmp_path: Path, left: int) -> None:
    """It was "failed" in the table and the page for ever, "0 failed" on the terminal, and the exit code was 0."""
    source, out = lab.write_laboratory(tmp_path / "lab.2026", 1, 2), tmp_path / "out"
    run_campaign(CampaignOptions(source, out, 1), lambda *_: None)
    whole = tables(out)
    torn = next(out.glob("jobs/*/row.parquet"))
    torn.write_bytes(torn.read_bytes()[:left])
    said: list[str] = []
    result = run_campaign(CampaignOptions(source, out, 1), lambda text, _: said.append(text))
    assert (result.n_before, result.n_now, result.problems) == (1, 1, {}) and tables(out) == whole
    assert any("is done again: its row cannot be read" in line for line in said)
    assert "<title>lab.2026</title>" in (out / "index.html").read_text()


@pytest.mark.slow
def test_one_two_and_four_workers_give_the_same_table(tmp_path: Path) -> None:
    source = lab.write_laboratory(tmp_path / "lab", 2, 6)
    found = []
    for n in (1, 2, 4):
        run_campaign(CampaignOptions(source, tmp_path / f"out-{n}", n), lambda *_: None)
        found.append(tables(tmp_path / f"out-{n}"))
    assert found[0] == found[1] == found[2]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_killed_at_random_times_it_ends_with_the_same_table(tmp_path: Path, seed: int) -> None:
    """The scheduler is killed twice, a worker whenever one is seen; the last start is let go on to its end."""
    rng = random.Random(seed)
    source = lab.write_laboratory(tmp_path / "lab", 4, 5)
    run_campaign(CampaignOptions(source, tmp_path / "whole", 2), lambda *_: None)
    out = tmp_path / "out"
    for kills in (True, True, False):
        process = lab.start(source, out, "--cores", "2")
        target = len(list(out.glob("jobs/*/row.parquet"))) + rng.randint(1, 6)
        while process.poll() is None and (kills or target):
            if len(list(out.glob("jobs/*/row.parquet"))) >= target:
                kill_a_worker(process.pid, rng)
                if not kills:
                    break
                time.sleep(rng.uniform(0.0, 0.5))
                process.kill()
            time.sleep(0.05)
        _, said = process.communicate()
    assert process.returncode == 0, said
    assert tables(out) == tables(tmp_path / "whole")


def kill_a_worker(parent: int, rng: random.Random) -> None:
    """Kill one of the processes below ``parent``, if there is one that lives."""
    import psutil

    below = []
    for process in psutil.Process(parent).children(recursive=True):
        with suppress(psutil.Error):  # it may end while it is looked at
            if "resource_tracker" not in " ".join(process.cmdline()):
                below.append(process)
    if below:
        with suppress(psutil.Error):
            rng.choice(below).kill()
