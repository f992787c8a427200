"""Hostile and broken files are bounded: one line, exit code 2, seconds, and less than a gigabyte."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import Chunk
from mcap.writer import CompressionType, Writer

sys.path.insert(0, str(Path(__file__).parents[1] / "trust"))  # a small experiment and its recording

from situations import sound

from livedeform.common import topics as t
from livedeform.common.bags.types import encode, jazzy_definition, message_class
from livedeform.common.yaml_text import MAX_CHARACTERS

SECONDS, BYTES = 5.0, 1 << 30
HEAD = "version: 1\nname: x\n"
LAUGHS = "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{k}: &a{k} [{', '.join(10 * [f'*a{k - 1}'])}]\n" for k in range(1, 10)
)
EXPERIMENTS = {
    "billion laughs": HEAD + LAUGHS,
    "billion laughs in merges": HEAD + "a0: &a0 {x: 1}\n" + "".join(
        f"a{k}: &a{k} {{<<: [{', '.join(10 * [f'*a{k - 1}'])}]}}\n" for k in range(1, 10)),
    "a python object": HEAD + "phantom: !!python/object/apply:os.system ['true']\n",
    "an unknown tag": HEAD + "phantom: !thing {}\n",
    "a merge of a number": HEAD + "<<: 3\n",
    "a recursive list": HEAD + "phantom: &a [*a]\n",
    "a recursive mapping": HEAD + "phantom: &a {b: *a}\n",
    "a recursive key": HEAD + "? &a [*a]\n: 1\n",
    "5000 digits": HEAD + f"phantom: {{density: {'9' * 5000}}}\n",
    "400 digits": HEAD + f"phantom: {{density: {'9' * 400}}}\n",
    "a date": HEAD + "phantom: {density: 2001-01-01}\n",
    "a date for a name": "version: 1\nname: 2001-01-01\n",
    "a date for a key": HEAD + "2001-01-01: 3\n",
    "a day that there is not": HEAD + "phantom: {density: 2001-02-31}\n",
    "a list for a key": HEAD + "? [1, 2]\n: 3\n",
    "a mapping for a key": HEAD + "? {a: 2}\n: 3\n",
    "a null for a key": HEAD + "~: 3\n",
    "deep brackets": HEAD + "phantom: " + "[" * 20_000,
    "deep and closed": HEAD + "phantom: " + "[" * 200 + "]" * 200,
    "deep indentation": HEAD + "\n".join(" " * k + "a:" for k in range(1500)),
    "a bomb of base 60": HEAD + "phantom: " + ":".join(["59"] * 3000),
    "large": HEAD + "x" * MAX_CHARACTERS,
    "many small things": HEAD + "phantom: [" + "1," * 200_000 + "1]",
    "two documents": HEAD + "---\n" + HEAD,
    "nothing": "",
    "null bytes": HEAD + "\0",
    "a surrogate": HEAD + "phantom: \\ud800 \u2028",
    "an undefined alias": HEAD + "phantom: *nobody\n",
    "binary": HEAD + "phantom: {density: !!binary aGVsbG8=}\n",
    "a set": HEAD + "phantom: {density: !!set {1, 2}}\n",
    "an ordered map": HEAD + "phantom: !!omap [1]\n",
    "not a number": HEAD + "phantom: {density: .nan}\n",
}  # fmt: skip


@cache
def zeros(*, with_size: bool) -> bytes:
    """3 GB of zeros as a zstd frame, whose head tells its size or does not."""
    n_bytes = 3 << 30
    compressor = zstandard.ZstdCompressor(level=1, write_content_size=with_size)
    stream = compressor.compressobj(size=n_bytes if with_size else -1)
    piece = bytes(1 << 24)
    return b"".join(stream.compress(piece) for _ in range(n_bytes >> 24)) + stream.flush()


def bomb(path: Path, declared: int, *, with_size: bool = True, indexed: bool = False) -> None:
    """An MCAP file with such a chunk, which says that it holds ``declared`` bytes, before one with a message; or with
    an index that has it in place of that one."""
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start("ros2", "tests")
        schema = writer.register_schema(t.FLOAT64, "ros2msg", jazzy_definition(t.FLOAT64).text.encode())
        channel = writer.register_channel("/n", "cdr", schema)
        writer.add_message(channel, 1, encode(message_class(t.FLOAT64)(1.0)), 1)
        writer.finish()
    builder = RecordBuilder()
    Chunk(
        compression="zstd", data=zeros(with_size=with_size), message_start_time=0, message_end_time=5,
        uncompressed_crc=0, uncompressed_size=declared,
    ).write(builder)  # fmt: skip
    whole = path.read_bytes()
    at = 8 + 9 + int.from_bytes(whole[9:17], "little")  # behind the magic number and the header
    chunk = bytes(builder.end())
    if indexed:  # what the index says of the chunk at ``at`` is of the bomb: the rest has moved behind it
        end = int.from_bytes(whole[-28:-20], "little")  # where the index began
        tail = whole[end:-28] + (end + len(chunk)).to_bytes(8, "little") + whole[-20:]
        path.write_bytes(whole[:at] + chunk + whole[at:end] + tail)
    else:
        path.write_bytes(_without_summary(whole[:at] + chunk + whole[at:]))


def _without_summary(data: bytes) -> bytes:
    """The file with a footer that knows no summary, so that every record is looked at."""
    magic = b"\x89MCAP0\r\n"
    footer = bytes([2]) + (20).to_bytes(8, "little") + bytes(20)
    end = data.rindex(bytes([0x0F]) + (4).to_bytes(8, "little"))  # DataEnd
    return data[:end] + bytes([0x0F]) + (4).to_bytes(8, "little") + bytes(4) + footer + magic


def written(folder: Path) -> dict[str, list[str]]:
    """Words of the commands, by the name of the case."""
    cases = {}
    for k, (name, text) in enumerate(EXPERIMENTS.items()):
        file = folder / f"{k}.yaml"
        file.write_text(text, encoding="utf-8", errors="replace")
        cases[name] = ["info", str(file)]
    bombs: dict[str, Callable[[Path], None]] = {
        "a zstd chunk that tells its size": lambda path: bomb(path, 3 << 30),
        "a zstd chunk that lies": lambda path: bomb(path, 1000),
        "a zstd chunk that hides its size": lambda path: bomb(path, 3 << 30, with_size=False),
        "a zstd chunk that hides and lies": lambda path: bomb(path, 1000, with_size=False),
        "a zstd chunk that the index knows": lambda path: bomb(path, 3 << 30, indexed=True),
        "a zstd chunk that the index knows, and lies": lambda path: bomb(path, 1000, with_size=False, indexed=True),
    }
    for k, (name, make) in enumerate(bombs.items()):
        make(folder / f"{k}.mcap")
        cases[name] = ["info", str(folder / f"{k}.mcap")]
        cases[f"{name}, recovered"] = ["recover", str(folder / f"{k}.mcap"), "--out", str(folder / f"{k}.back.mcap")]
    return cases


RUN = f"""
import json, resource, sys, time
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from livedeform.cli import run
import livedeform.inspection, livedeform.common.bags.recover, livedeform.stereo_node.detect.settings, trimesh
size = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (size + {BYTES}, size + {BYTES}))
out = {{}}
for name, words in json.load(open(sys.argv[1])).items():
    said, begin = StringIO(), time.process_time()
    with redirect_stderr(said), redirect_stdout(StringIO()):
        code = run(words)
    out[name] = [code, said.getvalue(), time.process_time() - begin]
