"""Are the markers numbered as in markers.csv, and are they in its frame and unit? Told where they are first seen.

Distances between markers need no frame: where they fit those of markers.csv the ids, the unit and the handedness are
right, and a best rigid motion (Kabsch) that is large is another frame. Where they do not fit, the one simple mistake
with which they do is named: ids that are permuted, a mirror image, another unit.

What may be so is no mistake: a body that sags, however soft (`may_sag`), or is pressed as deep as the probe is in it, a
tracker's noise, and what a diagnosis finds by itself, which are cameras that are off by millimetres and a few degrees,
lengths that are wrong by some per cent, and markers inside of a body that refracts.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from livedeform.common.bags.recording import Recording
from livedeform.common.checks.finding import Finding
from livedeform.common.checks.presses import RESTING, rest_places, shows_the_body
from livedeform.common.checks.probe_path import ProbeRecord
from livedeform.common.experiment.schema import Experiment
from livedeform.common.experiment.surface import Surface
from livedeform.common.types import Array, Ids

LEAST = 3  # markers that have a shape
SIGMAS = 5.0
SOFTER = 2.0  # than declared: a body sags so much more
STRETCHED = 0.1  # of the markers' size: a scale, or what swells, which a diagnosis finds
REFRACTED = 0.35  # of the depth, by which markers inside seem nearer
TURNED = np.radians(20.0)  # cameras off by a few degrees are found by a diagnosis; mixed up axes are 90 or more
SHIFTED, MILLIMETRES = 0.25, 0.005  # of the body's radius, and m, for the same of millimetres
OTHER_UNIT = 0.2  # by which lengths are off beyond what is called a scale
BETTER = 0.25  # of what is left without it, a mistake must leave at most
FEW = 0.25  # of the markers, and HALF of the distance to the next: so many are elsewhere, and so far
HALF, NEAR = 0.5, 0.25  # of that distance: a marker is off its place, and at that of another
ENOUGH = 8  # markers that tell how a body is sheared and squeezed, and which do not go with it
ON_A_LINE = 0.1  # of the size along it
ROUNDS = 10  # of leaving those out, and of numbering markers by which places they are nearest to
MOST = 1000  # markers, whose ids are told one by one
NAMED = 4
OF_IDS = "give every marker the id that markers.csv has for it"
OF_FRAME = "give markers in the frame of markers.csv (T_phantom_tracker), or measure how it lies to the tracker's"


@dataclass(frozen=True)
class Arrangement:
    """Markers ``ids`` (n,) that are first seen at ``seen`` (n, 3) m, and their ``places`` (n, 3) m of markers.csv;
    ``all_ids`` (m,) and ``all_places`` (m, 3) m are those that were not seen too. ``noise`` m is how well one place is
    known, ``gives`` m how far a marker may be off beside the others without a mistake, ``radius`` m that of the
    body, and ``down`` (3,) the direction in which weight alone pulls it, zero where other forces do too."""

    ids: Ids
    seen: Array
    places: Array
    all_ids: Ids
    all_places: Array
    noise: float
    gives: float
    radius: float
    down: Array

    @cached_property
    def spread(self) -> float:
        """Return the markers' size (m): the rms distance of their places from the middle of these."""
        return _rms(self.places - self.places.mean(axis=0))

    @cached_property
    def spacing(self) -> Array:
        """Return how far (n,) m the nearest other place is from each."""
        return np.asarray(cKDTree(self.all_places).query(self.places, k=2)[0][:, 1])

    @property
    def limit(self) -> float:
        """Return the largest rms misfit (m) of distances without a mistake."""
        return self.gives + STRETCHED * self.spread + SIGMAS * self.noise


def check_arrangement(probe: ProbeRecord) -> list[Finding]:
    """Check ids, handedness, unit and frame of the markers by where they are first seen."""
    given = arrangement(probe)
    if given is None:
        return []
    found = _exchanged(given)
    return found if found is not None else _other_distances(given)


