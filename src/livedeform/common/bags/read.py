"""Reading bags: MCAP alone or as a rosbag2 folder, split or not, and sqlite3. No ROS.

What others recorded is taken as it comes: a topic whose schema cannot be parsed is skipped with a warning, and the rest
is read.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from livedeform.common.bags.storage import McapFile, Rosbag2Storage, TopicInfo, split_number
from livedeform.common.bags.types import RawMessage, one_line
from livedeform.common.errors import InputError, RecordingError
from livedeform.common.yaml_text import parse_yaml

__all__ = ["BagReader", "RawMessage", "TopicInfo", "read_bag"]


def read_bag(path: Path | str) -> BagReader:
    """Open a bag: a .mcap or .db3 file, a rosbag2 folder, or a folder that holds one of them."""
    return BagReader(Path(path))


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
        self._parts: list[McapFile | Rosbag2Storage] = []
        self._stack = ExitStack()
        with ExitStack() as opening:
            for part in self._open(path):
                opening.callback(part.close)
                self._parts.append(part)
                self.metadata.update(part.metadata)
            self._stack = opening.pop_all()
        self._join()

    def _open(self, path: Path) -> Iterator[McapFile | Rosbag2Storage]:
        if not path.exists():
            raise RecordingError(
                "the bag does not exist", where=str(path), remedy="name a .mcap file or a rosbag2 folder"
            )
        if path.is_file():
            yield self._open_file(path)
            return
        if not path.is_dir():  # a device or a pipe, which cannot be read twice
            raise RecordingError("is no recording", where=str(path), remedy="name a .mcap file or a bag")
        described = path / "metadata.yaml"
        files = sorted(path.glob("*.mcap"), key=split_number)
        if described.is_file():
            information = _folder_information(described)
            self.metadata.update({str(k): str(v) for k, v in (information.get("custom_data") or {}).items()})
            if information.get("compression_mode") or information.get("storage_identifier") not in ("mcap", "sqlite3"):
                yield Rosbag2Storage(path)
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

    def _open_file(self, file: Path) -> McapFile | Rosbag2Storage:
        if file.suffix == ".bag":
            raise RecordingError(
                "this is a ROS 1 bag",
                where=str(file),
                remedy=f"rosbags-convert --src {file} --dst {file.with_suffix('')}",
            )
        return Rosbag2Storage(file) if file.suffix == ".db3" else McapFile(file)

    def _join(self) -> None:
        for part in self._parts:
            for name, info in part.topics.items():
                have = self.topics.get(name)
                self.topics[name] = replace(have, count=have.count + info.count) if have else info
        self.start_ns = min((part.start_ns for part in self._parts), default=0)
        self.end_ns = max((part.end_ns for part in self._parts), default=0)
        if self.start_ns > self.end_ns:
            self.start_ns = self.end_ns = 0
        if n := sum(part.n_beyond for part in self._parts):
            self.warnings.append(f"{self.path}: {n} messages are left out: received after the year 2262")
        for info in self.topics.values():
            if info.problem:
                self.warnings.append(f"{self.path}: topic {info.name} is skipped: {info.problem}")

    @property
    def n_messages(self) -> int:
        return sum(info.count for info in self.topics.values())

    @property
    def seeks(self) -> bool:
        """Tell whether messages are read from some time on without all that were before."""
        return all(part.seeks for part in self._parts)

    def messages(
        self, topics: Iterable[str] | None = None, start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[RawMessage]:
        """Return the messages of ``topics`` (default: all that can be decoded) in the order of their receive time.

        ``start_ns`` <= receive time < ``stop_ns``; a topic that is named is given even where it cannot be decoded.
        """
        if topics is None:
            names = [info.name for info in self.topics.values() if not info.problem]
        else:
            names = [name for name in topics if name in self.topics]
        sources = [part.messages(names, start_ns, stop_ns) for part in self._parts]
        try:
            yield from heapq.merge(*sources, key=lambda raw: raw.log_time_ns) if len(sources) > 1 else sources[0]
        except RecordingError:
            raise
        except Exception as error:  # only the storage can fail here: what the caller raises does not come in
            raise RecordingError(
                f"is damaged ({one_line(error)})",
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


def _folder_information(described: Path) -> dict[str, Any]:
    try:
        _, document = parse_yaml(described.read_text(), str(described))
        return dict(document["rosbag2_bagfile_information"])
    except (InputError, TypeError, KeyError, ValueError) as error:
        raise RecordingError(
            "is not the description of a rosbag2 folder", where=str(described), remedy="name the .mcap file itself"
        ) from error
