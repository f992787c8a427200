"""One self-contained HTML page: templates, style, script and charts in a single file that needs no network."""

from __future__ import annotations

import base64
import gzip
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from markupsafe import Markup

import livedeform
from livedeform.outputs import write_text

if TYPE_CHECKING:
    import plotly.graph_objects as go

# nothing is fetched, sent, or made a program of while the page is shown
POLICY = Markup(
    "<meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; script-src 'unsafe-inline'; "
    "style-src 'unsafe-inline'; img-src data: blob:; font-src data:; base-uri 'none'; form-action 'none'\">"
)


LARGE = 50_000  # characters of a figure, from which on it is packed


def packed(text: str) -> Markup:
    """Return a text as base64 of gzip, which the page's script unpacks: plotly is 4.8 MB, and 2.0 MB so."""
    return Markup(base64.b64encode(gzip.compress(text.encode(), 9, mtime=0)).decode())


def without_repeats(figure: str) -> str:
    """Return a figure's JSON with "@n" for an array of numbers that is the n-th different one once more, which the
    page's script puts back: the triangles of one surface in several states. gzip looks back 32 kB only."""
    known: dict[str, int] = {}

    def short(found: re.Match[str]) -> str:
        if found[1] in known:
            return f'"bdata":"@{known[found[1]]}"'
        known[found[1]] = len(known)
        return found[0]

    return re.sub(r'"bdata":"([^"]*)"', short, figure)


@cache
def _packed_plotly() -> Markup:
    from plotly.offline import get_plotlyjs

    return packed(get_plotlyjs())


@dataclass(frozen=True)
class Tile:
    """One number of the page's first row."""

    name: str
    value: str
    unit: str = ""
    aside: str = ""


@dataclass(frozen=True)
class Table:
    """A table of text; ``numbers`` are the columns set flush right, ``chosen`` the rows in bold."""

    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    numbers: tuple[int, ...] = ()
    chosen: tuple[int, ...] = ()


@dataclass(frozen=True)
class Verdict:
    """Hold what is said first. ``tone`` (good, warn, bad, neutral) never speaks by colour alone: see ``mark``."""

    tone: str
    said: str
    because: str

    @property
    def mark(self) -> str:
        return {"good": "✓", "warn": "!", "bad": "✕"}.get(self.tone, "–")


@dataclass(frozen=True)
class Chart:
    """An interactive figure and the id of its place on the page."""

    id: str
    figure: go.Figure
    caption: str
    tall: bool = False

    @cached_property
    def json(self) -> Markup:
        """The figure as JSON that cannot end its script element."""
        return Markup(self.figure.to_json().replace("<", "\\u003c"))

    @property
    def element(self) -> Markup:
        """The script element that holds the figure's data, packed where they are large."""
        kind, text = "application/json", self.json
        if len(text) > LARGE:
            kind, text = "application/gzip", packed(without_repeats(text))
        return Markup('<script type="{}" id="{}-data">{}</script>').format(kind, self.id, text)


@dataclass(frozen=True)
class PageSection:
    """A card of a page: prose, pictures of a study (data URIs), tables."""

    title: str
    text: tuple[str, ...] = ()
    figures: tuple[tuple[str, str], ...] = ()  # (data URI, caption)
    tables: tuple[Table, ...] = field(default=())


@cache
def _environment() -> Environment:
    return Environment(
        loader=PackageLoader("livedeform.report", "templates"),
        autoescape=select_autoescape(["html", "j2"]),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def write_page(
    path: Path, template: str, *, title: str, kind: str, charts: Sequence[Chart] = (), **context: Any
) -> Path:
    """Render ``template`` to ``path``; every chart in ``charts`` is inlined, with plotly itself if there is any."""
    html = (
        _environment()
        .get_template(template)
        .render(
            title=title,
            kind=kind,
            policy=POLICY,
            version=livedeform.__version__,
            made=datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
            charts=charts,
            plotly=_packed_plotly() if charts else "",
            **context,
        )
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, html)
    return path
