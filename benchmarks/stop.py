"""What a stop costs: a session's recording made by a generator, then what `livedeform live` computes after a Ctrl-C.

    python -m benchmarks.stop [--minutes 30] [--kilobytes 300] [--every 1] [--out FOLDER]

The shipped phantom's session: poses at 100 Hz, pairs of pictures at 30 Hz of which each (or one in ``--every``) is
measured, predicted and compared. The pictures are noise. Prints seconds of computing of each step, and the recording's
size.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from livedeform.common import topics as t
from livedeform.common.bags import layouts
from livedeform.common.bags.recording import load_recording
from livedeform.common.bags.recording_writer import RecordingWriter
from livedeform.common.bags.types import encode, message_class
from livedeform.common.bags.write import BagWriter
from livedeform.common.checks.recorded import check_recording
from livedeform.common.experiment.schema import Experiment
from livedeform.common.experiment.yaml_file import load_experiment
from livedeform.common.types import MarkerFrame, Pose
from livedeform.compare_node.interpolation import Interpolated
from livedeform.run import results
from livedeform.run.playing import restamped
from livedeform.shipped import BREAST, shipped

START_NS = 1_700_000_000_000_000_000
POSES, PAIRS = 100, 30  # per second
SIGMA = 5e-5  # m
DELAY_NS = 40_000_000  # from a picture to what is made of it


class Kept:
    """Takes one message: a `RecordingWriter`'s bag."""

    def __init__(self) -> None:
        self.data = b""

    def write(self, topic: str, type_name: str, log_time_ns: int, data: bytes) -> None:
        self.data = data


def serialised(write: Callable[[RecordingWriter], None]) -> bytes:
    """The bytes of the message that ``write`` makes."""
    kept = Kept()
    write(RecordingWriter(kept))
    return kept.data


def cloud(rows: Any) -> bytes:
    """A serialised PointCloud2 of structured rows (n,), in the frame ``phantom``."""
    kind = message_class("sensor_msgs/msg/PointField")
    time_class, header = message_class("builtin_interfaces/msg/Time"), message_class("std_msgs/msg/Header")
    return encode(
        message_class(t.POINT_CLOUD)(
            header=header(time_class(0, 0), t.FRAME_PHANTOM), height=1, width=len(rows),
            fields=[kind(row.name, row.offset, row.datatype, 1) for row in layouts.field_rows(rows.dtype)],
            is_bigendian=False, point_step=rows.dtype.itemsize, row_step=rows.nbytes,
            data=np.frombuffer(rows.tobytes(), np.uint8), is_dense=True,
        )
    )  # fmt: skip


def pressed(seconds: float) -> float:
    """How deep (m) the probe is: a press every 10 s."""
    return 0.004 * max(float(np.sin(2.0 * np.pi * seconds / 10.0)), 0.0)


def of_pose(experiment: Experiment, stamp_ns: int, rng: np.random.Generator) -> bytes:
    top = experiment.markers.points[experiment.markers.points[:, 2].argmax()]
    depth = pressed((stamp_ns - START_NS) * 1e-9)
    down = np.array([1.0, 0.0, 0.0, 0.0])
    return serialised(lambda w: w.pose(Pose(stamp_ns, top + [0.0, 0.0, 0.001 - depth] + 1e-6 * rng.random(3), down)))


def of_frame(experiment: Experiment, stamp_ns: int, rng: np.random.Generator) -> Iterator[tuple[str, str, bytes]]:
    """What is made of one pair of pictures: measured, predicted, compared, and the numbers of the error."""
    ids, rest = experiment.markers.ids, experiment.markers.points
    n = len(ids)
    moved = rest - [0.0, 0.0, pressed((stamp_ns - START_NS) * 1e-9)] * (rest[:, 2:] / rest[:, 2].max())
    measured = moved + SIGMA * rng.normal(size=(n, 3))
    frame = MarkerFrame(stamp_ns, ids, measured, np.tile(np.eye(3) * SIGMA**2, (n, 1, 1)), np.full(n, 0.1))
    yield t.STEREO_MARKERS, t.POINT_CLOUD, serialised(lambda w: w.marker_frame(frame))
    yield (
        t.FEM_MARKERS,
        t.POINT_CLOUD,
        restamped(cloud(layouts.pack(layouts.FEM_MARKERS, points=moved, id=ids)), stamp_ns),
    )
    errors = measured - moved
    rows = layouts.pack(
        layouts.COMPARE_MARKERS, points=measured, id=ids, ex=errors[:, 0], ey=errors[:, 1], ez=errors[:, 2],
        error=np.linalg.norm(errors, axis=1),
    )  # fmt: skip
    yield t.COMPARE_MARKERS, t.POINT_CLOUD, restamped(cloud(rows), stamp_ns)
    for topic in (t.COMPARE_RMSE, t.COMPARE_MEAN, t.COMPARE_P95, t.COMPARE_MAX):
        yield topic, t.FLOAT64, encode(message_class(t.FLOAT64)(1e-4))


