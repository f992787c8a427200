"""Writes everything that is published and received to ``run.mcap``. No ROS here: it takes serialised messages."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Self

from livedeform.common import topics as t
from livedeform.common.bags.types import RawMessage, decode, encode, message_class
from livedeform.common.bags.write import BagWriter

FLUSH_SECONDS = 0.5


class RunRecorder:
    """The recording of one run; a context manager. ``clock`` gives the receive time (ns) of a message; ``watch`` is
    called with everything that is recorded: topic, type, bytes. ``derive`` gives what else is to be written beside a
    message (`LiveScene`), and ``show`` is called with that."""

    def __init__(
        self,
        path: Path,
        metadata: Mapping[str, str],
        clock: Callable[[], int],
        watch: Callable[[str, str, bytes], None] | None = None,
        derive: Callable[[str, str, bytes], list[tuple[str, str, bytes]]] | None = None,
    ) -> None:
        self._watch, self._derive = watch, derive
        self.show: Callable[[str, str, bytes], None] | None = None
        self._bag = BagWriter(path, metadata)
        self._clock = clock
        self._last_ns, self._flushed = 0, 0.0
        self.counts: Counter[str] = Counter()

    def write(self, topic: str, type_name: str, data: bytes) -> None:
        """One message as it came over the wire, and what is derived of it; a registration becomes ``/tf_static``."""
        # receive times never go back, whatever the clock does: readers sort by them
        self._last_ns = max(self._last_ns, self._clock())
        if topic == t.STEREO_REGISTRATION and self._derive is None:
            transform = decode(RawMessage(topic, t.TRANSFORM_STAMPED, self._last_ns, data))
            topic, type_name, data = t.TF_STATIC, t.TRANSFORMS, encode(message_class(t.TRANSFORMS)([transform]))
        if topic != t.STEREO_REGISTRATION:
            self.counts[topic] += 1  # of what was heard: what is derived is none of it
            self._keep(topic, type_name, data)
        for derived in self._derive(topic, type_name, data) if self._derive is not None else ():
            self._keep(*derived)
            if self.show is not None:
                self.show(*derived)

    def _keep(self, topic: str, type_name: str, data: bytes) -> None:
        self._bag.write(topic, type_name, self._last_ns, data)
        if self._watch is not None:
            self._watch(topic, type_name, data)

    def flush_soon(self) -> None:
        """Hands everything to the operating system, twice a second at most."""
        if time.monotonic() - self._flushed > FLUSH_SECONDS:
            self._bag.flush()
            self._flushed = time.monotonic()

    def add_metadata(self, metadata: Mapping[str, str]) -> None:
        """Hold what is known only at the end."""
        self._bag.add_metadata(metadata)

    def __enter__(self) -> Self:
        self._bag.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bag.__exit__(kind, error, trace)