def arrangement(probe: ProbeRecord) -> Arrangement | None:
    """Return how the markers lie when they are first seen; None of fewer than three."""
    recording, markers = probe.recording, probe.experiment.markers
    ids, seen = rest_places(recording.measured_frames)
    order = np.argsort(markers.ids)
    at = order[np.minimum(np.searchsorted(markers.ids, ids, sorter=order), len(order) - 1)] if len(order) else ids
    known = markers.ids[at] == ids if len(order) else np.zeros(len(ids), bool)
    if known.sum() < LEAST:
        return None
    ids, seen, at = ids[known], seen[known], at[known]
    sigmas = markers.sigmas[at]
    sigma = float(np.median(sigmas[np.isfinite(sigmas)])) if np.isfinite(sigmas).any() else 0.0
    size = _rms(markers.points[at] - markers.points[at].mean(axis=0))
    gives = SOFTER * may_sag(probe.experiment, probe.body) + _pressed(probe)
    gives += REFRACTED * size if (markers.kinds[at] == "internal").any() else 0.0
    noise = float(np.hypot(_scatter(recording, ids, seen), sigma))
    places, radius = markers.points[at], radius_of(probe.body)
    return Arrangement(ids, seen, places, markers.ids, markers.points, noise, gives, radius, _down(probe.experiment))


def radius_of(body: Surface) -> float:
    """Return how far (m) the surface is from its middle, at most; the same in every frame."""
    corners = body.corners
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    middle = areas @ corners.mean(axis=1) / areas.sum()
    return float(np.linalg.norm(body.vertices - middle, axis=1).max())


def may_sag(experiment: Experiment, body: Surface) -> float:
    """Return how far (m) weight and loads may move a marker: of a bar as long as the way L to the farthest point that
    nothing holds, p L^2 / 2E along itself and 3 p L^4 / 2E h^2 across (p the force per volume, h the least width)."""
    phantom = experiment.phantom
    held = np.any([support.region.contains(body.vertices) for support in phantom.support], axis=0)
    middle = body.vertices[held].mean(axis=0) if held.any() else body.lower
    length = 2.0 * radius_of(body)
    if held.any():
        length = float(cKDTree(body.vertices[held]).query(body.vertices)[0].max())
    axis = body.corners.reshape(-1, 3).mean(axis=0) - middle
    axis = axis / max(float(np.linalg.norm(axis)), 1e-12)
    scanned = np.array(phantom.scan_gravity)
    pulls = [np.array(phantom.gravity), scanned, np.array(phantom.gravity) - scanned]
    pulls = [phantom.density * pull for pull in pulls]
    extra = 3.0 * sum((np.abs(load.force) for load in experiment.loads), np.zeros(3)) / body.volume  # at its end
    slender = 3.0 * max(1.0, length / float((body.upper - body.lower).min())) ** 2
    along = max(abs(float(pull @ axis)) for pull in pulls) + abs(float(extra @ np.abs(axis)))
    across = max(float(np.linalg.norm(pull - (pull @ axis) * axis)) for pull in pulls)
    across += float(np.linalg.norm(extra - (extra @ np.abs(axis)) * np.abs(axis)))
    return length**2 * (along + slender * across) / (2.0 * phantom.material.youngs_modulus)


def _down(experiment: Experiment) -> Array:
    """Return the direction (3,) of all weight that acts or acted; zero where that is none, or not one."""
    pulls = np.array([experiment.phantom.gravity, experiment.phantom.scan_gravity])
    size = float(np.linalg.norm(pulls[0]))
    if experiment.loads or not size or np.linalg.norm(np.cross(*pulls)) > STRETCHED * size**2:
        return np.zeros(3)
    return np.asarray(pulls[0] / size)


