"""How often intervals hold a take that was left out: of runs of takes, with the scatter of the others.

    python -m benchmarks.next_take RUN RUN ...

Each take is left out once. Its rmse, mean and 95th percentile are looked for in two intervals: that of another take's
mean (the bootstrap over that recording's own frames), and that of the next take, from the takes that are left of its
press and how the takes of the other presses differ, relative to their error.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path

from livedeform.compare_node.takes import NUMBERS, expected
from livedeform.comparing.takes import Take, groups, read_take


def main(paths: Sequence[Path]) -> None:
    """Print a line for each take and the count of what held."""
    within = {path.name: json.loads((path / "metrics.json").read_text())["interval_95"] for path in paths}
    presses = groups(read_take(path, path.name) for path in paths)
    of_mean = of_next = n = stated = 0
    for k, press in enumerate(presses):
        for take in press:
            others = [t for t in press if t is not take]
            for key in NUMBERS:
                value = take.numbers[key]
                held = [in_interval(value, within[t.name][key]) for t in others]
                left = [[t.numbers[key] for t in g] for g in (*presses[:k], others, *presses[k + 1 :])]
                span = expected(left)[k].next
                stated, of_mean, of_next, n = (
                    stated + len(held),
                    of_mean + sum(held),
                    of_next + in_interval(value, span),
                    n + 1,
                )
                print(f"{take.name} {key}: {1e3 * value:.3f} mm; next take {1e3 * span[0]:.3f} to {1e3 * span[1]:.3f}; "
                      + "; ".join(mean_of(t, within[t.name][key]) for t in others))  # fmt: skip
    print(f"held: {of_next} of {n} in the interval of the next take, {of_mean} of {stated} in another take's own")


def in_interval(value: float, span: Sequence[float | None]) -> bool:
    """Return whether the value is in the interval, which a recording may have none of."""
    low, high = span
    return low is not None and high is not None and low <= value <= high


def mean_of(take: Take, span: Sequence[float | None]) -> str:
    """Write another take's own interval."""
    low, high = (1e3 * v if v is not None else float("nan") for v in span)
    return f"{take.name}'s own {low:.3f} to {high:.3f}"


if __name__ == "__main__":
    main([Path(p) for p in sys.argv[1:]])
