"""Motion capture as bags: the synthetic take has known answers, the published beam has those of its authors."""

import json
import os
import shutil
from pathlib import Path

import ezc3d
import numpy as np
import pytest
import yaml

from livedeform.cli import run
from livedeform.common.bags.recording import load_recording
from livedeform.common.errors import InputError, RecordingError
from livedeform.common.experiment.yaml_file import load_experiment
from livedeform.common.frames import apply, inverse, matrix_pose, pose_matrix
from livedeform.common.types import Pose
from livedeform.importing.c3d import MotionCapture, read_c3d, register, still_covariance
from livedeform.importing.imports import import_preset, import_takes, parse_ids, parse_span
from livedeform.importing.silicone_beam import AUTHORS_FEM, AUTHORS_POINTS

LABELS = ["A", "B", "C", "D"]
PLACES = np.array([[0.0, 0.0, 0.1], [0.05, 0.0, 0.1], [0.0, 0.04, 0.1], [0.02, 0.01, 0.12]])
SIGMA = np.array([20e-6, 5e-6, 10e-6])


@pytest.fixture
def tracker(rng) -> np.ndarray:
    """T_tracker_phantom of a tracker that stands somewhere."""
    quaternion = rng.normal(size=4)
    return pose_matrix(Pose(0, np.array([0.3, -1.2, 0.8]), quaternion / np.linalg.norm(quaternion)))


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


