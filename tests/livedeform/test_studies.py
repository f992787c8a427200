"""The studies' parts against closed forms and independent values; whole studies are slow and run on request."""

from __future__ import annotations

import contextlib
import json
import os
import signal
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from livedeform import cli
from livedeform.calibrating import length_table
from livedeform.common.errors import InputError
from livedeform.fem_node.items.two_bodies import make_interface
from livedeform.fem_node.physics.record import Interface, MaterialSpec
from livedeform.stereo_node.boards.boards import Board
from livedeform.stereo_node.calibrate.known_lengths import Length
from livedeform.studies import STUDIES, booklet
from livedeform.studies.bodies import cuboid, quarter_holds, quarter_stack, settle
from livedeform.studies.public.swings import release_of, swings_of
from livedeform.studies.study import FAILS, HOLDS, OPEN, StudyPage, figure
from livedeform.studies.thesis import gravity, height, probe, stacked_fit, stacked_models, stereo
from livedeform.studies.thesis.column import HeavyColumn, minimum_modulus, modulus_linear, stretch_under
from livedeform.studies.thesis.cuboid import half_volume_height, reference_values
from livedeform.studies.thesis.sofa import SofaPositions, read_sofa_positions


def quiet(text: str, fraction: float | None = None) -> None:
    """No progress shown."""


def test_column_formula_gives_the_thesis_numbers() -> None:
    assert minimum_modulus(0.07) == pytest.approx(343.35)
    assert HeavyColumn(0.07, 1599.0).shortening_linear() == pytest.approx(0.01503, abs=1e-5)
    assert modulus_linear(0.07, 0.005) == pytest.approx(4807, abs=1)
    assert HeavyColumn(0.07, 979.0).shortening_linear() / HeavyColumn(
        0.035, 979.0
    ).shortening_linear() == pytest.approx(4.0)


def test_finite_column_is_the_linear_one_when_stiff_and_softer_bodies_sink_less_than_it_says() -> None:
    stiff, soft = HeavyColumn(0.07, 1e6), HeavyColumn(0.07, 1599.0)
    assert stiff.shortening_finite() == pytest.approx(stiff.shortening_linear(), rel=2e-3)
    assert soft.shortening_finite() < 0.8 * soft.shortening_linear()


def test_stretch_solves_its_equation() -> None:
    stress = np.array([0.0, 100.0, 1000.0])
    stretch = stretch_under(stress, 3000.0)
    assert 1.0 / stretch**2 - stretch == pytest.approx(3.0 * stress / 3000.0, abs=1e-9)


def test_outline_ends_at_the_shortened_height() -> None:
    column = HeavyColumn(0.07, 2896.0)
    linear, finite, wide = column.outline()
    assert 0.07 - linear[-1] == pytest.approx(column.shortening_linear(), rel=1e-6)
    assert 0.07 - finite[-1] == pytest.approx(column.shortening_finite(), rel=1e-4)
    assert wide[0] > wide[-1] == pytest.approx(1.0)


@pytest.mark.parametrize("base", ["bonded", "sliding"])
def test_cuboid_beside_independent_codes(base: str) -> None:
    theirs = next(
        r["shortening_top_centre"] for r in reference_values()
        if (r["model"], r["base"], r["youngs_modulus"], r["poisson_ratio"])
        == ("neo_hookean_isochoric", base, 2896.0, 0.49)
    )  # fmt: skip
    ours = cuboid(0.07, 2896.0, base, n=2).sink((0.0, 0.0, 0.07))  # type: ignore[arg-type]
    assert ours == pytest.approx(theirs, rel=0.01)  # +0.53 % bonded, +0.39 % sliding measured; the study uses n = 4


