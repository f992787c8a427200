"""Two ways to work on requests: each in its turn, or the newest first in a thread of its own.

Both have ``submit``, ``take``, ``busy``, ``skipped``, ``unfinished`` and ``close``, all to be called from one thread.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from queue import SimpleQueue
from threading import Thread
from typing import Generic, TypeVar

Request = TypeVar("Request")
Result = TypeVar("Result")


class InTurn(Generic[Request, Result]):
    """Works on every request, before ``submit`` returns."""

    skipped = unfinished = 0
    busy = False

    def __init__(self, work: Callable[[Request], Result]) -> None:
        self._work = work
        self._done: list[Result] = []

    def submit(self, request: Request) -> None:
        self._done.append(self._work(request))

    def take(self) -> Result | None:
        """Return the finished result, if there is one."""
        return self._done.pop(0) if self._done else None

    def close(self) -> None:
        """Do nothing: there is nothing to wait for."""


class LatestOnly(Generic[Request, Result]):
    """Works in a thread on the newest request; those that were overtaken meanwhile are dropped and counted.

    ``wake`` is called from that thread when a result is there. An exception of the work comes out of ``take``.
    """

    def __init__(self, work: Callable[[Request], Result], wake: Callable[[], None]) -> None:
        self._work, self._wake = work, wake
        self._jobs = SimpleQueue[tuple[Future[Result], Request] | None]()
        # a daemon: a process that ends does not wait for what nobody will hear
        Thread(target=self._work_in_turn, name="newest", daemon=True).start()
        self._next: list[Request] = []
        self._running: Future[Result] | None = None
        self._closed = False
        self.skipped = 0

    @property
    def busy(self) -> bool:
        """Return whether something is being worked on or waits to be taken."""
        return self._running is not None

    @property
    def unfinished(self) -> int:
        """Requests in hand or waiting: without an answer if the work ends now."""
        return len(self._next) + int(self.busy)

    def submit(self, request: Request) -> None:
        """Work on this next; what waited before it is dropped."""
        self.skipped += len(self._next)
        self._next = [request]
        self._start()

    def take(self) -> Result | None:
        """Return the finished result, if there is one; the next request is started."""
        if self._running is None or not self._running.done():
            return None
        finished, self._running = self._running, None
        self._start()
        return finished.result()

    def close(self) -> None:
        """Drop what waits, and the result of the work in hand: it can take long, and nobody is there to hear it."""
        self._next = []
        self._closed = True
        self._jobs.put(None)

    def _start(self) -> None:
        if self._running is None and self._next:
            self._running = Future()
            self._running.add_done_callback(self._finished)
            self._jobs.put((self._running, self._next.pop()))

    def _work_in_turn(self) -> None:
        while (job := self._jobs.get()) is not None:
            future, request = job
            try:
                result = self._work(request)
            except BaseException as error:  # it comes out of ``take``
                future.set_exception(error)
            else:
                future.set_result(result)

    def _finished(self, _: Future[Result]) -> None:
        if not self._closed:
            self._wake()
