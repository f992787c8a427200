"""Every number of the closed loop that was chosen: what it decides, its unit, and where it was measured.

The parts are handed in where they are used (``Screening(settings.screening)``, ``GaussNewton(settings.fit)``)
and are written beside each diagnosis as ``settings.json``. A number has one of three roles:

- *decides*: another value changes a verdict, a name or what counts as distinguishable;
- *allows*: it sizes an uncertainty that every explanation is granted;
- *effort*: how much is sampled, tried or drawn; a larger effort gives the same answer more slowly.

Gains and scores are in units of twice the log likelihood or predictive density: 9 are odds of 90, 16 odds of 3000.
Where a number was measured, "evidence/NAME" is the page docs/evidence/NAME.md, and "blind test" its blind-test.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any, Literal

from livedeform.compare_node.at_rest import PLACE

Role = Literal["decides", "allows", "effort"]


def _number(role: Role, value: Any, unit: str, what: str, measured: str) -> Any:
    """A field that knows its unit, what it is for, and where its value comes from."""
    return field(default=value, metadata={"role": role, "unit": unit, "what": what, "measured": measured})


def _decides(value: Any, unit: str, what: str, measured: str) -> Any:
    return _number("decides", value, unit, what, measured)


def _allows(value: Any, unit: str, what: str, measured: str) -> Any:
    return _number("allows", value, unit, what, measured)


def _effort(value: Any, unit: str, what: str, measured: str = "chosen") -> Any:
    return _number("effort", value, unit, what, measured)


@dataclass(frozen=True)
class SamplingSettings:
    """Numbers by which recordings become key moments, and the body a mesh."""

    moments_fit: int = _effort(30, "1", "key moments of a fitted recording", "evidence/blind-test, time")
    moments_test: int = _effort(20, "1", "key moments of a held-out recording", "evidence/blind-test, time")
    moments_swing: int = _effort(80, "1", "either, of a body that is let go: a swing needs some", "studies: beam")
    letting_go: tuple[float, float] = _effort(
        (-5.0, 10.0), "sigma of the release", "about it in which a hand may still be at the body", "studies: beam"
    )
    mesh_vertices: int = _effort(420, "1", "vertices of the mesh of the search", "evidence/refined-mesh")
    pairs_per_second: float = _effort(10.0, "Hz", "pairs of pictures that are measured where there are no markers yet")
    jolt_window: float = _effort(
        0.05, "s", "over which the probe's acceleration is taken: shorter blows pass a soft body by"
    )
    window_seconds: float = _effort(0.5, "s", "longest window over which frames are averaged")
    window_motion: float = _effort(5e-5, "m", "motion in a window beyond which its mean is biased by a kink")
    share_of_time: float = _effort(0.45, "1", "of a moment's importance that is time; the rest is motion")
    least_blocks: int = _effort(4, "1", "blocks of time that are left out one after another")
    block_level: float = _effort(0.15, "1", "share of the largest motion above which a press has begun")
    block_motion: float = _effort(1e-4, "m", "motion above which a press has begun, at least")
    block_seconds: float = _effort(0.5, "s", "shortest block")
    pressed_level: float = _effort(0.05, "1", "share of the largest motion above which a moment is not at rest")
    pressed_motion: float = _effort(5e-5, "m", "motion above which a moment is not at rest, at least")
    still_speed: float = _effort(5e-4, "m/s", "speed of the markers below which they are at rest")
    still_probe: float = _effort(2e-3, "m/s", "speed of the probe below which it is at rest")
    depth: tuple[float, float] = _effort((0.003, 0.015), "m", "least and largest depth of a proposed press")
    moved: float = _decides(
        6.0,
        "sigma of chi2",
        "by which a moment must differ from the first one to have moved: else there is no contact to learn from",
        "chosen",
    )


@dataclass(frozen=True)
class NoiseSettings:
    """Numbers that estimate the measuring noise from the recording itself."""

    point_sigma: float = _allows(1e-4, "m", "noise of a point where neither the tracker nor repeats say more", "chosen")
    force_sigma: float = _effort(1e-4, "N", "least noise of a force; one that never changes would have none")
    outlier: float = _decides(6.0, "sigma", "from a window's median beyond which a frame is left out", "chosen")
    sample_outlier: float = _effort(3.5, "sigma", "beyond which a difference does not count for the covariance")
    most_trusted: float = _effort(10.0, "1", "usual frames that one may stand for, however small a sigma it states")
    quiet: float = _effort(0.67, "1", "share of the time, the slowest, in which second differences are noise")
    changed: float = _effort(0.9, "1", "of the points that are other ones than before where a tracker measured anew")
    even: float = _effort(0.3, "1", "of the frame interval by which evenly sampled frames may differ")
    enough: int = _effort(30, "1", "differences that tell the scale of the noise")
    least_frames: int = _effort(5, "1", "frames that have differences worth a median")
    few: int = _effort(10, "1", "differences below which the default noise is taken")
    own_weight: float = _effort(50.0, "1", "differences at which a marker's own noise counts as much as all markers'")
    stretch: float = _effort(2.0, "s", "longest lag at which correlation is looked for")
    window: float = _effort(0.5, "s", "window whose mean the correlation inflates: the longest that is averaged")
    uncorrelated: float = _effort(0.05, "1", "correlation below which frames count as independent")
    often_seen: float = _effort(0.8, "1", "of the frames in which a marker is seen that helps to tell shared motion")
    least_markers: int = _effort(8, "1", "markers that tell what is shared")
    least_shared_frames: int = _effort(24, "1", "frames that tell what is shared")
    most_shared: float = _effort(0.4, "1", "of the frames, and of the markers' coordinates, shared courses at most")
    fading: tuple[float, float, int] = _effort(
        (0.4, 3.0, 16), "frame intervals, s, 1", "correlation times that are tried: shortest, longest, how many"
    )
    surrogates: int = _effort(10, "1", "courses of random phases that a shared one must exceed")
    wild: float = _effort(
        12.0,
        "1",
        "times a marker's usual departure from its neighbours in time beyond which a point is left out",
        "benchmarks/noise_estimates.py",
    )
    tiny_length: float = _effort(1e-9, "m", "least spread of a marker; recordings that repeat a frame have none")
    stretches: int = _effort(8, "1", "parts of the time whose noise is compared for the interval")
    most_uncertain: float = _decides(
        1.6,
        "1",
        "ratio of the interval's ends, and of the variances while moving and slow, beyond which noise is not told",
        "the goal of 0.8 to 1.25, benchmarks/noise_estimates.py",
    )
    smoothed: int = _effort(5, "1", "frames over which the markers' motion is smoothed, at least")
    smoothed_seconds: float = _effort(0.5, "s", "over which it is smoothed, at most, where noise asks for it")
    clear_level: float = _effort(0.15, "1", "share of the largest motion that is to be seen through the noise")
    clear_sigmas: float = _effort(5.0, "1", "of the noise, beyond which motion is no noise")
    least_wrenches: int = _effort(5, "1", "wrenches that make a course of the force")
    jitter: float = _effort(2.0, "sigma of the recorded path", "beyond which a probe is not still")
    whole: tuple[float, float, int] = _effort(
        (0.9, 0.1, 6), "1, 1, 1", "of differences, that share is so near to multiples of so many parts of a small one"
    )


@dataclass(frozen=True)
class AllowanceSettings:
    """Allowances for what may separate measurement and model without any missing effect."""

    place_sigma: float = _allows(PLACE, "m", "place of a marker whose file gives no sigma", "chosen")
    shift: float = _allows(5e-4, "m", "registration to the markers at rest, translation", "chosen")
    turn: float = _allows(0.01, "rad", "registration to the markers at rest, rotation", "chosen")
    stated_shift: float = _allows(2e-4, "m", "a pose of the cameras that the experiment states, translation", "chosen")
    stated_turn: float = _allows(0.002, "rad", "a pose of the cameras that the experiment states, rotation", "chosen")
    stated: float = _allows(
        0.1, "1", "of a candidate's usual sigma that is added to the one that the experiment states", "chosen"
    )
    relative: float = _allows(
        0.03,
        "1",
        "model error of a marker's motion where no refined mesh tells it",
        "evidence/refined-mesh: 2.6 %",
    )
    force: float = _allows(
        0.06,
        "1",
        "model error of the force where no refined mesh tells it",
        "evidence/refined-mesh: 1.1 to 2.9 %",
    )
    least: float = _allows(
        0.02,
        "1",
        "either of them where one does, at least",
        "none-50, -51, -52: 1.3 to 1.7 % of the motion, 0.2 to 0.4 % of the force, of which a sensor is hardly better",
    )
    force_factor: float = _allows(2.0, "1", "of the difference of two meshes' forces that is allowed for", "chosen")
    force_single: float = _allows(0.02, "1", "of the largest force, error that is another one at each moment", "chosen")
    force_common: float = _allows(0.5, "1", "share of the force's error that presses have in common", "chosen")
    rest: float = _allows(0.008, "1", "model error of a marker's sag", "evidence/refined-mesh")
    offset: tuple[float, float, float] = _allows(
        (0.04, 0.04, 0.02),
        "1",
        "of an element's size, sideways and along the probe's axis, by which the probe seems to press off its place",
        "evidence/refined-mesh: `offset`; half of it along the axis is chosen",
    )
    single: float = _allows(0.3, "1", "share of a marker's relative error that is another one at each moment", "chosen")
    floor: float = _effort(
        2e-6, "m", "error of a point that no other part describes", "chosen; keeps the covariance well conditioned"
    )
    look: float = _allows(
        2e-5,
        "m",
        "rms motion over which a dot keeps its systematic error: a twentieth of a pixel",
        "shipped phantom: a camera motion of 0.14 mrad was found without it",
    )
    light: float = _allows(
        0.25, "1", "share of the deepest motion of a press below which contact has hardly begun", "shipped phantom"
    )
    still: float = _effort(
        1e-5, "m", "motion in a press, or path of the probe, below which it has no columns of its own"
    )
    deeper: float = _effort(0.01, "1", "share of the deepest motion by which a neighbour in time has to be deeper")
    lost: float = _decides(
        0.2, "1", "share of the data without an equilibrium beyond which a fit is given up", "chosen"
    )
    outlier: float = _decides(
        5.0, "sigma", "beyond its neighbours' residual at which a marker at one moment is trusted less", "chosen"
    )
    usual: float = _effort(0.75, "1", "quantile of a marker's residuals that counts as usual")


@dataclass(frozen=True)
class DiscretisationSettings:
    """Numbers of the discretisation error, told by a refined mesh (`refined_mesh`)."""

    remains: float = _allows(
        0.5,
        "1",
        "of what a refined mesh takes away that is still wrong",
        "evidence/refined-mesh: 0.26 to 0.85 in five experiments",
    )
    remains_rubbing: float = _allows(
        1.0,
        "1",
        "the same where the probe rubs",
        "evidence/memory: 0.5 to 0.7 in three presses with a friction of 0.3, 0.96 on the gelatin cuboid",
    )
    flat: float = _allows(
        0.25,
        "1",
        "of the flats' depth by which curved patches of the contact are off",
        "as far as the scan's own triangles are",
    )
    patterns: int = _allows(2, "1", "independent errors that a press tells, for the upper bound", "chosen")
    tail: float = _allows(
        0.1, "1", "chance that an error is larger than the upper bound that few presses give", "chosen"
    )
    coarser: float = _effort(
        2.5, "1", "elements of a coarser mesh, of which a mesher gives 1.0 to 1.3: the surface holds them back"
    )
    most_vertices: int = _effort(840, "1", "of a mesh with all elements halved, where nothing presses")
    largest: float = _effort(2.0, "1", "times as many vertices as the own mesh, beyond which a coarser one is none")
    most_rubbing: int = _effort(
        40_000, "1", "unknowns of a refined mesh that is led along the whole path of a probe that begins to rub"
    )
    follows: float = _effort(1.25, "1", "times a friction, up to which what elements drag is in proportion to it")
    most_presses: int = _effort(4, "1", "presses of a recording at which meshes are compared")
    most_uneven: float = _effort(
        0.25, "1", "of the elements that are halved for that; a stiff skin would halve nearly all"
    )
    halved: int = _effort(
        2,
        "1",
        "times that elements under the probe are halved: once takes half of their error away, twice two thirds",
        "benchmarks/refined_mesh.py",
    )


@dataclass(frozen=True)
class FitSettings:
    """The nonlinear fit (`GaussNewton`)."""

    lengths: tuple[float, ...] = _effort((1.0, 0.35, 0.12), "1", "of a step, tried until one betters the fit")
    dampings: tuple[float, ...] = _effort(
        (0.0, 0.003, 0.02, 0.1, 0.5, 3.0), "1", "of a step of what swings, tried likewise"
    )
    tolerance: float = _effort(
        0.5, "gain", "expected of a step, below which the fit has converged: a seventh of a sigma or so"
    )
    runs: int = _effort(4, "1", "runs of the model for a fit, and one more for each coordinate")
    roughly: int = _effort(5, "1", "runs of a rough fit to what rings")
    falls: float = _effort(0.7, "1", "of what was left before: less, and another rough fit goes on from there")
    elements_size: float = _allows(
        0.04, "1", "error of a fitted effect's size that its elements make", "blind test, intervals that hold the truth"
    )
    elements_place: float = _allows(
        0.013, "1", "of the elements' size, error of a fitted place", "blind test, three offsets of the probe"
    )
    elements_edge: float = _effort(
        0.08,
        "1",
        "of the elements' size, error of a fitted length, as a layer's thickness: it widens intervals, and decides "
        "nothing",
        "benchmarks/coverage.py, the tuning half: 0.02 to 0.2",
    )
    presses_known: float = _effort(
        2.0,
        "presses",
        "that the expected size of a fit's error counts for, beside what they differ by",
        "benchmarks/coverage.py, the tuning half",
    )


@dataclass(frozen=True)
class ScreeningSettings:
    """All candidates by their Jacobian columns at once (`Screening`)."""

    draws: int = _effort(200, "1", "of noise, for the distribution of a candidate's gain")
    tail: int = _effort(10, "1", "draws beyond a gain from which its probability is a count; below it is extrapolated")
    own_run: float = _effort(
        150.0,
        "iterations",
        "for each moment of the run that a candidate without a tangent is screened by, after which it is set aside",
        "shipped phantom: 14 with adhesion, 25 with a base slip",
    )
    marker_folds: int = _effort(4, "1", "interleaved groups of markers that are left out one after another")
    doubt: float = _decides(
        6.0,
        "score",
        "most that a stated value can cost a candidate: it is wrong beyond its sigma once in twenty times",
        "chosen: -2 log 0.05",
    )
    mute: float = _decides(
        0.1,
        "1",
        "share of what one view says below which the other does not contradict",
        "blind test: what is constant is mute in time",
    )
    min_gap: float = _decides(
        9.0,
        "score",
        "by which one candidate has to be behind another to be told from it, odds of 90; of a proposed trajectory its "
        "root, the sigmas between the two",
        "blind test, sets",
    )
    gap_share: float = _decides(
        0.02,
        "1",
        "of the best gain by which it has to be behind: a model that is right within a few per cent",
        "blind test, sets",
    )


@dataclass(frozen=True)
class SelectionSettings:
    """Forward addition of effects (`ForwardSelection`)."""

    alpha: float = _decides(
        0.02,
        "1",
        "family-wise probability that a step accepts an effect that is not there",
        "blind test: 0 alarms of 60 on the toy body",
    )
    min_score: float = _decides(
        16.0,
        "score",
        "by which an effect that is accepted must predict unseen blocks better: odds of 3000",
        "blind test: 12 let none-39 and another have one",
    )
    effect_error: float = _decides(
        0.08,
        "1",
        "of what an added effect does that the model gets wrong: it looks like another effect",
        "blind test, pairs",
    )
    silent: float = _decides(
        0.5,
        "1",
        "of what an addition needs, below which prescreening ends the search",
        "evidence/blind-test, time",
    )
    one_by_one: float = _effort(
        0.5, "1", "share of the time budget for effects of a released body one by one; the rest is for them together"
    )
    look_again: float = _effort(
        0.1,
        "1",
        "of the best gain that a candidate must seem to have for its columns to be taken again",
        "evidence/blind-test, time",
    )
    leaders: int = _effort(
        4, "1", "candidates that are fitted through the nonlinear model", "evidence/blind-test, time"
    )
    lead_share: float = _effort(0.5, "1", "of the best gain that a leader has", "chosen")
    beginning: float = _effort(
        2.0, "1", "times the largest displacement, of the path in which columns of what rings tell something"
    )
    most: int = _effort(3, "1", "effects that are added, if nobody says how many", "interfaces: --max-effects 3")
    most_let_go: int = _effort(
        6,
        "1",
        "the same of a body that was let go: it rings, relaxes, is softer, was held; its loads pull late and rub",
        "silicone beam",
    )
    lead_share_no_tangent: float = _effort(0.2, "1", "the same where a tangent at zero says little", "chosen")
    first_runs: int = _effort(
        2,
        "1",
        "of the model for each leader, before those that have fallen behind are left",
        "evidence/blind-test, time",
    )
    behind: float = _effort(
        30.0, "gain", "by which a candidate has fallen behind, at least", "evidence/blind-test, time"
    )
    behind_share: float = _effort(
        0.2, "1", "of the best gain by which a candidate has fallen behind", "evidence/blind-test, time"
    )
    passes: int = _effort(
        3, "1", "over the refined mesh for an added effect, as long as that moves it by more than its sigma"
    )


@dataclass(frozen=True)
class VerdictSettings:
    """Numbers that decide whether there is something, and whether it is explained (`judge`)."""

    p_value: float = _decides(0.002, "1", "below which what is left is no chance", "toy body: 0 alarms of 60")
    min_excess: float = _decides(
        0.1, "1", "of the noise of a single frame that what is left must have to matter", "blind test, none"
    )
    min_explained: float = _decides(
        0.7,
        "1",
        "share of what a black box could take away that effects must, to be called the cause",
        "blind test, outside",
    )
    against: float = _decides(
        2.0,
        "chi2",
        "that effects may add to held-out data: odds of e against them",
        "blind test: a tether taken for three effects",
    )
    much: float = _decides(
        60.0,
        "gain",
        "where it was fitted that may show something, even if held-out data contradict the effects and are quiet",
        "blind test: elements gained 40 where nothing was missing",
    )
    matters: float = _decides(
        0.1,
        "1",
        "of the markers' rms motion by which an effect must move them for its size to matter (or by the experiment's "
        "threshold, if that is less)",
        "chosen: three to five times what the elements of the search get wrong",
    )
    power: float = _decides(
        0.95, "1", "with which a size that is called detectable would have been seen", "chosen: as intervals of 95 %"
    )
    stated_ratio: float = _effort(2.0, "1", "of variances, beyond which a note says that the stated noise is another")
    below_floor: float = _effort(4.0, "sigma", "by which an error may lie below the noise's before a note says so")
    usual_chi2: tuple[float, float] = _effort(
        (0.5, 2.0), "1", "chi2 per datum beyond which a note says that the noise, or what is allowed for, is off"
    )
    not_all: float = _effort(0.99, "1", "most that is said to be explained where something is known to be missed")
    there_always: float = _effort(0.7, "1", "of an error, from which a note says that it is there all the time")
    gains_nothing: float = _effort(
        1.0,
        "gain",
        "below which a candidate is not predicted on held-out data: every third parameter gains it from noise",
    )


@dataclass(frozen=True)
class DiscrepancySettings:
    """Numbers of what a flexible discrepancy could take away, and how it is described."""

    amplitudes: tuple[float, ...] = _effort((1e-5, 3e-5, 1e-4, 3e-4, 1e-3, 3e-3), "m", "prior scales that are tried")
    draws: int = _effort(200, "1", "of noise, for the distribution of its gain")
    pressed: float = _effort(0.2, "1", "share of the largest motion above which a block has a press")
    after: float = _effort(0.3, "1", "share of the largest motion below which a press is over")
    correlated: float = _effort(0.4, "1", "correlation above which a residual is said to go with something")
    steady: float = _effort(0.15, "1", "variation below which a residual is said to be there all the time")


@dataclass(frozen=True)
class ProposalSettings:
    """The next experiment: what a careful robot does, and when it tells two candidates apart."""

    speed: float = _effort(0.010, "m/s", "of a careful robot")
    fast: float = _effort(0.1, "m/s", "of a fast one")
    approach: float = _effort(0.005, "m", "above the surface, where a press begins")
    moments: int = _effort(14, "1", "key moments of a planned trajectory")
    side: float = _effort(0.2, "1", "of the body's width, to press off its centre")
    hold: float = _effort(6.0, "s", "for what relaxes")
    tilt: float = _effort(10.0, "deg", "of a tilted probe")
    wait: float = _effort(2.0, "s", "after a retreat")
    repeats: tuple[int, ...] = _effort((2, 4, 8, 16), "1", "of a recording, tried where it cannot tell")
    finer: tuple[float, ...] = _effort((0.5, 0.25), "1", "of the elements' size, tried there: their error goes with it")
    drag: tuple[float, float] = _effort((0.3, 0.7), "1", "of side and depth, for a press that slides")
    period: float = _effort(0.02, "s", "between two poses")
    patience: float = _effort(
        60.0,
        "iterations",
        "for each moment of a planned motion, after which it is set aside",
        "gelatin cuboid, under a flat probe that rubs: 7 to 29",
    )


@dataclass(frozen=True)
class BaselineSettings:
    """Simpler methods to compare with; never acted upon."""

    similar: float = _effort(0.5, "1", "cosine below which nobody would call two patterns alike")
    lengths: tuple[float, ...] = _effort(
        (0.25, 0.5, 1.0, 2.0), "1", "of the Gaussian process, in units of its inputs' spread"
    )
    ratios: tuple[float, ...] = _effort((0.1, 0.3, 1.0, 3.0), "1", "of the discrepancy's size to the noise's")
    most: int = _effort(1500, "1", "data of the Gaussian process")
    chosen_by: int = _effort(600, "1", "of these, by which its length and size are chosen")


@dataclass(frozen=True)
class Settings:
    """All of them."""

    sampling: SamplingSettings = SamplingSettings()
    noise: NoiseSettings = NoiseSettings()
    allowance: AllowanceSettings = AllowanceSettings()
    discretisation: DiscretisationSettings = DiscretisationSettings()
    fit: FitSettings = FitSettings()
    screening: ScreeningSettings = ScreeningSettings()
    selection: SelectionSettings = SelectionSettings()
    verdict: VerdictSettings = VerdictSettings()
    discrepancy: DiscrepancySettings = DiscrepancySettings()
    proposal: ProposalSettings = ProposalSettings()
    baselines: BaselineSettings = BaselineSettings()

    def as_dict(self) -> dict[str, dict[str, dict[str, Any]]]:
        """Return the record for a JSON file: part -> name -> value, role, unit, what it is for, where it was
        measured."""
        return {part.name: _part_as_dict(getattr(self, part.name)) for part in fields(self)}


def _part_as_dict(part: Any) -> dict[str, dict[str, Any]]:
    assert is_dataclass(part)
    return {f.name: {"value": getattr(part, f.name), **f.metadata} for f in fields(part)}


def n_deciding(settings: Settings) -> int:
    """Return how many numbers decide a verdict or size an allowance."""
    return sum(entry["role"] != "effort" for part in settings.as_dict().values() for entry in part.values())
