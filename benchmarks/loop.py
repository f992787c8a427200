"""How long one diagnosis takes and how often it is right, on synthetic experiments made by the other solver.

    python benchmarks/loop.py FOLDER [FOLDER ...]       # each made by `livedeform synth SCENARIO --out FOLDER`

prints one line per experiment (verdict, first effect, rivals, rmse before and after, noise floor, seconds) and the
table of issue D as far as these experiments fill it. Truth is read here, outside of the loop, and only to count.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from pathlib import Path

from livedeform.closed_loop.loop import diagnose


def main(folders: list[Path]) -> None:
    """One diagnosis per folder, first recording fitted, the others held out."""
    counts = {"experiments": 0, "named": 0, "in a set of 3": 0, "false alarms": 0, "without effect": 0, "wrong": 0}
    seconds = []
    for folder in folders:
        truth = json.loads((folder / "truth" / "truth.json").read_text())
        names = {e["name"] for e in truth["scenario"]["truth"]}
        bags = sorted((folder / "bags").iterdir())
        with tempfile.TemporaryDirectory() as out:
            began = time.perf_counter()
            d = diagnose(folder / "experiment", bags[:1], bags[1:], Path(out))
            seconds.append(time.perf_counter() - began)
        first = d.effects[0].name if d.effects else ""
        rivals = next((r.indistinguishable_from for r in d.ranking if r.name == first), ())
        near = {first, *rivals[:2]} if len(rivals) <= 2 else {first}
        counts["experiments"] += 1
        if names:
            counts["named"] += first in names
            counts["in a set of 3"] += bool(names & near)
            counts["wrong"] += bool(first) and not names & {first, *rivals}
        else:
            counts["without effect"] += 1
            counts["false alarms"] += d.verdict != "none"
        line = f"{folder.name}: truth {sorted(names) or 'none'}; verdict {d.verdict} {first} {list(rivals)}; "
        line += f"rmse {1e3 * d.before.rmse:.3f} -> {1e3 * d.after.rmse:.3f} mm, noise {1e3 * d.floor:.3f} mm; "
        print(line + f"{seconds[-1]:.0f} s", flush=True)
    table = ", ".join(f"{k}: {v}" for k, v in counts.items())
    print(f"{table}; median time {sorted(seconds)[len(seconds) // 2]:.0f} s")


if __name__ == "__main__":
    if len(sys.argv) < 2:
        raise SystemExit(__doc__)
    main([Path(a) for a in sys.argv[1:]])
