"""Say which rigid motions of the body its supports leave free, and what holds it then."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from livedeform.common.checks.finding import Finding
from livedeform.common.experiment.schema import Experiment, Region
from livedeform.common.experiment.surface import Surface
from livedeform.common.types import Array

STEEP = 0.5  # cosine to the mean normal, below which a facet is of a wall, which a flat support does not touch
FLAT = 0.005  # of its width, by which (rms) a support is off a plane that holds along one normal: a scan's noise
LOOSE = 0.02  # of a motion of length one (rms over the body), by which the supports see it, and do not hold it
ALIGNED = 0.999  # cosine to an axis that is named
AXES = ("x", "y", "z")
SPRINGY = {"base_slip"}  # effects whose springs hold a support sideways


def check_held(experiment: Experiment, body: Surface) -> list[Finding]:
    """Check whether the supports hold the body against every shift and turn."""
    if any(effect.name in SPRINGY for effect in experiment.effects):
        return []
    shifts, turns = free_motions(experiment, body)
    if not len(shifts) + len(turns):
        return []
    said = [f"{'a shift' if len(shifts) == 1 else 'shifts'} along {_named(shifts)}"] if len(shifts) else []
    said += [f"{'a turn' if len(turns) == 1 else 'turns'} about {_named(turns)}"] if len(turns) else []
    text = f"the supports leave {' and '.join(said)} of the whole body free"
    probe = experiment.probe
    if probe is None:
        text += ", and nothing else holds it"
    elif probe.contact.formulation == "prescribed" or probe.contact.friction > 0.0:
        text += ": only the probe holds it, while it touches"
    else:
        text += ": only the probe may hold it, which has no friction, while it touches and as far as its shape does"
    return [Finding("WARN", text, "hold a part of it with a support of the type 'fixed', or by the probe's friction")]


def free_motions(experiment: Experiment, body: Surface) -> tuple[Array, Array]:
    """Return the directions (s, 3) of the shifts that are free, and the axes (r, 3) of the turns that are besides."""
    middle, size = body.corners.reshape(-1, 3).mean(axis=0), 0.5 * body.diagonal
    rows = [_held_by(support.region, support.type, body, middle, size) for support in experiment.phantom.support]
    held = np.concatenate(rows)
    free = _null(held)
    shifts = _null(held[:, :3])
    besides = free[:, 3:]  # what turns the free motions have: the shifts among them have none
    if not len(besides):
        return _upright(shifts), np.zeros((0, 3))
    _, values, axes = np.linalg.svd(besides, full_matrices=False)
    return _upright(shifts), _upright(axes[: len(free) - len(shifts)][values[: len(free) - len(shifts)] > LOOSE])


def _held_by(region: Region, kind: str, body: Surface, middle: Array, size: float) -> Array:
    """Return the velocities (n, 6) that a support holds at nothing, of a shift and a turn about ``middle`` (over
    ``size`` m), each weighed by its share of the support."""
    corners = body.corners
    inside = region.contains(corners.reshape(-1, 3)).reshape(-1, 3).all(axis=1)
    if not inside.any():  # triangles that are larger than the region: what it is like is told by the model
        return np.eye(6)
    corners = corners[inside]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normals, axis=1)
    corners, normals, area = corners[area > 0.0], normals[area > 0.0], area[area > 0.0]
    if not len(area):
        return np.eye(6)
    normals = normals / area[:, None]
    if kind == "sliding":
        kept, normals = _touching(corners, normals, area)
        corners, area, directions = corners[kept], area[kept], normals[:, None]
    else:
        directions = np.broadcast_to(np.eye(3), (len(area), 3, 3))
    weight = np.sqrt(area / area.sum() / 3.0)
    arms = (corners - middle) / size
    shift = np.broadcast_to(directions[:, None], (len(area), 3, *directions.shape[1:]))
    turn = np.cross(arms[:, :, None], shift)
    return np.asarray((np.concatenate([shift, turn], axis=-1) * weight[:, None, None, None]).reshape(-1, 6))


def _touching(corners: Array, normals: Array, area: Array) -> tuple[NDArray[np.bool_], Array]:
    """Return which facets a sliding support touches, and their normals: one for all of a flat one, however rough."""
    mean = area @ normals
    length = float(np.linalg.norm(mean))
    if length <= STEEP * area.sum() * STEEP:
        return np.ones(len(area), bool), normals
    mean = mean / length
    kept = np.asarray(normals @ mean > STEEP)
    centres = corners[kept].mean(axis=1)
    centres = centres - np.average(centres, axis=0, weights=area[kept])
    heights = centres @ mean
    rough = float(np.sqrt(np.average(heights**2, weights=area[kept])))
    width = float(np.ptp(corners[kept].reshape(-1, 3), axis=0).max())
    if rough > FLAT * width:
        return np.ones(len(area), bool), normals
    axis = int(np.argmax(np.abs(mean)))
    if abs(mean[axis]) > ALIGNED:
        mean = np.sign(mean[axis]) * np.eye(3)[axis]
    return kept, np.broadcast_to(mean, (int(kept.sum()), 3))


def _null(rows: Array) -> Array:
    """Return the motions (k, 6 or 3), of length one, that ``rows`` (n, 6 or 3) do not hold."""
    values, vectors = np.linalg.eigh(rows.T @ rows)
    return np.asarray(vectors.T[values < LOOSE**2])


def _upright(directions: Array) -> Array:
    """Return directions (k, 3) that span the same, along the axes where these do."""
    along = [axis for axis in np.eye(3) if np.linalg.norm(directions @ axis) > ALIGNED]
    return np.array(along) if len(along) == len(directions) and along else directions


def _named(directions: Array) -> str:
    """Name directions by their axes, or by their components."""
    names = []
    for direction in directions:
        axis = int(np.argmax(np.abs(direction)))
        aligned = abs(direction[axis]) > ALIGNED
        names.append(AXES[axis] if aligned else "(" + ", ".join(f"{v + 0.0:.2f}" for v in direction) + ")")
    return ", ".join(names[:-1]) + (" and " if len(names) > 1 else "") + names[-1]
