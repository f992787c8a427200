"""Output folders: no input is touched, old results stay until the new ones are whole, and what a command ran with lies
beside its results."""

from __future__ import annotations

import ctypes
import datetime
import errno
import glob
import importlib.metadata
import itertools
import json
import math
import os
import platform
import re
import shutil
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import livedeform
from livedeform import drafts
from livedeform.common.errors import InputError, LivedeformError
from livedeform.common.processes import uninterrupted
from livedeform.drafts import real

CONFIGURATION = "configuration.json"
RECORDING = "run.mcap"  # of a run, whose folder is one result
UNWRITABLE = {
    errno.ENOSPC: "the disk is full",
    errno.EDQUOT: "the quota of the disk is used up",
    errno.EROFS: "the disk is read-only",
    errno.EIO: "the disk has a fault",
    errno.EFBIG: "no file may be that large here",
    errno.EACCES: "permission is denied",
    errno.EPERM: "permission is denied",
}
AT_FDCWD, RENAME_EXCHANGE = -100, 2  # fcntl.h, linux/fs.h
_FINAL: dict[Path, Path] = {}  # drafts that are being written, and what they will be called
PACKAGES = (
    "numpy", "scipy", "numba", "pypardiso", "opencv-python-headless", "rosbags", "mcap", "pytetwild", "ros-jazzy-rclpy",
)  # fmt: skip


def refuse_inputs(targets: Iterable[Path], inputs: Iterable[Path | None]) -> None:
    """Raises ``InputError`` where writing or replacing one of ``targets`` would touch one of ``inputs``.

    An input is a file, or a folder with everything in it. A target touches it if it is the input, holds it, lies in a
    recording's folder, or is a file that is there already in an input folder or beside an input ``run.mcap``: that
    folder is one result.
    """
    known = {real(path) for path in inputs if path is not None}
    for target in targets:
        place = real(target)
        for source in known:
            if place == source or place in source.parents or _in_one_piece(place, source):
                raise InputError(
                    f"would replace or change the input {source}", where=str(target), remedy="name another --out"
                )


def _in_one_piece(target: Path, source: Path) -> bool:
    """Return whether ``target`` is a part of what the input ``source`` is a part of."""
    if source.is_dir() and source in target.parents:
        return target.exists() or (source / "metadata.yaml").is_file()
    return source.name == RECORDING and source.parent == target.parent and target.exists()


def has_results(out: Path, names: Iterable[str]) -> bool:
    """Return whether one of ``names`` is in ``out``."""
    return any((out / name).exists() for name in names)


def checked(out: Path, names: Sequence[str], inputs: Sequence[Path | None], *, force: bool) -> bool:
    """Return whether there are earlier results; raises InputError where nothing may be written."""
    if out.exists() and not out.is_dir():
        raise InputError("is a file", where=str(out), remedy="name a folder with --out")
    for source in inputs:
        if source is not None and source.is_dir() and real(out) == real(source):
            raise InputError(f"is the input {source}", where=str(out), remedy="name another --out")
    refuse_inputs([out / name for name in names], inputs)
    present = has_results(out, names)
    if present and not force:
        raise InputError("there are results already", where=str(out), remedy="choose another --out, or add --force")
    return present


@contextmanager
def prepared(
    out: Path,
    names: Iterable[str],
    *,
    force: bool,
    inputs: Sequence[Path | None] = (),
    in_place: bool = False,
    alone: bool = True,
) -> Iterator[Path]:
    """Yield a draft folder beside ``out`` to write results into; what is in it at the end moves into ``out``.

    Until then earlier results in ``out`` stay as they are, whatever happens, and nothing incomplete has its final name.
    ``names`` are what is written: without ``force`` none of them may be there. ``inputs`` are what the command reads,
    and is never touched. With ``in_place`` and no earlier results the draft is ``out`` itself, and what is written
    stays: for what cannot be made a second time. Unless ``alone``, other results may share the folder. What a command
    that was killed left behind is removed first, or named.
    """
    names = (*names, CONFIGURATION) if alone else tuple(names)
    present = checked(out, names, inputs, force=force)
    drafts.tidy(out)
    made = [folder for folder in (out, *out.parents) if not folder.exists()]
    draft = _made(out, drafts.RECORDED if in_place else drafts.DRAFT, in_place=in_place and not present)
    _FINAL[draft] = out
    lock = drafts.hold(draft) if draft != out else None
    try:
        yield draft
        if draft != out:
            refuse_inputs([out / path.name for path in draft.iterdir()], inputs)
            with uninterrupted():
                _publish(draft, out, names) if any(draft.iterdir()) else draft.rmdir()
    except BaseException as error:
        if draft != out and not in_place:
            shutil.rmtree(draft, ignore_errors=True)
        _unmake(made)
        if isinstance(error, OSError) and error.errno in UNWRITABLE:
            kept = draft / RECORDING if in_place else None
            raise unwritable(error, out, kept if kept is not None and kept.exists() else None) from error
        raise
    finally:
        del _FINAL[draft]
        if lock is not None:
            os.close(lock)


