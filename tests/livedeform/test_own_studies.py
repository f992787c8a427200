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

import numpy as np
import pytest

from livedeform import cli
from livedeform.studies import gravity, own_cuboid
from livedeform.studies.column import Column


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
    assert by_name["eq. 2.3"]["loss_m"] == pytest.approx(Column(0.07, 2896.0).shortening_linear(), rel=1e-6)
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
