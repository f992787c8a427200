"""The metrics of a stopped session cost what its numbers cost: neither its pictures nor their bytes are read."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from benchmarks import stop
from livedeform.common.bags import chunks
from livedeform.common.bags.recording import load_recording
from livedeform.common.experiment.yaml_file import load_experiment

sys.path.insert(0, str(Path(__file__).parents[1] / "graph"))  # a small experiment

from small import write_experiment

SECONDS = 6.0
PICTURE_BYTES = 300_000


def read_bytes(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The sizes of the chunks that are read from now on."""
    sizes: list[int] = []
    whole = chunks.sound_content

    def counted(body: bytes) -> bytes | None:
        sizes.append(len(body))
        return whole(body)

    monkeypatch.setattr(chunks, "sound_content", counted)
    return sizes


def test_what_a_stop_reads_does_not_grow_with_the_pictures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    experiment = load_experiment(write_experiment(tmp_path / "experiment"))
    read, documents = {}, []
    for n_bytes in (100, PICTURE_BYTES):
        out = tmp_path / str(n_bytes)
        stop.write_session(out / "run.mcap", experiment, SECONDS, n_bytes)
        sizes = read_bytes(monkeypatch)
        stop.computed(out, experiment)
        monkeypatch.undo()
        read[n_bytes] = sum(sizes)
        documents.append((out / "metrics.json").read_bytes())
    pairs = round(SECONDS * stop.PAIRS)
    ends = 3 * 33 * (PICTURE_BYTES + 1000)  # the stamps of both cameras: the first, and the last second, the left twice
    assert (tmp_path / str(PICTURE_BYTES) / "run.mcap").stat().st_size > 2 * pairs * PICTURE_BYTES
    assert read[PICTURE_BYTES] < read[100] + ends
    assert documents[0] == documents[1]


def test_metrics_at_the_stop_are_those_of_the_recording(tmp_path: Path):
    """They are made of it, by what makes them again: there is no second source."""
    experiment = load_experiment(write_experiment(tmp_path / "experiment"))
    stop.write_session(tmp_path / "run.mcap", experiment, 2.0, 100)
    stop.computed(tmp_path, experiment)
    first = (tmp_path / "metrics.json").read_bytes()
    assert len(load_recording(tmp_path / "run.mcap", experiment).errors) == 2 * stop.PAIRS
    stop.computed(tmp_path, experiment)
    assert (tmp_path / "metrics.json").read_bytes() == first
