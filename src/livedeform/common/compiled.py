"""numba's `njit`, whose kept kernels are checked before they are used.

numba unpickles and runs what lies in its cache; a file that was damaged there ends the process, or worse. So each file
ends with a checksum of what is before it (which unpickling does not read), and one that does not is compiled again.
numba compiles a kernel again when its own file has changed, and does not look at what it takes from other files:
kernels that it calls, and numbers, which are compiled into it. So those are part of what it is kept for.
"""

from __future__ import annotations

import contextlib
import warnings
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numba
from numba.core.caching import IndexDataCacheFile
from numba.core.dispatcher import Dispatcher

MARK = b"crc32"


def _njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorate a kernel as `numba.njit` does, with the same ``options``; other threads of Python run beside it."""

    def decorate(function: Callable[..., Any]) -> Any:
        kernel = numba.njit(nogil=True, **options)(function)
        if options.get("cache"):
            kernel._cache._cache_file.__class__ = _CheckedFiles
            kernel._cache._cache_file._source_stamp = _stamp(function, kernel._cache._cache_file._source_stamp)
        return kernel

    return decorate


njit: Any = _njit  # numba types its kernels itself


def _stamp(function: Callable[..., Any], own: Any) -> tuple[Any, int]:
    """Return what a kernel is kept for: the stamp of its ``own`` file, and a checksum of what it takes from others that
    is known when it is defined (what is defined later is in its own file)."""
    taken = []
    for name in sorted(function.__code__.co_names):
        value = function.__globals__.get(name)
        if isinstance(value, Dispatcher):
            cache = getattr(getattr(value, "_cache", None), "_cache_file", None)
            taken.append((name, cache._source_stamp if cache is not None else value.py_func.__code__.co_code))
        elif isinstance(value, bool | int | float | str | tuple):
            taken.append((name, value))
    return own, zlib.crc32(repr(taken).encode())


class _CheckedFiles(IndexDataCacheFile):
    """The index and the data of one kernel."""

    def _load_index(self) -> Any:
        return super()._load_index() if _is_whole(Path(self._index_path)) else {}

    def _load_data(self, name: str) -> Any:
        path = Path(self._data_path(name))
        if not _is_whole(path):
            raise FileNotFoundError(path)  # by which numba knows that it is to be compiled
        return super()._load_data(name)

    @contextlib.contextmanager
    def _open_for_write(self, filepath: str) -> Iterator[Any]:
        with super()._open_for_write(filepath) as file:
            yield file
            file.flush()
            file.write(_checksum(Path(file.name).read_bytes()))


def _checksum(data: bytes) -> bytes:
    return MARK + zlib.crc32(data).to_bytes(4, "little")


def _is_whole(path: Path) -> bool:
    """Return whether a kept file is there and as it was written; one that is not is removed, and said."""
    try:
        data = path.read_bytes()
    except OSError:
        return False
    size = len(data) - len(_checksum(b""))
    if data[max(size, 0) :] == _checksum(data[: max(size, 0)]):
        return True
    warnings.warn("kernels that were kept are damaged, or of an older version: compiled again", stacklevel=2)
    with contextlib.suppress(OSError):
        path.unlink()
    return False
