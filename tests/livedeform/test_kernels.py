"""What the installation compiles."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from livedeform.kernels import compile_kernels

NJIT = "from livedeform.common.compiled import njit\n"


def test_the_shipped_phantom_goes_through_every_kernel() -> None:
    compile_kernels()  # raises where the shipped experiment, its pictures or its poses no longer do


@pytest.mark.parametrize(
    ("before", "after"), [("SCALE = 2.0", "SCALE = 5.0"), pytest.param("x + 1.0", "x + 4.0", marks=pytest.mark.slow)]
)
def test_a_kernel_is_compiled_again_where_another_file_changes(tmp_path: Path, before: str, after: str) -> None:
    """The kept one went on with the number and the kernel of before, whatever was installed since."""
    inner = NJIT + "SCALE = 2.0\n\n@njit(cache=True)\ndef inner(x):\n    return x + 1.0\n"
    middle = NJIT + "from inner import SCALE, inner\n\n@njit(cache=True)\ndef middle(x):\n    return SCALE * inner(x)\n"
    outer = NJIT + "from middle import middle\n\n@njit(cache=True)\ndef outer(x):\n    return middle(x)\n"
    for name, text in (("inner", inner), ("middle", middle), ("outer", outer)):
        (tmp_path / f"{name}.py").write_text(text)

    def found() -> float:
        command = [sys.executable, "-c", "from outer import outer; print(outer(1.0))"]
        return float(subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True).stdout)

    assert found() == 4.0
    (tmp_path / "inner.py").write_text(inner.replace(before, after))
    assert found() == {"SCALE = 5.0": 10.0, "x + 4.0": 10.0}[after]