def _pressed(probe: ProbeRecord) -> float:
    """Return how deep (m) the probe is in the body, at most, in the frames by which the rest is told."""
    frames, path = probe.recording.measured_frames, probe.path
    if path is None:
        return 0.0
    body = np.flatnonzero(shows_the_body(np.array([len(frame.ids) for frame in frames])))[:RESTING]
    seconds = [1e-9 * (frames[k].stamp_ns - probe.recording.start_ns) for k in body]
    return max(float(np.interp(seconds, path.seconds, path.depths).max(initial=0.0)), 0.0)


def _scatter(recording: Recording, ids: Ids, seen: Array) -> float:
    """Return how well (m, rms of three coordinates) the median of the first frames is known: by how these scatter."""
    at = {int(marker): k for k, marker in enumerate(ids)}
    frames = recording.measured_frames
    first = np.flatnonzero(shows_the_body(np.array([len(frame.ids) for frame in frames])))[:RESTING]
    off = [
        float(np.sum((p - seen[at[int(i)]]) ** 2))
        for k in first for i, p in zip(frames[k].ids, frames[k].points, strict=True) if int(i) in at
    ]  # fmt: skip
    off = [each for each in off if np.isfinite(each)]
    return float(np.sqrt(np.mean(off))) if off else 0.0


# --- a few ids -------------------------------------------------------------------------------------------------------


def _exchanged(given: Arrangement) -> list[Finding] | None:
    """Find a few markers that lie on one another's places, while all others go together."""
    moved = _going_along(given)
    off = np.linalg.norm(given.seen - moved, axis=1)
    odd = np.flatnonzero(off > HALF * given.spacing)
    if not 2 <= len(odd) <= max(2, FEW * len(off)) or len(odd) == len(off):
        return None
    apart = cdist(given.seen[odd], moved[odd])
    rows, columns = linear_sum_assignment(apart**2)
    limit = np.minimum(NEAR * np.linalg.norm(given.places[odd] - given.places[odd][columns], axis=1), HALF * off[odd])
    at = dict(zip(rows.tolist(), columns.tolist(), strict=True))
    fits = (apart[rows, columns] < limit) & (limit > SIGMAS * NEAR * given.noise)
    others = np.delete(off, odd)
    rest = float(np.percentile(others, 90.0))
    cycles = [c for c in _cycles(at) if all(fits[k] for k in c) and len(c) > 1 and rest < limit[c].min()]
    if not cycles:
        return None
    named = [[str(given.ids[odd[k]]) for k in cycle] for cycle in cycles]
    pairs = [" and ".join(c) if len(c) == 2 else ", ".join(c) for c in named[:NAMED]]
    more = f" and {len(named) - NAMED} more such" if len(named) > NAMED else ""
    text = f"from the beginning on markers lie on one another's places: {'; '.join(pairs)}{more}"
    return [Finding("WARN", text, f"their ids are exchanged: {OF_IDS}", doubts=True)]


def _going_along(given: Arrangement) -> Array:
    """Return where (n, 3) m the markers' places are once most of them are led to where they are seen: by a linear map,
    as a body sags, or, of a few, as they are."""
    if len(given.ids) < ENOUGH:
        return given.places
    moved = given.places + np.median(given.seen - given.places, axis=0)
    for _ in range(ROUNDS):
        off = np.linalg.norm(given.seen - moved, axis=1)
        kept = off <= np.quantile(off, 1.0 - FEW)
        moved = _linear(given.places[kept], given.seen[kept], given.places)
    return np.asarray(moved)


def _cycles(at: dict[int, int]) -> list[list[int]]:
    """Return the cycles of a permutation."""
    left, out = set(at), []
    while left:
        k, cycle = min(left), []
        while k in left:
            left.remove(k)
            cycle.append(k)
            k = at[k]
        out.append(cycle)
    return out


# --- ids, handedness, unit -------------------------------------------------------------------------------------------


