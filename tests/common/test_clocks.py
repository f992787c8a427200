"""A clock that was set or drifts is doubted by what comes beside it; queues, latencies and slow playing are not."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from livedeform.common import topics as t
from livedeform.common.bags.recording import Recording, load_recording
from livedeform.common.bags.recording_writer import RecordingWriter
from livedeform.common.bags.write import BagWriter
from livedeform.common.checks.clocks import check_clocks
from livedeform.common.checks.finding import Finding
from livedeform.common.experiment.schema import Experiment
from livedeform.common.experiment.yaml_file import load_experiment
from livedeform.common.types import Array, Image, MarkerFrame, Pose

DOWN = np.array([1.0, 0.0, 0.0, 0.0])
BEGIN_NS = 1_700_000_000_000_000_000
Course = Callable[[Array], Array]  # of times (n,) s


def steady(t: Array) -> Array:
    return np.full(len(t), 0.004)


def _ns(seconds: Array) -> list[int]:
    return [BEGIN_NS + round(1e9 * s) for s in seconds]


def arrivals(rate: float, seconds: float, ahead: Course, late: Course, played: float = 1.0) -> list[tuple[int, int]]:
    """Stamps and receive times of a topic whose clock is ``ahead`` s, and that is received ``late`` s afterwards, by a
    recorder for which time goes ``played`` times as slowly."""
    at = np.arange(0.0, seconds, 1.0 / rate)
    return list(zip(_ns(at + ahead(at)), _ns(played * at + late(at)), strict=True))


NAMES = {
    "markers": (t.STEREO_MARKERS, 30.0), "poses": (t.PROBE_POSE, 100.0), "wrench": (t.PROBE_WRENCH, 200.0),
    "surface": (t.STEREO_SURFACE, 5.0), "left": (t.LEFT_IMAGE, 20.0), "right": (t.RIGHT_IMAGE, 20.0),
}  # fmt: skip


def recorded(seconds: float = 9.0, **topics: tuple[Course, Course]) -> Recording:
    """A recording of topics of `NAMES` with the courses of their clock and their delay."""
    came = {NAMES[k][0]: arrivals(NAMES[k][1], seconds, *courses) for k, courses in topics.items()}
    return Recording(Path(), 0, 1, [], [], [], {}, {}, arrivals=came)


@pytest.fixture
def experiment(folder: Path) -> Experiment:
    return load_experiment(folder, geometry=False)


def said(recording: Recording, experiment: Experiment) -> list[Finding]:
    return check_clocks(recording, experiment, None)  # type: ignore[arg-type]  # the body is not asked for


def set_at(at: float, by: float) -> Course:
    return lambda t: by * (t >= at)


CLOCKS: dict[str, Course] = {
    "set by 0.25 s after a second": set_at(1.0, 0.25),
    "set back by 0.25 s": set_at(4.0, -0.25),
    "set by 0.15 s near the end": set_at(8.0, 0.15),
    "set by a minute": set_at(5.0, 60.0),
    "drifts by 2 %": lambda t: 0.02 * t,
    "set, and set again": lambda t: 0.3 * ((t > 2.0) & (t < 5.0)),
}


@pytest.mark.parametrize("name", CLOCKS)
@pytest.mark.parametrize("whose", ["markers", "poses"])
def test_a_clock_that_was_set_or_drifts_is_doubted(name: str, whose: str, experiment: Experiment) -> None:
    """Set by 0.25 s it made an error of 0.36 mm out of one of 0.09 mm, and the verdict was OK."""
    courses = dict.fromkeys(("markers", "poses"), (np.zeros_like, steady)) | {whose: (CLOCKS[name], steady)}
    (found,) = said(recorded(**courses), experiment)
    assert found.level == "WARN" and found.doubts
    assert found.text.startswith(f"receive time minus stamp of /{'stereo' if whose == 'markers' else 'probe'}/")
    by = np.ptp(CLOCKS[name](np.arange(0.0, 9.0, 0.01)))
    assert float(found.text.split("changes by ")[1].split(" s")[0]) == pytest.approx(by, rel=0.15)


def _noisy(t: Array) -> Array:
    return 0.005 + 0.03 * np.random.default_rng(len(t)).exponential(1.0, len(t))


def _stalls(t: Array) -> Array:
    """Delays of a queue that nobody empties for half a second, twice."""
    return 0.004 + sum(np.where((t > a) & (t < a + 0.5), a + 0.5 - t, 0.0) for a in (3.1, 6.7))


SOUND: dict[str, tuple[tuple[Course, Course], tuple[Course, Course]]] = {
    "written offline": ((np.zeros_like, np.zeros_like), (np.zeros_like, np.zeros_like)),
    "clocks that differ by an hour": ((lambda t: 3600.0 + 0.0 * t, steady), (np.zeros_like, steady)),
    "late by a third of a second, always": ((np.zeros_like, lambda t: 0.3 + 0.0 * t), (np.zeros_like, steady)),
    "late by up to 0.2 s": ((np.zeros_like, _noisy), (np.zeros_like, _noisy)),
    "a queue that is full for a while": ((np.zeros_like, _stalls), (np.zeros_like, steady)),
    "the recorder's clock was set": ((np.zeros_like, set_at(4.0, 5.0)), (np.zeros_like, set_at(4.0, 5.0))),
    "the recorder's clock drifts": ((np.zeros_like, lambda t: 0.05 * t), (np.zeros_like, lambda t: 0.05 * t)),
    "drifts by 50 ppm": ((lambda t: 5e-5 * t, steady), (np.zeros_like, steady)),
}


@pytest.mark.parametrize("seconds", [2.0, 9.0, 120.0])
@pytest.mark.parametrize("name", SOUND)
def test_what_is_no_clock_is_not_doubted(name: str, seconds: float, experiment: Experiment) -> None:
    markers, poses = SOUND[name]
    assert said(recorded(seconds, markers=markers, poses=poses), experiment) == []


def test_a_bag_that_is_played_slowly_is_not_doubted(experiment: Experiment) -> None:
    came = {
        name: arrivals(rate, 9.0, np.zeros_like, steady, played=2.5)
        for name, rate in ((t.STEREO_MARKERS, 30.0), (t.PROBE_POSE, 100.0))
    }
    assert said(Recording(Path(), 0, 1, [], [], [], {}, {}, arrivals=came), experiment) == []


def test_one_topic_alone_and_poses_that_nothing_uses_tell_nothing(experiment: Experiment) -> None:
    stepped, sound = (set_at(4.0, 0.3), steady), (np.zeros_like, steady)
    assert said(recorded(markers=sound), experiment) == []
    unused = experiment.model_copy(update={"probe": None})
    assert said(recorded(markers=sound, poses=stepped), unused) == []
    assert len(said(recorded(markers=sound, poses=stepped), experiment)) == 1


ALONE: dict[str, tuple[Course, Course, bool | None]] = {  # its clock, its delay, and what is said: whether it doubts
    "its clock was set": (set_at(4.0, 0.3), steady, True),
    "its clock was set back": (set_at(4.0, -0.3), steady, True),
    "its clock was set, of a tracker that jitters": (set_at(4.0, 0.3), lambda t: 0.2 * _noisy(t), True),
    "its clock or the recorder's drifts": (lambda t: 0.05 * t, steady, False),
    "the recorder's clock was set": (np.zeros_like, set_at(4.0, 5.0), False),
    "a queue that is full for a while": (np.zeros_like, lambda t: _stalls(t), None),
    "late by up to 0.2 s": (np.zeros_like, _noisy, None),
    "sound": (np.zeros_like, steady, None),
}


@pytest.mark.parametrize("name", ALONE)
@pytest.mark.parametrize("whose", ["markers", "poses"])
def test_a_topic_alone_tells_whose_clock_was_set_by_its_intervals(
    name: str, whose: str, experiment: Experiment
) -> None:
    """Only `info` said something of it; results of a body without a probe took the times as they were."""
    clock, delay, doubts = ALONE[name]
    found = said(recorded(**{whose: (clock, delay)}), experiment)
    assert [f.doubts for f in found] == ([] if doubts is None else [doubts])
    assert all(f.level == "WARN" and "receive time minus stamp" in f.text for f in found)
    if doubts:
        assert "its clock was set (after 4" in found[0].text or "its clock was set (after 3.9" in found[0].text


@pytest.mark.parametrize("by", [0.0, 0.25])
@pytest.mark.parametrize("filmed", [False, True])
def test_a_bag_tells_when_its_messages_came(by: float, filmed: bool, tmp_path: Path, experiment: Experiment) -> None:
    """From the file to the doubt; frames that were made of pictures came as late as that took."""
    with BagWriter(tmp_path / "x.mcap", {}) as file:
        late = _Late(file)
        writer = RecordingWriter(late)
        for k in range(120):
            late.now_ns, shown = BEGIN_NS + k * 50_000_000, BEGIN_NS + k * 50_000_000 + round(1e9 * by * (k > 40))
            writer.pose(Pose(late.now_ns, np.zeros(3), DOWN))
            if filmed:
                writer.image(Image(shown, np.zeros((4, 6), np.uint8), "mono8"), t.LEFT_IMAGE)
                late.now_ns += round(5e8 * k / 120)  # what takes longer and longer
            nan = np.full((1, 3, 3), np.nan)
            writer.marker_frame(MarkerFrame(shown, np.ones(1, np.uint32), np.zeros((1, 3)), nan, np.full(1, np.nan)))
    recording = load_recording(tmp_path / "x.mcap")
    assert set(recording.arrivals) == {t.PROBE_POSE, t.LEFT_IMAGE if filmed else t.STEREO_MARKERS}
    found = said(recording, experiment)
    assert [f.doubts for f in found] == ([True] if by else [])


@pytest.mark.parametrize(("rate", "seconds"), [(1.0, 20.0), (2.0, 10.0), (10.0, 2.0), (3.0, 200.0)])
@pytest.mark.parametrize("by", [0.25, -0.25])
def test_a_slow_or_short_topic_tells_too(rate: float, seconds: float, by: float, experiment: Experiment) -> None:
    """Fewer than three messages in a tenth of the time, and nothing was said."""
    for clock, n in ((set_at(0.5 * seconds, by), 1), (np.zeros_like, 0)):
        came = {
            t.PROBE_POSE: arrivals(100.0, seconds, np.zeros_like, steady),
            t.STEREO_MARKERS: arrivals(rate, seconds, clock, steady),
        }
        found = said(Recording(Path(), 0, 1, [], [], [], {}, {}, arrivals=came), experiment)
        assert len(found) == n and all("changes by 0.250 s" in f.text and f.doubts for f in found)


@pytest.mark.parametrize("whose", ["wrench", "surface", "right", "left"])
def test_every_measured_topics_clock_is_looked_at(whose: str, experiment: Experiment) -> None:
    """Those of the force sensor, of a scanner and of the right camera were not."""
    sound = (np.zeros_like, steady)
    courses = dict.fromkeys(("poses", "wrench", "surface", "left", "right"), sound)
    assert said(recorded(**courses), experiment) == []
    (found,) = said(recorded(**courses | {whose: (set_at(4.0, 0.25), steady)}), experiment)
    assert found.doubts and found.text.startswith(f"receive time minus stamp of {NAMES[whose][0]} changes by 0.250 s")
    assert ("or messages took longer" in found.text) == (whose in ("left", "right"))  # of which some are read


SLOW: dict[str, Course] = {
    "while the probe hides markers": lambda t: np.where((t > 8.0) & (t < 20.0), 0.2, 0.05),
    "from a moment on": lambda t: np.where(t > 12.0, 0.5, 0.05),
    "and jitters": lambda t: np.where((t > 8.0) & (t < 20.0), 0.2, 0.05) + 0.2 * _noisy(t),
}


@pytest.mark.parametrize("rate", [2.0, 5.0, 30.0])
@pytest.mark.parametrize("name", SLOW)
def test_a_tracker_that_takes_longer_is_no_clock(name: str, rate: float, experiment: Experiment) -> None:
    """Its stamps go on evenly while its messages come late: a clock that was set makes it the other way round."""
    tracked = arrivals(rate, 30.0, np.zeros_like, SLOW[name])
    came = {t.PROBE_POSE: arrivals(100.0, 30.0, np.zeros_like, steady), t.STEREO_MARKERS: tracked}
    recording = Recording(Path(), 0, 1, [], [], [], {}, {}, arrivals=came)
    assert said(recording, experiment) == []
    came[t.STEREO_MARKERS] = [(stamp + 250_000_000 * (stamp > BEGIN_NS + 15 * 10**9), at) for stamp, at in tracked]
    (found,) = said(recording, experiment)
    assert found.doubts and "a clock was set" in found.text and "longer" not in found.text


def test_what_takes_longer_and_longer_is_told_from_no_drift(experiment: Experiment) -> None:
    longer: Course = lambda t: 0.05 + 0.01 * t  # noqa: E731
    (found,) = said(recorded(30.0, poses=(np.zeros_like, steady), markers=(np.zeros_like, longer)), experiment)
    assert found.text.endswith("a clock was set or drifts, or messages took longer to come")


@pytest.mark.parametrize(("rate", "queued"), [(10.0, 0.3), (60.0, 0.2), (30.0, 1.0)])
def test_pictures_of_which_some_are_read_tell_no_clock_from_a_recorders_first_queue(
    rate: float, queued: float, tmp_path: Path, experiment: Experiment
) -> None:
    """They are read evenly over the recording, and not three at its beginning, which all waited in that queue."""
    path, tiny = tmp_path / "x.mcap", np.zeros((4, 6), np.uint8)
    for by, n in ((0.0, 0), (0.25, 1)):
        with BagWriter(path, {}) as file:
            late = _Late(file)
            writer = RecordingWriter(late)
            for k in range(round(20 * rate)):
                at = k / rate
                stamp = BEGIN_NS + round(1e9 * (at + by * (5.0 < at < 15.0)))
                late.now_ns = BEGIN_NS + round(1e9 * (max(at, queued) + 0.004))
                for camera in t.IMAGES:
                    writer.image(Image(stamp, tiny, "mono8"), camera)
                writer.pose(Pose(late.now_ns, np.zeros(3), DOWN))
        recording = load_recording(path)
        assert all(30 < len(recording.arrivals[camera]) <= 110 for camera in t.IMAGES)
        found = said(recording, experiment)
        assert len(found) == n and all("0.250 s" in f.text for f in found)
        path.unlink()


class _Late:
    """A bag whose messages are received at ``now_ns``, whatever their stamps."""

    def __init__(self, bag: BagWriter) -> None:
        self.bag, self.now_ns = bag, 0

    def write(self, topic: str, type_name: str, log_time_ns: int, data: bytes) -> None:
        self.bag.write(topic, type_name, self.now_ns, data)
