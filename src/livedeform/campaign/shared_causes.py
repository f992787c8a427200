"""Causes that recordings share, and those of their own, in one fit over what their diagnoses kept.

Each recording i has causes of its own, x ~ N(0, 1) in sigmas, and may belong to shared ones, x_i ~ N(a, tau^2): the
value a and the scatter tau between takes are the same for all members, and who is a member is found (a rig's camera is
knocked on a Tuesday). Given these, recordings are independent and everything integrates out in closed form; so the fit
goes to and fro between the best explanation of each recording (`explain`) and the shared values, as in random-effects
meta-analysis (DerSimonian and Laird 1986). A shared cause is kept where the evidence of all recordings together, with
what choosing it costs, is better with it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import lgamma, log

import numpy as np
from scipy.special import ndtr

from livedeform.campaign.evidence import KeptEvidence
from livedeform.common.types import Array

GRID, FAR = 100, 20.0  # values of a scatter that are gone through, and the largest in widths of its prior


@dataclass(frozen=True)
class PoolingSettings:
    """``own``: expected number of own causes of a recording; ``scatter``: the least scatter between takes, as a share
    of a shared value (what linearised models and elements get wrong of it); ``gain``: log odds by which a shared cause
    must better the evidence; ``tries``: values that are tried for one; ``rounds`` to and fro; ``most`` causes per
    recording; ``least`` members."""

    own: float = 0.5
    scatter: float = 0.05
    gain: float = 3.0
    tries: int = 5
    rounds: int = 2
    most: int = 4
    least: int = 2


@dataclass(frozen=True)
class Scope:
    """Recordings that may share a cause: ``where``, in words, their ``names``, and which ``effects``."""

    where: str
    names: frozenset[str]
    effects: frozenset[str]


@dataclass(frozen=True)
class Shared:
    """A shared cause: an ``effect`` of the recordings in ``scope`` (their names), at ``value`` (d,) with variance
    ``variance`` (d,) and ``scatter`` (d,) between takes, all in sigmas; ``unsure`` (d,): that variance whatever the
    scatter, which few takes hardly tell, and ``ahead`` (d,): how far another take lies with 95 %; ``share`` of them
    that are ``members``; ``gain`` in log evidence."""

    where: str
    effect: str
    scope: frozenset[str]
    value: Array
    variance: Array
    scatter: Array
    unsure: Array
    ahead: Array
    share: float
    members: tuple[str, ...] = ()
    gain: float = 0.0

    @property
    def spread(self) -> Array:
        """Variance (d,) of a member's value."""
        return np.asarray(self.scatter**2)


@dataclass(frozen=True)
class Causes:
    """The causes of one recording: effects of its ``own``, numbers of the shared ones it ``belongs`` to; ``score`` in
    log odds; ``rest``: its evidence with all of them integrated out."""

    own: tuple[str, ...]
    belongs: tuple[int, ...]
    score: float
    rest: KeptEvidence


def explain(e: KeptEvidence, shared: Sequence[Shared], settings: PoolingSettings) -> Causes:
    """Find the causes of a recording: one after another while they earn themselves, from several starts, and none that
    the others make needless."""
    cost = own_cost(e, settings)
    starts: list[tuple[tuple[str, ...], tuple[int, ...]]] = [((), ())]
    starts += [((), (k,)) for k, s in enumerate(shared) if _applies(s, e)]
    gains = e.own_gains()
    single = sorted(gains, key=lambda effect: -gains[effect])[:2]
    starts += [((effect,), ()) for effect in single]
    found = [_grown(e, start, shared, cost, settings) for start in starts]
    best = max(found, key=lambda x: x.score)
    return _pruned(e, best, shared, cost)


def own_cost(e: KeptEvidence, settings: PoolingSettings) -> float:
    """Log odds against one effect being a cause of its own."""
    p = settings.own / len(e.columns)
    return log((1.0 - p) / p)


def _applies(s: Shared, e: KeptEvidence) -> bool:
    return e.name in s.scope and s.effect in e.columns


def _explained(
    e: KeptEvidence, own: Sequence[str], belongs: Sequence[int], shared: Sequence[Shared], cost: float
) -> Causes:
    rest, score = e, -cost * len(own)
    for effect in own:
        rest = rest.given(effect)
    for k, s in enumerate(shared):
        if not _applies(s, e):
            continue
        score += log(s.share if k in belongs else 1.0 - s.share)
        if k in belongs:
            rest = rest.given(s.effect, s.value, s.spread)
    return Causes(tuple(own), tuple(belongs), score + rest.gain, rest)


