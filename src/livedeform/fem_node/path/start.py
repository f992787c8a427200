"""Warm starts of a solution: the nearer it starts, the fewer iterations it takes.

Only the start is chosen here: what it leads to is solved as exactly as from anywhere, and where it leads nowhere,
`Mechanics.solve` tries the next one and goes its usual way at last. Each strategy offers `Start`s:

- `Extrapolation`, without any knowledge of other runs: the line through the last two solutions. Along a probe's path
  it errs by the square of the poses' distance, the last solution itself by the distance.
- `WarmStart`, for one walk along a recording: the same moment of an earlier run of a body that differs a little, moved
  along its sensitivities; the same moment on another mesh, corrected by what that got wrong nearby; without memory of
  the path the moment with the nearest pose; where the probe drags the surface, what it touches moved along with it.
"""

from __future__ import annotations

import hashlib
import pickle
from collections import ChainMap
from collections.abc import Callable, Collection, Hashable, Iterable, Iterator, Mapping, MutableMapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.spatial import KDTree

from livedeform.common.types import Array
from livedeform.fem_node.contact.contact import ContactState, ProbeContact, make_contact
from livedeform.fem_node.element.element import Space
from livedeform.fem_node.embedded_points import EmbeddedPoints
from livedeform.fem_node.items.protocol import Moment
from livedeform.fem_node.path.direction import Direction
from livedeform.fem_node.physics.memory import memory_of
from livedeform.fem_node.physics.record import Physics

if TYPE_CHECKING:
    from livedeform.fem_node.path.mechanics import Mechanics

LEVER = 0.02  # m, about the size of a probe's face: what a turn counts
FURTHEST = 2.0  # times the last step
OFF_LINE = 0.5  # of the step: more than this off the line, and the line says too little
SAME_MOMENT = 2e-3  # m between the poses of one moment in two runs, up to which the one starts the other
ALIKE = 3e-3  # m between poses at which two meshes are apart by about the same
STRAYED = 1e-4  # m between two runs' displacements, from which the one is no start for the other's next moment
NEARER = 1e-9  # m by which another moment's pose must be nearer than the last one's
MOST_SLOPES = 12  # directions whose displacements are kept for the next run
MOST_KINDS = 6  # of bodies that solved moments are kept for, besides the plain one

Key = tuple[str, int]  # of a moment: the recording's name and the stamp
Kind = frozenset[str]  # what acts on a body besides what was declared
Coordinates = dict[Hashable, float]  # of a body, along named directions
ContactSave = tuple[ContactState, *tuple[Any, ...]]  # as `ProbeContact.save` makes it


class Start(NamedTuple):
    """Unknowns ``x`` (n_dof,) to start from; ``enter`` puts the contact's tractions there (None: they stay as they
    are); ``in_one_step``: the moment is not approached by load steps; ``jump``: it may be far, so that surface that is
    pushed elsewhere than where the probe came in is looked for."""

    x: Array
    enter: Callable[[ProbeContact], None] | None = None
    in_one_step: bool = True
    jump: bool = False


def coordinates_of(directions: Sequence[Direction]) -> Coordinates:
    """Return where a body is along each direction; nothing where two share a name, or they are too many to keep."""
    out = {d.name: d.at for d in directions}
    return out if len(out) == len(directions) <= MOST_SLOPES else {}


# -- from the last two solutions ---------------------------------------------------------------------------------------


class _Solved(NamedTuple):
    moment: Moment
    x: Array
    multiplier: Array


