"""The graph in one process: it agrees with direct calls, with itself, and says what it could not compare."""

from __future__ import annotations

import csv
import itertools
import json
import os
import shutil
import time
from pathlib import Path

import numpy as np
import pytest
import small
from std_msgs.msg import Float64

from livedeform.cli import run as command_line
from livedeform.common import topics as t
from livedeform.common.bags.read import read_bag
from livedeform.common.bags.recording import load_recording
from livedeform.common.bags.recording_writer import RecordingWriter
from livedeform.common.bags.write import BagWriter
from livedeform.common.experiment.yaml_file import load_experiment
from livedeform.common.ros.node import CountingNode
from livedeform.common.ros.session import ros
from livedeform.common.ros.traffic import Traffic
from livedeform.common.types import Prediction
from livedeform.comparing.runs import load_runs
from livedeform.run.graph import Graph
from livedeform.run.running import ISOLATE, RunOptions, isolated, run

SIZE = float(np.linalg.norm(small.OFFSET))


def silent(*_: object) -> None:
    """No progress."""


@pytest.fixture(scope="module")
def first(experiment: Path, bag: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("first") / "run"
    run(RunOptions(experiment, bag, out), silent)
    return out


def test_predictions_are_those_of_direct_calls(first: Path, direct: list[Prediction]):
    recording = load_recording(first / "run.mcap")
    assert [p.stamp_ns for p in recording.predictions] == [p.stamp_ns for p in direct]
    for there, here in zip(recording.predictions, direct, strict=True):
        np.testing.assert_allclose(there.points, here.markers, atol=4e-9)  # float32 on the wire; measured 1.9e-9
    for there, here in zip(recording.predicted_wrenches, direct, strict=True):
        np.testing.assert_allclose(there.force, here.force, rtol=1e-6, atol=1e-6)
    assert np.abs([p.force[2] for p in direct]).max() > 0.1  # N: the probe does press


def test_error_is_what_was_added_to_the_markers(first: Path):
    metrics = json.loads((first / "metrics.json").read_text())
    assert metrics["error"]["rmse"] == pytest.approx(SIZE, abs=1e-8)
    assert metrics["error"]["n"] == 12 * 11
    assert metrics["verdict"] == "OK"
    counts = metrics["counts"]
    assert counts["association"]["matched_frames"] == counts["association"]["measured_frames"] == 12
    assert counts["model"] == {"predicted": 12, "not_converged": 0, "skipped": 0, "unfinished": 0}
    assert counts["lost_messages"] == {}
    with (first / "markers.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 132
    for axis, value in zip("xyz", small.OFFSET, strict=True):
        assert {round(float(row[f"error_{axis}"]), 7) for row in rows} == {round(float(value), 7)}


def test_the_probe_study_reads_the_run(first: Path, tmp_path: Path):
    assert command_line(["study", "probe", "--data", str(first), "--out", str(tmp_path / "out")]) == 0
    numbers = json.loads((tmp_path / "out" / "study.json").read_text())["numbers"]
    assert numbers["paired"]["n"] == 11
    assert numbers["paired"]["largest_m"] < 1e-7  # the markers are off by the same offset in every frame
    assert numbers["maxima"]["at_press_m"] == pytest.approx(SIZE, abs=1e-7)
    assert numbers["lesion"]["t1"]["0.001"] > 0.99


def test_two_runs_give_the_same_metrics_to_the_last_digit(first: Path, experiment: Path, bag: Path, tmp_path: Path):
    run(RunOptions(experiment, bag, tmp_path / "second"), silent)
    for name in ("metrics.json", "markers.csv"):
        assert (tmp_path / "second" / name).read_bytes() == (first / name).read_bytes()


def test_everything_is_in_the_recording(first: Path, bag: Path):
    with read_bag(first / "run.mcap") as recorded, read_bag(bag) as played:
        counts = {name: info.count for name, info in recorded.topics.items()}
        for topic in (t.PROBE_POSE, t.STEREO_MARKERS):
            ours = [(m.log_time_ns, m.data) for m in recorded.messages([topic])]
            assert ours == [(m.log_time_ns, m.data) for m in played.messages([topic])]
        metadata = recorded.metadata
    for topic in (t.FEM_SURFACE, t.FEM_MARKERS, t.FEM_LESIONS, t.FEM_WRENCH, t.FEM_STATUS):
        assert counts[topic] == 12, topic
    for topic in (t.COMPARE_MARKERS, t.COMPARE_RMSE, t.COMPARE_MEAN, t.COMPARE_P95, t.COMPARE_MAX):
        assert counts[topic] == 12, topic
    assert counts[t.FEM_MESH] == 6  # every 0.1 s
    assert counts[t.COMPARE_METRICS] == 13  # and once more at the end
    assert "small-block" in metadata["experiment"] and "version livedeform" in metadata and "options" in metadata


def test_the_effective_configuration_lies_beside_the_results(first: Path):
    assert load_experiment(first).name == "small-block"
    configuration = json.loads((first / "configuration.json").read_text())
    assert configuration["versions"]["numpy"] == np.__version__
    assert configuration["options"]["start"] == 0.0
    assert (first / "report.html").stat().st_size > 10_000


def test_predictions_are_interpolated_and_never_extrapolated(
    experiment: Path, direct: list[Prediction], tmp_path: Path
):
    half = small.STEP_NS // 2
    frames = [small.frame(p.stamp_ns + half, p.ids, p.markers) for p in direct]
    bag = small.write_bag(tmp_path / "between.mcap", small.press(), frames)
    run(RunOptions(experiment, bag, tmp_path / "out"), silent)
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["n_frames"] == 11
    assert metrics["counts"]["association"]["refused_extrapolation"] == 1
    moved = [b.markers - a.markers for a, b in itertools.pairwise(direct)]
    expected = np.sqrt(np.mean([np.sum((m / 2) ** 2, axis=1) for m in moved]))
    assert metrics["error"]["rmse"] == pytest.approx(expected, abs=1e-8)
    assert metrics["interpolation_bound"] > 0


def test_part_of_a_bag(experiment: Path, bag: Path, tmp_path: Path):
    run(RunOptions(experiment, bag, tmp_path / "out", start=0.1, duration=0.2), silent)
    stamps = [p.stamp_ns for p in load_recording(tmp_path / "out" / "run.mcap").poses]
    assert stamps == [small.START_NS + i * small.STEP_NS for i in range(2, 6)]


def test_a_run_keeps_the_name_and_the_start_of_its_recording(experiment: Path, bag: Path, tmp_path: Path):
    """Diagnosed or compared, a run had the loads of a recording called "run", and times from its own first frame."""
    run(RunOptions(experiment, bag, tmp_path / "out", start=0.1, duration=0.2), silent)
    again = load_recording(tmp_path / "out" / "run.mcap")
    assert (again.own_name, load_recording(bag).own_name) == (bag.stem, bag.stem)
    assert again.start_ns == load_recording(bag).start_ns == small.START_NS
    row = next(iter(csv.DictReader((tmp_path / "out" / "markers.csv").open())))
    first = again.errors[0].stamp_ns
    assert float(row["seconds"]) == pytest.approx(1e-9 * (first - again.start_ns)) and first > again.start_ns


def test_compared_runs_have_the_intervals_of_their_own_results(bag: Path, tmp_path: Path):
    """`compare` left the stated sigmas of the markers' places out, and told an interval 250 times too narrow."""
    folder = small.write_experiment(tmp_path / "stated")
    head, *rows = (folder / "markers.csv").read_text().split()
    (folder / "markers.csv").write_text("\n".join([f"{head},sigma", *(f"{row},0.001" for row in rows)]) + "\n")
    run(RunOptions(folder, bag, tmp_path / "out"), silent)
    told = json.loads((tmp_path / "out" / "metrics.json").read_text())
    rmse = load_runs([tmp_path / "out"])[0].metrics.rmse
    assert [rmse.low, rmse.high] == pytest.approx(told["interval_95"]["rmse"])
    assert rmse.high - rmse.low > 5e-4  # m, measured 0.0010, nearly all of it of the places


def test_a_run_can_be_replayed(first: Path, experiment: Path, tmp_path: Path):
    run(RunOptions(experiment, first, tmp_path / "again"), silent)
    assert (tmp_path / "again" / "markers.csv").read_bytes() == (first / "markers.csv").read_bytes()


def test_without_poses_the_model_is_predicted_at_the_markers_stamps(tmp_path: Path):
    folder = small.write_experiment(tmp_path / "still", probe=False)
    experiment = load_experiment(folder)
    frames = [
        small.frame(small.START_NS + i * small.STEP_NS, experiment.markers.ids, experiment.markers.points)
        for i in range(4)
    ]
    bag = small.write_bag(folder / "still.mcap", [], frames)
    metrics = run(RunOptions(folder, bag, tmp_path / "out"), silent)
    assert metrics.n_frames == 4
    assert 1e-4 < metrics.rmse.value < 1e-3  # the sag of the gel: measured markers are where the unloaded surface was


def test_in_real_time_poses_may_be_skipped_but_nothing_is_wrong(
    experiment: Path, bag: Path, direct: list[Prediction], tmp_path: Path
):
    run(RunOptions(experiment, bag, tmp_path / "out", rate=4.0), silent)
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    model = metrics["counts"]["model"]
    heard = metrics["counts"]["traffic"]["fem_node: /probe/pose"]
    assert model["predicted"] + model["skipped"] + model["unfinished"] == heard["received"]
    assert heard["received"] + heard["lost"] == heard["sent"] == 12  # none is lost unless the machine is very busy
    by_stamp = {p.stamp_ns: p for p in direct}
    recording = load_recording(tmp_path / "out" / "run.mcap")
    assert len(recording.predictions) == model["predicted"] >= 1
    for prediction in recording.predictions:  # the live model answers within its tolerance
        np.testing.assert_allclose(prediction.points, by_stamp[prediction.stamp_ns].markers, atol=1e-4)


def test_verdict_and_exit_codes(experiment: Path, bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    arguments = ["run", str(experiment), "--bag", str(bag), "--out", str(tmp_path / "out")]
    assert command_line([*arguments, "--fail-over", "0.001"]) == 1
    assert "rmse_mm" in capsys.readouterr().out
    assert command_line(arguments) == 2
    error = capsys.readouterr().err
    assert "--force" in error and error.count("\n") == 1
    assert command_line([*arguments, "--force", "--fail-over", "0.002", "--duration", "0.2"]) == 0


def test_wrong_input_is_one_line(experiment: Path, bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = str(tmp_path / "out")
    for arguments, word in (
        (["run", str(tmp_path / "no"), "--bag", str(bag), "--out", out], "does not exist"),
        (["run", str(experiment), "--bag", str(tmp_path / "no.mcap"), "--out", out], "does not exist"),
        (["run", str(experiment), "--bag", str(bag), "--out", out, "--rate", "fast"], "--rate"),
        (["run", str(experiment), "--bag", str(bag), "--out", str(bag)], "is a file"),
        (["run", str(experiment)], "--bag"),
        (["frobnicate"], "frobnicate"),
    ):
        assert command_line(arguments) == 2
        error = capsys.readouterr().err
        assert word in error and error.count("\n") == 1, error
        assert "Traceback" not in error
    assert not (tmp_path / "out").exists()


def test_a_torn_bag_is_refused_with_the_remedy(
    experiment: Path, bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(bag.read_bytes()[:-200])
    assert command_line(["run", str(experiment), "--bag", str(torn), "--out", str(tmp_path / "out")]) == 2
    assert "livedeform recover" in capsys.readouterr().err
    assert command_line(["recover", str(torn), "--out", str(tmp_path / "saved.mcap")]) == 0
    assert (
        command_line(["run", str(experiment), "--bag", str(tmp_path / "saved.mcap"), "--out", str(tmp_path / "o")]) == 0
    )


def test_markers_that_are_corrected_for_a_measuring_effect(experiment: Path, direct: list[Prediction], tmp_path: Path):
    """A rig that measures 2 % too long, with the effect in the model: the error is gone, and both markers are kept."""
    rest = direct[0]
    middle = rest.markers.mean(axis=0)
    frames = [small.frame(p.stamp_ns, p.ids, middle + 1.02 * (p.markers - middle)) for p in direct]
    folder = small.write_experiment(tmp_path / "scaled", effects=[{"name": "stereo_scale", "scale": 1.02}])
    bag = small.write_bag(tmp_path / "scaled.mcap", small.press(), frames)
    plain = run(RunOptions(experiment, bag, tmp_path / "plain"), silent)
    corrected = run(RunOptions(folder, bag, tmp_path / "corrected"), silent)
    assert plain.rmse.value > 2e-4
    assert corrected.rmse.value < 1e-6
    recording = load_recording(tmp_path / "corrected" / "run.mcap")
    assert len(recording.uncorrected_marker_frames) == len(recording.marker_frames) == 12


def test_a_replay_keeps_to_itself(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv(ISOLATE, "SUBNET")
    with isolated(True):
        assert os.environ[ISOLATE] == "OFF"
    assert os.environ[ISOLATE] == "SUBNET"


def test_at_frames_the_model_is_predicted_once_per_measured_frame(
    experiment: Path, direct: list[Prediction], tmp_path: Path
):
    """Every third moment is measured: four predictions instead of twelve, and the same errors."""
    frames = [small.frame(p.stamp_ns, p.ids, p.markers + small.OFFSET) for p in direct[::3]]
    bag = small.write_bag(tmp_path / "sparse.mcap", small.press(), frames)
    metrics = run(RunOptions(experiment, bag, tmp_path / "out", at_frames=True), silent)
    counts = json.loads((tmp_path / "out" / "metrics.json").read_text())["counts"]
    assert counts["model"]["predicted"] == metrics.n_frames == 4
    assert metrics.rmse.value == pytest.approx(
        SIZE, abs=2e-6
    )  # frictionless and elastic: the way there does not matter


def test_gaps_in_the_publishers_numbers_are_losses():
    traffic = Traffic()
    for number in (5, 6, 9, 10, 2, 3, 5, None):  # joined late; 7 and 8 lost; a new publisher; 4 lost
        traffic.receive("/x", number)
    assert traffic.lost["/x"] == 3 and traffic.received["/x"] == 8
    assert traffic.before["/x"] == 4 + 1
    traffic.pass_over("/x", 7)  # 6 lost, and 7 left in the queue
    assert traffic.lost["/x"] == 5 and traffic.received["/x"] == 8


def test_every_topic_gets_its_turn_however_long_is_waited():
    """Two topics that are never empty do not keep a third from being heard, whose wait differs from call to call."""
    with isolated(True), ros([], handle_signals=False) as stop:
        node = CountingNode("busy")
        speak = {}
        for topic in ("/a", "/b", "/c"):
            node.subscribe(Float64, topic, lambda _: None)
            speak[topic] = node.publisher(Float64, topic)
        with Graph([node], stop) as graph:
            graph.start()
            speak["/c"](Float64())
            for k in range(100):
                speak["/a"](Float64())
                speak["/b"](Float64())
                graph.spin_once(0.1 + 1e-3 * k)
            assert node.traffic.handled["/c"] == 1


def test_a_node_apart_hears_while_others_compute():
    """More messages than a queue holds, all of them sent within one callback of another node."""
    with isolated(True), ros([], handle_signals=False) as stop:
        busy, hearer = CountingNode("busy"), CountingNode("hearer")
        hearer.subscribe(Float64, "/x", lambda _: None)
        speak, go = busy.publisher(Float64, "/x"), busy.publisher(Float64, "/go")

        def compute(_: Float64) -> None:
            for _k in range(150):
                speak(Float64())
                time.sleep(0.005)

        busy.subscribe(Float64, "/go", compute)
        with Graph([busy], stop, apart=hearer) as graph:
            graph.start()
            go(Float64())
            while not busy.traffic.handled["/go"]:
                graph.spin_once(0.1)
            graph.drain(patience=5.0)
            assert hearer.traffic.received["/x"] == 150 and not graph.lost()


def test_what_ends_the_thread_of_a_node_apart_ends_the_graph():
    """As a full disk does, to which the recorder writes."""

    def full() -> None:
        raise OSError(28, "No space left on device")

    with (
        isolated(True),
        ros([], handle_signals=False) as stop,
        pytest.raises(OSError, match="No space left"),
        Graph([], stop, CountingNode("hearer"), full) as graph,
    ):
        graph.spin_until(time.monotonic() + 60.0)


def test_messages_of_a_publisher_outside_are_received_lost_or_before():
    """Another graph publishes more than a queue holds, before and while a listener is there: its balance is exact."""
    with isolated(True), ros([], handle_signals=False) as stop:
        speaker = CountingNode("speaker")
        speak = speaker.publisher(Float64, "/outside")
        with Graph([speaker], stop) as outside:
            for i in range(7):
                speak(Float64(data=float(i)))
            hearer = CountingNode("hearer")
            hearer.subscribe(Float64, "/outside", lambda _: None)
            with Graph([hearer], stop) as graph:
                while not (
                    hearer.inlets["/outside"].get_publisher_count()
                    and speaker.outlets["/outside"].get_subscription_count()
                ):
                    graph.spin_once(0.01)
                for i in range(200):
                    speak(Float64(data=float(i)))
                outside.spin_once(0.2)
                graph.drain(patience=2.0)
                for i in range(60):  # they wait in the queue when it ends
                    speak(Float64(data=float(i)))
                outside.spin_once(0.2)
                graph.drain(patience=0.0)
                row = graph.balance()["hearer: /outside"]
    assert row["before"] + row["received"] + row["lost"] == speaker.traffic.sent["/outside"] == 267
    assert row["received"] >= 50 and row["lost"] >= 60


def test_a_burst_over_a_full_queue_is_counted_as_lost():
    """Two hundred messages at once over a queue of fifty: what does not arrive is reported."""
    with isolated(True), ros([], handle_signals=False) as stop:
        hearer = CountingNode("hearer")
        heard: list[float] = []
        hearer.subscribe(Float64, "/burst", lambda message: heard.append(message.data))
        speaker = CountingNode("speaker")
        speak = speaker.publisher(Float64, "/burst")
        with Graph([hearer, speaker], stop) as graph:
            graph.start()
            speak(Float64(data=-1.0))
            graph.settle()
            for i in range(200):
                speak(Float64(data=float(i)))
            graph.finish(patience=1.0)
            assert heard[-1] == 199.0
            assert graph.lost() == {"hearer: /burst": 201 - len(heard)} and len(heard) < 201


@pytest.mark.parametrize(("sigma", "verdict"), [("", "ERROR"), (",sigma", "WARN")])
def test_how_well_markers_places_are_known_is_in_the_verdict(experiment, direct, tmp_path, sigma, verdict):
    """1.3 mm beside places that are said to be known to 1 mm (1.7 mm of a point), where 0.9 mm are allowed."""
    folder = shutil.copytree(experiment, tmp_path / "declared")
    text = (folder / "experiment.yaml").read_text().replace("error: 0.005", "error: 0.0009")
    (folder / "experiment.yaml").write_text(text)
    head, *rows = (folder / "markers.csv").read_text().split()
    (folder / "markers.csv").write_text("\n".join([head + sigma, *(row + ",0.001" * bool(sigma) for row in rows)]))
    bag = tmp_path / "take.mcap"
    with BagWriter(bag, {}) as file:
        writer = RecordingWriter(file)
        for pose, p in zip(small.press(), direct, strict=True):
            writer.marker_frame(small.frame(p.stamp_ns, p.ids, p.markers + small.OFFSET))
            writer.pose(pose)
    run(RunOptions(folder, bag, tmp_path / "out"), lambda *_: None)
    said = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert said["verdict"] == verdict and ("marker places" in said["reason"]) == bool(sigma)
    assert said["error"]["rmse"] == pytest.approx(float(np.linalg.norm(small.OFFSET)), rel=0.02)
    assert said["places"] == pytest.approx(1e-3 * np.sqrt(3.0) * bool(sigma))
    assert ("marker places" in said["interval_of"]) == bool(sigma)
