"""MCAP chunks, decompressed within bounds: of a torn one what is there, of a bomb nothing. No ROS."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from io import BytesIO
from typing import IO

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Footer, Message, Metadata, MetadataIndex, Schema, Statistics

from livedeform.common.errors import RecordingError

MAX_CHUNK_BYTES = 1 << 28
"""What one chunk may hold, decompressed: a hundred times the largest that recorders make of pictures."""
RECORD_HEAD = struct.Struct("<BQ")  # opcode, length of what follows
MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, receive time, publish time
INDEX_HEAD = struct.Struct("<QQQQI")  # of a chunk: start, end, offset, length, bytes of the channels' offsets
FOOTER_BYTES = RECORD_HEAD.size + 20 + 8  # with the magic number behind it
CHUNK_HEAD = struct.Struct("<QQQII")  # start, end, bytes uncompressed, crc32, length of the compression's name
FRAME_HEAD_BYTES = 19  # the longest head of an lz4 or zstd frame
HEAD_BYTES = CHUNK_HEAD.size + 16 + 8 + FRAME_HEAD_BYTES
LZ4_RATIO = 255  # at most
PIECE_BYTES = 1 << 16

Readable = Schema | Channel | Message | Metadata | Statistics | MetadataIndex | Footer
READERS: dict[int, Callable[[ReadDataStream], Readable]] = {
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.METADATA: Metadata.read,
    Opcode.STATISTICS: Statistics.read,
    Opcode.METADATA_INDEX: MetadataIndex.read,
    Opcode.FOOTER: Footer.read,
}


@dataclass(frozen=True, slots=True)
class ChunkPlace:
    """A chunk as the file's index has it: receive times (ns), offset of its record, and the channels of its messages,
    None where the index does not say."""

    start_ns: int
    end_ns: int
    offset: int
    channels: frozenset[int] | None


@dataclass(frozen=True)
class FileIndex:
    """The end of a file: ``schemas`` and ``channels`` by number, ``statistics``, chunks, offsets of metadata."""

    schemas: dict[int, Schema]
    channels: dict[int, Channel]
    statistics: Statistics | None
    chunks: list[ChunkPlace]
    metadata_offsets: list[int]


@dataclass(frozen=True)
class ChunkHead:
    """The head of a chunk: bytes and crc32 (0: none) of its content, ``compression``, where its data begin."""

    n_bytes: int
    crc: int
    compression: str
    data_offset: int


def read_head(body: bytes) -> ChunkHead | None:
    """Return the head of a chunk's record; None where even that is torn."""
    if len(body) < CHUNK_HEAD.size:
        return None
    _, _, n_bytes, crc, n_name = CHUNK_HEAD.unpack_from(body)
    data_offset = CHUNK_HEAD.size + n_name + 8
    if n_name > 16 or len(body) < data_offset:
        return None
    name = body[CHUNK_HEAD.size : CHUNK_HEAD.size + n_name].decode("ascii", errors="replace")
    return ChunkHead(n_bytes, crc, name, data_offset)


def sound_content(body: bytes) -> bytes | None:
    """Return the content of a whole chunk record; None where it is not as long as it says or has another checksum."""
    head = read_head(body)
    if head is None or head.n_bytes > MAX_CHUNK_BYTES:
        return None
    content = _decompress(body[head.data_offset :], head.compression, head.n_bytes + 1)
    sound = len(content) == head.n_bytes and (head.crc == 0 or zlib.crc32(content) == head.crc)
    return content if sound else None


def torn_content(body: bytes) -> bytes:
    """Return what can be decompressed of a chunk record whose end is missing."""
    head = read_head(body)
    if head is None or head.n_bytes > MAX_CHUNK_BYTES:
        return b""
    return _decompress(body[head.data_offset :], head.compression, head.n_bytes)


