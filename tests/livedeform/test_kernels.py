"""What the installation compiles."""

from __future__ import annotations

from livedeform.kernels import compile_kernels


def test_the_shipped_phantom_goes_through_every_kernel() -> None:
    compile_kernels()  # raises where the shipped experiment, its pictures or its poses no longer do
