"""Hold what one recording says of all candidates at once: the normal equations that its diagnosis kept.

With x the amplitudes in units of their priors' sigmas, the log likelihood relative to the declared model is
b^T x - x^T G x / 2. Under a prior x_e ~ N(m, s^2) of an effect's amplitudes it integrates out in closed form, and what
remains is of the same form in the other effects (`KeptEvidence.given`).
"""

from __future__ import annotations

import zipfile
import zlib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from livedeform.closed_loop.candidates import TRANSFORMS
from livedeform.common.types import Array

SEEN = 1e-9  # of a column's square: below, the recording does not see it at all
ALIKE_SIGMAS, ALIKE_WIDTH = 0.5, 0.125  # of a place's or a time's prior, and of what is tried: what is nearer is alike
LEAST, FARTHEST = 1e-12, 1e12  # by which a number may differ that is tried at one value only, and any place
KIND = "~"  # between an effect's name and the number of its kind, where recordings have several
UNREADABLE = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error)  # kept evidence that is torn


@dataclass(frozen=True)
class Label:
    """One amplitude: its ``parameter``, its ``index`` in it (-1: a scalar), and its coordinate as in
    `closed_loop.candidates.Coordinate`, in sigmas from ``neutral``; ``of``: what it is a ratio to, NaN where to
    nothing or nobody says."""

    parameter: str
    index: int
    sigma: float
    transform: str
    neutral: float
    of: float = float("nan")

    def value(self, x: float) -> float:
        """Return the parameter's value at the amplitude ``x``, in sigmas."""
        forward, back = TRANSFORMS[self.transform]  # type: ignore[index]
        z = x * self.sigma + forward(self.neutral)
        return back(max(z, 0.0) if self.transform == "inverse" else z)  # no spring is stiffer than a rigid one

    def shift(self, other: Label) -> float:
        """Return the amplitude, in sigmas, of what is neutral to another label."""
        forward, _ = TRANSFORMS[self.transform]  # type: ignore[index]
        return (forward(other.neutral) - forward(self.neutral)) / self.sigma


@dataclass(frozen=True)
class KeptShape:
    """One number of what an effect's amplitudes are the strength of, a place or a time: its ``value``, the
    ``transform`` to its coordinate, and by how much of that another may differ and mean the same, ``apart``."""

    parameter: str
    index: int
    value: float
    transform: str
    apart: float

    @property
    def place(self) -> float:
        """Return the coordinate."""
        forward, _ = TRANSFORMS[self.transform]  # type: ignore[index]
        with np.errstate(divide="ignore"):
            return float(np.clip(np.nan_to_num(forward(self.value)), -FARTHEST, FARTHEST))


@dataclass(frozen=True)
class KeptEvidence:
    """``G`` (p, p) and ``b`` (p,) of the amplitudes in sigmas, from what the recording's experiment declares;
    ``columns`` of each effect; ``gain``: the log evidence of what is integrated out already; ``shapes``: what an
    effect's amplitudes are the strength of.

    ``declared`` (d,) of an effect: where these amplitudes are zero, in sigmas from the neutral values of the ``labels``
    (none: there). Means and values that are given and told are from these, as recordings have them in common.
    """

    name: str
    phantom: str
    rig: str
    G: Array
    b: Array
    columns: Mapping[str, np.ndarray]
    labels: Mapping[str, tuple[Label, ...]]
    gain: float = 0.0
    declared: Mapping[str, Array] = field(default_factory=dict)
    shapes: Mapping[str, tuple[KeptShape, ...]] = field(default_factory=dict)

    def _mean(self, effect: str, mean: Array | float | None) -> Array:
        """Return an amplitude's ``mean`` (d,) from what is declared; that itself for None."""
        n = len(self.columns[effect])
        return np.zeros(n) if mean is None else np.broadcast_to(mean, n) - self.declared.get(effect, 0.0)

    def gain_of(self, effect: str, mean: Array | float | None = None, variance: Array | float = 1.0) -> float:
        """Return the log evidence of an effect with amplitudes N(mean, variance), over its absence; without a mean they
        are about what is declared."""
        i = self.columns[effect]
        G, m = self.G[np.ix_(i, i)], self._mean(effect, mean)
        v = np.broadcast_to(variance, len(i))
        b = self.b[i] - G @ m
        A = G * v + np.eye(len(i))  # (I + G V), whose determinant and inverse are those wanted
        _, logdet = np.linalg.slogdet(A)
        inner = m @ self.b[i] - 0.5 * m @ G @ m
        return float(inner + 0.5 * (b * v) @ np.linalg.solve(A, b) - 0.5 * logdet)

    def own_gains(self) -> dict[str, float]:
        """Return `gain_of` of every effect under its prior."""
        g = np.maximum(np.diag(self.G), 0.0)
        single = 0.5 * self.b**2 / (1.0 + g) - 0.5 * np.log1p(g)
        return {x: float(single[i[0]]) if len(i) == 1 else self.gain_of(x) for x, i in self.columns.items()}

    def given(self, effect: str, mean: Array | float | None = None, variance: Array | float = 1.0) -> KeptEvidence:
        """Integrate an effect out with amplitudes N(mean, variance); without a mean about what is declared."""
        i = self.columns[effect]
        m, v = self._mean(effect, mean), np.broadcast_to(variance, len(i))
        across = self.G[:, i]
        moved = self.b - across @ m
        inverse = v[:, None] * np.linalg.inv(self.G[np.ix_(i, i)] * v + np.eye(len(i)))  # (G + V^-1)^-1
        gain = self.gain + self.gain_of(effect, mean, variance)
        return replace(self, G=self.G - across @ inverse @ across.T, b=moved - across @ inverse @ moved[i], gain=gain)

    def told(self, effect: str) -> tuple[Array, Array]:
        """Return what it says of an effect's amplitudes by itself, without a prior: values and variances (d,)."""
        i = self.columns[effect]
        G = self.G[np.ix_(i, i)]
        inverse = np.linalg.inv(G + SEEN * np.eye(len(i)))
        return inverse @ self.b[i] + self.declared.get(effect, 0.0), np.diag(inverse).copy()

    def told_with_prior(self, effect: str) -> tuple[Array, Array]:
        """Return the same with the prior of a cause of its own, N(0, 1) about what is declared."""
        values, variances = self.told(effect)
        declared, posterior = self.declared.get(effect, 0.0), 1.0 / (1.0 / variances + 1.0)
        return (values / variances + declared) * posterior, posterior