@pytest.mark.parametrize("base", ["bonded", "sliding"])
def test_the_soft_cuboid_on_the_graded_mesh_is_the_others(base: str) -> None:
    case = next(
        r for r in reference_values()
        if (r["model"], r["base"], r["youngs_modulus"], r["poisson_ratio"]) == ("neo_hookean_log", base, 1599.0, 0.49)
    )  # fmt: skip
    d = cuboid(0.07, 1599.0, base, model="neo_hookean_log", graded=True)  # type: ignore[arg-type]
    ours = d.sink((0.0, 0.0, 0.07))
    # measured -0.10 % bonded (the others' own uncertainty: 0.69 %), +0.03 % sliding; even cells of 8.3 mm: -1.35 %
    assert ours == pytest.approx(case["shortening_top_centre"], rel=5e-3)


def test_halves_of_an_unloaded_body_meet_in_the_middle() -> None:
    rigid = cuboid(0.07, 1e7, "sliding", n=2)
    assert half_volume_height(rigid) == pytest.approx(0.035, abs=5e-4)


def test_a_slippery_stack_carries_its_weight_and_slides() -> None:
    space = quarter_stack((0.05, 0.05, 0.035), (2, 2, 2))
    item = make_interface(space, Interface(lambda X: np.abs(X[:, 2] - 0.035) < 1e-9, 0.02, reach=0.005), 2000.0)
    material = MaterialSpec("neo_hookean", 2000.0, 0.49)
    d = settle(space, material, quarter_holds(space, "bonded"), further=[item])
    x = np.concatenate([d.u.ravel(), np.zeros(space.n_pressure)])
    weight = 1000.0 * 9.81 * 0.025**2 * 0.035
    assert abs(item.force(x)[2]) == pytest.approx(weight, rel=1e-4)  # measured 1e-7
    assert np.nanmax(np.abs(item.gap(x))) < 1e-5
    lower, upper = np.flatnonzero(np.linalg.norm(space.nodes - (0.025, 0.0, 0.035), axis=1) < 1e-9)
    assert np.linalg.norm(d.u[upper, :2] - d.u[lower, :2]) > 1e-4  # the faces do slide


def test_stacked_column_deforms_three_to_one_and_cannot_explain_the_table() -> None:
    short, tall, top, bottom = stacked_models.column(979.0)
    assert (tall / short, bottom / top) == pytest.approx((4.0, 3.0))
    fitted = stacked_fit.fit(
        stacked_models.Explanation("eq. 2.3", lambda E, _: stacked_models.column(E)), stacked_fit.MEASURED, 0.0011
    )
    assert fitted.chi2 == pytest.approx(32.2, abs=0.1)  # 32.2 computed independently
    assert fitted.p < 1e-6


def test_a_shift_of_the_interface_is_found_again() -> None:
    truth = stacked_models.shifted(stacked_models.column, 1500.0, 0.003)
    explanation = stacked_models.Explanation(
        "shift", lambda E, s: stacked_models.shifted(stacked_models.column, E, s), (-0.01, 0.01, "m")
    )
    fitted = stacked_fit.fit(explanation, truth, 0.001)
    assert (fitted.E, fitted.extra) == pytest.approx((1500.0, 0.003), rel=1e-3)


def test_own_shortenings_are_read_and_refused_in_one_line() -> None:
    own = stacked_fit.own_numbers("3.7,15.2,8.9,7.6", "1.1")
    assert own.values == pytest.approx(stacked_fit.MEASURED) and own.stated == own.honest == pytest.approx(0.0011)
    for text, sigma in (("3.7,15.2", "1.1"), ("3.7,15.2,8.9,x", "1.1"), ("1,2,3,4", "0"), ("1,2,3,4", "1,2,3")):
        with pytest.raises(InputError, match="--measured, --sigma"):
            stacked_fit.own_numbers(text, sigma)


