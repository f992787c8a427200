"""Hooks of the documentation's site (mkdocs): pages that are made from the code, and links out of ``docs``.

Reference pages (commands, keys, topics, Python) are generated whenever the site is built, so they cannot go stale.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[1]
OUTSIDE = {"CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}  # pages that lie beside docs


def on_files(files: Files, config: Any) -> Files:
    """Add the generated pages and those that lie beside ``docs``."""
    sys.path[:0] = [str(ROOT / "src"), str(ROOT / "docs")]  # here, since mkdocs puts the path back after loading hooks
    import make_reference as reference

    pages = {f"reference/{name}.md": text for name, text in reference.pages().items()}
    for source, target in OUTSIDE.items():
        text = re.sub(r"\]\(docs/", "](", (ROOT / source).read_text())
        pages[target] = re.sub(r"\]\((\w+\.md)", lambda link: f"]({OUTSIDE.get(link[1], link[1])}", text)
    for path, text in pages.items():
        files.append(File.generated(config, path, content=text))
    known = {file.src_uri for file in files}
    for path in sorted((ROOT / "docs" / "evidence").glob("*.md")):
        assert f"evidence/{path.name}" in known, f"{path} is not on the site"
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Turn links out of ``docs`` into links on the site, or, to what is no page, into plain names."""

    def turned(match: re.Match[str]) -> str:
        text, target, anchor = match.groups()
        path = (ROOT / "docs" / page.file.src_uri).parent / target
        name = path.resolve()
        if not name.is_relative_to(ROOT) or name.is_relative_to(ROOT / "docs") or target.startswith("http"):
            return match.group(0)
        if name.name in OUTSIDE:
            up = "../" * page.file.src_uri.count("/")
            return f"[{text}]({up}{OUTSIDE[name.name]}{anchor or ''})"
        if not name.exists():
            raise FileNotFoundError(f"{page.file.src_uri}: {target} is not there")
        return f"{text} (`{name.relative_to(ROOT)}`)"

    return re.sub(r"(?<!!)\[([^\]]+)\]\(((?:\.\./)+[^)#\s]*)(#[^)]*)?\)", turned, markdown)
