"""The table of places in CONTRIBUTING.md names files and names that are there, and that a search finds."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
ROWS = re.findall(r"^\| ([^|]+) \| `([^`|]+\.py)` \| `(\w+)` \|$", (ROOT / "CONTRIBUTING.md").read_text(), re.M)


def test_the_table_is_read():
    assert len(ROWS) >= 20


@pytest.mark.parametrize(("what", "file", "name"), ROWS, ids=[row[0] for row in ROWS])
def test_what_is_looked_for_is_there(what: str, file: str, name: str):
    text = (ROOT / "src" / "livedeform" / file).read_text()
    assert re.search(rf"^(class|def) {name}\b|^{name}\b.* = ", text, re.M), f"{file} has no {name} ({what})"


# a word that somebody would search for, and the file that must be among few hits
SEARCHED = {
    r"accept": "closed_loop/settings.py",
    r"[Cc]ovarian\w+ .*triangulat|triangulat\w+ .*covarian": "stereo_node/camera/triangulate.py",
    r"symmetric tangent": "fem_node/contact/law.py",
    r"[Vv]erdict.*sentence|sentence.*verdict": "closed_loop/assessment/verdict.py",
    r"frame_id=": "common/ros/messages.py",
}


@pytest.mark.parametrize(("pattern", "file"), SEARCHED.items())
def test_a_search_for_the_word_finds_it(pattern: str, file: str):
    src = ROOT / "src" / "livedeform"
    room = file.split("/")[0]
    hits = [str(p.relative_to(src)) for p in sorted((src / room).rglob("*.py")) if re.search(pattern, p.read_text())]
    assert file in hits and len(hits) <= 4, hits


def test_the_method_of_the_loop_is_a_page():
    assert len((ROOT / "docs" / "loop.md").read_text().split()) <= 900  # measured 898
