"""Runs a command again and again, each time with another of its writes failing, or killed there; a process of its own.

    python faults.py FAULT[,FAULT...] OUT HOW [WORD...]

FAULT is ENOSPC, EROFS, EACCES (from that write on), EIO (that write only), KILL (the process, at that write) or TIME
(the process, 50 times at random). A write is an opening for writing, a rename or a new folder below OUT's parent. HOW
is ``command`` with the command's words, or ``toy``: a result written with all writers of a run. Prints one JSON line
per attempt: n, exit code, what it said, and whether OUT holds "old", "new", "nothing", or "something else".
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import importlib
import io
import json
import os
import random
import shutil
import signal
import sys
import time
from pathlib import Path

TOY = ("run.mcap", "metrics.json", "markers.csv", "report.html")
KILLS = 50
USED = {
    "toy": ("livedeform.run.results", "livedeform.common.bags.write"),
    "command": ("livedeform.cli", "livedeform.run.running", "livedeform.report.run.page", "plotly.graph_objects"),
}


def content(folder: Path) -> dict[str, str]:
    """Hashes of every file under a folder, by their paths."""
    files = [path for path in sorted(folder.rglob("*")) if path.is_file()] if folder.exists() else []
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def writes_below(place: str, event: str, arguments: tuple) -> bool:
    """Return whether an audit event is a write below a folder."""
    if event == "open":
        path, mode, flags = arguments
        writing = any(c in mode for c in "wxa+") if isinstance(mode, str) else flags & (os.O_WRONLY | os.O_RDWR)
    else:
        path, writing = arguments[0], event in ("os.rename", "os.mkdir")
    return bool(writing) and isinstance(path, str | bytes | Path) and os.fsdecode(path).startswith(place)


def arm(fault: str, number: int, place: str) -> list[str]:
    """Let write ``number`` of this process fail; gives the list that the writes are put into."""
    found: list[str] = []

    def hook(event: str, arguments: tuple) -> None:
        if event not in ("open", "os.rename", "os.mkdir") or not writes_below(place, event, arguments):
            return
        found.append(event)
        if len(found) < number or (len(found) > number and fault == "EIO"):
            return
        if fault == "KILL":
            os.kill(os.getpid(), signal.SIGKILL)
        code = getattr(errno, fault)
        raise OSError(code, os.strerror(code), os.fsdecode(arguments[0]))

    sys.addaudithook(hook)
    return found


def toy(out: Path) -> int:
    """Write what looks like a run's results."""
    from livedeform import outputs
    from livedeform.common.bags.write import BagWriter
    from livedeform.common.errors import LivedeformError
    from livedeform.run.results import write_markers

    try:
        with outputs.prepared(out, TOY, force=True) as draft:
            outputs.write_configuration(draft, {"command": "toy"})
            with BagWriter(draft / "run.mcap", {"made": str(time.time_ns())}) as bag:
                bag.write("/a", "std_msgs/msg/Float64", 1, b"\0\1\0\0" + bytes(8))
            outputs.write_json(draft / "metrics.json", {"made": time.time_ns()})
            write_markers(draft / "markers.csv", [], time.time_ns())
            outputs.write_text(draft / "report.html", f"<html>{time.time_ns()}</html>")
    except LivedeformError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


def attempt(fault: str, number: int, out: Path, how: str, words: list[str]) -> int:
    """Run once in a fork; gives its exit code, or minus the signal that ended it."""
    child = os.fork()
    if child == 0:
        said = os.open(out.parent.parent / "said.txt", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(said, 2)
        code, writes = 99, arm(fault, number, str(out.parent)) if fault != "TIME" else []
        try:
            with contextlib.redirect_stdout(io.StringIO()):
                code = toy(out) if how == "toy" else command(words)
        finally:
            sys.stderr.flush()
            (out.parent.parent / "writes.txt").write_text(str(len(writes)))
            os._exit(code)
    if fault == "TIME":
        time.sleep(random.uniform(0.0, number * 1e-3))
        with contextlib.suppress(ProcessLookupError):
            os.kill(child, signal.SIGKILL)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def command(words: list[str]) -> int:
    from livedeform.cli import run

    return run(words)


def main(faults: str, out: Path, how: str, *words: str) -> None:
    random.seed(7)
    for module in USED[how]:  # once, not in every fork
        importlib.import_module(module)
    with_old, beside = bool(content(out)), {path.name for path in out.parent.iterdir()} | {out.name}
    begin = time.monotonic()
    assert attempt("EIO", 10**6, out, how, list(words)) in (0, 1)  # what a sound one takes and writes
    lasts, names = time.monotonic() - begin, set(content(out))
    n_writes = int((out.parent.parent / "writes.txt").read_text())
    for fault in faults.split(","):
        for n in range(1, (KILLS if fault == "TIME" else n_writes) + 1):
            if not with_old:
                shutil.rmtree(out)
                out.mkdir()
            old = content(out)
            code = attempt(fault, round(1e3 * lasts) if fault == "TIME" else n, out, how, list(words))
            now = content(out)
            state = "nothing" if not now else "old" if now == old else "new" if set(now) == names else "something else"
            left = sorted({path.name for path in out.parent.iterdir()} - beside)
            said = (out.parent.parent / "said.txt").read_text()
            told = {"fault": fault, "n": n, "code": code, "state": state, "left": left, "said": said}
            print(json.dumps(told), flush=True)


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), *sys.argv[3:])
