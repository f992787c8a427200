"""Pictures of a synthetic experiment, painted again from the surfaces in its truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from livedeform.common.bags.read import read_bag
from livedeform.common.bags.recording import load_recording
from livedeform.common.errors import InputError
from livedeform.synthetic import scenario
from livedeform.synthetic.repaint import can_repaint, repaint

SPEC = {
    "version": 1,
    "name": "tiny",
    "body": {"shape": "block", "size": [0.06, 0.05, 0.04], "elements": [3, 2, 2]},
    "declared": {"ship_mesh": False, "element_size": 0.015},
    "markers": {"surface": 10, "internal": 0, "support": 3},
    "measuring": {"kind": "pictures", "rate": 1.0},
    "rig": {"size": [320, 240], "f": 500.0},
    "path_step": 0.002,
    "recordings": {"a": [{"at": [0.0, 0.0], "depth": 0.002, "hold": 0.2}]},
}


def test_only_the_noise_of_the_pictures_is_another(tmp_path: Path) -> None:
    scenario.make(SPEC, tmp_path / "made", seed=1)
    assert can_repaint(tmp_path / "made") and not can_repaint(tmp_path)
    repaint(tmp_path / "made", tmp_path / "again", seed=2)
    with read_bag(tmp_path / "made" / "bags" / "a") as one, read_bag(tmp_path / "again" / "bags" / "a") as two:
        pairs = list(zip(one.messages(), two.messages(), strict=True))
    assert all((a.topic, a.log_time_ns) == (b.topic, b.log_time_ns) for a, b in pairs)
    assert all(a.data == b.data for a, b in pairs if "image" not in a.topic)
    before, after = (load_recording(tmp_path / name / "bags" / "a") for name in ("made", "again"))
    for a, b in zip([*before.left, *before.right], [*after.left, *after.right], strict=True):
        difference = np.asarray(a.pixels, float) - np.asarray(b.pixels, float)
        assert 0.3 < difference.std() < 2.0  # the noise is 1 grey value in each
        assert np.abs(difference).max() < 9.0  # nothing has moved
    truth = tmp_path / "made" / "truth" / "a.npz"
    values = dict(np.load(truth))
    np.savez(truth, **{k: v for k, v in values.items() if k != "surface"})
    with pytest.raises(InputError, match="holds no surfaces"):
        repaint(tmp_path / "made", tmp_path / "third")