def _grown(
    e: KeptEvidence,
    start: tuple[tuple[str, ...], tuple[int, ...]],
    shared: Sequence[Shared],
    cost: float,
    settings: PoolingSettings,
) -> Causes:
    """Add causes while the best of them betters the score."""
    now = _explained(e, *start, shared, cost)
    while len(now.own) + len(now.belongs) < settings.most:
        taken = {*now.own, *(shared[k].effect for k in now.belongs)}
        gains: dict[str | int, float] = {x: g - cost for x, g in now.rest.own_gains().items() if x not in taken}
        for k, s in enumerate(shared):
            if _applies(s, e) and s.effect not in taken:
                gains[k] = now.rest.gain_of(s.effect, s.value, s.spread) + log(s.share / (1.0 - s.share))
        best = max(gains, key=lambda x: gains[x], default=None)
        if best is None or gains[best] <= 0.0:
            break
        own = (*now.own, best) if isinstance(best, str) else now.own
        belongs = (*now.belongs, best) if isinstance(best, int) else now.belongs
        now = _explained(e, own, belongs, shared, cost)
    return now


def _pruned(e: KeptEvidence, found: Causes, shared: Sequence[Shared], cost: float) -> Causes:
    """Take out, or put a shared cause in the place of, what the others make needless."""
    while True:
        without = [(tuple(x for x in found.own if x != effect), found.belongs) for effect in found.own]
        without += [(found.own, tuple(k for k in found.belongs if k != j)) for j in found.belongs]
        taken = {shared[k].effect for k in found.belongs}
        for k, s in enumerate(shared):
            if _applies(s, e) and s.effect not in taken:
                without += [
                    (tuple(x for x in found.own if x not in (effect, s.effect)), (*found.belongs, k))
                    for effect in found.own
                ]
        others = [_explained(e, *w, shared, cost) for w in without]
        best = max(others, key=lambda x: x.score, default=found)
        if best.score <= found.score:
            return found
        found = best


@dataclass(frozen=True)
class Pooled:
    """The result: ``shared`` causes, in the order in which explanations number them, and each recording's explanation
    by its name."""

    shared: tuple[Shared, ...]
    explanations: Mapping[str, Causes]

    @property
    def named(self) -> list[Shared]:
        """The shared causes that still have members: later ones may have made one needless."""
        return [s for s in self.shared if s.members]


def pool(evidence: Sequence[KeptEvidence], scopes: Sequence[Scope], settings: PoolingSettings | None = None) -> Pooled:
    """Fit all recordings together; ``scopes``: what may share a cause, rigs first, then phantoms."""
    settings = settings or PoolingSettings()
    shared: list[Shared] = []
    now = {e.name: explain(e, (), settings) for e in evidence}
    for scope in scopes:
        inside = [e for e in evidence if e.name in scope.names]
        if len(inside) < settings.least:
            continue
        while (better := _one_more(scope, inside, shared, now, settings)) is not None:
            shared, changed = _where_it_belongs(better, scope, scopes, evidence, shared, now, settings)
            now = now | changed
    members = [tuple(name for name, x in now.items() if k in x.belongs) for k in range(len(shared))]
    return Pooled(tuple(replace(s, members=m) for s, m in zip(shared, members, strict=True)), now)


def _where_it_belongs(
    better: tuple[list[Shared], dict[str, Causes]],
    scope: Scope,
    scopes: Sequence[Scope],
    evidence: Sequence[KeptEvidence],
    shared: Sequence[Shared],
    now: Mapping[str, Causes],
    settings: PoolingSettings,
) -> tuple[list[Shared], dict[str, Causes]]:
    """Give a cause whose members all lie in a narrower scope to that: what only one phantom's takes have is the
    phantom's, though a rig saw them."""
    causes, found = better
    members = {name for name, x in found.items() if len(shared) in x.belongs}
    for other in scopes:
        if members <= other.names < scope.names and causes[-1].effect in other.effects:
            own = replace(other, effects=frozenset({causes[-1].effect}))
            inside = [e for e in evidence if e.name in other.names]
            return _one_more(own, inside, shared, now, settings) or better
    return better


