"""Signals, worker processes and threads: a stop that ends in order; workers do not outlive who started them."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, NoReturn, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

PR_SET_PDEATHSIG = 1  # linux/prctl.h
WATCH_SECONDS = 0.5
STOPS = (signal.SIGINT, signal.SIGTERM)
INTERRUPTED = 130  # exit code
WORKING = "working"  # the name of a thread that may be at work, in a library, when the process ends
GRACE = 1.0  # s after a stop signal, for what would be lost anyway


def end(code: int) -> NoReturn:
    """End this process with an exit code, at once where a thread is still `WORKING`: what it works on nobody will hear,
    and the interpreter's own end would take its library away under it, which can crash."""
    if any(thread.name == WORKING for thread in threading.enumerate()):
        for stream in (sys.stdout, sys.stderr):
            if not stream.closed:  # stderr is, where the reader of our output has gone
                stream.flush()
        os._exit(code)
    sys.exit(code)


@contextmanager
def terminable() -> Iterator[None]:
    """Let Ctrl-C and SIGTERM end the ``with`` block alike: the workers are killed, then comes ``KeyboardInterrupt``."""
    with _handling(_interrupt), heard_at_once():
        yield


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Ignore Ctrl-C and SIGTERM in the ``with`` block: for the few seconds in which results are written."""
    with _handling(signal.SIG_IGN):
        yield


@contextmanager
def _handling(handler: Any) -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():  # no other may
        yield
        return
    before = {number: signal.signal(number, handler) for number in STOPS}
    try:
        yield
    finally:
        for number, handler_before in before.items():
            signal.signal(number, handler_before)


def _interrupt(signum: int, frame: object) -> None:
    for child in multiprocessing.active_children():  # threads may wait for what they work on
        child.kill()
    raise KeyboardInterrupt


# --- a stop while the main thread is busy ----------------------------------------------------------------------------

_expendable: list[object] = []  # one entry for each block that may be cut off


@contextmanager
def heard_at_once() -> Iterator[None]:
    """Let a thread hear of stop signals, too: Python calls a handler only when the main thread is back from what it
    calls, and a factorisation, or a busy machine, can take seconds."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    hears, tells = socket.socketpair()
    tells.setblocking(False)
    before = signal.set_wakeup_fd(tells.fileno(), warn_on_full_buffer=False)
    threading.Thread(target=_hear, args=(hears,), name="stops", daemon=True).start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(before)
        tells.close()


@contextmanager
def expendable() -> Iterator[None]:
    """Within the ``with`` block nothing would be lost: a stop signal kills the workers, and `GRACE` later this process,
    if it is still in the block then. To be used within `heard_at_once`."""
    own = object()
    _expendable.append(own)
    try:
        yield
    finally:
        _expendable.remove(own)


def _hear(hears: socket.socket) -> None:
    """End what is expendable after a stop signal; the bytes are the signals' numbers."""
    with hears:
        while numbers := hears.recv(64):
            if not _expendable or not set(numbers) & set(STOPS):
                continue
            for child in multiprocessing.active_children():
                child.kill()
            deadline = time.monotonic() + GRACE
            while _expendable and time.monotonic() < deadline:
                time.sleep(WATCH_SECONDS / 20)
            if _expendable:
                os.write(2, b"livedeform: stopped\n")
                os._exit(INTERRUPTED)


# --- workers ---------------------------------------------------------------------------------------------------------


@contextmanager
def worker_pool(processes: int, start: Callable[..., object], *arguments: Any) -> Iterator[ProcessPoolExecutor]:
    """Forked workers, each of which calls ``start(*arguments)`` first.

    An exception, as of Ctrl-C, kills them in the middle of what they do; and they do not outlive this process, however
    it ends.
    """
    before = set(multiprocessing.active_children())
    with ProcessPoolExecutor(
        processes,
        mp_context=multiprocessing.get_context("fork"),
        initializer=_begin,
        initargs=(os.getpid(), start, *arguments),
    ) as executor:
        try:
            with expendable():
                yield executor
        except BaseException:
            executor.shutdown(wait=False, cancel_futures=True)
            for child in set(multiprocessing.active_children()) - before:
                child.kill()
            raise


def usable_cores() -> int:
    """Return how many cores this process may use: of its affinity, and of OMP_NUM_THREADS where that is set."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(cores, stated_threads("OMP_NUM_THREADS") or cores)


def stated_threads(*names: str) -> int | None:
    """Return how many threads the first of the environment's variables ``names`` asks for that is a number, or a list
    of them, one for each level, as OpenMP takes it; None if none is."""
    for name in names:
        first = os.environ.get(name, "").split(",")[0].strip()
        if first.isdecimal() and int(first) > 0:
            return int(first)
    return None


def in_threads(function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """Yield ``function`` of every item, in order, from as many threads as there are cores: for what runs outside the
    interpreter most of the time. What has not begun is dropped where the caller stops."""
    with ThreadPoolExecutor(usable_cores()) as threads:
        try:
            yield from threads.map(function, items)
        finally:
            threads.shutdown(wait=False, cancel_futures=True)


def _begin(parent: int, start: Callable[..., object], *arguments: Any) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group: the parent ends the workers
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.set_wakeup_fd(-1)
    end_with(parent)
    start(*arguments)


def end_with(parent: int) -> None:
    """End this process when its parent, the process number ``parent``, has ended: at once on Linux, else soon."""
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:  # it ended before we asked
            os.kill(os.getpid(), signal.SIGKILL)
        return
    threading.Thread(target=_watch, args=(parent,), daemon=True).start()


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(WATCH_SECONDS)
    os.kill(os.getpid(), signal.SIGKILL)
