"""Is everything installed and working? Each check does the thing itself, small, and says what to do if it fails."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

SHARED_MEMORY_NEEDED = 128 * 2**20  # bytes: two segments of 64 MB for pictures between processes
HANDSHAKE_SECONDS = 20.0
CUBE = 24  # nodes a side of the cube that times the solver


@dataclass(frozen=True)
class Check:
    """One finding: ``ok`` True works, False missing, None works but could be better; ``remedy`` is empty when ok."""

    name: str
    ok: bool | None
    found: str
    remedy: str = ""


def examine() -> Iterator[Check]:
    """All checks, one after another; none of them raises."""
    for name, check, remedy in CHECKS:
        try:
            yield Check(name, *check(), "")
        except NotBetter as note:
            yield Check(name, None, str(note), remedy)
        except subprocess.TimeoutExpired as error:
            yield Check(name, False, f"no answer within {error.timeout:.0f} s", remedy)
        except Exception as error:  # whatever goes wrong is the finding
            yield Check(name, False, f"{type(error).__name__}: {' '.join(str(error).split())}"[:300], remedy)


class NotBetter(Exception):
    """It works, with a disadvantage."""


def _python() -> tuple[bool, str]:
    if sys.version_info < (3, 11):  # pip refuses this, but a copied tree may run  # noqa: UP036
        raise RuntimeError(f"Python {platform.python_version()}")
    return True, f"Python {platform.python_version()}, {platform.machine()}, {os.cpu_count()} cores"


def _cores() -> tuple[bool, str]:
    """Count the cores that this process may use, and how many others want them now."""
    usable, load = len(os.sched_getaffinity(0)), os.getloadavg()[0]
    if load > usable + 0.5:
        raise NotBetter(f"{usable} cores, and {load:.1f} programs that want one: everything takes longer now")
    return True, f"{usable} cores, load {load:.1f}"


def _versions() -> tuple[bool, str]:
    return True, ", ".join(f"{name} {importlib.metadata.version(name)}" for name in PACKAGES)


PACKAGES = ("livedeform", "numpy", "scipy", "numba", "pydantic", "rosbags", "mcap", "typer")


def _rclpy() -> tuple[bool, str]:
    from livedeform.run.graph import middleware

    return True, middleware()


def _handshake() -> tuple[bool, str]:
    """Another process answers over DDS, in a domain of its own."""
    environment = os.environ | {"ROS_DOMAIN_ID": str(100 + os.getpid() % 100)}
    begin = time.monotonic()
    child = subprocess.Popen([sys.executable, "-m", "livedeform.run.graph", "answer"], env=environment)
    try:
        code = "from livedeform.run.graph import ask; ask()"
        subprocess.run([sys.executable, "-c", code], env=environment, check=True, timeout=HANDSHAKE_SECONDS)
    finally:
        child.terminate()
        child.wait(5.0)
    return True, f"two processes met in {time.monotonic() - begin:.1f} s"


def _shared_memory() -> tuple[bool, str]:
    free = shutil.disk_usage("/dev/shm").free
    if free < SHARED_MEMORY_NEEDED:
        raise NotBetter(f"{free / 2**20:.0f} MB free in /dev/shm, pictures between processes need 128 MB")
    return True, f"{free / 2**20:.0f} MB free in /dev/shm"


def _solver() -> tuple[bool, str]:
    import numpy as np
    from scipy.sparse import eye

    try:
        import pypardiso
    except ImportError as error:
        raise NotBetter("MKL PARDISO is not there; scipy's solver is used, 20 to 30 times slower") from error
    if not np.allclose(pypardiso.spsolve(eye(4, format="csr") * 2.0, np.ones(4)), 0.5):
        raise RuntimeError("PARDISO gave a wrong answer")
    return (
        True,
        f"pypardiso {importlib.metadata.version('pypardiso')}, {_solver_speed():.2f} s of CPU for {CUBE**3} unknowns",
    )


def _solver_speed() -> float:
    """Seconds of CPU to factorise the Laplacian of a cube of ``CUBE`` nodes a side, and to solve once."""
    import numpy as np
    import pypardiso
    from scipy.sparse import csr_array, diags_array, eye_array, kron

    line = diags_array([-1.0, 2.0, -1.0], offsets=[-1, 0, 1], shape=(CUBE, CUBE))
    one = eye_array(CUBE)
    parts = (kron(kron(line, one), one), kron(kron(one, line), one), kron(kron(one, one), line))
    matrix = csr_array(parts[0] + parts[1] + parts[2])
    begin = time.process_time()
    x = pypardiso.spsolve(matrix, np.ones(CUBE**3))
    took = time.process_time() - begin
    if not np.allclose(matrix @ x, 1.0, atol=1e-8):
        raise RuntimeError("PARDISO gave a wrong answer")
    return took


def _numba() -> tuple[bool, str]:
    """A kernel compiles and its cache can be written: otherwise every start compiles for a minute."""
    import numba

    folder = os.environ.get("NUMBA_CACHE_DIR") or str(Path(__file__).parent / "fem_node")
    kernel = numba.njit(lambda x: x + 1.0)
    if kernel(1.0) != 2.0:
        raise RuntimeError("a compiled kernel gave a wrong answer")
    home_cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    if not os.access(folder, os.W_OK) and not os.access(home_cache if home_cache.exists() else Path.home(), os.W_OK):
        raise NotBetter(f"neither {folder} nor {home_cache} can be written: kernels are compiled at every start")
    kept = _kept_kernels(Path(os.environ.get("NUMBA_CACHE_DIR") or Path(__file__).parent))
    if not kept:
        raise NotBetter(f"numba {numba.__version__}; no kernel is compiled yet: the first run takes a minute longer")
    return True, f"numba {numba.__version__}, {kept} kernels are compiled and kept"


def _kept_kernels(folder: Path) -> int:
    """Count the compiled kernels: numba writes an index for each."""
    return sum(1 for _ in folder.rglob("*.nbi"))


def _mesher() -> tuple[bool, str]:
    """Run it in a process of its own: a broken native library would take this one down."""
    code = "import pytetwild, importlib.metadata as m; print(m.version('pytetwild'))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60.0)
    if done.returncode:
        raise RuntimeError(done.stderr.strip().splitlines()[-1] if done.stderr.strip() else "the import fails")
    return True, f"pytetwild {done.stdout.strip()}"


def _opencv() -> tuple[bool, str]:
    # imported by the tracker, which is what needs it
    importlib.import_module("livedeform.stereo_node.detect.picture")
    return True, f"OpenCV {importlib.metadata.version('opencv-python-headless')}"


def _writing() -> tuple[bool, str]:
    """A message that is written to a bag is read back as it was."""
    import numpy as np

    from livedeform.common.bags.read import read_bag
    from livedeform.common.bags.recording import load_recording
    from livedeform.common.bags.recording_writer import RecordingWriter
    from livedeform.common.bags.write import BagWriter
    from livedeform.common.types import Pose

    written = Pose(1_000_000_001, np.array([0.25, -0.5, 1e-9]), np.array([0.0, 0.6, 0.0, 0.8]))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "check.mcap"
        with BagWriter(path, {"made_by": "livedeform doctor"}) as bag:
            RecordingWriter(bag).pose(written)
        with read_bag(path) as read:
            n = read.n_messages
        poses = load_recording(path).poses
    whole = [(p.stamp_ns, *p.position, *p.orientation_xyzw) for p in poses]
    if n != 1 or whole != [(written.stamp_ns, *written.position, *written.orientation_xyzw)]:
        raise RuntimeError(f"of one message that was written, {n} came back, as {whole}")
    return True, "a recording was written and read back"


CHECKS: tuple[tuple[str, Callable[[], tuple[bool, str]], str], ...] = (
    ("python", _python, "install Python 3.11 or newer"),
    ("cores", _cores, "end other programs, or wait for them"),
    ("packages", _versions, "pip install livedeform"),
    ("ros 2", _rclpy, "pip install 'ros-jazzy-rclpy[fastrtps]==7.1.6' 'ros-jazzy-common-interfaces==5.3.6'"),
    ("dds", _handshake, "allow local UDP multicast (firewall, container network), or unset ROS_DISCOVERY_SERVER"),
    ("shared memory", _shared_memory, "in docker: --shm-size=512m"),
    ("bags", _writing, "check that the temporary folder can be written"),
    ("pictures", _opencv, "pip install opencv-python-headless"),
    ("solver", _solver, "pip install 'livedeform[fast]'"),
    ("kernels", _numba, "python -c 'from livedeform.kernels import compile_kernels; compile_kernels()'"),
    ("mesher", _mesher, "pip install pytetwild (needed for new surfaces only)"),
)
