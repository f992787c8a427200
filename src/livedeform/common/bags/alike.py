"""Messages of one layout, read together: a recording of half an hour has hundreds of thousands. No ROS.

What comes out is what reading them one by one gives, bit for bit; what is not alike is left to that.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from livedeform.common import topics as t
from livedeform.common.bags import layouts
from livedeform.common.bags.types import RawMessage, TypeDefinition, decode, jazzy, typestore
from livedeform.common.errors import RecordingError
from livedeform.common.stamps import NS

LITTLE = b"\0\1\0\0"  # how a serialised message begins: plain CDR, little-endian
FEWEST = 4  # messages that are worth it
HEADER = 12  # bytes to the frame's name: that, and the stamp
N_DOUBLES = {t.POSE_STAMPED: 7, t.WRENCH_STAMPED: 6}  # behind the header


@dataclass(frozen=True)
class Alike:
    """Messages that differ in their stamps and values only.

    ``rows`` says which they are of those given; ``stamps_ns`` of their headers; ``frame_id`` of all of them. ``values``
    (n, k): the rows of point clouds of k points each, or the k numbers of poses or wrenches.
    """

    rows: list[int]
    stamps_ns: list[int]
    frame_id: str
    values: NDArray[Any]


def groups(raws: Sequence[RawMessage], type_name: str) -> Iterator[Alike]:
    """Yield those of the messages of a type (a cloud, a stamped pose or wrench) that can be read together."""
    by_length: dict[tuple[int, int], list[int]] = defaultdict(list)
    for row, raw in enumerate(raws):
        if raw.type == type_name:
            by_length[id(raw.definition), len(raw.data)].append(row)  # a bag's messages share their definitions
    for rows in by_length.values():
        if len(rows) >= FEWEST and _is_standard(type_name, raws[rows[0]].definition):
            found = _alike([raws[row] for row in rows], rows)
            if found is not None:
                yield found


@lru_cache(maxsize=256)
def _is_standard(type_name: str, definition: TypeDefinition) -> bool:
    """Tell whether a bag's definition of a type is ROS 2 Jazzy's."""
    if type_name != t.POINT_CLOUD and type_name not in N_DOUBLES:
        return False
    try:
        known = typestore(type_name, definition).fielddefs
    except RecordingError:
        return False
    return all(jazzy().fielddefs.get(name) == fields for name, fields in known.items())


def _alike(raws: Sequence[RawMessage], rows: Sequence[int]) -> Alike | None:
    """Read messages of one type and length like the first; None where that is none that can be."""
    try:
        first = decode(raws[0])
        dtype = layouts.unpack(first).dtype if raws[0].type == t.POINT_CLOUD else np.dtype("<f8")
    except RecordingError:
        return None
    begin, n_bytes = _content(raws[0], first, dtype)
    if raws[0].data[:4] != LITTLE or n_bytes == 0:
        return None
    table = np.frombuffer(b"".join([raw.data for raw in raws]), np.uint8).reshape(len(raws), -1)
    stamps = table[:, 4:HEADER].copy().view([("sec", "<i4"), ("nanosec", "<u4")])[:, 0]
    same = (table[:, :4] == table[0, :4]).all(axis=1) & (stamps["nanosec"] < NS)
    same &= (table[:, HEADER:begin] == table[0, HEADER:begin]).all(axis=1)
    values = np.ascontiguousarray(table[same, begin : begin + n_bytes]).view(dtype)
    stamps_ns = stamps["sec"][same].astype(np.int64) * NS + stamps["nanosec"][same]
    kept = [row for row, is_same in zip(rows, same.tolist(), strict=True) if is_same]
    return Alike(kept, stamps_ns.tolist(), first.header.frame_id, values)


def _content(raw: RawMessage, message: Any, dtype: np.dtype[Any]) -> tuple[int, int]:
    """Return where a message's values begin and how many bytes they have; none where they are not in one piece."""
    length = len(raw.data)
    if raw.type != t.POINT_CLOUD:
        n_bytes = 8 * N_DOUBLES[raw.type]
        end_of_name = 16 + len(message.header.frame_id.encode()) + 1
        padded = 4 + -(-(end_of_name - 4) // 8) * 8  # numbers of 8 bytes begin at a multiple of 8 behind the first 4
        return (padded, n_bytes) if padded + n_bytes == length else (0, 0)
    n_bytes = message.height * message.width * dtype.itemsize
    begin = length - 1 - n_bytes  # is_dense comes last
    whole = len(message.data) == n_bytes and (message.height == 1 or message.row_step * message.height == n_bytes)
    if not whole or begin < HEADER or raw.data[begin : begin + n_bytes] != message.data.tobytes():
        return 0, 0
    told = int.from_bytes(raw.data[begin - 4 : begin], "little")
    return (begin, n_bytes) if told == n_bytes else (0, 0)
