"""A model that jumps against the same model that walks: is it ever converged in a wrong state?

    python benchmarks/contact_grid.py --out grid.jsonl [--part tuned|held] [--bodies N] [--only ball] [--summary]

Each setting is a body, a probe, a place and a tilt, drawn with a seed of its own; the probe goes down its axis. The
reference is the model itself, walked in steps of 0.5 mm, and where a walk in steps of 0.25 mm ends elsewhere, the
setting has more than one equilibrium and is counted apart (sharp edges on a coarse mesh). Jumps to each depth: first
seen inside, from 1 and 20 mm above, from 2 mm deep, from the far side of the body, and sideways by 6 mm after 12
missing poses.
``converged`` but off by more than 1 % of the force or 0.05 mm is wrong. A run goes on where the file ends.

Numbers were chosen on the part ``tuned``; ``held`` is there to be looked at only.
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

from livedeform.common import frames
from livedeform.common.types import Array, Prediction
from livedeform.fem_node.contact.probe_shapes import Box, Cylinder, Shape, Sphere
from livedeform.fem_node.element.element import make_space
from livedeform.fem_node.mesh.structured import block_mesh, cylinder_mesh, hemi_ellipsoid_mesh
from livedeform.fem_node.mesh.tet_mesh import TetMesh
from livedeform.fem_node.model import PhantomModel
from livedeform.fem_node.physics.record import MaterialSpec, Physics, Probe, Support

DOWN = Rotation.from_euler("x", 180, degrees=True).as_matrix()
DEPTHS = (0.004, 0.008, 0.012)
FORCE, PLACE, LEAST_FORCE = 0.01, 5e-5, 0.005  # of the force, m, N: what a jump may be off by
FINE, FINER = 5e-4, 2.5e-4  # m, the reference's steps
SIDE = 0.006

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
    """One body, probe, place and tilt: number ``k`` of a ``part``."""

    def __init__(self, part: str, kind: str, k: int) -> None:
        rng = np.random.default_rng([{"tuned": 0, "held": 1}[part], {"ball": 0, "cylinder": 1, "box": 2}[kind], k])
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

    def walk(self, path: list[tuple[float, float]], step: float) -> Prediction:
        """Along straight lines between (depth, side), from a fresh body."""
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
        yield "sideways in contact", [(-0.001, 0.0), (depth, 0.0)], (depth, SIDE)
        yield "from the far side", [(0.15, 0.0)], (depth, 0.0)


def off(answer: Prediction, reference: Prediction) -> tuple[float, float]:
    """Of the force (relative), and the surface's largest distance, m."""
    there = np.linalg.norm(reference.force)
    force = float(np.linalg.norm(answer.force - reference.force) / max(there, LEAST_FORCE))
    return force, float(np.linalg.norm(answer.surface - reference.surface, axis=1).max())


def same(answer: Prediction, reference: Prediction, share: float = 1.0) -> bool:
    """Whether they agree."""
    force, place = off(answer, reference)
    return force <= share * FORCE and place <= share * PLACE


def cases(part: str, kind: str, k: int) -> Iterator[dict[str, Any]]:
    """The results of one setting."""
    setting = Setting(part, kind, k)
    for depth in DEPTHS:
        references: dict[float, tuple[Prediction, Prediction]] = {}
        for name, before, (d, side) in setting.jumps(depth):
            if side not in references:
                path = [(-0.001, 0.0), (d, 0.0), *([(d, side)] if side else [])]
                references[side] = setting.walk(path, FINE), setting.walk(path, FINER)
            fine, finer = references[side]
            setting.model.reset()
            if before:
                setting.walk(before, FINE)
            began = time.perf_counter()
            answer = setting.go(d, side)
            seconds = time.perf_counter() - began
            after = setting.go(d - 5e-4, side)
            result = {"part": part, "kind": kind, "k": k, "body": setting.body, "depth": depth, "jump": name}
            result |= {"converged": answer.converged, "next": after.converged, "seconds": round(seconds, 3)}
            result |= {"solved": fine.converged and finer.converged, "message": answer.message}
            if fine.converged and finer.converged:
                result["unique"] = same(fine, finer, 0.5)
                if answer.converged:
                    result["off"] = min(off(answer, fine), off(answer, finer))
                    result["right"] = same(answer, fine) or same(answer, finer)
            yield result


def summary(results: list[dict[str, Any]]) -> None:
    """The table."""
    for part in ("tuned", "held"):
        some = [r for r in results if r["part"] == part]
        if not some:
            continue
        solved = [r for r in some if r["solved"]]
        unique = [r for r in solved if r["unique"]]
        wrong = [r for r in unique if r["converged"] and not r["right"]]
        refused = [r for r in solved if not r["converged"]]
        split = [r for r in solved if not r["unique"] and r["converged"]]
        print(
            f"{part}: {len(some)} cases, {len(solved)} solved by walking; wrong and converged {len(wrong)} of "
            f"{len(unique)}; refused {len(refused)} ({100 * len(refused) / max(len(solved), 1):.1f} %); more than one "
            f"equilibrium by walking {len(solved) - len(unique)}, of which "
            f"{sum(not r['right'] for r in split)} end in another yet"
        )
        for r in wrong:
            print(f"  wrong: {r['kind']} {r['k']} {r['body']}, {1e3 * r['depth']:.0f} mm, {r['jump']}: "
                  f"{100 * r['off'][0]:.1f} % {1e3 * r['off'][1]:.2f} mm")  # fmt: skip
        for text, n in Counter(r["message"][:110] for r in refused).most_common(5):
            print(f"  refused {n}: {text}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--part", choices=("tuned", "held"), default="held")
    parser.add_argument("--bodies", type=int, default=10)
    parser.add_argument("--only", choices=("ball", "cylinder", "box"))
    parser.add_argument("--summary", action="store_true")
    args = parser.parse_args()
    done = [json.loads(line) for line in args.out.read_text().splitlines()] if args.out.exists() else []
    known = {(r["part"], r["kind"], r["k"]) for r in done}
    kinds = (args.only,) if args.only else ("ball", "cylinder", "box")
    for k in range(0 if args.summary else args.bodies):
        for kind in kinds:
            if (args.part, kind, k) in known:
                continue
            results = list(cases(args.part, kind, k))
            with args.out.open("a") as file:
                file.writelines(json.dumps(r) + "\n" for r in results)
            done += results
    summary(done)


if __name__ == "__main__":
    main()
