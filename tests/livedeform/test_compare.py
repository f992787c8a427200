"""livedeform compare: runs side by side, paired by stamp and marker, with intervals that mean something."""

from __future__ import annotations

import csv
import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from livedeform.cli import run as cli
from livedeform.common.errors import InputError
from livedeform.compare_node.metrics import Statistic, run_metrics
from livedeform.compare_node.residual import Residual
from livedeform.comparing.page import against_row, sentence, table_row, takes_of, verdict_of, write_comparison
from livedeform.comparing.runs import ComparedRun, compared, distinct_names, load_runs
from livedeform.comparing.takes import Take, groups, read_model, read_repeats, read_take, refuse_other_meshes, together

MARKERS = np.arange(1, 11, dtype=np.uint32)


def made(name: str, errors: np.ndarray, *, start: int = 0, ids: np.ndarray = MARKERS) -> ComparedRun:
    """A run with errors (frames, markers, 3) m."""
    nothing = np.full((len(ids), 3, 3), np.nan)
    residuals = tuple(
        Residual(10**9 + (start + k) * 10**8, ids, e, np.zeros_like(e), nothing) for k, e in enumerate(errors)
    )
    return ComparedRun(name, Path(name), "OK", "b.mcap", residuals, run_metrics(residuals, 0.001), 10**9)


def noise(seed: int, sigma: float, n: int = 60) -> np.ndarray:
    return np.random.default_rng(seed).normal(0.0, sigma, (n, len(MARKERS), 3))


def test_the_difference_of_pairs() -> None:
    """A common part that is common to both drops out: the interval is of the difference, not of both errors."""
    common = noise(1, 1e-3)
    reference, other = made("a", common), made("b", 0.9 * common)
    difference = compared(reference, other)
    assert difference is not None
    assert difference.n == 600 and difference.n_frames == 60
    assert difference.difference.value == pytest.approx(-0.1 * difference.reference)
    assert difference.difference.value == pytest.approx(difference.other - difference.reference)
    assert difference.difference.low < difference.difference.value < difference.difference.high < 0
    alone = reference.metrics.rmse.high - reference.metrics.rmse.low
    assert difference.difference.high - difference.difference.low < 0.2 * alone  # measured 0.1
    assert "10 % smaller" in sentence(difference, "a")
    marker = difference.markers[3]
    assert marker.id == 4 and marker.n == 60 and marker.difference.high < 0


@pytest.mark.statistical
def test_equal_runs_are_told_apart_no_more_often_than_stated() -> None:
    """Of pairs that differ by noise alone about one in twenty has an interval without zero."""
    wrong, few = 0, MARKERS[:3]
    for seed in range(60):
        a, b = (noise(2 * seed + side, 1e-3)[:, :3] for side in (0, 1))
        difference = compared(made("a", a, ids=few), made("b", b, ids=few))
        assert difference is not None
        wrong += not difference.difference.low <= 0.0 <= difference.difference.high
    assert wrong <= 9  # 3 of 60 are expected; more than 9 come by chance once in a thousand


def test_only_common_stamps_and_markers_count() -> None:
    errors = noise(3, 1e-3)
    reference = made("a", errors[:40])
    other = made("b", errors[10:, 2:], start=10, ids=MARKERS[2:])
    difference = compared(reference, other)
    assert difference is not None
    assert difference.n_frames == 30 and difference.n == 30 * 8
    assert difference.difference.value == 0.0
    assert "cannot be told apart" in sentence(difference, "a")
    assert compared(reference, made("c", errors, start=1000)) is None


@pytest.mark.parametrize(
    ("factor", "said"),
    [(0.5, "50 % smaller"), (1.004, "0.4 % larger"), (0.9998, "0.02 % smaller"), (1.00001, "than 0.01 % larger")],
)
def test_a_small_difference_is_not_shown_as_none(tmp_path: Path, factor: float, said: str) -> None:
    """It was "0 % smaller", by "-0.000 mm, -0.000 to -0.000"."""
    common = noise(1, 1e-3)
    runs = [made("a", common), made("b", factor * common)]
    difference = compared(*runs)
    assert difference is not None and said in sentence(difference, "a")
    value, between = against_row(difference)[-2:]
    ends = [float(end) for end in between.split(" to ")]
    assert np.sign([float(value), *ends]).tolist() == 3 * [np.sign(factor - 1.0)]
    assert float(value) == pytest.approx(1e3 * difference.difference.value, rel=0.06)
    write_comparison(tmp_path, runs, [difference])
    rows = list(csv.DictReader((tmp_path / "markers.csv").open()))
    assert all(float(row["difference (mm)"]) * (factor - 1.0) > 0.0 for row in rows)


