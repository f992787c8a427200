"""All candidates: every effect's parameters in coordinates that suit fitting, and the shapes that are tried at first.

An effect's parameters are mapped to coordinates z: logarithms of ratios and times, the compliance of a spring, plain
values elsewhere. *Amplitudes* are shifted so that z = 0 is the declared model; the other coordinates (places, times,
thicknesses) say what shape the effect has, and a list of their values, ``shapes``, is tried before any is refined.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from livedeform.common.effect import (
    STEP,
    EffectInfo,
    Form,
    Parameter,
    Scale,
    Starts,
    Surroundings,
    Together,
    Usual,
    one_start,
)
from livedeform.common.errors import InputError
from livedeform.common.experiment.schema import did_you_mean
from livedeform.common.types import Array, EffectValues
from livedeform.fem_node.effects import EFFECTS as MECHANICAL
from livedeform.stereo_node.effects import EFFECTS as MEASURING

DIFFERENCE = 1e-4  # of a coordinate, for derivatives of what is made of it
NEARLY_NOTHING = 1e-3  # of what is usual: that the effect is not there
TRANSFORMS: Mapping[Scale, tuple[Callable[[float], float], Callable[[float], float]]] = {
    "linear": (float, float),
    "log": (lambda v: float(np.log(v)), lambda z: float(np.exp(z))),
    "inverse": (lambda v: 1.0 / v, lambda z: 1.0 / z if z != 0.0 else float("inf")),
}
TURNS = 361  # about an ellipse, and amplitudes of which one is looked up


@dataclass(frozen=True)
class Coordinate:
    """One number of a candidate. ``amplitude``: z = 0 switches the effect off. ``sigma``, ``lower``, ``upper`` of z;
    ``centre`` of the prior; ``step`` is a size of z that is small but well above a solver's tolerance; ``edges``: of
    values between which nothing changes, as an onset between two moments (none: it is known better). ``usual``: the
    prior in a fit, if not that."""

    parameter: str
    index: int | None
    transform: Scale
    amplitude: bool
    neutral: float  # in the parameter's unit; NaN unless an amplitude
    centre: float
    sigma: float
    lower: float
    upper: float
    step: float
    edges: tuple[float, ...] = ()
    usual: Usual | None = None

    def value(self, z: float) -> float:
        forward, back = TRANSFORMS[self.transform]
        return back(z + forward(self.neutral)) if self.amplitude else back(z)

    def z(self, value: float) -> float:
        forward, _ = TRANSFORMS[self.transform]
        return forward(value) - (forward(self.neutral) if self.amplitude else 0.0)

    def beside(self, z: float, by: float) -> float:
        """Return what ``z`` is moved by for a difference: ``by``, or as much down where that is beyond the bound."""
        return by if z + by <= self.upper else -by

    def from_usual(self, z: float) -> tuple[float, float] | None:
        """Return how far ``z`` is from what is `usual`, in sigmas, and the derivative of that; None where there is no
        such prior, and where next to nothing is there, which has no logarithm to speak of."""
        if self.usual is None:
            return None
        steps = (-DIFFERENCE, 0.0, DIFFERENCE)
        low, at, high = (self.usual.of(self.value(z + step)) / self.usual.centre for step in steps)
        if min(low, high) <= NEARLY_NOTHING:
            return None
        return float(np.log(at)) / self.usual.sigma, float(np.log(high / low)) / (2.0 * DIFFERENCE * self.usual.sigma)

    def slope(self, z: float) -> float:
        """Return d value / d z."""
        value = self.value(z)
        return {"linear": 1.0, "log": value, "inverse": -(value**2)}[self.transform]


@dataclass(frozen=True)
class Candidate:
    """An effect ready to be fitted: ``shapes`` (s, p) starting coordinates, the amplitudes among them at ``kick``
    where columns cannot be had at zero; ``tangent``: columns at z = 0 exist, so that a linear screening makes sense;
    ``stated`` (p,): sigmas that the experiment states of the declared values, infinite where it does not; ``wide``: the
    candidate without these (None: there are none); ``form``: how it is numbered, if not by the effect's own parameters;
    ``forms``: the same effect numbered otherwise. ``undeclared``: of what differs from a declared effect, that effect
    with coordinates that count from where it is off (None: it is not declared)."""

    info: EffectInfo
    coordinates: tuple[Coordinate, ...]
    shapes: Array
    tangent: bool
    kick: Array
    stated: Array
    wide: Candidate | None = None
    form: Form | None = None
    forms: tuple[Candidate, ...] = ()
    undeclared: Candidate | None = None

    @property
    def name(self) -> str:
        return self.info.name

    @property
    def measuring(self) -> bool:
        return self.info.acts_on == "measuring"

    @property
    def beginning(self) -> Array:
        """Return coordinates (p,) of the values that the parameters start at, with the effect on."""
        starts = {p.name: np.atleast_1d(np.asarray(p.start, float)) for p in self.parameters}
        return np.array([c.z(float(starts[c.parameter][c.index or 0])) for c in self.coordinates])

    @property
    def amplitudes(self) -> np.ndarray:
        """Columns of ``shapes`` that are amplitudes."""
        return np.flatnonzero([c.amplitude for c in self.coordinates])

    @property
    def strengths(self) -> np.ndarray:
        """Columns of ``shapes`` that say how much of it there is: its amplitudes, as they are where nothing is declared
        of it."""
        whole = self if self.undeclared is None else self.undeclared
        return whole.amplitudes if len(whole.amplitudes) else self.amplitudes

    @property
    def declared(self) -> EffectValues | None:
        """The declared effect that it differs from; None if nothing is declared of it."""
        return None if self.undeclared is None else self.values(self.shapes[0])

    def off(self, z: Array) -> Array:
        """Return the coordinates ``z`` (p,) as they count from where the effect is off, whatever is declared of it."""
        return z if self.undeclared is None else self.undeclared.coordinates_of(self.values(z).values)

    def array(self, attribute: str) -> Array:
        return np.array([getattr(c, attribute) for c in self.coordinates], float)

    def values(self, z: Array) -> EffectValues:
        """Return the effect at coordinates ``z`` (p,), as an experiment holds it."""
        out: dict[str, Array] = {}
        for parameter in self.parameters:
            mine = [(c, v) for c, v in zip(self.coordinates, z, strict=True) if c.parameter == parameter.name]
            numbers = np.array([c.value(float(v)) for c, v in mine])
            out[parameter.name] = numbers if parameter.size is not None else numbers[0]
        if self.form is not None:
            out = self.form.expand(out)
        return EffectValues(self.name, {k: np.asarray(v) for k, v in out.items()})

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Return what the coordinates are of: the effect's parameters, or those of its form."""
        return self.info.parameters if self.form is None else self.form.parameters

    def parameter(self, name: str) -> Parameter:
        """Return the parameter of that name."""
        return next(p for p in self.parameters if p.name == name)

    def sigmas(self, z: Array, covariance: Array) -> dict[str, Array]:
        """Return one sigma of each parameter by the delta method; a vector parameter has a vector."""
        if self.form is not None:
            return self._sigmas_of_form(z, covariance)
        sigma = np.sqrt(np.diag(covariance))
        for i, c in enumerate(self.coordinates):
            if c.edges:
                after = int(np.clip(np.searchsorted(c.edges, z[i]), 1, len(c.edges) - 1))
                sigma[i] = (c.edges[after] - c.edges[after - 1]) / np.sqrt(12.0)  # of anywhere between two moments
        out: dict[str, Array] = {}
        for parameter in self.info.parameters:
            mine = [i for i, c in enumerate(self.coordinates) if c.parameter == parameter.name]
            numbers = np.array([abs(self.coordinates[i].slope(float(z[i]))) * sigma[i] for i in mine])
            out[parameter.name] = numbers if parameter.size is not None else numbers[0]
        return {k: np.asarray(v) for k, v in out.items()}

    @property
    def together(self) -> Together | None:
        """Return what a length and the amplitude make together, where these are the coordinates."""
        return self.info.together if self.form is None else None

    def carried(self, before: Array, after: Array) -> tuple[Array, Array]:
        """Return the step (p,) with which derivatives at the coordinates ``before`` carry a number to those ``after``,
        and the matrix (p, p) that turns these derivatives into those there.

        A number that follows what a length and the amplitude make `together` is not linear in the coordinates: along a
        line of balls that look alike from afar it stays as it is. It is taken as linear in that and the others.
        """
        i = int(self.amplitudes[0])
        slope, new = (self.slope_of_together(z) for z in (before, after))
        step, turn = after - before, np.eye(len(before))
        made = self.made_together(after) - self.made_together(before)
        step[i] = (made - np.delete(slope, i) @ np.delete(step, i)) / slope[i]
        turn[i] = (new - np.where(np.arange(len(new)) == i, 0.0, slope)) / slope[i]
        return step, turn

    def made_together(self, z: Array) -> float:
        """Return what the effect's values make `together` at coordinates ``z`` (p,)."""
        assert self.together is not None  # the caller's
        return float(self.together.of(self.values(z).values))

    def slope_of_together(self, z: Array) -> Array:
        """Return the derivative (p,) of what the values make `together`."""
        h = DIFFERENCE * np.eye(len(z))
        return np.array([self.made_together(z + d) - self.made_together(z - d) for d in h]) / (2.0 * DIFFERENCE)

    def intervals(self, z: Array, covariance: Array, sigmas: float) -> dict[str, Array]:
        """Return the interval of each parameter, its two ends in a last axis: by so many ``sigmas`` to either side in
        the coordinates, in which it is even, and within the bounds. An amplitude that is known less well than what it
        makes `together` with a length goes with that. Of a form's numbers those that are the effect's own."""
        ends = []
        for i, c in enumerate(self.coordinates):
            both = z[i] + sigmas * np.sqrt(covariance[i, i]) * np.array([-1.0, 1.0])
            if self.together is not None and c.amplitude and z[i] != 0.0:
                both = self._ends_of_amplitude(self.together, z, covariance, sigmas)
            both = np.clip(both, c.lower, c.upper)
            if c.edges:
                after = int(np.clip(np.searchsorted(c.edges, z[i]), 1, len(c.edges) - 1))
                both = np.array([c.edges[after - 1], c.edges[after]])
            ends.append(sorted(c.value(float(end)) for end in both))
        out: dict[str, Array] = {}
        own = {p.name for p in (*self.info.parameters, *self.info.optional)}
        for parameter in (p for p in self.parameters if p.name in own):
            mine = [ends[i] for i, c in enumerate(self.coordinates) if c.parameter == parameter.name]
            out[parameter.name] = np.array(mine if parameter.size is not None else mine[0])
        return out

    def _ends_of_amplitude(self, together: Together, z: Array, covariance: Array, sigmas: float) -> Array:
        """Return the least and the largest amplitude (2,) in the ellipse of its length, and of what it makes with that.

        It is even where the logarithms of both are coordinates (what is there is there with one sign), so that its edge
        is where twice the log likelihood falls by the square of ``sigmas``.
        """
        i = int(self.amplitudes[0])
        k = next(k for k, c in enumerate(self.coordinates) if c.index is None and not c.amplitude)
        amplitude, length = self.coordinates[i], self.coordinates[k]
        G = np.eye(len(z))
        G[i] = self.slope_of_together(z)
        own = (G @ covariance @ G.T)[np.ix_([k, i], [k, i])]
        turns = np.linspace(0.0, 2.0 * np.pi, TURNS)
        edge = sigmas * np.linalg.cholesky(own) @ np.stack([np.cos(turns), np.sin(turns)])
        lengths = np.clip(z[k] + edge[0], length.lower, length.upper)
        amplitudes = np.linspace(amplitude.lower, amplitude.upper, TURNS)
        values = {length.parameter: np.array([[length.value(float(at))] for at in lengths])}
        values |= {amplitude.parameter: np.array([amplitude.value(float(at)) for at in amplitudes])}
        size = self.made_together(z)
        with np.errstate(over="ignore"):  # of what is hardly there anything is possible
            wanted = size * np.exp(edge[1] / size)
        found = [np.interp(w, made, amplitudes) for w, made in zip(wanted, together.of(values), strict=True)]
        return np.array([min(found), max(found)])

    def _sigmas_of_form(self, z: Array, covariance: Array) -> dict[str, Array]:
        """Return the same of what the form makes of its numbers; nothing for parameters that do not depend on them."""
        at, out = self.values(z).values, {}
        moved = [self.values(z + DIFFERENCE * unit).values for unit in np.eye(len(z))]
        for name, values in at.items():
            J = np.array([(m[name] - values) / DIFFERENCE for m in moved])
            variances = np.einsum("p...,pq,q...->...", J, covariance, J)
            if np.all(variances > 0.0):
                out[name] = np.asarray(np.sqrt(variances))
        return out

    def coordinates_of(self, values: Mapping[str, Array]) -> Array:
        """Return z (p,) of given values."""
        z = []
        for c in self.coordinates:
            value = np.atleast_1d(values[c.parameter])[c.index or 0]
            z.append(c.z(float(value)))
        return np.array(z)