def _other_distances(given: Arrangement) -> list[Finding]:
    """Find why distances between the markers do not fit, or, where they do, why the places do not."""
    misfit = _rms(given.seen - _rigid(given.places, given.seen))
    if misfit > given.limit - given.gives:  # a body may give way by that much, but not to become one of these
        if _rms(given.seen - _rigid(given.places, given.seen, mirrored=True)) <= BETTER * misfit:
            text = "the markers are a mirror image of those of markers.csv"
            return [Finding("WARN", text, "one of both frames is left-handed: turn one of its axes round", doubts=True)]
        scale, left = _similar(given)
        if abs(scale - 1.0) > OTHER_UNIT and left <= BETTER * min(scale, 1.0) * max(misfit, given.spread):
            said = f"{scale:.0f}" if scale >= 100.0 else f"{scale:.3g}"
            text = f"the distances between the markers are {said} times those of markers.csv"
            return [Finding("WARN", text, "give both in metres", doubts=True)]
        if numbered := _numbered(given, BETTER * misfit):
            return numbered
    if misfit <= given.limit:
        return _other_frame(given, misfit)
    if misfit <= SOFTER * given.limit:
        return []
    text = f"the distances between the markers are not those of markers.csv ({1e3 * misfit:.3g} mm, rms, are left)"
    if misfit > HALF * given.spread:  # as of other markers altogether: no ids that are told above make them fit
        return [Finding("ERROR", f"{text}: a recording of another body or with other ids", OF_IDS)]
    return [Finding("WARN", text, f"compare frame, unit and ids: {OF_IDS}", doubts=True)]


def _numbered(given: Arrangement, fine: float) -> list[Finding]:
    """Say which ids the markers have where, in the frame as given, they lie on the places of others, ``fine`` m (rms)
    from these at most."""
    if len(given.all_ids) > MOST:
        return []
    moved = given.all_places
    if len(given.ids) >= ENOUGH:
        fine = min(fine, BETTER * _rms(given.seen - _linear(given.places, given.seen, given.places)))
    for _ in range(ROUNDS):
        rows, columns = linear_sum_assignment(cdist(given.seen, moved) ** 2)
        left = _rms(given.seen - moved[columns])
        if left <= fine or len(rows) < ENOUGH:
            break
        moved = _linear(given.all_places[columns], given.seen, given.all_places)
    if left > fine or np.median(np.linalg.norm(given.seen - moved[columns], axis=1)) > HALF * np.median(given.spacing):
        return []
    own = given.all_ids[columns].astype(np.int64)
    wrong = np.flatnonzero(own != given.ids)
    if not len(wrong):
        return []
    text = f"markers lie on the places of others: {_pairs(given.ids, own, wrong)}"
    shifts, counts = np.unique(given.ids.astype(np.int64) - own, return_counts=True)
    if counts.max() > 0.5 * len(own) and shifts[counts.argmax()] != 0:
        shift = int(shifts[counts.argmax()])
        text = f"the markers' ids are shifted by {shift:+d}: {_pairs(given.ids, own, wrong)}"
    return [Finding("WARN", text, OF_IDS, doubts=True)]


def _pairs(ids: Ids, own: NDArray[np.int64], wrong: NDArray[np.int64]) -> str:
    said = ", ".join(f"{ids[k]} on that of {own[k]}" for k in wrong[:NAMED])
    return said + (f" and {len(wrong) - NAMED} more" if len(wrong) > NAMED else "")


# --- the frame -------------------------------------------------------------------------------------------------------


