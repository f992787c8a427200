"""Follow the probe against the body's surface as it was given: does it touch, when, how deep, and from where?"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from livedeform.common.bags.recording import Recording
from livedeform.common.checks.contact.distance import SurfaceDistance
from livedeform.common.checks.finding import Finding
from livedeform.common.experiment.schema import Experiment, ProbeShape
from livedeform.common.experiment.surface import Surface
from livedeform.common.types import Array, Pose

MOST_POSES = 400  # looked at, spread evenly over the recording, and as many that are nearest to the body between them
MOST_LOOKS = 200_000  # at where poses are, to find these
TOUCH = 1e-3  # m: the body sags, and the samples are apart, by about that
FAR = 2.0  # of the body's diagonal: a probe that stays that far away is in another frame or unit
BACKWARDS = -0.5  # cosine between the probe's +z and the direction to the body: it looks away from it
CLEAR = 2 * TOUCH  # m above the body, besides what it may sag: the probe does not touch
ALONG = 0.7  # cosine between the way in which a probe presses and that in which the body sags


@dataclass(frozen=True)
class ProbeApproach:
    """The probe's path: ``seconds`` (n,) since the recording's start, ``depths`` (n,) m, how deep the probe's face is
    below the surface (negative: how far above), ``facing`` (n,) the cosine between +z of the probe and the direction to
    the body's middle."""

    seconds: Array
    depths: Array
    facing: Array


@dataclass(frozen=True)
class ProbeRecord:
    """The probe of a ``recording`` beside the ``body`` as it was given. All checks of one recording share it: what they
    ask of half an hour of poses takes seconds, and is worked out once."""

    recording: Recording
    experiment: Experiment
    body: Surface

    @cached_property
    def path(self) -> ProbeApproach | None:
        """Return the probe's path (`probe_path`); None where no probe is declared, or no pose was recorded."""
        probe, poses = self.experiment.probe, self.recording.poses
        return probe_path(poses, probe.shape, self.body, self.recording.start_ns) if probe and poses else None

    @cached_property
    def sag(self) -> float:
        """Say how far (m) the body's top may be from the given surface (`sag_bound`)."""
        return sag_bound(self.experiment, self.body)

    @cached_property
    def clear_limit(self) -> float:
        """Return the depth (m, negative) above which the probe may touch a body that sags: not where it presses the way
        that the body sags, which is away from it."""
        phantom = self.experiment.phantom
        scanned = np.array(phantom.scan_gravity) if phantom.configuration == "loaded" else np.zeros(3)
        pull = np.array(phantom.gravity) - scanned
        axes = Rotation.from_quat([pose.orientation_xyzw for pose in self.recording.poses]).apply([0.0, 0.0, 1.0])
        away = bool((axes @ pull > ALONG * np.linalg.norm(pull)).all()) and not self.experiment.timeline.release
        return -(CLEAR + (0.0 if away else self.sag))


def check_probe(probe: ProbeRecord) -> list[Finding]:
    """Findings about the probe's path; says when it touches and how deep it goes."""
    path, diagonal = probe.path, probe.body.diagonal
    if path is None:
        return []
    nearest, deepest = int(np.argmax(path.depths)), float(path.depths.max())
    if deepest < -FAR * diagonal:
        return [_too_far(probe.recording, probe.experiment, probe.body, deepest, diagonal)]
    # only near the body does the direction mean anything
    near = path.depths > max(deepest, -diagonal) - TOUCH
    if near.any() and float(np.median(path.facing[near])) < BACKWARDS:
        text = "the probe is upside down: its +z points away from the body"
        return [Finding("ERROR", text, "+z of the probe's frame points out of its face, into the tissue")]
    if deepest < -TOUCH:
        at = path.seconds[nearest]
        text = f"the probe never touches the body: it stays {-1e3 * deepest:.1f} mm away (at {at:.1f} s)"
        return [Finding("WARN", text, "check the probe's poses and its shape", doubts=True)]
    return [_contact(path, nearest, probe.sag)]


def _contact(path: ProbeApproach, deepest: int, sag: float) -> Finding:
    """Return when the probe touches and how deep it goes, as far as the given surface tells."""
    depth, at = f"{1e3 * max(float(path.depths[deepest]), 0.0):.1f} mm", f"{path.seconds[deepest]:.1f} s"
    if sag > TOUCH:
        text = f"deepest {depth} at {at} below the surface as given, which may sag by {1e3 * sag:.1f} mm"
        return Finding("NOTE", text)
    first = int(np.argmax(path.depths > 0.0)) if path.depths[deepest] > 0.0 else deepest
    return Finding("NOTE", f"first contact at {path.seconds[first]:.1f} s, deepest {depth} at {at}")


def sag_bound(experiment: Experiment, body: Surface) -> float:
    """Return how far (m) the body's top may be from the given surface: rho g H^2 / 2E of a column of its height under
    the difference of gravity and what acted during the scan; 0 where the same acted."""
    phantom = experiment.phantom
    scanned = np.array(phantom.scan_gravity) if phantom.configuration == "loaded" else np.zeros(3)
    pulls = [float(np.linalg.norm(np.array(phantom.gravity) - scanned))]
    if experiment.timeline.release:
        pulls.append(float(np.linalg.norm(scanned)))
    height = float((body.upper - body.lower).max())
    return phantom.density * max(pulls) * height**2 / (2.0 * phantom.material.youngs_modulus)


