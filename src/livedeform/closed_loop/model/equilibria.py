"""Check that the loop's quick solutions are the equilibria that the graph finds.

The loop tries each key moment at once, from the nearest one that it knows (`fem_node.simulator.SETTINGS`). Under a
probe that is sharp for its elements that may end in another equilibrium than the recorded poses lead to: in balance,
verified, and off by millimetres. Which of them is meant such elements cannot say.
"""

from __future__ import annotations

from collections.abc import Sequence

from livedeform.closed_loop.evidence.observation import Observation
from livedeform.closed_loop.model.fem_model import Body


def doubtful(body: Body, observations: Sequence[Observation]) -> tuple[str, ...]:
    """Say of which recordings the deepest moment has more than one answer, or none along the recorded poses, a line
    each."""
    said = [(o.name, body.astray(o, int(o.deepest(1)[-1]))) for o in observations]
    return tuple(
        f"{name}: on these elements the deepest moment has more than one answer ({apart}): use elements as small as "
        "the radius of the probe's edges"
        for name, apart in said
        if apart
    )
