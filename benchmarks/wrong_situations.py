"""Wrong situations, and what the tool says of each: refused, warned, or silently wrong (goal: none).

python -m benchmarks.wrong_situations            experiments, recordings, pairs of recordings
python -m benchmarks.wrong_situations --graph    also through the graph (a minute)
"""

from __future__ import annotations

import sys
import tempfile
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "trust"))

import situations  # the tests' own


def main() -> int:
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        names = [*situations.EXPERIMENTS, *situations.RECORDINGS]
        for number, name in enumerate(names):
            rows.append((name, *situations.judged(name, _new(folder, number))))
        for number, name in enumerate(situations.PAIRS, len(names)):
            rows.append((name, *situations.judged_pair(_new(folder, number), name)))
        if "--graph" in sys.argv:
            for number, name in enumerate(situations.RECORDINGS, len(rows)):
                rows.append((f"graph: {name}", *situations.judged_run(name, _new(folder, number))))
        for name, word, text in rows:
            print(f"{name:45} {word:15} {text.replace(folder, '')[:150]}")
    counts = Counter(word for _, word, _ in rows)
    print(f"{len(rows)} situations: " + ", ".join(f"{n} {word}" for word, n in sorted(counts.items())))
    return int(counts["silently wrong"] > 0)


def _new(folder: str, number: int) -> Path:
    path = Path(folder) / str(number)
    path.mkdir()
    return path


if __name__ == "__main__":
    sys.exit(main())
