"""How far the blind test's truth and `fem_node` are apart on the same body, the same poses and no undeclared effect.

    python -m benchmarks.truth_agreement [--thorough | --foreign]

On the standard experiment of the blind test: markers and force of both solvers at rest, under shallow, deep and off-
centre presses. With ``--thorough`` each solver is refined by itself, so that one sees which has converged where. With
``--foreign`` felupe's truth is held against it at rest, on two meshes. Pressed markers are compared by their
displacement from rest, as far as the cameras see them. All in mm; the force in per cent of its length.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from benchmarks.blind.cases import STANDARD
from benchmarks.blind.felupe_truth import FelupeTruth
from livedeform.closed_loop.inputs import coarse_enough
from livedeform.closed_loop.settings import Settings
from livedeform.common.types import Array
from livedeform.fem_node.contact.probe_shapes import make_shape
from livedeform.fem_node.element.element import ElementKind, make_space
from livedeform.fem_node.embedded_points import EmbeddedPoints
from livedeform.fem_node.items.protocol import Moment
from livedeform.fem_node.mesh.generate import tetrahedralise
from livedeform.fem_node.mesh.tet_mesh import TetMesh
from livedeform.fem_node.path.mechanics import Mechanics
from livedeform.fem_node.physics.record import MaterialSpec, Physics, Probe, Support
from livedeform.fem_node.simulator import SETTINGS
from livedeform.synthetic import scenario
from livedeform.synthetic.body_markers import aimed_rig, place_markers
from livedeform.synthetic.measuring.measure import behind
from livedeform.synthetic.rig import stereo_rig
from livedeform.synthetic.solved_motion import build_truth, build_world
from livedeform.synthetic.truth import hexmesh
from livedeform.synthetic.truth.physics import TruthPhysics
from livedeform.synthetic.truth.probe import TruthProbe
from livedeform.synthetic.truth.solver import TruthBody

DOWN = np.diag([1.0, -1.0, -1.0])
GRAVITY = np.array([0.0, 0.0, -9.81])
# name: (x, y, depth) mm below the resting top; each is reached from above, save the stroke
PRESSES = {
    "centre 1 mm": (0.0, 0.0, 1.0),
    "centre 3 mm": (0.0, 0.0, 3.0),
    "centre 7 mm": (0.0, 0.0, 7.0),
    "off centre 7 mm": (18.0, 6.0, 7.0),
    "corner 6 mm": (-18.0, -8.0, 6.0),
}
Pose = Callable[[float], Array]


@dataclass(frozen=True)
class Pressed:
    """``markers`` (k, m, 3) m and ``forces`` (k, 3) N at rest (first) and under the presses; seconds of CPU."""

    markers: Array
    forces: Array
    seconds: float


def pose(x: float, y: float, z: float) -> Array:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = DOWN, (x, y, z)
    return T


def presses(top: float) -> list[tuple[Array, Array]]:
    """Of each press the pose above the body and the pose at depth."""
    places = [(1e-3 * x, 1e-3 * y, 1e-3 * depth) for x, y, depth in PRESSES.values()]
    return [(pose(x, y, top + 0.004), pose(x, y, top - depth)) for x, y, depth in places]


def truth(elements: tuple[int, int, int], places: Array, top: float, step: float = 0.002) -> Pressed:
    """The truth with so many elements; ``places`` (m, 3) on the undeformed surface."""
    declared = STANDARD["declared"]
    mesh = hexmesh.block(STANDARD["body"]["size"], elements, STANDARD["body"]["focus"])
    physics = TruthPhysics(declared["youngs_modulus"], declared["poisson_ratio"], declared["density"])
    ((kind, size),) = STANDARD["probe"]["shape"].items()
    shape = TruthProbe(kind, tuple(np.atleast_1d(size).tolist()), STANDARD["probe"]["edge_radius"])
    body = TruthBody(mesh, physics, shape)
    faces, weights = on_surface(mesh, places)

    def markers(x: Array) -> Array:
        found: Array = np.einsum("pa,pad->pd", weights, x[mesh.faces[faces]])
        return found

    began = time.process_time()
    points, forces = [markers(body.rest().x)], [np.zeros(3)]
    for above, deep in presses(top):
        body.step(above, 0.0, step)
        state = body.step(deep, 0.0, step)
        points.append(markers(state.x))
        forces.append(state.force)
        body.step(above, 0.0, step)
    body.factors.close()
    return Pressed(np.stack(points), np.stack(forces), time.process_time() - began)


def at_rest(body: FelupeTruth | TruthBody, places: Array) -> Array:
    """Where the places on the undeformed surface (m, 3) are at rest."""
    x = body.rest() if isinstance(body, FelupeTruth) else body.rest().x
    faces, weights = on_surface(body.mesh, places)
    return np.asarray(np.einsum("pa,pad->pd", weights, x[body.mesh.faces[faces]]))


def on_surface(mesh: hexmesh.HexMesh, places: Array) -> tuple[Array, Array]:
    """Face (m,) and weights (m, 9) of undeformed places on the boundary of a block (its faces are rectangles)."""
    corners = mesh.nodes[mesh.faces]
    low, high = corners.min(axis=1), corners.max(axis=1)
    faces, weights = [], []
    for p in places:
        off = np.maximum(np.maximum(low - p, p - high), 0.0).max(axis=1)
        f = int(np.argmin(off))
        c = corners[f]
        local = np.zeros(2)
        for _ in range(30):  # mid-side nodes are not in the middle where the mesh is graded
            here, slope = hexmesh.face_shape(local[None])[0], hexmesh.face_gradient(local[None])[0]
            local += np.linalg.lstsq((slope @ c).T, p - here @ c, rcond=None)[0]
        faces.append(f)
        weights.append(hexmesh.face_shape(local[None])[0])
    return np.array(faces), np.stack(weights)


def model(mesh: TetMesh, kind: ElementKind, places: Array, top: float, step: float = 0.002) -> Pressed:
    """`fem_node` on a mesh, stepped like the truth."""
    declared = STANDARD["declared"]
    ((shape_kind, size),) = STANDARD["probe"]["shape"].items()
    shape = make_shape(shape_kind, tuple(np.atleast_1d(size).tolist()), STANDARD["probe"]["edge_radius"])
    physics = Physics(
        MaterialSpec("neo_hookean", declared["youngs_modulus"], declared["poisson_ratio"]),
        density=declared["density"],
        supports=(Support(lambda p: p[:, 2] < 1e-3),),
        probe=Probe(shape),
    )
    space = make_space(mesh, kind)
    body = Mechanics(space, physics, settings=SETTINGS)
    carried = EmbeddedPoints(space, places, np.zeros(len(places), bool))
    began = time.process_time()
    body.advance(Moment(0.0, np.inf, GRAVITY))
    points, forces = [carried.positions(body.u)], [np.zeros(3)]
    for above, deep in presses(top):
        for s in np.linspace(0.0, 1.0, 1 + int(np.ceil(np.linalg.norm(deep - above) / step))):
            body.advance(Moment(0.0, np.inf, GRAVITY, pose=(1.0 - s) * above + s * deep))
        points.append(carried.positions(body.u))
        forces.append(body.wrench()[0])
        body.advance(Moment(0.0, np.inf, GRAVITY, pose=above))
    return Pressed(np.stack(points), np.stack(forces), time.process_time() - began)


def places_of() -> tuple[Array, float]:
    """The markers' places on the unloaded body, and the height of its top at rest."""
    spec = scenario.load({"name": "agreement", "recordings": {}, **STANDARD})
    world, body, _ = build_truth(spec)
    rest = body.rest()
    markers = place_markers(spec, body.mesh, rest.x, aimed_rig(spec, rest.x))
    body.factors.close()
    surface = [k == "surface" for k in markers.kinds]
    return markers.places(world.mesh.nodes)[surface], float(rest.x[:, 2].max())


