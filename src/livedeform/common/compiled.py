"""numba's `njit`, whose kept kernels are checked before they are used.

numba unpickles and runs what lies in its cache; a file that was damaged there ends the process, or worse. So each file
ends with a checksum of what is before it (which unpickling does not read), and one that does not is compiled again.
numba compiles a kernel again when its own file has changed, and does not look at what it takes from other files:
kernels that it calls, and numbers and arrays, which are compiled into it. So those are part of what it is kept for.
They are asked for when a kernel is first called, as numba does: all that its file defines is known by then.
"""

from __future__ import annotations

import contextlib
import hashlib
import sys
import warnings
import zlib
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

import numba
import numpy as np
from numba.core.caching import IndexDataCacheFile

MARK = b"crc32"
DIGEST = "digest"  # attribute of a kernel's function: of its file, when it was defined


def _njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorate a kernel as `numba.njit` does, with the same ``options``; other threads of Python run beside it."""

    def decorate(function: Callable[..., Any]) -> Any:
        kernel = numba.njit(nogil=True, **options)(function)
        vars(function)[DIGEST] = _digest(function.__code__.co_filename)  # now: the file may be another one later
        if options.get("cache"):
            files = kernel._cache._cache_file
            files.__class__ = _CheckedFiles
            files.function = function
        return kernel

    return decorate


njit: Any = _njit  # numba types its kernels itself


def _digest(path: str) -> str:
    """Return a digest of a source file as it is now; empty where it cannot be read."""
    try:
        about = Path(path).stat()
        return _digest_of(path, about.st_mtime_ns, about.st_size)
    except OSError:
        return ""


@cache
def _digest_of(path: str, mtime_ns: int, size: int) -> str:
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


def _stamp(function: FunctionType) -> str:
    """Return what a kernel is kept for: a digest of the files of all that it is compiled from, and of all numbers."""
    said = hashlib.sha256()
    for part in _parts_of(function, set()):
        said.update(part + b"\n")
    return said.hexdigest()


def _parts_of(function: FunctionType, seen: set[int]) -> Iterator[bytes]:
    """Yield the file of a function and what it takes from elsewhere, save the functions that were ``seen``; what is in
    a closure numba looks at itself."""
    if id(function) in seen or _is_foreign(function.__module__):
        return
    seen.add(id(function))
    code = function.__code__
    digest = vars(function).get(DIGEST) or _digest(code.co_filename) or code.co_code
    yield f"{function.__qualname__} {digest!r}".encode()
    names = sorted(_names_in(code))
    for name in names:
        yield from _parts(name, function.__globals__.get(name), names, seen)


def _parts(name: str, value: Any, names: list[str], seen: set[int]) -> Iterator[bytes]:
    """Yield what is compiled into a kernel of a ``value`` that it calls by ``name``, whose attributes are among
    ``names``."""
    value = getattr(value, "py_func", getattr(value, "_defn", value))  # of a kernel, and of an intrinsic
    if isinstance(value, FunctionType):
        yield from _parts_of(value, seen)
    elif isinstance(value, ModuleType) and not _is_foreign(value.__name__):
        for attribute in names:
            yield from _parts(f"{name}.{attribute}", vars(value).get(attribute), names, seen)
    elif isinstance(value, tuple):
        for k, item in enumerate(value):
            yield from _parts(f"{name}[{k}]", item, names, seen)
    elif isinstance(value, type) and not _is_foreign(value.__module__):
        module = sys.modules.get(value.__module__)
        yield f"{name} {value.__qualname__} {_digest(getattr(module, '__file__', None) or '')}".encode()
    elif isinstance(value, np.ndarray):
        yield f"{name} {value.dtype.str} {value.shape} {value.flags.f_contiguous} ".encode() + value.tobytes()
    elif isinstance(value, bool | int | float | complex | str | bytes | np.generic):
        yield f"{name} {type(value).__name__} {value!r}".encode()


def _names_in(code: CodeType) -> set[str]:
    """Return the names of globals and attributes in a function's code, and in that of functions within it."""
    inner = [_names_in(constant) for constant in code.co_consts if isinstance(constant, CodeType)]
    return set(code.co_names).union(*inner)


def _is_foreign(module: str | None) -> bool:
    """Return whether a module is numba's own, whose version it keeps beside each kernel, or one that it knows by
    heart."""
    return (module or "").partition(".")[0] in ("numba", "numpy", "llvmlite")


class _CheckedFiles(IndexDataCacheFile):
    """The index and the data of one kernel, of a ``function``."""

    function: Any  # Python's own

    @property
    def _source_stamp(self) -> Any:
        return vars(self)["_source_stamp"], _stamp(self.function)

    @_source_stamp.setter
    def _source_stamp(self, own: Any) -> None:
        vars(self)["_source_stamp"] = own

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