print(json.dumps(out))
"""


@pytest.mark.skipif(not Path("/proc/self/statm").is_file(), reason="the limit counts from what /proc says")
def test_every_hostile_file_is_one_line_in_seconds_and_little_memory(tmp_path: Path):
    cases = written(tmp_path)
    (tmp_path / "cases.json").write_text(json.dumps(cases))
    done = subprocess.run(
        [sys.executable, "-c", RUN, str(tmp_path / "cases.json")], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    results = json.loads(done.stdout)
    wrong = {}
    for name, (code, said, seconds) in results.items():
        may_work = name.endswith("recovered")  # the message behind the bomb comes back
        fine = (code == 2 and said.count("\n") == 1 and "internal" not in said) or (may_work and code == 0)
        if not fine or seconds > SECONDS:
            wrong[name] = (code, said, seconds)
    assert not wrong and len(results) == len(cases)


def test_a_zero_receive_time_does_not_stop_a_replay_in_real_time(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """One message of 1970 is left out; a recording of two times is refused rather than waited for."""
    from livedeform.cli import run as command_line
    from livedeform.common.bags.read import read_bag
    from livedeform.common.bags.write import BagWriter

    with read_bag(sound(tmp_path).write()) as bag:
        messages = list(bag.messages())
    for name, early in (("one", 1), ("half", len(messages) // 2)):
        path = tmp_path / f"{name}.mcap"
        with BagWriter(path) as writer:
            for k, raw in enumerate(messages):
                writer.write(raw.topic, raw.type, 0 if k < early else raw.log_time_ns, raw.data)
        words = ["run", str(tmp_path), "--bag", str(path), "--out", str(tmp_path / name), "--rate", "20"]
        code = command_line(words)
        said = capsys.readouterr().err
        assert (code in (0, 1) and "left out" in said) if name == "one" else (code == 2 and "--rate max" in said)