def unwritable(error: OSError, out: Path | None = None, kept: Path | None = None) -> LivedeformError:
    """Say what the system says, in words, and of which file; ``error`` is one of `UNWRITABLE`. ``kept``: a recording of
    what cannot be made a second time, as far as it was written."""
    path = final(Path(os.fsdecode(error.filename))) if isinstance(error.filename, str | bytes) else out
    where = "" if path is None else str(path.with_name(re.sub(r"^\.(.+)\.draft-\d+$", r"\1", path.name)))
    mine = out is not None and where.startswith(str(out))
    remedy = "name another --out" if mine else "see to the disk, or name another place"
    if kept is not None:
        remedy = f"make room; what was recorded until then stays: livedeform recover {kept} --out saved.mcap"
    return LivedeformError(
        f"cannot be {'' if mine else 'read or '}written: {UNWRITABLE[error.errno or 0]}", where=where, remedy=remedy
    )


def _made(out: Path, kind: str, *, in_place: bool) -> Path:
    """Make ``out``; return it, or unless ``in_place`` a draft of a ``kind`` beside it."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        return out if in_place else drafts.new_draft(out, kind)
    except OSError as error:
        why = UNWRITABLE.get(error.errno or 0, error.strerror)
        raise InputError(f"cannot be made: {why}", where=str(out), remedy="name another --out") from error


def _unmake(folders: Iterable[Path]) -> None:
    """Remove folders, the innermost first, up to the first that something was written to."""
    with suppress(OSError):
        for folder in folders:
            folder.rmdir()


def put_aside(draft: Path, out: Path) -> Path:
    """Moves what was recorded of an interrupted command out of the draft, to a folder beside ``out`` that is new."""
    place = next(p for n in itertools.count(1) if not (p := out.with_name(f"{out.name}.interrupted-{n}")).exists())
    place.mkdir()
    for path in draft.iterdir():
        path.rename(place / path.name)
    return place


def final(path: Path) -> Path:
    """The name that a path in a draft will have."""
    for draft, out in sorted(_FINAL.items(), key=lambda pair: -len(pair[0].parts)):  # the innermost first
        if path == draft or draft in path.parents:
            return final(out / path.relative_to(draft)) if draft != out else path
    return path


def _publish(draft: Path, out: Path, names: Sequence[str]) -> None:
    """Moves the draft to its final name; what was there of ``names`` is deleted afterwards.

    In one step where ``out`` holds nothing but results; else file by file, and what else is there stays.
    """
    results = {name for name in names if "/" not in name} | {path.name for path in draft.iterdir()}
    only_results = all(path.name in results for path in out.iterdir()) and not any("/" in name for name in names)
    if only_results and draft.parent == real(out).parent and _exchange(draft, real(out)):
        shutil.rmtree(draft, ignore_errors=True)
        return
    replaced = Path(tempfile.mkdtemp(prefix=".replaced-", dir=out))
    for name in results:
        inner = [rest for head, _, rest in (n.partition("/") for n in names) if head == name and rest]
        if inner and (out / name).is_dir() and (draft / name).is_dir():
            _publish(draft / name, out / name, inner)
        else:
            _replace(draft / name, out / name, replaced)
    shutil.rmtree(replaced, ignore_errors=True)
    shutil.rmtree(draft, ignore_errors=True)


def _replace(new: Path, old: Path, replaced: Path) -> None:
    """The new file or folder in the old one's place; where there is no new one, the old one is out of date."""
    there = os.path.lexists(old)
    if there and (not new.exists() or new.is_dir() or old.is_dir()):
        old.rename(replaced / old.name)
    if new.exists():
        new.replace(old)


def _exchange(one: Path, two: Path) -> bool:
    """Exchanges the names of two folders in one step; False where the system cannot (renameat2 of Linux)."""
    try:
        rename = ctypes.CDLL(None, use_errno=True).renameat2
    except AttributeError:
        return False
    status: int = rename(AT_FDCWD, os.fsencode(one), AT_FDCWD, os.fsencode(two), RENAME_EXCHANGE)
    return status == 0


def versions() -> dict[str, str]:
    """Versions of what the numbers depend on."""
    found = {"livedeform": livedeform.__version__, "python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found


def configuration(command: str, options: Mapping[str, Any], *, seed: int | None = None) -> dict[str, Any]:
    """Collect what a command runs with: options, seed, versions, machine, time."""
    return {
        "command": command,
        "options": {key: _plain(value) for key, value in options.items()},
        "seed": seed,
        "versions": versions(),
        "machine": {"system": platform.platform(), "cores": os.cpu_count()},
        "started": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "arguments": sys.argv[1:],
    }


def write_configuration(out: Path, what: Mapping[str, Any]) -> None:
    """``configuration.json``."""
    write_json(out / CONFIGURATION, what)


def write_json(path: Path, document: Any) -> None:
    """JSON without NaN (null instead), floats with all their digits."""
    write_text(path, json.dumps(_plain(document), indent=2, allow_nan=False) + "\n")


def write_text(path: Path, text: str) -> None:
    """The whole text, or the file as it was before."""
    draft = path.with_name(f".{path.name}.draft-{os.getpid()}")
    for left in path.parent.glob(f".{glob.escape(path.name)}.draft-*"):  # by a killed process
        if not _runs(left.suffix.removeprefix(".draft-")):
            left.unlink(missing_ok=True)
    try:
        draft.write_text(text, encoding="utf-8")
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)


def _runs(number: str) -> bool:
    """Return whether the process of this number is there (on a system that can tell)."""
    try:
        os.kill(int(number), 0)
    except ProcessLookupError:
        return False
    except (OSError, ValueError):
        pass
    return True


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple | set):
        return [_plain(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Path):
        return str(final(value))
    return value
