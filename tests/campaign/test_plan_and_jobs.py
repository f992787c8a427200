"""Which recordings a campaign has, and by what it knows them again."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import small_laboratory as lab

pytest.importorskip("pyarrow")

from livedeform.campaign import jobs as jobs_module
from livedeform.campaign.jobs import Job, jobs_of
from livedeform.campaign.plan import read_plan
from livedeform.common.errors import InputError


@pytest.fixture
def source(tmp_path: Path) -> Path:
    return lab.write_laboratory(tmp_path / "lab", 2, 2)


def planned(source: Path, out: Path) -> list[Job]:
    out.mkdir(exist_ok=True)
    settings, recordings = read_plan(source, out)
    return list(jobs_of(recordings, settings, out))


def test_a_folder_is_read_in_the_order_of_names(source: Path, tmp_path: Path) -> None:
    _, recordings = read_plan(source, tmp_path / "out")
    assert [r.name for r in recordings] == [f"phantom-0{i}/take-0{k}" for i in (0, 1) for k in (0, 1)]
    assert {r.phantom for r in recordings} == {"phantom-00", "phantom-01"}


def test_results_below_the_folder_are_no_input(source: Path) -> None:
    out = source / "out"
    lab.write_phantom(out / "jobs" / "key" / "run")
    lab.write_take(out / "jobs" / "key" / "run" / "run.mcap", 7)
    assert len(read_plan(source, out)[1]) == 4


def test_neither_the_folder_of_bags_nor_results_beside_it_are_recordings(source: Path, tmp_path: Path) -> None:
    """With `bags/` beside the experiment, and a run there, both were read as one recording each, and pooled."""
    phantom = source / "phantom-00"
    (phantom / "bags").mkdir()
    for take in sorted(phantom.glob("*.mcap")):
        take.rename(phantom / "bags" / take.name)
    for name, file in (("run", "metrics.json"), ("why", "configuration.json")):
        (phantom / name).mkdir()
        lab.write_take(phantom / name / "run.mcap", 7)
        (phantom / name / file).write_text("{}")
    assert [r.name for r in read_plan(source, tmp_path / "out")[1]][:3] == [
        "phantom-00/take-00",
        "phantom-00/take-01",
        "phantom-01/take-00",
    ]


def test_a_pattern_of_bags_fits_no_results(source: Path, tmp_path: Path) -> None:
    """Begun a second time, a campaign counted its own runs as further takes, and told causes of them."""
    home = source / "phantom-00"
    (source / "campaign.yaml").write_text("recordings:\n- {experiment: phantom-00, bags: ['phantom-00/**/*']}\n")
    wanted = [r.name for r in read_plan(source, home / "out")[1]]
    assert wanted == ["phantom-00/take-00", "phantom-00/take-01"]
    for name, command in (("out/jobs/a/run", ""), ("why/proposal", ""), ("why", "diagnose"), ("live", "live")):
        (home / name).mkdir(parents=True, exist_ok=True)
        lab.write_take(home / name / "run.mcap", 7)
        if command:
            (home / name / "configuration.json").write_text(f'{{"command": "{command}"}}')
    assert [r.name for r in read_plan(source, home / "out")[1]] == wanted


def test_imported_recordings_are_recordings_and_a_session_that_was_killed_is_none(source: Path, tmp_path: Path) -> None:
    home, text = source / "phantom-00", "recordings:\n- {experiment: 'phantom-*', bags: ['**/*.mcap']}\n"
    for name, command in (("phantom-00/monday", "import c3d"), ("phantom-02", "live")):
        (source / name).mkdir()
        lab.write_take(source / name / "a.mcap", 7)
        (source / name / "configuration.json").write_text(f'{{"command": "{command}"}}')
    (source / "phantom-02" / "experiment.yaml").write_text((home / "experiment.yaml").read_text())
    takes = [f"phantom-0{i}/take-0{k}" for i in (0, 1) for k in (0, 1)]
    assert [r.name for r in read_plan(source, tmp_path / "out")[1]] == ["phantom-00/a", *takes]
    (source / "campaign.yaml").write_text(text)
    found = {(r.name, r.experiment.name) for r in read_plan(source, tmp_path / "out")[1]}
    assert {e for _, e in found} == {"phantom-00", "phantom-01"}
    assert ("phantom-00/a", "phantom-00") in found


def test_the_parts_of_a_bag_are_one_recording(source: Path, tmp_path: Path) -> None:
    bag = source / "phantom-00" / "bags" / "long"
    bag.mkdir(parents=True)
    for part in (0, 1):
        lab.write_take(bag / f"long_{part}.mcap", 7 + part)
    (bag / "metadata.yaml").write_text("")
    (source / "campaign.yaml").write_text("recordings:\n- {experiment: phantom-00, bags: ['bags/**/*']}\n")
    assert [r.name for r in read_plan(source, tmp_path / "out")[1]] == ["phantom-00/long"]


def test_a_file_names_recordings_rig_and_phantom(source: Path, tmp_path: Path) -> None:
    text = "version: 1\nrecordings:\n- {experiment: 'phantom-*', bags: ['take-00.mcap'], rig: two, phantom: gel}\n"
    (source / "campaign.yaml").write_text(text)
    _, recordings = read_plan(source / "campaign.yaml", tmp_path / "out")
    assert [(r.name, r.rig, r.phantom) for r in recordings] == [
        ("phantom-00/take-00", "two", "gel"),
        ("phantom-01/take-00", "two", "gel"),
    ]


def test_bodies_of_one_name_in_two_folders_are_two(source: Path, tmp_path: Path) -> None:
    """Also outside of the folder of the file, where a body had the last part of its place as its name."""
    study = tmp_path / "study"
    study.mkdir()
    source.rename(tmp_path / "monday")
    lab.write_laboratory(tmp_path / "tuesday", 2, 2)
    (study / "campaign.yaml").write_text(
        "version: 1\nrecordings:\n- {experiment: '../monday/phantom-*'}\n- {experiment: '../tuesday/phantom-*'}\n"
    )
    days = [f"../{day}/phantom-0{i}" for day in ("monday", "tuesday") for i in (0, 1)]
    recordings = read_plan(study, tmp_path / "out")[1]
    assert [r.phantom for r in recordings] == [phantom for phantom in days for _ in (0, 1)]
    assert [r.name for r in recordings] == [f"{phantom}/take-0{k}" for phantom in days for k in (0, 1)]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("version: 1\nrecordingz: []\n", "unknown key 'recordingz'"),
        ("version: 1\ndiagnose: {max_effects: 99}\n", "diagnose.max_effects"),
        ("version: 1\nrun: {at_frames: 3.5}\n", ":2: run.at_frames: input should be a valid boolean"),
        ("version: 1\n\nrecordings:\n- {rig: a}\n", ":4: recordings.0: key 'experiment' is missing; add it"),
        ("recordings:\n- {experiment: phantom-00, rig: 1}\n", ":2: recordings.0.rig: should be a text, but it is 1"),
        ("recordings:\n- {experiment: phantom-00, bags: a}\n", "bags: should be a list, but it is 'a'"),
        ("- phantom-00\n", "campaign.yaml: is not a mapping of keys"),
        ("version: 99\n", ":1: version: input should be 1, but it is 99"),
        ("diagnose: {max_effects: true}\n", "diagnose.max_effects: 'true' is not a number"),
        ("diagnose: {candidates: [stifness]}\n", "unknown effect 'stifness'; did you mean 'stiffness'"),
        ("recordings:\n- {experiment: phantom-00}\n- {experiment: phantom-1}\n", "there is no experiment 'phantom-1'"),
        ("recordings:\n- {experiment: phantom-00}\n- {experiment: 'fantom*'}\n", "there is no experiment 'fantom*'"),
        ("recordings:\n- {experiment: phantom-00, bags: ['x*']}\n", "'phantom-00' has no recording x*"),
        ("version: [\n", "not valid YAML"),
        ("version: 1\ndiagnose: {}\ndiagnose: {max_effects: 1}\n", ":3: key 'diagnose' is there twice"),
        ("version: 01\ndiagnose: {max_effects: 010}\n", ":2: 010 begins with a zero"),
    ],
)
def test_a_mistake_in_the_file_is_one_line(source: Path, tmp_path: Path, text: str, said: str) -> None:
    (source / "campaign.yaml").write_text(text)
    with pytest.raises(InputError, match=r"campaign\.yaml") as error:
        read_plan(source, tmp_path / "out")
    assert said in str(error.value)


def test_what_is_no_text_is_one_line(source: Path, tmp_path: Path) -> None:
    """The name of a bag in place of the file's was a traceback."""
    with pytest.raises(InputError, match="is no text that can be read"):
        read_plan(source / "phantom-00" / "take-00.mcap", tmp_path / "out")