def test_small_errors_and_no_difference_have_no_false_signs() -> None:
    tiny, same = made("a", 1e-4 * noise(1, 1e-3)), compared(made("a", noise(1, 1e-3)), made("a", noise(1, 1e-3)))
    assert float(table_row(tiny)[5]) == pytest.approx(1e3 * tiny.metrics.rmse.value, rel=0.05)
    assert same is not None and against_row(same)[-2:] == ("0.000", "0.000 to 0.000")
    exact = compared(made("a", 0.0 * noise(1, 1e-3)), made("b", noise(1, 1e-3)))
    assert exact is not None and sentence(exact, "a") == "the error of b is larger than that of a"


def test_swapped_runs_say_the_opposite() -> None:
    """A run that is worse was shown with the mark of what is good."""
    a, b = made("a", noise(1, 1e-3)), made("b", 1.3 * noise(1, 1e-3))
    there, back = compared(a, b), compared(b, a)
    assert there is not None and back is not None
    ends = [(d.difference.low, d.difference.value, d.difference.high) for d in (there, back)]
    assert ends[0] == pytest.approx([-end for end in ends[1][::-1]], rel=1e-9)
    assert (verdict_of([a, b], [there]).tone, verdict_of([b, a], [back]).tone) == ("warn", "good")
    assert verdict_of([a, b, b], [there, back]).tone == "warn"


def test_many_frames_are_compared_in_a_moment() -> None:
    """60 markers in 2000 frames took 23 s on a machine where this takes 2 s; with 10 000 frames, minutes. By how long
    the same processor sorts."""
    ids, rng = np.arange(30, dtype=np.uint32), np.random.default_rng(0)
    errors = rng.normal(0.0, 1e-3, (1500, 30, 3))
    runs = made("a", errors, ids=ids), made("b", 0.9 * errors, ids=ids)
    began = time.process_time()
    found = compared(*runs)
    took = time.process_time() - began
    numbers = rng.random(5_000_000)
    began = time.process_time()
    numbers.sort()
    assert took < 70.0 * (time.process_time() - began)  # measured 19 to 25, and ten times as much before
    assert found is not None and len(found.markers) == 30
    assert found.markers[3].difference.value == pytest.approx(-0.1 * found.markers[3].reference)


def test_the_tables_and_the_page(tmp_path: Path) -> None:
    runs = [made("a", noise(4, 1e-3)), made("b", noise(4, 0.5e-3)), made("c", noise(4, 1e-3), start=500)]
    differences = [compared(runs[0], run) for run in runs[1:]]
    write_comparison(tmp_path, runs, differences)
    document = json.loads((tmp_path / "compare.json").read_text())
    assert document["runs"][1]["rmse"]["value"] == runs[1].metrics.rmse.value
    assert document["differences"][1] is None
    rows = list(csv.DictReader((tmp_path / "markers.csv").open()))
    assert len(rows) == 10 and rows[0]["run"] == "b"
    page = (tmp_path / "compare.html").read_text()
    for words in ("50 % smaller", "no moment in common): c", "Error over time", "Difference per marker"):
        assert words in page


def test_bare_recordings_of_runs_are_paired_only_if_of_one_recording() -> None:
    """Without results beside them stamps that are alike made pairs of two recordings, as imported ones begin at 0."""
    runs = [replace(made(k, noise(4, 1e-3)), digest=digest) for k, digest in (("a", "x"), ("b", "y"), ("c", "x"))]
    assert compared(runs[0], runs[1]) is None
    assert compared(runs[0], runs[2]) is not None
    assert compared(runs[0], replace(runs[1], digest="")) is not None  # nothing is known of it


@pytest.mark.parametrize(
    "text", ["{", "", "[1]", "null", '{"error": null}', '{"error": {"rmse": 1.0}, "markers": [{}]}']
)
def test_torn_results_are_one_line(tmp_path: Path, text: str) -> None:
    folder = written(tmp_path / "a", "a.mcap", 1e-3)
    (folder / "metrics.json").write_text(text)
    with pytest.raises(InputError, match="is no run"):
        read_take(folder)


def test_names_are_as_short_as_they_can_be() -> None:
    assert distinct_names([Path("/x/before"), Path("/x/after")]) == ["before", "after"]
    assert distinct_names([Path("/x/a/run"), Path("/x/b/run")]) == ["a/run", "b/run"]
    assert distinct_names([Path("/x/a"), Path("/x/a/run.mcap")]) == ["/x/a (1)", "/x/a (2)"]


def test_what_is_no_run_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(InputError, match="is no run"):
        load_runs([tmp_path])
    assert cli(["compare", str(tmp_path)]) == 2
    assert "two runs or more" in capsys.readouterr().err


