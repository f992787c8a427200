"""Compression tests between platens: sizes, files, fits, and intervals that are of what they say."""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest

from livedeform.common.errors import InputError
from livedeform.studies.public import compression
from livedeform.studies.public.compression_tests import Size, Specimen, latest_touch, read, read_materials
from livedeform.studies.study import StudyPage


def test_bonded_disc_is_stiffer_than_a_free_one_by_the_published_factor() -> None:
    strains = (0.0, 0.02, 0.04)
    bonded = compression.platen_stress(0.0, cells=3, strains=strains)
    free = compression.free_curve(np.array(strains), np.array([1.0, 0.0]))
    assert bonded[1] / free[1] == pytest.approx(1.35, abs=0.06)  # measured 1.388
    flatter = compression.platen_stress(0.0, shape=2.0, cells=3, strains=strains)
    assert flatter[1] > 1.5 * bonded[1]  # a flat disc is held at its faces all over


def pushed(
    path: Path, *, diameter: float, height: float, E: float = 3e4, header: bool = True, offset: float = 0.0
) -> Path:
    """A test of a free cylinder (mm) as a machine writes it."""
    travel = np.arange(0.0, 0.5 * height, height / 150)
    stress = compression.free_curve(np.clip((travel - offset) / height, 0, None), np.array([E, 0.0]))
    load = stress * np.pi * (0.5e-3 * diameter) ** 2
    head = [f"Cylinder Diameter: {diameter:g}mm;", f"Cylinder Height: {height:g}mm;"] if header else ["a;"]
    rows = [f"{k / 10},{x:.5f},{f:.6f},0" for k, (x, f) in enumerate(zip(travel, load, strict=True))]
    path.parent.mkdir(exist_ok=True)
    path.write_text("\n".join([*head, "Time (s),Compression (mm),Load (N),x", *rows]))
    return path


def test_modulus_and_stiffening_are_fitted_back() -> None:
    strain = np.linspace(0.02, 0.38, 60)
    truth = np.array([3e4, 0.2])
    force = compression.free_curve(strain - 1e-4 / 0.03, truth) * np.pi * 0.025**2
    specimen = Specimen("made", strain, force, 0.025, 0.03)
    fitted = compression.fit(compression.free_curve, specimen, True)
    assert (fitted.E, fitted.b, fitted.offset) == pytest.approx((3e4, 0.2, 1e-4), rel=1e-2)


def test_a_cylinder_has_the_size_that_its_file_or_the_user_says(tmp_path: Path) -> None:
    """25 mm across, not the published 50 mm: four times the modulus."""
    small = read(pushed(tmp_path / "m" / "a1.csv", diameter=25.0, height=15.0))
    assert (small.radius, small.height) == pytest.approx((0.0125, 0.015))
    assert pytest.approx(3e4, rel=1e-3) == compression.fit(compression.free_curve, small, False).E
    silent = pushed(tmp_path / "m" / "a2.csv", diameter=25.0, height=15.0, header=False)
    with pytest.raises(InputError, match=r"does not state the cylinder's diameter and height.*--diameter"):
        read(silent)
    assert (
        pytest.approx(3e4, rel=1e-3)
        == compression.fit(compression.free_curve, read(silent, Size(0.0125, 0.015)), False).E
    )
    with pytest.raises(InputError, match="give metres"):
        Size(12.5, 15.0)


def test_every_file_that_cannot_be_used_is_named(tmp_path: Path) -> None:
    for k in (1, 2):
        pushed(tmp_path / "one" / f"A{k}.csv", diameter=50, height=30)
    pushed(tmp_path / "two" / "B1.csv", diameter=50, height=30)
    pushed(tmp_path / "two" / "B2.csv", diameter=20, height=30)
    (tmp_path / "two" / "torn.csv").write_text((tmp_path / "two" / "B1.csv").read_text()[:900])
    (tmp_path / "one" / "bad.csv").write_text("1,2,3\n")
    materials, dropped = read_materials(tmp_path)
    assert {k: [t.name for t in v] for k, v in materials.items()} == {"one": ["A1", "A2"], "two": ["B1"]}
    assert len(dropped) == 3 and all(any(n in line for line in dropped) for n in ("torn.csv", "bad.csv", "B2.csv"))
    with pytest.raises(InputError, match=r"holds no \*.csv file"):
        (tmp_path / "none").mkdir()
        read_materials(tmp_path / "none")
    for name in ("a.csv", "b.txt", "c.xlsx"):
        (tmp_path / "none" / name).write_text("1,2,3\n")
    with pytest.raises(InputError, match=r"none of 3 files can be used \(.*a.csv: holds no table.*nor b.txt, c.xlsx"):
        read_materials(tmp_path / "none")


