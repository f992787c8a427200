"""The user's own press: the folder of a ``livedeform run``, its markers before and at the press paired with each other.

The model's error in the press is what the press adds to each marker's error; what a marker is off at rest
(registration, its reference place) is there before and after.
"""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from livedeform.common.errors import InputError
from livedeform.common.experiment.yaml_file import Lesion, load_experiment
from livedeform.common.types import Array, Ids
from livedeform.compare_node.metrics import rmse
from livedeform.report.page import Table
from livedeform.run.results import COLUMNS
from livedeform.studies.own.numbers import MEASURED, Key, named_values
from livedeform.studies.study import COLOURS, FAILS, HOLDS, OPEN, PARTLY, Progress, StudyPage, figure

KEYS = {
    "before": Key("second of the frame before the press", 0.0, 1e6, float("nan")),
    "press": Key("second of the frame at the press", 0.0, 1e6, float("nan")),
}
FEWEST = 3  # markers that both frames show
STILL = 1e-6  # m: a model that moves less than this was not pressed
NEEDLES = (0.0, 0.001, 0.002, 0.003)  # m, one sigma of the needle's tip per coordinate
SEED, N_DRAWS = 5, 4000
REMEDY = "name the --out of a 'livedeform run' with --data"
MM = 1e3


@dataclass(frozen=True)
class Frame:
    """One moment of ``markers.csv``: ``ids`` (n,), ``predicted`` and ``errors`` = measured - predicted (n, 3) m,
    ``sigmas`` (n,) m of a measured coordinate, NaN where the tracker gave none."""

    seconds: float
    ids: Ids
    predicted: Array
    errors: Array
    sigmas: Array

    def of(self, ids: Ids) -> Frame:
        """These markers only, in their order."""
        rows = [int(np.flatnonzero(self.ids == i)[0]) for i in ids]
        return Frame(self.seconds, ids, self.predicted[rows], self.errors[rows], self.sigmas[rows])


@dataclass(frozen=True)
class OwnPress:
    """The frames ``before`` and at the ``press`` with the same markers; the run's ``threshold`` m; the experiment's
    lesions, or why there are none."""

    name: str
    before: Frame
    press: Frame
    threshold: float
    lesions: tuple[Lesion, ...]
    no_lesion: str = ""

    @property
    def change(self) -> Array:
        """Return what the press adds to each marker's error (n, 3) m."""
        return self.press.errors - self.before.errors

    @property
    def sigmas(self) -> Array:
        """One sigma of a coordinate of `change` (n,) m; NaN where it is not known."""
        return np.hypot(self.before.sigmas, self.press.sigmas)


def read_run(folder: Path, measured: str = "") -> OwnPress:
    """The press in the folder of a run; ``measured`` as "before=0.1,press=1.2" names the frames by their seconds."""
    seconds = named_values(measured, KEYS)
    frames = read_frames(folder / "markers.csv")
    name, threshold = _read_metrics(folder / "metrics.json")
    first = _at(frames, seconds["before"], "before") if np.isfinite(seconds["before"]) else frames[0]
    if np.isfinite(seconds["press"]):
        last = _at(frames, seconds["press"], "press")
    else:
        last = max(frames, key=lambda f: motion(first, f))
    if motion(first, last) < STILL:
        raise InputError(
            f"the model does not move between {first.seconds:.3f} s and {last.seconds:.3f} s",
            where=str(folder / "markers.csv"),
            remedy=f"give a run with a press, or name its frames with {MEASURED} before=...,press=...",
        )
    common = np.intersect1d(first.ids, last.ids)
    lesions, why = _lesions(folder)
    return OwnPress(name, first.of(common), last.of(common), threshold, lesions, why)


def motion(a: Frame, b: Frame) -> float:
    """Root mean square of the predicted motion (m) of the markers that both show; 0 if these are too few."""
    common = np.intersect1d(a.ids, b.ids)
    if len(common) < FEWEST:
        return 0.0
    return rmse(np.linalg.norm(b.of(common).predicted - a.of(common).predicted, axis=1))


