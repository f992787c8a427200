"""MCAP chunks, decompressed within bounds: of a torn one what is there, of a bomb nothing. No ROS."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from typing import IO

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Message, Metadata, Schema

from livedeform.common.errors import RecordingError

MAX_CHUNK_BYTES = 1 << 28
"""What one chunk may hold, decompressed: a hundred times the largest that recorders make of pictures."""
RECORD_HEAD = struct.Struct("<BQ")  # opcode, length of what follows
CHUNK_HEAD = struct.Struct("<QQQII")  # start, end, bytes uncompressed, crc32, length of the compression's name
FRAME_HEAD_BYTES = 19  # the longest head of an lz4 or zstd frame
LZ4_RATIO = 255  # at most
PIECE_BYTES = 1 << 16

Readable = Schema | Channel | Message | Metadata


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
    at = 0
    while at + RECORD_HEAD.size <= len(content):
        opcode, length = RECORD_HEAD.unpack_from(content, at)
        at += RECORD_HEAD.size
        if at + length > len(content):
            return
        yield opcode, content[at : at + length]
        at += length


def read_record(opcode: int, body: bytes) -> Readable | None:
    """Return a schema, channel, message or metadata record; None for any other kind."""
    stream = ReadDataStream(BytesIO(body))
    record: Readable | None = None
    if opcode == Opcode.MESSAGE:
        record = Message.read(stream, len(body))
    elif opcode == Opcode.SCHEMA:
        record = Schema.read(stream)
    elif opcode == Opcode.CHANNEL:
        record = Channel.read(stream)
    elif opcode == Opcode.METADATA:
        record = Metadata.read(stream)
    return record


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
    for opcode, body, _ in file_records(stream, CHUNK_HEAD.size + 16 + 8 + FRAME_HEAD_BYTES):
        head = read_head(body) if opcode == Opcode.CHUNK else None
        if head is None:
            continue
        (n_compressed,) = struct.unpack_from("<Q", body, head.data_offset - 8)
        n_bytes = max(head.n_bytes, _announced(body[head.data_offset :], head.compression, n_compressed))
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
