"""The blind test: makes experiments with undeclared effects, has ``livedeform diagnose`` look at them, prints the
table.

``python -m livedeform.synthetic.blind_test run --out DIR [--set small|medium|large|dome] [--jobs N] [--limit N]``
goes on where it was stopped; ``table`` prints what is there. The diagnosis runs in a process of its own, which gets
the experiment and the recordings, and no path to the truth.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import beta

from livedeform.synthetic import blind_cases
from livedeform.synthetic.blind_cases import Case
from livedeform.synthetic.scenario import make

TIME_LIMIT = 1800.0  # s for one diagnosis
SETS: dict[str, Callable[[], list[Case]]] = {
    "small": blind_cases.small,
    "medium": blind_cases.medium,
    "large": blind_cases.large,
    "dome": blind_cases.dome,
}
ONE_THREAD = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "MKL", "OPENBLAS", "NUMBA")}


@dataclass(frozen=True)
class Score:
    """One case judged. ``errors``: relative error of each fitted number; ``covered``: whether its 95 % interval
    holds; ``before``, ``after`` m: errors on the test recording; ``removed``: share of the excess over its noise;
    ``simpler``: what other methods said, and the share that they removed."""

    case: Case
    verdict: str
    named: tuple[str, ...]
    alternatives: tuple[str, ...]
    errors: tuple[float, ...]
    covered: tuple[bool, ...]
    before: float
    after: float
    removed: float
    seconds: float
    simpler: Mapping[str, Any] | None = None

    @property
    def right(self) -> bool:
        if self.case.kind == "none":
            return self.verdict == "none"
        if self.case.kind == "outside":
            return self.verdict == "unexplained"
        return self.verdict == "effect" and set(self.named) == set(self.case.truth)

    @property
    def in_set(self) -> bool:
        """Named right, or every true effect is named or among at most three that cannot be told apart."""
        together = set(self.named) | set(self.alternatives)
        return self.right or (
            self.verdict == "effect" and len(self.alternatives) <= 2 and set(self.case.truth) <= together
        )

    @property
    def confidently_wrong(self) -> bool:
        return self.verdict == "effect" and not set(self.case.truth) & (set(self.named) | set(self.alternatives))


def run_case(case: Case, out: Path, keep: bool = False) -> None:
    """Make and diagnose one case, unless that was done; DIR/<case>/result.json."""
    folder = out / case.name
    if (folder / "result.json").is_file():
        return
    shutil.rmtree(folder, ignore_errors=True)
    make(case.scenario(), folder, case.seed, kept=out / "bodies")
    start = time.monotonic()
    command = [
        *(sys.executable, "-c", "import sys; from livedeform.cli import main; sys.exit(main())"),
        *("diagnose", str(folder / "experiment")),
        *("--fit", str(folder / "bags" / "a"), "--test", str(folder / "bags" / "b")),
        *("--out", str(folder / "diagnosis"), "--seed", str(case.seed)),
    ]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=TIME_LIMIT, env={**os.environ, **ONE_THREAD}, check=False
        )
        code, said = done.returncode, done.stderr.strip().splitlines()[-1:] if done.returncode not in (0, 1) else []
    except subprocess.TimeoutExpired:
        code, said = -1, [f"stopped after {TIME_LIMIT:.0f} s"]
    answer = folder / "diagnosis" / "diagnosis.json"
    diagnosis = json.loads(answer.read_text()) if answer.is_file() and code in (0, 1) else None
    other = folder / "diagnosis" / "simpler.json"
    simpler = json.loads(other.read_text()) if other.is_file() else None
    result = {
        "diagnosis": diagnosis,
        "simpler": simpler,
        "code": code,
        "said": said,
        "seconds": time.monotonic() - start,
    }
    if not keep:
        for part in ("bags", "experiment", "diagnosis"):
            shutil.rmtree(folder / part, ignore_errors=True)
    temporary = folder / "result.json.part"
    temporary.write_text(json.dumps(result, indent=1))
    temporary.replace(folder / "result.json")


def score(case: Case, out: Path) -> Score | None:
    """Judge a finished case; None if it is not finished. A diagnosis that failed counts as ``failed``."""
    path = out / case.name / "result.json"
    if not path.is_file():
        return None
    result = json.loads(path.read_text())
    found = result["diagnosis"]
    if found is None:
        nan = float("nan")
        return Score(case, "failed", (), (), (), (), nan, nan, nan, float(result["seconds"]))
    named = tuple(e["name"] for e in found["effects"])
    alternatives: set[str] = set()
    for candidate in found["candidates"]:
        if candidate["name"] in named:
            alternatives |= set(candidate["indistinguishable_from"])
    errors, covered = [], []
    for true in case.scenario()["truth"]:
        for effect in found["effects"]:
            if effect["name"] == true["name"]:
                e, c = _compare(true, effect["parameters"])
                errors += e
                covered += c

    def removed(after: float | None, before: float = found["error_before"]["rmse"]) -> float:
        floor = found["noise_floor"]
        excess = before**2 - floor**2
        if after is None or excess <= 0.05 * floor**2:
            return float("nan")
        return float((before**2 - max(after, floor) ** 2) / excess)

    simpler = result.get("simpler")
    if simpler is not None:
        finer = simpler["finer_before_rmse"]
        simpler = {**simpler, **{k: removed(simpler[f"{k}_rmse"]) for k in ("modulus", "process")}}
        simpler["finer"] = removed(simpler["finer_after_rmse"], finer)
    together = tuple(sorted(alternatives - set(named)))
    before, after = float(found["error_before"]["rmse"]), float(found["error_after"]["rmse"])
    return Score(
        case=case,
        verdict=found["verdict"],
        named=named,
        alternatives=together,
        errors=tuple(errors),
        covered=tuple(covered),
        before=before,
        after=after,
        removed=removed(after),
        seconds=float(result["seconds"]),
        simpler=simpler,
    )


def _compare(true: Mapping[str, Any], parameters: Mapping[str, Any]) -> tuple[list[float], list[bool]]:
    errors, covered = [], []
    for name, fitted in parameters.items():
        if name not in true:
            continue
        t, v = np.atleast_1d(np.asarray(true[name], float)), np.atleast_1d(np.asarray(fitted["value"], float))
        if t.shape != v.shape:
            continue
        start = blind_cases.NEUTRAL.get(name, 0.0)
        size = float(np.linalg.norm(t - start))
        if size > 0.0:
            errors.append(float(np.linalg.norm(v - t)) / size)
        sigma = np.atleast_1d(np.asarray(fitted["sigma"], float))
        covered += [bool(x) for x in np.abs(v - t) <= 1.96 * sigma]
    return errors, covered


# ---- the table


def table(scores: Iterable[Score]) -> list[str]:
    """The figures of the blind test with their counts and 95 % bounds (Clopper & Pearson 1934)."""
    all_ = list(scores)

    def kind(*names: str, size: float | None = None) -> list[Score]:
        return [s for s in all_ if s.case.kind in names and (size is None or s.case.size == size)]

    singles = kind("single")
    lines = [f"{len(all_)} experiments, {sum(s.verdict == 'failed' for s in all_)} diagnoses failed", ""]
    lines += [
        _share("named right at 3 x noise", [s.right for s in kind("single", size=3.0)], ""),
        _share("named right at 2 x noise", [s.right for s in kind("single", size=2.0)], ">= 95 %"),
        _share("named right at 1 x noise", [s.right for s in kind("single", size=1.0)], ">= 85 %"),
        _share("named right at 0.5 x noise", [s.right for s in kind("single", size=0.5)], ""),
        _share("right, or in a set of at most 3, at 2 x", [s.in_set for s in kind("single", size=2.0)], ">= 98 %"),
        _share("right, or in a set of at most 3, at 3 x", [s.in_set for s in kind("single", size=3.0)], ""),
        _share("pairs named right", [s.right for s in kind("pair")], ""),
        _share("false alarms without an effect", [not s.right for s in kind("none")], "<= 5 %"),
        _share("confidently wrong", [s.confidently_wrong for s in kind("single", "pair", "outside")], "<= 2 %"),
        _share("outside effects called unexplained", [s.right for s in kind("outside")], ">= 90 %"),
        _share("poor trajectory: right, or in a set", [s.in_set for s in kind("poor")], ""),
        _share("95 % intervals that hold the truth", [c for s in singles for c in s.covered], "90-98 %"),
    ]
    errors = [e for s in singles if s.right for e in s.errors]
    removed = [s.removed for s in singles if s.right and np.isfinite(s.removed)]
    seconds = [s.seconds for s in all_]
    lines.append(_middle("median parameter error", errors, 100.0, "%", "<= 10 %"))
    lines.append(_middle("median share of the excess removed, test recording", removed, 100.0, "%", ">= 90 %"))
    lines.append(_pooled(singles, kind("none")))
    lines.append(_middle("median time of one diagnosis", seconds, 1.0, "s", "<= 60 s on 2 cores"))
    lines += ["", *_today(all_)]
    return [*lines, "", "true effect -> what was answered", *_confusion(all_)]


def _today(scores: Sequence[Score]) -> list[str]:
    """The same experiments by what people do today."""
    known = [(s, s.simpler) for s in scores if s.simpler is not None]
    singles = [(s, m) for s, m in known if s.case.kind == "single" and s.case.size >= 1.0]
    nones = [(s, m) for s, m in known if s.case.kind == "none"]
    lines = []
    for key, what in (("bic", "BIC over the same library"), ("signature", "likeness of signatures")):
        lines.append(_share(f"{what}: named right, 1 x and more", [m[key] in s.case.truth for s, m in singles], ""))
        lines.append(_share(f"{what}: false alarms", [m[key] != "none" for _, m in nones], ""))
    ours = [s.removed for s, _ in singles if np.isfinite(s.removed)]
    lines.append(_middle("median share of the excess removed: livedeform", ours, 100.0, "%", ""))
    others = (("finer", "livedeform, the elements' own error taken off"), ("modulus", "the modulus refitted"))
    for key, what in (*others, ("process", "a Gaussian process")):
        shares = [m[key] for _, m in singles if np.isfinite(m[key])]
        lines.append(_middle(f"median share of the excess removed: {what}", shares, 100.0, "%", ""))
    return lines


def _share(what: str, hits: Sequence[bool], goal: str) -> str:
    n, k = len(hits), int(np.sum(hits))
    if n == 0:
        return f"{what:52s} -"
    low = float(beta.ppf(0.025, k, n - k + 1)) if k else 0.0
    high = float(beta.ppf(0.975, k + 1, n - k)) if k < n else 1.0
    return f"{what:52s} {100 * k / n:5.1f} %  ({k}/{n}, 95 %: {100 * low:.0f}-{100 * high:.0f})  {goal}"


def _pooled(singles: Sequence[Score], nones: Sequence[Score]) -> str:
    """The excess over what a right model leaves, where nothing is missing, of all right answers together: a single
    recording's noise is larger than most excesses."""
    right = [s for s in singles if s.right]
    left = float(np.mean([s.before**2 for s in nones])) if nones else float("nan")
    excess = sum(s.before**2 - left for s in right)
    gone = sum(s.before**2 - s.after**2 for s in right)
    share = [gone / excess] if right and excess > 0.0 else []
    return _middle(
        f"share removed of the excess over what {len(nones)} without an effect leave", share, 100.0, "%", ">= 90 %"
    )