def test_the_touch_of_an_unseen_test_is_not_fitted(tmp_path: Path) -> None:
    """A test that touches 0.3 mm later than the others is predicted too stiff, and its misfit says so."""
    same = read(pushed(tmp_path / "m" / "A1.csv", diameter=50, height=30))
    late = read(pushed(tmp_path / "m" / "A2.csv", diameter=50, height=30, offset=0.3))
    p = np.array([3e4, 0.0])
    assert compression.unseen_misfit(compression.free_curve, same, p, 0.0) < 1e-3
    assert compression.unseen_misfit(compression.free_curve, late, p, 0.0) > 0.02


def test_the_next_specimens_interval_is_of_specimens_and_not_of_repeats() -> None:
    """Two specimens 30 % apart, whose five repeats agree within 1 %: the repeats' mean says nothing of the third."""
    rng = np.random.default_rng(0)
    names = [f"A{k}" for k in range(5)] + [f"B{k}" for k in range(5)]
    moduli = [1e4 * (1.3 if n[0] == "B" else 1.0) * np.exp(rng.normal(0, 0.01)) for n in names]
    tests = [Specimen(n, np.ones(1), np.ones(1), 0.025, 0.03, n[0]) for n in names]
    each = compression.by_specimen(tests, moduli)
    assert list(each) == ["A", "B"] and each["B"] / each["A"] == pytest.approx(1.3, rel=0.02)
    low, high = compression.next_interval(list(each.values()))
    assert low < 3e3 and high > 4e4  # two specimens: Student's t of one degree of freedom
    assert np.isnan(compression.next_interval([1e4])).all()
    held = 0
    for _ in range(400):
        values = np.exp(rng.normal(np.log(1e4), 0.05, 6))
        low, high = compression.next_interval(values[:5])
        held += low < values[5] < high
    assert held / 400 == pytest.approx(0.95, abs=0.03)


@pytest.fixture(scope="module")
def models() -> compression.Models:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compression, "STIFFENING", (0.0, 0.25))
        return compression.curves(5.0 / 6.0, lambda *_: None)


@pytest.mark.parametrize("platens", ["free", "bonded"])
@pytest.mark.parametrize("height", [0.015, 0.03, 0.1])
def test_a_touch_beside_zero_is_found_as_far_as_it_is_taken(
    platens: str, height: float, models: compression.Models, tmp_path: Path
) -> None:
    """With a bonded curve that ended at 40 %, a free one that pulled before the touch and 1 mm at most, 50 kPa came out
    as 53.7 (bonded, 15 mm, touched 0.6 mm early), 47.5 (free, 15 mm, 1 mm late) and 42.3 kPa (free, 100 mm, 4 mm)."""
    latest = latest_touch(height)
    assert latest == pytest.approx(1e-3 + 0.05 * height)
    curve, radius = models[f"{platens}, neo-Hookean"][0], height * 5.0 / 6.0
    found = {}
    for touch in (-latest, -0.4 * latest, 0.0, 0.6 * latest, 0.95 * latest):
        travel = np.linspace(0.0, 0.41, 400) * height
        load = curve((travel - touch) / height, np.array([5e4, 0.0])) * np.pi * radius**2
        rows = "\n".join(f"{1e3 * x:.6f},{f:.8f}" for x, f in zip(travel, load, strict=True))
        path = tmp_path / "a.csv"
        path.write_text(f"Diameter: {2e3 * radius} mm\nHeight: {1e3 * height} mm\nCompression (mm),Load (N)\n{rows}")
        try:
            test = read(path)
        except InputError as error:  # 2 % of the load come later than the touch
            assert touch > 0.9 * latest and "the load begins at" in str(error)
            continue
        for stiffening in (False, True):
            fitted = compression.fit(curve, test, stiffening)
            found[touch, stiffening] = fitted.E, fitted.offset - touch, fitted.misfit
    assert len(found) >= 8
    E, off, misfit = np.array(list(found.values())).T
    np.testing.assert_allclose(E, 5e4, rtol=1e-3)
    assert np.abs(off).max() < 1e-3 * latest and misfit.max() < 1e-3


def test_strains_of_a_bonded_curve_may_be_in_any_order(models: compression.Models) -> None:
    """A machine's compression goes back by its noise."""
    strain, law = np.array([0.1, 0.3, 0.29, -0.01, 0.9]), np.array([2e4, 0.1])
    curve = models["bonded, stiffening"][0]
    one_by_one = [curve(strain[[k]], law)[0] for k in range(len(strain))]
    np.testing.assert_allclose(curve(strain, law), one_by_one)
    assert one_by_one[3] == pytest.approx(0.0, abs=1e-6)


