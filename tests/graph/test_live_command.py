"""livedeform live: waits, records, ends cleanly, and leaves a recording even when it is killed."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import small
from processes import Conversation, conversation, process, raw_messages, shifted

from livedeform.common import topics as t
from livedeform.common.bags.read import read_bag
from livedeform.common.bags.recording import load_recording
from livedeform.common.bags.recover import recover
from livedeform.common.bags.types import RawMessage
from livedeform.comparing.identity import digest_of

LIVE = "from livedeform.cli import main; main()"


def stream(talk: Conversation, messages: list[RawMessage], log: Path) -> None:
    """Plays the press again and again, ten poses a second, until the log says that frames are compared."""
    n = 0

    def said() -> bool:
        nonlocal n
        lap, i = divmod(n, len(messages))
        talk.player.play(shifted(messages[i], lap * len(messages) * small.STEP_NS))
        n += 1
        talk.graph.spin_once(0.05)
        talk.graph.spin_once(0.0)
        return re.search(r"[1-9]\d* frames compared", log.read_text()) is not None

    talk.wait("error of the model", said)


@pytest.mark.parametrize(
    "number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)], ids=["ctrl-c", "sigterm"]
)
def test_it_waits_records_and_ends_cleanly(number: int, experiment: Path, bag: Path, tmp_path: Path):
    log, out = tmp_path / "live.log", tmp_path / "out"
    with (
        process(LIVE, "live", str(experiment), "--out", str(out), out=log, ends=(0, 1)) as child,
        conversation((t.PROBE_POSE, t.STEREO_MARKERS), tmp_path / "heard.mcap") as talk,
    ):
        talk.wait("word that it waits", lambda: "waiting for /" in log.read_text())
        stream(talk, raw_messages(bag), log)
        for _ in range(20):
            talk.graph.spin_once(0.05)
        child.send_signal(number)
        code = child.wait(60.0)
    metrics = json.loads((out / "metrics.json").read_text())
    assert code == (metrics["verdict"] == "STALE"), log.read_text()  # a busy machine may predict too few poses
    assert metrics["n_frames"] >= 1
    recording = load_recording(out / "run.mcap")
    assert len(recording.errors) == metrics["n_frames"] and len(recording.poses) >= 2
    with read_bag(out / "run.mcap") as recorded:  # a session is known by what was recorded, not by a folder "live"
        assert metrics["recording"] == {"digest": digest_of(recorded), "whole": True}
    assert (out / "report.html").exists()
    assert "Traceback" not in log.read_text()


@pytest.mark.parametrize(
    "apart", [pytest.param(0.0, marks=pytest.mark.slow), 0.05, pytest.param(0.5, marks=pytest.mark.slow)]
)
def test_a_second_signal_leaves_out_what_waits_and_not_the_results(
    apart: float, experiment: Path, bag: Path, tmp_path: Path
):
    """Two taps of Ctrl-C, or a service's manager that is in a hurry: what is recorded gets its results."""
    log, out = tmp_path / "live.log", tmp_path / "out"
    with (
        process(LIVE, "live", str(experiment), "--out", str(out), out=log, ends=(0, 1)) as child,
        conversation((t.PROBE_POSE, t.STEREO_MARKERS), tmp_path / "heard.mcap") as talk,
    ):
        stream(talk, raw_messages(bag), log)
        child.send_signal(signal.SIGINT)
        time.sleep(apart)
        child.send_signal(signal.SIGTERM)
        child.wait(60.0)
    metrics = json.loads((out / "metrics.json").read_text())
    recording = load_recording(out / "run.mcap")
    assert len(recording.errors) == metrics["n_frames"] >= 1, log.read_text()
    assert (out / "report.html").exists() and "error" not in log.read_text().partition("press Ctrl-C")[2].partition(
        "verdict"
    )[0]


FULL = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (150_000, 150_000)); " + LIVE


def test_on_a_full_disk_it_says_where_the_recording_is(experiment: Path, bag: Path, tmp_path: Path):
    log, out = tmp_path / "live.log", tmp_path / "out"
    with (
        process(FULL, "live", str(experiment), "--out", str(out), out=log, ends=(2,)) as child,
        conversation((t.PROBE_POSE, t.STEREO_MARKERS), tmp_path / "heard.mcap") as talk,
    ):
        messages, n = raw_messages(bag), 0
        while child.poll() is None:
            lap, i = divmod(n, len(messages))
            talk.player.play(shifted(messages[i], lap * len(messages) * small.STEP_NS))
            talk.graph.spin_once(0.01)
            n += 1
    last = log.read_text().strip().splitlines()[-1]
    named = re.search(r"livedeform recover (\S+) --out", last)
    assert named is not None and "Traceback" not in log.read_text()
    assert recover(Path(named[1]), tmp_path / "saved.mcap").n_messages > 10


def is_on_disk(recording: Path, scratch: Path) -> bool:
    """Tell whether an error could be recovered from a copy of what is on the disk now: it gets there every second, or
    later on a busy machine."""
    scratch.mkdir(exist_ok=True)
    copied, saved = scratch / "run.mcap", scratch / "saved.mcap"
    copied.write_bytes(recording.read_bytes())
    saved.unlink(missing_ok=True)
    recover(copied, saved)
    with read_bag(saved) as bag:
        return t.COMPARE_MARKERS in bag.topics


def test_a_killed_recording_can_be_recovered(experiment: Path, bag: Path, tmp_path: Path):
    log, out = tmp_path / "live.log", tmp_path / "out"
    with log.open("w") as file:
        arguments = [sys.executable, "-c", LIVE, "live", str(experiment), "--out", str(out)]
        child = subprocess.Popen(arguments, stdout=file, stderr=subprocess.STDOUT)
    try:
        with conversation((t.PROBE_POSE, t.STEREO_MARKERS), tmp_path / "heard.mcap") as talk:
            stream(talk, raw_messages(bag), log)
            talk.wait("error of the model on the disk", lambda: is_on_disk(out / "run.mcap", tmp_path / "copy"))
    finally:
        child.kill()
        child.wait()
    report = recover(out / "run.mcap", tmp_path / "saved.mcap")
    with read_bag(tmp_path / "saved.mcap") as saved:
        assert saved.topics[t.COMPARE_MARKERS].count >= 1
    assert report.n_messages > 10
