"""The user's own dots: two pictures of a target whose dots lie at known places. Every column that both cameras see is
measured by cameras that are calibrated on the others.

The folder holds ``left`` and ``right`` (png, jpg, bmp or tiff), ``points.csv`` (id,x,y,z in metres), ``picks.csv``
(where roughly each dot is in the pictures) and, if the dots are not found without it, ``detector.yaml`` (as an
experiment's ``stereo.detector``). A dot's id is 100 times its column plus its row, both counted from 1.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from livedeform.common.errors import InputError
from livedeform.common.experiment.markers_file import read_markers
from livedeform.common.types import Array
from livedeform.common.yaml_text import parse_yaml
from livedeform.report.page import Table
from livedeform.stereo_node.boards.find_pairs import read_picture
from livedeform.stereo_node.detect.settings import DetectorSettings
from livedeform.studies.public.dots import MODELS, Dots, LeftOut, detected, leave_one_column_out
from livedeform.studies.study import COLOURS, FAILS, HOLDS, OPEN, Progress, StudyPage, figure

SIDES = ("left", "right")
SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
COLUMNS = ("id", "u_left", "v_left", "u_right", "v_right")
DETECTOR = {"type": "blob"}
FEWEST_COLUMNS, FEWEST_DOTS = 3, 12  # that both cameras see; that are left for a camera without a column
SEED, N_DRAWS = 7, 2000
FILES = "left.png, right.png, points.csv, picks.csv"
MM = 1e3


@dataclass(frozen=True)
class OwnDots:
    """Hold what is in the folder ``name``; ``dots`` have the user's picks in the published centroids' place."""

    name: str
    dots: Dots
    detector: dict[str, Any]


def is_own(folder: Path) -> bool:
    """Return whether a folder is meant to hold one's own dots."""
    return any((folder / name).exists() for name in ("points.csv", "picks.csv"))


