"""The row of a recording: what the table shows of it, from ``metrics.json`` and ``diagnosis.json``."""

from __future__ import annotations

import json
from collections.abc import Mapping
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

import livedeform
from livedeform.closed_loop.assessment.verdict import rivals_of
from livedeform.closed_loop.candidates import all_effects
from livedeform.common.effect import significant
from livedeform.common.types import Array

LABELS = ("recording", "phantom", "rig", "key")  # of the table, not of the job: a recording may be renamed
_TEXT, _NUMBER, _COUNT = pa.string(), pa.float64(), pa.int64()
MEASURED = pa.schema(
    [
        ("status", _TEXT),  # done, failed
        ("problem", _TEXT),
        ("started_ns", _COUNT),
        ("duration_s", _NUMBER),
        ("run_verdict", _TEXT),
        ("frames_compared", _COUNT),
        ("frames_measured", _COUNT),
        ("coverage", _NUMBER),
        ("rmse_m", _NUMBER),
        ("noise_floor_m", _NUMBER),
        ("mesh", _TEXT),
        ("verdict", _TEXT),
        ("error_before_m", _NUMBER),
        ("error_after_m", _NUMBER),
        ("improvement_low", _NUMBER),
        ("improvement_high", _NUMBER),
        ("effects", _TEXT),  # in words: value and 95 % interval
        ("effects_json", _TEXT),
        ("rivals", _TEXT),
        ("unexplained", _TEXT),
        ("version", _TEXT),
    ]
)
SCHEMA = pa.schema([*((name, _TEXT) for name in LABELS), *MEASURED])
INTERVAL = 1.96  # sigmas of 95 %


def row_of(metrics: Mapping[str, Any] | None, diagnosis: Mapping[str, Any] | None, times: tuple[int, int]) -> Row:
    """Put the row together; ``times``: the recording's first and last stamp in ns. What was not done is None."""
    out: Row = dict.fromkeys(MEASURED.names)
    out |= {"status": "done", "version": livedeform.__version__}
    out |= {"started_ns": times[0], "duration_s": (times[1] - times[0]) * 1e-9}
    if metrics is not None:
        out |= _of_run(metrics)
    if diagnosis is not None:
        out |= _of_diagnosis(diagnosis)
    return out


def failed_row(problem: str) -> Row:
    """Give the row of a recording whose job failed."""
    return {**dict.fromkeys(MEASURED.names), "status": "failed", "problem": problem}


def write_row(row: Row, path: Path) -> None:
    """Write one row, whole or not at all."""
    draft = path.with_name(f".{path.name}")
    pq.write_table(pa.Table.from_pylist([row], MEASURED), draft, compression="zstd", store_schema=False)
    draft.replace(path)


def read_row(path: Path) -> Row:
    """Read the row of a job that is done."""
    with pq.ParquetFile(path) as file:
        return dict(file.read().to_pylist()[0])


Row = dict[str, Any]


def _of_run(metrics: Mapping[str, Any]) -> Row:
    error, coverage = metrics["error"], metrics.get("coverage") or {}
    compared, measured = coverage.get("frames_compared"), coverage.get("frames_measured")
    return {
        "run_verdict": metrics["verdict"],
        "frames_compared": compared,
        "frames_measured": measured,
        "coverage": compared / measured if measured else None,
        "rmse_m": error["rmse"],
        "noise_floor_m": metrics["noise_floor"],
        "mesh": (metrics.get("mesh") or {}).get("digest"),
    }


def _of_diagnosis(diagnosis: Mapping[str, Any]) -> Row:
    effects = diagnosis["effects"]
    alike = {c["name"]: c["indistinguishable_from"] for c in diagnosis["candidates"]}
    low, high = diagnosis["improvement_interval"]
    rivals = rivals_of([e["name"] for e in effects], alike)
    return {
        "verdict": diagnosis["verdict"],
        "error_before_m": diagnosis["error_before"]["rmse"],
        "error_after_m": diagnosis["error_after"]["rmse"],
        "improvement_low": low,
        "improvement_high": high,
        "effects": "; ".join(map(effect_words, effects)),
        "effects_json": json.dumps(effects, sort_keys=True),
        "rivals": ", ".join(dict.fromkeys(chain.from_iterable(rivals.values()))),
        "unexplained": diagnosis["unexplained"],
    }


def effect_words(effect: Mapping[str, Any]) -> str:
    """Say an effect with its values and 95 % intervals, and what is declared of it."""
    said = []
    for name, parameter in effect["parameters"].items():
        values = np.atleast_1d(parameter["value"]).ravel()
        ends = _ends(parameter, values)
        before = " ".join(f"{v:.3g}" for v in np.ravel(parameter["declared"])) if "declared" in parameter else ""
        told = " ".join(interval_words(v, *e) for v, e in zip(values, ends, strict=True))
        told += unit_words(effect["name"], name)
        said.append(f"{name} {told}" + (f" (declared {before})" if before else ""))
    return f"{effect['name']}: {', '.join(said)}"


def unit_words(effect: str, parameter: str) -> str:
    """Return the unit of an effect's parameter as it stands behind its value; empty where it has none."""
    units = {p.name: p.unit for p in all_effects()[effect].parameters} if effect in all_effects() else {}
    unit = units.get(parameter, "")
    return "" if unit in ("", "-", "1") else f" {unit}"


def _ends(parameter: Mapping[str, Any], values: Array) -> Array:
    """Return the ends (n, 2) of a parameter's intervals as the diagnosis states them, infinite where there is none; by
    its sigma where there is only that, and NaN where nothing is stated."""
    if "interval" in parameter:
        ends = np.array(parameter["interval"], float).reshape(-1, 2)  # None is NaN
        return np.where(np.isnan(ends), [-np.inf, np.inf], ends)
    sigmas = np.atleast_1d(parameter.get("sigma", np.full(len(values), np.nan))).ravel()
    return values[:, None] + INTERVAL * sigmas[:, None] * [-1.0, 1.0]


def interval_words(value: float, low: float, high: float) -> str:
    """Say a value and its interval (NaN: none), with so many digits that the interval's width has two."""
    if np.isnan(low) or np.isnan(high):
        return f"{value:.3g}"
    digits = significant(max(abs(low), abs(high)), high - low, 3)
    value, low, high = value + 0.0, low + 0.0, high + 0.0  # no minus before a zero
    return f"{value:.{digits}g} [{low:.{digits}g}, {high:.{digits}g}]"
