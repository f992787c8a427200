"""Bags: reading (MCAP alone or as a rosbag2 folder, split or not; sqlite3), writing, and recovering torn files. No ROS.

The only module that knows mcap and rosbags. What others recorded is taken as it comes: a topic whose schema cannot be
parsed is skipped with a warning, and the rest is read.
"""

from __future__ import annotations

import heapq
import os
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

import yaml
from mcap.reader import McapReader, make_reader
from mcap.records import Channel, Chunk, Message, Metadata, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType, Writer
from rosbags.interfaces import Connection, MessageDefinitionFormat
from rosbags.rosbag2 import Reader as Rosbag2Reader
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from livedeform.common import topics as t
from livedeform.common.errors import RecordingError

MAGIC = b"\x89MCAP0\r\n"
METADATA_NAME = "livedeform"
PARTIAL = ".partial"
FLUSH_SECONDS = 1.0
CHUNK_BYTES = 1 << 20
LATCHED_TOPICS = frozenset({t.TF_STATIC, t.LEFT_CAMERA_INFO, t.RIGHT_CAMERA_INFO, t.FEM_MESH})
COMPRESSIONS = {"none": CompressionType.NONE, "lz4": CompressionType.LZ4, "zstd": CompressionType.ZSTD}


@dataclass(frozen=True)
class TypeDefinition:
    """A message type's text: ``encoding`` ros2msg or ros2idl, empty where the bag holds none."""

    encoding: str
    text: str


@dataclass(frozen=True)
class TopicInfo:
    """A topic of a bag. ``problem`` says why it cannot be decoded; empty if it can."""

    name: str
    type: str
    count: int
    definition: TypeDefinition
    problem: str = ""


@dataclass(frozen=True)
class RawMessage:
    """One serialised message (CDR)."""

    topic: str
    type: str
    log_time_ns: int
    data: bytes
    definition: TypeDefinition = field(default=TypeDefinition("", ""), repr=False)


# --- types -----------------------------------------------------------------------------------------------------------


@lru_cache(maxsize=1)
def _jazzy() -> Typestore:
    return get_typestore(Stores.ROS2_JAZZY)


@lru_cache(maxsize=256)
def _typestore(type_name: str, definition: TypeDefinition) -> Typestore:
    """The types that one schema defines, or Jazzy's where there is no schema; ``RecordingError`` if neither serves."""
    remedy = "the topic is skipped; the rest of the bag is used"
    if not definition.text.strip():
        if type_name not in _jazzy().fielddefs:
            raise RecordingError(f"type '{type_name}' is unknown and the bag holds no schema for it", remedy=remedy)
        return _jazzy()
    parse = {"ros2msg": get_types_from_msg, "ros2idl": lambda text, _: get_types_from_idl(text)}.get(
        definition.encoding
    )
    if parse is None:
        raise RecordingError(f"schema encoding '{definition.encoding}' is not a ROS 2 one", remedy=remedy)
    try:
        store = get_typestore(Stores.EMPTY)
        store.register(parse(definition.text, type_name))
        store.get_msgdef(type_name)
    except Exception as error:  # the parsers raise many kinds on schemas that are not quite ROS's
        raise RecordingError(
            f"the schema of type '{type_name}' cannot be parsed ({_words(error)})", remedy=remedy
        ) from error
    return store


def decode(raw: RawMessage) -> Any:
    """The message as an object with the fields of its type; ``RecordingError`` if its bytes do not fit the type."""
    store = _typestore(raw.type, raw.definition)
    try:
        return store.deserialize_cdr(raw.data, raw.type)
    except Exception as error:  # truncated or foreign bytes fail in many ways inside the generated decoder
        raise RecordingError(
            f"a message at {raw.log_time_ns} ns cannot be decoded as {raw.type} ({error})",
            where=raw.topic,
            remedy="the message is damaged; 'livedeform info' counts such messages",
        ) from error


def message_class(type_name: str) -> Callable[..., Any]:
    """The rosbags class of a Jazzy message type, to fill and ``encode`` without ROS."""
    return _jazzy().types[type_name]


