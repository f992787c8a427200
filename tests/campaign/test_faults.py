"""Faults in the middle of many recordings: whatever can be done is done, and a later start ends with the same table."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
import small_laboratory as lab

pytest.importorskip("distributed")

from livedeform.campaign.campaign import CampaignOptions, CampaignResult, run_campaign
from livedeform.campaign.table import CSV, PARQUET, read_table

pytestmark = pytest.mark.slow


def done(source: Path, out: Path) -> CampaignResult:
    return run_campaign(CampaignOptions(source, out, 2), lambda *_: None)


def tables(out: Path) -> tuple[bytes, bytes]:
    return (out / PARQUET).read_bytes(), (out / CSV).read_bytes()


def test_a_torn_bag_and_a_mistake_in_the_middle_of_fifty(tmp_path: Path) -> None:
    source, out = lab.write_laboratory(tmp_path / "lab", 10, 5), tmp_path / "out"
    experiment, bag = source / "phantom-04" / "experiment.yaml", source / "phantom-06" / "take-02.mcap"
    right, whole = experiment.read_text(), bag.read_bytes()
    experiment.write_text(right.replace("fixed", "fixxed"))
    bag.write_bytes(whole[: len(whole) // 2])
    result = done(source, out)
    wrong = [f"phantom-04/take-0{k}" for k in range(5)]
    assert (result.n_now, sorted(result.problems)) == (44, [*wrong, "phantom-06/take-02"])
    assert all("\n" not in line for line in result.problems.values())
    rows = {row["recording"]: row for row in read_table(out)}
    assert "fixxed" in rows[wrong[0]]["problem"] and "take-02.mcap" in rows["phantom-06/take-02"]["problem"]
    experiment.write_text(right)
    bag.write_bytes(whole)
    result = done(source, out)
    assert (result.n_before, result.n_now, result.problems) == (44, 6, {})
    done(source, tmp_path / "whole")
    assert tables(out) == tables(tmp_path / "whole")


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A file system in memory of 300 kB."""
    place = tmp_path / "disk"
    place.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=300k", "none", str(place)], check=False).returncode:
        pytest.skip("nothing may be mounted here")
    yield place
    subprocess.run(["umount", str(place)], check=True)


def test_a_full_disk_is_said_and_made_up_for(tmp_path: Path, disk: Path) -> None:
    """Of 40 recordings some find room; a larger disk, and the same command does the rest."""
    source, out = lab.write_laboratory(tmp_path / "lab", 8, 5), disk / "out"
    process = lab.start(source, out, "--cores", "2")
    said = "".join(process.communicate())
    assert process.returncode in (1, 2) and "the disk is full" in said and "Traceback" not in said
    before = len(list(out.glob("jobs/*/row.parquet")))
    assert 0 < before < 40
    subprocess.run(["mount", "-o", "remount,size=50m", str(disk)], check=True)
    result = done(source, out)
    assert (result.n, result.n_before, result.problems) == (40, before, {})
    done(source, tmp_path / "whole")
    assert tables(out) == tables(tmp_path / "whole")


def test_a_second_campaign_in_the_same_folder_is_refused(tmp_path: Path) -> None:
    """By name of who runs in it, while the first goes on to its end."""
    source, out = lab.write_laboratory(tmp_path / "lab", 3, 5), tmp_path / "out"
    first = lab.start(source, out, "--cores", "1")
    while not (out / ".campaign.lock").is_file() or not (out / ".campaign.lock").read_text():
        assert first.poll() is None
    second = lab.start(source, out, "--cores", "1")
    said = second.communicate()[1]
    assert second.returncode == 2 and f"process {first.pid}" in said and said.count("\n") == 1
    first.communicate()
    assert first.returncode == 0 and len(list(read_table(out))) == 15