@pytest.fixture
def take(tmp_path, tracker, rng) -> Path:
    """200 frames in millimetres at 100 Hz: still for 1 s, then marker D rises by 10 mm; B is hidden in frames 50-59."""
    points = np.repeat(PLACES[None], 200, axis=0)
    points[100:, 3, 2] += np.linspace(0, 0.01, 100)
    points = apply(tracker, points.reshape(-1, 3)).reshape(200, 4, 3) + rng.normal(size=(200, 4, 3)) * SIGMA
    points[50:60, 1] = np.nan
    file = ezc3d.c3d()
    file["parameters"]["POINT"]["RATE"]["value"] = [100.0]
    file["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
    file["parameters"]["POINT"]["LABELS"]["value"] = LABELS
    data = np.ones((4, 4, 200))
    data[:3] = 1e3 * points.transpose(2, 1, 0)
    file["data"]["points"] = data
    file["data"]["meta_points"]["residuals"] = np.where(
        np.isnan(data[:1]), -1.0, 2.0
    )  # mm; the format stores small integers
    path = tmp_path / "take.c3d"
    file.write(str(path))
    return path


@pytest.fixture
def experiment(tmp_path) -> Path:
    import trimesh

    folder = tmp_path / "experiment"
    folder.mkdir()
    block = trimesh.creation.box((0.1, 0.1, 0.1))
    block.apply_translation((0, 0, 0.05))
    block.export(folder / "block.stl")
    rows = "".join(f"{10 + i},{x},{y},{z}\n" for i, (x, y, z) in enumerate(PLACES))
    (folder / "markers.csv").write_text("id,x,y,z\n" + rows)
    content = {
        "version": 1, "name": "block",
        "phantom": {
            "surface": "block.stl", "configuration": "unloaded", "element_size": 0.02, "density": 1000.0,
            "material": {"model": "neo_hookean", "youngs_modulus": 4000.0, "poisson_ratio": 0.49},
            "support": [{"region": {"below_z": 0.001}}], "markers": "markers.csv",
        },
    }  # fmt: skip
    (folder / "experiment.yaml").write_text(yaml.safe_dump(content))
    return folder


def test_a_take_is_read_in_metres(take, tracker):
    capture = read_c3d(take)
    assert capture.labels == tuple(LABELS) and capture.rate_hz == 100.0
    assert np.isnan(capture.points[50:60, 1]).all() and np.isfinite(np.delete(capture.points, 1, axis=1)).all()
    np.testing.assert_allclose(capture.points[0], apply(tracker, PLACES), atol=1e-4)
    np.testing.assert_allclose(capture.residuals[0], 2e-3, rtol=1e-6)


def test_registered_takes_lie_where_the_experiment_says(take, experiment, tmp_path):
    ids = {label: 10 + i for i, label in enumerate(LABELS)}
    (line,) = import_takes([take], tmp_path / "out", experiment=experiment, ids=ids)
    assert "registered to 4 markers" in line
    recording = load_recording(tmp_path / "out/take.mcap", load_experiment(experiment))
    assert len(recording.marker_frames) == 200 and recording.warnings == []
    first, hidden, last = recording.marker_frames[0], recording.marker_frames[55], recording.marker_frames[-1]
    np.testing.assert_allclose(first.points, PLACES, atol=7e-5)
    assert hidden.ids.tolist() == [10, 12, 13]
    assert abs(last.points[3, 2] - 0.13) < 7e-5
    assert (recording.end_ns - recording.start_ns) == 1_990_000_000


def test_the_covariance_is_the_noise_in_the_phantoms_frame(take, experiment, tmp_path, tracker):
    """A fair still window of 20 frames: +-40 % at 3 sigma of chi-square, so a factor 2 bounds it."""
    ids = {label: 10 + i for i, label in enumerate(LABELS)}
    import_takes([take], tmp_path / "out", experiment=experiment, ids=ids)
    covariance = load_recording(tmp_path / "out/take.mcap").marker_frames[0].covariances
    R = inverse(tracker)[:3, :3]
    expected = R @ np.diag(SIGMA**2) @ R.T
    traces = np.trace(covariance, axis1=1, axis2=2) / np.trace(expected)
    assert (traces > 0.5).all() and (traces < 2.0).all()  # measured 0.75 .. 1.13
    largest = np.linalg.eigh(covariance.mean(axis=0))[1][:, -1]
    assert abs(largest @ np.linalg.eigh(expected)[1][:, -1]) > 0.95  # measured 0.992


def test_a_drift_does_not_count_as_noise(rng):
    drifting = rng.normal(size=(300, 1, 3)) * 1e-5 + np.linspace(0, 0.1, 300)[:, None, None]
    take = MotionCapture(Path("x.c3d"), ("A",), drifting, np.full((300, 1), np.nan), 100.0)
    sigma = np.sqrt(np.trace(still_covariance(take)[0]) / 3)
    assert 0.6e-5 < sigma < 1.4e-5  # measured 0.95e-5


def test_the_trackers_own_residual_as_noise(take, tmp_path):
    import_takes([take], tmp_path / "out", noise="residual")
    covariance = load_recording(tmp_path / "out/take.mcap").marker_frames[0].covariances[0]
    np.testing.assert_allclose(np.trace(covariance), 2e-3**2, rtol=1e-5)


def test_numbered_in_order_and_unregistered_by_default(take, tmp_path, tracker):
    (line,) = import_takes([take], tmp_path / "out")
    assert "not registered" in line
    frame = load_recording(tmp_path / "out/take.mcap").marker_frames[0]
    assert frame.ids.tolist() == [1, 2, 3, 4]
    np.testing.assert_allclose(frame.points, apply(tracker, PLACES), atol=1e-4)


def test_mistakes(take, experiment, tmp_path):
    with pytest.raises(InputError, match=r"has no marker 'E'.*A, B, C, D"):
        import_takes([take], tmp_path / "o", ids={"E": 1})
    with pytest.raises(InputError, match="marker 'B' has no id"):
        import_takes([take], tmp_path / "o", ids={"A": 1})
    with pytest.raises(InputError, match="only 1 markers have a place"):
        import_takes([take], tmp_path / "o", experiment=experiment, ids={"A": 10, "B": 2, "C": 3, "D": 4})
    with pytest.raises(InputError, match="--noise"):
        import_takes([take], tmp_path / "o", noise="none")
    with pytest.raises(RecordingError, match="does not exist"):
        import_takes([tmp_path / "none.c3d"], tmp_path / "o")
    (tmp_path / "bad.c3d").write_bytes(b"P" * 700)
    with pytest.raises(RecordingError, match="cannot be read as C3D"):
        import_takes([tmp_path / "bad.c3d"], tmp_path / "o")
    import_takes([take], tmp_path / "o")
    with pytest.raises(InputError, match=r"exists already.*--force"):
        import_takes([take], tmp_path / "o")
    import_takes([take], tmp_path / "o", force=True)
    with pytest.raises(InputError, match="LABEL=ID"):
        parse_ids(["A:1"])
    assert parse_ids(["Tip - 1=4"]) == {"Tip - 1": 4}
    with pytest.raises(InputError, match="--rest"):
        parse_span("2:1")


def test_the_command_writes_what_it_ran_with(take, tmp_path, capsys):
    assert run(["import", "c3d", str(take), "--out", str(tmp_path / "out"), "--noise", "residual"]) == 0
    assert "take.mcap: 200 frames, 4 markers" in capsys.readouterr().out
    document = json.loads((tmp_path / "out/configuration.json").read_text())
    assert document["command"] == "import c3d" and document["options"]["noise"] == "residual"
    assert run(["import", "c3d", str(take), "--out", str(tmp_path / "out")]) == 2
    assert "exists already" in capsys.readouterr().err


def test_registration_of_exact_places(tracker):
    T, misfit = register(PLACES, apply(tracker, PLACES))
    np.testing.assert_allclose(T, inverse(tracker), atol=1e-12)
    assert np.abs(misfit).max() < 1e-12
    assert matrix_pose(T).stamp_ns == 0


# --- the published beam ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def beam(tmp_path_factory) -> Path:
    data = Path(os.environ.get("LIVEDEFORM_DATA", Path(__file__).parents[2] / "../shared/data")).resolve()
    if not data.is_dir():
        pytest.skip(f"public data is not at {data}; set LIVEDEFORM_DATA")
    out = tmp_path_factory.mktemp("beam")
    import_preset("silicone-beam", sorted((data / "silicone_beam").glob("*.c3d")), None, out)
    return out


@pytest.mark.parametrize(("case", "n_loads"), [("gravity", 0), ("load52", 1)])
def test_beam_experiments_are_sound(beam, case, n_loads):
    experiment = load_experiment(beam / case)
    assert len(experiment.loads) == n_loads
    assert experiment.markers.kinds.tolist() == ["surface"] * 3 + ["support"] * 3
    assert sorted(path.stem[-1] for path in (beam / case / "bags").glob("*.mcap")) == ["a", "b"]


def test_beam_surface_lies_in_the_beams_frame(beam):
    import trimesh

    bounds = trimesh.load_mesh(beam / "gravity/beam.stl").bounds
    np.testing.assert_allclose(bounds, [[-0.1, 0, 0], [0, 0.03, 0.03]], atol=1e-7)


@pytest.mark.parametrize("case", ["gravity", "load52"])
@pytest.mark.parametrize("take", ["a", "b"])
def test_beam_rests_until_the_release_and_then_falls(beam, case, take):
    experiment = load_experiment(beam / case)
    recording = load_recording(beam / case / f"bags/beam_{case}_V2_{take}.mcap", experiment)
    seconds = np.array([1e-9 * (frame.stamp_ns - recording.start_ns) for frame in recording.marker_frames])
    tip = np.array([frame.points[:3].mean(axis=0) for frame in recording.marker_frames])
    rest = experiment.markers.points[:3].mean(axis=0)
    moved = np.linalg.norm(tip - rest, axis=1)
    release = experiment.of_recording(f"beam_{case}_V2_{take}").timeline.release
    assert moved[seconds < release - 0.03].max() < 0.4e-3  # a hand lets go slowly
    assert moved[seconds < release - 1e-9].max() < 2.5e-3  # measured 2.0 mm at most, with the weight
    assert tip[seconds > release + 0.05, 2].max() < rest[2] - 1e-3


@pytest.mark.parametrize(("case", "bound"), [("gravity", 0.8e-3), ("load52", 1.7e-3)])
def test_beam_sags_as_the_authors_computed(beam, case, bound):
    """Mean of the last second of both takes: how far each tip marker moved, against the authors' FEM.

    Measured: gravity 0.67, 0.28, 0.36 mm; load52 1.53, 0.65, 0.56 mm off.
    """
    experiment = load_experiment(beam / case)
    moved = []
    for path in (beam / case / "bags").glob("*.mcap"):
        last = load_recording(path).marker_frames[-100:]
        moved.append(np.mean([frame.points[:3] for frame in last], axis=0) - experiment.markers.points[:3])
    difference = np.mean(moved, axis=0) - (AUTHORS_FEM[case] - AUTHORS_POINTS)
    assert np.linalg.norm(difference, axis=1).max() < bound


def test_force_replaces_only_what_the_import_writes(beam, tmp_path):
    data = Path(os.environ.get("LIVEDEFORM_DATA", Path(__file__).parents[2] / "../shared/data")).resolve()
    out = tmp_path / "beam"
    shutil.copytree(beam, out)
    (out / "gravity" / "run").mkdir()
    kept = (out / "gravity" / "run" / "run.mcap", out / "gravity" / "bags" / "my-own.mcap")
    for path in kept:
        path.write_text("recorded")
    takes = sorted((data / "silicone_beam").glob("*.c3d"))
    with pytest.raises(InputError, match=r"results already.*--force"):
        import_preset("silicone-beam", takes, None, out)
    import_preset("silicone-beam", takes, None, out, force=True)
    assert [path.read_text() for path in kept] == ["recorded"] * 2
    assert (
        load_experiment(out / "gravity").markers.ids.tolist() == load_experiment(beam / "gravity").markers.ids.tolist()
    )


def test_dots_with_force_leave_everything_else(tmp_path, capsys):
    data = Path(os.environ.get("LIVEDEFORM_DATA", Path(__file__).parents[2] / "../shared/data")).resolve()
    if not data.is_dir():
        pytest.skip(f"public data is not at {data}; set LIVEDEFORM_DATA")
    out = tmp_path / "cylinder"
    (out / "bags").mkdir(parents=True)
    kept = (out / "run" / "run.mcap", out / "bags" / "my-own.mcap", out / "notes.txt")
    (out / "run").mkdir()
    for path in kept:
        path.write_text("recorded")
    arguments = ["import", "dots", str(data / "dot_cylinder"), "--out", str(out)]
    assert run(arguments) == 0  # nothing of its own is there yet
    assert run(arguments) == 2 and "--force" in capsys.readouterr().err
    before = load_experiment(out).markers.points
    assert run(["import", "dots", str(tmp_path), "--out", str(out), "--force"]) == 2
    np.testing.assert_array_equal(load_experiment(out).markers.points, before)  # what cannot be read replaces nothing
    assert run([*arguments, "--force"]) == 0
    assert [path.read_text() for path in kept] == ["recorded"] * 3
    assert (out / "configuration.json").exists()


def test_the_preset_wants_its_own_takes(take, tmp_path):
    (tmp_path / "beam.stl").write_text("")
    named = tmp_path / "gravity.c3d"
    named.write_bytes(take.read_bytes())
    with pytest.raises(InputError, match="this preset is for the beam's takes only"):
        import_preset("silicone-beam", [named], None, tmp_path / "out")
    with pytest.raises(InputError, match="gravity or load52"):
        import_preset("silicone-beam", [take], None, tmp_path / "out2")
    with pytest.raises(InputError, match="unknown preset 'beam'"):
        import_preset("beam", [take], None, tmp_path / "out3")