def encode(message: Any) -> bytes:
    """CDR of a message made with ``message_class``."""
    return bytes(_jazzy().serialize_cdr(message, message.__msgtype__))


def _jazzy_definition(type_name: str) -> TypeDefinition:
    if type_name not in _jazzy().fielddefs:
        raise RecordingError(f"message type '{type_name}' is unknown", remedy="pass its definition to BagWriter.write")
    text, _ = _jazzy().generate_msgdef(type_name, ros_version=2)
    return TypeDefinition("ros2msg", text)


def _type_hash(type_name: str, definition: TypeDefinition) -> str:
    try:
        return _typestore(type_name, definition).hash_rihs01(type_name)
    except (RecordingError, KeyError):
        return ""


# --- reading ---------------------------------------------------------------------------------------------------------


def _words(error: Exception) -> str:
    """What a library says, in one short line."""
    return " ".join(str(error).split())[:100] or type(error).__name__


class _McapFile:
    """One MCAP file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._stream: IO[bytes] = path.open("rb")
        try:
            self._check()
            self.reader: McapReader = make_reader(self._stream, validate_crcs=True)
            self._index()
            self.metadata = self._metadata()
        except RecordingError:
            self._stream.close()
            raise
        except Exception as error:  # damaged bytes make mcap raise many kinds, not all of them its own
            self._stream.close()
            raise RecordingError(
                f"is not a sound MCAP file ({_words(error)})",
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
        self._stream.seek(0)

    def _index(self) -> None:
        summary = self.reader.get_summary()
        self.topics: dict[str, TopicInfo] = {}
        self.start_ns, self.end_ns = 2**63 - 1, 0
        if summary is not None and summary.statistics is not None and summary.channels:
            stats = summary.statistics
            for channel in summary.channels.values():
                schema = summary.schemas.get(channel.schema_id)
                self._add(schema, channel, stats.channel_message_counts.get(channel.id, 0))
            if stats.message_count:
                self.start_ns, self.end_ns = stats.message_start_time, stats.message_end_time
            return
        for schema, channel, message in self.reader.iter_messages(log_time_order=False):
            self._add(schema, channel, 1)
            self.start_ns = min(self.start_ns, message.log_time)
            self.end_ns = max(self.end_ns, message.log_time)

    def _add(self, schema: Schema | None, channel: Channel, count: int) -> None:
        have = self.topics.get(channel.topic)
        definition = _definition(schema)
        info = TopicInfo(channel.topic, schema.name if schema else "", 0, definition, _problem(schema, channel))
        self.topics[channel.topic] = replace(have or info, count=(have.count if have else 0) + count)

    def messages(self, topics: list[str], start_ns: int | None, stop_ns: int | None) -> Iterator[RawMessage]:
        found = self.reader.iter_messages(topics=topics, starting_at=start_ns, ending_before=stop_ns)
        for schema, channel, message in found:
            name = schema.name if schema else ""
            yield RawMessage(channel.topic, name, message.log_time, message.data, _definition(schema))

    def _metadata(self) -> dict[str, str]:
        out: dict[str, str] = {}
        for record in self.reader.iter_metadata():
            if record.name == METADATA_NAME:
                out.update(record.metadata)
        return out

    def close(self) -> None:
        self._stream.close()


@lru_cache(maxsize=256)
def _parsed_definition(encoding: str, data: bytes) -> TypeDefinition:
    return TypeDefinition(encoding, data.decode("utf-8", errors="replace"))


def _definition(schema: Schema | None) -> TypeDefinition:
    return _parsed_definition(schema.encoding, schema.data) if schema else TypeDefinition("", "")


def _problem(schema: Schema | None, channel: Channel) -> str:
    """Why the channel's messages cannot be decoded; empty if they can."""
    if channel.message_encoding != "cdr":
        return f"message encoding '{channel.message_encoding}' is not ROS 2's cdr"
    try:
        _typestore(schema.name if schema else "", _definition(schema))
    except RecordingError as error:
        return error.what
    return ""


