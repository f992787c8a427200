"""Does what is measured at rest contradict the model, by how much, and how much of that is one rigid motion?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from livedeform.common.experiment.schema import Markers
from livedeform.common.frames import fit_rigid, make_a_frame
from livedeform.common.types import Array, Ids, Wrench
from livedeform.compare_node.residual import Residual, tabulate

STILL = 5e-5  # m, rms, by which the model's markers at rest may differ from one frame to another
PLACE = 4e-5  # m, sigma of a marker's place where its file gives none
SHORTEST, LONGEST = 5, 100  # frames that make a rest, and that are looked at
SPAN_NS = 200_000_000  # a rest is as long, too: between frames that follow each other fast nothing moves by much
PRESSES = 1e-3  # N: by less a probe moves markers of soft bodies by less than `STILL`
BEYOND = 3.0  # times the noise


@dataclass(frozen=True)
class AtRest:
    """The mean error (m, rms over ``n`` markers off the support) of ``frames`` still frames at one ``end`` of a
    recording: in all, after the best ``rigid`` motion is taken off (``left``), and what ``noise`` would leave: the
    frames' and that of the markers' stated places. The model's ``elements`` get the markers wrong by so much.

    That motion moves the markers' middle by ``shift`` (m) and turns them by ``turn`` (rad) about it, (3,) each: from
    where the model has them to where they were measured. So many markers are ``held`` by the support, if they make a
    frame: they tell a body that was held off its rest from a tracker's frame that is off."""

    end: str
    n: int
    frames: int
    error: float
    rigid: float
    left: float
    noise: float
    shift: tuple[float, float, float]
    turn: tuple[float, float, float]
    elements: float = 0.0
    held: int = 0

    @property
    def rigid_noise(self) -> float:
        """Return what noise would leave in a rigid motion (m, rms): 6 numbers of 3 n."""
        return self.noise * float(np.sqrt(6.0 / (3.0 * self.n)))

    @property
    def contradicts(self) -> bool:
        """Return whether that is beyond noise and elements: in all, or as one rigid motion, which many markers tell
        better."""
        allowed = np.hypot(self.elements, [self.noise, self.rigid_noise])
        return bool(self.error > BEYOND * allowed[0] or self.rigid > BEYOND * allowed[1])

    @property
    def text(self) -> str:
        """Put it in a sentence with numbers."""
        found = (
            f"at rest at the {self.end} the mean error of {self.n} markers is {1e3 * self.error:.2f} mm rms "
            f"({1e3 * self.rigid:.2f} mm one rigid motion, {1e3 * self.left:.2f} mm beside it; noise "
            f"{1e3 * self.noise:.3f} and {1e3 * self.rigid_noise:.3f} mm, elements {1e3 * self.elements:.3f} mm)"
        )
        if not self.contradicts:
            return found
        shift, turn = (", ".join(f"{1e3 * v:+.2f}" for v in motion) for motion in (self.shift, self.turn))
        where = "" if self.held else ", where the tracker's frame does not come from these markers"
        return (
            f"{found}: the reference pose contradicts the model, or the model the body; the motion is ({shift}) mm of "
            f"the markers' middle and ({turn}) mrad about it; diagnose tests reference_pose{where}"
        )


def read_at_rest(document: Mapping[str, Any]) -> AtRest:
    """The error at one end as ``metrics.json`` has it, where null is what is not known."""
    known: dict[str, Any] = {f.name: document[f.name] for f in fields(AtRest) if f.name in document}
    known |= {key: float("nan") for key, value in known.items() if value is None}
    known |= {key: _three(np.array(known[key], float)) for key in ("shift", "turn")}
    return AtRest(**known)


def at_rest(
    residuals: Sequence[Residual], markers: Markers, elements: float = 0.0, wrenches: Sequence[Wrench] = ()
) -> tuple[AtRest, ...]:
    """Judge the start and the end of a recording, as far as the model rests there and, by its predicted ``wrenches``,
    is not pressed; its ``elements`` get the markers wrong by so much (m, rms)."""
    free = _not_pressed([r for r in residuals if len(r.ids)], wrenches)
    found = (_at_end(free, markers, "start"), _at_end(free[::-1], markers, "end"))
    return tuple(replace(f, elements=elements) for f in found if f is not None)


