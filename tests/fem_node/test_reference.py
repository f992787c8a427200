"""The gelatin cuboid under its weight against FEniCSx with hexahedra (numbers and method: docs of the benchmark)."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from fem_reference import mesh_of, shortening

# model, base, E Pa, nu, shortening of the top's centre m; measured error of p2p0 on the graded mesh
CASES = [
    ("neo_hookean", "bonded", 2896.0, 0.49, 0.006845),  # -0.14 %
    ("neo_hookean", "bonded", 2896.0, 0.499, 0.006825),  # -0.17 %
    ("neo_hookean", "sliding", 2896.0, 0.499, 0.007520),  # +0.05 %
    ("neo_hookean", "sliding", 1599.0, 0.49, 0.012278),  # +0.02 %
    ("neo_hookean_log", "bonded", 2896.0, 0.49, 0.006862),  # -0.22 %
    ("linear", "sliding", 1599.0, 0.45, 0.015607),  # +0.10 %
    ("neo_hookean", "bonded", 1599.0, 0.49, 0.01155),  # +0.04 %
]


@pytest.fixture(scope="module")
def graded():
    return mesh_of(None, "p2p0")


@pytest.mark.parametrize(("model", "base", "E", "nu", "expected"), CASES)
def test_the_cuboid_is_within_half_a_percent_on_a_live_mesh(graded, model, base, E, nu, expected):
    assert graded.n_dof < 5000  # a quarter of the body
    found, _ = shortening(model, E, nu, base, graded)
    assert abs(found / expected - 1) < 0.005
