"""What livedeform info finds out: rates, gaps, stamp problems, whether a bag fits, and how it says so."""

import json

import numpy as np
import pytest
import trimesh
import yaml

from livedeform.cli import run
from livedeform.common import topics as t
from livedeform.common.bags.recording_writer import RecordingWriter
from livedeform.common.bags.types import encode, message_class
from livedeform.common.bags.write import BagWriter
from livedeform.common.types import CameraCalibration, Image, MarkerFrame, Pose
from livedeform.inspection import OF_A_DIAGNOSIS, inspect

MS = 1_000_000
START = 1_700_000_000_000_000_000
STILL = np.array([0.0, 0.0, 0.0, 1.0])
PLACES = np.array([[0.05, 0.0, 0.03], [0.0, 0.05, 0.03], [0.0, 0.0, 0.1]])


@pytest.fixture
def experiment(tmp_path):
    folder = tmp_path / "experiment"
    folder.mkdir()
    block = trimesh.creation.box((0.1, 0.1, 0.1))
    block.apply_translation((0, 0, 0.05))
    block.export(folder / "block.stl")
    rows = "".join(f"{i + 1},{x},{y},{z}\n" for i, (x, y, z) in enumerate(PLACES))
    (folder / "markers.csv").write_text("id,x,y,z\n" + rows)
    content = {
        "version": 1, "name": "block",
        "phantom": {
            "surface": "block.stl", "configuration": "unloaded", "element_size": 0.02, "density": 1000.0,
            "material": {"model": "neo_hookean", "youngs_modulus": 4000.0, "poisson_ratio": 0.49},
            "support": [{"region": {"below_z": 0.001}}], "markers": "markers.csv",
        },
        "probe": {"shape": {"sphere": 0.01}},
        "stereo": {"detector": {"type": "blob"}},
    }  # fmt: skip
    (folder / "experiment.yaml").write_text(yaml.safe_dump(content))
    return folder


def markers(stamp_ns: int, ids=(1, 2, 3), points=PLACES) -> MarkerFrame:
    n = len(ids)
    return MarkerFrame(stamp_ns, np.array(ids, np.uint32), points[:n], np.full((n, 3, 3), np.nan), np.full(n, np.nan))


@pytest.fixture
def bag(tmp_path):
    """``bag(stamps_ms, ...)``: markers at these moments, poses every 10 ms from 0 to 1 s."""

    def make(stamps_ms, *, frame=markers, pose_shift_ms=0.0, extra=lambda writer: None):
        path = tmp_path / "x.mcap"
        with BagWriter(path) as writer:
            recording = RecordingWriter(writer)
            for k in range(101):
                recording.pose(Pose(START + round((10 * k + pose_shift_ms) * MS), np.zeros(3), STILL))
            for stamp in stamps_ms:
                recording.marker_frame(frame(START + round(stamp * MS)))
            extra(recording)
        return path

    return make


class InOrder:
    """A bag that receives messages 1 ms after the other, whatever their stamps."""

    def __init__(self, bag: BagWriter) -> None:
        self.bag, self.n = bag, 0

    def write(self, topic: str, type_name: str, stamp_ns: int, data: bytes) -> None:
        self.n += 1
        self.bag.write(topic, type_name, START + self.n * MS, data)


def texts(report, level: str) -> str:
    return " | ".join(finding.text for finding in report.findings if finding.level == level)


def test_a_sound_bag_that_fits(bag, experiment):
    report = inspect(bag(np.arange(0, 1000, 20)), experiment)
    assert report.sound and not texts(report, "WARN")
    topic = {topic.name: topic for topic in report.topics}
    assert topic[t.STEREO_MARKERS].rate_hz == pytest.approx(50.0)
    assert topic[t.PROBE_POSE].count == 101
    assert "0.000 mm from their places" in texts(report, "NOTE")


