"""Write what is declared of a scenario: the experiment's folder."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from livedeform.common.experiment.markers_file import write_markers
from livedeform.common.experiment.schema import Markers
from livedeform.common.types import Array
from livedeform.synthetic import writing
from livedeform.synthetic.body_markers import BodyMarkers
from livedeform.synthetic.record import START_NS
from livedeform.synthetic.rig import Rig
from livedeform.synthetic.true_effects import World
from livedeform.synthetic.truth import hexmesh

Mesher = Callable[[Array, NDArray[np.int64], float, Path], None]
"""Writes a mesh of what a surface (vertices (n, 3) m, triangles (k, 3)) encloses, with elements of a size (m)."""

SCAN_SAG, MOST_CUTS = 1.2e-5, 5  # m that flat triangles may lie below a curved surface: those of 2 mm at 45 mm radius


def write_experiment(
    folder: Path, spec: Mapping[str, Any], mesh: hexmesh.HexMesh, scan: Array, markers: BodyMarkers, rig: Rig,
    world: World, tell: Callable[[str, float | None], None],
    mesher: Mesher | None,
) -> None:  # fmt: skip
    """Write the experiment's folder: the scan, the markers at rest, the cameras, and what is declared of them."""
    declared = spec["declared"]
    weights, faces, triangles = hexmesh.surface_triangles(mesh, _cuts(mesh, scan))
    surface = np.einsum("pa,pad->pd", weights, scan[mesh.faces[faces]])
    surface[np.abs(surface[:, 2]) < 1e-9, 2] = 0.0
    writing.write_surface(folder / "phantom.stl", surface, triangles)
    kinds = np.array(markers.kinds)
    ids = np.arange(1, len(kinds) + 1).astype(np.uint32)
    write_markers(folder / "markers.csv", Markers(ids, markers.places(scan), np.full(len(kinds), np.nan), kinds))
    shape = {"surface": "phantom.stl"}
    if declared["ship_mesh"] and mesher is not None:
        tell("meshing for the shipped experiment", None)
        mesher(surface, triangles, float(declared["element_size"]), folder / "phantom.vtu")
        shape = {"mesh": "phantom.vtu"}
    phantom = _phantom(spec, mesh, scan, shape)
    probe = spec["probe"]
    document: dict[str, Any] = {
        "version": 1,
        "name": spec["name"],
        "phantom": phantom,
        "probe": {
            "shape": probe["shape"],
            **({} if "sphere" in probe["shape"] else {"edge_radius": float(probe["edge_radius"])}),
            "contact": {"formulation": "lagrange", "friction": float(probe["friction"])},
        },
    }
    writing.write_rig(folder, rig)
    document["stereo"] = {"left": "left.yaml", "right": "right.yaml", "pose": "registered"}
    if spec["temperature"] is not None:  # whoever measures it knows it
        document["timeline"] = {"clock_start_ns": START_NS}
        document["temperature"] = {key: spec["temperature"][key] for key in ("time", "value", "reference")}
    document["effects"] = list(declared["effects"])
    document["thresholds"] = {"error": float(spec["threshold"])}
    writing.write_yaml(folder / "experiment.yaml", document)


def _cuts(mesh: hexmesh.HexMesh, scan: Array) -> int:
    """Tell how often each face edge is cut for a scan of the surface: a chord over the part 1/n of a quadratic edge
    sags by |a - 2 b + c| / (2 n^2), of its nodes a, b, c."""
    grid = scan[mesh.faces].reshape(-1, 3, 3, 3)
    bent = [grid[:, 0] - 2.0 * grid[:, 1] + grid[:, 2], grid[:, :, 0] - 2.0 * grid[:, :, 1] + grid[:, :, 2]]
    most = float(np.linalg.norm(bent, axis=-1).max())
    return int(np.clip(np.ceil(np.sqrt(most / (2.0 * SCAN_SAG))), 1, MOST_CUTS))


def _phantom(spec: Mapping[str, Any], mesh: hexmesh.HexMesh, scan: Array, shape: Mapping[str, str]) -> dict[str, Any]:
    """Return the experiment's ``phantom`` section, as declared."""
    declared = spec["declared"]
    write_lesions = [
        {"name": lesion["name"], "centre": _at_node(mesh, scan, lesion["centre"]), "diameter": lesion["diameter"]}
        for lesion in spec["lesions"]
    ]
    material = {
        "model": "neo_hookean",
        "youngs_modulus": float(declared["youngs_modulus"]),
        "poisson_ratio": float(declared["poisson_ratio"]),
    }
    sigmas = dict(declared["sigmas"])
    material |= {f"{k}_sigma": float(sigmas.pop(k)) for k in ("youngs_modulus", "poisson_ratio") if k in sigmas}
    phantom: dict[str, Any] = {
        **shape,
        "unit": "m",
        "configuration": declared["configuration"],
        "element_size": float(declared["element_size"]),
        "density": float(declared["density"]),
        **{f"{k}_sigma": float(v) for k, v in sigmas.items()},
        "material": material,
        "gravity": [0.0, 0.0, -9.81],
        "support": [{"region": {"below_z": 0.001}, "type": "fixed"}],
        "markers": "markers.csv",
    }
    if write_lesions:
        phantom["lesions"] = write_lesions
    return phantom


def _at_node(mesh: hexmesh.HexMesh, scan: Array, centre: list[float]) -> list[float]:
    node = int(np.argmin(np.linalg.norm(mesh.nodes - np.array(centre), axis=1)))
    return [round(float(v), 6) for v in scan[node]]
