"""Estimate how far the model is from its own limit of fine elements: the error that no parameter of it can take away.

The declared model is solved on a refined mesh of the same body. Where a probe presses, that mesh has smaller elements
there, and where a bond ends (`pressed_more_finely`): what it tells differently is taken off the residuals, moment by
moment, and a part of it stays as error (``remains``). Where nothing presses only the moments at which the body is
deformed most are solved, on a mesh with all elements halved (``halved_all``) where that is small enough to be quick.
Else it has larger elements (``coarser``) as far as the mesher can: two meshes of one size tell the part of the error
that is theirs alone times 1.4, and a coarser one tells at least half of the finer one's whole error (Richardson 1911;
Roache 1994), but of a coarse mesh many times too much: of a beam of 5 x 3 x 3 cells 9 % where it is wrong by 0.7 %.

An effect changes the error of the elements with the body: `refined_effects` works the difference out again.

Where the probe rubs every moment has its whole path before it, on both meshes; without its friction a body may be
somewhere else altogether (a tall soft one sways). One that pulls would take the refined mesh many minutes: both meshes
are pressed by a probe that neither rubs nor sticks then (`Body.slippery`). All of the difference is allowed for in
both cases (``remains_rubbing``). The numbers are `settings.DiscretisationSettings`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from livedeform.closed_loop.candidates import Candidate
from livedeform.closed_loop.evidence.observation import Observation, poses_at
from livedeform.closed_loop.forward import Correction, Run, dictionary_columns, difference, first_key, keys_of
from livedeform.closed_loop.model.fem_model import Body
from livedeform.closed_loop.model.refined_effects import Anew, Known, spread
from livedeform.closed_loop.model.workers import simulate_each
from livedeform.closed_loop.settings import DiscretisationSettings
from livedeform.common.errors import MeshError
from livedeform.common.frames import transform
from livedeform.common.types import Array
from livedeform.fem_node.mesh.generate import remeshed
from livedeform.fem_node.mesh.tet_mesh import TetMesh
from livedeform.fem_node.physics.memory import memory_of, pulls
from livedeform.fem_node.physics.record import Physics
from livedeform.fem_node.refinement import flatness, pressed_facets, refined, with_finer_edges

# rms length of an error vector over that of the motion, per unit of `noise.ModelErrors.relative`: three axes of an
# error of each marker, and three of a field that is linear over the body
PER_UNIT = 2.7


@dataclass(frozen=True)
class Accuracy:
    """``relative``, ``local`` (m,), ``absolute`` m and ``force_relative`` as `noise.ModelErrors` has them, from ``n``
    moments; ``offset`` (3,) m, in the probe's frame: how far off its place the probe seems to press; the
    ``correction`` that they remain after, and the ``vertices`` of the refined mesh; ``unsolved`` moments have an answer
    on the own mesh and none on that one."""

    relative: float
    local: Array
    absolute: float
    force_relative: float
    n: int
    offset: Array
    correction: Correction = field(default_factory=Correction)
    vertices: int = 0
    unsolved: int = 0
    anew: Anew | None = None

    def times(self, share: float) -> Accuracy:
        """Return it with a share of its errors, but for the shape at rest."""
        sizes = {name: share * getattr(self, name) for name in ("relative", "local", "force_relative", "offset")}
        return replace(self, **sizes)


def accuracy(
    body: Body,
    fitted: Sequence[Observation],
    held_out: Sequence[Observation],
    offset: Candidate | None = None,
    processes: int = 2,
    *,
    settings: DiscretisationSettings,
) -> Accuracy | None:
    """Return the declared model's; None where no other mesh can be made, or nothing converges. Correction and all, if a
    probe presses: then the moments that are ``held_out`` are solved as well. On so many ``processes``."""
    declared = body.physics([])
    body = body.slippery() if pulls(declared.probe) else body
    deep = [np.isin(np.arange(o.n_moments), o.deepest(settings.most_presses)) for o in fitted]
    few = [o.take(keep) for o, keep in zip(fitted, deep, strict=True)]
    asked, columns = [*fitted, *held_out], [] if offset is None else dictionary_columns([offset])
    under = pressed(body, asked, settings)
    if not under.any():
        return _where_nothing_presses(body, few, processes, settings)
    second = [Body(replace(body.setting, mesh=pressed_more_finely(body, o, settings))) for o in asked]
    remembers = bool(memory_of(body.physics([])).path_dependent)  # then it has to go the whole path to the deep moments
    own = simulate_each([body] * len(asked), [], asked, columns if remembers else (), processes)
    for better in second:
        better.start_from(body)
    told = where_solved(second, asked, own, processes)
    fine = _at_each(own, deep) if remembers else simulate_each([body] * len(fitted), [], few, columns, processes)
    found = compared(few, fine, _at_each(told, deep), settings)
    if found is None:
        return None
    known = {first_key(o): Known(body, run) for o, body, run in zip(asked, second, told, strict=True)}
    remains = settings.remains_rubbing if memory_of(declared).rubs else settings.remains
    found = found.times(remains)
    return replace(
        found,
        offset=np.hypot(found.offset, [0.0, 0.0, settings.flat * flatness(body.setting.mesh, under)]),
        correction=(correction := everywhere(difference(asked, own, told), asked, own)),
        vertices=max(len(b.setting.mesh.nodes) for b in second),
        unsolved=sum(int((answered(one) & ~answered(two)).sum()) for one, two in zip(own, told, strict=True)),
        anew=Anew(body, known, correction, settings, pulls(declared.probe), processes),
    )


def _where_nothing_presses(
    body: Body, fitted: Sequence[Observation], processes: int, settings: DiscretisationSettings
) -> Accuracy | None:
    mesh = body.setting.mesh
    other = halved_all(mesh, settings) or coarser(mesh, settings)
    if other is None:
        return None
    own = simulate_each([body] * len(fitted), [], fitted, (), processes)
    told = simulate_each([Body(replace(body.setting, mesh=other)) for _ in fitted], [], fitted, (), processes)
    found = compared(fitted, own, told, settings)
    return None if found is None else replace(found, vertices=len(other.nodes))


def where_solved(
    bodies: Sequence[Body], observations: Sequence[Observation], own: Sequence[Run], processes: int
) -> list[Run]:
    """Return the runs of the declared ``bodies`` at the moments at which their ``own`` runs have an answer; NaN at the
    others, of which a finer mesh tells no difference."""
    keep = [answered(run) for run in own]
    for moments in keep:
        moments[0] = True  # from where it begins
    found = simulate_each(bodies, [], [o.take(k) for o, k in zip(observations, keep, strict=True)], (), processes)
    return [run.at(moments) for run, moments in zip(found, keep, strict=True)]


def answered(run: Run) -> NDArray[np.bool_]:
    """Return the moments (k,) of a run that have an answer."""
    return np.asarray(np.isfinite(run.points).all(axis=(1, 2)))


def everywhere(correction: Correction, observations: Sequence[Observation], own: Sequence[Run]) -> Correction:
    """Return the correction with that of the moment whose motion is most alike, in proportion to the motion in the
    model's ``own`` runs, where the refined mesh has no answer (`spread`)."""
    keys = [key for o in observations for key in keys_of(o)]
    shape = observations[0].points.shape[1:]
    nothing = Correction({key: np.zeros(shape) for key in keys}, {key: np.zeros(3) for key in keys})
    return spread(correction, nothing, observations, own)