def read_evidence(path: Path, name: str, phantom: str, rig: str) -> KeptEvidence:
    """Read what a diagnosis kept, in its own sigmas; raises one of `UNREADABLE` where it is torn."""
    with np.load(path, allow_pickle=False) as kept:
        effects = kept["effect"].astype(str)
        sigma = kept["sigma"].astype(float)
        parts = (kept["parameter"].astype(str), kept["index"], sigma, kept["transform"].astype(str), kept["neutral"])
        of = kept["of"] if "of" in kept else np.full(len(effects), np.nan)
        rows = zip(*parts, of, strict=True)
        labels = [Label(str(p), int(i), float(s), str(t), float(n), float(o)) for p, i, s, t, n, o in rows]
        G, b = kept["G"] * np.outer(sigma, sigma), kept["b"] * sigma
        shapes = _read_shapes(kept)
    columns = {effect: np.flatnonzero(effects == effect) for effect in dict.fromkeys(effects.tolist())}
    of_effect = {effect: tuple(labels[i] for i in at) for effect, at in columns.items()}
    return KeptEvidence(name, phantom, rig, G, b, columns, of_effect, shapes=shapes)


def _read_shapes(kept: Mapping[str, np.ndarray]) -> dict[str, tuple[KeptShape, ...]]:
    """Read what the amplitudes are the strength of, by effect; nothing of a diagnosis that did not say it."""
    if "shape_effect" not in kept:
        return {}
    out: dict[str, tuple[KeptShape, ...]] = {}
    names = ("effect", "parameter", "index", "value", "transform", "sigma", "width")
    for effect, parameter, index, value, transform, sigma, width in zip(
        *(kept[f"shape_{n}"] for n in names), strict=True
    ):
        apart = min(ALIKE_SIGMAS * float(sigma), ALIKE_WIDTH * float(width))
        shape = KeptShape(str(parameter), int(index), float(value), str(transform), apart)
        out[str(effect)] = (*out.get(str(effect), ()), shape)
    return out


def effect_of(kind: str) -> str:
    """Return the effect's name of a kind of it, see `told_apart`."""
    return kind.partition(KIND)[0]


def told_apart(evidence: Sequence[KeptEvidence]) -> list[KeptEvidence]:
    """Name an effect apart where its amplitudes are of something else than in most recordings: other parameters, or
    another place or time. What is named alike can be put together, and nothing else is."""
    names: list[dict[str, str]] = [{} for _ in evidence]
    for effect in dict.fromkeys(x for e in evidence for x in e.columns):
        have = [k for k, e in enumerate(evidence) if effect in e.columns]
        for number, kind in enumerate(_kinds([evidence[k] for k in have], effect)):
            for i in kind:
                names[have[i]][effect] = effect if number == 0 else f"{effect}{KIND}{number + 1}"
    return [
        replace(
            e,
            columns={name[x]: at for x, at in e.columns.items()},
            labels={name[x]: labels for x, labels in e.labels.items()},
            shapes={name[x]: shapes for x, shapes in e.shapes.items() if x in name},
        )
        for e, name in zip(evidence, names, strict=True)
    ]


