"""fTetWild (Hu et al. 2020) in a process of its own, seeded: the one place that knows pytetwild.

    python -m livedeform.fem_node.mesh.mesher FOLDER PARENT

reads ``surface.npz`` in FOLDER and writes ``mesh.npz``. fTetWild draws the order in which it inserts triangles from
``std::random_device``, and keeps a second random generator for as long as its process lives. So one process makes one
mesh, on one thread, and `seed_random_device` puts numbers of a fixed sequence into the place of the device's: the same
surface gives the same tetrahedra. A crash of the mesher ends its own process only.
"""

from __future__ import annotations

import ctypes
import mmap
import os
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from livedeform.common.processes import end_with

DRAW = b"_ZNSt13random_device9_M_getvalEv"  # std::random_device::operator(), as libstdc++ names it
SEQUENCE = 2654435761  # Knuth's multiplicative hash (The Art of Computer Programming 3, 6.4) of 1, 2, 3 ...
PT_LOAD, PT_DYNAMIC = 1, 2
DT_PLTRELSZ, DT_STRTAB, DT_SYMTAB, DT_RELA, DT_RELASZ, DT_JMPREL = 2, 5, 6, 7, 8, 23
SURFACE, MESH = "surface.npz", "mesh.npz"


class Tetrahedra(NamedTuple):
    """``nodes`` (n, 3) m and ``tets`` (m, 4) as the mesher gave them; ``seeded``: the same surface gives them again."""

    nodes: NDArray[np.float64]
    tets: NDArray[np.int64]
    seeded: bool


class MesherError(Exception):
    """The mesher's process ended without a mesh; the text is the last that it said."""


def tetrahedra(
    vertices: NDArray[np.float64], triangles: NDArray[np.int64], element_size: float, envelope: float
) -> Tetrahedra:
    """Fill a surface (vertices (n, 3) m, triangles (k, 3)) with elements of ``element_size`` m.

    ``envelope`` m: how far the tetrahedra's boundary may lie from the surface. Raises `MesherError`.
    """
    with TemporaryDirectory() as scratch:  # fTetWild leaves its tracked surface where it stands
        folder = Path(scratch)
        diagonal = float(np.linalg.norm(np.ptp(vertices, axis=0)))
        np.savez(
            folder / SURFACE, vertices=vertices, triangles=triangles, size=element_size, epsilon=envelope / diagonal
        )
        command = [sys.executable, "-m", __name__, str(folder), str(os.getpid())]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, env=_environment())
        if done.returncode != 0 or not (folder / MESH).is_file():
            said = (done.stderr.strip() or done.stdout.strip()).splitlines()
            raise MesherError(said[-1] if said else f"it ended with code {done.returncode}")
        with np.load(folder / MESH) as made:
            return Tetrahedra(made["nodes"], made["tets"].astype(np.int64), bool(made["seeded"]))


def _environment() -> dict[str, str]:
    """This process's, with the package where this process found it."""
    here = str(Path(__file__).parents[3])
    known = [p for p in os.environ.get("PYTHONPATH", "").split(os.pathsep) if p]
    return {**os.environ, "PYTHONPATH": os.pathsep.join([here, *known]), "OMP_NUM_THREADS": "1"}


def main(folder: Path) -> None:
    """Mesh the surface in ``folder``."""
    import pytetwild

    seeded = seed_random_device(Path(pytetwild.PyfTetWildWrapper.__file__))
    with np.load(folder / SURFACE) as given:
        nodes, tets = pytetwild.pytetwild.tetrahedralize(
            given["vertices"],
            given["triangles"].astype(np.int32),
            edge_length_abs=float(given["size"]),
            epsilon=float(given["epsilon"]),
            num_threads=1,
            quiet=True,
        )
    np.savez(folder / MESH, nodes=nodes, tets=tets, seeded=seeded)


# -- the random device -----------------------------------------------------------------------------------------------

_kept: list[Callable[..., int]] = []  # what native code calls must not be collected


def seed_random_device(library: Path) -> bool:
    """Let the ``std::random_device`` of a loaded shared ``library`` give a fixed sequence; False where that cannot be.

    Its entry for the device in the table of imported functions (the global offset table of a 64-bit ELF file) is
    pointed at a function of ours.
    """
    library = library.resolve()
    base, offset = _address(library), _import_slot(library.read_bytes(), DRAW)
    if base is None or offset is None:
        return False
    number = 0

    def draw(_: int) -> int:
        nonlocal number
        number += 1
        return number * SEQUENCE & 0xFFFFFFFF

    function = ctypes.CFUNCTYPE(ctypes.c_uint, ctypes.c_void_p)(draw)
    slot, page = base + offset, mmap.PAGESIZE
    writable = ctypes.CDLL(None).mprotect(ctypes.c_void_p(slot - slot % page), page, mmap.PROT_READ | mmap.PROT_WRITE)
    if writable != 0:
        return False
    _kept.append(function)
    ctypes.c_void_p.from_address(slot).value = ctypes.cast(function, ctypes.c_void_p).value
    return True


def _address(library: Path) -> int | None:
    """Return where ``library`` was loaded in this process; None where the system does not tell."""
    maps = Path("/proc/self/maps")
    for line in maps.read_text().splitlines() if maps.is_file() else []:
        fields = line.split(maxsplit=5)
        if len(fields) == 6 and fields[5] == str(library) and int(fields[2], 16) == 0:
            return int(fields[0].split("-")[0], 16)
    return None


def _import_slot(elf: bytes, symbol: bytes) -> int | None:
    """The offset of the pointer to an imported function from the library's start (ELF-64 specification, 2.9 and 2.11);
    None if this is no such file, or if it does not import the ``symbol``."""
    if elf[:6] != b"\x7fELF\x02\x01":
        return None
    headers, size, count = *struct.unpack_from("<Q", elf, 32), *struct.unpack_from("<HH", elf, 54)
    segments = [struct.unpack_from("<IIQQQQQQ", elf, headers + k * size) for k in range(count)]
    dynamic = next((s for s in segments if s[0] == PT_DYNAMIC), None)
    if dynamic is None:
        return None

    def at(address: int) -> int:
        return next(
            int(s[2]) + address - int(s[3]) for s in segments if s[0] == PT_LOAD and s[3] <= address < s[3] + s[5]
        )

    tags = dict(struct.iter_unpack("<qQ", elf[dynamic[2] : dynamic[2] + dynamic[5]]))
    symbols, names = at(tags[DT_SYMTAB]), at(tags[DT_STRTAB])
    for table, length in ((DT_JMPREL, DT_PLTRELSZ), (DT_RELA, DT_RELASZ)):
        for k in range(tags.get(length, 0) // 24):
            offset, info, _ = struct.unpack_from("<QQq", elf, at(tags[table]) + 24 * k)
            name = names + struct.unpack_from("<I", elf, symbols + 24 * (info >> 32))[0]
            if elf[name : name + len(symbol) + 1] == symbol + b"\0":
                return int(offset)
    return None


if __name__ == "__main__":
    end_with(int(sys.argv[2]))
    main(Path(sys.argv[1]))
