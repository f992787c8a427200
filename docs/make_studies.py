"""Writes the front table of docs/studies.md, and copies the figures, from what ``livedeform study all`` left behind.

livedeform study all --out out/booklet --data DATA
python docs/make_studies.py out/booklet
"""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

HERE = Path(__file__).parent
PAGE = HERE / "studies.md"
BEGIN, END = "<!-- begin of what docs/make_studies.py writes -->", "<!-- end -->"
MAX_BYTES = 400_000  # of a figure that goes into the docs


def cell(text: str) -> str:
    """Text that does not end a table's cell."""
    return text.replace("|", "\\|").replace("\n", " ")


def chapter(folder: Path) -> list[str]:
    """One study: its claims as a table, and its figures."""
    document = json.loads((folder / "study.json").read_text())
    lines = [f"## {document['title']}", "", document["question"], ""]
    lines += ["| claim | theirs | ours | verdict |", "|---|---|---|---|"]
    for c in document["claims"]:
        ours = cell(c["ours"]) + (f" <br> *{cell(c['why'])}*" if c["why"] else "")
        lines.append(f"| {cell(c['claim'])} | {cell(c['theirs'])} | {ours} | **{c['verdict']}** |")
    lines.append("")
    for name in document["figures"]:
        if (folder / name).stat().st_size <= MAX_BYTES:
            target = f"{document['name']}_{name.removeprefix(document['name'] + '_')}"
            shutil.copy(folder / name, HERE / "img" / target)
            lines += [f"![{document['title']}: {Path(name).stem.replace('_', ' ')}](img/{target})", ""]
    lines += [f"- {limit}" for limit in document["limits"]]
    lines += [""] if document["limits"] else []
    lines += [f"`livedeform study {document['name']}`, {document['seconds']:.0f} s.", ""]
    return lines


def times(document: dict) -> list[str]:
    """What each study took, and all of them."""
    lines = ["| study | time, s |", "|---|---|"]
    for name, study in document["studies"].items():
        lines.append(f"| `{name}` | {study['seconds']:.0f} |" if "seconds" in study else f"| `{name}` | not run |")
    return [*lines, f"| all | {document['seconds']:.0f} |", ""]


def main(booklet: Path) -> None:
    """Replaces the part of the page between the two comments."""
    document = json.loads((booklet / "study.json").read_text())
    folders = [booklet / name for name in document["studies"] if (booklet / name / "study.json").exists()]
    written = times(document) + [line for folder in folders for line in chapter(folder)]
    before, rest = PAGE.read_text().split(BEGIN)
    after = rest.split(END)[1]
    PAGE.write_text(before + BEGIN + "\n\n" + "\n".join(written) + "\n" + END + after)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
