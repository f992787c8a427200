"""The steps of the protocol for a press (docs/how-to/real-press.md), each against what a recording holds.

Presses are told by the markers: while the body rests they stay within their noise, while it is pressed they do not.
The names and their order are those of the page's list.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from livedeform.common.bags.recording import Recording
from livedeform.common.checks.presses import count_presses, lasting, motion, rest_places, without_noise
from livedeform.common.types import Array

ENOUGH_MARKERS = 20
RATE = 10.0  # Hz
SEEN = 0.8  # of the moments
NOISE = 0.2e-3  # m
STILL, HOLD = 2.0, 5.0  # s
TIMES_NOISE = 50.0  # by which markers should move
PRESSES, PLACES = 4, 2
DEEPER, FASTER = 1.5, 3.0  # ratios of depth and of speed between presses
SAME_SHAPE, SAME_DEPTH = 0.97, 0.15  # presses that are repeats: their displacements' cosine, and their sizes' ratio
OTHER_SHAPE = 0.9  # cosine below which presses are at other places
BEYOND, SHARE = 3.0, 0.05  # away from rest: rms of the markers over one axis' noise, and share of the largest


@dataclass(frozen=True)
class ProtocolStep:
    """A step of the protocol: its ``name``, what it ``asks``, what was ``found``; ``kept`` None where the recording
    does not tell."""

    name: str
    asks: str
    found: str
    kept: bool | None


@dataclass(frozen=True)
class SeenPress:
    """A press: ``begins`` and ``ends`` s, ``size`` m (rms of the markers at its deepest), ``shape`` their displacements
    there (3 n,), ``rise`` and ``hold`` s: from a tenth to nine tenths of it, and above nine tenths."""

    begins: float
    ends: float
    size: float
    shape: Array
    rise: float
    hold: float


class MarkerTrack:
    """The markers of a recording: ``seconds`` (n,) and ``points`` (n, m, 3) m, NaN where one was not seen."""

    def __init__(self, recording: Recording) -> None:
        frames = [f for f in recording.measured_frames if len(f.ids)]
        self.frames = frames
        self.ids = np.unique(np.concatenate([f.ids for f in frames])) if frames else np.zeros(0, int)
        self.seconds = np.array([(f.stamp_ns - recording.start_ns) * 1e-9 for f in frames])
        self.points = np.full((len(frames), len(self.ids), 3), np.nan)
        for k, frame in enumerate(frames):
            self.points[k, np.searchsorted(self.ids, frame.ids)] = frame.points

    @cached_property
    def rest(self) -> Array:
        """(m, 3) m: places before the first press, NaN of markers not seen then."""
        known, places = rest_places(self.frames)
        out = np.full((len(self.ids), 3), np.nan)
        out[np.searchsorted(self.ids, known)] = places
        return out

    @cached_property
    def noise(self) -> float:
        """One sigma per axis, m: from differences of neighbouring frames, of which most are of slow movement."""
        d = np.diff(self.points, axis=0)
        d = d[np.isfinite(d)]
        return float(np.median(np.abs(d)) / 0.6745 / np.sqrt(2)) if d.size else float("nan")

    @cached_property
    def moved(self) -> Array:
        """(n,) m: rms displacement of the markers from rest, NaN where none of them is seen."""
        return motion(self.frames)

    @cached_property
    def presses(self) -> list[SeenPress]:
        """Every time at which the markers are away from rest, as a run's coverage counts them."""
        away = self.moved > max(BEYOND * self.noise, SHARE * float(np.nanmax(self.moved, initial=0.0)))
        found = count_presses(*without_noise(lasting(self.moved), self.noise * 3**0.5))
        rows = [press.start + np.flatnonzero(away[press]) for press in found]
        return [self._press(int(k[0]), int(k[-1]) + 1) for k in rows if len(k)]

    def _press(self, a: int, b: int) -> SeenPress:
        s, d = self.seconds[a:b], self.moved[a:b]
        top = float(np.nanpercentile(d, 90))
        deep = np.flatnonzero(d > 0.9 * top)
        shape = np.nan_to_num(np.nanmedian(self._displaced(a + deep), axis=0)).ravel()
        rise = float(s[deep[0]] - self.seconds[max(a - 1, 0)])
        return SeenPress(float(s[0]), float(s[-1]), top, shape, max(rise, 1e-3), float(s[deep[-1]] - s[deep[0]]))

    def _displaced(self, rows: NDArray[np.int64]) -> Array:
        d: Array = self.points[rows] - self.rest
        hidden = ~np.isfinite(d).any(axis=0)
        d[:, hidden] = 0.0
        return d


def protocol(recording: Recording) -> list[ProtocolStep]:
    """Every step, in the protocol's order; what needs markers is unknown where there are none yet."""
    track = MarkerTrack(recording)
    if len(track.seconds) < 3:
        return [
            ProtocolStep(name, asks, "no markers yet: run it, and look at the run's folder", None)
            for name, asks, _ in STEPS
        ]
    return [ProtocolStep(name, asks, *check(track)) for name, asks, check in STEPS]


