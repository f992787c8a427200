"""What a run counts is what was recorded: each moment once, of this recording, as far as it was played."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import small

from livedeform.common.bags.read import read_bag
from livedeform.common.errors import InputError
from livedeform.common.experiment.yaml_file import load_experiment
from livedeform.common.types import MarkerFrame, Prediction
from livedeform.compare_node.judgement import judge
from livedeform.comparing.identity import digest_of
from livedeform.comparing.page import takes_of
from livedeform.comparing.runs import compared, load_runs
from livedeform.comparing.takes import read_take
from livedeform.fem_node.model import PhantomModel
from livedeform.report.run.read import load_evidence
from livedeform.run.running import WRITES, RunOptions, run

SIZE = float(np.linalg.norm(small.OFFSET))


def measured(direct: list[Prediction], sigma: float = 5e-5) -> list[MarkerFrame]:
    return [small.frame(p.stamp_ns, p.ids, p.markers + small.OFFSET, sigma) for p in direct]


def of(frame: MarkerFrame, rows: slice) -> MarkerFrame:
    """Some of a frame's markers."""
    return replace(frame, ids=frame.ids[rows], points=frame.points[rows], covariances=frame.covariances[rows],
                   reprojection_error_px=frame.reprojection_error_px[rows])  # fmt: skip


def results(out: Path) -> dict[str, Any]:
    return json.loads((out / "metrics.json").read_text())


def silent(*_: object) -> None:
    """No progress."""


SENT: dict[str, tuple[Callable[[MarkerFrame], list[MarkerFrame]], int]] = {
    "twice": (lambda f: [f, f], 12),
    "thrice": (lambda f: [f, f, f], 24),
    "in two halves": (lambda f: [of(f, slice(0, 6)), of(f, slice(6, None))], 0),
    "in two halves, one twice": (lambda f: [of(f, slice(0, 6)), of(f, slice(6, None)), of(f, slice(0, 6))], 12),
}


@pytest.mark.parametrize("name", SENT)
def test_a_moment_counts_once_however_often_it_is_sent(
    name: str, experiment: Path, direct: list[Prediction], tmp_path: Path
):
    """Twice made "only 12 of 24 measured frames were compared", halves lost the second half of the markers."""
    send, left_out = SENT[name]
    frames = [sent for frame in measured(direct) for sent in send(frame)]
    run(RunOptions(experiment, small.write_bag(tmp_path / "b.mcap", small.press(), frames), tmp_path / "out"), silent)
    told = results(tmp_path / "out")
    coverage = told["coverage"]
    assert (coverage["frames_measured"], coverage["frames_compared"], coverage["repeated"]) == (12, 12, left_out)
    assert told["error"]["n"] == 12 * 11 and told["error"]["rmse"] == pytest.approx(SIZE, abs=1e-8)
    assert (f"{left_out} measured frames were left out: their stamp was there already" in told["reason"]) == (
        left_out > 0
    )


def recorded(path: Path, frames: list[MarkerFrame], poses: list[Any] | None = None) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    return small.write_bag(path, small.press() if poses is None else poses, frames)