def _kinds(evidence: Sequence[KeptEvidence], effect: str) -> list[list[int]]:
    """Sort recordings by what they mean by an effect's amplitudes, the usual meaning first."""
    by_numbers: dict[tuple[object, ...], list[int]] = {}
    for k, e in enumerate(evidence):
        labels, shapes = e.labels[effect], e.shapes.get(effect, ())
        numbers = (
            tuple((x.parameter, x.index, x.transform) for x in labels),
            *((x.parameter, x.index) for x in shapes),
        )
        by_numbers.setdefault(numbers, []).append(k)
    out = []
    for members in by_numbers.values():
        each = [evidence[k].shapes.get(effect, ()) for k in members]
        apart = np.maximum(np.median([[x.apart for x in s] for s in each], axis=0), LEAST)
        out += [[members[i] for i in near] for near in _near(np.array([[x.place for x in s] for s in each]) / apart)]
    return sorted(out, key=lambda kind: (-len(kind), kind[0]))


def _near(places: Array) -> list[list[int]]:
    """Put places (n, d) together that are within one of each other in every number: about that which has most such
    neighbours, then about one of the rest."""
    if not places.shape[1]:
        return [list(range(len(places)))]
    rows, inverse, counts = np.unique(places, axis=0, return_inverse=True, return_counts=True)
    near = [np.array(found) for found in cKDTree(rows).query_ball_point(rows, 1.0, p=np.inf)]
    free, out = np.ones(len(rows), bool), []
    while free.any():
        size = [counts[found[free[found]]].sum() if free[k] else 0 for k, found in enumerate(near)]
        mine = near[int(np.argmax(size))]
        mine = mine[free[mine]]
        free[mine] = False
        out.append(np.flatnonzero(np.isin(inverse.ravel(), mine)).tolist())
    return out


def in_common_units(evidence: Iterable[KeptEvidence]) -> list[KeptEvidence]:
    """Bring all recordings to the widest prior of each amplitude, as experiments state some of them better, and to the
    neutral value that most have, as what is declared may differ, ratios to what most declare; what amplitudes of
    other things are is told apart."""
    all_ = _to_the_same(told_apart(list(evidence)))
    widest: dict[str, Array] = {}
    for effect in dict.fromkeys(x for e in all_ for x in e.labels):
        of_each = [[label.sigma for label in e.labels[effect]] for e in all_ if effect in e.labels]
        widest[effect] = np.max(of_each, axis=0)
    neutral = {effect: _usual_neutral(all_, effect) for effect in widest}
    return [_in_units(e, widest, neutral) for e in all_]


def _to_the_same(evidence: Sequence[KeptEvidence]) -> list[KeptEvidence]:
    """State ratios to what is declared as ratios to what most recordings declare of it; the first of equals."""
    known = Counter((x, k, label.of) for e in evidence for x, own in e.labels.items() for k, label in enumerate(own))
    usual = {(x, k): of for (x, k, of), _ in reversed(known.most_common()) if np.isfinite(of)}
    return [
        replace(
            e,
            labels={
                x: tuple(_ratio_to(label, usual.get((x, k), label.of)) for k, label in enumerate(own))
                for x, own in e.labels.items()
            },
        )
        for e in evidence
    ]


def _ratio_to(label: Label, of: float) -> Label:
    """Return a label as a ratio to ``of`` where it says what it is a ratio to."""
    return label if not np.isfinite(label.of) else replace(label, neutral=label.neutral * label.of / of, of=of)


def _usual_neutral(evidence: Sequence[KeptEvidence], effect: str) -> tuple[float, ...]:
    """Return the neutral values of an effect's amplitudes that most recordings have; the first of equals."""
    found = (tuple(label.neutral for label in e.labels[effect]) for e in evidence if effect in e.labels)
    return Counter(found).most_common(1)[0][0]


def _in_units(e: KeptEvidence, widest: Mapping[str, Array], neutral: Mapping[str, tuple[float, ...]]) -> KeptEvidence:
    scale = np.zeros(len(e.b))
    labels, declared = {}, {}
    for effect, at in e.columns.items():
        scale[at] = widest[effect] / [label.sigma for label in e.labels[effect]]
        values = zip(e.labels[effect], widest[effect].tolist(), neutral[effect], strict=True)
        labels[effect] = tuple(replace(label, sigma=sigma, neutral=at) for label, sigma, at in values)
        pairs = zip(labels[effect], e.labels[effect], strict=True)
        declared[effect] = np.array([label.shift(own) for label, own in pairs])
    G, b = e.G * np.outer(scale, scale), e.b * scale
    return replace(e, G=G, b=b, labels=labels, declared=declared)
