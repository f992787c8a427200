"""What the loop says of ordinary recordings: 5 to 30 Hz, pauses of 0.3 to 3 s, noise stated rightly, wrongly or not.

Experiments without any undeclared effect and experiments with one that is twice as large as the noise of a frame go
through the whole of it: track, noise, key moments, search, verdict. The body is that of closed formulas in
`tests/closed_loop/toy.py`, so that hundreds of experiments take minutes; what finite elements get wrong is the blind
test's (`benchmarks.blind`).

    python -m benchmarks.verdicts [--experiments 40] [--seed 0] [--jobs 2]
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np

from benchmarks.blind.table import bounds
from benchmarks.noise_estimates import pressed
from livedeform.closed_loop.assessment.next_experiment import ProbeReach
from livedeform.closed_loop.evidence.observation import Observation, observe
from livedeform.closed_loop.evidence.track import Track
from livedeform.closed_loop.inputs import Inputs
from livedeform.closed_loop.loop import investigate
from livedeform.common.errors import LivedeformError
from livedeform.common.types import Array, EffectValues, Pose

SECONDS, AIR = 30.0, 0.005  # s of a recording, m of the probe above the body between presses
SPREAD = np.array([0.5, 0.5, 1.6])  # a camera pair sees depth worst
STATED = (1.0, 1.0, 0.4, 2.5, float("nan"))  # stated sigma over the true one; NaN: none is stated
KINDS = {
    "stiffness": lambda s: {"ratio": 1.0 + 0.2 * s},
    "viscoelasticity": lambda s: {"g": [0.1 * s], "tau": [2.0]},
    "gravity_tilt": lambda s: {"angle_x": 0.05 * s, "angle_y": 0.02 * s},
    "probe_offset": lambda s: {"translation": [1e-3 * s, -5e-4 * s, 5e-4 * s]},
    "plastic_set": lambda s: {"fraction": 0.2 * s},
    "poisson_ratio": lambda s: {"value": 0.49 - 0.1 * s},
    "time_offset": lambda s: {"seconds": 0.05 * s},
    "swelling": lambda s: {"rate": 5e-4 * s, "offset": 0.0},
}


@dataclass(frozen=True)
class Case:
    """One experiment of two recordings: ``rate`` Hz, ``pause`` s, ``sigma`` m of a coordinate, ``stated`` sigma over
    the true one (NaN: none), ``markers``, and the ``kind`` of effect that it lacks ("": none)."""

    number: int
    kind: str
    rate: float
    pause: float
    sigma: float
    stated: float
    markers: int


@dataclass(frozen=True)
class Outcome:
    """The ``verdict`` (or "refused") and the names that it gives, with those that cannot be told apart from them."""

    case: Case
    verdict: str
    named: tuple[str, ...] = ()
    alternatives: tuple[str, ...] = ()
    said: str = ""

    @property
    def right(self) -> bool:
        return self.verdict == ("effect" if self.case.kind else "none") and (
            not self.case.kind or self.case.kind in self.named + self.alternatives
        )


def cases(experiments: int, seed: int) -> list[Case]:
    """Make so many experiments without an effect, and so many with one."""
    rng = np.random.default_rng([seed, 77])
    out = []
    for number in range(2 * experiments):
        kind = "" if number < experiments else list(KINDS)[number % len(KINDS)]
        rate, pause = float(rng.choice([5.0, 10.0, 30.0])), float(rng.choice([0.3, 0.8, 1.5, 3.0]))
        sigma, stated = float(rng.choice([3e-5, 1e-4, 2e-4])), float(rng.choice(STATED))
        out.append(Case(number, kind, rate, pause, sigma, stated, int(rng.choice([20, 40]))))
    return out


def toy_body() -> ModuleType:
    """Load the body of closed formulas, which is the tests' own."""
    if "toy" not in sys.modules:
        file = Path(__file__).parents[1] / "tests" / "closed_loop" / "toy.py"
        spec = importlib.util.spec_from_file_location("toy", file)
        assert spec is not None and spec.loader is not None
        sys.modules["toy"] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules["toy"])
    return sys.modules["toy"]


def path(case: Case, rng: np.random.Generator, height: float) -> list[Pose]:
    """Return poses of a probe at 100 Hz that presses at changing places."""
    seconds = np.arange(0.0, SECONDS, 0.01)
    depth, place = pressed(seconds, case.pause, rng)
    down = np.array([1.0, 0.0, 0.0, 0.0])
    z = height - depth + AIR * (depth < 1e-9)
    return [Pose(int(s * 1e9), np.array([*p, h]), down) for s, p, h in zip(seconds, place, z, strict=True)]


