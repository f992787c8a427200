"""Studies of the user's own numbers and recordings: small real input, and every mistake in one line."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from scipy.stats import ncx2

sys.path.insert(0, str(Path(__file__).parents[1] / "stereo_node"))  # the renderer of the stereo tests

import scene

from livedeform import cli
from livedeform.common.frames import apply, inverse, transform
from livedeform.compare_node.metrics import run_metrics
from livedeform.compare_node.residual import Residual
from livedeform.fem_node.mesh.generate import write_mesh
from livedeform.fem_node.mesh.structured import block_mesh
from livedeform.run.results import metrics_document, write_markers
from livedeform.studies.own import cuboid as own_cuboid
from livedeform.studies.study import FAILS, HOLDS, OPEN
from livedeform.studies.thesis import gravity
from livedeform.studies.thesis.column import HeavyColumn


def refused(words: list[str], capsys: pytest.CaptureFixture, tmp_path: Path, *said: str) -> None:
    """Exit code 2, one line that says all of ``said``, and nothing written to --out."""
    out = tmp_path / "out"
    assert cli.run(["study", *words, "--out", str(out)]) == 2
    (line,) = [x for x in capsys.readouterr().err.splitlines() if x.startswith("livedeform")]  # the others: progress
    assert all(word in line for word in said), line
    assert not out.exists() and not list(tmp_path.glob(".out-*"))


def document(out: Path) -> dict:
    """What the study wrote."""
    assert (out / "index.html").exists()
    return json.loads((out / "study.json").read_text())


def test_own_cuboid_is_told_from_the_formula(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(own_cuboid, "CELLS", 2)
    # 6.84 mm is what the codes of reference/cuboid_fem.json give for this bonded body
    numbers = "width=50,height=70,E=2896,loss=6.84"
    assert cli.run(["study", "cuboid", "--measured", numbers, "--sigma", "0.15", "--out", str(tmp_path / "out")]) == 0
    found = document(tmp_path / "out")["numbers"]
    by_name = {x["name"]: x for x in found["explanations"]}
    assert by_name["eq. 2.3"]["loss_m"] == pytest.approx(HeavyColumn(0.07, 2896.0).shortening_linear(), rel=1e-6)
    assert by_name["eq. 2.3"]["youngs_modulus_wanted"][0] == pytest.approx(0.5 * 9810 * 0.07**2 / 0.00684, rel=1e-3)
    assert by_name["3-D, bonded base"]["chi2"] < 1.0 and by_name["eq. 2.3"]["p"] < 1e-6
    assert found["not_refused"] == ["3-D, bonded base"]


def test_a_modulus_that_is_badly_known_refuses_less() -> None:
    E = np.array([1000.0, 2000.0, 4000.0])
    own = own_cuboid.OwnCuboid((0.05, 0.05, 0.07), 1000.0, 2000.0, 0.0, 0.49, 0.010, 0.0005)
    sure = own_cuboid.judge(own, "made", E, 24.0 / E)  # 12 mm at 2000 Pa
    assert (sure.loss, sure.chi2) == pytest.approx((0.012, 16.0))
    assert sure.wanted == pytest.approx((2400.0, 24 / 0.0105, 24 / 0.0095), rel=1e-3)
    unsure = own_cuboid.judge(replace(own, youngs_sigma=400.0), "made", E, 24.0 / E)
    assert unsure.sigma == pytest.approx(0.0024, rel=1e-3)  # 20 % of the loss, which goes with 1/E
    assert unsure.p > 0.05 > sure.p


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["cuboid", "--measured", "width=50,height=70,E=2896", "--sigma", "1"], ("--measured loss", "is missing")),
        (["cuboid", "--measured", "width=50,height=70,E=soft,loss=6", "--sigma", "1"], ("--measured E", "'soft'")),
        (["cuboid", "--measured", "width=50,height=70,E=2896,loss=75", "--sigma", "1"], ("--measured loss", "70 mm")),
        (["cuboid", "--measured", "width=50,height=70,E=2896,loss=6"], ("--sigma", "is missing")),
        (["gravity", "--measured", "standing=94.5,hangs=95", "--sigma", "1"], ("hangs=95", "hanging")),
        (["gravity", "--measured", "standing=94.5,hanging=95", "--sigma", "1,2,3"], ("--sigma", "1,2,3")),
        (["gravity", "--measured", "standing=95,hanging=90", "--sigma", "1"], ("--measured hanging", "swapped")),
        (["gravity", "--sigma", "1"], ("--measured", "is missing")),
        (["beam", "--measured", "E=3"], ("'beam' takes no numbers", "leave it away")),
    ],
)
def test_numbers_that_are_wrong(
    words: list[str], said: tuple[str, ...], capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    refused(words, capsys, tmp_path, *said)


def test_a_body_too_soft_to_stand_is_named(
    capsys: pytest.CaptureFixture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(own_cuboid, "CELLS", 2)
    words = ["cuboid", "--measured", "width=50,height=70,E=20,loss=6", "--sigma", "1"]
    refused(words, capsys, tmp_path, "--measured E", "no equilibrium")


def test_own_heights_bound_the_modulus_on_both_sides(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gravity, "CELLS", 2)
    monkeypatch.setattr(gravity, "MODULI", (3500.0, 7000.0, 14000.0, 28000.0))
    # half as tall and twice as dense: the same body in units of its own, so the thesis's curve at the same E
    words = ["gravity", "--measured", "standing=47.25,hanging=49.8,base=60,density=2000", "--sigma", "0.25,0.55"]
    assert cli.run(["study", *words, "--out", str(tmp_path / "out")]) == 0
    found = document(tmp_path / "out")["numbers"]
    assert found["lengthening_m"] == pytest.approx({"measured": 2.55e-3, "sigma": np.hypot(0.25e-3, 0.55e-3)})
    (E,) = found["modulus_pa"]
    assert E["low_2_sigma"] < E["low_1_sigma"] < E["best"] < E["high_1_sigma"] < E["high_2_sigma"]
    same = gravity.hang(0.060, lambda *_: None)  # 94.5 mm tall, water: lengths are twice as long
    assert E["best"] == pytest.approx(same.modulus_at(0.0945 + 2 * 2.55e-3), rel=1e-3)


def test_heights_that_hardly_differ_leave_the_modulus_open() -> None:
    curve = gravity.Curves(0.06, np.array([2000.0, 4000.0]), 0.09 + 40 / np.array([2e3, 4e3]), np.zeros(2), 0.09)
    assert gravity.modulus_text(curve, 0.0) == "∞"
    assert gravity.modulus_text(curve, 0.01) == "4000"
    assert gravity.modulus_text(curve, 0.05) == "< 2000"


N, LIMIT = 40, 0.002


def write_run(folder: Path, *, added: float, noise: float, lesion: bool = False) -> Path:
    """What a run leaves of 40 markers in three frames, as the program writes it: before, half way, and pressed by 5 mm,
    when the model's error has grown by ``added`` m along x; at rest every marker is 1 mm off its own way."""
    rng = np.random.default_rng(3)
    places, static = rng.uniform(-0.03, 0.03, (N, 3)), rng.normal(0.0, 1e-3 / np.sqrt(3), (N, 3))
    residuals = []
    for k, share in enumerate((0.0, 0.5, 1.0)):
        predicted = places - share * np.array([0.0, 0.0, 0.005])
        error = static + share * np.array([added, 0.0, 0.0]) + rng.normal(0.0, noise, (N, 3))
        covariances = np.tile(np.eye(3) * noise**2, (N, 1, 1))
        ids = np.arange(N, dtype=np.uint32)
        residuals.append(Residual(k * 500_000_000, ids, predicted + error, predicted, covariances))
    folder.mkdir()
    write_markers(folder / "markers.csv", residuals, 0)
    metrics = metrics_document(run_metrics(residuals, LIMIT))
    (folder / "metrics.json").write_text(json.dumps({"experiment": "made", **metrics}))
    write_mesh(folder / "block.vtu", block_mesh((0.04, 0.04, 0.03), (2, 2, 2)))
    (folder / "reference.csv").write_text("id,x,y,z\n1,0,0,0.03\n2,0.01,0,0.03\n3,0,0.01,0.03\n4,0.01,0.01,0.03\n")
    phantom = {
        "mesh": "block.vtu", "configuration": "unloaded", "density": 1000.0, "markers": "reference.csv",
        "material": {"model": "neo_hookean", "youngs_modulus": 8000.0, "poisson_ratio": 0.49},
        "support": [{"region": {"below_z": 0.0005}, "type": "fixed"}],
        "lesions": [{"name": "t1", "centre": [0.0, 0.0, 0.015], "diameter": 0.012}] if lesion else [],
    }  # fmt: skip
    text = yaml.safe_dump({"version": 1, "name": "made", "phantom": phantom, "thresholds": {"error": LIMIT}})
    (folder / "experiment.yaml").write_text(text)
    return folder