def messages(
    experiment: Experiment, seconds: float, picture_bytes: int, every: int = 1
) -> Iterator[tuple[str, str, int, bytes]]:
    """Topic, type, receive time and bytes of everything that a session records, in the order of the receive times.

    ``every``: of so many pairs one is measured, predicted and compared.
    """
    rng = np.random.default_rng(0)
    zeros = np.zeros(800, layouts.FEM_SURFACE)
    surface = cloud(zeros)
    noise = np.random.default_rng(1).bytes(picture_bytes)  # the numbers are the same with any pictures
    time_class, header = message_class("builtin_interfaces/msg/Time"), message_class("std_msgs/msg/Header")
    photo = encode(
        message_class(t.COMPRESSED_IMAGE)(header(time_class(0, 0), t.FRAME_LEFT), "png", np.frombuffer(noise, np.uint8))
    )
    events = sorted(
        [(round(k * 1e9 / POSES), 0) for k in range(round(seconds * POSES))]
        + [(round(k * 1e9 / PAIRS) + 1, 1) for k in range(round(seconds * PAIRS))]
    )
    for at, is_pair in events:
        stamp_ns = START_NS + at
        if not is_pair:
            yield t.PROBE_POSE, t.POSE_STAMPED, stamp_ns, of_pose(experiment, stamp_ns, rng)
            continue
        for topic in t.COMPRESSED_IMAGES:
            yield topic, t.COMPRESSED_IMAGE, stamp_ns, restamped(photo, stamp_ns)
        if round(at * 1e-9 * PAIRS) % every:
            continue
        yield t.FEM_SURFACE, t.POINT_CLOUD, stamp_ns, restamped(surface, stamp_ns)
        for topic, type_name, data in of_frame(experiment, stamp_ns, rng):
            yield topic, type_name, stamp_ns, data


def write_session(path: Path, experiment: Experiment, seconds: float, picture_bytes: int, every: int = 1) -> None:
    """The recording of a session."""
    with BagWriter(path, {"made_by": "benchmarks.stop"}) as bag:
        for topic, type_name, at, data in messages(experiment, seconds, picture_bytes, every):
            bag.write(topic, type_name, at, data)


def computed(out: Path, experiment: Experiment) -> dict[str, float]:
    """Seconds of computing from a stop to the metrics; markers.csv is written behind them."""
    took: dict[str, float] = {}
    began = time.process_time()
    recording = load_recording(out / "run.mcap", experiment)
    took["read"] = time.process_time() - began
    findings = check_recording(recording, experiment)
    took["checked"] = time.process_time() - began - sum(took.values())
    head = {"experiment": experiment.name}
    with mock.patch.object(results, "write_markers", lambda *_: took.setdefault("metrics", time.process_time())):
        metrics = results.write_results(
            out, experiment, {}, START_NS, Interpolated(0.0, 0.0), head, findings, recording
        )
    took["metrics"] -= began + took["read"] + took["checked"]
    print(f"{len(recording.poses)} poses, {metrics.n_frames} frames, {metrics.n} errors")
    return took


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--kilobytes", type=float, default=300.0, help="of a picture")
    parser.add_argument("--every", type=int, default=1, help="of so many pairs one is measured and compared")
    parser.add_argument("--out", type=Path, help="where what is written, and deleted in the end, goes")
    options = parser.parse_args()
    experiment = load_experiment(shipped(BREAST) / "experiment")
    with tempfile.TemporaryDirectory(dir=options.out) as scratch:
        out = Path(scratch)
        began = time.process_time()
        write_session(
            out / "run.mcap", experiment, 60.0 * options.minutes, round(1e3 * options.kilobytes), options.every
        )
        size = (out / "run.mcap").stat().st_size / 1e9
        print(f"{options.minutes:g} min, {size:.2f} GB, written with {time.process_time() - began:.0f} s of computing")
        took = computed(out, experiment)
        print(", ".join(f"{name} {s:.2f} s" for name, s in took.items()), f"= {sum(took.values()):.2f} s of computing")


if __name__ == "__main__":
    main()