@pytest.mark.parametrize("name", ["gel [2]", "a*b", "what?", "Gel\u00e4 <b>&", "\u51dd\u80f6"])
@pytest.mark.parametrize("file", ["", "recordings:\n- {experiment: '%s'}\n- {experiment: 'phantom-*'}\n"])
def test_names_with_signs_of_patterns_are_names(source: Path, tmp_path: Path, name: str, file: str) -> None:
    """Recordings of a folder "gel [2]" were left out without a word."""
    (source / "phantom-01").rename(source / name)
    (source / "campaign.yaml").write_text(file % name if file else lab.ONLY_READ)
    names = {r.name for r in read_plan(source, tmp_path / "out")[1]}
    assert names == {f"{home}/take-0{k}" for home in (name, "phantom-00") for k in (0, 1)}


def test_a_pattern_may_begin_at_the_root_and_fits_no_results(source: Path, tmp_path: Path) -> None:
    """The first was a traceback; and a run's folder beside its experiment was a recording of its own."""
    run = lab.write_phantom(source / "phantom-00-run")
    lab.write_take(run / "run.mcap", 7)
    (run / "metrics.json").write_text("{}")
    lab.write_take(lab.write_phantom(source / "phantom-out" / "x") / "y.mcap", 8)
    (source / "campaign.yaml").write_text(f"recordings:\n- {{experiment: '{source}/phantom-*/**/'}}\n")
    found = read_plan(source, source / "phantom-out")[1]
    assert [r.name for r in found] == [f"phantom-0{i}/take-0{k}" for i in (0, 1) for k in (0, 1)]