def read_frames(path: Path) -> list[Frame]:
    """The frames of a run's ``markers.csv`` that show enough markers, in the order of time."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not text"
        raise InputError(f"cannot be read ({reason})", where=str(path), remedy=REMEDY) from error
    rows = csv.DictReader(lines)
    missing = [c for c in COLUMNS if c not in (rows.fieldnames or [])]
    if missing:
        raise InputError(f"column {', '.join(missing)} is missing", where=str(path), remedy=REMEDY)
    by_stamp: dict[int, list[list[float]]] = {}
    for number, row in enumerate(rows, start=2):
        try:
            values = [float(row[c]) for c in COLUMNS[1:12]]
            values.append(float(row["sigma"]) if row["sigma"] else float("nan"))
            by_stamp.setdefault(int(row["stamp_ns"]), []).append(values)
        except (TypeError, ValueError) as error:
            remedy = "the file is torn: make the run again"
            raise InputError("a number is missing or is none", where=f"{path}:{number}", remedy=remedy) from error
    frames = []
    for stamp in sorted(by_stamp):
        table = np.array(by_stamp[stamp])
        table = table[np.isfinite(table[:, :-1]).all(axis=1)]  # NaN: the model did not converge
        if len(table) >= FEWEST:
            ids = table[:, 1].astype(np.uint32)
            frames.append(Frame(float(table[0, 0]), ids, table[:, 5:8], table[:, 8:11], table[:, 11]))
    if len(frames) < 2:
        raise InputError(
            f"{len(frames)} frames show {FEWEST} markers or more",
            where=str(path),
            remedy="two are needed, one before and one at the press",
        )
    return frames


def _at(frames: list[Frame], seconds: float, key: str) -> Frame:
    nearest = min(frames, key=lambda f: abs(f.seconds - seconds))
    if abs(nearest.seconds - seconds) > 0.5:
        raise InputError(
            f"no frame is within half a second of {seconds:g} s",
            where=f"{MEASURED} {key}",
            remedy=f"the run goes from {frames[0].seconds:.2f} to {frames[-1].seconds:.2f} s",
        )
    return nearest


def _read_metrics(path: Path) -> tuple[str, float]:
    """The experiment's name and the threshold (m) of ``metrics.json``."""
    try:
        document = json.loads(path.read_text())
        return str(document["experiment"]), float(document["threshold"])
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", where=str(path), remedy=REMEDY) from error
    except (ValueError, KeyError, TypeError) as error:
        raise InputError("is not what a run writes", where=str(path), remedy="make the run again") from error


def _lesions(folder: Path) -> tuple[tuple[Lesion, ...], str]:
    try:
        lesions = load_experiment(folder, geometry=False).lesions
    except InputError as error:
        return (), f"the experiment of the run cannot be read: {error}"
    return lesions, "" if lesions else "the experiment has no lesion (phantom.lesions)"


def run_own(out: Path, own: OwnPress, progress: Progress) -> dict[str, Any]:
    """The study of the user's press."""
    progress("probe: pairing the markers", None)
    moved = motion(own.before, own.press)
    page = StudyPage(
        "probe",
        "Your phantom under the probe",
        f"What does the press add to the model's error: less than {own.threshold * MM:g} mm?",
        out,
        inputs={"experiment": own.name, "before the press": f"{own.before.seconds:.3f} s",
                "at the press": f"{own.press.seconds:.3f} s", "markers in both": len(own.change),
                "predicted motion": f"{moved * MM:.2f} mm rms"},
        seed=SEED,
    )  # fmt: skip
    rms, interval, noise = paired_rms(own)
    _maxima(page, own)
    _paired(page, own, rms, interval, noise)
    _lesion(page, own, rms)
    page.limits += [
        "One frame before and one at the press: what is slow between them (creep, drift) counts as the press's.",
        "Markers say what happens where they are.",
    ]
    if not np.isfinite(noise):
        page.limits.append("No sigma of the markers is known: nothing is taken off for noise, all errors are "
                           "upper bounds.")  # fmt: skip
    return page.finish()


def paired_rms(own: OwnPress) -> tuple[float, tuple[float, float], float]:
    """Root mean square (m) of what the press adds with the noise's share taken off, its 95 % interval over markers
    (bootstrap), and the noise's rms, NaN if it is not known (then nothing is taken off)."""
    square = (own.change**2).sum(axis=1)
    noise = 3.0 * own.sigmas**2
    known = bool(np.isfinite(noise).all())
    excess = square - noise if known else square
    rng = np.random.default_rng(SEED)
    draws = excess[rng.integers(0, len(excess), (N_DRAWS, len(excess)))].mean(axis=1)
    low, high = np.sqrt(np.maximum(np.quantile(draws, [0.025, 0.975]), 0.0))
    rms = float(np.sqrt(max(excess.mean(), 0.0)))
    return rms, (float(low), float(high)), float(np.sqrt(noise.mean())) if known else float("nan")


def _verdict(low: float, high: float, limit: float) -> str:
    return HOLDS if high < limit else FAILS if low > limit else OPEN


def _maxima(page: StudyPage, own: OwnPress) -> None:
    """The largest errors before and at the press, and all that they say."""
    before, after = (float(np.linalg.norm(f.errors, axis=1).max()) for f in (own.before, own.press))
    low, high = abs(after - before), after + before
    page.numbers["maxima"] = {"before_m": before, "at_press_m": after, "bounds_m": (low, high)}
    page.claim(
        f"The press adds less than {own.threshold * MM:g} mm: from the two maxima",
        f"{after * MM:.2f} - {before * MM:.2f} = {(after - before) * MM:.2f} mm",
        f"between {low * MM:.2f} and {high * MM:.2f} mm for certain",
        _verdict(low, high, own.threshold),
        "Two maxima, perhaps of two markers: max|a| - max|b| <= max|a - b| <= max|a| + max|b|.",
    )