def catalogue(
    around: Surroundings, names: Iterable[str] | None = None, declared: Sequence[EffectValues] = ()
) -> dict[str, Candidate]:
    """Return the candidates that the experiment can have; with ``names``, those only (``InputError`` for unknown
    ones). One that is ``declared`` is the difference from that, if it can be (`that_may_differ`)."""
    infos, there = all_effects(), {effect.name for effect in declared}
    may_differ = that_may_differ(declared)
    wanted = list(infos) if names is None else check_known(names)
    built = {name: _candidate(infos[name], around) for name in wanted if name not in there}
    built |= {name: _differing(infos[name], may_differ[name], around) for name in wanted if name in may_differ}
    return {name: candidate for name in wanted if (candidate := built.get(name)) is not None}


def that_may_differ(declared: Sequence[EffectValues]) -> dict[str, EffectValues]:
    """Return the declared effects, by name, of which other values can be tried: those that are there once, with numbers
    that the search has."""
    count = Counter(effect.name for effect in declared)
    return {e.name: e for e in declared if count[e.name] == 1 and _numbers_of(all_effects()[e.name], e.values)}


def that_stay(declared: Sequence[EffectValues]) -> list[str]:
    """Name the declared effects of which no other values can be tried."""
    may_differ = that_may_differ(declared)
    return [name for name in dict.fromkeys(effect.name for effect in declared) if name not in may_differ]


