"""One self-contained HTML page: templates, style, script and charts in a single file that needs no network."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache
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

    @property
    def json(self) -> Markup:
        """The figure as JSON that cannot end its script element."""
        return Markup(self.figure.to_json().replace("</", "<\\/"))


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
    from plotly.offline import get_plotlyjs

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
            plotly_js=Markup(get_plotlyjs()) if charts else "",
            **context,
        )
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, html)
    return path