def test_experiments_behind_links_are_found_and_links_that_lead_back_are_no_others(
    source: Path, tmp_path: Path
) -> None:
    """A folder with links to the data, as a data store has it, had no recordings."""
    (source / "phantom-01").rename(tmp_path / "stored")
    (source / "phantom-01").symlink_to(tmp_path / "stored")
    (source / "phantom-00" / "up").symlink_to(source)
    names = [r.name for r in read_plan(source, tmp_path / "out")[1]]
    assert names == [*(f"../stored/take-0{k}" for k in (0, 1)), *(f"phantom-00/take-0{k}" for k in (0, 1))]


def test_an_experiment_within_another_is_no_bag_of_that(source: Path, tmp_path: Path) -> None:
    """Its folder, which holds bags, was run with the outer experiment."""
    lab.write_phantom(tmp_path / "outer")
    for path in (tmp_path / "outer").iterdir():
        path.rename(source / path.name)
    assert {r.experiment for r in read_plan(source, tmp_path / "out")[1]} == {source / f"phantom-0{i}" for i in (0, 1)}


def test_namesakes_have_names_of_their_own(source: Path, tmp_path: Path) -> None:
    """A third recording that is called as the number would make it: two rows had one name, and one's problem."""
    home = source / "phantom-00"
    (home / "bags").mkdir()
    lab.write_take(home / "take-00~2.mcap", 8)
    lab.write_take(home / "bags" / "take-00.mcap", 9)
    names = [r.name for r in read_plan(source, tmp_path / "out")[1] if r.phantom == "phantom-00"]
    assert names == [f"phantom-00/take-0{k}" for k in ("0", "0~2", "0~3", "1")]


def test_a_name_that_is_no_text_is_one_line(source: Path, tmp_path: Path) -> None:
    """Of a disk with another encoding: no table or page can hold it, and it was a traceback after all was done."""
    os.rename(os.fsencode(source / "phantom-00" / "take-00.mcap"), os.fsencode(source / "phantom-00") + b"/t\xe9.mcap")
    with pytest.raises(InputError, match="its name is not UTF-8"):
        read_plan(source, tmp_path / "out")


def test_a_folder_without_recordings_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no recording"):
        read_plan(tmp_path, tmp_path / "out")


def test_a_key_follows_the_content_and_nothing_else(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    keys = [j.key for j in planned(source, tmp_path / "out")]
    assert len(set(keys)) == 4
    os.utime(source / "phantom-00" / "take-00.mcap")
    (source / "phantom-01").rename(source / "renamed")
    assert [j.key for j in planned(source, tmp_path / "out")] == keys
    (source / "phantom-00" / "take-00.mcap").unlink()
    lab.write_take(source / "phantom-00" / "take-00.mcap", 9)
    assert [a == b for a, b in zip([j.key for j in planned(source, tmp_path / "out")], keys, strict=True)] == [
        *(False, True, True, True)
    ]
    experiment = source / "renamed" / "experiment.yaml"
    experiment.write_text(experiment.read_text().replace("8000", "9000"))
    changed = [j.key for j in planned(source, tmp_path / "out")]
    assert [a == b for a, b in zip(changed, keys, strict=True)] == [False, True, False, False]
    monkeypatch.setattr(jobs_module, "versions", lambda: {"livedeform": "another"})
    assert not set(changed) & {j.key for j in planned(source, tmp_path / "out")}


def test_the_name_of_a_bags_folder_is_in_its_key(source: Path, tmp_path: Path) -> None:
    """An experiment says by that name what acts in it: renamed to what it says something of, the old row was shown."""
    home = source / "phantom-00"
    (home / "slow").mkdir()
    (home / "take-00.mcap").rename(home / "slow" / "x.mcap")
    before = {j.recording.name: j.key for j in planned(source, tmp_path / "out")}
    (home / "slow").rename(home / "fast")
    after = {j.recording.name: j.key for j in planned(source, tmp_path / "out")}
    assert after["phantom-00/fast"] != before["phantom-00/slow"]
    assert after["phantom-00/take-01"] == before["phantom-00/take-01"]


def test_what_cannot_be_read_has_its_line_and_the_rest_goes_on(source: Path, tmp_path: Path) -> None:
    (source / "phantom-00" / "experiment.yaml").write_text("version: 1\nname: x\nphantomm: {}\n")
    found = planned(source, tmp_path / "out")
    assert ["unknown key 'phantomm'" in j.wrong for j in found] == [True, True, False, False]
    assert [j.failure != "" for j in found] == [True, True, False, False]