def _numbers_of(info: EffectInfo, values: Mapping[str, Array]) -> tuple[Parameter, ...]:
    """Return the parameters, of the card or of one of its forms, of which each number of an effect's ``values`` is a
    coordinate's; nothing where none are."""
    for parameters in (info.parameters, *(form.parameters for form in info.forms)):
        sizes = {p.name: 1 if p.size in (None, -1) else p.size for p in parameters}
        if sizes == {name: np.size(value) for name, value in values.items()}:
            there = all(p.scale == "linear" or bool(np.all(values[p.name])) for p in parameters)
            return parameters if there else ()
    return ()


def check_known(names: Iterable[str]) -> list[str]:
    """Return the names; ``InputError`` for one that no effect has."""
    out, known = list(names), list(all_effects())
    for name in out:
        if name not in known:
            hint = did_you_mean(name, known)
            raise InputError(f"unknown effect '{name}'", where="--candidates", remedy=hint)
    return out


def all_effects() -> dict[str, EffectInfo]:
    """Return the cards of both registries."""
    return {name: module.INFO for name, module in (*MECHANICAL.items(), *MEASURING.items())}


def _candidate(info: EffectInfo, around: Surroundings) -> Candidate | None:
    """Make the candidate of a card; None where the experiment lacks the thing that the effect acts on."""
    if (info.acts_on == "probe" and not around.has_probe) or not info.possible(around):
        return None
    return replace(_numbered(info, around), forms=tuple(_numbered(info, around, form) for form in info.forms))


