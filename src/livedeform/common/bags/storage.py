"""The two storages that a bag may have: MCAP files, and whatever else rosbags reads (sqlite3, compressed bags)."""

from __future__ import annotations

import os
from bisect import bisect_left
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import IO

from mcap.opcode import Opcode
from mcap.reader import McapReader, make_reader
from mcap.records import Channel, Metadata, Schema
from rosbags.interfaces import Connection, MessageDefinitionFormat
from rosbags.rosbag2 import Reader as Rosbag2Reader

from livedeform.common.bags import chunks
from livedeform.common.bags.types import RawMessage, TypeDefinition, jazzy, one_line, typestore
from livedeform.common.errors import RecordingError

MAGIC = b"\x89MCAP0\r\n"
METADATA_NAME = "livedeform"
"""Name of the MCAP metadata record that holds what the writer said of the bag."""
NEVER_NS = 2**63 - 1


@dataclass(frozen=True)
class TopicInfo:
    """A topic of a bag. ``problem`` says why it cannot be decoded; empty if it can."""

    name: str
    type: str
    count: int
    definition: TypeDefinition
    problem: str = ""


class McapFile:
    """One MCAP file. ``n_beyond``: messages whose receive time no clock can show (after 2262); they are left out."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.n_beyond = 0
        self._stream: IO[bytes] = path.open("rb")
        try:
            self._check()
            self._index = chunks.read_index(self._stream)
            stats = None if self._index is None else self._index.statistics
            self._stats = stats if stats is not None and stats.message_end_time <= NEVER_NS else None
            if self._index is None or not self._index.chunks or self._stats is None:  # it is read from end to end
                self._stream.seek(len(MAGIC))
                chunks.refuse_bombs(self._stream, str(path))
            self._stream.seek(0)
            self.reader: McapReader = make_reader(self._stream, validate_crcs=True)
            self._survey()
            self.metadata = self._metadata()
        except RecordingError:
            self._stream.close()
            raise
        except Exception as error:  # damaged bytes make mcap raise many kinds, not all of them its own
            self._stream.close()
            raise RecordingError(
                f"is not a sound MCAP file ({one_line(error)})",
                where=str(path),
                remedy=f"livedeform recover {path} --out FILE",
            ) from error

    def _check(self) -> None:
        head = self._stream.read(len(MAGIC))
        if head != MAGIC:
            what = "is empty" if not head else "is not an MCAP file"
            raise RecordingError(what, where=str(self.path), remedy="name a .mcap file or a rosbag2 folder")
        self._stream.seek(0, os.SEEK_END)
        size = self._stream.tell()
        self._stream.seek(max(size - len(MAGIC), 0))
        if size < 2 * len(MAGIC) or self._stream.read() != MAGIC:
            raise RecordingError(
                "the file is torn: its end is missing, as after a crash while recording",
                where=str(self.path),
                remedy=f"livedeform recover {self.path} --out FILE",
            )
        self._stream.seek(len(MAGIC))

    def _survey(self) -> None:
        """Count the messages of each topic: by the file's statistics, or one by one."""
        self.topics: dict[str, TopicInfo] = {}
        self.start_ns, self.end_ns = NEVER_NS, 0
        if self._index is not None and self._stats is not None and self._index.channels:
            for channel in self._index.channels.values():
                schema = self._index.schemas.get(channel.schema_id)
                self._add(schema, channel, self._stats.channel_message_counts.get(channel.id, 0))
            if self._stats.message_count:
                self.start_ns, self.end_ns = self._stats.message_start_time, self._stats.message_end_time
            return
        for schema, channel, message in self.reader.iter_messages(log_time_order=False):
            if message.log_time > NEVER_NS:
                self.n_beyond += 1
                continue
            self._add(schema, channel, 1)
            self.start_ns = min(self.start_ns, message.log_time)
            self.end_ns = max(self.end_ns, message.log_time)

    def _add(self, schema: Schema | None, channel: Channel, count: int) -> None:
        have = self.topics.get(channel.topic)
        definition = schema_definition(schema)
        info = TopicInfo(channel.topic, schema.name if schema else "", 0, definition, _why_undecodable(schema, channel))
        self.topics[channel.topic] = replace(have or info, count=(have.count if have else 0) + count)

    @property
    def seeks(self) -> bool:
        """Tell whether an index leads to the messages of some time."""
        return self._index is not None and bool(self._index.chunks)

    def messages(self, topics: list[str], start_ns: int | None, stop_ns: int | None) -> Iterator[RawMessage]:
        """Yield the messages in the order of their receive times; of one time in the order of the file."""
        if self._index is not None and self._index.chunks:
            yield from self._by_index(self._index, topics, start_ns or 0, NEVER_NS + 1 if stop_ns is None else stop_ns)
            return
        for schema, channel, message in self.reader.iter_messages(topics, starting_at=start_ns, ending_before=stop_ns):
            if message.log_time <= NEVER_NS:
                name = schema.name if schema else ""
                yield RawMessage(channel.topic, name, message.log_time, message.data, schema_definition(schema))

    def _by_index(
        self, index: chunks.FileIndex, topics: list[str], start_ns: int, stop_ns: int
    ) -> Iterator[RawMessage]:
        """Read only the chunks with messages of the topics in that time; chunks may overlap in time."""
        kinds = {n: c.topic for n, c in index.channels.items() if c.topic in topics}
        schemas = {n: index.schemas.get(index.channels[n].schema_id) for n in kinds}
        types = {n: (schema.name if schema else "", schema_definition(schema)) for n, schema in schemas.items()}
        waiting: list[tuple[int, int, int, int, bytes]] = []  # until no chunk that is left can have earlier ones

        def upto(time_ns: int) -> Iterator[RawMessage]:
            n = bisect_left(waiting, (time_ns,))
            ready = waiting[:n]
            del waiting[:n]
            for time, _, _, channel, data in ready:
                yield RawMessage(kinds[channel], types[channel][0], time, data, types[channel][1])

        for place in sorted(index.chunks, key=lambda place: place.start_ns):
            within = place.end_ns >= start_ns and place.start_ns < stop_ns
            if not within or (place.channels is not None and place.channels.isdisjoint(kinds)):
                continue
            yield from upto(place.start_ns)
            content = chunks.read_chunk(self._stream, place.offset, str(self.path))
            for at, (channel, time_ns, start, stop) in enumerate(chunks.messages(content)):
                if channel not in index.channels:
                    raise ValueError(f"a message is of an unknown channel {channel}")
                if channel in kinds and start_ns <= time_ns < min(stop_ns, NEVER_NS + 1):
                    waiting.append((time_ns, place.offset, at, channel, content[start:stop]))
            waiting.sort()
        yield from upto(NEVER_NS + 1)

    def _metadata(self) -> dict[str, str]:
        records = self._metadata_records() if self._index is not None else self.reader.iter_metadata()
        out: dict[str, str] = {}
        for record in records:
            if record.name == METADATA_NAME:
                out.update(record.metadata)
        return out

    def _metadata_records(self) -> Iterator[Metadata]:
        for offset in self._index.metadata_offsets if self._index is not None else ():
            record = chunks.read_record(Opcode.METADATA, chunks.read_at(self._stream, offset, Opcode.METADATA))
            if isinstance(record, Metadata):
                yield record

    def close(self) -> None:
        self._stream.close()


