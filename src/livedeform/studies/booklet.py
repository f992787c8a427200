"""All studies in one booklet: a front table of claims, and a page for each study."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from livedeform.common.errors import InputError
from livedeform.report.page import Table, write_page
from livedeform.studies import STUDIES
from livedeform.studies.study import TONE, Claim, IncompleteStudyError, Progress, reason


@dataclass(frozen=True)
class Chapter:
    """A study of the booklet: its ``study.json``, or why there is none."""

    name: str
    document: dict[str, Any]
    missing: str = ""

    @property
    def title(self) -> str:
        return str(self.document.get("title", self.name))

    @property
    def claims(self) -> list[tuple[Claim, str]]:
        rows = [Claim(**row) for row in self.document.get("claims", [])]
        return [(claim, TONE[claim.verdict]) for claim in rows]


def make_booklet(out: Path, data: Path | None, progress: Progress) -> dict[str, Any]:
    """Run every study into ``out/<name>`` and write the front page and ``study.json``; a study whose data is absent is
    named with the reason, and what failed otherwise is in ``failed`` as well."""
    started = time.monotonic()
    chapters: list[Chapter] = []
    failed: dict[str, str] = {}
    for number, (name, run) in enumerate(STUDIES.items()):
        progress(f"study {name}", number / len(STUDIES))
        try:
            chapters.append(Chapter(name, run(out / name, data, progress)))
        except IncompleteStudyError as error:
            chapters.append(Chapter(name, error.document))
            failed[name] = str(error)
        except InputError as error:
            chapters.append(Chapter(name, {}, str(error)))
        except OSError:  # a full disk is nothing that the others would be spared
            raise
        except Exception as error:  # a fault in one study takes nothing from the others
            chapters.append(Chapter(name, {}, reason(error)))
            failed[name] = reason(error)
        if chapters[-1].missing:
            progress(f"study {name} is left out: {chapters[-1].missing}", None)
    document = {
        "version": 1,
        "name": "all",
        "studies": {c.name: c.document or {"missing": c.missing} for c in chapters},
        "failed": failed,
        "seconds": round(time.monotonic() - started, 1),
    }
    out.mkdir(parents=True, exist_ok=True)
    (out / "study.json").write_text(json.dumps(document, indent=1, ensure_ascii=False) + "\n")
    rows = tuple(
        (c.name, f"{c.document['seconds']:.0f}" if c.document else "–", c.missing or c.title) for c in chapters
    )
    write_page(
        out / "index.html",
        "booklet.html.j2",
        title="The thesis, redone with honest errors",
        kind="booklet of studies",
        chapters=chapters,
        n_claims=sum(len(c.claims) for c in chapters),
        times=Table(("study", "time (s)", ""), rows, numbers=(1,)),
        seconds=document["seconds"],
    )
    return document