def _numbered(info: EffectInfo, around: Surroundings, form: Form | None = None) -> Candidate:
    """Make the candidate of a card as its own parameters number it, or a form."""
    parameters, starts = (info.parameters, info.starts) if form is None else (form.parameters, form.starts)
    parts = [(p, c) for p in parameters for c in _coordinates(info, p, around)]
    coordinates = tuple(c for _, c in parts)
    kick = np.array([_kick(p, around) if c.amplitude else 0.0 for p, c in parts])
    stated = np.full(len(coordinates), np.inf)
    return Candidate(info, coordinates, _shapes(starts, coordinates, around), info.tangent, kick, stated, form=form)


def _differing(info: EffectInfo, declared: EffectValues, around: Surroundings) -> Candidate:
    """Make the candidate of what differs from a ``declared`` effect."""
    numbers = _numbers_of(info, declared.values)
    undeclared = replace(info, parameters=numbers, starts=one_start, forms=())
    without = replace(around, physics=around.physics if around.bare is None else around.bare)
    return replace(_numbered(_about(undeclared, declared), around), undeclared=_numbered(undeclared, without))


def _about(info: EffectInfo, declared: EffectValues) -> EffectInfo:
    """Return the card of what differs from a ``declared`` effect, which is there: every number counts from its declared
    value, but for a moment between those of the recordings, which stays."""
    parameters = []
    for p in info.parameters:
        values = np.atleast_1d(np.asarray(declared.values[p.name], float))
        start = float(values[0]) if p.size is None else tuple(values.tolist())
        neutral = None if p.between_moments else start
        parameters.append(replace(p, start=start, neutral=neutral, kick=0.0, usual=None))
    return replace(
        info,
        parameters=tuple(parameters),
        tangent=True,
        switched=False,
        together=None,
        proved=(0, 0),
    )


