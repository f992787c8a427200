"""Writing bags: one MCAP file, or a rosbag2 folder that ``ros2 bag``, Foxglove and rosbags open. No ROS."""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import yaml
from mcap.data_stream import RecordBuilder
from mcap.records import ChunkIndex
from mcap.writer import CompressionType, Writer

from livedeform.common.bags.storage import METADATA_NAME, NEVER_NS
from livedeform.common.bags.types import TypeDefinition, jazzy_definition, type_hash
from livedeform.common.errors import RecordingError
from livedeform.common.topics import LATCHED_DEPTH, LOADED, TOPICS

__all__ = ["BagWriter"]

PARTIAL = ".partial"
FLUSH_SECONDS = 1.0
CHUNK_BYTES = 1 << 18
RECORD_HEAD = 9  # bytes: opcode and length of an MCAP record
RECORD_BYTES = RECORD_HEAD + 22  # of a message's record, beside its data
COMPRESSIONS = {"none": CompressionType.NONE, "lz4": CompressionType.LZ4, "zstd": CompressionType.ZSTD}


class BagWriter:
    """Writes a single ``x.mcap`` or, for any other path, a rosbag2 folder; a context manager.

    The messages that a recording is loaded from (`LOADED`) are in chunks of their own, and pictures and meshes between
    them: whoever wants the former does not read the latter.
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
        self._index = _IndexOnDisk(file.parent)
        setattr(self._writer, "_Writer__chunk_indices", self._index)  # noqa: B010
        self._writer.start(profile="ros2", library="livedeform")
        if self.metadata:
            self._writer.add_metadata(METADATA_NAME, self.metadata)
        self._channels: dict[tuple[str, str], int] = {}
        self._schemas: dict[str, int] = {}
        self._counts: dict[tuple[str, str], int] = {}
        self._waiting: list[tuple[int, int, bytes, int]] = []  # of the chunk to come: channel, time, data, sequence
        self._n_waiting = 0  # bytes
        self._definitions: dict[str, TypeDefinition] = {}
        self._start_ns, self._end_ns = NEVER_NS, 0
        self._last_flush = time.monotonic()
        self._closed = False
        self.flush()

    @property
    def n_messages(self) -> int:
        return sum(self._counts.values())

    def write(
        self, topic: str, type_name: str, log_time_ns: int, data: bytes, definition: TypeDefinition | None = None
    ) -> None:
        """Append one serialised message; ``definition`` is needed for types that are not ROS 2 Jazzy's."""
        key = (topic, type_name)
        channel = self._channels.get(key)
        if channel is None:
            channel = self._add_channel(topic, type_name, definition)
        if topic in LOADED:
            self._waiting.append((channel, log_time_ns, data, self._counts[key]))
            self._n_waiting += RECORD_BYTES + len(data)
            if self._n_waiting > CHUNK_BYTES:
                self._end_chunks()
        else:
            self._writer.add_message(channel, log_time_ns, data, log_time_ns, sequence=self._counts[key])
        self._counts[key] += 1
        self._start_ns = min(self._start_ns, log_time_ns)
        self._end_ns = max(self._end_ns, log_time_ns)
        if time.monotonic() - self._last_flush > FLUSH_SECONDS:
            self.flush()

    def add_metadata(self, metadata: Mapping[str, str]) -> None:
        """Add key-value pairs (what is known only at the end, as counts of lost messages)."""
        self.metadata.update(metadata)
        self._end_chunks()
        self._writer.add_metadata(METADATA_NAME, dict(metadata))

    def flush(self) -> None:
        """End the chunks and hand everything to the operating system."""
        self._end_chunks()
        self._stream.flush()
        self._last_flush = time.monotonic()

    def _end_chunks(self) -> None:
        """Write the chunk of the other messages, and then that of the loaded ones."""
        waiting, self._waiting, self._n_waiting = self._waiting, [], 0
        self._writer.flush()
        for channel, log_time_ns, data, sequence in waiting:
            self._writer.add_message(channel, log_time_ns, data, log_time_ns, sequence=sequence)
        if waiting:
            self._writer.flush()

    def _add_channel(self, topic: str, type_name: str, definition: TypeDefinition | None) -> int:
        if type_name not in self._schemas:
            known = definition if definition is not None and definition.text else jazzy_definition(type_name)
            self._definitions[type_name] = known
            self._schemas[type_name] = self._writer.register_schema(type_name, known.encoding, known.text.encode())
        description = {
            "offered_qos_profiles": yaml.safe_dump(_qos(topic)),
            "topic_type_hash": type_hash(type_name, self._definitions[type_name]),
        }
        channel = self._writer.register_channel(topic, "cdr", self._schemas[type_name], description)
        self._channels[(topic, type_name)] = channel
        self._counts[(topic, type_name)] = 0
        return channel

    def close(self) -> None:
        """End the file with its index, and the folder with its ``metadata.yaml``."""
        if self._closed:
            return
        self._closed = True
        self._end_chunks()
        self._writer.finish()
        self._index.close()
        self._stream.close()
        if not self._single:
            text = yaml.safe_dump({"rosbag2_bagfile_information": self._information()}, sort_keys=False)
            (self._target / "metadata.yaml").write_text(text)
        if self._atomic:
            os.replace(self._target, self.path)

    def _discard(self) -> None:
        self._closed = True
        self._index.close()
        with suppress(OSError):  # what was to be written yet does not fit on the disk
            self._stream.close()
        _remove(self._target)

    def _information(self) -> dict[str, Any]:
        """Return ``metadata.yaml`` of rosbag2, version 9 (Jazzy)."""
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
                        "type_description_hash": type_hash(type_name, self._definitions[type_name]),
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
        if not self._atomic:
            self.close()
        elif kind is not None:
            self._discard()
        else:
            try:
                self.close()
            except OSError:
                self._discard()
                raise


class _IndexOnDisk:
    """Stand for mcap's list of chunk indices, until the file's end is written: an hour of two cameras has 200 000 of
    them, at 0.5 kB of memory each. They are kept in a file without a name."""

    def __init__(self, folder: Path) -> None:
        self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115

    def append(self, index: ChunkIndex) -> None:
        builder = RecordBuilder()
        index.write(builder)
        self._file.write(builder.end())

    def __iter__(self) -> Iterator[_WrittenRecord]:
        self._file.seek(0)
        while head := self._file.read(RECORD_HEAD):
            yield _WrittenRecord(head + self._file.read(int.from_bytes(head[1:], "little")))

    def close(self) -> None:
        self._file.close()


@dataclass(frozen=True)
class _WrittenRecord:
    """Hold a record as it is written."""

    data: bytes

    def write(self, builder: RecordBuilder) -> None:
        builder.write(self.data)


def _remove(path: Path | None) -> None:
    if path is None or not path.exists():
        return
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink()


def _qos(topic: str) -> list[dict[str, Any]]:
    """Return the offered quality of service that a replay restores; only latched topics differ from the default."""
    known = TOPICS.get(topic)
    if known is None or not known.latched:
        return []
    forever = {"sec": 9223372036, "nsec": 854775807}
    return [
        {
            "history": "keep_last",
            "depth": LATCHED_DEPTH,
            "reliability": "reliable",
            "durability": "transient_local",
            "deadline": forever,
            "lifespan": forever,
            "liveliness": "automatic",
            "liveliness_lease_duration": forever,
            "avoid_ros_namespace_conventions": False,
        }
    ]