def test_where_bonded_platens_are_not_solved_far_enough_the_page_says_so(models: compression.Models) -> None:
    """The early touch is then looked for as far as they are; it is no fit at the end of a curve that stays level."""
    test = Specimen("a", np.linspace(0.02, 0.39, 50), np.linspace(0.1, 9.0, 50), 4e-3, 5e-3)
    material = compression.TestedMaterial([test, test], {}, {}, models)
    (said,) = compression._unreached({"m": material})
    assert "8 mm across and 5 mm high" in said and "0.65 mm before" in said  # of 1.25 mm
    assert compression.fit(models["bonded, neo-Hookean"][0], test, False).offset >= -0.13 * 5e-3 - 1e-9


def test_figures_of_ten_materials_have_room(tmp_path: Path) -> None:
    test = read(pushed(tmp_path / "m" / "A1.csv", diameter=50, height=30))
    models = {"free, neo-Hookean": (compression.free_curve, False)}
    page = StudyPage("x", "x", "x", tmp_path / "out", {})
    compression._figure(page, {f"m{k}": compression.fitted([test], models) for k in range(10)})
    page.finish()
    picture = plt.imread(next((tmp_path / "out").glob("*.png")))
    assert picture.shape[0] > 0.9 * picture.shape[1]  # three rows of four, not ten panels beside each other


def test_a_compression_file_is_read_and_a_torn_one_is_one_line(tmp_path: Path) -> None:
    header = ["a;"] * 6 + ["Time (s),Compression (mm),Load (N),x"]
    rows = [f"{k / 10},{k * 0.1:.3f},{k * 0.5:.3f},0" for k in range(150)]
    size = Size(0.025, 0.03)
    (tmp_path / "t.csv").write_text("\n".join(header + rows))
    specimen = read(tmp_path / "t.csv", size)
    assert specimen.force == pytest.approx(specimen.strain * 30.0 * 5.0, rel=1e-6)
    (tmp_path / "bad.csv").write_text("1,2,3\n")
    with pytest.raises(InputError, match="holds no table"):
        read(tmp_path / "bad.csv")
    (tmp_path / "torn.csv").write_text("\n".join([*header, *rows, "15.0,15."]))
    with pytest.raises(InputError, match="has 2 cells beside lines of 4; it may be torn"):
        read(tmp_path / "torn.csv", size)
    (tmp_path / "short.csv").write_text("\n".join([*header, *rows[:59]]))
    with pytest.raises(InputError, match="ends at a compression of 19 % in 59 lines; 39 % are needed"):
        read(tmp_path / "short.csv", size)


def written(path: Path, *, head: list[str], columns: str, scale: tuple[float, float], sep: str = ",") -> Specimen:
    """A free cylinder of 25 x 15 mm and 20 kPa, as columns that are ``scale`` times SI."""
    travel = np.linspace(0.0, 0.0062, 200)
    load = compression.free_curve(travel / 0.015, np.array([2e4, 0.0])) * np.pi * 0.0125**2
    cells = [
        (str(k), f"{scale[0] * x:.8f}", f"{scale[1] * f:.8f}")
        for k, (x, f) in enumerate(zip(travel, load, strict=True))
    ]
    rows = [sep.join(row) if sep == "," else sep.join(row).replace(".", ",") for row in cells]
    path.write_text("\n".join([*head, columns.replace(",", sep), *rows]), encoding="utf-8-sig")
    return read(path)


PLAIN = ["Diameter: 25mm;", "Height: 15mm;"]


@pytest.mark.parametrize(
    "head, columns, scale, sep",
    [
        (PLAIN, "Time (s),Compression (mm),Load (N)", (1e3, 1.0), ","),
        (PLAIN, "Time (s),Compression (mm),Load (N)", (1e3, 1.0), ";"),
        (PLAIN, '"Time (s)","Displacement (cm)","Force (kN)"', (1e2, 1e-3), ","),
        (PLAIN, "n,Extension [in],Load [lbf]", (1 / 0.0254, 1 / 4.4482216), ","),
        (PLAIN, "Time (s),Compression (mm),Load (g)", (1e3, 1 / 9.80665e-3), ","),
        (PLAIN, "Time (s),Extension (mm),Load (N)", (-1e3, -1.0), ","),  # a machine that counts pulling
        (["Cylinder diameter 25 mm, height 15 mm"], "Time (s),Compression (mm),Load (N)", (1e3, 1.0), ","),
        (["Diameter (mm): 25", "Height (mm): 15"], "Time (s),Compression (mm),Load (N)", (1e3, 1.0), ","),
        (["radius,0.0125,m", "height,0.015,m"], "Time (s),Compression (mm),Load (N)", (1e3, 1.0), ","),
        (["Diameter: 2,5 cm", "Length = 1,5 cm"], "Time (s),Compression (mm),Load (N)", (1e3, 1.0), ","),
    ],
)
def test_units_signs_and_headers_of_others_give_one_modulus(head, columns, scale, sep, tmp_path: Path) -> None:
    test = written(tmp_path / "a.csv", head=head, columns=columns, scale=scale, sep=sep)
    assert pytest.approx(2e4, rel=1e-3) == compression.fit(compression.free_curve, test, False).E
    assert (test.radius, test.height) == pytest.approx((0.0125, 0.015)) and not test.notes