def _kick(parameter: Parameter, around: Surroundings) -> float:
    return parameter.kick(around) if callable(parameter.kick) else parameter.kick


def _coordinates(info: EffectInfo, parameter: Parameter, around: Surroundings) -> list[Coordinate]:
    """Map each number of a parameter to a coordinate."""
    neutral = _neutral(info, parameter, around)
    amplitude = neutral is not None
    forward = TRANSFORMS[parameter.scale][0]
    count = 1 if parameter.size in (None, -1) else int(parameter.size)
    starts = np.broadcast_to(np.asarray(parameter.start, float), (count,))
    off = np.broadcast_to(np.asarray(np.nan if neutral is None else neutral, float), (count,))
    shift = [forward(float(v)) if amplitude else 0.0 for v in off]
    ends = [sorted(_end(forward, v) - shift[i] for v in _bounds(parameter, i, around)) for i in range(count)]
    return [
        Coordinate(
            parameter=parameter.name,
            index=i if parameter.size is not None else None,
            transform=parameter.scale,
            amplitude=amplitude,
            neutral=float(off[i]),
            centre=0.0 if amplitude else forward(float(starts[i])),
            sigma=parameter.sigma,
            lower=min(ends[i][0], 0.0) if amplitude else ends[i][0],
            upper=max(ends[i][1], 0.0) if amplitude else ends[i][1],
            step=STEP * parameter.sigma if parameter.step is None else parameter.step,
            edges=tuple(around.times.tolist()) if parameter.between_moments else (),
            usual=parameter.usual,
        )
        for i in range(count)
    ]


