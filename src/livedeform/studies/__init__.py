"""The studies: the thesis repeated with honest errors, and public measurements. One row of ``STUDIES`` each.

A study is ``run(out: Path, data: Path | None, progress) -> dict``: it writes ``study.json``, its figures and
``index.html`` into ``out`` and returns the content of ``study.json``.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

Study = Callable[..., dict[str, Any]]


def _in(module: str) -> Study:
    """Return the study of a module, imported when it is run: ``livedeform --help`` must not wait for matplotlib."""

    def run(out: Path, data: Path | None, progress: Callable[[str, float | None], None], **own: Any) -> dict[str, Any]:
        study: Study = importlib.import_module(f"livedeform.studies.{module}").run
        return study(out, data, progress, **own)

    return run


STUDIES: dict[str, Study] = {
    **{name: _in(f"thesis.{name}") for name in ("stereo", "height", "cuboid", "stacked", "gravity", "probe")},
    **{name: _in(f"public.{name}") for name in ("beam", "dots", "compression")},
}
