"""Three ways to work on requests: each in its turn, the newest first in a thread of its own, or with a second thread
that learns what the first cannot answer.

All have ``submit``, ``take``, ``busy``, ``skipped``, ``unfinished`` and ``close``, all to be called from one thread.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from queue import SimpleQueue
from threading import Thread
from typing import Generic, TypeVar

from livedeform.common.processes import WORKING

MOST_LESSONS = 300  # that wait: the last ten seconds of poses at 30 Hz

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
        Thread(target=self._work_in_turn, name=WORKING, daemon=True).start()
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


class AnswerOrLearn(Generic[Request, Result]):
    """Answers the newest request where ``answer`` can (None: it cannot). What it cannot, ``learn`` works out meanwhile
    in another thread, the newest first; its result is given only if nothing newer has been answered by then.

    ``is_known`` tells, before a lesson begins, whether another one has made it needless. ``wake`` as of `LatestOnly`.
    """

    def __init__(
        self,
        answer: Callable[[Request], Result | None],
        learn: Callable[[Request], Result],
        is_known: Callable[[Request], bool],
        wake: Callable[[], None],
    ) -> None:
        def lesson(request: tuple[int, Request]) -> tuple[int, Result | None]:
            return request[0], None if is_known(request[1]) else learn(request[1])

        self._answers = LatestOnly[tuple[int, Request], tuple[tuple[int, Request], Result | None]](
            lambda request: (request, answer(request[1])), wake
        )
        self._lessons = LatestOnly[tuple[int, Request], tuple[int, Result | None]](lesson, wake)
        self._waiting = deque[tuple[int, Request]](maxlen=MOST_LESSONS)
        self._n, self._answered, self._overtaken = 0, 0, 0

    @property
    def busy(self) -> bool:
        """Return whether something is being worked on or waits to be taken."""
        return self._answers.busy or self._lessons.busy

    @property
    def skipped(self) -> int:
        """Requests that were overtaken by a newer one, or waited too long to be learnt."""
        return self._answers.skipped + self._overtaken

    @property
    def unfinished(self) -> int:
        """Requests in hand or waiting: without an answer if the work ends now."""
        return self._answers.unfinished + self._lessons.unfinished + len(self._waiting)

    def submit(self, request: Request) -> None:
        """Answer this next; what waited for an answer before it is dropped."""
        self._n += 1
        self._answers.submit((self._n, request))

    def take(self) -> Result | None:
        """Return a finished result, if there is one, the newest first; the next requests are started."""
        result = self._take_answer()
        if result is None:
            result = self._take_lesson()
        if self._waiting and not self._lessons.busy:
            self._lessons.submit(self._waiting.pop())
        return result

    def close(self) -> None:
        """Drop what waits, and the results of the work in hand."""
        self._answers.close()
        self._lessons.close()

    def _take_answer(self) -> Result | None:
        if (taken := self._answers.take()) is None:
            return None
        request, result = taken
        if result is None:
            self._overtaken += int(len(self._waiting) == MOST_LESSONS)
            self._waiting.append(request)
        else:
            self._answered = request[0]
        return result

    def _take_lesson(self) -> Result | None:
        if (taken := self._lessons.take()) is None:
            return None
        number, result = taken
        if result is None or number < self._answered:
            self._overtaken += 1
            return None
        self._answered = number
        return result