def test_gaps_doubles_and_stamps_that_go_back(tmp_path):
    with BagWriter(tmp_path / "x.mcap") as writer:
        recording = RecordingWriter(InOrder(writer))
        for stamp in [0, 20, 40, 40, 60, 80, 300, 320, 310, 340]:
            recording.marker_frame(markers(START + stamp * MS))
    report = inspect(tmp_path / "x.mcap")
    topic = {topic.name: topic for topic in report.topics}[t.STEREO_MARKERS]
    assert (topic.n_gaps, topic.n_backwards, topic.n_duplicates) == (1, 1, 1)
    assert topic.longest_gap_s == pytest.approx(0.22)
    said = texts(report, "WARN")
    assert "1 gaps, the longest 0.220 s" in said and "go back in time" in said and "there twice" in said
    assert report.sound


def test_stamps_that_nobody_set(tmp_path):
    with BagWriter(tmp_path / "x.mcap") as writer:
        recording = RecordingWriter(InOrder(writer))
        for _ in range(3):
            recording.marker_frame(markers(0))
    assert "every stamp is 0" in texts(inspect(tmp_path / "x.mcap"), "ERROR")


def test_clocks_that_differ(bag):
    report = inspect(bag(np.arange(0, 1000, 20), pose_shift_ms=5000.0))
    assert not report.sound
    assert "50 of 50 measured moments lie outside the time of the probe's poses: the clocks differ" in texts(
        report, "ERROR"
    )


def test_receive_times_that_drift(tmp_path):
    kind = message_class("geometry_msgs/msg/PoseStamped")
    header, time = message_class("std_msgs/msg/Header"), message_class("builtin_interfaces/msg/Time")
    pose = message_class("geometry_msgs/msg/Pose")(
        message_class("geometry_msgs/msg/Point")(0.0, 0.0, 0.0),
        message_class("geometry_msgs/msg/Quaternion")(0.0, 0.0, 0.0, 1.0),
    )
    with BagWriter(tmp_path / "x.mcap") as writer:
        for k in range(50):
            message = kind(header(time(100, 10_000_000 * k), "phantom"), pose)
            writer.write(t.PROBE_POSE, "geometry_msgs/msg/PoseStamped", 103 * 10**9 + 15_000_000 * k, encode(message))
    report = inspect(tmp_path / "x.mcap")
    assert "receive time minus stamp changes by 0.245 s" in texts(report, "WARN")
    assert "3.123 s before the receive time" in texts(report, "NOTE")


def test_ids_that_the_experiment_does_not_know(bag, experiment):
    report = inspect(bag([0, 20], frame=lambda stamp: markers(stamp, (1, 2, 8))), experiment)
    assert "markers 8 are not in the experiment" in texts(report, "WARN")
    assert "markers 3 of the experiment are never seen" in texts(report, "WARN")
    assert report.sound


def test_markers_in_another_unit(bag, experiment):
    report = inspect(bag([0, 20], frame=lambda stamp: markers(stamp, points=1e3 * PLACES)), experiment)
    assert "another frame or unit" in texts(report, "ERROR")


def test_inputs_that_are_missing(tmp_path, experiment):
    with BagWriter(tmp_path / "x.mcap") as writer:
        RecordingWriter(writer).marker_frame(markers(START))
    assert "has a probe, but there is no /probe/pose" in texts(inspect(tmp_path / "x.mcap", experiment), "ERROR")
    with BagWriter(tmp_path / "y.mcap") as writer:
        RecordingWriter(writer).pose(Pose(START, np.zeros(3), STILL))
    assert "nothing was measured" in texts(inspect(tmp_path / "y.mcap", experiment), "ERROR")
    with BagWriter(tmp_path / "z.mcap"):
        pass
    assert "the bag is empty" in texts(inspect(tmp_path / "z.mcap"), "ERROR")


def test_pictures(bag, experiment):
    def pictures(writer: RecordingWriter) -> None:
        for k in range(3):
            writer.image(Image(START + k * MS, np.zeros((8, 10), np.uint8), "mono8", t.FRAME_LEFT), t.LEFT_IMAGE)
            writer.image(Image(START + k * MS + (k == 2), np.zeros((8, 10), np.uint8)), t.RIGHT_IMAGE)
        K = np.diag([800.0, 800.0, 1.0])
        camera = CameraCalibration("left", 20, 16, K, np.zeros(5), np.eye(3), np.hstack([K, np.zeros((3, 1))]))
        writer.camera_info(camera, START, t.LEFT_CAMERA_INFO, t.FRAME_LEFT)

    report = inspect(bag([0], extra=pictures), experiment)
    said = texts(report, "ERROR")
    assert "left pictures are 10 x 8, but the calibration is for 20 x 16" in said
    assert "the right camera has no calibration" in said
    assert "2 of 6 pictures have no partner with the same stamp" in texts(report, "WARN")


