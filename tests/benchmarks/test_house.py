"""The figures of the layout stay within their targets (`python -m benchmarks.house` prints them)."""

from __future__ import annotations

import pytest

from benchmarks import house

TARGETS = (  # what is counted, the figure's name, and at most how many
    (house.function_lengths, "functions over 40 lines", 15),  # measured 9
    (house.rooms, "files flat in the fullest room", 12),  # 12
    (house.thresholds, "numbers that decide", 45),  # 45
    (house.inline_numbers, "inline numbers in closed_loop", 25),  # 7
    (house.memory, "predicates of memory", 0),  # 0
    (house.knowledge, "modules of fem_node that closed_loop imports", 8),  # 7
    (house.names_used_twice, "class names used twice", 8),  # 8
    (house.fragments, "docstrings that begin with a fragment", 0),  # 0
)


@pytest.fixture(scope="module")
def tree() -> house.Tree:
    return house.Tree(house.SRC)


@pytest.mark.parametrize(("measure", "name", "most"), TARGETS, ids=[name for _, name, _ in TARGETS])
def test_a_figure_is_within_its_target(tree, measure, name, most):
    figure = next(f for f in measure(tree) if f.name == name)
    assert int(figure.value.split()[0]) <= most, figure.counted


def test_the_longest_function_is_within_a_screen(tree):
    figure = house.function_lengths(tree)[0]
    assert int(figure.value.split()[0]) <= 50, figure.counted  # measured 50