def split(content: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield opcode and body of the records that are whole in a chunk's content, or in a part of it."""
    for opcode, start, stop in places(content):
        yield opcode, content[start:stop]


def places(content: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield opcode, begin and end of the bodies of the records that are whole in a chunk's content."""
    at = 0
    while at + RECORD_HEAD.size <= len(content):
        opcode, length = RECORD_HEAD.unpack_from(content, at)
        at += RECORD_HEAD.size
        if at + length > len(content):
            return
        yield opcode, at, at + length
        at += length


def messages(content: bytes) -> Iterator[tuple[int, int, int, int]]:
    """Yield channel, receive time (ns), and begin and end of the data of the messages in a chunk's content."""
    for opcode, start, stop in places(content):
        if opcode == Opcode.MESSAGE:
            channel, _, time_ns, _ = MESSAGE_HEAD.unpack_from(content, start)
            yield channel, time_ns, start + MESSAGE_HEAD.size, stop


def read_record(opcode: int, body: bytes) -> Readable | None:
    """Return a message, or a record of one of the kinds in ``READERS``; None for any other."""
    stream = ReadDataStream(BytesIO(body))
    reader = READERS.get(opcode)
    record: Readable | None = None
    if opcode == Opcode.MESSAGE:
        record = Message.read(stream, len(body))
    elif reader is not None:
        record = reader(stream)
    return record


def read_index(stream: IO[bytes]) -> FileIndex | None:
    """Return what the end of a whole file says of it, if it says anything.

    ``ValueError`` or ``struct.error`` where it makes no sense.
    """
    stream.seek(-FOOTER_BYTES, os.SEEK_END)
    end = stream.tell()
    opcode, body = next(split(stream.read(FOOTER_BYTES)), (0, b""))
    footer = read_record(opcode, body)
    if not isinstance(footer, Footer):
        raise ValueError("it does not end with a footer")
    if not footer.summary_start:
        return None
    n_bytes = end - footer.summary_start
    if not 0 <= n_bytes <= MAX_CHUNK_BYTES:
        raise ValueError(f"its index would have {n_bytes} bytes")
    stream.seek(footer.summary_start)
    index = FileIndex({}, {}, None, [], [])
    known: dict[frozenset[int] | None, frozenset[int] | None] = {}
    for opcode, body in split(stream.read(n_bytes)):
        record = None if opcode == Opcode.CHUNK_INDEX else read_record(opcode, body)
        if opcode == Opcode.CHUNK_INDEX:
            place = _chunk_place(body)  # many have the same channels: one set is enough
            index.chunks.append(replace(place, channels=known.setdefault(place.channels, place.channels)))
        elif isinstance(record, Schema):
            index.schemas[record.id] = record
        elif isinstance(record, Channel):
            index.channels[record.id] = record
        elif isinstance(record, MetadataIndex):
            index.metadata_offsets.append(record.offset)
        elif isinstance(record, Statistics):
            index = replace(index, statistics=record)
    return index


def _chunk_place(body: bytes) -> ChunkPlace:
    start, end, offset, _, n_bytes = INDEX_HEAD.unpack_from(body)
    pairs = struct.unpack_from("<" + n_bytes // 10 * "HQ", body, INDEX_HEAD.size)
    return ChunkPlace(start, end, offset, frozenset(pairs[::2]) or None)


def read_at(stream: IO[bytes], offset: int, opcode: int, most: int = -1) -> bytes:
    """Return the body of the record of that kind at ``offset``, or its first ``most`` bytes.

    ``ValueError`` where there is none.
    """
    stream.seek(offset)
    head = stream.read(RECORD_HEAD.size)
    found, length = RECORD_HEAD.unpack(head) if len(head) == RECORD_HEAD.size else (-1, 0)
    if found != opcode or (most < 0 and length > 2 * MAX_CHUNK_BYTES):
        raise ValueError(f"there is no record of the kind {int(opcode)} at byte {offset}")
    return stream.read(length if most < 0 else min(length, most))


def read_chunk(stream: IO[bytes], offset: int, where: str) -> bytes:
    """Return the content of the chunk at ``offset``; ``ValueError`` for one that is damaged.

    ``RecordingError`` for one that holds more than `MAX_CHUNK_BYTES`.
    """
    refuse_bomb(read_at(stream, offset, Opcode.CHUNK, HEAD_BYTES), where)
    content = sound_content(read_at(stream, offset, Opcode.CHUNK))
    if content is None:
        raise ValueError(f"the chunk at byte {offset} has another checksum or length")
    return content


def file_records(stream: IO[bytes], head_bytes: int | None = None) -> Iterator[tuple[int, bytes, bool]]:
    """Yield opcode, body and whether that is whole of every record from the ``stream``'s place on.

    With ``head_bytes`` only so much of each body is read, and the rest is passed over.
    """
    place = stream.tell()
    size = stream.seek(0, os.SEEK_END)
    while place + RECORD_HEAD.size <= size:
        stream.seek(place)
        opcode, length = RECORD_HEAD.unpack(stream.read(RECORD_HEAD.size))
        place += RECORD_HEAD.size + length
        wanted = min(length, size - stream.tell())
        body = stream.read(wanted if head_bytes is None else min(wanted, head_bytes))
        yield opcode, body, place <= size
        if opcode == Opcode.FOOTER:
            return


def refuse_bombs(stream: IO[bytes], where: str) -> None:
    """Raise ``RecordingError`` if a chunk holds more than `MAX_CHUNK_BYTES`, or more than it says.

    ``stream`` is an MCAP file behind its magic number; of each chunk only the head is read.
    """
    for opcode, body, _ in file_records(stream, HEAD_BYTES):
        if opcode == Opcode.CHUNK:
            refuse_bomb(body, where)


def refuse_bomb(body: bytes, where: str) -> None:
    """Raise ``RecordingError`` if the chunk's record, of which the begin is enough, holds more than it may."""
    head = read_head(body)
    if head is None:
        return
    (n_compressed,) = struct.unpack_from("<Q", body, head.data_offset - 8)
    frame = body[head.data_offset : head.data_offset + FRAME_HEAD_BYTES]
    n_bytes = max(head.n_bytes, _announced(frame, head.compression, n_compressed))
    if n_bytes > MAX_CHUNK_BYTES:
        raise RecordingError(
            f"a chunk of {n_compressed} bytes would take {n_bytes >> 20} MB",
            where=where,
            remedy=f"chunks of up to {MAX_CHUNK_BYTES >> 20} MB are read: record with smaller ones",
        )


def _announced(frame: bytes, compression: str, n_compressed: int) -> int:
    """Return how many bytes the head of a compressed frame says that it holds, or the most that it can; 0 if unknown
    and limited by what the chunk says."""
    try:
        if compression == "zstd":
            return max(zstandard.frame_content_size(frame), 0)
        if compression == "lz4":
            return int(lz4.frame.get_frame_info(frame)["content_size"]) or LZ4_RATIO * n_compressed
    except (zstandard.ZstdError, RuntimeError, ValueError):  # damaged: found out where it is read
        return 0
    return 0


def _decompress(data: bytes, compression: str, limit: int) -> bytes:
    """Return the first ``limit`` bytes, or as many as there are before the data end or make no sense."""
    if compression == "zstd":
        return b"".join(_zstd(data, limit))
    if compression == "lz4":
        return b"".join(_lz4(data, limit))
    return data[:limit] if compression == "" else b""


def _zstd(data: bytes, limit: int) -> Iterator[bytes]:
    reader = zstandard.ZstdDecompressor().stream_reader(BytesIO(data))
    while limit > 0:
        try:
            piece = reader.read(min(PIECE_BYTES, limit))
        except zstandard.ZstdError:
            return
        if not piece:
            return
        limit -= len(piece)
        yield piece


def _lz4(data: bytes, limit: int) -> Iterator[bytes]:
    reader = lz4.frame.LZ4FrameDecompressor()
    while limit > 0 and not reader.eof:
        try:
            piece = reader.decompress(data, max_length=min(PIECE_BYTES, limit))
        except RuntimeError:
            return
        if not piece and reader.needs_input:
            return
        data = b""
        limit -= len(piece)
        yield piece