class Extrapolation:
    """Remembers the last two solutions with a probe, and continues the line through them."""

    def __init__(self) -> None:
        self._known: list[_Solved] = []

    def note(self, moment: Moment, x: Array, multiplier: Array) -> None:
        """Remember an accepted solution: unknowns ``x`` (n_dof,), multipliers (q,) Pa."""
        if moment.pose is None:
            self._known.clear()
        else:
            self._known = [*self._known[-1:], _Solved(moment, x, multiplier)]

    def back_to(self, x: Array) -> None:
        """Forget the line if the body was put back to a solution ``x`` that is not the last one."""
        if self._known and self._known[-1].x is not x:
            self._known.clear()

    def starts(self, moment: Moment) -> Iterator[Start]:
        """Offer the point of the line that belongs to ``moment``."""
        reached = self.at(moment)
        if reached is not None:
            x, multiplier = reached
            yield Start(x, lambda contact: contact.warm_start(multiplier))

    def at(self, moment: Moment) -> tuple[Array, Array] | None:
        """Return unknowns (n_dof,) and multipliers (q,) Pa at ``moment``; None where the last two solutions do not
        lead there."""
        if len(self._known) < 2 or moment.pose is None:
            return None
        first, last = self._known
        if not (_same_loads(first.moment, last.moment) and _same_loads(last.moment, moment)):
            return None
        before, now, then = (_points(m) for m in (first.moment, last.moment, moment))
        step, ahead = now - before, then - now
        squared = float(step @ step)
        if squared == 0.0:
            return None
        f = float(ahead @ step) / squared
        if abs(f) > FURTHEST or np.linalg.norm(ahead - f * step) > OFF_LINE * np.linalg.norm(ahead):
            return None
        pressed = np.maximum(last.multiplier + f * (last.multiplier - first.multiplier), 0.0)
        return last.x + f * (last.x - first.x), np.where(last.multiplier > 0.0, pressed, 0.0)


def _points(moment: Moment) -> Array:
    """Return points of the probe (12,) m that tell its place and its turn."""
    if moment.pose is None:
        return np.zeros(12)
    return np.concatenate([moment.pose[:3, 3], LEVER * moment.pose[:3, :3].ravel()])


def _same_loads(a: Moment, b: Moment) -> bool:
    return a.load == b.load and np.array_equal(a.gravity, b.gravity)


# -- from other runs ---------------------------------------------------------------------------------------------------


@dataclass
class SolvedMoment:
    """A solved moment: unknowns ``x`` (n_dof,), the contact's state, the probe's pose, and how the unknowns change when
    a coordinate changes from ``coordinates`` by one: ``slopes`` (n_dof,) by direction; ``body``: `fingerprint` of the
    physics that it was solved with (empty: not known)."""

    x: Array
    contact: ContactSave | None
    pose: Array | None
    coordinates: Coordinates = field(default_factory=dict)
    slopes: dict[Hashable, Array] = field(default_factory=dict)
    body: bytes = b""

    def at(self, coordinates: Coordinates) -> Array:
        """Return the unknowns (n_dof,) to be expected at other coordinates, to first order."""
        x = self.x
        for name, slope in self.slopes.items():
            if name in coordinates:
                x = x + (coordinates[name] - self.coordinates[name]) * slope
        return x

    def corrected(self, expected: SolvedMoment, found: SolvedMoment) -> SolvedMoment:
        """Return this moment if it is as wrong as another was, where one was ``expected`` and one was ``found``."""
        if self.contact is None or expected.contact is None or found.contact is None:
            return replace(self, x=self.x + found.x - expected.x, body=b"")
        state = self.contact[0]
        multiplier = state.multiplier + found.contact[0].multiplier - expected.contact[0].multiplier
        state = replace(state, multiplier=np.maximum(multiplier, 0.0), touches=multiplier > 0.0)
        return replace(self, x=self.x + found.x - expected.x, contact=(state, *self.contact[1:]), body=b"")


Solved = dict[tuple[Kind, Key], SolvedMoment]


def fingerprint(physics: Physics) -> bytes:
    """Return what equal physics have in common, and others do not; nothing where a function is a part of them."""
    try:
        return hashlib.sha256(pickle.dumps(physics)).digest()
    except (pickle.PicklingError, AttributeError, TypeError):
        return b""