def _other_frame(given: Arrangement, misfit: float) -> list[Finding]:
    """Find a frame that is turned or shifted against that of markers.csv, where distances fit to ``misfit`` m (rms), or
    ids with which markers of a regular pattern seem to be so."""
    centred = given.places - given.places.mean(axis=0)
    shift = given.seen.mean(axis=0) - given.places.mean(axis=0)
    R = _rotation(centred, given.seen - given.seen.mean(axis=0))
    by = _rms(centred @ R.T - centred)
    limit = 2.0 * np.sin(TURNED / 2.0) * given.spread + SIGMAS * given.noise
    is_turned = by > limit + given.gives or (by > limit and _twist(R, centred, given.down) > TURNED)
    is_shifted = np.linalg.norm(shift) > max(SHIFTED * given.radius, MILLIMETRES) + given.gives + SIGMAS * given.noise
    if not (is_turned or is_shifted):
        return []
    if misfit > SIGMAS * given.noise and (numbered := _numbered(given, BETTER * misfit)):
        return numbered
    x, y, z = 1e3 * shift
    angle = float(np.linalg.norm(Rotation.from_matrix(R).as_rotvec()))
    how = [f"turned by {np.degrees(angle):.0f} degrees"] if by > SIGMAS * given.noise + misfit else []
    how += [f"shifted by ({x:.1f}, {y:.1f}, {z:.1f}) mm"] if np.linalg.norm(shift) > SIGMAS * given.noise else []
    text = f"the markers are in another frame than markers.csv: {' and '.join(how)}"
    return [Finding("WARN", text, OF_FRAME, doubts=True)]


def _twist(R: Array, centred: Array, down: Array) -> float:
    """Return by how much (rad) a rotation turns about the direction (3,) in which weight pulls, which no weight does; 0
    where that is none, or where the markers lie nearly on a line, which tells no such turn."""
    spreads = np.linalg.svd(centred, compute_uv=False)
    if not down.any() or spreads[1] < ON_A_LINE * spreads[0]:
        return 0.0
    x, y, z, w = Rotation.from_matrix(R).as_quat()
    return float(2.0 * np.arctan2(abs(down @ [x, y, z]), abs(w)))


# --- fits ------------------------------------------------------------------------------------------------------------


def _rms(vectors: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1))))


def _linear(source: Array, target: Array, points: Array) -> Array:
    """Lead ``points`` (m, 3) m by the linear map and shift that lead ``source`` (n, 3) to ``target`` best; across a
    plane or a line in which all of these lie, by the shift alone."""
    middle = source.mean(axis=0)
    homogeneous = [np.column_stack([each - middle, np.ones(len(each))]) for each in (source, points)]
    by, *_ = np.linalg.lstsq(homogeneous[0], target - source, rcond=1e-6)
    return np.asarray(points + homogeneous[1] @ by)


def _rotation(p: Array, q: Array, sign: float = 1.0) -> Array:
    """Return the rotation (3, 3) that leads ``p`` (n, 3) to ``q``, both about zero, best (Kabsch 1976), or, with a
    ``sign`` of -1, the mirror image; the least one of points on a line."""
    U, s, Vt = np.linalg.svd(p.T @ q)
    if sign > 0.0 and s[1] <= 1e-12 * s[0]:
        return np.asarray(Rotation.align_vectors(Vt[:1], U[:, :1].T)[0].as_matrix())
    D = np.diag([1.0, 1.0, sign * float(np.sign(np.linalg.det(U) * np.linalg.det(Vt)))])
    return np.asarray(Vt.T @ D @ U.T)


def _rigid(source: Array, target: Array, *, mirrored: bool = False) -> Array:
    """Lead ``source`` (n, 3) m to ``target`` by the best rotation, or mirror image, and shift."""
    p, q = source - source.mean(axis=0), target - target.mean(axis=0)
    return np.asarray(p @ _rotation(p, q, -1.0 if mirrored else 1.0).T + target.mean(axis=0))


def _similar(given: Arrangement) -> tuple[float, float]:
    """Return the scale of what is seen, by the best rotation, shift and scale, and the rms (m) that is left."""
    p, q = given.places - given.places.mean(axis=0), given.seen - given.seen.mean(axis=0)
    turned = p @ _rotation(p, q).T
    scale = float(np.sum(turned * q) / np.sum(turned**2))
    return scale, _rms(q - scale * turned)
