"""Heights of one's own: markers of a recording, points picked in pictures, and refusals."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from livedeform.cli import run as command_line
from livedeform.common.errors import InputError
from livedeform.common.types import MarkerFrame
from livedeform.studies.own.heights import of_markers, of_picks
from livedeform.synthetic.rig import stereo_rig
from livedeform.synthetic.writing import ScenarioWriter, write_rig

HEIGHT = 0.045
RING = np.array([[0.04, 0.0, 0.0], [-0.04, 0.0, 0.0], [0.0, 0.04, 0.0], [0.0, -0.04, 0.0]])
TOP = np.array([[0.003, 0.002, HEIGHT]])


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """Marker 1 on top of 2 to 5, in 40 frames with 0.1 mm of noise per coordinate; it sinks by 1 mm at the end."""
    rng, ids = np.random.default_rng(0), np.arange(1, 6).astype(np.uint32)
    with ScenarioWriter(tmp_path / "markers.mcap", {}) as writer:
        for k in range(40):
            points = np.vstack([TOP - [0, 0, 0.001 * (k == 39)], RING]) + rng.normal(0, 1e-4, (5, 3))
            covariances = np.tile(np.eye(3) * 1e-8, (5, 1, 1))
            writer.markers(MarkerFrame(10**9 + k * 10**8, ids, points, covariances, np.full(5, 0.1)))
    return tmp_path / "markers.mcap"


@pytest.mark.parametrize("up", [None, np.array([0.0, 0.0, 1.0])])
def test_of_markers_with_the_right_uncertainty(bag: Path, up: np.ndarray | None):
    found = of_markers(bag, [1], [2, 3, 4, 5], up)
    values = np.array([h.value for h in found.values])
    assert len(values) == 40 and values[-1] - values[:-1].mean() == pytest.approx(-0.001, abs=4e-4)
    z = (values[:-1] - HEIGHT) / np.array([h.sigma_noise for h in found.values])[:-1]
    assert np.sqrt((z**2).mean()) == pytest.approx(1.0, abs=0.3)  # 39 heights
    assert found.values[0].sigma_noise == pytest.approx(1e-4 * np.sqrt(1.25), rel=0.02)
    assert not found.with_calibration


def test_of_picked_points(tmp_path: Path):
    rig = stereo_rig(np.zeros(3))
    write_rig(tmp_path, rig)
    rng, z = np.random.default_rng(1), []
    for _ in range(60):
        pixels = rig.project(np.vstack([TOP, RING])) + rng.normal(0, 0.5, (5, 4))
        lines = [",".join(["top" if k == 0 else "bottom", *map(str, row)]) for k, row in enumerate(pixels)]
        (tmp_path / "picks.csv").write_text("\n".join(["kind,u_left,v_left,u_right,v_right", *lines]))
        value = of_picks(tmp_path / "picks.csv", tmp_path).values[0]
        z.append((value.value - HEIGHT) / value.sigma_noise)
    assert np.mean(z) == pytest.approx(0.0, abs=0.4) and np.std(z) == pytest.approx(1.0, abs=0.25)


def test_by_the_command_line(bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    words = ["study", "height", "--bag", str(bag), "--out", str(tmp_path / "out")]
    assert command_line([*words, "--top", "1", "--bottom", "2,3,4,5"]) == 0
    own = json.loads((tmp_path / "out" / "study.json").read_text())["numbers"]["own"]
    assert own["value"] == pytest.approx(HEIGHT, abs=5e-4) and own["sigma_systematic"] is None
    for more, said in (
        (["--top", "1"], "--bag, --top, --bottom: the markers are not named"),
        (["--top", "1", "--bottom", "9"], "no frame shows the markers 1, 9 together"),
        (["--top", "one", "--bottom", "2"], "'one' is not a list of marker numbers"),
        (["--top", "1", "--bottom", "2", "--up", "0,0"], "'0,0' is no direction"),
    ):
        assert command_line([*words[:4], "--out", str(tmp_path / "no"), *more]) == 2
        assert said in capsys.readouterr().err


def test_picks_that_say_nothing(tmp_path: Path):
    write_rig(tmp_path, stereo_rig(np.zeros(3)))
    for text, said in (
        ("kind,u\ntop,1", "is not a table of"),
        ("kind,u_left,v_left,u_right,v_right\nside,1,2,3,4", "neither top nor bottom"),
        ("kind,u_left,v_left,u_right,v_right\ntop,1,2,3,4", "needs points of kind top and of kind bottom"),
        ("kind,u_left,v_left,u_right,v_right\ntop,1,2,3,4\nbottom,1,2,3,4", "direction of the height is not known"),
    ):
        (tmp_path / "picks.csv").write_text(text)
        with pytest.raises(InputError, match=said):
            of_picks(tmp_path / "picks.csv", tmp_path)
