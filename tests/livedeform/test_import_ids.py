"""A marker has one id in all takes of a command, whatever a take lacks and however its file is sorted."""

from __future__ import annotations

from pathlib import Path

import ezc3d
import numpy as np
import pytest

from livedeform.common.bags.recording import load_recording
from livedeform.common.errors import InputError
from livedeform.importing.imports import import_takes
from livedeform.importing.marker_ids import ids_of
from livedeform.importing.points import Understanding, import_points

PLACES = {"M1": (0, 0, 50), "M2": (30, 0, 52), "M3": (0, 40, 51), "M4": (30, 40, 60)}  # mm
WORDS = dict(zip(("tip", "base", "left", "right"), PLACES.values(), strict=True))
MM = Understanding("mm", 100.0)


def take(folder: Path, name: str, places: dict[str, tuple[int, ...]], kind: str = "wide") -> Path:
    path = folder / f"{name}.csv"
    if kind == "c3d":
        path = path.with_suffix(".c3d")
        file = ezc3d.c3d()
        for key, value in (("RATE", [100.0]), ("UNITS", ["mm"]), ("LABELS", list(places))):
            file["parameters"]["POINT"][key]["value"] = value
        data = np.ones((4, len(places), 10))
        data[:3] = np.array(list(places.values())).T[:, :, None]
        file["data"]["points"] = data
        file.write(str(path))
    elif kind == "long":
        rows = [f"{k},{n},{x},{y},{z}" for k in range(10) for n, (x, y, z) in places.items()]
        path.write_text("\n".join(["frame,id,x,y,z", *rows]) + "\n")
    else:
        cells = ",".join(str(v) for p in places.values() for v in p)
        head = ",".join(["frame", *(f"{n}_{a}" for n in places for a in "xyz")])
        path.write_text("\n".join([head, *(f"{k},{cells}" for k in range(10))]) + "\n")
    return path


def found(bag: Path) -> dict[int, tuple[int, ...]]:
    frame = load_recording(bag).marker_frames[3]
    return {int(i): tuple(round(1e3 * v) for v in p) for i, p in zip(frame.ids, frame.points, strict=True)}


@pytest.mark.parametrize("kind", ["wide", "long", "c3d"])
@pytest.mark.parametrize("places", [PLACES, WORDS], ids=["numbers at the end", "words"])
def test_a_name_has_one_id_in_all_takes(kind: str, places: dict, tmp_path: Path):
    names = list(places)
    less = {n: places[n] for n in names if n != names[1]}
    other = {n: places[n] for n in (names[3], names[0], names[2], names[1])}
    files = [take(tmp_path, n, p, kind) for n, p in (("all", places), ("less", less), ("other", other))]
    out = tmp_path / "bags"
    lines = import_takes(files, out) if kind == "c3d" else import_points(files, out, MM)
    for name, those in (("all", places), ("less", less), ("other", other)):
        assert found(out / f"{name}.mcap") == {names.index(n) + 1: p for n, p in those.items()}
    warnings = [line for line in lines if line.startswith("warning: ")]
    assert len(warnings) == 1 and f"less.{files[0].suffix[1:]}: has no marker {names[1]}" in warnings[0]
    assert ", ".join(f"{k} {n}" for k, n in enumerate(names, 1)) in warnings[0]


def test_a_take_alone_has_the_numbers_of_its_names(tmp_path: Path):
    """As it has them beside a take that lacks none."""
    less = {n: p for n, p in PLACES.items() if n != "M2"}
    lines = import_points([take(tmp_path, "less", less)], tmp_path / "bags", MM)
    assert list(found(tmp_path / "bags" / "less.mcap")) == [1, 3, 4] and not any("warning" in line for line in lines)


def test_ids_that_are_given_hold_for_all_takes(tmp_path: Path):
    less = {n: p for n, p in WORDS.items() if n != "base"}
    files = [take(tmp_path, "all", WORDS), take(tmp_path, "less", less)]
    ids = {"tip": 7, "base": 8, "left": 9, "right": 4}
    import_points(files, tmp_path / "bags", MM, ids=ids)
    assert found(tmp_path / "bags" / "less.mcap") == {ids[n]: p for n, p in less.items()}
    for wrong, said in (
        ({**ids, "nose": 5}, "none of the takes has a marker 'nose'; the markers are tip, base, left, right"),
        ({"tip": 7, "left": 9, "right": 4}, "marker 'base' has no id"),
        ({**ids, "base": 7}, "two markers got the same id"),
    ):
        with pytest.raises(InputError, match=said):
            import_points(files, tmp_path / "none", MM, ids=wrong, preview=True)


def numbers(*takes: list[str]) -> list[list[int]]:
    return [ids.tolist() for ids in ids_of(takes, {})]


def test_numbers_of_names():
    assert numbers(["10", "11"], ["11"]) == [[10, 11], [11]]
    assert numbers(["M1", "M2"], ["M2", "M30"]) == [[1, 2], [2, 30]]
    assert numbers(["a1", "b1"], ["b1"]) == [[1, 2], [2]]  # two with one number
    assert numbers(["a", "b2"], ["b2"]) == [[1, 2], [2]]  # one without
    assert numbers(["tip", "base"], ["1", "2"]) == [[1, 2], [1, 2]]  # rows of an array have no names
    assert numbers(["1", "2", "3"], ["1", "x", "2"]) == [[1, 2, 3], [1, 4, 2]]
    assert numbers(["*", "*", "tip"], ["tip", "*"]) == [[1, 2, 3], [3, 1]]  # a C3D file may call two alike
    with pytest.raises(InputError, match=r"two markers called '\*'"):
        ids_of([["*", "*"]], {"*": 1})