def test_a_recording_is_told_by_what_was_measured(
    experiment: Path, direct: list[Prediction], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """From two folders `--bag rec.mcap` was one recording; from one folder and its parent one recording was two."""
    other = [replace(f, points=f.points + 1e-4) for f in measured(direct)]
    a, b = recorded(tmp_path / "a" / "rec.mcap", measured(direct)), recorded(tmp_path / "b" / "rec.mcap", other)
    for folder in (a.parent, b.parent):
        monkeypatch.chdir(folder)
        run(RunOptions(experiment, Path("rec.mcap"), Path("out")), silent)
    monkeypatch.chdir(tmp_path)
    run(RunOptions(experiment, Path("a/rec.mcap"), Path("again")), silent)
    run(RunOptions(experiment, Path("a/out"), Path("replayed")), silent)
    outs = [a.parent / "out", b.parent / "out", tmp_path / "again", tmp_path / "replayed"]
    digests = [results(out)["recording"]["digest"] for out in outs]
    assert [d == digests[0] for d in digests] == [True, False, True, True]
    loaded = load_runs(outs)
    assert [compared(loaded[0], r) is None for r in loaded[1:]] == [True, False, False]
    assert [takes.names for takes in takes_of(loaded[:1] + loaded[2:])] == []
    run(RunOptions(experiment, b, tmp_path / "third", repeats=(outs[0],)), silent)
    assert results(tmp_path / "third")["next_take"]["takes"] == ["rec", "rec"]
    with pytest.raises(InputError, match="counts already"):
        run(RunOptions(experiment, a, tmp_path / "fourth", repeats=(outs[2],)), silent)
    for out, bag in zip(outs, ("a", "b", "a", "a"), strict=True):  # as results of before, which said no digest
        (out / "metrics.json").write_text(json.dumps(results(out) | {"recording": None}))
        assert (read_take(out).source == digests[0]) == (bag == "a")


def test_pictures_and_what_is_found_in_them_are_one_recording(filmed: small.Filmed, tmp_path: Path):
    run(RunOptions(filmed.folder, filmed.bag, tmp_path / "one"), silent)
    run(RunOptions(filmed.folder, tmp_path / "one", tmp_path / "two"), silent)
    dark = [(replace(a, pixels=a.pixels // 2), b) for a, b in filmed.pairs]
    other = small.write_picture_bag(tmp_path / "dark.mcap", small.press(6), dark)
    with read_bag(filmed.bag) as bag, read_bag(other) as another:
        digests = digest_of(bag), digest_of(another)
    assert results(tmp_path / "one")["recording"]["digest"] == results(tmp_path / "two")["recording"]["digest"]
    assert results(tmp_path / "one")["recording"]["digest"] == digests[0] != digests[1]


@pytest.mark.parametrize("changes", [{"start": 0.25}, pytest.param({"duration": 0.3}, marks=pytest.mark.slow)])
def test_a_part_of_a_recording_is_no_take(changes: dict, experiment: Path, bag: Path, tmp_path: Path):
    run(RunOptions(experiment, bag, tmp_path / "part", **changes), silent)
    assert results(tmp_path / "part")["recording"]["whole"] is False
    run(RunOptions(experiment, tmp_path / "part", tmp_path / "again"), silent)
    assert results(tmp_path / "again")["recording"]["whole"] is False
    for repeats, options in (((tmp_path / "part",), {}), ((), {}), ((tmp_path / "part",), changes)):
        out = tmp_path / f"out{len(repeats)}{len(options)}"
        if not repeats:
            run(RunOptions(experiment, bag, out, duration=60.0), silent)  # more than there is: all of it
            assert results(out)["recording"]["whole"] is True
            continue
        with pytest.raises(InputError, match="a part of"):
            run(RunOptions(experiment, bag, out, repeats=repeats, **options), silent)


def test_what_is_not_played_does_not_judge_what_is(experiment: Path, direct: list[Prediction], tmp_path: Path):
    """Begun in the middle of a press, a recording is in doubt; of a part of one that begins above the body the model
    comes there as in a run of the whole, and only what is not recorded is in doubt."""
    bag = recorded(tmp_path / "rec.mcap", measured(direct))
    said: list[str] = []
    run(RunOptions(experiment, bag, tmp_path / "out", start=0.3), lambda text, *_: said.append(text))
    cut = recorded(tmp_path / "cut.mcap", measured(direct)[6:], small.press()[6:])
    of_cut: list[str] = []
    run(RunOptions(experiment, cut, tmp_path / "of_cut"), lambda text, *_: of_cut.append(text))
    inside = "warning: the recording begins with the probe"
    told, told_of_cut = results(tmp_path / "out"), results(tmp_path / "of_cut")
    assert [x for x in of_cut if x.startswith(inside)] != [] and told_of_cut["verdict"] == "WARN"
    assert len(told_of_cut["doubts"]) == 1
    assert [x for x in said if x.startswith("warning")] == [] and told["doubts"] == [] and told["verdict"] == "OK"
    whole: list[str] = []
    run(RunOptions(experiment, bag, tmp_path / "whole"), lambda text, *_: whole.append(text))
    assert not any(x.startswith(inside) for x in whole)


def test_a_part_without_poses_is_refused_in_a_line(experiment: Path, direct: list[Prediction], tmp_path: Path):
    bag = recorded(tmp_path / "rec.mcap", measured(direct), small.press()[:8])
    with pytest.raises(InputError, match="no /probe/pose in the part that is to be played"):
        run(RunOptions(experiment, bag, tmp_path / "out", start=0.45), silent)
    assert not (tmp_path / "out").exists()


def test_a_run_keeps_the_markers_that_were_declared(direct: list[Prediction], tmp_path: Path):
    """The page and `compare` read today's file: other sigmas, another verdict than the run's own."""
    folder = small.write_experiment(tmp_path / "declared", threshold=0.0009)
    head, *rows = (folder / "markers.csv").read_text().split()
    places = "\n".join([head + ",sigma", *(row + ",0.001" for row in rows)]) + "\n"
    (folder / "markers.csv").write_text(places)
    run(RunOptions(folder, recorded(tmp_path / "rec.mcap", measured(direct)), tmp_path / "out"), silent)
    told, page = results(tmp_path / "out"), unescape((tmp_path / "out" / "report.html").read_text())
    assert told["verdict"] == "WARN" and all(part in page for part in told["reason"].split(": ", 1))
    (folder / "markers.csv").write_text("\n".join([head, *rows[:-2]]) + "\n")
    assert (tmp_path / "out" / "declared_markers.csv").read_text() == places
    again = load_evidence(tmp_path / "out", load_experiment(tmp_path / "out"))
    assert again.metrics is not None
    assert judge(again.metrics).sentence == told["reason"]
    assert [again.metrics.rmse.low, again.metrics.rmse.high] == pytest.approx(told["interval_95"]["rmse"])
    (shown,) = load_runs([tmp_path / "out"])
    assert [shown.metrics.rmse.low, shown.metrics.rmse.high] == pytest.approx(told["interval_95"]["rmse"])
    assert (shown.metrics.n, shown.metrics.places) == (told["error"]["n"], pytest.approx(told["places"]))


def test_what_contradicts_the_model_at_rest_is_on_the_page(experiment: Path, tmp_path: Path):
    model = PhantomModel.from_experiment(load_experiment(experiment))
    still = [replace(small.press()[0], stamp_ns=small.START_NS + k * small.STEP_NS) for k in range(8)]
    frames = measured([model.predict(pose) for pose in still])
    run(RunOptions(experiment, recorded(tmp_path / "rec.mcap", frames, still), tmp_path / "out"), silent)
    told = [r for r in results(tmp_path / "out")["rest"] if r["contradicts"]]
    assert len(told) == 2
    page = unescape((tmp_path / "out" / "report.html").read_text())
    assert all(r["text"] in page for r in told)
    evidence = load_evidence(tmp_path / "out", load_experiment(tmp_path / "out"))
    assert evidence.metrics is not None and [r.text for r in evidence.metrics.rest] == [r["text"] for r in told]


def test_forced_results_leave_nothing_of_the_earlier_ones(experiment: Path, bag: Path, tmp_path: Path):
    (tmp_path / "out").mkdir()
    for name in (*WRITES, "mine.txt"):
        (tmp_path / "out" / name).write_text("of before")
    run(RunOptions(experiment, bag, tmp_path / "out", force=True), silent)
    left = [p.name for p in (tmp_path / "out").iterdir() if p.read_bytes() == b"of before"]
    assert left == ["mine.txt"]
