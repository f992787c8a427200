"""The tutorial, followed word by word: its commands are run as they stand there, and say what it says that they say."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import pytest

from livedeform.common.bags.recording import load_recording
from livedeform.common.checks.recorded import POSES_APART_NS

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "tutorial" / "own-data.md").read_text()
BLOCKS = re.findall(r"^```(\w+)(?: title=\"([^\"]+)\")?\n(.*?)^```", PAGE, re.M | re.S)
CODE = "import sys; from livedeform.cli import main; main()"
LONG = ("run", "diagnose", "compare")  # the commands of the slow part


@dataclass
class Reader:
    """Follows the page in a folder: ``said`` is what the last command printed, ``steps`` are the commands so far."""

    folder: Path
    said: str = ""
    steps: list[str] = field(default_factory=list)

    def follow(self, line: str) -> None:
        """Run one line of the page."""
        words = shlex.split(line.replace("REPOSITORY", str(ROOT)))
        if words[0] == "cd":
            self.folder = self.folder / words[1]
            return
        if words[0] == "livedeform":
            words = [sys.executable, "-c", CODE, *words[1:]]
        elif words[0] == "python":
            words = [sys.executable, *words[1:]]
        here = os.environ | {"PYTHONPATH": str(ROOT / "src")}
        began = time.monotonic()
        done = subprocess.run(words, cwd=self.folder, env=here, capture_output=True, text=True, check=False)
        print(f"{time.monotonic() - began:7.1f} s  {line}", flush=True)
        assert done.returncode == 0, f"{line}\n{done.stdout}\n{done.stderr}"
        self.said = done.stdout
        self.steps.append(line)

    def read(self, text: str) -> None:
        """Look for every line of a block among what was printed."""
        for line in text.strip().splitlines():
            assert line in self.said, f"the page has '{line}', the program said:\n{self.said}"


def test_the_script_of_the_page_is_the_file() -> None:
    (script,) = [text for kind, title, text in BLOCKS if title == "record.py"]
    assert script == (ROOT / "examples" / "own_data" / "record.py").read_text()


def follow(folder: Path, *, everything: bool) -> Reader:
    """Follow the page, up to the first command that takes long unless ``everything``."""
    reader = Reader(folder)
    for kind, _, text in BLOCKS:
        if kind == "console":
            for line in re.findall(r"^\$ (.*)$", text, re.M):
                if not everything and line.split()[:2] in [["livedeform", word] for word in LONG]:
                    return reader
                reader.follow(line)
        elif kind == "text":
            reader.read(text)
    return reader


def test_until_there_are_recordings(tmp_path: Path) -> None:
    reader = follow(tmp_path, everything=False)
    assert len(reader.steps) == 5
    assert reader.said.rstrip().endswith("sound")
    assert (reader.folder / "block" / "experiment.png").is_file()


@pytest.mark.slow
def test_from_tables_to_a_better_model(tmp_path: Path) -> None:
    """All of it; how many minutes it takes is printed, and not asserted: that depends on the machine."""
    began = time.monotonic()
    reader = follow(tmp_path, everything=True)
    print(f"tutorial: {len(reader.steps)} commands, {(time.monotonic() - began) / 60:.1f} minutes")
    diagnosis = json.loads((reader.folder / "out" / "why" / "diagnosis.json").read_text())
    assert [effect["name"] for effect in diagnosis["effects"]] == ["stiffness"]
    ratio = diagnosis["effects"][0]["parameters"]["ratio"]
    assert abs(ratio["value"] - 1.2 * 2896 / 2900) < 3 * ratio["sigma"]  # the truth, over the declared modulus
    after = json.loads((reader.folder / "out" / "after" / "metrics.json").read_text())
    before = json.loads((reader.folder / "out" / "before" / "metrics.json").read_text())
    assert after["error"]["rmse"] < 0.5 * before["error"]["rmse"]


def test_the_script_of_a_real_press_makes_a_recording_that_can_be_compared(tmp_path: Path) -> None:
    """Two videos and what was written down of the stage, as the page has them."""
    page = (ROOT / "docs" / "how-to" / "real-press.md").read_text()
    script = re.search(r"^```python\n(.*?)^```", page, re.M | re.S)
    assert script is not None
    for name in ("left", "right"):
        video = cv2.VideoWriter(str(tmp_path / f"{name}.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 30, (320, 240))
        for k in range(90):
            picture = np.full((240, 320, 3), 200, np.uint8)
            cv2.circle(picture, (100, 100 + k // 10), 6, (30, 30, 30), -1)
            video.write(picture)
        video.release()
    rows = ["seconds,x,y,z,grams", "0,0,0,0.08,0", "2,0,0,0.06,120", "4,0,0,0.08,0"]
    (tmp_path / "stage.csv").write_text("\n".join(rows))
    here = os.environ | {"PYTHONPATH": str(ROOT / "src")}
    subprocess.run([sys.executable, "-c", script[1]], cwd=tmp_path, env=here, check=True)
    recording = load_recording(tmp_path / "monday.mcap")
    stamps = np.array([pose.stamp_ns for pose in recording.poses])
    assert np.diff(stamps).max() < POSES_APART_NS and recording.picture_stamps_ns
    middle = recording.poses[int(np.argmin(np.abs(stamps - stamps[0] - 1_000_000_000)))]
    assert middle.position[2] == pytest.approx(0.07, abs=1e-6)  # straight between what was written down
    assert min(w.force[2] for w in recording.wrenches) == pytest.approx(-1.1772)
