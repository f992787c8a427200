"""A stop ends soon and loses nothing, and nothing survives its parent."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "trust"))  # a small experiment and its recording

from situations import sound

from livedeform import drafts
from livedeform.common.bags.recording import load_recording

COMMAND = "from livedeform.cli import main; main()"
POOL = """
import time
from livedeform.common.processes import terminable, worker_pool
with terminable(), worker_pool(2, list) as pool:
    for _ in range(2):
        pool.submit(time.sleep, 60)
    time.sleep(0.5)
    print("working", flush=True)
    time.sleep(60)
"""
STUCK = """
import ctypes
from livedeform.common.processes import terminable, worker_pool
with terminable(), worker_pool(2, list) as pool:
    for _ in range(2):
        pool.submit(ctypes.CDLL(None).sleep, 60)
    print("working", flush=True)
    ctypes.CDLL(None).sleep(60)  # as a long factorisation: no handler of Python is called until it is back
"""
KILLS = [signal.SIGKILL, signal.SIGTERM, signal.SIGINT]
linux = pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="children are looked up in /proc")


def children(pid: int) -> set[int]:
    """The processes that a process has started and that still run, theirs among them."""
    found: set[int] = set()
    with suppress(OSError):  # it has ended meanwhile
        for path in Path(f"/proc/{pid}/task").glob("*/children"):
            for child in map(int, path.read_text().split()):
                found |= {child} | children(child)
    return found


def alive(pids: set[int]) -> set[int]:
    """Those that run: a process that has ended and that nobody has waited for is none."""
    states = {}
    for pid in pids:
        try:
            states[pid] = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        except OSError:
            continue
    return {pid for pid, state in states.items() if state not in "ZX"}


def ended_soon(pids: set[int]) -> None:
    """Raise AssertionError where one of the processes runs 2 s from now; later by as much as more wants to run on the
    machine than it has cores."""
    deadline = time.monotonic() + 2.0 * max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))
    while alive(pids) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not alive(pids)


@contextmanager
def started(code: str, *words: str) -> Iterator[subprocess.Popen[str]]:
    arguments = [sys.executable, "-c", code, *words]
    child = subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        yield child
    finally:
        child.kill()
        child.wait()
        assert child.stdout is not None
        child.stdout.close()


def seconds_of(pid: int) -> float:
    """Time (s) that a process has computed."""
    words = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")


def wait_for_line(child: subprocess.Popen[str], text: str) -> None:
    assert child.stdout is not None
    heard = []
    for line in child.stdout:
        heard.append(line)
        if text in line:
            return
    raise AssertionError("".join(heard))


@linux
@pytest.mark.parametrize("code", [POOL, STUCK], ids=["waiting", "stuck in native code"])
@pytest.mark.parametrize("number", KILLS, ids=lambda n: n.name)
def test_no_worker_survives_its_parent(number: signal.Signals, code: str):
    with started(code) as child:
        wait_for_line(child, "working")
        workers = children(child.pid)
        assert len(workers) == 2
        child.send_signal(number)
        ended_soon({child.pid, *workers})


@linux
@pytest.mark.slow
@pytest.mark.parametrize("number", KILLS, ids=lambda n: n.name)
def test_no_worker_of_a_diagnosis_survives_it(number: signal.Signals, tmp_path: Path):
    bag = sound(tmp_path).write()
    with started(COMMAND, "diagnose", str(tmp_path), "--fit", str(bag), "--out", str(tmp_path / "out")) as child:
        deadline = time.monotonic() + 120.0
        while len(workers := children(child.pid)) < 2 and child.poll() is None and time.monotonic() < deadline:
            time.sleep(0.02)
        time.sleep(1.0)
        assert len(workers) >= 2
        child.send_signal(number)
        ended_soon({child.pid, *workers, *children(child.pid)})
    drafts.tidy(tmp_path / "out")  # as the next command does
    assert not list(tmp_path.glob(".*draft*"))


@pytest.mark.parametrize("stderr", ["open", "closed"])
def test_what_nobody_will_hear_is_not_waited_for(stderr: str):
    """The interpreter's end, beside a thread that is in a library, crashed 3 of some 75 live sessions."""
    lines = [
        "import sys, threading, time",
        "from livedeform.common.processes import WORKING, end",
        "threading.Thread(target=time.sleep, args=(600.0,), name=WORKING).start()",
        "print('said')",
        "sys.stderr.close()" if stderr == "closed" else "",
        "end(3)",
    ]
    done = subprocess.run([sys.executable, "-c", "\n".join(lines)], capture_output=True, text=True, timeout=300.0)
    assert (done.returncode, done.stdout, done.stderr) == (3, "said\n", "")


@linux
@pytest.mark.slow
@pytest.mark.parametrize("name", ["stereo_node", "fem_node", "compare_node"])
@pytest.mark.parametrize("number", KILLS, ids=lambda n: n.name)
def test_a_node_ends_soon(number: signal.Signals, name: str, tmp_path: Path):
    """Also while its model is being made."""
    sound(tmp_path).write()
    code = f"print('begun', flush=True); from livedeform.{name}.node import main; main()"
    for seconds in (1.0, 8.0):
        with started(code, "--ros-args", "-p", f"experiment:={tmp_path}") as child:
            wait_for_line(child, "begun")
            time.sleep(seconds)
            there = {child.pid, *children(child.pid)}
            child.send_signal(number)
            ended_soon(there)


@linux
def test_a_stopped_run_has_its_metrics_and_a_whole_recording_whatever_is_pressed_again(tmp_path: Path):
    bag = sound(tmp_path).write()
    out = tmp_path / "out"
    with started(COMMAND, "run", str(tmp_path), "--bag", str(bag), "--out", str(out), "--rate", "0.05") as child:
        wait_for_line(child, "replaying")
        before = spent = seconds_of(child.pid)
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGINT):
            child.send_signal(number)
            time.sleep(0.2)
        while not [*tmp_path.glob("out/metrics.json"), *tmp_path.glob(".out-draft-*/metrics.json")]:
            assert child.poll() is None
            with suppress(OSError):  # it has ended meanwhile
                spent = seconds_of(child.pid)
            time.sleep(0.02)
        assert spent - before < 5.0  # s of computing: other work may run on the machine
        child.wait(300.0)
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["coverage"]["interrupted"] is True and "interrupted" in metrics["reason"]
    assert load_recording(out / "run.mcap").metadata["counts"]
