"""Everything that studies have in common: claims with verdicts, figures of print quality, ``study.json`` and a page."""

from __future__ import annotations

import base64
import json
import os
import platform
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import livedeform
from livedeform.common.errors import InputError, LivedeformError
from livedeform.report.page import PageSection, Table, write_page

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Progress = Callable[[str, float | None], None]

HOLDS, PARTLY, FAILS, OPEN = "holds", "partly", "does not hold", "not decided by the data"
TONE = {HOLDS: "good", PARTLY: "warn", FAILS: "bad", OPEN: "neutral"}

# Okabe and Ito (2008): told apart by colour-blind readers, in this order
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#E69F00", "#CC79A7", "#56B4E9", "#000000")
STYLE: Any = {
    "font.family": "sans-serif",
    "font.size": 9,
    "axes.labelsize": 9,
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.8,
    "axes.grid": True,
    "grid.color": "#e3e6e9",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "lines.linewidth": 1.6,
    "lines.markersize": 4.5,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "figure.constrained_layout.use": True,
    "savefig.dpi": 220,
    "svg.fonttype": "none",
    "svg.hashsalt": "livedeform",
}


@dataclass(frozen=True)
class Claim:
    """A claim of the thesis (or of the data's authors), what they found, what we find, and whether it holds."""

    claim: str
    theirs: str
    ours: str
    verdict: str
    why: str = ""


class IncompleteStudyError(LivedeformError):
    """A part of a study failed; its page and ``study.json``, the ``document``, are written with what did not."""

    def __init__(self, name: str, failed: Mapping[str, Exception], document: dict[str, Any]) -> None:
        self.document, self.__cause__ = document, next(iter(failed.values()))
        reasons = "; ".join(f"{part}: {reason(error)}" for part, error in failed.items())
        super().__init__(
            f"not everything could be done ({reasons})", where=f"study {name}", remedy="its page has the rest"
        )


def reason(error: Exception) -> str:
    """Say why a part failed: an expected error in its own words, another with its type."""
    return (
        str(error) if isinstance(error, LivedeformError) else f"a fault of livedeform, {type(error).__name__}: {error}"
    )


@dataclass
class StudyPage:
    """A study while it is made; ``finish`` writes it. ``numbers`` are SI unless their name says another unit."""

    name: str
    title: str
    question: str
    out: Path
    inputs: dict[str, Any] = field(default_factory=dict)
    seed: int | None = None
    claims: list[Claim] = field(default_factory=list)
    numbers: dict[str, Any] = field(default_factory=dict)
    limits: list[str] = field(default_factory=list)
    failed: dict[str, Exception] = field(default_factory=dict, init=False)
    _sections: list[PageSection] = field(default_factory=list, init=False)
    _figures: list[str] = field(default_factory=list, init=False)
    _started: float = field(default_factory=time.monotonic, init=False)

    def __post_init__(self) -> None:
        self.out.mkdir(parents=True, exist_ok=True)

    def claim(self, claim: str, theirs: str, ours: str, verdict: str, why: str = "") -> None:
        """Add a row to the front table; ``verdict`` is one of HOLDS, PARTLY, FAILS, OPEN."""
        if verdict not in TONE:
            raise ValueError(f"unknown verdict '{verdict}'")
        self.claims.append(Claim(claim, theirs, ours, verdict, why))

    def failure(self, part: str, error: Exception) -> None:
        """Say that a ``part`` was not done, and why: the other parts are kept, and `finish` raises at its end."""
        self.failed[part] = error
        self.claim(f"{part}: could not be done", "", reason(error), OPEN)

    def section(
        self,
        title: str,
        text: str | Sequence[str] = (),
        figures: Sequence[tuple[str, Figure, str]] = (),
        tables: Sequence[Table] = (),
    ) -> None:
        """Add a card: paragraphs, figures (file name without suffix, figure, caption; saved as SVG and PNG), tables."""
        import matplotlib.pyplot as plt

        shown = []
        for name, figure, caption in figures:
            for suffix in ("svg", "png"):
                metadata = {"Date": None} if suffix == "svg" else None
                figure.savefig(self.out / f"{name}.{suffix}", metadata=metadata, bbox_inches="tight", pad_inches=0.04)
            plt.close(figure)
            self._figures.append(f"{name}.png")
            encoded = base64.b64encode((self.out / f"{name}.png").read_bytes()).decode()
            shown.append((f"data:image/png;base64,{encoded}", caption))
        paragraphs = (text,) if isinstance(text, str) else tuple(text)
        self._sections.append(PageSection(title, paragraphs, tuple(shown), tuple(tables)))

    def finish(self) -> dict[str, Any]:
        """Write ``study.json`` and ``index.html`` into the study's folder; returns what ``study.json`` holds.

        Raises IncompleteStudyError, once both are written, where a part failed.
        """
        document = {
            "version": 1,
            "name": self.name,
            "title": self.title,
            "question": self.question,
            "claims": [asdict(c) for c in self.claims],
            "numbers": plain(self.numbers),
            "limits": self.limits,
            "failed": {part: reason(error) for part, error in self.failed.items()},
            "figures": self._figures,
            "inputs": plain(self.inputs),
            "seed": self.seed,
            "seconds": round(time.monotonic() - self._started, 1),
            "livedeform": livedeform.__version__,
            "python": platform.python_version(),
        }
        (self.out / "study.json").write_text(json.dumps(document, indent=1, ensure_ascii=False) + "\n")
        seed = "none is drawn" if self.seed is None else str(self.seed)
        facts = ("inputs", _inline(self.inputs)), ("seed", seed), ("time", f"{document['seconds']} s")
        write_page(
            self.out / "index.html",
            "study.html.j2",
            title=self.title,
            kind=f"study {self.name}",
            question=self.question,
            claims=[(c, TONE[c.verdict]) for c in self.claims],
            sections=self._sections,
            limits=self.limits,
            facts=Table(("what", "value"), facts),
        )
        if self.failed:
            raise IncompleteStudyError(self.name, self.failed, document)
        return document


def figure(
    width: float = 6.4, height: float = 3.2, columns: int = 1, rows: int = 1, **options: Any
) -> tuple[Figure, Any]:
    """A matplotlib figure in the studies' style (sizes in inches) and its axes, an array if there are several."""
    import matplotlib

    if not os.environ.get("MPLBACKEND"):
        matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from cycler import cycler

    plt.rcParams.update(STYLE)
    plt.rcParams["axes.prop_cycle"] = cycler(color=COLOURS)
    return plt.subplots(rows, columns, figsize=(width, height), **options)


def plain(value: Any) -> Any:
    """``value`` with numpy scalars and arrays, paths and tuples turned into what JSON can hold; NaN becomes null."""
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float):
        return value if np.isfinite(value) else None
    if isinstance(value, Path):
        return value.name
    return value


def need_data(data: Path | None, folder: str, home: str) -> Path:
    """The folder of a public data set; ``InputError`` that says where to get it if it is not there."""
    root = data or (Path(os.environ["LIVEDEFORM_DATA"]) if os.environ.get("LIVEDEFORM_DATA") else None)
    if root is not None:
        for path in (root / folder, root):
            if path.is_dir() and (path.name == folder or path != root):
                return path
    raise InputError(
        f"this study needs the public data set '{folder}'",
        where=str(root) if root else "--data",
        remedy=f"get it from {home} and name its parent folder with --data or LIVEDEFORM_DATA",
    )


def _inline(values: Mapping[str, Any]) -> str:
    return "; ".join(f"{k}: {v}" for k, v in plain(values).items())
