"""What the installation compiles."""

from __future__ import annotations

import importlib
import subprocess
import sys
from pathlib import Path
from typing import Any

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


KERNEL = "@njit(cache=True)\n"
INTRINSIC = """
from numba import types
from numba.extending import intrinsic

@intrinsic
def inner(context, x):
    def generate(context, builder, signature, args):
        return builder.fmul(args[0], context.get_constant(types.float64, 2.0))
    return types.float64(types.float64), generate
"""
TAKEN = {  # what a kernel takes from the file ``taken``, in which 2.0 becomes 3.0, and how it does
    "a kernel by a helper below": (
        f"{KERNEL}def inner(x):\n    return 2.0 * x\n",
        f"from taken import inner\n{KERNEL}def outer(x):\n    return helper(x)\n"
        f"{KERNEL}def helper(x):\n    return inner(x)\n",
    ),
    "a kernel by its module": (
        f"{KERNEL}def inner(x):\n    return 2.0 * x\n",
        f"import taken\n{KERNEL}def outer(x):\n    return taken.inner(x)\n",
    ),
    "a number within a kernel that is not kept": (
        '@njit(inline="always")\ndef inner(x):\n    return 2.0 * x\n',
        f"from taken import inner\n{KERNEL}def outer(x):\n    return inner(x)\n",
    ),
    "a number in an array": (
        "import numpy as np\nTABLE = np.array([1.0, 2.0])\n",
        f"from taken import TABLE\n{KERNEL}def outer(x):\n    return TABLE[1] * x\n",
    ),
    "a number of a module": (
        "SCALE = 2.0\n",
        f"import taken\n{KERNEL}def outer(x):\n    return taken.SCALE * x\n",
    ),
    "an instruction of its own": (INTRINSIC, f"from taken import inner\n{KERNEL}def outer(x):\n    return inner(x)\n"),
}


@pytest.mark.parametrize("what", TAKEN)
def test_whatever_a_kernel_takes_from_another_file_is_part_of_what_it_is_kept_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # which goes by whole seconds
    taken, outer = TAKEN[what]

    def loaded() -> Any:
        for name in ("taken", "takes"):
            sys.modules.pop(name, None)
        importlib.invalidate_caches()
        return importlib.import_module("takes").outer

    (tmp_path / "taken.py").write_text(NJIT + taken)
    (tmp_path / "takes.py").write_text(NJIT + outer)
    assert loaded()(1.0) == 2.0
    again = loaded()
    assert again(1.0) == 2.0 and sum(again.stats.cache_hits.values()) == 1  # nothing has changed
    (tmp_path / "taken.py").write_text(NJIT + taken.replace("2.0", "3.0"))
    assert loaded()(1.0) == 3.0
