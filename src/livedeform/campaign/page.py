"""The page of a campaign: one file that opens offline, its table in columns that the browser shows a window of."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from math import floor, isfinite
from pathlib import Path
from typing import Any

from markupsafe import Markup

from livedeform.campaign.row import Row
from livedeform.report.page import Tile, write_page
from livedeform.report.text import EARLIEST_NS

PAGE = "index.html"
# name in the row, heading, kind: text, mm (from m), percent, time
COLUMNS = (
    ("recording", "recording", "text"),
    ("phantom", "phantom", "text"),
    ("rig", "rig", "text"),
    ("status", "status", "text"),
    ("run_verdict", "run", "text"),
    ("verdict", "diagnosis", "text"),
    ("coverage", "coverage, %", "percent"),
    ("rmse_m", "rmse, mm", "mm"),
    ("error_before_m", "before, mm", "mm"),
    ("error_after_m", "after, mm", "mm"),
    ("noise_floor_m", "noise, mm", "mm"),
    ("effects", "effects, with 95 % intervals", "text"),
    ("rivals", "not told from", "text"),
    ("problem", "problem", "text"),
    ("started_ns", "started", "time"),
)
VERDICTS = {"effect": "effect named", "none": "no effect", "undecided": "undecided", "unexplained": "unexplained"}
SCALE = {"mm": 1e3, "time": 1e-9}
DIGITS = {"mm": 6, "time": 3}  # more than are shown: nothing is rounded twice


def write_campaign_page(
    rows: Iterable[Row],
    shared: Sequence[Mapping[str, Any]],
    out: Path,
    title: str,
    *,
    left_out: Mapping[str, str] | None = None,
) -> Path:
    """Write ``out/index.html``; ``shared``: the causes that recordings have in common, in words, and why recordings are
    ``left_out`` of that fit."""
    cells: list[str] = []
    count: Counter[str] = Counter()
    for row in rows:
        count[row["status"]] += 1
        count[f"verdict {row['verdict']}"] += 1
        cells.append(json.dumps(_cells(row), ensure_ascii=False, separators=(",", ":")))
    head = json.dumps([{"name": name, "heading": heading, "kind": kind} for name, heading, kind in COLUMNS])
    earliest = EARLIEST_NS * SCALE["time"]
    data = f'{{"columns":{head},"earliest":{earliest:g},"rows":[{",".join(cells)}]}}'.replace(
        "<", "\\u003c"
    )  # no text is markup
    return write_page(
        out / PAGE,
        "campaign.html.j2",
        title=title,
        kind="campaign",
        tiles=_tiles(count, len(cells)),
        shared=shared,
        left_out=left_out or {},
        data=Markup(data),
    )


def _cells(row: Row) -> list[Any]:
    """The row's cells in the order of `COLUMNS`, and last the links to its reports."""
    cells: list[Any] = [_cell(row[name], kind) for name, _, kind in COLUMNS]
    if row["status"] != "done":
        return [*cells, row["key"], 0]
    return [*cells, row["key"], (row["run_verdict"] is not None) + 2 * (row["verdict"] is not None)]


def _cell(value: Any, kind: str) -> Any:
    if value is None or kind == "text":
        return value or ""
    if not isfinite(value):  # JSON has no such number
        return ""
    if kind == "percent":  # 100 is all of it: what is shown is rounded down
        return floor(value * 1e3 + 1e-9) / 10
    return round(value * SCALE[kind], DIGITS[kind]) + 0.0  # no minus before a zero


def _tiles(count: Counter[str], n: int) -> list[Tile]:
    """The numbers of the first row."""
    tiles = [Tile("recordings", str(n)), Tile("done", str(count["done"])), Tile("failed", str(count["failed"]))]
    return [*tiles, *(Tile(said, str(c)) for name, said in VERDICTS.items() if (c := count[f"verdict {name}"]))]