class SolvedMoments:
    """The solved moments of one mesh: the last ones of each kind of body, for some kinds."""

    def __init__(self) -> None:
        self._by_kind: dict[Kind, dict[Key, SolvedMoment]] = {frozenset(): {}}  # the latest last

    def of(self, kind: Kind) -> MutableMapping[Key, SolvedMoment]:
        """Return those of a kind, to read and to write. What is not solved with all that acts there is read as it was
        with the most of it."""
        if kind:
            self._by_kind[kind] = self._by_kind.pop(kind, {})
        for old in list(self._by_kind)[1:-MOST_KINDS]:
            del self._by_kind[old]
        fewer = sorted((k for k in self._by_kind if k < kind), key=len, reverse=True)
        return ChainMap(self._by_kind[kind], *(self._by_kind[k] for k in fewer))

    @property
    def known(self) -> set[tuple[Kind, Key]]:
        """Return what is solved."""
        return {(kind, key) for kind, known in self._by_kind.items() for key in known}

    def news(self, known: Collection[tuple[Kind, Key]]) -> Solved:
        """Return what is solved besides the ``known``, for another process; slopes stay here."""
        return {(n, k): replace(self._by_kind[n][k], slopes={}) for n, k in self.known if (n, k) not in known}

    def hear(self, news: Solved) -> None:
        """Take over what another process solved, where nothing is known here."""
        for (kind, key), moment in news.items():
            self._by_kind.setdefault(kind, {}).setdefault(key, moment)

    def solved(self, kind: Kind, name: str, stamps_ns: Iterable[int]) -> Solved:
        """Return what there is of the recording ``name`` with a kind of body, slopes and all."""
        wanted = {(name, int(s)) for s in stamps_ns}
        return {(kind, k): g for k, g in self._by_kind[kind].items() if k in wanted or not k[0]}

    def follow(self, solved: Solved) -> None:
        """Take over what the same body has `solved` in another process, instead of what was known."""
        for (kind, key), moment in solved.items():
            self._by_kind.setdefault(kind, {})[key] = moment


class WarmStart:
    """The warm starts of the solutions of one walk along the recording ``name``.

    ``known``: moments that were solved in earlier runs; what this walk solves is written there. ``elsewhere``: moments
    that another mesh has solved (`transferred`). ``dense``: the moments are near each other, so that one that is not
    known starts from the line through the last two. ``coordinates``: where the body is along the directions by which
    the next run may differ. ``body``: `fingerprint` of its physics; what it has solved is not solved again.
    """

    def __init__(
        self,
        known: MutableMapping[Key, SolvedMoment] | None = None,
        name: str = "recording",
        *,
        elsewhere: Mapping[Key, SolvedMoment] | None = None,
        dense: bool = False,
        body: bytes = b"",
    ) -> None:
        self._known: MutableMapping[Key, SolvedMoment] = {} if known is None else known
        self._elsewhere = {} if elsewhere is None else elsewhere
        self._name, self._dense, self._body = name, dense, body
        self._here: dict[int, SolvedMoment] = {}  # by the stamp that the walk was on the way to
        self._away = 0.0  # m, how far the last solution was from that of an earlier run
        self.coordinates: Coordinates = {}

    def starts(self, body: Mechanics, stamp_ns: int, key: Key, moment: Moment) -> Iterator[Start]:
        """Offer starts for ``moment``, which is kept by ``key``, on the way to ``stamp_ns`` or there."""
        path_matters = bool(body.memory.path_dependent)
        chosen, known = self._chosen(body, stamp_ns, key, moment, path_matters=path_matters)
        if chosen is not None:
            x, enter = chosen.at(self.coordinates), _entering(chosen, path_matters=path_matters)
            yield Start(x, enter, jump=not known)
            if known:
                yield Start(x, enter, in_one_step=False)
        elif self._dense:
            yield from body.extrapolated(moment)
        elif not path_matters:
            yield Start(body.x, jump=True)
        if path_matters:
            yield from body.dragged(moment)

    def solved(self, body: Mechanics, key: Key, moment: Moment) -> Array | None:
        """Return the unknowns (n_dof,) that this very body has at ``moment``, and put its contact there; None where
        they are not known, or more than the pose and the loads decides."""
        known = self._known.get(key)
        if known is None or not self._body or known.body != self._body:
            return None
        if body.memory.path_dependent or body.physics.interfaces or (not key[0] and body.memory.reasons):
            return None
        if pose_distance(known.pose, moment.pose) > 0.0:
            return None
        body.prepare(moment)
        if body.contact is not None and known.contact is not None:
            body.contact.restore(known.contact)
        return known.x

    def key(self, stamp_ns: int, moment: Moment, *, first: bool) -> Key:
        """Return by what a moment is kept: where every recording begins, at rest, by whether loads act."""
        return ("", int(moment.gravity.any() or moment.load > 0.0)) if first else (self._name, stamp_ns)

    def note(self, body: Mechanics, stamp_ns: int, key: Key, moment: Moment) -> None:
        """Keep the committed solution."""
        before = self._known.get(key)
        self._away = 0.0 if before is None else float(np.abs(body.x - before.at(self.coordinates)).max())
        state = None if body.contact is None else body.contact.save()
        moment_now = SolvedMoment(body.x.copy(), state, moment.pose, self.coordinates, body=self._body)
        self._here[stamp_ns] = self._known[key] = moment_now

    def keep_slopes(self, stamp_ns: int, slopes: dict[Hashable, Array]) -> None:
        """Keep how the solution at ``stamp_ns`` changes (n_dof,) along directions, for the next run."""
        moment = self._known.get((self._name, stamp_ns))
        if self.coordinates and moment is not None and moment.coordinates is self.coordinates:
            moment.slopes = slopes

    def _chosen(
        self, body: Mechanics, stamp_ns: int, key: Key, moment: Moment, *, path_matters: bool
    ) -> tuple[SolvedMoment | None, bool]:
        """Return the same moment of an earlier run or of another mesh, or without memory of the path the solved moment
        with the nearest pose; and whether it is the same. None where the probe and the support both rub: from
        another run's solution the limits of the two settle sooner, but within their tolerance elsewhere."""
        if body.memory.rubs and body.memory.slips:
            return None, False
        if not key[0]:
            return self._known.get(key), True
        same = self._known.get(key) or self._from_elsewhere(stamp_ns, moment)
        strayed = path_matters and self._away > STRAYED
        if same is not None and pose_distance(same.pose, moment.pose) < SAME_MOMENT and not strayed:
            return same, True
        if path_matters or not self._here:
            return None, False
        best = min(self._here.values(), key=lambda s: pose_distance(s.pose, moment.pose))
        nearest = pose_distance(body.moment.pose, moment.pose) - NEARER
        return (best if pose_distance(best.pose, moment.pose) < nearest else None), False

    def _from_elsewhere(self, stamp_ns: int, moment: Moment) -> SolvedMoment | None:
        """Return what another mesh has solved, corrected by what it got wrong at the nearest moment solved here."""
        found = {s: self._elsewhere.get((self._name, s)) for s in (stamp_ns, *self._here)}
        start = found[stamp_ns]
        done = [(here, found[s]) for s, here in self._here.items() if found[s] is not None]
        if start is None or not done:
            return start
        here, there = min(done, key=lambda pair: pose_distance(pair[0].pose, moment.pose))
        near = pose_distance(here.pose, moment.pose) < ALIKE
        return start.corrected(there, here) if near and there is not None else start


