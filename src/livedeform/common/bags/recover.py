"""Recovering torn MCAP files, as a crash or a full disk leaves them: every message that is whole comes back. No ROS."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Channel, Message, Metadata, Schema

from livedeform.common.bags import chunks
from livedeform.common.bags.storage import MAGIC, METADATA_NAME, schema_definition, split_number
from livedeform.common.bags.types import RawMessage
from livedeform.common.bags.write import BagWriter
from livedeform.common.errors import RecordingError

__all__ = ["RecoveryReport", "recover"]


@dataclass(frozen=True)
class RecoveryReport:
    """The outcome of ``recover``: messages, damaged chunks that were left out, and where reading ended."""

    n_messages: int
    n_bad_chunks: int
    n_bytes_read: int
    n_bytes: int


def recover(path: Path | str, out: Path | str) -> RecoveryReport:
    """Copy what can be read of a torn MCAP file, or of a folder of them, into the new bag ``out``."""
    source = Path(path)
    files = sorted(source.glob("*.mcap"), key=split_number) if source.is_dir() else [source]
    if not files or not all(file.is_file() for file in files):
        raise RecordingError("there is no MCAP file", where=str(path), remedy="name a torn .mcap file or its folder")
    n_messages = n_bad = n_read = n_bytes = 0
    with BagWriter(out, {"recovered_from": str(source)}, atomic=True) as writer:
        for file in files:
            salvage = _TornFile(file)
            for raw in salvage.messages():
                writer.write(raw.topic, raw.type, raw.log_time_ns, raw.data, raw.definition)
                n_messages += 1
            for metadata in salvage.metadata:
                writer.add_metadata(metadata)
            n_bad += salvage.n_bad_chunks
            n_read += salvage.n_bytes_read
            n_bytes += file.stat().st_size
        if n_messages == 0:
            raise RecordingError("no message could be recovered", where=str(path), remedy="record again")
    return RecoveryReport(n_messages, n_bad, n_read, n_bytes)


class _TornFile:
    """Reads a file record by record until it ends or makes no sense; of a chunk that is torn what is there, of one that
    is damaged nothing."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self.metadata: list[dict[str, str]] = []
        self.n_bad_chunks = 0
        self.n_bytes_read = 0

    def messages(self) -> Iterator[RawMessage]:
        with self._path.open("rb") as stream:
            if stream.read(len(MAGIC)) != MAGIC:
                return
            for opcode, body, whole in chunks.file_records(stream):
                if opcode == Opcode.CHUNK:
                    yield from self._chunk(body, whole=whole)
                elif whole:
                    yield from self._records([(opcode, body)])
                self.n_bytes_read = stream.tell()

    def _chunk(self, body: bytes, *, whole: bool) -> Iterator[RawMessage]:
        content = chunks.sound_content(body) if whole else chunks.torn_content(body)
        if content is None:
            self.n_bad_chunks += 1
        else:
            yield from self._records(chunks.split(content))

    def _records(self, bodies: Iterable[tuple[int, bytes]]) -> Iterator[RawMessage]:
        for opcode, body in bodies:
            try:
                record = chunks.read_record(opcode, body)
            except Exception:  # whatever damaged bytes make mcap raise
                continue
            yield from self._take(record)

    def _take(self, record: chunks.Readable | None) -> Iterator[RawMessage]:
        if isinstance(record, Schema):
            self._schemas[record.id] = record
        elif isinstance(record, Channel):
            self._channels[record.id] = record
        elif isinstance(record, Metadata) and record.name == METADATA_NAME:
            self.metadata.append(dict(record.metadata))
        elif isinstance(record, Message) and record.channel_id in self._channels:
            channel = self._channels[record.channel_id]
            schema = self._schemas.get(channel.schema_id)
            if schema is not None:
                yield RawMessage(channel.topic, schema.name, record.log_time, record.data, schema_definition(schema))
