"""A model that jumps against the same model that walks: is it ever converged in a wrong state?

    python -m benchmarks.contact_grid --out grid.jsonl [--part tuned|held] [--seed 1] [--bodies N] [--depths 8]
    python -m benchmarks.contact_grid --out grid.jsonl --summary

Each setting is a body, a probe, a place and a tilt, drawn with a seed of its own; the probe goes down its axis. The
reference is the model itself, walked from above at each place in steps of 0.5 and of 0.25 mm; where these two end apart
(by half of what a jump may be off by), the setting has more than one equilibrium by walking and is counted apart. To
each depth: first seen inside, from 1 and 20 mm above, from 2 mm deep, from the far side of the body, sideways by 6 mm
at once (12 missing poses), and slid there in steps of 1 mm.
``converged`` but off by more than 1 % of the force or 0.05 mm is wrong. A run goes on where the file ends.

Numbers were chosen on the part ``tuned``; ``held`` is there to be looked at only, with a new seed for each look.
"""

from __future__ import annotations

import argparse
import itertools
import json
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import beta

from livedeform.common import frames
from livedeform.common.types import Array, Prediction
from livedeform.fem_node.contact.probe_shapes import Box, Cylinder, Shape, Sphere
from livedeform.fem_node.element.element import make_space
from livedeform.fem_node.mesh.structured import block_mesh, cylinder_mesh, hemi_ellipsoid_mesh
from livedeform.fem_node.mesh.tet_mesh import TetMesh
from livedeform.fem_node.model import PhantomModel
from livedeform.fem_node.physics.record import MaterialSpec, Physics, Probe, Support

DOWN = Rotation.from_euler("x", 180, degrees=True).as_matrix()
DEPTHS = (4.0, 8.0, 12.0)  # mm
FORCE, PLACE, LEAST_FORCE = 0.01, 5e-5, 0.005  # of the force, m, N: what a jump may be off by
FINE, FINER = 5e-4, 2.5e-4  # m, the reference's steps
SIDE, SLIDE = 0.006, 1e-3  # m, how far sideways, and the steps of a slide
SLID = "slid in contact"
SEEDS = {"tuned": 0, "held": 1}

BODIES: dict[str, TetMesh] = {
    "block of 108": block_mesh((0.06, 0.06, 0.04), (3, 3, 2)),
    "block of 480": block_mesh((0.06, 0.06, 0.04), (5, 4, 4)),
    "block of 1080": block_mesh((0.06, 0.06, 0.04), (6, 6, 5)),
    "hemisphere": hemi_ellipsoid_mesh((0.045, 0.045, 0.045), 4),
    "cylinder": cylinder_mesh(0.03, 0.04, 3),
}


def probe_of(kind: str, rng: np.random.Generator) -> Shape:
    """A ball, flat cylinder or box of a random size, with rounded edges of 0.8 to 3 mm."""
    edge = float(rng.uniform(0.0008, 0.003))
    if kind == "ball":
        return Sphere(float(rng.uniform(0.006, 0.02)))
    if kind == "cylinder":
        return Cylinder(float(rng.uniform(0.007, 0.015)), 0.03, edge)
    return Box(float(rng.uniform(0.02, 0.05)), float(rng.uniform(0.01, 0.016)), 0.04, edge)


