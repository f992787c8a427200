"""Meshes kept by the content that they were made of."""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from livedeform.common.own_folder import is_own, own_folder
from livedeform.common.types import Array
from livedeform.fem_node.mesh.repair.record import Repair, from_json, to_json
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


class Kept(NamedTuple):
    """A mesh as it was made: ``record`` of the surface's repairs; ``seeded``: whether it is made again the same."""

    mesh: TetMesh
    record: tuple[Repair, ...]
    seeded: bool


def load(folder: Path, key: str, tell: Callable[[str], None] = lambda text: None) -> Kept | None:
    """The mesh kept under ``key``; None if there is none, or if it is damaged, which is told.

    Whole is a file whose mesh and record have the hash that was written with them.
    """
    path = folder / f"{key}.npz"
    if not path.is_file():
        return None
    if not is_own(folder):
        tell(f"the kept mesh {path} is not used: the folder is another user's, or everybody may write there")
        return None
    try:
        with np.load(path, allow_pickle=False) as data:
            kept = Kept(TetMesh(data["nodes"], data["tets"]), from_json(str(data["record"])), bool(data["seeded"]))
            if str(data["hash"]) == _content(kept):
                return kept
            fault = "its content has another hash than it was written with"
    except Exception as error:  # whatever a torn or flipped file makes numpy, zipfile, zlib and json raise
        fault = type(error).__name__
    tell(f"the kept mesh {path} is damaged ({fault}) and is made again")
    return None


def save(folder: Path, key: str, mesh: TetMesh, record: Sequence[Repair] = (), *, seeded: bool = True) -> bool:
    """Keep a mesh, written aside and moved, so that nobody reads half a file; False where that is forbidden."""
    kept = Kept(mesh, tuple(record), seeded)
    name = ""
    try:
        if not own_folder(folder):
            return False
        handle, name = tempfile.mkstemp(suffix=".part", dir=folder)
        with os.fdopen(handle, "wb") as file:
            np.savez_compressed(
                file,
                nodes=mesh.nodes,
                tets=mesh.tets,
                record=np.array(to_json(kept.record)),
                seeded=np.array(seeded),
                hash=np.array(_content(kept)),
            )
        os.replace(name, folder / f"{key}.npz")
    except OSError:
        if name:
            Path(name).unlink(missing_ok=True)
        return False
    return True


def _content(kept: Kept) -> str:
    """A hash of all that is kept."""
    said = f"{kept.mesh.digest} {to_json(kept.record)} {kept.seeded}"
    return hashlib.sha256(said.encode()).hexdigest()[:32]
