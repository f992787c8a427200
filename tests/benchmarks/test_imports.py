"""Benchmarks are run rarely: what they import from the package must be there all the same."""

from __future__ import annotations

import ast
import importlib
from pathlib import Path

import pytest

FILES = sorted(Path(__file__).parents[2].glob("benchmarks/**/*.py"))


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.stem)
def test_what_a_benchmark_imports_is_there(path: Path) -> None:
    for node in ast.walk(ast.parse(path.read_text())):
        if not isinstance(node, ast.ImportFrom) or not (node.module or "").startswith(("livedeform", "benchmarks")):
            continue
        module = importlib.import_module(str(node.module))
        for alias in node.names:
            if not hasattr(module, alias.name):
                importlib.import_module(f"{node.module}.{alias.name}")