def _too_far(recording: Recording, experiment: Experiment, body: Surface, deepest: float, diagonal: float) -> Finding:
    assert experiment.probe is not None  # the caller's
    text = f"the probe is never nearer than {-deepest:.3g} m to the body"
    travel = float(np.ptp([pose.position for pose in recording.poses], axis=0).max())
    poses = [Pose(p.stamp_ns, 1e-3 * p.position, p.orientation_xyzw) for p in recording.poses]
    if travel > diagonal and float(probe_path(poses, experiment.probe.shape, body, 0).depths.max()) > -FAR * diagonal:
        return Finding("ERROR", text + ": its poses seem to be in millimetres", "record poses in metres")
    return Finding("ERROR", text, "check the frame and the unit of the poses")


def probe_path(poses: list[Pose], shape: ProbeShape, body: Surface, start_ns: int) -> ProbeApproach:
    """Return the probe's path past the body at some of the poses: the last and the first, the deepest and the first
    that touches are among them."""
    distance, face = SurfaceDistance(body), face_points(shape)
    rows = _nearest(poses, distance)
    path = _path_at(poses, rows, distance, face, body, start_ns)
    touching = np.flatnonzero(path.depths > 0.0)
    if not len(touching) or touching[0] == 0:
        return path
    between = np.setdiff1d(_evenly(rows[touching[0] - 1], rows[touching[0]]), rows)
    if not len(between):
        return path
    first, at = _path_at(poses, between, distance, face, body, start_ns), int(touching[0])
    return ProbeApproach(*(np.insert(getattr(path, f.name), at, getattr(first, f.name)) for f in fields(ProbeApproach)))


def _evenly(first: int, last: int, most: int = MOST_POSES) -> NDArray[np.int64]:
    """Return numbers between two, these among them, of which there are at most so many."""
    if last - first < most:
        return np.arange(first, last + 1)
    return np.unique(np.linspace(first, last, most).round().astype(np.int64))


def _nearest(poses: list[Pose], distance: SurfaceDistance) -> NDArray[np.int64]:
    """Return the numbers of some of the poses: spread evenly, and between them the one that is deepest in the body."""
    rows = _evenly(0, len(poses) - 1)
    if len(rows) == len(poses):
        return rows
    looked = _evenly(0, len(poses) - 1, MOST_LOOKS)
    depths = distance(np.array([poses[i].position for i in looked]))
    part = np.searchsorted(rows, looked, side="right")
    by_depth = np.lexsort((depths, part))
    deepest = by_depth[np.flatnonzero(np.diff(part[by_depth], append=part[by_depth[-1]] + 1))]
    return np.union1d(rows, looked[deepest])


def _path_at(
    poses: list[Pose], rows: NDArray[np.int64], distance: SurfaceDistance, face: Array, body: Surface, start_ns: int
) -> ProbeApproach:
    """Return the path at the poses number ``rows`` (n,)."""
    chosen = [poses[i] for i in rows]
    turns = Rotation.from_quat([pose.orientation_xyzw for pose in chosen])
    origins = np.array([pose.position for pose in chosen])
    points = np.array([turn.apply(face) for turn in turns]) + origins[:, None]
    depths = distance(points.reshape(-1, 3)).reshape(points.shape[:2]).max(axis=1)
    to_body = 0.5 * (body.lower + body.upper) - origins
    axes = turns.apply([0.0, 0.0, 1.0])
    length = np.maximum(np.linalg.norm(to_body, axis=1), 1e-12)
    facing = np.einsum("ij,ij->i", axes, to_body) / length
    return ProbeApproach(np.array([(p.stamp_ns - start_ns) * 1e-9 for p in chosen]), depths, facing)


def face_points(shape: ProbeShape) -> Array:
    """Points (n, 3) m of the probe's face, in the frame ``probe``."""
    if shape.box is not None:
        x, y = (np.linspace(-0.48, 0.48, 9) * side for side in shape.box[:2])
        grid = np.array(np.meshgrid(x, y)).reshape(2, -1).T
    elif shape.mesh is not None:
        import trimesh

        loaded: Any = trimesh.load(shape.mesh, force="mesh")
        vertices: Array = np.asarray(loaded.vertices, float)
        return np.asarray(vertices[vertices[:, 2] > vertices[:, 2].max() - 0.25 * np.ptp(vertices[:, 2])])
    else:
        radius = shape.cylinder[0] if shape.cylinder is not None else (shape.sphere or 0.0)
        rho, phi = np.meshgrid(
            radius * np.array([0.0, 0.33, 0.66, 0.96]), np.linspace(0, 2 * np.pi, 12, endpoint=False)
        )
        grid = np.column_stack([(rho * np.cos(phi)).ravel(), (rho * np.sin(phi)).ravel()])
        if shape.sphere is not None:
            z = np.sqrt(np.maximum(radius**2 - (grid**2).sum(axis=1), 0.0)) - radius
            return np.column_stack([grid, z])
    return np.column_stack([grid, np.zeros(len(grid))])