def shipped(size: float) -> TetMesh:
    """The tetrahedral mesh that comes with an experiment of the blind test, with another element size."""
    mesh = hexmesh.block(STANDARD["body"]["size"], STANDARD["body"]["elements"], STANDARD["body"]["focus"])
    weights, faces, triangles = hexmesh.surface_triangles(mesh, 3)
    return tetrahedralise(np.einsum("pa,pad->pd", weights, mesh.nodes[mesh.faces[faces]]), triangles, size)


def seen(markers: Array, top: float) -> Array:
    """(k, m) bool: the markers that the probe does not hide from either camera, at rest and under each press."""
    views = [T for _, T in stereo_rig(np.array([0.0, 0.0, 0.55 * top])).views()]
    eyes = [-T[:3, :3].T @ T[:3, 3] for T in views]
    ((kind, size),) = STANDARD["probe"]["shape"].items()
    shape = TruthProbe(kind, tuple(np.atleast_1d(size).tolist()), STANDARD["probe"]["edge_radius"])
    out = np.ones(markers.shape[:2], bool)
    for k, (_, deep) in enumerate(presses(top), start=1):
        out[k] = ~np.any([behind(markers[k], eye, deep, shape) for eye in eyes], axis=0)
    return out


def report(name: str, a: Pressed, b: Pressed, top: float) -> None:
    """What ``a`` differs from ``b``, of the markers that the cameras see."""
    print(f"{name} ({a.seconds:.0f} s)")
    d = 1e3 * (a.markers - b.markers)
    visible = seen(b.markers, top)
    print(f"  {'at rest':18s} rms {rms(d[0]):.4f} mm, worst {np.linalg.norm(d[0], axis=1).max():.4f}")
    for k, press in enumerate(PRESSES, start=1):
        e = (d[k] - d[0])[visible[k]]
        moved = 1e3 * np.linalg.norm(b.markers[k] - b.markers[0], axis=1)[visible[k]]
        force = 100 * np.linalg.norm(a.forces[k] - b.forces[k]) / np.linalg.norm(b.forces[k])
        print(f"  {press:18s} rms {rms(e):.4f} mm, worst {np.linalg.norm(e, axis=1).max():.4f} of {moved.max():.2f}, "
              f"rms over rms motion {100 * rms(e) / np.sqrt((moved**2).mean() / 3):.2f} %, force {force:.2f} %, "
              f"Fz {b.forces[k][2]:.4f} N, difference {1e3 * (a.forces[k] - b.forces[k]).round(6)} mN")  # fmt: skip