@lru_cache(maxsize=256)
def _parsed_definition(encoding: str, data: bytes) -> TypeDefinition:
    return TypeDefinition(encoding, data.decode("utf-8", errors="replace"))


def schema_definition(schema: Schema | None) -> TypeDefinition:
    return _parsed_definition(schema.encoding, schema.data) if schema else TypeDefinition("", "")


def _why_undecodable(schema: Schema | None, channel: Channel) -> str:
    """Return why the channel's messages cannot be decoded; empty if they can."""
    if channel.message_encoding != "cdr":
        return f"message encoding '{channel.message_encoding}' is not ROS 2's cdr"
    try:
        typestore(schema.name if schema else "", schema_definition(schema))
    except RecordingError as error:
        return error.what
    return ""


class Rosbag2Storage:
    """A bag in a storage that rosbags reads: sqlite3, or compressed by message or by file."""

    n_beyond = 0  # sqlite's times are signed, as ours
    seeks = True

    def __init__(self, path: Path) -> None:
        self.path = path
        self._reader = Rosbag2Reader(path)
        try:
            self._reader.open()
        except Exception as error:  # rosbags, yaml and sqlite each raise their own
            raise RecordingError(
                f"cannot be read ({one_line(error)})",
                where=str(path),
                remedy="check it with 'ros2 bag info', or record again",
            ) from error
        self.metadata: dict[str, str] = {}
        self.topics: dict[str, TopicInfo] = {}
        for connection in self._reader.connections:
            self._refuse_other(connection.topic, str)  # sqlite keeps anything in any column
            self._refuse_other(connection.msgtype, str)
            definition = _sqlite_definition(connection)
            try:
                typestore(connection.msgtype, definition)
                problem = ""
            except RecordingError as error:
                problem = error.what
            have = self.topics.get(connection.topic)
            count = connection.msgcount + (have.count if have else 0)
            self.topics[connection.topic] = TopicInfo(connection.topic, connection.msgtype, count, definition, problem)
        empty = self._reader.message_count == 0
        self.start_ns = NEVER_NS if empty else self._reader.start_time
        self.end_ns = 0 if empty else self._reader.end_time - 1

    def messages(self, topics: list[str], start_ns: int | None, stop_ns: int | None) -> Iterator[RawMessage]:
        connections = [c for c in self._reader.connections if c.topic in topics]
        if connections:
            for connection, log_time_ns, data in self._reader.messages(connections, start_ns, stop_ns):
                definition = self.topics[connection.topic].definition
                self._refuse_other(log_time_ns, int)
                self._refuse_other(data, bytes)
                yield RawMessage(connection.topic, connection.msgtype, log_time_ns, bytes(data), definition)

    def _refuse_other(self, value: object, kind: type) -> None:
        """Raise RecordingError for a value that is not of the kind that its column has."""
        if not isinstance(value, kind):
            what = f"is damaged: {type(value).__name__} in place of {kind.__name__}"
            raise RecordingError(what, where=str(self.path), remedy="check it with 'ros2 bag info', or record again")

    def close(self) -> None:
        self._reader.close()


def _sqlite_definition(connection: Connection) -> TypeDefinition:
    """Return the type's text, where the storage vouches for it with a type hash.

    Before Iron (2023) sqlite3 bags held no definitions, and converted ones hold placeholders that would decode to
    nonsense without a word: there Jazzy's own definition is used.
    """
    encoding = {MessageDefinitionFormat.MSG: "ros2msg", MessageDefinitionFormat.IDL: "ros2idl"}.get(
        connection.msgdef.format, ""
    )
    if not encoding or (not connection.digest.startswith("RIHS01_") and connection.msgtype in jazzy().fielddefs):
        return TypeDefinition("", "")
    return TypeDefinition(encoding, connection.msgdef.data)


def split_number(path: Path) -> tuple[str, int]:
    """Order x_2.mcap before x_10.mcap."""
    stem, _, number = path.stem.rpartition("_")
    return (stem, int(number)) if number.isdigit() else (path.stem, -1)
