"""Judge the diagnoses of the blind test against the truth, and print the table.

``score`` reads what ``run`` left of one case; ``table`` counts many of them.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import beta

from benchmarks.blind.cases import NEUTRAL, Case, nothing_at
from benchmarks.blind.detection import curve, predicted
from livedeform.common.types import Array


@dataclass(frozen=True)
class Score:
    """One case judged. ``errors``: relative error of each fitted number; ``covered``: whether its 95 % interval
    holds; ``before``, ``after`` m: errors on the test recording; ``removed``: share of the excess over its noise;
    ``baselines``: what other methods said, and the share that they removed; ``strength``: how large a single effect is
    over the noise, as measured; ``expected``: the probability with which the diagnosis says that it would see it."""

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
    baselines: Mapping[str, Any] | None = None
    strength: float = float("nan")
    expected: float = float("nan")

    @property
    def right(self) -> bool:
        if self.case.kind == "none":
            return self.verdict == "none"
        if self.case.kind == "outside":
            return self.verdict == "unexplained"
        return self.verdict == "effect" and set(self.named) == set(self.case.truth)

    @property
    def in_set(self) -> bool:
        """Named right, or every true effect is among at most three, of those named and those that cannot be told from
        them."""
        together = set(self.named) | set(self.alternatives)
        return self.right or (self.verdict == "effect" and len(together) <= 3 and set(self.case.truth) <= together)

    @property
    def false_alarm(self) -> bool:
        """Whether something is said to be the matter, or nothing is said, where nothing is."""
        return self.case.kind == "none" and self.verdict not in ("none", "undecided")

    @property
    def confidently_wrong(self) -> bool:
        return self.verdict == "effect" and not set(self.case.truth) & (set(self.named) | set(self.alternatives))


def score(case: Case, out: Path) -> Score | None:
    """Judge a finished case; None if it is not finished, or could not be made. A diagnosis that failed counts as
    ``failed``."""
    result = _result(case, out)
    if result is None or "error" in result:
        return None
    found, seconds = result["diagnosis"], float(result["seconds"])
    if found is None:
        nan = float("nan")
        strength = float(result.get("size_over_noise", "nan"))
        return Score(case, "failed", (), (), (), (), nan, nan, nan, seconds, strength=strength)
    named = tuple(e["name"] for e in found["effects"])
    errors, covered = _accuracy(case, found)
    before, after = float(found["error_before"]["rmse"]), float(found["error_after"]["rmse"])
    return Score(
        case=case,
        verdict=found["verdict"],
        named=named,
        alternatives=_alternatives(found, named),
        errors=tuple(errors),
        covered=tuple(covered),
        before=before,
        after=after,
        removed=_removed(found, before, after),
        seconds=seconds,
        baselines=_baselines(found, result.get("baselines")),
        strength=float(result.get("size_over_noise", "nan")),
        expected=_expected(case, found),
    )


def unmade(case: Case, out: Path) -> str | None:
    """Return why a case that was begun could not be made; None of all others."""
    result = _result(case, out)
    return None if result is None or "error" not in result else str(result["error"])


def _result(case: Case, out: Path) -> dict[str, Any] | None:
    """Return what ``run`` left of a case; None where there is nothing."""
    path = out / case.name / "result.json"
    return dict(json.loads(path.read_text())) if path.is_file() else None


def _expected(case: Case, found: Mapping[str, Any]) -> float:
    """Return the probability with which a diagnosis says that it would see the truth; NaN where a part of it is
    declared, of which what would be seen is a difference."""
    spec = case.scenario()
    if spec["declared"].get("effects"):
        return float("nan")
    return predicted(spec["truth"], found, nothing_at(spec))


def _alternatives(found: Mapping[str, Any], named: Sequence[str]) -> tuple[str, ...]:
    """Effects that the diagnosis could not tell from those it named."""
    rivals = {n for c in found["candidates"] if c["name"] in named for n in c["indistinguishable_from"]}
    return tuple(sorted(rivals - set(named)))


def _removed(found: Mapping[str, Any], before: float, after: float | None) -> float:
    """Share of the excess over the noise that is gone; NaN where there is hardly any excess."""
    floor = found["noise_floor"]
    excess = before**2 - floor**2
    if after is None or excess <= 0.05 * floor**2:
        return float("nan")
    return float((before**2 - max(after, floor) ** 2) / excess)


def _baselines(found: Mapping[str, Any], said: Mapping[str, Any] | None) -> Mapping[str, Any] | None:
    """What other methods said of the same data, with the shares of the excess that they removed."""
    if said is None:
        return None
    before = float(found["error_before"]["rmse"])
    shares = {k: _removed(found, before, said[f"{k}_rmse"]) for k in ("modulus", "process")}
    return {**said, **shares, "finer": _removed(found, said["finer_before_rmse"], said["finer_after_rmse"])}


def _accuracy(case: Case, found: Mapping[str, Any]) -> tuple[list[float], list[bool]]:
    """Relative errors of all fitted numbers that are known, and whether their intervals hold the truth."""
    errors, covered = [], []
    spec = case.scenario()
    for true in spec["truth"]:
        for effect in found["effects"]:
            if effect["name"] == true["name"]:
                e, c = compare(true, effect["parameters"], nothing_at(spec))
                errors += e
                covered += c
    return errors, covered


def compare(
    true: Mapping[str, Any], parameters: Mapping[str, Any], nothing: Mapping[str, float] = NEUTRAL
) -> tuple[list[float], list[bool]]:
    """Return the errors of an effect's numbers, relative to how far from ``nothing`` the ``true`` ones are, and whether
    their intervals hold these: those of numbers that are more or fewer than the true ones do not."""
    errors, covered = [], []
    for name, fitted in parameters.items():
        if name not in true:
            continue
        t, v = np.atleast_1d(np.asarray(true[name], float)), np.atleast_1d(np.asarray(fitted["value"], float))
        if t.shape != v.shape:
            covered += [False] * v.size
            continue
        angle = name == "direction" and t.size == 1  # the same after a turn, and without a size to be wrong by
        t = t + 2.0 * np.pi * np.round((v - t) / (2.0 * np.pi)) if angle else t
        size = 0.0 if angle else float(np.linalg.norm(t - nothing.get(name, 0.0)))
        if size > 0.0:
            errors.append(float(np.linalg.norm(v - t)) / size)
        sigma = np.atleast_1d(np.asarray(fitted["sigma"], float))
        low, high = _ends(fitted.get("interval"), v, sigma)
        covered += [bool(x) for x in (low <= t) & (t <= high)]
    return errors, covered


def _ends(interval: Any, value: Array, sigma: Array) -> Array:
    """Return the lower and upper ends (2, n) of 95 % intervals; null is an end without a bound."""
    if interval is None:
        return np.array([value - 1.96 * sigma, value + 1.96 * sigma])
    ends = np.asarray(interval, float).reshape(-1, 2).T  # NaN for null
    return np.where(np.isfinite(ends), ends, [[-np.inf], [np.inf]])


def table(scores: Iterable[Score], reasons: Mapping[str, str] | None = None) -> list[str]:
    """The figures of the blind test with their counts and 95 % bounds (Clopper & Pearson 1934).

    ``reasons``: why cases could not be made, by their names; nothing is known of their diagnoses, so that they are
    listed and are in no share. Bounds are by as many experiments as are distinct (`Case.distinct`): what is pressed
    alike and has the same true effects may be misjudged alike.
    """
    all_ = list(scores)
    lines = [f"{len(all_)} experiments, {sum(s.verdict == 'failed' for s in all_)} diagnoses failed"]
    if reasons:
        lines.append(f"{len(reasons)} of {len(all_) + len(reasons)} could not be made, and are in no share below:")
        lines += [f"  {name}: {reason}" for name, reason in reasons.items()]
    lines.append("")
    lines += [*_shares(all_), *_medians(all_), "", *_of_baselines(all_)]
    singles = _of_kind(all_, "single")
    measured = [(s.strength, s.right, s.expected) for s in singles if np.isfinite(s.strength)]
    lines += ["", *curve(measured), f"of {len(singles) - len(measured)} more the size is not measured"]
    return [*lines, "", "true effect -> what was answered", *_confusion(all_)]


def _of_kind(scores: Iterable[Score], *kinds: str, size: float | None = None) -> list[Score]:
    return [s for s in scores if s.case.kind in kinds and (size is None or s.case.size == size)]


def _each(scores: Iterable[Score], told: Callable[[Score], bool]) -> list[tuple[Hashable, bool]]:
    """Return what is told of each score, beside what makes its experiment distinct."""
    return [(s.case.distinct, told(s)) for s in scores]


def _shares(scores: Sequence[Score]) -> list[str]:
    """Tabulate how often the diagnoses were right, wrong, or in a small set, with the goals."""

    def right(*kinds: str, size: float | None = None) -> list[tuple[Hashable, bool]]:
        return _each(_of_kind(scores, *kinds, size=size), lambda s: s.right)

    def in_set(*kinds: str, size: float | None = None) -> list[tuple[Hashable, bool]]:
        return _each(_of_kind(scores, *kinds, size=size), lambda s: s.in_set)

    def undecided(*kinds: str, size: float | None = None) -> list[tuple[Hashable, bool]]:
        return _each(_of_kind(scores, *kinds, size=size), lambda s: s.verdict == "undecided")

    singles, wrong_of = _of_kind(scores, "single"), _of_kind(scores, "single", "pair", "outside", "poor")
    held = [((s.case.distinct, i), c) for s in singles for i, c in enumerate(s.covered)]
    return [
        _share("named right at 3 x noise", right("single", size=3.0), ""),
        _share("named right at 2 x noise", right("single", size=2.0), ">= 95 %"),
        _share("named right at 1 x noise", right("single", size=1.0), ">= 85 %"),
        _share("named right at 0.5 x noise", right("single", size=0.5), ""),
        _share("right, or in a set of at most 3, at 2 x", in_set("single", size=2.0), ">= 98 %"),
        _share("undecided at 2 x", undecided("single", size=2.0), ""),
        _share("undecided at 1 x", undecided("single", size=1.0), ""),
        _share("right, or in a set of at most 3, at 3 x", in_set("single", size=3.0), ""),
        _share("pairs named right", right("pair"), ""),
        _share("pairs: right, or in a set", in_set("pair"), ""),
        _share("false alarms without an effect", _each(_of_kind(scores, "none"), lambda s: s.false_alarm), "<= 3 %"),
        _share("undecided without an effect", undecided("none"), ""),
        _share("confidently wrong", _each(wrong_of, lambda s: s.confidently_wrong), "<= 1 %"),
        _share("outside effects called unexplained", right("outside"), ">= 90 %"),
        _share("poor trajectory: right, or in a set", in_set("poor"), ""),
        _share("95 % intervals that hold the truth", held, "93-97 %"),
    ]


def _medians(scores: Sequence[Score]) -> list[str]:
    """Tabulate the accuracy of the right diagnoses, the share of the excess they remove, and the time they take."""
    singles = _of_kind(scores, "single")
    errors = [e for s in singles if s.right for e in s.errors]
    removed = [s.removed for s in singles if s.right and np.isfinite(s.removed)]
    return [
        _median("median parameter error", errors, 100.0, "%", "<= 5 %"),
        _median("median share of the excess removed, test recording", removed, 100.0, "%", ">= 90 %"),
        _pooled(singles, _of_kind(scores, "none")),
        _median("median time of one diagnosis", [s.seconds for s in scores], 1.0, "s", "<= 60 s on 2 cores"),
    ]


def _of_baselines(scores: Sequence[Score]) -> list[str]:
    """Lines on the same experiments by the methods in common use."""
    known = [(s, s.baselines) for s in scores if s.baselines is not None]
    singles = [(s, m) for s, m in known if s.case.kind == "single" and s.case.size >= 1.0]
    nones = [(s, m) for s, m in known if s.case.kind == "none"]
    lines = []
    for key, what in (("bic", "BIC over the same library"), ("signature", "likeness of signatures")):
        named = [(s.case.distinct, m[key] in s.case.truth) for s, m in singles]
        lines.append(_share(f"{what}: named right, 1 x and more", named, ""))
        lines.append(_share(f"{what}: false alarms", [(s.case.distinct, m[key] != "none") for s, m in nones], ""))
    lines += _of_falsification(singles, nones)
    ours = [s.removed for s, _ in singles if np.isfinite(s.removed)]
    lines.append(_median("median share of the excess removed: livedeform", ours, 100.0, "%", ""))
    others = (("finer", "livedeform, the elements' own error taken off"), ("modulus", "the modulus refitted"))
    for key, what in (*others, ("process", "a Gaussian process")):
        shares = [m[key] for _, m in singles if np.isfinite(m[key])]
        lines.append(_median(f"median share of the excess removed: {what}", shares, 100.0, "%", ""))
    return lines


def _of_falsification(
    singles: Sequence[tuple[Score, Mapping[str, Any]]], nones: Sequence[tuple[Score, Mapping[str, Any]]]
) -> list[str]:
    """Return lines on model falsification: it names a set, the larger the less it tells."""
    left = [(s, m["edmf"]) for s, m in singles if "edmf" in m]
    alarms = [(s.case.distinct, "none" not in m["edmf"]) for s, m in nones if "edmf" in m]
    what = "EDMF over the same library"
    found = [(s.case.distinct, "none" not in names and bool(set(s.case.truth) & set(names))) for s, names in left]
    falsified = [(s.case.distinct, "none" not in names) for s, names in left]
    return [
        _share(f"{what}: falsifies what was declared", falsified, ""),
        _share(f"{what}: and leaves the true effect", found, ""),
        _median(f"{what}: models left", [len(names) for _, names in left], 1.0, "", ""),
        _share(f"{what}: false alarms", alarms, ""),
    ]


def bounds(k: float, n: float) -> tuple[float, float]:
    """Return the 95 % interval of a share of which ``k`` of ``n`` were seen (Clopper & Pearson 1934)."""
    low = float(beta.ppf(0.025, k, n - k + 1)) if k else 0.0
    high = float(beta.ppf(0.975, k + 1, n - k)) if k < n else 1.0
    return low, high


def _share(what: str, hits: Sequence[tuple[Hashable, bool]], goal: str) -> str:
    """Return the line of a share; ``hits``: what makes an experiment distinct, and whether it counts, of each."""
    n, k, m = len(hits), sum(hit for _, hit in hits), len({key for key, _ in hits})
    if n == 0:
        return f"{what:52s} -"
    low, high = bounds(k * m / n, m)
    of = f"{k}/{n}" if m == n else f"{k}/{n} of {m} distinct"
    return f"{what:52s} {100 * k / n:5.1f} %  ({of}, 95 %: {100 * low:.0f}-{100 * high:.0f})  {goal}"


def _pooled(singles: Sequence[Score], nones: Sequence[Score]) -> str:
    """The excess over what a right model leaves, where nothing is missing, of all right diagnoses together: a single
    recording's noise is larger than most excesses."""
    right = [s for s in singles if s.right]
    left = float(np.mean([s.before**2 for s in nones])) if nones else float("nan")
    excess = sum(s.before**2 - left for s in right)
    gone = sum(s.before**2 - s.after**2 for s in right)
    share = [gone / excess] if right and excess > 0.0 else []
    return _median(
        f"share removed of the excess over what {len(nones)} without an effect leave", share, 100.0, "%", ">= 90 %"
    )


def _median(what: str, values: Sequence[float], scale: float, unit: str, goal: str) -> str:
    if not values:
        return f"{what:52s} -"
    return f"{what:52s} {scale * float(np.median(values)):5.1f} {unit}  (n {len(values)})  {goal}"


def _confusion(scores: Sequence[Score]) -> list[str]:
    counts: dict[str, Counter[str]] = {}
    for s in scores:
        true = "+".join(s.case.truth) or "none"
        found = "+".join(s.named) if s.verdict == "effect" else s.verdict
        counts.setdefault(f"{true} {s.case.size:g}x" if s.case.truth else true, Counter())[found] += 1
    return [f"  {true:34s} " + ", ".join(f"{a} {n}" for a, n in c.most_common()) for true, c in sorted(counts.items())]
