"""Stereo calibration from files or a bag, its files and its page."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast, get_args

import numpy as np

import livedeform
from livedeform.common.errors import CalibrationError
from livedeform.importing.board_pictures import Pictures, Say
from livedeform.report.page import Table
from livedeform.stereo_node.boards.boards import Board, Kind
from livedeform.stereo_node.boards.charuco import understood
from livedeform.stereo_node.boards.find_pairs import find_pairs
from livedeform.stereo_node.calibrate.calibrate import Calibration, calibrate
from livedeform.stereo_node.calibrate.known_lengths import Length
from livedeform.stereo_node.camera.calibration_file import write_camera
from livedeform.stereo_node.camera.scale import ScaleCheck, check_calibration
from livedeform.studies.study import FAILS, HOLDS, PARTLY, StudyPage, figure, plain

FILES = ("left.yaml", "right.yaml", "calibration.json", "study.json", "index.html", "lengths.svg", "lengths.png")
MM = 1e3
ENOUGH = 10  # lengths, for their scatter


def parse_board(
    text: str, square: float, kind: str = "checkerboard", marker: float = 0.0, dictionary: str = "DICT_4X4_50",
    option: str = "--square",
) -> Board:  # fmt: skip
    """A board from the command line's words."""
    match = re.fullmatch(r"(\d+)[xX](\d+)", text.strip())
    if match is None:
        raise CalibrationError(f"'{text}' is not columns x rows", where="--board", remedy="write it as 9x6")
    if kind not in get_args(Kind):
        raise CalibrationError(
            f"unknown board '{kind}'", where="--kind", remedy=f"use one of {', '.join(get_args(Kind))}"
        )
    return Board(cast(Kind, kind), int(match[1]), int(match[2]), square, marker, dictionary, option)


def run_calibration(
    pictures: Pictures, board: Board, out: Path, say: Say, check: tuple[Pictures, Board] | None = None
) -> list[str]:
    """Calibrates, writes ``left.yaml``, ``right.yaml``, ``calibration.json`` and the page; returns lines to tell.

    ``check``: pictures of another board, whose size was measured independently.
    """
    told: list[str] = []
    board = understood(board, [p for _, *both in pictures for p in both], told.append)
    pairs = find_pairs(pictures, board, say)
    size = pictures[0][1].shape[1], pictures[0][1].shape[0]
    if check is not None:
        _check_is_independent(pictures, check[0], size)
    if check is not None:
        check = check[0], understood(check[1], [p for _, *both in check[0] for p in both], told.append)
    others = None if check is None else find_pairs(check[0], check[1], say, least=1)
    result = calibrate(pairs, board, size, say)
    scale = None
    if check is not None and others is not None:
        scale = check_calibration(result.bundle, size, others, check[1])
    out.mkdir(parents=True, exist_ok=True)
    write_camera(result.rig.left, out / "left.yaml")
    write_camera(result.rig.right, out / "right.yaml")
    document = summary(result, scale)
    (out / "calibration.json").write_text(json.dumps(plain(document), indent=1) + "\n")
    _page(result, scale, document, out)
    return [*told, *_lines(result, scale, out)]


def _check_is_independent(pictures: Pictures, others: Pictures, size: tuple[int, int]) -> None:
    if others[0][1].shape[::-1] != size:
        found = "x".join(str(n) for n in others[0][1].shape[::-1])
        raise CalibrationError(
            f"its pictures are {found}, those of the calibration {size[0]}x{size[1]}",
            where="--check-left",
            remedy="take them with the same cameras at the same size",
        )
    if any(np.array_equal(a, b) for _, a, _ in others for _, b, _ in pictures):
        raise CalibrationError(
            "the pictures of the check are those of the calibration",
            where="--check-left",
            remedy="take pictures of another board, or of a length that was measured by itself",
        )


