"""Work in a thread of its own on the newest request; requests that were overtaken are dropped and counted."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Generic, TypeVar

Request = TypeVar("Request")
Result = TypeVar("Result")


class NewestFirst(Generic[Request, Result]):
    """``submit`` from one thread, ``take`` from the same one after ``wake`` was called (from the worker's thread).

    An exception of the work comes out of ``take``.
    """

    def __init__(self, work: Callable[[Request], Result], wake: Callable[[], None]) -> None:
        self._work, self._wake = work, wake
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="newest")
        self._next: list[Request] = []
        self._running: Future[Result] | None = None
        self.skipped = 0

    @property
    def busy(self) -> bool:
        """Whether something is being worked on or waits to be taken."""
        return self._running is not None

    def submit(self, request: Request) -> None:
        """Work on this next; what waited before it is dropped."""
        self.skipped += len(self._next)
        self._next = [request]
        self._start()

    def take(self) -> Result | None:
        """The finished result, if there is one; the next request is started."""
        if self._running is None or not self._running.done():
            return None
        finished, self._running = self._running, None
        self._start()
        return finished.result()

    def close(self) -> None:
        """Waits for the work in hand and drops the rest."""
        self._next = []
        self._pool.shutdown(wait=True)

    def _start(self) -> None:
        if self._running is None and self._next:
            self._running = self._pool.submit(self._work, self._next.pop())
            self._running.add_done_callback(lambda _: self._wake())
