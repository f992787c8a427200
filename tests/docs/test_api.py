"""The declared public API: what docs/api.md names is there and documented, and the version has one source."""

from __future__ import annotations

import ast
import importlib
import inspect
import re
import subprocess
import tomllib
from pathlib import Path
from xml.etree import ElementTree

import pytest
import yaml

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "api.md").read_text()
NAMES = sorted(set(re.findall(r"`(livedeform(?:\.\w+)+\.\w+)`", PAGE)))


def documented(value: object) -> bool:
    """Whether it says what it is; data, aliases of types and modules need no docstring of their own."""
    return not (inspect.isclass(value) or inspect.isroutine(value)) or bool((value.__doc__ or "").strip())


@pytest.mark.parametrize("dotted", NAMES)
def test_every_stable_name_is_there_with_a_docstring(dotted: str) -> None:
    module, name = dotted.rsplit(".", 1)
    assert documented(getattr(importlib.import_module(module), name))


def test_examples_use_stable_names_only() -> None:
    for path in sorted((ROOT / "examples").glob("[0-9]*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("livedeform"):
                used = {f"{node.module}.{a.name}" for a in node.names if not a.name.isupper()}
                assert used <= set(NAMES), f"{path.name}: {used - set(NAMES)} are not in docs/api.md"


def test_what_modules_export_is_documented() -> None:
    for path in sorted((ROOT / "src" / "livedeform").rglob("*.py")):
        if "\n__all__ = " in path.read_text():
            module = importlib.import_module(dotted_name(path))
            for exported in module.__all__:
                assert documented(getattr(module, exported)), f"{module.__name__}.{exported} has no docstring"


def dotted_name(path: Path) -> str:
    """The module of a file."""
    return ".".join(path.relative_to(ROOT / "src").with_suffix("").parts).removesuffix(".__init__")


def test_the_version_has_one_number() -> None:
    """The tag's, where there is one; package.xml, the citation and the fallback without a tag say the same."""
    fallback = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools_scm"]["fallback_version"]
    assert ElementTree.parse(ROOT / "package.xml").findtext("version") == fallback
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text()).get("version", fallback) == fallback
    command = ["git", "describe", "--tags", "--abbrev=0", "--match", "v*"]
    tag = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert tag.returncode != 0 or tag.stdout.strip() == f"v{fallback}"
