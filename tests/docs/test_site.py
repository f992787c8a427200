"""The site of the documentation: it builds without a warning, quoted messages exist, generated pages are whole."""

from __future__ import annotations

import importlib.util
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"


def source_text() -> str:
    """All sources, strings that are continued on the next line joined, numbers in them left out."""
    text = "\n".join(p.read_text() for p in sorted((ROOT / "src").rglob("*.py")))
    return re.sub(r'"\s*\n\s*f?"', "", text)


def test_messages_of_troubleshooting_are_messages_of_the_program() -> None:
    page = (DOCS / "troubleshooting.md").read_text()
    quoted = re.findall(r"^\| `([^`]+)` \|", page.split("## By message")[1], re.M)
    assert len(quoted) > 25
    assert quoted == sorted(quoted)
    known = source_text()
    assert [message for message in quoted if message not in known] == []


def test_the_method_is_short() -> None:
    page = (DOCS / "method.md").read_text()
    assert len(re.findall(r"!\[", page)) == 4
    assert len(page.split()) <= 900  # measured 807


def test_every_page_is_on_the_site() -> None:
    named = set(re.findall(r": ([\w/-]+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.M))
    pages = {str(path.relative_to(DOCS)) for path in DOCS.rglob("*.md")}
    assert pages <= named, f"not in mkdocs.yml: {pages - named}"
    assert {name for name in named - pages if not name.startswith("reference/")} == {"contributing.md", "changelog.md"}


def test_the_reference_names_every_command_key_topic_and_stable_name() -> None:
    sys.path.insert(0, str(DOCS))
    try:
        import make_reference as reference
    finally:
        sys.path.remove(str(DOCS))
    pages = reference.pages()
    for command in ("livedeform new", "livedeform study cuboid", "livedeform compare"):
        assert f" {command}\n" in pages["cli"]
    for key in ("youngs_modulus", "element_size", "edge_radius", "clock_start_ns"):
        assert f"`{key}`" in pages["keys"]
    assert "`/stereo/markers`" in pages["topics"]
    assert "## PhantomModel" in pages["python"]


def test_the_shipped_schema_is_the_schema_and_describes_every_key() -> None:
    from livedeform.common.experiment.yaml_file import json_schema

    schema = json_schema()
    assert json.loads((DOCS / "experiment.schema.json").read_text()) == schema, (
        "run: livedeform schema > docs/experiment.schema.json"
    )
    for name, section in {"experiment": schema, **schema["$defs"]}.items():
        for key, entry in section.get("properties", {}).items():
            assert entry.get("description"), f"{name}.{key} has no description"
            assert "\n" not in entry["description"]


def test_the_schema_takes_the_shipped_experiments() -> None:
    jsonschema = pytest.importorskip("jsonschema")
    schema = json.loads((DOCS / "experiment.schema.json").read_text())
    for file in sorted((ROOT / "bags").glob("*/experiment/experiment.yaml")):
        jsonschema.validate(yaml.safe_load(file.read_text()), schema)


@pytest.mark.skipif(importlib.util.find_spec("mkdocs") is None, reason="mkdocs is not installed: make docs")
def test_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path / "site")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    pages = list((tmp_path / "site").rglob("*.html"))
    assert len(pages) > 30
    for page in pages:  # nothing is fetched when it is read
        assert not re.search(
            r'(?:src|href)="https?://(?!github\.com|squidfunk)[^"]*\.(?:js|css|woff2?)"', page.read_text()
        )
