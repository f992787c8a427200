"""The blind test from the command line.

    python -m benchmarks.blind run --out DIR [--set small|medium|large|dome|foreign|random|redeclared]
        [--truth own|felupe] [--jobs N] [--limit N] [--only PART] [--half even|odd] [--sizes]
    python -m benchmarks.blind table --out DIR [--set ...]

``run`` goes on where it was stopped; ``table`` prints what is there. ``--sizes`` also measures how large the effects
are over the noise.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from benchmarks.blind.cases import SETS as OWN_SETS
from benchmarks.blind.foreign_cases import foreign
from benchmarks.blind.random_cases import randomised
from benchmarks.blind.redeclared_cases import redeclared
from benchmarks.blind.run import TRUTHS, run_all
from benchmarks.blind.table import score, table, unmade

SETS = {**OWN_SETS, "foreign": foreign, "random": randomised, "redeclared": redeclared}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run or print the wanted cases; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="benchmarks.blind", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=["run", "table"])
    parser.add_argument("--out", type=Path, default=Path("out/blind"))
    parser.add_argument("--set", choices=list(SETS), default="large")
    parser.add_argument("--truth", choices=list(TRUTHS), default=None, help="default: felupe of the foreign set")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--limit", type=int, default=None, help="only so many cases")
    parser.add_argument("--only", default="", help="only cases whose name contains this")
    parser.add_argument("--half", choices=["even", "odd"], default=None, help="only cases with such a seed")
    parser.add_argument("--sizes", action="store_true", help="measure how large the effects are over the noise")
    parser.add_argument("--keep", action="store_true", help="keep experiments and reports")
    options = parser.parse_args(arguments)
    halves = {"even": (0,), "odd": (1,)}.get(options.half, (0, 1))
    cases = [c for c in SETS[options.set]() if options.only in c.name and c.seed % 2 in halves][: options.limit]
    options.out.mkdir(parents=True, exist_ok=True)
    if options.what == "run":
        truth = options.truth or ("felupe" if options.set == "foreign" else "own")
        run_all(cases, options.out, options.jobs, options.keep, truth, options.sizes)
    scores = [s for s in (score(c, options.out) for c in cases) if s is not None]
    reasons = {c.name: unmade(c, options.out) for c in cases}
    print("\n".join(table(scores, {name: reason for name, reason in reasons.items() if reason is not None})))
    return 0


if __name__ == "__main__":
    sys.exit(main())