def test_own_press_is_read_marker_by_marker(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", added=0.001, noise=1e-4, lesion=True)
    assert cli.run(["study", "probe", "--data", str(run), "--out", str(tmp_path / "out")]) == 0
    found = document(tmp_path / "out")
    paired, maxima = found["numbers"]["paired"], found["numbers"]["maxima"]
    assert paired["n"] == N
    low, high = paired["rms_interval_95_m"]
    assert low < 0.001 < high and high - low < 1.5e-4
    assert paired["noise_rms_m"] == pytest.approx(np.sqrt(6) * 1e-4, rel=1e-3)
    assert maxima["bounds_m"][1] > LIMIT > paired["largest_interval_m"][1]  # only the pairs can tell
    verdicts = [c["verdict"] for c in found["claims"]]
    assert verdicts[:2] == [OPEN, HOLDS]
    chances = found["numbers"]["lesion"]["t1"]
    # a 1 mm error and a tip of 2 mm: a non-central chi distribution of three degrees of freedom
    assert chances["0.002"] == pytest.approx(ncx2.cdf((0.006 / 0.002) ** 2, 3, (0.001 / 0.002) ** 2), abs=0.015)
    assert chances["0.0"] == 1.0


def test_own_press_beyond_the_threshold_without_a_lesion(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", added=0.004, noise=1e-4)
    words = ["study", "probe", "--data", str(run), "--measured", "before=0,press=1.0", "--out", str(tmp_path / "out")]
    assert cli.run(words) == 0
    found = document(tmp_path / "out")
    assert found["claims"][1]["verdict"] == FAILS and len(found["claims"]) == 2
    assert any("No verdict on a lesion: the experiment has no lesion" in limit for limit in found["limits"])


def test_runs_that_cannot_be_read(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    run = write_run(tmp_path / "run", added=0.001, noise=1e-4)
    probe = ["probe", "--data", str(run)]
    refused([*probe, "--measured", "press=9"], capsys, tmp_path, "--measured press", "from 0.00 to 1.00 s")
    refused([*probe, "--measured", "before=1,press=1"], capsys, tmp_path, "does not move")
    refused([*probe, "--sigma", "1"], capsys, tmp_path, "--sigma", "leave it away")
    refused(["probe", "--measured", "press=1"], capsys, tmp_path, "--data", "is missing")
    text = (run / "markers.csv").read_text()
    (run / "markers.csv").write_text(text[: len(text) - 40])
    refused(probe, capsys, tmp_path, f"markers.csv:{3 * N + 1}", "torn")
    (run / "markers.csv").unlink()
    refused(probe, capsys, tmp_path, "markers.csv", "cannot be read", "livedeform run")
    (run / "markers.csv").write_text(text)
    (run / "metrics.json").write_text("{}")
    refused(probe, capsys, tmp_path, "metrics.json", "not what a run writes")


def write_dots(folder: Path) -> tuple[Path, tuple[str, ...]]:
    """Two pictures of 7 columns of 6 dots on a cylinder, by cameras with barrel distortion, and the user's files."""
    rig = scene.make_test_rig(1000, 700, 1300.0, baseline=0.06, dist=(-0.3, 0.1, 0, 0, 0), converge=0.2)
    columns, rows = np.meshgrid(np.arange(7), np.arange(6), indexing="ij")
    angle = np.deg2rad(18.0 * (columns.ravel() - 3))
    normals = np.column_stack([np.sin(angle), np.zeros(42), np.cos(angle)])
    points = 0.05 * normals + np.column_stack([np.zeros(42), 0.012 * (rows.ravel() - 2.5), np.zeros(42)])
    T = transform(np.diag([1.0, -1.0, -1.0]), np.array([-0.03, 0.0, 0.29]))  # the cameras look along -z of the target
    folder.mkdir()
    pictures = scene.pair(rig, T, points, normals, scene.Look(radius=0.0025, painted_on=None))
    for side, picture in zip(("left", "right"), pictures, strict=True):
        cv2.imwrite(str(folder / f"{side}.png"), picture.pixels)
    ids = (100 * (columns + 1) + rows + 1).ravel()
    rows_of_text = [f"{i},{x:.6f},{y:.6f},{z:.6f}" for i, (x, y, z) in zip(ids, points, strict=True)]
    (folder / "points.csv").write_text("\n".join(["id,x,y,z", *rows_of_text]))
    seen = []
    for camera, T_camera in ((rig.left, inverse(T)), (rig.right, rig.T_right_left @ inverse(T))):
        there = cv2.projectPoints(apply(T_camera, points), np.zeros(3), np.zeros(3), camera.camera_matrix,
                                  camera.dist_coeffs)[0].reshape(-1, 2)  # fmt: skip
        seen.append(np.round(there + 1.5))  # a hand is 2 px off
    lines = [f"{i},{a[0]:g},{a[1]:g},{b[0]:g},{b[1]:g}" for i, a, b in zip(ids, *seen, strict=True)]
    (folder / "picks.csv").write_text("\n".join(["id,u_left,v_left,u_right,v_right", *lines]))
    return folder, tuple(lines)


def test_own_dots_are_found_at_their_places(tmp_path: Path) -> None:
    folder, _ = write_dots(tmp_path / "target")
    assert cli.run(["study", "dots", "--data", str(folder), "--out", str(tmp_path / "out")]) == 0
    found = document(tmp_path / "out")
    numbers = found["numbers"]
    assert numbers["dots_found"] == numbers["dots_picked"] == [42, 42]
    by_model = numbers["leave_one_column_out"]
    assert by_model["k1k2"]["n"] == 42
    assert by_model["k1k2"]["rms_m"] < 5e-5  # 0.011 mm measured: 0.03 px at 0.29 m
    assert by_model["none"]["rms_m"] > 1e-4  # 0.200 mm: the distortion that the pictures were made with
    assert found["claims"][0]["verdict"] == HOLDS


def test_dots_that_cannot_be_read(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    folder, lines = write_dots(tmp_path / "target")
    words, picks = ["dots", "--data", str(folder)], folder / "picks.csv"
    head = "id,u_left,v_left,u_right,v_right"
    (folder / "detector.yaml").write_text("min_radios: 3\n")
    refused(words, capsys, tmp_path, "min_radios", "min_radius")
    (folder / "detector.yaml").unlink()
    picks.write_text("\n".join([head, *lines[:5], "106,3,x,4,5"]))
    refused(words, capsys, tmp_path, "picks.csv:7", "four pixels")
    picks.write_text("\n".join([head, *lines, "999,1,2,3,4"]))
    refused(words, capsys, tmp_path, "picks.csv:44", "dot 999 is not in points.csv")
    picks.write_text("\n".join([head, *lines[:12]]))
    refused(words, capsys, tmp_path, "both cameras see 2 columns", "3 or more")
    picks.write_text("\n".join([head, *(f"{line.split(',')[0]},9,9,9,9" for line in lines)]))
    refused(words, capsys, tmp_path, "0 of 42 picked dots are found in the left picture")
    picks.unlink()
    refused(words, capsys, tmp_path, "picks.csv", "cannot be read", "left.png, right.png, points.csv")
    (folder / "right.png").unlink()
    refused(words, capsys, tmp_path, "holds no picture right.png")


def test_sigterm_leaves_nothing_behind(tmp_path: Path) -> None:
    words = [sys.executable, "-c", "from livedeform.cli import main; main()", "study", "gravity"]
    process = subprocess.Popen([*words, "--out", str(tmp_path / "out")], stderr=subprocess.PIPE, text=True)
    try:
        for _ in range(600):  # until it works
            if list(tmp_path.glob(".out-*")) or process.poll() is not None:
                break
            time.sleep(0.05)
        assert list(tmp_path.glob(".out-*"))
        os.kill(process.pid, signal.SIGTERM)
        assert process.wait(timeout=60) == 130
    finally:
        process.kill()
        process.communicate()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["cuboid", "gravity", "stacked"])
def test_a_folder_that_would_not_be_read_is_refused(name: str, capsys: pytest.CaptureFixture, tmp_path: Path) -> None:
    refused([name, "--data", str(tmp_path)], capsys, tmp_path, "--data", name, "--measured")