def _middle(what: str, values: Sequence[float], scale: float, unit: str, goal: str) -> str:
    if not values:
        return f"{what:52s} -"
    return f"{what:52s} {scale * float(np.median(values)):5.1f} {unit}  (n {len(values)})  {goal}"


def _confusion(scores: Sequence[Score]) -> list[str]:
    counts: dict[str, Counter[str]] = {}
    for s in scores:
        true = "+".join(s.case.truth) or "none"
        answer = "+".join(s.named) if s.verdict == "effect" else s.verdict
        counts.setdefault(f"{true} {s.case.size:g}x" if s.case.truth else true, Counter())[answer] += 1
    return [f"  {true:34s} " + ", ".join(f"{a} {n}" for a, n in c.most_common()) for true, c in sorted(counts.items())]


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="blind_test", description=__doc__)
    parser.add_argument("what", choices=["run", "table"])
    parser.add_argument("--out", type=Path, default=Path("out/blind"))
    parser.add_argument("--set", choices=list(SETS), default="large")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--limit", type=int, default=None, help="only so many cases")
    parser.add_argument("--only", default="", help="only cases whose name contains this")
    parser.add_argument("--keep", action="store_true", help="keep experiments and reports")
    options = parser.parse_args(arguments)
    os.environ.update(ONE_THREAD)
    cases = SETS[options.set]()
    cases = [c for c in cases if options.only in c.name][: options.limit]
    options.out.mkdir(parents=True, exist_ok=True)
    if options.what == "run":
        _run_all(cases, options.out, options.jobs, options.keep)
    print("\n".join(table(s for s in (score(c, options.out) for c in cases) if s is not None)))
    return 0


def _run_all(cases: Sequence[Case], out: Path, jobs: int, keep: bool) -> None:
    with ProcessPoolExecutor(jobs) as pool:
        running = {pool.submit(run_case, case, out, keep): case for case in cases}
        for k, future in enumerate(as_completed(running), start=1):
            case = running[future]
            error = future.exception()
            judged = score(case, out)
            answer = f"could not be made: {error}" if error else "?" if judged is None else judged.verdict
            named = "" if judged is None else "+".join(judged.named)
            print(f"{k}/{len(cases)} {case.name}: {answer} {named}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