def _paired(page: StudyPage, own: OwnPress, rms: float, interval: tuple[float, float], noise: float) -> None:
    length = np.linalg.norm(own.change, axis=1)
    worst = int(length.argmax())
    sigma = float(own.sigmas[worst])
    known = np.isfinite(noise)
    low, high = (max(length[worst] - 2 * sigma, 0.0), length[worst] + 2 * sigma) if known else (0.0, length[worst])
    page.numbers["paired"] = {
        "n": len(length), "largest_m": length[worst], "largest_marker": int(own.press.ids[worst]),
        "largest_interval_m": (low, high), "rms_m": rms, "rms_interval_95_m": interval, "noise_rms_m": noise,
    }  # fmt: skip
    page.claim(
        f"The press adds less than {own.threshold * MM:g} mm: each marker against itself",
        "",
        f"largest {length[worst] * MM:.2f} mm (marker {own.press.ids[worst]}, {low * MM:.2f} to {high * MM:.2f} mm); "
        f"rms {rms * MM:.2f} mm ({interval[0] * MM:.2f} to {interval[1] * MM:.2f} mm)",
        _verdict(low, high, own.threshold),
        "The largest of many is too large by noise, so that its lower end is generous." if known else "",
    )
    fig, axes = figure(6.6, 3.1, 2)
    a, b = (np.linalg.norm(f.errors, axis=1) * MM for f in (own.before, own.press))
    axes[0].plot(a, b, "o", color=COLOURS[1])
    end = 1.05 * max(a.max(), b.max())
    axes[0].plot([0, end], [0, end], "k-", lw=0.7)
    axes[0].set(xlabel="error before (mm)", ylabel="error at the press (mm)", title="two frames")
    order = np.argsort(length)[::-1]
    error = 2 * own.sigmas[order] * MM if known else None
    axes[1].errorbar(np.arange(len(order)), length[order] * MM, error, fmt="o", color=COLOURS[0], ms=3.5, capsize=2)
    axes[1].axhline(own.threshold * MM, color="k", lw=0.7, ls="--")
    axes[1].set(
        xlabel="marker, by size", ylabel="added by the press (mm)", title="the same markers, paired", ylim=(0, None)
    )
    taken = f"The noise ({noise * MM:.2f} mm rms) is taken off the rms." if known else "The noise is not known."
    page.section(
        "Maxima and pairs",
        f"{len(length)} markers at {own.before.seconds:.2f} s and at {own.press.seconds:.2f} s. {taken} The interval "
        "of the rms is over markers, the largest ± two sigmas of its measurement.",
        figures=[
            ("probe_own", fig, "Left: error before and at the press. Right: what the press adds; dashed: threshold.")
        ],
    )


def _lesion(page: StudyPage, own: OwnPress, rms: float) -> None:
    """Probability that a needle sent to the predicted centre ends inside each lesion."""
    if not own.lesions:
        page.numbers["lesion"] = None
        page.limits.append(f"No verdict on a lesion: {own.no_lesion}.")
        return
    rng = np.random.default_rng(SEED + 1)
    whole = rmse(np.linalg.norm(own.change, axis=1))
    drawn = own.change[rng.integers(0, len(own.change), 20000)] * (rms / whole if whole > 0 else 0.0)
    rows, numbers = [], {}
    for lesion in own.lesions:
        tips = (drawn + rng.normal(0.0, 1.0, drawn.shape) * needle for needle in NEEDLES)
        chances = [float((np.linalg.norm(tip, axis=1) < 0.5 * lesion.diameter).mean()) for tip in tips]
        numbers[lesion.name] = dict(zip(map(str, NEEDLES), chances, strict=True))
        rows.append((f"{lesion.name}, {lesion.diameter * MM:g} mm", *(f"{100 * c:.1f} %" for c in chances)))
        chance = chances[2]
        page.claim(
            f"A needle (± 2 mm) hits lesion {lesion.name}, if the model errs there as at the markers",
            "",
            f"{100 * chance:.0f} %",
            HOLDS if chance > 0.95 else PARTLY if chance > 0.5 else FAILS,
            "What the press adds only; no marker is where the lesion is, and nothing has measured it.",
        )
    page.numbers["lesion"] = numbers
    page.section(
        "The lesion",
        "The lesion's own error is not measured. If it is like the markers' (the added part, noise taken off), a "
        "needle sent to the predicted centre ends inside with the probability:",
        tables=[Table(("lesion", *(f"needle ± {n * MM:g} mm" for n in NEEDLES)), tuple(rows), numbers=(1, 2, 3, 4))],
    )