def written(
    folder: Path, bag: str, rmse: float, *, density: float = 1000.0, markers: tuple[int, ...] = (1, 2), **said: object
) -> Path:
    """The results of a run of a recording, as `livedeform run` leaves them; ``said`` beside in its metrics."""
    folder.mkdir(parents=True)
    error = {"rmse": rmse, "mean": 0.8 * rmse, "p95": 1.9 * rmse}
    rows = [{"id": m, "rmse": rmse * (1.0 + 0.1 * m)} for m in markers]
    document = {"bag": bag, "recording": {"digest": bag, "whole": True}, "error": error, "markers": rows}
    (folder / "metrics.json").write_text(json.dumps(document | said))
    (folder / "configuration.json").write_text(json.dumps({"options": {"bag": bag}}))
    phantom = f"{{density: {density}, surface: {folder}/b.stl, markers: m.csv}}"
    (folder / "experiment.yaml").write_text(f"name: beam\nphantom: {phantom}\n")
    (folder / "m.csv").write_text("id,x,y,z\n1,0,0,0.01\n2,0,0,0.02\n")
    return folder


def repeats(paths: list[Path], bag: str, of: Path) -> list[Take]:
    """What `livedeform run --bag BAG --repeat PATHS` reads, with the model of the run ``of``."""
    return read_repeats(paths, Path(bag), bag, read_model(of / "experiment.yaml"))


def test_runs_of_other_takes_say_what_the_next_one_may_be(tmp_path: Path) -> None:
    first, second = (written(tmp_path / k, f"{k}.mcap", e) for k, e in (("a", 1.0e-3), ("b", 1.2e-3)))
    others = repeats([first, second], "c.mcap", first)
    both = together(others)
    low, high = both.expected["rmse"].next
    s = np.log(1.2) / np.sqrt(2.0)
    assert np.log(high / low) == pytest.approx(2.0 * 12.706 * s * np.sqrt(1.5), rel=1e-4)
    assert set(both.markers) == {1, 2} and both.markers[1].freedom == pytest.approx(1.0)  # all markers differ alike
    assert "from 2 takes: a, b" in both.text
    assert np.isnan(together(others[:1]).expected["rmse"].next).all() and "--repeat" in together(others[:1]).text
    assert together([*others, others[0]]).expected == both.expected  # a take that is there twice counts once


def test_what_is_no_other_take_is_refused(tmp_path: Path) -> None:
    a = written(tmp_path / "a", "a.mcap", 1e-3)
    heavier = written(tmp_path / "heavier", "b.mcap", 1e-3, density=2000.0)
    for path, bag, why in ((tmp_path, "c.mcap", "is no run"), (heavier, "c.mcap", "another experiment or model"),
                           (a, "a.mcap", "counts already")):  # fmt: skip
        with pytest.raises(InputError, match=why):
            repeats([path], bag, a)


def test_runs_of_other_recordings_are_takes_and_not_pairs(tmp_path: Path) -> None:
    """Stamps that are alike, as every imported take begins at 0, do not make one recording of two."""
    runs = [
        replace(made(k, noise(4, 1e-3)), bag=f"{k}.mcap", take=read_take(written(tmp_path / k, f"{k}.mcap", e), k))
        for k, e in (("a", 1.0e-3), ("b", 1.2e-3))
    ]
    assert compared(runs[0], runs[1]) is None
    (takes,) = takes_of(runs)
    assert takes.names == ("a", "b") and takes.expected["rmse"].freedom == 1
    write_comparison(tmp_path, runs, [None])
    assert "The next take" in (tmp_path / "compare.html").read_text()
    assert json.loads((tmp_path / "compare.json").read_text())["next_takes"][0]["degrees_of_freedom"] == 1.0


def test_a_recording_is_one_wherever_it_lies(tmp_path: Path) -> None:
    """`rec.mcap` of two folders was taken for one recording, and one recording for two when run from elsewhere."""
    a, b = (written(tmp_path / k, "rec.mcap", e, recording={"digest": k, "whole": True})
            for k, e in (("a", 1e-3), ("b", 1.2e-3)))  # fmt: skip
    again = written(tmp_path / "again", "../x/rec.mcap", 1.001e-3, recording={"digest": "a", "whole": True})
    (found,) = groups(read_take(path) for path in (a, b, again))
    assert [take.path for take in found] == [a, b]
    assert len(repeats([a, b], "c.mcap", a)) == 2
    with pytest.raises(InputError, match="counts already"):
        repeats([a, again], "c.mcap", a)


def test_results_of_before_are_told_by_their_recording_or_where_it_lay(tmp_path: Path) -> None:
    where = {"full": (str(tmp_path / "rec.mcap"), 1), "again": (str(tmp_path / "rec.mcap"), 1),
             "short": ("rec.mcap", 2), "as short": ("rec.mcap", 3)}  # fmt: skip
    takes = [read_take(written(tmp_path / k, bag, 1e-3 * (1 + n), recording=None)) for k, (bag, n) in where.items()]
    assert [take.source == takes[0].source for take in takes] == [True, True, False, False]
    assert takes[2].source != takes[3].source  # a name says nothing of the folder that it was typed in