@pytest.mark.parametrize(
    "head, columns, scale, said",
    [
        ([*PLAIN, "Platen diameter: 100 mm"], "t,Compression (mm),Load (N)", (1e3, 1.0), "two values of the diameter"),
        (["Diameter: 25 m", "Height: 15 m"], "t,Compression (mm),Load (N)", (1e3, 1.0), "a.csv: a cylinder of radius"),
        (["Diameter: 25", "Height: 15"], "t,Compression (mm),Load (N)", (1e3, 1.0), "does not state the cylinder's"),
        (PLAIN, "t,Compression (mm),Load (N)", (1e4, 1.0), "is compressed by 62.0 mm, and 15.0 mm high"),
        (PLAIN, "t,Compression (mm),Load (psi)", (1e3, 1.0), "the unit 'psi' of load is not known"),
        (PLAIN, "t,Compression (mm),Load (N)", (1e3, -1.0), "the load does not push"),
        (PLAIN, "t,Strain,Stress (kPa)", (1.0, 1.0), "has no column 'compression'"),
    ],
)
def test_a_header_that_is_wrong_is_one_line(head, columns, scale, said: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=said):
        written(tmp_path / "a.csv", head=head, columns=columns, scale=scale)


def test_what_is_taken_beside_the_file_is_noted(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    bare = written(path, head=PLAIN, columns="Time,Compression,Load", scale=(1e3, 1.0))
    assert len(bare.notes) == 2 and "no unit of load, taken as N" in bare.notes[1]
    (note,) = (n for n in read(path, Size(0.02, 0.015)).notes if "header" in n)
    assert "header says diameter 25 mm and height 15 mm, taken are 40 and 15 mm" in note


def test_a_test_is_one_loading_from_the_touch_on(tmp_path: Path) -> None:
    """A gap before the touch is no soft beginning; the way back and a first cycle are no loading."""
    pushed(tmp_path / "m" / "a.csv", diameter=50, height=30, offset=4.0)
    with pytest.raises(InputError, match=r"the load begins at a compression of 4\.\d mm"):
        read(tmp_path / "m" / "a.csv")
    lines = pushed(tmp_path / "m" / "b.csv", diameter=50, height=30).read_text().splitlines()
    once = read(tmp_path / "m" / "b.csv")
    back = [*lines, *(line.rsplit(",", 2)[0] + ",1.0,0" for line in reversed(lines[3:]))]
    (tmp_path / "m" / "b.csv").write_text("\n".join(back))
    np.testing.assert_allclose(read(tmp_path / "m" / "b.csv").force, once.force)
    (tmp_path / "m" / "b.csv").write_text("\n".join([*lines[:60], *lines[3:]]))
    with pytest.raises(InputError, match="is loaded more than once"):
        read(tmp_path / "m" / "b.csv")
    (tmp_path / "m" / "b.csv").write_text("\n".join([*lines[:60], "9,4.0,,0", *lines[60:]]))
    with pytest.raises(InputError, match=r"b\.csv:61: has no compression or no load"):
        read(tmp_path / "m" / "b.csv")


def test_the_mean_of_several_specimens_is_no_mean_of_their_repeats() -> None:
    """Three specimens 10 % apart with five repeats within 1 %: 15 tests do not make the mean known to 1 %."""
    rng = np.random.default_rng(3)
    moduli = {s: 1e4 * f * np.exp(rng.normal(0, 0.01, 5)) for s, f in (("A", 0.9), ("B", 1.0), ("C", 1.1))}
    tests = [Specimen(f"{s}{k}", np.ones(1), np.ones(1), 0.025, 0.03, s) for s in moduli for k in range(5)]
    fits = [compression.FittedLaw(float(E), 0.0, 0.0, 0.01) for values in moduli.values() for E in values]
    found = compression._numbers(compression.TestedMaterial(tests, {"m": fits}, {"m": 0.02}, {}), "m")
    low, high = found["interval_of_the_specimens_mean"]
    assert high / low > 1.5 and found["interval_of_the_repeats_mean"] is None
    low, high = found["interval_of_the_next_repeat"]["A"]
    assert 0.9e4 * 0.96 < low < 0.9e4 < high < 0.9e4 * 1.04  # about its own specimen
    assert found["next_repeat_held"][1] == 15 and found["next_repeat_held"][0] >= 12
    assert compression._repeats(found).startswith("its own mean ± ")