class Setting:
    """One body, probe, place and tilt: number ``k`` of a ``seed``."""

    def __init__(self, seed: int, kind: str, k: int) -> None:
        rng = np.random.default_rng([seed, {"ball": 0, "cylinder": 1, "box": 2}[kind], k])
        self.body = list(BODIES)[k % len(BODIES)]
        self.shape = probe_of(kind, rng)
        mesh = BODIES[self.body]
        self.top = mesh.nodes[:, 2].max()
        x, y = rng.uniform(-0.012, 0.012, 2)
        tilt = rng.uniform(-8.0, 8.0, 2)
        spin = rng.uniform(0.0, 180.0)
        self.R = Rotation.from_euler("xyz", [*tilt, spin], degrees=True).as_matrix() @ DOWN
        physics = Physics(
            MaterialSpec("neo_hookean", 4000.0, 0.49),
            supports=(Support(lambda points: points[:, 2] < 1e-6),),
            probe=Probe(self.shape),
        )
        self.model = PhantomModel(make_space(mesh), physics)
        self.origin = np.array([x, y, self.top])
        rest = self.model.rest().surface
        touch = self._first_touch(rest)
        self.origin = self.origin + touch * self.R[:, 2]
        self.stamp = 0

    def _first_touch(self, surface: Array) -> float:
        """How far down its axis the probe meets the surface's points."""
        low, high = -0.02, 0.05
        for _ in range(30):
            middle = 0.5 * (low + high)
            y = frames.apply(frames.inverse(self._pose(middle)), surface)
            low, high = (middle, high) if self.shape.distance(y).d.min() > 0.0 else (low, middle)
        return low

    def _pose(self, depth: float, side: float = 0.0) -> Array:
        return frames.transform(self.R, self.origin + depth * self.R[:, 2] + side * self.R[:, 0])

    def go(self, depth: float, side: float = 0.0) -> Prediction:
        """The next prediction, a thirtieth of a second later."""
        self.stamp += 33_333_333
        return self.model.predict(frames.matrix_pose(self._pose(depth, side), self.stamp))

    def walk(self, path: list[tuple[float, float]], step: float, *, on: bool = False) -> Prediction:
        """Along straight lines between (depth, side), from a fresh body or ``on`` from where it is."""
        if not on:
            self.model.reset()
        answer = self.go(*path[0])
        for (a, s), (b, t) in itertools.pairwise(path):
            n = int(np.ceil(np.hypot(b - a, t - s) / step - 1e-9))
            for f in np.arange(1, n + 1) / n:
                answer = self.go(a + f * (b - a), s + f * (t - s))
        return answer

    def jumps(self, depth: float) -> Iterator[tuple[str, list[tuple[float, float]], tuple[float, float]]]:
        """Name, where it was seen before (walked to), and where it is seen next."""
        yield "first seen inside", [], (depth, 0.0)
        yield "from 1 mm above", [(-0.001, 0.0)], (depth, 0.0)
        yield "from 20 mm above", [(-0.02, 0.0)], (depth, 0.0)
        if depth > 0.005:
            yield "from 2 mm deep", [(-0.001, 0.0), (0.002, 0.0)], (depth, 0.0)
        yield "from the far side", [(0.15, 0.0)], (depth, 0.0)
        yield "sideways in contact", [(-0.001, 0.0), (depth, 0.0)], (depth, SIDE)
        yield SLID, [(-0.001, 0.0), (depth, 0.0)], (depth, SIDE)


def off(answer: Prediction, reference: Prediction) -> tuple[float, float]:
    """Of the force (relative), and the surface's largest distance, m."""
    there = np.linalg.norm(reference.force)
    force = float(np.linalg.norm(answer.force - reference.force) / max(there, LEAST_FORCE))
    return force, float(np.linalg.norm(answer.surface - reference.surface, axis=1).max())


def same(answer: Prediction, reference: Prediction, share: float = 1.0) -> bool:
    """Whether they agree."""
    force, place = off(answer, reference)
    return force <= share * FORCE and place <= share * PLACE


def cases(setting: Setting, depth: float) -> Iterator[dict[str, Any]]:
    """The results of one setting at one depth."""
    references: dict[float, tuple[Prediction, Prediction]] = {}
    for name, before, (d, side) in setting.jumps(depth):
        if side not in references:
            path = [(-0.001, side), (d, side)]
            references[side] = setting.walk(path, FINE), setting.walk(path, FINER)
        result = {"body": setting.body, "depth": depth, "jump": name}
        yield result | compared(setting, name, before, (d, side), references[side])


def compared(
    setting: Setting,
    name: str,
    before: list[tuple[float, float]],
    end: tuple[float, float],
    references: tuple[Prediction, Prediction],
) -> dict[str, Any]:
    """Jump to ``end`` (or slide there), and compare with both references."""
    setting.model.reset()
    began = time.process_time()
    last = setting.walk(before, FINE) if before else setting.model.rest()
    steps = sum(np.ceil(np.hypot(b - a, t - s) / FINE) for (a, s), (b, t) in itertools.pairwise(before))
    usual = (time.process_time() - began) / max(steps, 1.0)
    began = time.process_time()
    answer = setting.walk([before[-1], end], SLIDE, on=True) if name == SLID else setting.go(*end)
    seconds = time.process_time() - began
    fine, finer = references
    out = {"converged": answer.converged, "seconds": round(seconds, 3), "usual": round(usual, 4)}
    out |= {"solved": fine.converged and finer.converged, "message": answer.message, "began": last.converged}
    if out["solved"]:
        out["unique"] = same(fine, finer, 0.5)
        if answer.converged:
            out["off"] = min(off(answer, fine), off(answer, finer))
            out["right"] = same(answer, fine) or same(answer, finer)
    return out