def test_a_topic_of_the_wrong_type(tmp_path):
    with BagWriter(tmp_path / "x.mcap") as writer:
        writer.write(t.PROBE_POSE, "std_msgs/msg/Float64", START, encode(message_class("std_msgs/msg/Float64")(1.0)))
    assert "/probe/pose is of type std_msgs/msg/Float64" in texts(inspect(tmp_path / "x.mcap"), "ERROR")


def test_damaged_messages_are_counted(tmp_path):
    with BagWriter(tmp_path / "x.mcap") as writer:
        writer.write(t.PROBE_POSE, "geometry_msgs/msg/PoseStamped", START, b"\x00\x01\x00\x00" + bytes(20))
    assert "/probe/pose: 1 messages are damaged" in texts(inspect(tmp_path / "x.mcap"), "WARN")


def test_an_experiment_in_words(experiment):
    report = inspect(experiment)
    assert report.kind == "experiment" and report.sound
    assert report.facts["body"] == "100.0 x 100.0 x 100.0 mm, 1000.0 ml, 1000.0 g"
    assert report.facts["markers"] == "3: 3 surface"
    assert report.facts["probe"] == "sphere, lagrange"


# --- the command -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("{}", "has no version, verdict, effects"),
        ("[]", "has no version, verdict, effects"),
        ('{"noise_floor": 0.1, "verdict": "none"}', "has no version, effects, candidates"),
        (json.dumps(dict.fromkeys(OF_A_DIAGNOSIS, "fine")), "the verdict of diagnosis.json is 'fine'"),
    ],
)
def test_a_diagnosis_that_lacks_something_is_not_sound(tmp_path, text, said):
    (tmp_path / "diagnosis.json").write_text(text)
    report = inspect(tmp_path)
    assert not report.sound and said in report.findings[0].text
    whole = dict.fromkeys(OF_A_DIAGNOSIS, 1.0) | {"verdict": "undecided"}
    (tmp_path / "diagnosis.json").write_text(json.dumps(whole))
    assert inspect(tmp_path).sound


def test_the_command_prints_and_judges(bag, experiment, capsys):
    path = bag([0, 20, 40])
    assert run(["info", str(path), "--experiment", str(experiment)]) == 0
    out = capsys.readouterr().out
    assert "/stereo/markers" in out and out.endswith("sound\n")
    assert run(["info", str(experiment)]) == 0
    assert run(["info", str(experiment.parent / "none.mcap")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_the_commands_json_has_no_nan(bag, capsys):
    assert run(["info", "--json", str(bag([0]))]) == 0
    document = json.loads(capsys.readouterr().out, parse_constant=lambda name: pytest.fail(name))
    assert document["kind"] == "bag" and document["sound"] is True


def test_a_bag_that_cannot_be_used_is_exit_code_one(tmp_path, capsys):
    with BagWriter(tmp_path / "x.mcap"):
        pass
    assert run(["info", str(tmp_path / "x.mcap")]) == 1
    assert "cannot be used as it is" in capsys.readouterr().out


def test_a_torn_bag_is_refused_and_recovered(bag, tmp_path, capsys):
    data = bag(np.arange(0, 1000, 20)).read_bytes()
    (tmp_path / "torn.mcap").write_bytes(data[:-50])
    assert run(["info", str(tmp_path / "torn.mcap")]) == 2
    assert "livedeform recover" in capsys.readouterr().err
    assert run(["recover", str(tmp_path / "torn.mcap"), "--out", str(tmp_path / "back.mcap")]) == 0
    assert "151 messages recovered" in capsys.readouterr().out
    assert run(["info", str(tmp_path / "back.mcap")]) == 0


def test_schema_is_printed(capsys):
    assert run(["schema"]) == 0
    assert json.loads(capsys.readouterr().out)["title"] == "livedeform experiment"
