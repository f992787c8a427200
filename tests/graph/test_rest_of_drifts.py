"""Experiments with drifts that go on from an earlier clock: checked by it, and no rest is written that is none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import small
import yaml

from livedeform.common.bags.recording import load_recording
from livedeform.common.checks.recorded import check_drifts, load_checked
from livedeform.common.errors import ConvergenceError, InputError
from livedeform.common.experiment.markers_file import read_markers
from livedeform.common.experiment.plausibility import read_body
from livedeform.common.experiment.yaml_file import load_experiment
from livedeform.fem_node.model import PhantomModel
from livedeform.importing.clouds import surface_at_rest
from livedeform.run.running import write_rest

DAY_NS = 86_400_000_000_000


def _experiment(folder: Path, rate: float, before_ns: int | None):
    """The small block that swells, by a clock that started ``before_ns`` before the press (None: with it)."""
    timeline = {} if before_ns is None else {"clock_start_ns": small.START_NS - before_ns}
    effects = [{"name": "swelling", "rate": rate, "offset": 0.0}]
    return load_experiment(small.write_experiment(folder, effects=effects, timeline=timeline))


def _bag(path: Path, later_ns: int = 0) -> Path:
    poses = [replace(pose, stamp_ns=pose.stamp_ns + later_ns) for pose in small.press()]
    places = np.array(small.MARKERS)
    ids = np.arange(1, len(places) + 1)
    return small.write_bag(path, poses, [small.frame(p.stamp_ns, ids, places) for p in poses])


@pytest.mark.parametrize(
    ("rate", "before_ns", "when"),
    [
        (-1e-5, 2 * DAY_NS, "1.73e+05 s after"),
        (1e-5, -2 * DAY_NS, "1.73e+05 s before"),
        (-10.0, None, "0.55 s after"),
        (-1e-5, 0, ""),
        (1e-5, 2 * DAY_NS, ""),
        (-1e-5, None, ""),
    ],
)
def test_a_recording_is_checked_by_its_distance_from_the_drifts_clock(tmp_path, rate, before_ns, when):
    experiment = _experiment(tmp_path / "block", rate, before_ns)
    recording = load_recording(_bag(tmp_path / "a.mcap"), experiment)
    found = check_drifts(recording, experiment, read_body(experiment))
    assert [f.level for f in found] == ["ERROR"] * bool(when)
    assert all(when in f.text and "leaves nothing of the body" in f.text for f in found)
    assert all(("clock_start_ns" in f.remedy) == (before_ns is not None) for f in found)


def test_of_several_recordings_drifts_count_from_the_earliest_that_is_fitted(tmp_path):
    experiment = _experiment(tmp_path / "block", -1e-5, None)
    early, late = _bag(tmp_path / "early.mcap"), _bag(tmp_path / "late.mcap", 2 * DAY_NS)
    assert len(load_checked([early], [], experiment)) == len(load_checked([late], [], experiment)) == 1
    with pytest.raises(InputError, match="leaves nothing of the body") as caught:
        load_checked([early], [late], experiment)
    assert caught.value.where == str(late)


def test_the_rest_that_is_written_is_that_of_the_clocks_start(tmp_path):
    plain, drifting = _experiment(tmp_path / "a", 0.0, None), _experiment(tmp_path / "b", -2e-6, 2 * DAY_NS)
    written = []
    for name, experiment in (("a", plain), ("b", drifting)):
        path = tmp_path / f"{name}.csv"
        write_rest(SimpleNamespace(model=PhantomModel.from_experiment(experiment)), path)
        written.append(read_markers(path).points)
    np.testing.assert_allclose(written[1], written[0], atol=1e-9)  # measured 0; 1970 was 0.53 m away


def test_no_rest_is_written_where_there_is_none(tmp_path):
    """A block that is far too soft for its weight."""
    folder = small.write_experiment(tmp_path / "soft")
    described = yaml.safe_load((folder / "experiment.yaml").read_text())
    described["phantom"]["material"]["youngs_modulus"] = 20.0
    (folder / "experiment.yaml").write_text(yaml.safe_dump(described))
    experiment = load_experiment(folder)
    with pytest.raises(ConvergenceError, match=r"^the body at rest: "):
        write_rest(SimpleNamespace(model=PhantomModel.from_experiment(experiment)), tmp_path / "rest.csv")
    assert not (tmp_path / "rest.csv").exists()
    with pytest.raises(ConvergenceError, match=r"^the body at rest: "):
        surface_at_rest(experiment)


@pytest.mark.parametrize("configuration", ["unloaded", "loaded"])
def test_a_body_that_is_let_go_later_lies_as_it_was_scanned(tmp_path, configuration):
    """One that was scanned under its weight was laid on the shape to which it would spring back without it."""
    folder = small.write_experiment(tmp_path / "held", timeline={"release": 1.0})
    described = yaml.safe_load((folder / "experiment.yaml").read_text())
    described["phantom"]["configuration"] = configuration
    (folder / "experiment.yaml").write_text(yaml.safe_dump(described))
    experiment = load_experiment(folder)
    vertices, _, said = surface_at_rest(experiment)
    assert said == "the experiment's file"
    np.testing.assert_array_equal(vertices, read_body(experiment).vertices)
