"""Read the data that a report's page embeds, as a browser would draw it."""

from __future__ import annotations

import base64
import gzip
import json
import re
from typing import Any

import numpy as np

from livedeform.common.types import Array


def figures(html: str) -> dict[str, dict[str, Any]]:
    """Each interactive chart as plotly takes it, by its id in the order of the page; large ones are unpacked."""
    found = re.findall(r'<script type="application/(json|gzip)" id="([\w-]+)-data">(.*?)</script>', html, re.S)
    return {name: json.loads(unpacked(text) if kind == "gzip" else text) for kind, name, text in found}


def unpacked(text: str) -> str:
    """What a page holds as base64 of gzip."""
    return gzip.decompress(base64.b64decode(text)).decode()


def charts(html: str) -> dict[str, list[dict[str, Any]]]:
    """Traces of each interactive chart, by the chart's id."""
    return {name: figure["data"] for name, figure in figures(html).items()}


def numbers(value: Any) -> Array:
    """An array of a trace, plain or packed."""
    if isinstance(value, dict):
        flat = np.frombuffer(base64.b64decode(value["bdata"]), np.dtype(value["dtype"]))
        shape = [int(n) for n in str(value.get("shape", len(flat))).split(",")]
        return flat.reshape(shape).astype(float)
    return np.array(value, float)


def pooled(values: Array, weights: Array) -> float:
    """Root mean square of values (n,), each counting by its weight (n,)."""
    return float(np.sqrt((weights * values**2).sum() / weights.sum()))


def tiles(html: str) -> dict[str, str]:
    """The value of each tile without its unit, by the tile's name."""
    found = re.findall(r'<div class="name">(.*?)</div>\s*<div class="value">(.*?)(?: <small>.*?)?</div>', html, re.S)
    return {name: value.strip() for name, value in found}


def said(html: str) -> tuple[str, str, str]:
    """Tone, headline and what stands behind it."""
    pattern = r'class="card verdict (\w+)">.*?<div class="said">(.*?)</div><p class="muted">(.*?)</p>'
    tone, headline, because = re.search(pattern, html, re.S).groups()  # type: ignore[union-attr]
    return tone, headline, because
