"""Meshes kept by the content that they were made of."""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from livedeform.common.errors import MeshError
from livedeform.common.types import Array
from livedeform.fem_node.mesh.tet_mesh import IntArray, TetMesh


def default_cache_dir() -> Path:
    """``LIVEDEFORM_CACHE``, else the user's cache folder."""
    chosen = os.environ.get("LIVEDEFORM_CACHE")
    if chosen:
        return Path(chosen) / "meshes"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "livedeform" / "meshes"


def content_key(vertices: Array, triangles: IntArray, parameters: Mapping[str, object]) -> str:
    """A hash of the surface's numbers and of everything that the result depends on."""
    digest = hashlib.sha256(json.dumps(parameters, sort_keys=True).encode())
    digest.update(np.ascontiguousarray(vertices, "<f8").tobytes())
    digest.update(np.ascontiguousarray(triangles, "<i8").tobytes())
    return digest.hexdigest()[:32]


def load(folder: Path, key: str) -> tuple[TetMesh, tuple[str, ...]] | None:
    """The mesh kept under ``key`` and its repairs; None if there is none, or if it is damaged."""
    path = folder / f"{key}.npz"
    try:
        with np.load(path) as data:
            return TetMesh(data["nodes"], data["tets"]), tuple(str(r) for r in data["repairs"])
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile, MeshError):
        return None


def save(folder: Path, key: str, mesh: TetMesh, repairs: tuple[str, ...]) -> bool:
    """Keep a mesh, written aside and moved, so that nobody reads half a file; False where that is forbidden."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(suffix=".npz", dir=folder)
        with os.fdopen(handle, "wb") as file:
            np.savez_compressed(file, nodes=mesh.nodes, tets=mesh.tets, repairs=np.array(repairs, dtype=str))
        os.replace(name, folder / f"{key}.npz")
    except OSError:
        return False
    return True