class _Rosbag2:
    """A bag in a storage that rosbags reads: sqlite3, or compressed by message or by file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._reader = Rosbag2Reader(path)
        try:
            self._reader.open()
        except Exception as error:  # rosbags, yaml and sqlite each raise their own
            raise RecordingError(
                f"cannot be read ({_words(error)})",
                where=str(path),
                remedy="check it with 'ros2 bag info', or record again",
            ) from error
        self.metadata: dict[str, str] = {}
        self.topics: dict[str, TopicInfo] = {}
        for connection in self._reader.connections:
            definition = _sqlite_definition(connection)
            try:
                _typestore(connection.msgtype, definition)
                problem = ""
            except RecordingError as error:
                problem = error.what
            have = self.topics.get(connection.topic)
            count = connection.msgcount + (have.count if have else 0)
            self.topics[connection.topic] = TopicInfo(connection.topic, connection.msgtype, count, definition, problem)
        empty = self._reader.message_count == 0
        self.start_ns = 2**63 - 1 if empty else self._reader.start_time
        self.end_ns = 0 if empty else self._reader.end_time - 1

    def messages(self, topics: list[str], start_ns: int | None, stop_ns: int | None) -> Iterator[RawMessage]:
        connections = [c for c in self._reader.connections if c.topic in topics]
        if connections:
            for connection, log_time_ns, data in self._reader.messages(connections, start_ns, stop_ns):
                definition = self.topics[connection.topic].definition
                yield RawMessage(connection.topic, connection.msgtype, log_time_ns, bytes(data), definition)

    def close(self) -> None:
        self._reader.close()


def _sqlite_definition(connection: Connection) -> TypeDefinition:
    """The type's text, where the storage vouches for it with a type hash.

    Before Iron (2023) sqlite3 bags held no definitions, and converted ones hold placeholders that would decode to
    nonsense without a word: there Jazzy's own definition is used.
    """
    encoding = {MessageDefinitionFormat.MSG: "ros2msg", MessageDefinitionFormat.IDL: "ros2idl"}.get(
        connection.msgdef.format, ""
    )
    if not encoding or (not connection.digest.startswith("RIHS01_") and connection.msgtype in _jazzy().fielddefs):
        return TypeDefinition("", "")
    return TypeDefinition(encoding, connection.msgdef.data)


class BagReader:
    """A bag opened for reading; a context manager.

    ``topics`` by name, ``start_ns`` and ``end_ns`` of the receive times (0 if empty), ``metadata`` of the writer,
    ``warnings`` one line each.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.warnings: list[str] = []
        self.metadata: dict[str, str] = {}
        self.topics: dict[str, TopicInfo] = {}
        self._parts: list[_McapFile | _Rosbag2] = []
        self._stack = ExitStack()
        with ExitStack() as opening:
            for part in self._open(path):
                opening.callback(part.close)
                self._parts.append(part)
                self.metadata.update(part.metadata)
            self._stack = opening.pop_all()
        self._join()

    def _open(self, path: Path) -> Iterator[_McapFile | _Rosbag2]:
        if not path.exists():
            raise RecordingError(
                "the bag does not exist", where=str(path), remedy="name a .mcap file or a rosbag2 folder"
            )
        if path.is_file():
            yield self._open_file(path)
            return
        described = path / "metadata.yaml"
        files = sorted(path.glob("*.mcap"), key=_split_number)
        if described.is_file():
            information = _folder_information(described)
            self.metadata.update({str(k): str(v) for k, v in (information.get("custom_data") or {}).items()})
            if information.get("compression_mode") or information.get("storage_identifier") not in ("mcap", "sqlite3"):
                yield _Rosbag2(path)
                return
            # file by file: for a whole folder rosbags 0.11 drops every topic whose QoS differs between metadata.yaml
            # and the database, and does not interleave the files of a split bag
            files = [path / Path(name).name for name in information.get("relative_file_paths") or []]
            missing = [file.name for file in files if not file.is_file()]
            if missing:
                raise RecordingError(
                    f"{', '.join(missing)} is missing", where=str(path), remedy="copy the whole folder of the bag"
                )
        elif files:
            self.warnings.append(f"{path}: there is no metadata.yaml; every .mcap file in the folder is read")
        else:
            databases = sorted(path.glob("*.db3"))
            if not databases:
                raise RecordingError(
                    "there is no bag in this folder", where=str(path), remedy="name a .mcap file or a bag"
                )
            self.warnings.append(f"{path}: there is no metadata.yaml; every .db3 file in the folder is read")
            files = databases
        for file in files:
            yield self._open_file(file)

    def _open_file(self, file: Path) -> _McapFile | _Rosbag2:
        if file.suffix == ".bag":
            raise RecordingError(
                "this is a ROS 1 bag",
                where=str(file),
                remedy=f"rosbags-convert --src {file} --dst {file.with_suffix('')}",
            )
        return _Rosbag2(file) if file.suffix == ".db3" else _McapFile(file)

    def _join(self) -> None:
        for part in self._parts:
            for name, info in part.topics.items():
                have = self.topics.get(name)
                self.topics[name] = replace(have, count=have.count + info.count) if have else info
        self.start_ns = min((part.start_ns for part in self._parts), default=0)
        self.end_ns = max((part.end_ns for part in self._parts), default=0)
        if self.start_ns > self.end_ns:
            self.start_ns = self.end_ns = 0
        for info in self.topics.values():
            if info.problem:
                self.warnings.append(f"{self.path}: topic {info.name} is skipped: {info.problem}")

    @property
    def n_messages(self) -> int:
        return sum(info.count for info in self.topics.values())

    def messages(
        self, topics: Iterable[str] | None = None, start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[RawMessage]:
        """The messages of ``topics`` (default: all that can be decoded) in the order of their receive time.

        ``start_ns`` <= receive time < ``stop_ns``; a topic that is named is given even where it cannot be decoded.
        """
        if topics is None:
            names = [info.name for info in self.topics.values() if not info.problem]
        else:
            names = [name for name in topics if name in self.topics]
        sources = [part.messages(names, start_ns, stop_ns) for part in self._parts]
        try:
            yield from heapq.merge(*sources, key=lambda raw: raw.log_time_ns) if len(sources) > 1 else sources[0]
        except Exception as error:  # only the storage can fail here: what the caller raises does not come in
            raise RecordingError(
                f"is damaged ({_words(error)})",
                where=str(self.path),
                remedy=f"livedeform recover {self.path} --out FILE",
            ) from error

    def close(self) -> None:
        self._stack.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def read_bag(path: Path | str) -> BagReader:
    """Opens a bag: a .mcap or .db3 file, a rosbag2 folder, or a folder that holds one of them."""
    return BagReader(Path(path))


def _folder_information(described: Path) -> dict[str, Any]:
    try:
        document = yaml.safe_load(described.read_text())
        return dict(document["rosbag2_bagfile_information"])
    except (yaml.YAMLError, TypeError, KeyError, ValueError) as error:
        raise RecordingError(
            "is not the description of a rosbag2 folder", where=str(described), remedy="name the .mcap file itself"
        ) from error


def _split_number(path: Path) -> tuple[str, int]:
    """Orders x_2.mcap before x_10.mcap."""
    stem, _, number = path.stem.rpartition("_")
    return (stem, int(number)) if number.isdigit() else (path.stem, -1)


# --- writing ---------------------------------------------------------------------------------------------------------


class BagWriter:
    """Writes a single ``x.mcap`` or, for any other path, a rosbag2 folder; a context manager.

    Refuses to overwrite. What was written is on disk after ``FLUSH_SECONDS`` at the latest, as long as ``write`` or
    ``flush`` is called: a killed process leaves a file that ``recover`` reads. An ordinary exception or Ctrl-C inside
    the ``with`` still ends the file properly. With ``atomic``, for conversions, the file appears only when it is
    complete, and an exception leaves nothing behind.
    """

    def __init__(
        self,
        path: Path | str,
        metadata: Mapping[str, str] | None = None,
        *,
        compression: str = "none",
        atomic: bool = False,
    ) -> None:
        self.path = Path(path)
        if self.path.exists():
            raise RecordingError(
                "exists already", where=str(self.path), remedy="choose another name or delete it first"
            )
        self.metadata = dict(metadata or {})
        self._atomic = atomic
        self._target = self.path.with_name(self.path.name + PARTIAL) if atomic else self.path
        self._single = self.path.suffix == ".mcap"
        _remove(self._target if atomic else None)
        (self._target.parent if self._single else self._target).mkdir(parents=True, exist_ok=True)
        file = self._target if self._single else self._target / f"{self.path.name}_0.mcap"
        self._file_name = file.name
        self._stream = file.open("xb")
        self._writer = Writer(self._stream, chunk_size=CHUNK_BYTES, compression=COMPRESSIONS[compression])
        self._writer.start(profile="ros2", library="livedeform")
        if self.metadata:
            self._writer.add_metadata(METADATA_NAME, self.metadata)
        self._channels: dict[tuple[str, str], int] = {}
        self._schemas: dict[str, int] = {}
        self._counts: dict[tuple[str, str], int] = {}
        self._definitions: dict[str, TypeDefinition] = {}
        self._start_ns, self._end_ns = 2**63 - 1, 0
        self._last_flush = time.monotonic()
        self._closed = False
        self.flush()

    @property
    def n_messages(self) -> int:
        return sum(self._counts.values())

    def write(
        self, topic: str, type_name: str, log_time_ns: int, data: bytes, definition: TypeDefinition | None = None
    ) -> None:
        """Appends one serialised message; ``definition`` is needed for types that are not ROS 2 Jazzy's."""
        key = (topic, type_name)
        channel = self._channels.get(key)
        if channel is None:
            channel = self._add_channel(topic, type_name, definition)
        self._writer.add_message(channel, log_time_ns, data, log_time_ns, sequence=self._counts[key])
        self._counts[key] += 1
        self._start_ns = min(self._start_ns, log_time_ns)
        self._end_ns = max(self._end_ns, log_time_ns)
        if time.monotonic() - self._last_flush > FLUSH_SECONDS:
            self.flush()

    def add_metadata(self, metadata: Mapping[str, str]) -> None:
        """Adds key-value pairs (what is known only at the end, as counts of lost messages)."""
        self.metadata.update(metadata)
        self._writer.flush()
        self._writer.add_metadata(METADATA_NAME, dict(metadata))

    def flush(self) -> None:
        """Ends the chunk and hands everything to the operating system."""
        self._writer.flush()
        self._stream.flush()
        self._last_flush = time.monotonic()

    def _add_channel(self, topic: str, type_name: str, definition: TypeDefinition | None) -> int:
        if type_name not in self._schemas:
            known = definition if definition is not None and definition.text else _jazzy_definition(type_name)
            self._definitions[type_name] = known
            self._schemas[type_name] = self._writer.register_schema(type_name, known.encoding, known.text.encode())
        description = {
            "offered_qos_profiles": yaml.safe_dump(_qos(topic)),
            "topic_type_hash": _type_hash(type_name, self._definitions[type_name]),
        }
        channel = self._writer.register_channel(topic, "cdr", self._schemas[type_name], description)
        self._channels[(topic, type_name)] = channel
        self._counts[(topic, type_name)] = 0
        return channel

    def close(self) -> None:
        """Ends the file with its index, and the folder with its ``metadata.yaml``."""
        if self._closed:
            return
        self._closed = True
        self._writer.finish()
        self._stream.close()
        if not self._single:
            text = yaml.safe_dump({"rosbag2_bagfile_information": self._information()}, sort_keys=False)
            (self._target / "metadata.yaml").write_text(text)
        if self._atomic:
            os.replace(self._target, self.path)

    def _discard(self) -> None:
        self._closed = True
        self._stream.close()
        _remove(self._target)

    def _information(self) -> dict[str, Any]:
        """``metadata.yaml`` of rosbag2, version 9 (Jazzy)."""
        n = self.n_messages
        start = {"nanoseconds_since_epoch": self._start_ns if n else 0}
        duration = {"nanoseconds": max(self._end_ns - self._start_ns, 0) if n else 0}
        return {
            "version": 9,
            "storage_identifier": "mcap",
            "duration": duration,
            "starting_time": start,
            "message_count": n,
            "topics_with_message_count": [
                {
                    "topic_metadata": {
                        "name": topic,
                        "type": type_name,
                        "serialization_format": "cdr",
                        "offered_qos_profiles": _qos(topic),
                        "type_description_hash": _type_hash(type_name, self._definitions[type_name]),
                    },
                    "message_count": count,
                }
                for (topic, type_name), count in self._counts.items()
            ],
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [self._file_name],
            "files": [{"path": self._file_name, "starting_time": start, "duration": duration, "message_count": n}],
            "custom_data": self.metadata or None,
            "ros_distro": "jazzy",
        }

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None and self._atomic:
            self._discard()
        else:
            self.close()


def _remove(path: Path | None) -> None:
    if path is None or not path.exists():
        return
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink()


def _qos(topic: str) -> list[dict[str, Any]]:
    """The offered quality of service that a replay restores; only latched topics differ from the default."""
    if topic not in LATCHED_TOPICS:
        return []
    forever = {"sec": 9223372036, "nsec": 854775807}
    return [
        {
            "history": "keep_last",
            "depth": 1,
            "reliability": "reliable",
            "durability": "transient_local",
            "deadline": forever,
            "lifespan": forever,
            "liveliness": "automatic",
            "liveliness_lease_duration": forever,
            "avoid_ros_namespace_conventions": False,
        }
    ]


# --- recovery --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class RecoveryReport:
    """What ``recover`` saved: messages, damaged chunks that were left out, and where reading ended."""

    n_messages: int
    n_bad_chunks: int
    n_bytes_read: int
    n_bytes: int


def recover(path: Path | str, out: Path | str) -> RecoveryReport:
    """Copies what can be read of a torn MCAP file, or of a folder of them, into the new bag ``out``."""
    source = Path(path)
    files = sorted(source.glob("*.mcap"), key=_split_number) if source.is_dir() else [source]
    if not files or not all(file.is_file() for file in files):
        raise RecordingError("there is no MCAP file", where=str(path), remedy="name a torn .mcap file or its folder")
    n_messages = n_bad = n_read = n_bytes = 0
    with BagWriter(out, {"recovered_from": str(source)}, atomic=True) as writer:
        for file in files:
            salvage = _Salvage(file)
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


class _Salvage:
    """Reads a file record by record until it ends or makes no sense, leaving out chunks that are damaged."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self.metadata: list[dict[str, str]] = []
        self.n_bad_chunks = 0
        self.n_bytes_read = 0

    def messages(self) -> Iterator[RawMessage]:
        with self._path.open("rb") as stream:
            records = StreamReader(stream, emit_chunks=True).records
            while True:
                try:
                    record = next(records)
                except Exception:  # StopIteration, or whatever damaged bytes make mcap raise
                    return
                self.n_bytes_read = stream.tell()
                yield from self._chunk(record) if isinstance(record, Chunk) else self._record(record)

    def _chunk(self, chunk: Chunk) -> Iterator[RawMessage]:
        try:
            records = breakup_chunk(chunk, validate_crc=True)
        except Exception:  # lz4, zstd and struct each fail in their own way on damaged bytes
            self.n_bad_chunks += 1
            return
        for record in records:
            yield from self._record(record)

    def _record(self, record: Any) -> Iterator[RawMessage]:
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
                yield RawMessage(channel.topic, schema.name, record.log_time, record.data, _definition(schema))
