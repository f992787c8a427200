"""Check that the loop's quick solutions are the equilibria that the graph finds.

The loop tries each key moment at once, from the nearest one that it knows (`fem_node.simulator.SETTINGS`). Under a
probe that is sharp for its elements that may end in another equilibrium than the recorded poses lead to: in balance,
verified, and off by millimetres. Which of them is meant such elements cannot say. Of a probe that rubs the path
decides, and it is simulated; but where its edges are far sharper than the elements, small things do: how often it is
looked at, or how the body happens to lie in the frame.
"""

from __future__ import annotations

from collections.abc import Sequence

from livedeform.closed_loop.evidence.observation import Observation
from livedeform.closed_loop.model.fem_model import Body

REMEDY = "use elements as small as the radius of the probe's edges"


def doubtful(body: Body, observations: Sequence[Observation]) -> tuple[str, ...]:
    """Say of which recordings the deepest moment has more than one answer, or none along the recorded poses, a line
    each; and once that there may be more, where the probe rubs and only another path would tell."""
    said = [(o.name, body.astray(o, int(o.deepest(1)[-1]))) for o in observations]
    lines = [
        f"{name}: on these elements the deepest moment has more than one answer ({apart}): {REMEDY}"
        for name, apart in said
        if apart
    ]
    rubs = dict.fromkeys(body.rubs_on_sharp_edges(o) for o in observations)
    lines += [f"on these elements a press may have more than one answer ({sharp}): {REMEDY}" for sharp in rubs if sharp]
    return tuple(lines)