def rms(d: Array) -> float:
    """Per coordinate."""
    return float(np.sqrt((d**2).mean()))


def against_foreign(places: Array) -> None:
    """Print how far felupe's truth is at rest from the truth, and that from a coarser one, mm."""
    worlds = {}
    for elements in ((10, 8, 6), (8, 6, 4), (8, 6, 5)):
        body = {**STANDARD["body"], "elements": list(elements)}
        worlds[elements] = build_world(scenario.load({"name": "agreement", "recordings": {}, **STANDARD, "body": body}))
    fine = at_rest(TruthBody(worlds[10, 8, 6][0].mesh, worlds[10, 8, 6][0].physics), places)
    foreign = [(FelupeTruth, elements) for elements in ((8, 6, 5), (10, 8, 6))]
    for kind, elements in ((TruthBody, (8, 6, 4)), *foreign):
        world, shape = worlds[elements]
        body = FelupeTruth(world, shape) if kind is FelupeTruth else TruthBody(world.mesh, world.physics)
        d = 1e3 * (at_rest(body, places) - fine)
        print(f"{kind.__name__} {elements} at rest against TruthBody (10, 8, 6): rms {rms(d):.4f} mm, "
              f"worst {np.linalg.norm(d, axis=1).max():.4f}", flush=True)  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--thorough", action="store_true")
    which.add_argument("--foreign", action="store_true")
    options = parser.parse_args()
    thorough = options.thorough
    places, top = places_of()
    if options.foreign:
        against_foreign(places)
        return
    elements = tuple(STANDARD["body"]["elements"])
    used = truth(elements, places, top)
    own = model(
        coarse_enough(shipped(STANDARD["declared"]["element_size"]), Settings().sampling.mesh_vertices),
        "p2p0",
        places,
        top,
    )
    report("fem_node as the loop uses it, against the truth", own, used, top)
    if not thorough:
        return
    fine = truth((16, 12, 7), places, top)
    report("truth as used against truth 16 x 12 x 7", used, fine, top)
    report("fem_node as the loop uses it, against truth 16 x 12 x 7", own, fine, top)
    for size in (0.011, 0.009):
        for kind in ("p2p0", "p2p1"):
            report(f"fem_node {kind}, elements of {1e3 * size:g} mm, against truth 16 x 12 x 7",
                   model(shipped(size), kind, places, top), fine, top)  # fmt: skip


if __name__ == "__main__":
    main()