def _bounds(parameter: Parameter, i: int, around: Surroundings) -> tuple[float, float]:
    """Return the bounds of a parameter's number ``i``, in its unit."""
    if parameter.in_body:
        return float(around.lower[i]), float(around.upper[i])
    return parameter.lower, parameter.upper


def _end(forward: Callable[[float], float], value: float) -> float:
    """Return a bound in coordinates; the logarithm of zero is a very small number."""
    return forward(max(value, 1e-6)) if forward is TRANSFORMS["log"][0] else forward(value)


def _neutral(info: EffectInfo, parameter: Parameter, around: Surroundings) -> float | tuple[float, ...] | None:
    """Return the value at which the parameter switches its effect off: the card's, or what the model declares."""
    if parameter.neutral is not None:
        return parameter.neutral
    module = MECHANICAL.get(info.name)
    if module is not None and hasattr(module, "declared"):
        return float(module.declared(around.physics)[parameter.name])
    return None


def _shapes(card_starts: Starts, coordinates: tuple[Coordinate, ...], around: Surroundings) -> Array:
    """Return starting coordinates (s, p) of the card's starts: amplitudes at zero."""
    starts = card_starts(around)
    out = np.tile([0.0 if c.amplitude else c.centre for c in coordinates], (len(starts), 1))
    for row, start in zip(out, starts, strict=True):
        for i, c in enumerate(coordinates):
            if c.parameter in start:
                row[i] = c.z(float(np.atleast_1d(start[c.parameter])[c.index or 0]))
    return out


def with_start(candidate: Candidate, shape: int, theta: Array) -> Array:
    """Return coordinates (p,) of shape number ``shape`` with its amplitudes at ``theta``."""
    z = np.array(candidate.shapes[shape])
    z[candidate.amplitudes] = theta
    return z


def narrowed(candidate: Candidate, sigma: Mapping[str, float], more: float) -> Candidate:
    """Return the candidate with the sigmas that an experiment states, in the parameters' coordinates, as its prior's;
    of the usual one a share ``more`` is added, see `doubt`."""
    coordinates = tuple(
        replace(c, sigma=float(np.hypot(sigma[c.parameter], more * c.sigma))) if c.parameter in sigma else c
        for c in candidate.coordinates
    )
    stated = [sigma.get(c.parameter, np.inf) if c.amplitude else np.inf for c in coordinates]
    return replace(candidate, coordinates=coordinates, stated=np.array(stated), wide=candidate)


def unhindered(candidate: Candidate, z: Array, most: float) -> Candidate:
    """Return the candidate with priors that do not hold its value ``z`` (p,) back: the usual ones where the data have
    rejected what is stated (a `doubt` of ``most``), and of a size beyond what is usual one as wide as it is.

    A prior of sigma draws an estimate that the data know to s by (s / sigma)^2 of itself towards nothing.
    """
    rejected = doubt(z, candidate.stated, np.inf) >= most
    wide = candidate.wide if rejected and candidate.wide is not None else candidate
    free = ~np.isfinite(candidate.stated) | rejected
    coordinates = tuple(
        replace(c, sigma=abs(float(at))) if c.amplitude and c.usual is None and one and abs(at) > c.sigma else c
        for c, at, one in zip(wide.coordinates, z, free, strict=True)
    )
    return replace(candidate, coordinates=coordinates)


def doubt(theta: Array, stated: Array, most: float) -> float:
    """Return what it costs, in twice the log of odds, to say that ``stated`` sigmas (p,) are exceeded by ``theta``
    (p,): a data sheet can be wrong by more than it says, so ``most`` at most, but of two explanations the one that it
    allows is preferred."""
    return float(min(np.sum((theta / stated) ** 2), most))