def _one_more(
    scope: Scope,
    inside: Sequence[KeptEvidence],
    shared: Sequence[Shared],
    now: Mapping[str, Causes],
    settings: PoolingSettings,
) -> tuple[list[Shared], dict[str, Causes]] | None:
    """Find the shared cause that betters the evidence most; None where none earns itself."""
    mine = [k for k, s in enumerate(shared) if s.where == scope.where]
    effects = sorted(scope.effects - {shared[k].effect for k in mine})
    proposals = [_proposed(scope.where, x, inside, now, shared, settings) for x in effects]
    before = sum(now[e.name].score for e in inside)
    for proposal in sorted((p for p in proposals if p is not None), key=lambda p: -p.gain)[:2]:
        tried = [*shared, proposal]
        found = {e.name: explain(e, tried, settings) for e in inside}
        for _ in range(settings.rounds):
            for k in (*mine, len(shared)):
                tried[k] = _refined(k, inside, found, tried, settings)
            found = {e.name: explain(e, tried, settings) for e in inside}
        n_members = sum(len(shared) in x.belongs for x in found.values())
        gain = sum(x.score for x in found.values()) - before - _price(tried[-1], len(effects))
        if gain > settings.gain and n_members >= settings.least:
            return [*tried[:-1], replace(tried[-1], gain=gain)], found
    return None


def _price(s: Shared, n_effects: int) -> float:
    """Return the cost of a shared cause: one effect of so many, at one value out of its prior's width (Laplace)."""
    width = 0.5 * np.sum(s.value**2 - np.log(np.minimum(s.variance, 1.0)))
    return float(width + log(n_effects) + 0.5 * log(len(s.scope) + 1.0))


def _proposed(
    where: str,
    effect: str,
    inside: Sequence[KeptEvidence],
    now: Mapping[str, Causes],
    shared: Sequence[Shared],
    settings: PoolingSettings,
) -> Shared | None:
    """Try the values that single recordings tell of an effect, and take the one that most of them go with."""
    bases = {e.name: _bases(e, now[e.name], effect, shared, settings) for e in inside if effect in e.columns}
    told = [(b[0][0].gain_of(effect), b[0][0].told(effect)) for b in bases.values()]
    told = sorted((t for t in told if t[0] > 0.0), key=lambda t: -t[0])
    if len(told) < settings.least:
        return None
    picks = np.unique(np.linspace(0, len(told) - 1, settings.tries).astype(int))
    best: Shared | None = None
    for value, variance in (told[i][1] for i in picks):
        scatter = np.maximum(settings.scatter * np.abs(value), np.sqrt(variance) * 0.5)
        gains = np.array([_gain_at(bases[n], now[n].score, effect, value, scatter) for n in bases])
        n, m = len(gains), int((gains > 0.0).sum())
        total = gains[gains > 0.0].sum() - _choosing(n, m)
        if m >= settings.least and (best is None or total > best.gain):
            share = float(np.clip((m + 1.0) / (n + 2.0), 0.02, 0.98))
            mean, found = variance / m, float(total)
            best = Shared(where, effect, frozenset(bases), value, mean, scatter, mean, 2.0 * scatter, share, gain=found)
    return best if best is not None and best.gain > 0.0 else None


def _choosing(n: int, m: int) -> float:
    """Minus the log probability of just these ``m`` members out of ``n``, whatever their share."""
    return log(n + 1.0) + lgamma(n + 1.0) - lgamma(m + 1.0) - lgamma(n - m + 1.0)


def _bases(
    e: KeptEvidence, now: Causes, effect: str, shared: Sequence[Shared], settings: PoolingSettings
) -> list[tuple[KeptEvidence, float]]:
    """Return what an effect may come on top of: the shared causes that the recording belongs to, with all of its own,
    each single one, or none of them; each with its score."""
    cost = own_cost(e, settings)
    others = [x for x in now.own if x != effect]
    belongs = [k for k in now.belongs if shared[k].effect != effect]
    choices = {(), tuple(others), *((x,) for x in others)}
    found = [_explained(e, own, belongs, shared, cost) for own in sorted(choices, key=len, reverse=True)]
    return [(x.rest, x.score) for x in found]


def _gain_at(
    bases: Sequence[tuple[KeptEvidence, float]], now: float, effect: str, value: Array, scatter: Array
) -> float:
    return max(score + rest.gain_of(effect, value, scatter**2) for rest, score in bases) - now


