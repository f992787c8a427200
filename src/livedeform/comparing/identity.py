"""Tell recordings apart by what was measured, wherever they lie and whatever their files are called."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping

from livedeform.common import topics as t
from livedeform.common.bags.read import BagReader
from livedeform.common.bags.recording import ends, picture_topic
from livedeform.common.bags.types import RawMessage

DIGEST, PART = "recording_digest", "part_of_recording"  # in a run's metadata: of the recording that was run
CLOUDS = (t.STEREO_MARKERS_RAW, t.STEREO_MARKERS, t.STEREO_SURFACE)
LETTERS = 16


def digest_of(bag: BagReader) -> str:
    """Return a digest of a recording: of its probe poses and of what was measured, both with their stamps.

    Measured are markers, or points without ids, or (the first and those of the last second of) the left pictures. Of a
    run's recording it is the digest of what was run.
    """
    if said := bag.metadata.get(DIGEST, ""):
        return said
    digest = hashlib.sha256()
    for name, messages in (("poses", _of(bag, t.PROBE_POSE)), ("measured", _measured(bag))):
        digest.update(name.encode())
        for raw in messages:
            digest.update(len(raw.data).to_bytes(8, "little"))
            digest.update(raw.data)
    return digest.hexdigest()[:LETTERS]


def is_part(metadata: Mapping[str, str]) -> bool:
    """Tell of a run's recording by its ``metadata`` whether only a part of the recording was run."""
    return bool(metadata.get(PART))


def _of(bag: BagReader, topic: str) -> Iterator[RawMessage]:
    return bag.messages([topic]) if topic in bag.topics else iter(())


def _measured(bag: BagReader) -> Iterator[RawMessage]:
    have = {name for name, info in bag.topics.items() if info.count}
    cloud = next((name for name in CLOUDS if name in have), None)
    picture = picture_topic(bag, t.LEFT_IMAGE)
    if cloud is not None or picture is None:
        return _of(bag, cloud or "")
    return ends(bag, picture)
