"""How many threads and cores may be used, by what the environment says."""

from __future__ import annotations

import subprocess
import sys

import pytest

from livedeform.common.processes import stated_threads, usable_cores


@pytest.mark.parametrize(
    ("said", "threads"), [("3", 3), (" 2 ", 2), ("4,2", 4), ("", None), ("0", None), ("-1", None), ("all", None)]
)
def test_threads_are_what_the_environment_says(said: str, threads: int | None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", said)
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    assert stated_threads("MKL_NUM_THREADS", "OMP_NUM_THREADS") == threads
    assert 1 <= usable_cores() <= (threads or usable_cores())
    monkeypatch.setenv("MKL_NUM_THREADS", "1")
    assert stated_threads("MKL_NUM_THREADS", "OMP_NUM_THREADS") == 1


@pytest.mark.parametrize("said", ["", "2,1", "many"])
def test_the_solver_starts_whatever_the_environment_says(said: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", said)
    monkeypatch.setenv("MKL_NUM_THREADS", said)
    code = "import livedeform.fem_node.solve.linear_solver as s; assert s.DEFAULT_THREADS > 0"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