def _refined(
    number: int,
    inside: Sequence[KeptEvidence],
    found: Mapping[str, Causes],
    shared: Sequence[Shared],
    settings: PoolingSettings,
) -> Shared:
    """Take a shared cause's value, scatter and share anew from the members."""
    s = shared[number]
    members = [e for e in inside if number in found[e.name].belongs]
    n = sum(_applies(s, e) for e in inside)
    share = float(np.clip((len(members) + 1.0) / (n + 2.0), 0.02, 0.98))
    if not members:
        return replace(s, share=share)
    told = [_told_beside(e, found[e.name], number, shared) for e in members]
    values, variances = (np.array([t[i] for t in told]) for i in (0, 1))
    value, variance, scatter = random_effects(values, variances, settings.scatter)
    all_scatters = Scatters.of(values, variances, value, settings.scatter)
    unsure, ahead = all_scatters.variance_about(value), all_scatters.next_within(value)
    return replace(s, value=value, variance=variance, scatter=scatter, unsure=unsure, ahead=ahead, share=share)


def _told_beside(e: KeptEvidence, x: Causes, number: int, shared: Sequence[Shared]) -> tuple[Array, Array]:
    """Return what a member says of a shared cause, beside the others that it has."""
    rest = e
    for effect in x.own:
        rest = rest.given(effect)
    for k in x.belongs:
        if k != number:
            rest = rest.given(shared[k].effect, shared[k].value, shared[k].spread)
    return rest.told(shared[number].effect)


def random_effects(values: Array, variances: Array, least: float) -> tuple[Array, Array, Array]:
    """Pool values (m, d) with variances: the common value (d,), its variance with the scatter in it, and the scatter
    between takes, at least the share ``least`` of the value (DerSimonian and Laird 1986)."""
    w = 1.0 / variances
    mean = (w * values).sum(axis=0) / w.sum(axis=0)
    q = (w * (values - mean) ** 2).sum(axis=0)
    free = w.sum(axis=0) - (w**2).sum(axis=0) / w.sum(axis=0)
    extra = (q - (len(values) - 1.0)) / np.maximum(free, np.finfo(float).tiny)
    scatter2 = np.maximum(np.where(free > 0.0, extra, 0.0), (least * mean) ** 2)
    w = 1.0 / (variances + scatter2)
    total = w.sum(axis=0)
    return (w * values).sum(axis=0) / total, 1.0 / total, np.sqrt(scatter2)


@dataclass(frozen=True)
class Scatters:
    """All scatters between takes that values allow, ``tau2`` (g, d) variances with probability ``p`` (g, d), and by
    each the common value ``mean`` (g, d) and its ``variance`` (g, d).

    Each counts by its likelihood, times a half-Cauchy prior (Gelman 2006) that is as wide as a single take's sigma and
    the share ``least`` of the value together.
    """

    tau2: Array
    p: Array
    mean: Array
    variance: Array

    @classmethod
    def of(cls, values: Array, variances: Array, value: Array, least: float) -> Scatters:
        """Weigh them by ``values`` (m, d) with variances; ``value`` (d,) is that of `random_effects`."""
        floor = least * np.abs(value)
        wide = np.sqrt(np.median(variances, axis=0)) + floor
        steps = np.linspace(0.0, 1.0, GRID) ** 2 * FAR
        tau2 = floor**2 + (steps[:, None] * wide) ** 2
        w = 1.0 / (variances + tau2[:, None])
        total = w.sum(axis=1)
        mean = (w * values).sum(axis=1) / total
        likelihood = np.log(w).sum(axis=1) - np.log(total) - (w * (values - mean[:, None]) ** 2).sum(axis=1)
        log_p = 0.5 * likelihood - np.log1p(steps**2)[:, None]
        p = np.exp(log_p - log_p.max(axis=0)) * np.gradient(steps)[:, None]
        return cls(tau2, p / p.sum(axis=0), mean, 1.0 / total)

    def variance_about(self, value: Array) -> Array:
        """Return the variance (d,) of the common value about ``value`` (d,), whatever the scatter."""
        return np.asarray((self.p * (self.variance + (self.mean - value) ** 2)).sum(axis=0))

    def next_within(self, value: Array) -> Array:
        """Return how far (d,) about ``value`` (d,) another take lies with 95 %, whatever the scatter."""
        sigma, off = np.sqrt(self.tau2 + self.variance), self.mean - value
        low, high = np.zeros(len(value)), np.max(np.abs(off) + 5.0 * sigma, axis=0)
        for _ in range(60):
            half = 0.5 * (low + high)
            inside = (self.p * (ndtr((half - off) / sigma) - ndtr((-half - off) / sigma))).sum(axis=0)
            low, high = np.where(inside < 0.95, half, low), np.where(inside < 0.95, high, half)
        return np.asarray(high)