def _entering(solved: SolvedMoment, *, path_matters: bool) -> Callable[[ProbeContact], None] | None:
    """Return what puts the contact where ``solved`` had it; its own past stays where the path matters."""
    saved = solved.contact
    if saved is None:
        return None
    if path_matters:
        return lambda contact: contact.begin_like(saved[0])
    return lambda contact: contact.restore(saved)


def pose_distance(a: Array | None, b: Array | None) -> float:
    """Return a distance between two poses (4, 4), m; a turn counts as 3 cm per radian."""
    if a is None or b is None:
        return 0.0 if a is b else 1.0
    return float(np.linalg.norm(a[:3, 3] - b[:3, 3]) + LEVER * np.linalg.norm(a[:3, :3] - b[:3, :3]))


def transferred(
    solved: Mapping[Key, SolvedMoment], one: Space, other: Space, physics: Physics
) -> dict[Key, SolvedMoment]:
    """Return the moments at which a body was pressed as solved on its mesh ``one``, for its mesh ``other``.

    Displacements go by the shape functions, pressures from the nearest contact points. Nothing is transferred where
    there is more to a moment than these: pressure unknowns, or a memory of the path.
    """
    if physics.probe is None or other.n_pressure or memory_of(physics).path_dependent:
        return {}
    at = EmbeddedPoints(one, other.nodes)
    there, here = (make_contact(space, physics.probe, physics.material.youngs_modulus) for space in (one, other))
    nearest = KDTree(there.places).query(here.places)[1]
    out = {}
    for key, moment in solved.items():
        if moment.contact is not None and moment.contact[0].touches.any():
            u = at.positions(moment.x.reshape(-1, 3)) - other.nodes
            here.start_like(moment.contact[0], nearest, u)
            out[key] = SolvedMoment(u.ravel(), here.save(), moment.pose, moment.coordinates)
    return out