def at_twice_the_noise(case: Case, path: list[Pose], stamps: Array, places: Array) -> list[EffectValues]:
    """Return the missing effect, so large that it moves the markers by twice the noise of a frame (rms)."""
    toy = toy_body()
    if not case.kind:
        return []
    body, goal = toy.ToyBody(places), 2.0 * case.sigma * float(np.sqrt((SPREAD**2).sum()))

    def moved(size: float) -> float:
        effects = [toy.effect(case.kind, **KINDS[case.kind](size))]
        d = points(body, effects, path, stamps) - points(body, [], path, stamps)
        return float(np.sqrt((d**2).sum(axis=2).mean()))

    size = 1.0
    for _ in range(12):
        size *= float(np.clip(goal / max(moved(size), 1e-12), 0.3, 3.0))
    return [toy.effect(case.kind, **KINDS[case.kind](size))]


def points(body: object, effects: list[EffectValues], path: list[Pose], stamps: Array) -> Array:
    """Return places (f, m, 3) m of the markers without noise."""
    toy = toy_body()
    offset = next((float(e.values["seconds"]) for e in effects if e.name == "time_offset"), 0.0)
    position, _ = toy.poses_at(path, stamps, offset)
    return np.asarray(body.points(effects, stamps * 1e-9, position))  # type: ignore[attr-defined]


def recording(
    case: Case, seed: int, name: str, effects: list[EffectValues] | None
) -> tuple[Observation, list[EffectValues]]:
    """Return one recording of the case, and the effects in it (sized by this one if None are given)."""
    toy, rng = toy_body(), np.random.default_rng([case.number, seed])
    places = toy.markers(case.markers)
    poses = path(case, rng, toy.HEIGHT)
    stamps = (np.arange(0.05, SECONDS - 0.1, 1.0 / case.rate) * 1e9).astype(np.int64)
    effects = at_twice_the_noise(case, poses, stamps, places) if effects is None else effects
    measured = points(toy.ToyBody(places), effects, poses, stamps)
    measured = measured + case.sigma * SPREAD * rng.standard_normal(measured.shape)
    covariances = np.broadcast_to(np.diag((case.stated * case.sigma * SPREAD) ** 2), (*measured.shape, 3)).copy()
    data = Track(stamps, np.arange(case.markers), measured, covariances)
    return observe(name, data, poses, n_moments=24, start_ns=0, settings=toy.SETTINGS), effects


def diagnosed(case: Case, seed: int) -> Outcome:
    """Ask the loop."""
    toy = toy_body()
    try:
        fit, effects = recording(case, 2 * seed, "fit", None)
        test, _ = recording(case, 2 * seed + 1, "test", effects)
        places = toy.markers(case.markers)
        inputs = Inputs(
            fitted=(fit,),
            held_out=(test,),
            candidates=toy.candidates(places),
            uncertain=toy.uncertain(places),
            places=places,
            reach=ProbeReach(
                np.array([-toy.RADIUS, -toy.RADIUS, 0.0]), np.array([toy.RADIUS, toy.RADIUS, toy.HEIGHT]), None, 0.008
            ),
        )
        found = investigate(toy.ToyModel(toy.ToyBody(places)), inputs, seed=seed)
    except LivedeformError as error:
        return Outcome(case, "refused", said=str(error))
    named = tuple(e.name for e in found.effects)
    together = {a for r in found.ranking if r.name in named for a in r.indistinguishable_from}
    return Outcome(case, found.verdict, named, tuple(sorted(together - set(named))), found.text)


def main() -> int:
    """Print what was said of each kind of experiment; 1 where a false "none" or alarm is among them."""
    parser = argparse.ArgumentParser(prog="benchmarks.verdicts", description=__doc__)
    parser.add_argument("--experiments", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    with ProcessPoolExecutor(options.jobs) as pool:
        wanted = cases(options.experiments, options.seed)
        outcomes = list(pool.map(diagnosed, wanted, [options.seed] * len(wanted)))
    return report(outcomes)


def report(outcomes: list[Outcome]) -> int:
    """Print the two tables, and each wrong answer."""
    without, lacking = [o for o in outcomes if not o.case.kind], [o for o in outcomes if o.case.kind]
    alarms = [o for o in without if o.verdict in ("effect", "unexplained")]
    missed = [o for o in lacking if o.verdict == "none"]
    wrong = [o for o in lacking if o.verdict == "effect" and not o.right]
    for title, group in (("without an effect", without), ("one effect at twice the noise", lacking)):
        print(f"{title}: {dict(Counter(o.verdict for o in group))} of {len(group)}")
    print(f"false alarms {rate(len(alarms), len(without))}, false 'none' {rate(len(missed), len(lacking))}")
    named = rate(sum(o.right for o in lacking), len(lacking))
    print(f"named right {named}, named wrong {rate(len(wrong), len(lacking))}")
    for o in (*alarms, *missed, *wrong):
        print(f"  {o.verdict} {o.named} {o.alternatives} of {o.case}\n    {o.said}")
    return int(bool(alarms or missed))


def rate(k: int, n: int) -> str:
    """Say ``k`` of ``n`` with its 95 % interval."""
    low, high = bounds(k, n)
    return f"{k} of {n} ({low:.0%} to {high:.0%})"


if __name__ == "__main__":
    sys.exit(main())