def test_a_recording_that_is_there_twice_counts_once_in_all_numbers(tmp_path: Path) -> None:
    """The shared scatter of takes counted it twice: an interval of the next take without any width."""
    runs = [made(k, noise(4, 1e-3)) for k in ("a", "again", "b")]
    paths = [written(tmp_path / k, f"{k}.mcap", e) for k, e in (("a", 1.0e-3), ("again", 1.0e-3), ("b", 1.2e-3))]
    loaded = [replace(run, take=read_take(path)) for run, path in zip(runs, paths, strict=True)]
    assert takes_of(loaded[:2]) == []
    (takes,) = takes_of(loaded)
    assert len(takes.names) == takes.expected["rmse"].n == 2 and takes.expected["rmse"].freedom == 1
    assert takes.expected == together([run.take for run in loaded if run.take is not None]).expected


def test_other_elements_or_markers_are_another_model(tmp_path: Path) -> None:
    a = written(tmp_path / "a", "a.mcap", 1e-3, mesh={"digest": "coarse"})
    finer = written(tmp_path / "finer", "b.mcap", 1.1e-3, mesh={"digest": "fine"})
    moved = written(tmp_path / "moved", "c.mcap", 1.2e-3, mesh={"digest": "coarse"})
    (moved / "m.csv").write_text("id,x,y,z\n1,0,0,0.01\n2,0,0,0.021\n")
    renamed = written(tmp_path / "renamed", "d.mcap", 1.3e-3, mesh={"digest": "coarse"})
    (renamed / "m.csv").rename(renamed / "n.csv")
    text = (renamed / "experiment.yaml").read_text()
    (renamed / "experiment.yaml").write_text(text.replace("m.csv", "n.csv"))
    (found,) = groups(read_take(path) for path in (a, finer, moved, renamed))
    assert [take.path for take in found] == [a, renamed]
    with pytest.raises(InputError, match="another experiment or model"):
        repeats([moved], "e.mcap", a)
    refuse_other_meshes(repeats([renamed], "e.mcap", a), "coarse")
    with pytest.raises(InputError, match="another experiment or model"):
        refuse_other_meshes(repeats([finer], "e.mcap", a), "coarse")


@pytest.mark.parametrize("said", [
    {"recording": {"digest": "p", "whole": False}}, {"recording": None, "interrupted": True}, {"recording": None},
    {"verdict": "STALE"},
])  # fmt: skip
def test_a_part_of_a_recording_is_no_take(tmp_path: Path, said: dict) -> None:
    whole, part = written(tmp_path / "a", "a.mcap", 1e-3), written(tmp_path / "part", "p.mcap", 2e-3, **said)
    if said == {"recording": None}:  # of an older version
        (part / "configuration.json").write_text(json.dumps({"options": {"bag": "p.mcap", "start": 1.0}}))
    assert groups(read_take(path) for path in (whole, part)) == []
    with pytest.raises(InputError, match="only a part of its recording"):
        repeats([part], "c.mcap", whole)


def test_too_few_frames_for_an_interval_are_no_good_news(tmp_path: Path) -> None:
    """Without an interval the page's verdict was shown as good."""
    few = [made(k, noise(s, 1e-3, n=2)) for k, s in (("a", 1), ("b", 2))]
    difference = compared(few[0], few[1])
    assert difference is not None
    unknown = replace(difference, difference=Statistic(1e-3, float("nan"), float("nan")))
    assert verdict_of(few, [unknown]).tone == "neutral"
    better = replace(difference, difference=Statistic(-1e-3, -2e-3, -1e-4))
    assert verdict_of(few, [better]).tone == "good"


def test_what_either_had_no_answer_for_is_no_good_news(tmp_path: Path) -> None:
    """A model that found no equilibrium in the presses, 4 mm off before, was better by its easy frames at rest."""
    errors = np.vstack([noise(1, 2e-4, n=20), noise(2, 4e-3, n=80)])
    declared, fitted = made("declared", errors), replace(made("fitted", 0.9 * errors[:20]), verdict="STALE")
    verdict = verdict_of([declared, fitted], [compared(declared, fitted)])
    assert verdict.tone == "warn"
    assert "20 of the 100 frames that declared compared" in verdict.said and "fitted most was not" in verdict.said
    whole = made("whole", 0.9 * errors)
    assert verdict_of([declared, whole], [compared(declared, whole)]).tone == "good"
    other = verdict_of([fitted, whole], [compared(fitted, whole)])
    assert other.tone == "warn" and "20 of the 100 frames that whole compared" in other.said