def bound(k: int, n: int) -> float:
    """The upper end of the one-sided 95 % interval of a share, in per cent (Clopper & Pearson 1934)."""
    return 100.0 * float(beta.ppf(0.95, k + 1, n - k)) if n > k else 100.0


def summary(results: list[dict[str, Any]]) -> None:
    """The table, of each part and of each way to come."""
    for part in ("tuned", "held"):
        some = [r for r in results if r["part"] == part]
        if not some:
            continue
        seeds = ", ".join(sorted({str(r["seed"]) for r in some}))
        print(f"{part} (seed {seeds}): {len({(r['kind'], r['k']) for r in some})} settings")
        print("| | cases | solved by walking | wrong and converged | 95 % below | refused | 95 % below |")
        print("|---|---|---|---|---|---|---|")
        for name in [*dict.fromkeys(r["jump"] for r in some), "all"]:
            row([r for r in some if name in (r["jump"], "all")], name)
        details(some)


def row(some: list[dict[str, Any]], name: str) -> None:
    """One line of the table."""
    solved = [r for r in some if r["solved"] and r["unique"]]
    wrong = [r for r in solved if r["converged"] and not r["right"]]
    refused = [r for r in solved if not r["converged"]]
    n = len(solved)
    print(
        f"| {name} | {len(some)} | {n} | {len(wrong)} | {bound(len(wrong), n):.1f} % "
        f"| {len(refused)} ({100 * len(refused) / max(n, 1):.1f} %) | {bound(len(refused), n):.1f} % |"
    )


def details(some: list[dict[str, Any]]) -> None:
    """Which were wrong, why others were refused, and what that cost."""
    apart = [r for r in some if r["solved"] and not r["unique"]]
    others = sum(r["converged"] and not r["right"] for r in apart)
    print(f"more than one equilibrium by walking: {len(apart)}, of which {others} end in another yet")
    for r in some:
        if r["solved"] and r["unique"] and r["converged"] and not r["right"]:
            print(f"  wrong: {r['kind']} {r['k']} {r['body']}, {1e3 * r['depth']:.0f} mm, {r['jump']}: "
                  f"{100 * r['off'][0]:.1f} % {1e3 * r['off'][1]:.2f} mm")  # fmt: skip
    refused = [r for r in some if r["solved"] and not r["converged"]]
    for text, n in Counter(r["message"][:90] for r in refused).most_common(5):
        print(f"  refused {n}: {text}")
    for word, which in (("refused", refused), ("found", [r for r in some if r["converged"]])):
        steps = [
            r["seconds"] / r["usual"]
            for r in which
            if r["usual"] > 0.0 and r["jump"] not in ("first seen inside", SLID)
        ]
        if steps:
            print(f"  {word}: {np.median(steps):.0f} usual steps in the median, {max(steps):.0f} at most (CPU time)")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--part", choices=tuple(SEEDS), default="held")
    parser.add_argument("--seed", type=int, help="of the settings (default: the part's own)")
    parser.add_argument("--bodies", type=int, default=10)
    parser.add_argument("--depths", type=float, nargs="+", default=DEPTHS, help="mm")
    parser.add_argument("--summary", action="store_true")
    args = parser.parse_args()
    seed = SEEDS[args.part] if args.seed is None else args.seed
    done = [json.loads(line) for line in args.out.read_text().splitlines()] if args.out.exists() else []
    known = {(r["part"], r["seed"], r["kind"], r["k"], r["depth"]) for r in done}
    wanted = itertools.product(range(0 if args.summary else args.bodies), ("ball", "cylinder", "box"), args.depths)
    for k, kind, mm in wanted:
        which = {"part": args.part, "seed": seed, "kind": kind, "k": k}
        if (*which.values(), 1e-3 * mm) in known:
            continue
        results = [which | r for r in cases(Setting(seed, kind, k), 1e-3 * mm)]
        with args.out.open("a") as file:
            file.writelines(json.dumps(r) + "\n" for r in results)
        done += results
    summary(done)


if __name__ == "__main__":
    main()