def _not_pressed(residuals: Sequence[Residual], wrenches: Sequence[Wrench]) -> list[Residual | None]:
    """Return the ``residuals``, None for one at which the predicted force is not zero."""
    forces = np.array([np.linalg.norm(w.force) for w in wrenches])
    known = np.isfinite(forces)
    if not known.any():
        return list(residuals)
    stamps = np.array([w.stamp_ns for w in wrenches], float)
    force = np.interp([r.stamp_ns for r in residuals], stamps[known], forces[known])
    return [r if f <= PRESSES else None for r, f in zip(residuals, force, strict=True)]


def _at_end(residuals: Sequence[Residual | None], markers: Markers, end: str) -> AtRest | None:
    """Judge the first of the ``residuals``, while nothing presses and the model stays within `STILL`; None if that is
    not long."""
    still: list[Residual] = []
    for r in residuals:
        if r is None or (still and _moved(r, still[0]) > STILL):
            break
        still.append(r)
        if len(still) >= LONGEST and _span_ns(still) >= SPAN_NS:
            break
    if len(still) < SHORTEST or _span_ns(still) < SPAN_NS:
        return None
    ids, predicted, error, frame = _means(still)
    on_support = np.asarray(markers.kinds) == "support"
    held = markers.ids[on_support]
    free = ~np.isin(ids, held)
    if free.sum() < 3:
        return None
    ids, predicted, error, frame = ids[free], predicted[free], error[free], frame[free]
    sigma = dict(zip(markers.ids.tolist(), markers.sigmas.tolist(), strict=True))
    place = np.array([sigma.get(int(i), np.nan) for i in ids])
    place = np.where(np.isfinite(place), place, PLACE)
    noise = float(np.sqrt(3.0 * np.mean(place**2 + frame)))
    T = _motion(predicted, predicted + error, noise)
    moved = predicted @ T[:3, :3].T + T[:3, 3]
    left = predicted + error - moved
    size = [float(np.sqrt(np.mean(np.sum(e**2, axis=1)))) for e in (error, error - left, left)]
    shift, turn = (moved - predicted).mean(axis=0), Rotation.from_matrix(T[:3, :3]).as_rotvec()
    moved_by = _three(shift), _three(turn)
    n_held = len(held) if make_a_frame(markers.points[on_support]) else 0
    return AtRest(end, len(ids), len(still), size[0], size[1], size[2], noise, *moved_by, held=n_held)


def _motion(predicted: Array, measured: Array, noise: float) -> Array:
    """Return the rigid motion (4, 4) that takes ``predicted`` to ``measured`` (n, 3) m. Six more points, which do not
    turn, keep that turn at zero which the ``noise`` (m) hides: the one about a line, where all markers lie on it."""
    far = BEYOND * noise * np.sqrt(len(predicted) / 2.0)
    arms = np.concatenate([far * np.eye(3), -far * np.eye(3)])
    return fit_rigid(*(np.concatenate([points, points.mean(axis=0) + arms]) for points in (predicted, measured)))


def _span_ns(still: Sequence[Residual]) -> int:
    return abs(still[-1].stamp_ns - still[0].stamp_ns)


def _means(still: Sequence[Residual]) -> tuple[Ids, Array, Array, Array]:
    """Return the ids (n,) of markers that at least half of the frames show, their mean prediction and error (n, 3) m,
    and the variance (n,) m2 per axis of their mean: that of one frame, as frames may not be independent. Of a marker
    whose tracker states none it is how its errors scatter."""
    table = tabulate(list(still))
    ids, row, count = np.unique(table.ids, return_inverse=True, return_counts=True)
    often = 2 * count >= len(still)

    def mean(values: Array) -> Array:
        columns = [np.bincount(row, column) / count for column in values.reshape(len(row), -1).T]
        return np.stack(columns, axis=1)[often]

    error, known = mean(table.errors), np.isfinite(table.variances)
    scatter = np.maximum(mean(table.errors**2) - error**2, 0.0).sum(axis=1) * (count / np.maximum(count - 1, 1))[often]
    share = mean(1.0 * known)[:, 0]  # of the frames, in which it is stated
    stated = mean(np.where(known, table.variances, 0.0))[:, 0] / np.where(share > 0.0, share, 1.0)
    return ids[often], mean(table.predicted), error, np.where(share > 0.0, stated, scatter) / 3.0


def _moved(one: Residual, other: Residual) -> float:
    """Return how far (m, rms) the model's markers that both show are apart; infinite where they share none."""
    _, i, j = np.intersect1d(one.ids, other.ids, return_indices=True)
    if not len(i):
        return float("inf")
    return float(np.sqrt(np.mean(np.sum((one.predicted[i] - other.predicted[j]) ** 2, axis=1))))


def _three(vector: Array) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in vector)
    return x, y, z