def _at_each(runs: Sequence[Run], keep: Sequence[np.ndarray]) -> list[Run]:
    """Return the kept moments (k,) of the first runs; those of what is held out come after."""
    return [run.take(moments) for run, moments in zip(runs, keep, strict=False)]


def compared(
    pressed: Sequence[Observation], fine: Sequence[Run], other: Sequence[Run], settings: DiscretisationSettings
) -> Accuracy | None:
    """Return the error that the difference of two meshes' runs tells; ``fine`` with the columns of the probe's offset,
    or without any."""
    rest2 = force2 = load2 = 0.0
    n_markers = pressed[0].points.shape[1]
    offset2, error2, motion2 = np.zeros(3), np.zeros(n_markers), np.zeros(n_markers)
    n_rest = n = 0
    for few, one, two in zip(pressed, fine, other, strict=True):
        good = np.asarray(np.isfinite(one.points + two.points).all(axis=(1, 2)))
        if not good[0]:
            continue
        d = two.points - one.points
        rest2, n_rest = rest2 + float((d[0] ** 2).sum()), n_rest + d[0].size
        for k in np.flatnonzero(good)[1:]:
            seen = np.isfinite(few.points[k]).all(axis=1)
            error2 += np.where(seen, ((d[k] - d[0]) ** 2).sum(axis=1), 0.0)
            motion2 += np.where(seen, ((one.points[k] - one.points[0]) ** 2).sum(axis=1), 0.0)
            n += 1
            if one.d_points.shape[-1]:
                like = np.linalg.lstsq(
                    one.d_points[k][seen].reshape(-1, 3), (d[k] - d[0])[seen].reshape(-1), rcond=None
                )
                offset2 += like[0] ** 2
            if one.forces is not None and two.forces is not None:
                force2 += float(((two.forces[k] - one.forces[k]) ** 2).sum())
                load2 += float((one.forces[k] ** 2).sum())
    if n_rest == 0:
        return None
    relative = float(np.sqrt(error2.sum() / motion2.sum())) / PER_UNIT if motion2.any() else 0.0
    local = np.sqrt(np.divide(error2 / 3.0, motion2, out=np.zeros_like(error2), where=motion2 > 1e-10))
    force = float(np.sqrt(force2 / load2)) if load2 > 0.0 else 0.0
    more = upper(n, settings)
    rest = float(np.sqrt(rest2 / n_rest))
    return Accuracy(more * relative, more * local, rest, more * force, n, more * np.sqrt(offset2 / max(n, 1)))