Check = Callable[[MarkerTrack], tuple[str, bool]]


def _markers(track: MarkerTrack) -> tuple[str, bool]:
    return f"{len(track.ids)}", len(track.ids) >= ENOUGH_MARKERS


def _seen(track: MarkerTrack) -> tuple[str, bool]:
    share = np.isfinite(track.points).all(axis=2).mean(axis=0)
    return f"the least seen one {share.min():.0%}", bool(share.min() >= SEEN)


def _rate(track: MarkerTrack) -> tuple[str, bool]:
    rate = 1.0 / float(np.median(np.diff(track.seconds)))
    return f"{rate:.1f} Hz", rate >= 0.95 * RATE


def _noise(track: MarkerTrack) -> tuple[str, bool]:
    return f"{1e3 * track.noise:.3f} mm", track.noise <= NOISE


def _still_before(track: MarkerTrack) -> tuple[str, bool]:
    first = track.presses[0].begins - float(track.seconds[0]) if track.presses else 0.0
    return (f"{first:.1f} s", first >= STILL) if track.presses else ("nothing is pressed", False)


def _presses(track: MarkerTrack) -> tuple[str, bool]:
    return f"{len(track.presses)}", len(track.presses) >= PRESSES


def _places(track: MarkerTrack) -> tuple[str, bool]:
    places: list[SeenPress] = []
    for press in track.presses:
        if all(_cosine(press, other) < OTHER_SHAPE for other in places):
            places.append(press)
    return f"{len(places)}", len(places) >= PLACES


def _depths(track: MarkerTrack) -> tuple[str, bool]:
    pairs = [(a.size, b.size) for a in track.presses for b in track.presses if _cosine(a, b) >= OTHER_SHAPE]
    ratio = max((a / b for a, b in pairs), default=0.0)
    return f"at one place the deepest moves the markers {ratio:.1f} times as far as another", ratio >= DEEPER


def _deep_enough(track: MarkerTrack) -> tuple[str, bool]:
    largest = float(np.nanmax(np.linalg.norm(track.points - track.rest, axis=2), initial=0.0))
    if not largest > 0.0:
        return "no marker moves", False
    times = largest / track.noise if track.noise > 0 else np.inf
    return f"a marker moves {1e3 * largest:.1f} mm, {times:.0f} times the noise", times >= TIMES_NOISE


def _hold(track: MarkerTrack) -> tuple[str, bool]:
    longest = max((p.hold for p in track.presses), default=0.0)
    return f"{longest:.1f} s", longest >= HOLD


def _speeds(track: MarkerTrack) -> tuple[str, bool]:
    rises = [p.rise for p in track.presses]
    ratio = max(rises) / min(rises) if rises else 0.0
    return (
        f"the fastest is down in {min(rises, default=0.0):.1f} s, the slowest in {ratio:.1f} times that",
        ratio >= FASTER,
    )


def _repeats(track: MarkerTrack) -> tuple[str, bool]:
    pairs = [(a, b) for k, a in enumerate(track.presses) for b in track.presses[k + 1 :]]
    same = sum(_cosine(a, b) > SAME_SHAPE and abs(a.size / b.size - 1) < SAME_DEPTH for a, b in pairs)
    return f"{same} pairs of presses alike", same >= 1


def _still_between(track: MarkerTrack) -> tuple[str, bool]:
    pauses = [b.begins - a.ends for a, b in pairwise(track.presses)]
    shortest = min(pauses, default=0.0)
    return f"the shortest {shortest:.1f} s", shortest >= STILL


def _still_after(track: MarkerTrack) -> tuple[str, bool]:
    last = float(track.seconds[-1]) - track.presses[-1].ends if track.presses else 0.0
    return f"{last:.1f} s", last >= STILL


def _cosine(a: SeenPress, b: SeenPress) -> float:
    size = float(np.linalg.norm(a.shape) * np.linalg.norm(b.shape))
    return float(a.shape @ b.shape) / size if size > 0 else 0.0


STEPS: tuple[tuple[str, str, Check], ...] = (
    ("markers", f"{ENOUGH_MARKERS} or more", _markers),
    ("seen", f"every marker in {SEEN:.0%} of the moments", _seen),
    ("rate", f"{RATE:g} Hz or more", _rate),
    ("noise", f"at most {1e3 * NOISE:g} mm per axis", _noise),
    ("still time before", f"{STILL:g} s or more", _still_before),
    ("presses", f"{PRESSES} or more", _presses),
    ("places", f"{PLACES} or more", _places),
    ("depths", f"one {DEEPER:g} times as deep as another there", _depths),
    ("deep enough", f"a marker moves {TIMES_NOISE:g} times the noise", _deep_enough),
    ("hold", f"one of {HOLD:g} s or more", _hold),
    ("speeds", f"one down {FASTER:g} times as fast as another", _speeds),
    ("repeats", "one press twice, at the same place and depth", _repeats),
    ("still time between", f"{STILL:g} s or more", _still_between),
    ("still time after", f"{STILL:g} s or more", _still_after),
)
"""Name, what is asked, and the check, in the order of the protocol's page."""