def length_table(lengths: Sequence[Length]) -> list[dict[str, float]]:
    """Errors of known lengths by number of squares, m: mean, sd, worst, predicted sd, and how many 95 % intervals
    hold.
    """
    rows = []
    for n in sorted({x.n_squares for x in lengths}):
        chosen = [x for x in lengths if x.n_squares == n]
        error = np.array([x.error for x in chosen])
        own = np.array([x.measured - x.printed for x in chosen])
        sigma = np.array([x.sigma for x in chosen])
        rows.append(
            {
                "n_squares": n,
                "count": len(chosen),
                "true": float(np.mean([x.true for x in chosen])),
                "mean": float(error.mean()),
                "sd": float(error.std(ddof=1)) if len(error) > 1 else float("nan"),
                "worst": float(np.abs(error).max()),
                "sd_against_print": float(own.std(ddof=1)) if len(own) > 1 else float("nan"),
                "predicted": float(np.sqrt((sigma**2).mean())),
                "covered": float((np.abs(own) < 1.96 * sigma).mean()),
            }
        )
    return rows


def _longest(rows: Sequence[dict[str, float]]) -> dict[str, float]:
    """Return the row of the longest lengths of which there are enough for a scatter; of all where none has."""
    return [row for row in rows if row["count"] >= ENOUGH or row is rows[0]][-1]


def summary(c: Calibration, scale: ScaleCheck | None) -> dict[str, Any]:
    """Return what ``calibration.json`` holds; SI units, px where named so."""
    return {
        "version": 1,
        "livedeform": livedeform.__version__,
        "board": {"kind": c.board.kind, "columns": c.board.columns, "rows": c.board.rows, "square": c.board.square},
        "parameters": {n: {"value": v, "sigma": s} for n, (v, s) in c.parameters.items()},
        "distortion_model": c.bundle.model,
        "lens_model": c.lens_model,
        "board_shape_released": c.bundle.released,
        "board_shape_rms": float(np.sqrt((c.bundle.shape**2).sum(axis=1).mean())),
        "reprojection_rms_px": c.reprojection_rms_px,
        "corner_sigma_px": c.bundle.sigma_px,
        "held_out_epipolar_rms_px": c.epipolar_rms_px,
        "used": c.used,
        "outliers": [{"picture": n, "reprojection_rms_px": r} for n, r in c.outliers],
        "models": [vars(m) for m in c.models],
        "coverage": vars(c.coverage) | {"warnings": c.coverage.warnings},
        "corners_beyond": c.n_beyond,
        "known_lengths": length_table([x for x in c.lengths if not x.outlier]),
        "known_lengths_with_outliers": length_table(c.lengths),
        "scale_check": None if scale is None else vars(scale),
        "rig_covariance": {"names": c.bundle.names, "matrix": c.bundle.covariance},
    }


def _lines(c: Calibration, scale: ScaleCheck | None, out: Path) -> list[str]:
    baseline, sigma = c.parameters["baseline"]
    rows = length_table([x for x in c.lengths if not x.outlier])
    lines = [
        f"baseline {baseline * MM:.3f} +- {1.96 * sigma * MM:.3f} mm (95 %), lens model "
        f"{c.lens_model}, {len(c.used)} pairs",
        f"reprojection {c.reprojection_rms_px:.3f} px rms; epipolar error of pictures that "
        f"were not used {c.epipolar_rms_px:.3f} px rms",
    ]
    for row in (rows[0], _longest(rows)):
        lines.append(
            f"known lengths of {row['true'] * MM:.1f} mm on pictures that were not used: mean "
            f"error {row['mean'] * MM:+.3f} mm, "
            f"sd {row['sd'] * MM:.3f} mm, worst {row['worst'] * MM:.2f} mm (n = {row['count']})"
        )
    if c.n_beyond:
        lines.append(
            f"{c.n_beyond} corners lie where the other pictures do not tell the lens to a pixel: nothing is measured "
            f"there"
        )
    lines += [f"outlier picture {name} ({rms:.3f} px rms) was left out" for name, rms in c.outliers]
    lines += [f"warning: {text}" for text in c.coverage.warnings]
    if scale is not None:
        lines.append(scale.sentence)
    else:
        lines.append(
            "the scale rests on --square alone; check it with --check-left, --check-right, "
            "--check-board, --check-square"
        )
    return [*lines, f"wrote {out / 'left.yaml'}, {out / 'right.yaml'} and {out / 'index.html'}"]