def upper(n: int, settings: DiscretisationSettings) -> float:
    """Find the upper bound of an rms over its estimate from ``n`` presses, each with a few independent errors."""
    freedom = settings.patterns * max(n, 1)
    return float(np.sqrt(freedom / chdtri(freedom, 1.0 - settings.tail)))


def pressed(body: Body, observations: Sequence[Observation], settings: DiscretisationSettings) -> NDArray[np.bool_]:
    """Return which boundary triangles (k,) of its mesh the probe presses at the deepest moments."""
    return pressed_facets(
        body.setting.mesh, body.physics([]), _deepest_poses(body, observations, settings.most_presses)
    )


def pressed_more_finely(body: Body, o: Observation, settings: DiscretisationSettings) -> TetMesh:
    """Return the body's mesh with smaller elements where its bond ends, and where the probe presses at the deepest
    moments of a recording."""
    setting = body.setting
    poses = _deepest_poses(body, [o], settings.most_presses)
    return with_finer_edges(setting.mesh, setting.element, body.physics([]), poses, settings.halved)


def _deepest_poses(body: Body, observations: Sequence[Observation], most: int) -> list[Array | None]:
    """Return the probe's poses (4, 4) at the deepest moments."""
    physics, out = body.physics([]), []
    for o in observations:
        poses = pose_matrices(physics, o)
        out += [poses[i] for i in o.deepest(most)]
    return out


def pose_matrices(physics: Physics, o: Observation) -> list[Array | None]:
    """Return T_phantom_probe (4, 4) at the key moments, with the probe's offsets in place and time."""
    if physics.probe is None or not len(o.path):
        return [None] * o.n_moments
    position, rotation = poses_at(o.path, o.stamps_ns, physics.probe.time_offset)
    R = rotation.as_matrix()
    return [transform(r, p + r @ physics.probe.offset) for r, p in zip(R, position, strict=True)]


def halved_all(mesh: TetMesh, settings: DiscretisationSettings) -> TetMesh | None:
    """Return the same body with all elements halved until edges are half as long; None where that has more than
    ``most_vertices``."""
    for _ in range(3):  # an element is halved along one of its edges at a time
        mesh = refined(mesh, np.arange(len(mesh.tets)))
        if len(mesh.nodes) > settings.most_vertices:
            return None
    return mesh


def coarser(mesh: TetMesh, settings: DiscretisationSettings) -> TetMesh | None:
    """Return the same body with elements ``coarser`` times as large; None where the mesher cannot make it of fewer than
    ``largest`` times as many vertices."""
    edges: Array = mesh.nodes[mesh.edges[:, 0]] - mesh.nodes[mesh.edges[:, 1]]
    size = settings.coarser * float(np.median(np.linalg.norm(edges, axis=1)))
    try:
        coarse = remeshed(mesh, size, {"accuracy": size})
    except MeshError:
        return None
    return coarse if len(coarse.nodes) <= settings.largest * len(mesh.nodes) else None