def read_own(folder: Path) -> OwnDots:
    """The user's folder; ``InputError`` naming the file for anything that does not fit."""
    pictures = [read_picture(str(_picture(folder, side))) for side in SIDES]
    if pictures[0].shape != pictures[1].shape:
        raise InputError("the two pictures differ in size", where=str(folder), remedy="take both with the same size")
    markers = read_markers(folder / "points.csv")
    column, row = markers.ids.astype(int) // 100 - 1, markers.ids.astype(int) % 100 - 1
    if column.min() < 0 or row.min() < 0:
        bad = markers.ids[(column < 0) | (row < 0)][0]
        remedy = "number dots 100 * column + row, both from 1: 705 is the fifth dot of column 7"
        raise InputError(f"id {bad} has no column or no row", where=str(folder / "points.csv"), remedy=remedy)
    places = np.full((row.max() + 1, column.max() + 1, 3), np.nan)
    places[row, column] = markers.points
    picks = read_picks(folder / "picks.csv", {int(i) for i in markers.ids})
    columns, pixels = [], []
    for side in range(2):
        grid = np.full((*places.shape[:2], 2), np.nan)
        for i, pick in picks.items():
            grid[i % 100 - 1, i // 100 - 1] = pick[2 * side : 2 * side + 2]
        seen = np.flatnonzero(np.isfinite(grid[:, :, 0]).any(axis=0)).astype(np.int64)
        columns.append(seen)
        pixels.append(grid[:, seen].transpose(1, 0, 2))
    dots = Dots(places, (pictures[0], pictures[1]), (columns[0], columns[1]), (pixels[0], pixels[1]))
    return OwnDots(folder.name, dots, _detector(folder / "detector.yaml"))


def _picture(folder: Path, side: str) -> Path:
    for suffix in SUFFIXES:
        if (path := folder / f"{side}{suffix}").exists():
            return path
    raise InputError(f"holds no picture {side}.png", where=str(folder), remedy=f"needed are {FILES}")


def read_picks(path: Path, known: set[int]) -> dict[int, Array]:
    """id -> (4,) px u, v in the left and in the right picture, from 0; NaN where a camera does not see the dot."""
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not text"
        raise InputError(f"cannot be read ({reason})", where=str(path), remedy=f"needed are {FILES}") from error
    rows = csv.DictReader(lines, skipinitialspace=True)
    missing = [c for c in COLUMNS if c not in (rows.fieldnames or [])]
    if missing:
        remedy = f"begin it with {','.join(COLUMNS)}"
        raise InputError(f"column {', '.join(missing)} is missing", where=str(path), remedy=remedy)
    out: dict[int, Array] = {}
    for number, row in enumerate(rows, start=2):
        try:
            i, pick = int(row["id"]), np.array([float(row[c]) if row[c] else np.nan for c in COLUMNS[1:]])
        except (TypeError, ValueError) as error:
            remedy = "write an id and four pixels; leave those of a camera empty that does not see the dot"
            raise InputError("a number is missing or is none", where=f"{path}:{number}", remedy=remedy) from error
        if i not in known or i in out:
            what = "is picked twice" if i in out else "is not in points.csv"
            raise InputError(f"dot {i} {what}", where=f"{path}:{number}", remedy="correct the id or delete the line")
        pick[:2], pick[2:] = (np.where(np.isfinite(p).all(), p, np.nan) for p in (pick[:2], pick[2:]))
        out[i] = pick
    return out


def _detector(path: Path) -> dict[str, Any]:
    if not path.exists():
        return dict(DETECTOR)
    try:
        _, values = parse_yaml(path.read_text(), str(path))
    except (InputError, UnicodeDecodeError) as error:
        raise InputError("is not YAML", where=str(path), remedy="write lines like 'min_radius: 6.0'") from error
    if not isinstance(values, dict):
        raise InputError("holds no keys", where=str(path), remedy="write lines like 'min_radius: 6.0'")
    DetectorSettings.from_mapping(DETECTOR | values)  # says which key is wrong
    return DETECTOR | values


def run_own(out: Path, own: OwnDots, progress: Progress) -> dict[str, Any]:
    """The study of the user's dots."""
    dots = own.dots
    progress("finding the dots", 0.1)
    found, counts = detected(dots, own.detector)
    picked = [int(np.isfinite(p[:, :, 0]).sum()) for p in dots.published]
    _check(own, found, counts, picked)
    page = StudyPage(
        "dots",
        "Your dots at known places",
        "How far from their known places are the dots found, by cameras that are calibrated without them?",
        out,
        inputs={"folder": own.name, "picture": "{1} x {0} px".format(*dots.pictures[0].shape),
                "dots found of those picked, left": f"{counts[0]} of {picked[0]}",
                "right": f"{counts[1]} of {picked[1]}", "columns that both see": len(dots.common)},
        seed=SEED,
    )  # fmt: skip
    results = {}
    for k, model in enumerate(MODELS):
        progress(f"dots: lens model {model}", 0.2 + 0.2 * k)
        results[model] = leave_one_column_out(dots, found, model)
    page.numbers = {
        "leave_one_column_out": {m: {"rms_m": r.rms, "spacing_sd_m": r.spacing_sd, "n": len(r.errors)}
                                 for m, r in results.items()},
        "dots_found": counts, "dots_picked": picked,
    }  # fmt: skip
    _claims(page, results)
    _sections(page, results)
    return page.finish()


def _sections(page: StudyPage, results: Mapping[str, LeftOut]) -> None:
    """Show the errors of a column that took no part, by lens model, and what limits them."""
    rows = tuple(
        (m, *(f"{x * MM:.3f}" for x in (r.rms, np.linalg.norm(r.errors, axis=1).max(), r.spacing_sd)))
        for m, r in results.items()
    )
    page.section(
        "A column that took no part",
        f"Each camera is calibrated on all columns that it sees but one, and measures that one: "
        f"{len(results['k1k2'].errors)} dots, 3-D. Spacing: of neighbours, about the known one.",
        figures=[("errors", _figure(results["k1k2"]), "Error of every dot (k1 k2) by column.")],
        tables=[Table(("lens model", "rms (mm)", "largest (mm)", "spacing (mm)"), rows, numbers=(1, 2, 3))],
    )
    page.limits += [
        "What the known places are off is in these errors too.",
        "One pair of pictures calibrates and is measured: this holds while focus and lens stay as they were.",
    ]


def _check(own: OwnDots, found: tuple[Array, Array], counts: tuple[int, int], picked: list[int]) -> None:
    """Enough dots in enough columns, or an ``InputError`` that says what is missing."""
    common = own.dots.common
    if len(common) < FEWEST_COLUMNS:
        raise InputError(
            f"both cameras see {len(common)} columns",
            where=f"{own.name}/picks.csv",
            remedy=f"pick dots of {FEWEST_COLUMNS} or more in both pictures",
        )
    for side, pixels, columns, n, wanted in zip(SIDES, found, own.dots.columns, counts, picked, strict=True):
        most = max(int(np.isfinite(pixels[list(columns).index(j), :, 0]).sum()) for j in common)
        if n - most < FEWEST_DOTS:
            raise InputError(
                f"{n} of {wanted} picked dots are found in the {side} picture, {n - most} without the fullest column",
                where=f"{own.name}/picks.csv",
                remedy=f"{FEWEST_DOTS} are needed: pick to within 5 px (from 0), or name size and polarity in "
                "detector.yaml",
            )
    both = [np.isfinite(found[s][[list(own.dots.columns[s]).index(j) for j in common], :, 0]) for s in range(2)]
    empty = [j + 1 for k, j in enumerate(common) if not (both[0][k] & both[1][k]).any()]
    if empty:
        raise InputError(
            f"no dot of column {empty[0]} is found in both pictures",
            where=f"{own.name}/picks.csv",
            remedy="pick its dots to within 5 px (from 0), or delete them in one picture",
        )


def _claims(page: StudyPage, results: dict[str, LeftOut]) -> None:
    """Show whether the lens needs its distortion, by the same dots with and without.

    Resampled by columns, as the dots of a column share their calibration.
    """
    none, k1k2 = ((r.errors**2).sum(axis=1) for r in (results["none"], results["k1k2"]))
    columns = results["k1k2"].columns
    sums = np.array([[s[columns == j].sum() for j in np.unique(columns)] for s in (none, k1k2)])
    rng = np.random.default_rng(SEED)
    drawn = sums[:, rng.integers(0, sums.shape[1], (N_DRAWS, sums.shape[1]))].sum(axis=2)
    low, high = np.quantile(np.sqrt(drawn[0] / drawn[1]), [0.025, 0.975])
    ratio = results["none"].rms / results["k1k2"].rms
    page.numbers["rms_without_over_with_distortion"] = {"ratio": ratio, "interval_95": (low, high)}
    page.claim(
        "These lenses need a distortion model",
        "",
        f"{results['none'].rms * MM:.3f} mm without, {results['k1k2'].rms * MM:.3f} mm with k1 k2: "
        f"{ratio:.2f} times as much ({low:.2f} to {high:.2f})",
        HOLDS if low > 1.0 else FAILS if high < 1.0 else OPEN,
        f"95 % over {sums.shape[1]} columns, none of which calibrated the cameras that measured it.",
    )


def _figure(result: LeftOut) -> Any:
    fig, axis = figure()
    axis.plot(result.columns + 1, np.linalg.norm(result.errors, axis=1) * MM, "o", color=COLOURS[0], alpha=0.6)
    axis.set(xlabel="column", ylabel="distance from the known place (mm)", ylim=(0, None))
    axis.xaxis.get_major_locator().set_params(integer=True)
    return fig
