"""What one diagnosis of a shipped experiment costs, by unknowns, key moments and candidates: user CPU and wall seconds.

    python -m benchmarks.loop_scaling [--vertices 200,420,800] [--moments 10,20,30] [--candidates 5,21] [--cuboid]

Each row is a whole diagnosis, start and kernels included, without the report. One of the three is changed at a time,
the others stay as the settings have them; the exponents are those of a line through the logarithms. Wall seconds are
those of a quiet machine only if it is one.
"""

from __future__ import annotations

import argparse
import os
import resource
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from livedeform.closed_loop.candidates import all_effects
from livedeform.closed_loop.inputs import read_inputs
from livedeform.closed_loop.loop import diagnose
from livedeform.closed_loop.settings import Settings
from livedeform.shipped import BREAST, CUBOID, shipped


def cpu_seconds() -> float:
    """Return the user CPU seconds of this process and of the children that have ended."""
    return sum(resource.getrusage(who).ru_utime for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))


def settings_of(vertices: int | None = None, moments: int | None = None) -> Settings:
    """Return the settings with another mesh of the search, or another number of moments of a fitted recording and two
    thirds as many of a held-out one."""
    settings = Settings()
    sampling = settings.sampling
    if vertices is not None:
        sampling = replace(sampling, mesh_vertices=vertices)
    if moments is not None:
        sampling = replace(sampling, moments_fit=moments, moments_test=max(2, 2 * moments // 3))
    return replace(settings, sampling=sampling)


def measured(folder: Path, settings: Settings, candidates: Sequence[str] | None) -> tuple[float, float, str]:
    """Diagnose once; return user CPU and wall seconds, and what was found. The mesh is made before."""
    experiment, bags = folder / "experiment", sorted((folder / "bags").iterdir())
    cpu, wall = cpu_seconds(), time.perf_counter()
    with tempfile.TemporaryDirectory() as out:
        found = diagnose(experiment, bags[:1], bags[1:], Path(out), candidates=candidates, settings=settings)
    name = ", ".join(e.name for e in found.effects) or found.verdict
    return cpu_seconds() - cpu, time.perf_counter() - wall, name


def unknowns(folder: Path, settings: Settings) -> int:
    """Return the unknowns of the search's mesh; makes it, so that no diagnosis pays for it."""
    bags = sorted((folder / "bags").iterdir())
    forward = read_inputs(folder / "experiment", bags[:1], bags[1:], settings=settings).forward
    assert forward is not None
    return forward.body.unknowns


def table(title: str, folder: Path, rows: Sequence[tuple[float, Settings, Sequence[str] | None]]) -> None:
    """Print a row for each size, and the exponents."""
    print(f"{title:>12} {'user CPU s':>11} {'wall s':>8}  found")
    sizes, costs = [], []
    for size, settings, candidates in rows:
        cpu, wall, name = measured(folder, settings, candidates)
        sizes.append(size)
        costs.append(cpu)
        print(f"{size:12.0f} {cpu:11.1f} {wall:8.1f}  {name}", flush=True)
    if len(set(sizes)) > 1:
        print(f"user CPU grows as {title}^{np.polyfit(np.log(sizes), np.log(costs), 1)[0]:.2f}", flush=True)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the tables that are asked for, all by default."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for name, given in (("vertices", "200,420,800"), ("moments", "10,20,30"), ("candidates", "5,21")):
        parser.add_argument(f"--{name}", default=given, help="separated by commas; none: leave the table out")
    parser.add_argument("--cuboid", action="store_true", help="the shipped cuboid instead of the phantom")
    asked = parser.parse_args(arguments)
    folder = shipped(CUBOID if asked.cuboid else BREAST)
    print(f"{folder.name}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    vertices, moments, candidates = (
        [int(n) for n in text.split(",") if n] for text in (asked.vertices, asked.moments, asked.candidates)
    )
    if vertices:
        sizes = [settings_of(vertices=n) for n in vertices]
        table("unknowns", folder, [(unknowns(folder, s), s, None) for s in sizes])
    if moments:
        table("moments", folder, [(n, settings_of(moments=n), None) for n in moments])
    if candidates:
        names = [str(n) for n in all_effects()]
        unknowns(folder, Settings())
        table("candidates", folder, [(n, Settings(), names[:n]) for n in candidates])


if __name__ == "__main__":
    main()
