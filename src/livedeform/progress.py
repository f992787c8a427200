"""Progress of long work: a bar on a terminal, plain lines elsewhere, always on stderr."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import Any, Self, TextIO

Tell = Callable[..., None]  # (text, fraction 0..1 or None)

PLAIN_EVERY = 2.0  # s between two plain lines about the same task


class Progress:
    """Call it with a text and, where it is known, the fraction done: ``progress("frame 3 of 10", 0.3)``."""

    def __init__(self, stream: TextIO | None = None) -> None:
        self._stream = stream or sys.stderr
        self._bar: Any = None
        self._task: Any = None
        self._last = 0.0
        self._last_text = ""

    def __enter__(self) -> Self:
        if self._stream.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, SpinnerColumn, TextColumn, TimeElapsedColumn
            from rich.progress import Progress as Bar

            console = Console(file=self._stream)
            columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
            self._bar = Bar(*columns, console=console, transient=True)
            self._bar.start()
            self._task = self._bar.add_task("", total=None)
        return self

    def __call__(self, text: str, fraction: float | None = None) -> None:
        if self._bar is not None:
            self._bar.update(
                self._task, description=text, total=1.0 if fraction is not None else None, completed=fraction or 0
            )
            return
        now = time.monotonic()
        finished = fraction is not None and fraction >= 1.0
        if now - self._last < PLAIN_EVERY and not finished and fraction is not None:
            return
        if text != self._last_text or finished:
            percent = f" ({100 * fraction:.0f} %)" if fraction is not None else ""
            print(f"{text}{percent}", file=self._stream, flush=True)
            self._last, self._last_text = now, text

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Take the bar away while something is asked: it is drawn over what others write."""
        if self._bar is not None:
            self._bar.stop()
        try:
            yield
        finally:
            if self._bar is not None:
                self._bar.start()

    def line(self, text: str) -> None:
        """A line that stays."""
        if self._bar is not None:
            self._bar.console.print(text, highlight=False, markup=False)
        else:
            print(text, file=self._stream, flush=True)

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()
            self._bar = None
