"""Run a study into its folder, with what it ran with beside it: whole, or with the parts that failed named."""

from __future__ import annotations

import signal
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

from livedeform import outputs
from livedeform.common.errors import InputError, LivedeformError
from livedeform.progress import Progress
from livedeform.studies import STUDIES, Study
from livedeform.studies.study import IncompleteStudyError

ALL = "all"


def run_study(
    name: str, out: Path, data: Path | None, arguments: Mapping[str, Any], options: Mapping[str, Any], *, force: bool
) -> None:
    """Run the study ``name``, or the booklet of all, and write its results into ``out``.

    ``arguments`` go to the study; ``options`` are what the user wrote, for ``configuration.json``. Raises InputError
    where ``data`` does not exist, or ``out`` holds results and ``force`` is not given; IncompleteStudyError, once the
    others are in ``out``, where a part failed.
    """
    if data is not None and not data.exists():
        raise InputError("does not exist", where=str(data), remedy="name the folder of the data with --data")
    study: Study = _booklet if name == ALL else STUDIES[name]
    inputs = [data, *(value for value in options.values() if isinstance(value, Path))]
    incomplete: IncompleteStudyError | None = None
    kept = outputs.prepared(out, ("study.json", "index.html"), force=force, inputs=inputs)
    with _Stop() as stop, kept as work, Progress() as progress:

        def tell(text: str, fraction: float | None = None) -> None:
            stop.check()
            progress(text, fraction)

        try:
            study(work, data, tell, **arguments)
        except IncompleteStudyError as error:
            incomplete = error
        stop.check()
        outputs.write_configuration(work, outputs.configuration("study", {"name": name, "data": data, **options}))
    if incomplete is not None:
        raise incomplete


def _booklet(*arguments: Any) -> dict[str, Any]:
    from livedeform.studies.booklet import make_booklet

    document = make_booklet(*arguments)
    if failed := document["failed"]:
        raise IncompleteStudyError(ALL, {name: LivedeformError(line) for name, line in failed.items()}, document)
    return document


class _Stop:
    """Lets SIGTERM end what runs as Ctrl-C does, so that it cleans up behind itself.

    An exception that is raised in a callback of a library, or while an object is destroyed, is lost: the wish to stop
    is kept, and ``check`` raises it again.
    """

    def __init__(self) -> None:
        self._wanted = False
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():  # only the main one may set handlers
            self._before = {number: signal.signal(number, self._handle) for number in (signal.SIGTERM, signal.SIGINT)}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _handle(self, *_: object) -> None:
        self._wanted = True
        raise KeyboardInterrupt

    def check(self) -> None:
        """Raise KeyboardInterrupt if a signal has asked for it."""
        if self._wanted:
            raise KeyboardInterrupt
