"""Make the experiments of the blind test and diagnose them.

The diagnosis runs in a process of its own, which gets the experiment and the recordings, and no path to the truth.
"""

from __future__ import annotations

import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

from benchmarks.blind.cases import OUTSIDE, Case
from benchmarks.blind.felupe_truth import FelupeTruth
from benchmarks.blind.sizes import size_of_truth, size_over_noise
from benchmarks.blind.table import score
from livedeform.fem_node.mesh.generate import mesh_to_file
from livedeform.synthetic.scenario import make
from livedeform.synthetic.solved_motion import HexSolver, TruthSolver
from livedeform.synthetic.true_effects import World
from livedeform.synthetic.truth.probe import TruthProbe

TRUTHS: dict[str, Callable[[World, TruthProbe], TruthSolver]] = {"own": HexSolver, "felupe": FelupeTruth}
TIME_LIMIT = 1800.0  # s for one diagnosis
ONE_THREAD = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "MKL", "OPENBLAS", "NUMBA")}


def run_all(cases: Sequence[Case], out: Path, jobs: int, keep: bool, truth: str = "own", sizes: bool = False) -> None:
    """Run every case that is not done, ``jobs`` at once, and print a line for each; ``keep`` leaves the recordings.

    ``truth`` is one of TRUTHS; with ``sizes``, what a case's effects are over the noise is measured.
    """
    os.environ.update(ONE_THREAD)
    with ProcessPoolExecutor(jobs) as pool:
        running = {pool.submit(run_case, case, out, keep, truth, sizes): case for case in cases}
        for k, future in enumerate(as_completed(running), start=1):
            case = running[future]
            error = future.exception()
            judged = score(case, out)
            verdict = f"could not be made: {error}" if error else "?" if judged is None else judged.verdict
            named = "" if judged is None else "+".join(judged.named)
            print(f"{k}/{len(cases)} {case.name}: {verdict} {named}", flush=True)


def run_case(case: Case, out: Path, keep: bool = False, truth: str = "own", sizes: bool = False) -> None:
    """Make and diagnose one case, and write ``out/<case>/result.json``, unless that is there; sizes that it lacks are
    added to one that is there where its recordings were kept.

    A case that raises leaves its ``error`` there, so that it is counted, and is begun again by the next run.
    """
    folder = out / case.name
    done = folder / "result.json"
    result = _document(done)
    new = result is None or "error" in result
    if new:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        try:
            result = _made_and_diagnosed(case, out, truth)
        except Exception as error:
            _write(done, {"error": f"{type(error).__name__}: {error}", "truth": truth})
            raise
        _write(done, result)  # before its size, which may not be measurable
    if sizes and case.effects and "size_over_noise" not in result and (folder / "bags").is_dir():
        _write(done, result | _size(folder, case, truth))
    if new and not keep:
        for part in ("bags", "experiment", "diagnosis"):
            shutil.rmtree(folder / part, ignore_errors=True)


def _made_and_diagnosed(case: Case, out: Path, truth: str) -> dict[str, Any]:
    """Return the result of a case, but for its size, with its experiment, recordings and report in ``out/<case>``."""
    folder = out / case.name
    kept = out / ("bodies" if truth == "own" else f"bodies-{truth}")
    began = resources()
    make(case.scenario(), folder, case.seed, kept=kept, mesher=mesh_to_file, solver=TRUTHS[truth])
    made = resources() - began
    return _diagnose(folder, case.seed) | {"truth": truth, "making_cpu_seconds": made}


def _size(folder: Path, case: Case, truth: str) -> dict[str, Any]:
    """Return a case's size, or NaN with the reason where it cannot be measured: the declared model of a diagnosis that
    failed may have no equilibrium."""
    try:
        return {"size_over_noise": _measured_size(folder, case, truth)}
    except Exception as error:
        return {"size_over_noise": float("nan"), "size_error": f"{type(error).__name__}: {error}"}


def _measured_size(folder: Path, case: Case, truth: str) -> float:
    """Measure a case's effects over the noise: by the loop's model, or by a second truth without them if it does not
    know them."""
    if not set(case.truth) & set(OUTSIDE):
        true = case.scenario()["truth"]  # which may differ from the case's effects: a scan that is loaded
        return size_over_noise(folder / "experiment", folder / "bags" / "a", true)
    with tempfile.TemporaryDirectory() as plain:
        make(case.scenario() | {"truth": []}, Path(plain), case.seed, mesher=mesh_to_file, solver=TRUTHS[truth])
        return size_of_truth(folder, Path(plain))


def _write(path: Path, result: Mapping[str, Any]) -> None:
    temporary = path.with_suffix(".json.part")
    temporary.write_text(json.dumps(result, indent=1))
    temporary.replace(path)


def _diagnose(folder: Path, seed: int) -> dict[str, Any]:
    """The diagnosis of the experiment in ``folder``, its baselines, exit code, last line of stderr, and seconds."""
    start, spent = time.monotonic(), resources()
    command = [
        *(sys.executable, "-c", "import sys; from livedeform.cli import main; sys.exit(main())"),
        *("diagnose", str(folder / "experiment")),
        *("--fit", str(folder / "bags" / "a"), "--test", str(folder / "bags" / "b")),
        *("--out", str(folder / "diagnosis"), "--seed", str(seed)),
    ]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=TIME_LIMIT, env={**os.environ, **ONE_THREAD}, check=False
        )
        code, said = done.returncode, done.stderr.strip().splitlines()[-1:] if done.returncode not in (0, 1) else []
    except subprocess.TimeoutExpired:
        code, said = -1, [f"stopped after {TIME_LIMIT:.0f} s"]
    return {
        "diagnosis": _document(folder / "diagnosis" / "diagnosis.json") if code in (0, 1) else None,
        "baselines": _document(folder / "diagnosis" / "baselines.json"),
        "code": code,
        "said": said,
        "seconds": time.monotonic() - start,
        "cpu_seconds": resources() - spent,
    }


def resources() -> float:
    """Return the CPU seconds of this process and of its children that have ended."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(u.ru_utime + u.ru_stime for u in used)


def _document(path: Path) -> Any:
    """The content of a JSON file; None where there is none."""
    return json.loads(path.read_text()) if path.is_file() else None