def _page(c: Calibration, scale: ScaleCheck | None, document: dict[str, Any], out: Path) -> None:
    page = StudyPage(
        "calibrate",
        "Stereo calibration",
        "How well does this pair of cameras measure, and what limits it?",
        out,
        inputs={
            "board": f"{c.board.columns}x{c.board.rows} {c.board.kind}, {c.board.square * MM:g} mm",
            "pairs": len(c.used),
        },
    )
    rows = document["known_lengths"]
    longest = _longest(rows)
    covered = float(np.mean([r["covered"] for r in rows]))
    page.claim(
        "lengths on unused pictures are unbiased",
        "0",
        f"{longest['mean'] * MM:+.3f} mm on {longest['true'] * MM:.0f} mm",
        HOLDS if abs(longest["mean"]) < 2 * longest["predicted"] else FAILS,
    )
    page.claim("95 % intervals of lengths hold", "95 %", f"{covered:.0%}", HOLDS if covered > 0.9 else PARTLY)
    _model_sections(page, c)
    page.section(
        "Known lengths on pictures that were not used",
        figures=[("lengths", _length_figure(rows), "Measured minus true length.")],
        tables=[length_rows(rows)],
    )
    notes = [f"{n}: {r:.3f} px rms, left out" for n, r in c.outliers] + list(c.coverage.warnings)
    page.section("Pictures", notes or ["No outlier pictures, and the field is covered."])
    if scale is not None:
        page.section("Scale", scale.sentence)
    page.numbers = document
    page.finish()


def _model_sections(page: StudyPage, c: Calibration) -> None:
    """Show the parameters, and the lens models on unused pictures."""
    page.section(
        "Parameters",
        tables=[
            Table(
                ("parameter", "value", "95 % interval +-"),
                tuple((n, f"{v:.6g}", f"{1.96 * s:.2g}") for n, (v, s) in c.parameters.items()),
                (1, 2),
            )
        ],
    )
    page.section(
        "Lens models on pictures that were not used",
        tables=[
            Table(
                ("model", "board", "rms px", "standard error px2"),
                tuple(
                    (
                        m.model,
                        "own shape" if m.released else "as declared",
                        f"{np.sqrt(m.mean_square_px):.4f}",
                        f"{m.standard_error:.5f}",
                    )
                    for m in c.models
                ),
                (2, 3),
                tuple(i for i, m in enumerate(c.models) if (m.model, m.released) == (c.lens_model, c.bundle.released)),
            )
        ],
    )


def length_rows(rows: Sequence[dict[str, float]]) -> Table:
    """A table of ``length_table``."""
    header = (
        "squares",
        "length mm",
        "n",
        "mean error mm",
        "sd mm",
        "sd against print mm",
        "predicted sd mm",
        "95 % intervals that hold",
    )
    cells = tuple(
        (
            f"{r['n_squares']:.0f}",
            f"{r['true'] * MM:.1f}",
            f"{r['count']:.0f}",
            f"{r['mean'] * MM:+.3f}",
            f"{r['sd'] * MM:.3f}",
            f"{r['sd_against_print'] * MM:.3f}",
            f"{r['predicted'] * MM:.3f}",
            f"{r['covered']:.0%}",
        )
        for r in rows
    )
    return Table(header, cells, tuple(range(8)))


def _length_figure(rows: Sequence[dict[str, float]]) -> Any:
    fig, axis = figure()
    x = [r["true"] * MM for r in rows]
    axis.errorbar(
        x, [r["mean"] * MM for r in rows], yerr=[r["sd"] * MM for r in rows], fmt="o", capsize=3, label="mean and sd"
    )
    axis.fill_between(
        x,
        [-1.96 * r["predicted"] * MM for r in rows],
        [1.96 * r["predicted"] * MM for r in rows],
        alpha=0.15,
        label="predicted 95 %",
    )
    axis.set_xlabel("true length (mm)")
    axis.set_ylabel("error (mm)")
    axis.legend()
    return fig