def test_a_folder_without_sofa_files_is_refused_unless_it_holds_the_public_data(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no SOFA file"):
        height.sofa_files(tmp_path)
    (tmp_path / "compression").mkdir()
    assert height.sofa_files(tmp_path) == []


@pytest.mark.parametrize("name", ["beam", "compression", "dots", "stereo", "height"])
def test_a_study_that_fails_leaves_nothing_behind(name: str, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    (tmp_path / "data").mkdir()
    out = tmp_path / "out"
    if name != "height":  # its model is solved first: the missing folder is seen at once
        assert cli.run(["study", name, "--data", str(tmp_path / "data"), "--out", str(out)]) == 2
        assert capsys.readouterr().err.count("\n") == 1
    assert cli.run(["study", name, "--data", str(tmp_path / "nowhere"), "--out", str(out)]) == 2
    assert "does not exist" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["data"]


@pytest.mark.parametrize(
    ("sd", "slope"),
    [(1e-4, 0.0), (9e-4, 0.0), (5e-3, 0.0), (1e-4, -0.05), (1e-4, -0.0348), (1e-4, 1e-4), (1e-4, 0.0348)],
)
def test_verdicts_on_the_thesis_errors_follow_the_measured_ones(sd: float, slope: float, tmp_path: Path) -> None:
    """That lengths scatter by 0.6 to 1.1 mm held whatever they did; that they are 4 % short held where they are not."""
    errors = sd * np.tile([-1.0, 1.0], 240).reshape(8, 3, 20)
    lengths = [
        Length(f"{k}", n, n * 0.025, n * 0.025, n * 0.025 * (1.0 + slope) + e, 0.0, 0.0, 0.5, 0.3, False)
        for k, of_pair in enumerate(errors)
        for n, of_length in zip((1, 6, 8), of_pair, strict=True)
        for e in of_length
    ]
    page = StudyPage("stereo", "t", "q", tmp_path, {})
    rows = length_table(lengths)
    stereo._claims(page, Board("checkerboard", 9, 6, 0.025), lengths, rows, rows)
    verdicts = {c.claim: c.verdict for c in page.claims}
    assert verdicts["the random error of a length is at most 1.1 mm"] == (HOLDS if sd < 1.1e-3 else FAILS)
    assert verdicts["a stereo camera measures lengths 4 % too short"] == (HOLDS if slope == -0.0348 else FAILS)
    assert verdicts["the error does not depend on the board's angle"] == OPEN  # all boards have one angle here


def of_pairs(per_degree: float, sd_pair: float, rng: np.random.Generator, bias: float = 0.0) -> list[Length]:
    """Thirty lengths of six and of one square on each of twelve pairs, tilted by 15 to 45 degrees; of a pair they share
    an error of ``sd_pair`` m, beside 0.1 mm of their own."""
    lengths = []
    for k, degrees in enumerate(np.linspace(15.0, 45.0, 12)):
        shared = per_degree * (degrees - 30.0) + rng.normal(0.0, sd_pair)
        for n in np.repeat([1, 6], 30):
            error = bias * n * 0.025 + shared + rng.normal(0.0, 1e-4)
            true, tilt = n * 0.025, float(np.radians(degrees))
            lengths.append(Length(f"{k}", n, true, true, true + error, 0.0, 0.0, 0.5, tilt, False))
    return lengths


@pytest.mark.parametrize(
    ("per_degree", "sd_pair", "verdict"),
    [(0.0, 1e-5, HOLDS), (5e-5, 1e-5, FAILS), (-5e-5, 1e-5, FAILS), (0.0, 2e-3, OPEN)],
)
def test_the_verdict_on_the_board_s_angle_is_that_of_a_slope(
    per_degree: float, sd_pair: float, verdict: str, tmp_path: Path
) -> None:
    """It was "partly" whatever the slope."""
    lengths = of_pairs(per_degree, sd_pair, np.random.default_rng(0))
    page = StudyPage("stereo", "t", "q", tmp_path, {})
    stereo._claim_angle(page, lengths)
    assert page.claims[0].verdict == verdict
    found = stereo.slope_over_angle(lengths)
    assert abs(found.value - per_degree) < found.factor * found.sigma


def test_lengths_of_one_pair_are_no_repetitions() -> None:
    """What a pair's pose does to all of its lengths is one error: taken as 720 repetitions they
    would make intervals a seventh as wide."""
    draws = [of_pairs(0.0, 3e-4, np.random.default_rng(k)) for k in range(200)]
    for with_tilt in (False, True):
        found = [stereo.clustered(lengths, with_tilt=with_tilt) for lengths in draws]
        held = np.mean([abs(f.value) < f.factor * f.sigma for f in found])
        assert 0.90 <= held <= 0.99  # measured 0.93, 0.97


def test_a_length_has_two_points_and_their_errors_are_counted_once(tmp_path: Path) -> None:
    """1.1 mm was the error of a length, of a point along z, and of a point in space, by turns."""
    rng = np.random.default_rng(2)
    points = rng.normal(0.0, stereo.POINT_SD, (2, 100_000, 3))
    assert np.std(points[0, :, 2] - points[1, :, 2]) == pytest.approx(stereo.LENGTH_SD, rel=0.01)
    far = np.array([0.0, 0.06, 0.0])  # any direction: a length of 60 mm, of the same two points
    lengths = np.linalg.norm(far + points[0] - points[1], axis=1)
    assert np.std(lengths) == pytest.approx(stereo.LENGTH_SD, rel=0.02)
    page = StudyPage("height", "t", "q", tmp_path, {})
    height._noise(page)
    picked, extremes = page.claims
    assert picked.verdict == HOLDS and "± 1.1 mm" in picked.ours and "± 1.1 mm" in picked.theirs
    assert "+ 2.7 mm" in extremes.ours  # 2 x 1.766 x 0.78 mm
    assert not hasattr(height, "SIGMA") and not hasattr(probe, "SIGMA_POINT")


@pytest.mark.parametrize("shift", [0.0, 0.025, -0.4])
def test_a_slice_s_half_width_does_not_know_where_the_body_stands(shift: float) -> None:
    states = np.random.default_rng(3).uniform(0.0, 1.0, (2, 4000, 3)) * (0.05, 0.05, 0.07) + (shift, 0.0, 0.0)
    for _, _, half in height.slice_heights(SofaPositions(np.arange(2.0), states)):
        assert float(half) == pytest.approx(25.0, abs=0.3)


def test_what_gravity_twice_is_off_by_is_that_of_all_bodies() -> None:
    """It named the first body's at 5 kPa, and a body without an equilibrium made it nan."""
    moduli = np.array([1800.0, 5000.0])
    right = gravity.HEIGHT + np.array([0.010, 0.004])
    slim = gravity.Curves(0.055, moduli, right, right + np.array([0.0005, 0.00003]))
    wide = gravity.Curves(0.075, moduli, right, right - np.array([np.nan, 0.00014]))
    for curves in ([slim, wide], [wide, slim]):
        said, worst = gravity.error_of_twice(curves)
        assert "0.03 to 0.14 mm at 5 kPa" in said and "0.5 mm at 1.8 kPa (half width 55 mm)" in said
        assert said.endswith("no equilibrium at 1.8 kPa (half width 75 mm)") and worst == pytest.approx(0.0005)
    said, worst = gravity.error_of_twice([gravity.Curves(0.055, moduli, right, right * np.nan)])
    assert said.startswith("no equilibrium at") and np.isnan(worst)


def test_both_bodies_of_gravity_twice_are_kept_and_a_missing_one_has_a_word(tmp_path: Path) -> None:
    moduli, right = np.array([1800.0, 5000.0]), gravity.HEIGHT + np.array([0.010, 0.004])
    curves = [gravity.Curves(r, moduli, right, right + np.array([np.nan, r * 1e-3])) for r in (0.055, 0.075)]
    page = StudyPage("gravity", "t", "q", tmp_path)
    gravity._twice(page, curves)
    document = page.finish()
    assert [k["radius"] for k in document["numbers"]["twice_minus_inverse_m"]] == [0.055, 0.075]
    html = (tmp_path / "index.html").read_text()
    assert html.count("no equilibrium") >= 2 and "nan" not in html


def test_extremes_of_noisy_points_are_biased_and_two_points_carry_two_errors() -> None:
    rng = np.random.default_rng(1)
    bias, sigma = height.extremes_bias(1, 0.001, rng)
    assert abs(bias) < 5e-5 and sigma == pytest.approx(0.001 * np.sqrt(2), rel=0.05)
    # the expected largest of 16 normal numbers is 1.766 sigma (Harter 1961)
    assert height.extremes_bias(16, 0.001, rng)[0] == pytest.approx(2 * 1.766e-3, rel=0.03)


@pytest.mark.parametrize("write", [height.write_monitor, height.write_state])
def test_sofa_files_come_back(write, tmp_path: Path) -> None:
    states = np.random.default_rng(0).normal(size=(3, 5, 3))
    positions = read_sofa_positions(write(tmp_path / "body_x.txt", states))
    assert positions.points == pytest.approx(states, abs=1e-9)
    assert positions.heights() == pytest.approx(np.ptp(states[:, :, 2], axis=1))


def test_gnuplot_header_of_sofa_and_a_bad_line(tmp_path: Path) -> None:
    path = tmp_path / "m_x.txt"
    path.write_text("# Gnuplot File : positions of 2 particle(s) Monitored\n# 1st Column : time\n0\t1 2 3\t4 5 6\t\n")
    assert read_sofa_positions(path).points.shape == (1, 2, 3)
    path.write_text("0\t1 2 3\t4 5\n")
    with pytest.raises(InputError, match="line 1 holds 5 numbers"):
        read_sofa_positions(path)


def test_interval_of_the_modulus_has_no_upper_end() -> None:
    moduli = np.array([2000.0, 4000.0, 8000.0])
    curve = gravity.Curves(0.06, moduli, gravity.HEIGHT + 40.0 / moduli, gravity.HEIGHT + 40.0 / moduli)
    assert curve.modulus_at(gravity.HEIGHT + 0.01) == pytest.approx(4000.0)
    assert curve.modulus_at(gravity.HEIGHT) == float("inf")
    assert curve.modulus_at(gravity.HEIGHT + 0.001) == pytest.approx(40000.0)


def test_a_page_holds_claims_figures_and_numbers(tmp_path: Path) -> None:
    page = StudyPage("made", "A <made> study", "Is it so?", tmp_path, seed=3)
    fig, ax = figure()
    ax.plot([0, 1])
    page.claim("it is", "1", "2", HOLDS)
    page.numbers["array"] = np.array([1.0, np.nan])
    page.section("Figure", "text", figures=[("line", fig, "a line")])
    document = page.finish()
    assert json.loads((tmp_path / "study.json").read_text()) == document
    assert document["numbers"]["array"] == [1.0, None]
    html = (tmp_path / "index.html").read_text()
    assert "A &lt;made&gt; study" in html and "data:image/png;base64," in html
    assert (tmp_path / "line.svg").exists()


def good(out: Path, data: Path | None, progress: object) -> dict:
    page = StudyPage("good", "Good", "?", out)
    page.claim("it is", "1", "2", HOLDS)
    return page.finish()


def absent(out: Path, data: Path | None, progress: object) -> dict:
    raise InputError("this study needs data", remedy="get it")


def test_booklet_names_what_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(booklet, "STUDIES", {"good": good, "absent": absent})
    document = booklet.make_booklet(tmp_path, None, quiet)
    html = (tmp_path / "index.html").read_text()
    assert "this study needs data; get it" in html and 'href="good/index.html"' in html
    assert document["studies"]["absent"]["missing"]


def test_a_fault_in_one_study_of_all_takes_nothing_from_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """A study that failed to converge was missing from the booklet with exit code 0, and a fault left no booklet."""

    def faulty(out: Path, data: Path | None, progress: object) -> dict:
        raise np.linalg.LinAlgError("Singular matrix")

    for studies, code in (({"faulty": faulty, "good": good}, 2), ({"absent": absent, "good": good}, 0)):
        out = tmp_path / str(code)
        monkeypatch.setattr(booklet, "STUDIES", studies)
        assert cli.run(["study", "all", "--out", str(out)]) == code
        said = capsys.readouterr().err
        assert ("faulty: a fault of livedeform, LinAlgError: Singular matrix" in said) == (code == 2)
        assert ("study absent is left out: this study needs data; get it" in said) == (code == 0)
        assert json.loads((out / "study.json").read_text())["studies"]["good"]["claims"]
        assert 'href="good/index.html"' in (out / "index.html").read_text()


def test_what_was_done_is_kept_when_a_part_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    def half(out: Path, data: Path | None, progress: object) -> dict:
        page = StudyPage("beam", "Half", "?", out)
        page.claim("one: it is", "1", "2", HOLDS)
        page.failure("two", np.linalg.LinAlgError("Eigenvalues did not converge"))
        return page.finish()

    monkeypatch.setitem(STUDIES, "beam", half)
    assert cli.run(["study", "beam", "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "two: a fault of livedeform, LinAlgError: Eigenvalues" in error
    document = json.loads((tmp_path / "out/study.json").read_text())
    assert [c["verdict"] for c in document["claims"]] == [HOLDS, OPEN] and list(document["failed"]) == ["two"]
    assert (tmp_path / "out/configuration.json").exists() and (tmp_path / "out/index.html").exists()
    monkeypatch.setattr(booklet, "STUDIES", {"beam": half})
    assert booklet.make_booklet(tmp_path / "all", None, quiet)["studies"]["beam"]["claims"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["height", "cuboid", "stacked", "gravity", "probe", "compression"])
def test_whole_study(name: str, tmp_path: Path) -> None:
    data = Path(os.environ.get("LIVEDEFORM_DATA", Path(__file__).parents[2].parent / "shared" / "data"))
    if name == "compression" and not (data / "compression").is_dir():
        pytest.skip("needs the public compression data (LIVEDEFORM_DATA)")
    document = STUDIES[name](tmp_path, data if name == "compression" else None, quiet)
    assert document["claims"] and (tmp_path / "index.html").exists()


def test_a_stop_that_a_library_swallows_still_stops(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def swallowing(out: Path, data: Path | None, progress: Callable[..., None]) -> dict:
        with contextlib.suppress(KeyboardInterrupt):  # as what calls back from C, or runs while an object dies, does
            signal.raise_signal(signal.SIGTERM)
        (out / "study.json").write_text("{}")
        return {}

    monkeypatch.setitem(STUDIES, "gravity", swallowing)
    assert cli.run(["study", "gravity", "--out", str(tmp_path / "out")]) == 130
    assert not list(tmp_path.iterdir())


def test_a_tips_swing_is_told_by_its_frequency_damping_and_creep() -> None:
    t = np.arange(-0.2, 5.0, 0.01)
    after = np.maximum(t, 0.0)
    swing = np.exp(-0.05 * 2.0 * np.pi * 7.7 * after) * np.cos(2.0 * np.pi * 7.7 * after)
    height = -6.5e-3 * (t > 0.0) * (1.0 - swing) - 2e-4 * np.log10(1.0 + after)
    found = swings_of(t, height)
    assert found.hertz == pytest.approx(7.7, rel=2e-3) and found.damping == pytest.approx(0.05, rel=0.03)
    assert found.creep == pytest.approx(-2e-4 * np.log10(5.74 / 3.75), abs=2e-6)  # means of half a second
    tip = np.repeat(height[:, None, None], 3, axis=2)
    assert release_of(t, np.roll(tip, 1, axis=0), tip, 0.012) == pytest.approx(0.01, abs=1e-3)
