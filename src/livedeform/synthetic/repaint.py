"""The pictures of an earlier synthetic experiment anew, from the surfaces that its truth holds: nothing is solved."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from livedeform.common import topics as t
from livedeform.common.bags.read import read_bag
from livedeform.common.errors import InputError
from livedeform.common.types import Array
from livedeform.synthetic import scenario
from livedeform.synthetic.body_markers import aimed_rig, place_markers
from livedeform.synthetic.measuring.measure import Seen, Tracker
from livedeform.synthetic.record import START_NS, ScenePainter
from livedeform.synthetic.solved_motion import build_truth
from livedeform.synthetic.writing import ScenarioWriter

PICTURES = (t.LEFT_COMPRESSED, t.RIGHT_COMPRESSED)


def can_repaint(folder: Path) -> bool:
    """Return whether ``folder`` is a synthetic experiment."""
    return (folder / "truth" / "truth.json").is_file()


def repaint(
    folder: Path, out: Path, seed: int = 0, progress: Callable[[str, float | None], None] | None = None
) -> Path:
    """Copies a synthetic experiment to ``out``, with new pictures; returns the experiment's folder.

    Poses, forces and truth stay; how the body looks comes from the scenario in its truth (``paint`` there may be
    edited).
    """
    tell = progress or (lambda text, fraction: None)
    spec = scenario.load(json.loads((folder / "truth" / "truth.json").read_text())["scenario"])
    for part in ("experiment", "truth"):
        shutil.copytree(folder / part, out / part)
    for path in sorted((folder / "truth").glob("*.npz")):
        truth = np.load(path)
        if "surface" not in truth:
            raise InputError(
                "its truth holds no surfaces", where=str(path), remedy="make the experiment again with livedeform synth"
            )
        tell(f"recording {path.stem}", 0.0)
        painter = _painter(spec, truth["surface_rest"])
        rng = scenario.generator(seed)
        stamps = {int(stamp): k for k, stamp in enumerate(truth["stamps_ns"])}
        x = np.zeros_like(painter.mesh.nodes)
        with (
            read_bag(folder / "bags" / path.stem) as bag,
            ScenarioWriter(out / "bags" / path.stem, bag.metadata | {"repainted_with_seed": str(seed)}) as writer,
        ):
            for raw in bag.messages():
                if raw.topic not in PICTURES:
                    writer.copy(raw)
                elif raw.topic == PICTURES[0]:
                    k = stamps[raw.log_time_ns]
                    x[painter.nodes] = truth["surface"][k]
                    clock = 1e-9 * (raw.log_time_ns - START_NS)
                    for side, pixels in painter.pictures(x, truth["T_probe"][k], clock, int(rng.integers(2**31))):
                        writer.picture(side, raw.log_time_ns, pixels)
                    tell(f"recording {path.stem}", k / len(stamps))
    return out / "experiment"


def _painter(spec: dict[str, Any], surface: Array) -> ScenePainter:
    """Return a painter like the scenario's, for a body whose ``surface`` at rest (the faces' nodes) is known."""
    world, body, shape = build_truth(spec)
    body.factors.close()
    rest = body.mesh.nodes.copy()
    rest[np.unique(body.mesh.faces)] = surface
    rig = aimed_rig(spec, rest)
    markers = place_markers(spec, body.mesh, rest, rig)
    ids = np.arange(1, len(markers.kinds) + 1).astype(np.uint32)
    tracker = Tracker(rig, world.measuring, Seen(ids, markers.kinds), shape, np.random.default_rng(0))
    return ScenePainter(spec, body.mesh, rest, markers, tracker)
