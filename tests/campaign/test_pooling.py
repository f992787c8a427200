"""Shared causes and own ones, from what diagnoses keep."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("pyarrow")

from benchmarks.pooling import SHARED, judge, laboratory, phantom

from livedeform.campaign.evidence import KeptEvidence, Label, in_common_units
from livedeform.campaign.jobs import ROW, Job
from livedeform.campaign.plan import CampaignRecording
from livedeform.campaign.pooling import pool_jobs, scopes_of
from livedeform.campaign.row import interval_words
from livedeform.campaign.shared_causes import Scatters, pool, random_effects
from livedeform.closed_loop.candidates import TRANSFORMS


def evidence(seed: int = 0, p: int = 4, name: str = "a") -> KeptEvidence:
    rng = np.random.default_rng(seed)
    J = rng.standard_normal((30, p))
    b = J.T @ (J @ np.array([1.0, 0.0, -2.0, 0.5])[:p] + rng.standard_normal(30))
    columns = {"one": np.array([0]), "two": np.array([1, 2]), "three": np.array([3])}
    labels = {k: tuple(Label("x", -1, 1.0, "linear", 0.0) for _ in at) for k, at in columns.items()}
    return KeptEvidence(name, name, "rig", J.T @ J, b, columns, labels)


def test_an_effect_integrates_out_as_a_gaussian_does() -> None:
    """Evidence of all effects together: log N(b; G m, G V G + G) - log N(b; 0, G), whatever the order."""
    e = evidence()
    mean, variance = np.array([0.3, 0.0, 0.0, -1.0]), np.array([0.5, 1.0, 1.0, 0.2])
    steps = {"one": (0.3, 0.5), "two": (0.0, 1.0), "three": (-1.0, 0.2)}

    def log_density(mu: np.ndarray, C: np.ndarray) -> float:
        r = e.b - mu
        return float(-0.5 * r @ np.linalg.solve(C, r) - 0.5 * np.linalg.slogdet(C)[1])

    expected = log_density(e.G @ mean, e.G @ np.diag(variance) @ e.G + e.G) - log_density(np.zeros(4), e.G)
    for order in (("one", "two", "three"), ("three", "two", "one")):
        rest = e
        for effect in order:
            rest = rest.given(effect, *steps[effect])
        assert rest.gain == pytest.approx(expected, rel=1e-9)
    assert e.own_gains() == pytest.approx({k: e.gain_of(k) for k in e.columns})


def test_values_and_variances_are_those_of_least_squares_beside_the_others() -> None:
    e = evidence()
    value, variance = e.given("two", 0.0, 1e9).given("three", 0.0, 1e9).told("one")
    assert value[0] == pytest.approx(np.linalg.solve(e.G, e.b)[0], rel=1e-5)
    assert variance[0] == pytest.approx(np.linalg.inv(e.G)[0, 0], rel=1e-5)


def test_scatter_between_takes_goes_into_the_interval() -> None:
    rng = np.random.default_rng(1)
    n, own, between = 400, 0.1, 0.3
    values = 1.0 + rng.normal(0.0, np.hypot(own, between), (n, 1))
    value, variance, scatter = random_effects(values, np.full((n, 1), own**2), 0.0)
    assert scatter[0] == pytest.approx(between, rel=0.1)
    assert variance[0] == pytest.approx((own**2 + between**2) / n, rel=0.2)
    assert abs(value[0] - 1.0) < 3.0 * np.sqrt(variance[0])


@pytest.mark.parametrize("m", [2, 3, 5, 10])
@pytest.mark.parametrize("between", [0.0, 0.1, 0.3])
def test_intervals_of_repeats_hold_what_they_promise(m: int, between: float) -> None:
    """Of 400 sets of ``m`` takes: the common value lies in nine of ten intervals of 95 %, though a few takes hardly
    tell how far takes lie apart (measured 0.91 to 1.00; with the estimated scatter alone, 0.78 for two takes)."""
    rng = np.random.default_rng(7)
    own, n = 0.1, 400
    sets = 1.0 + rng.normal(0.0, np.hypot(own, between), (n, m))
    value = random_effects(sets.T, np.full((m, n), own**2), 0.05)[0]
    scatters = Scatters.of(sets.T, np.full((m, n), own**2), value, 0.05)
    variance = scatters.variance_about(value)
    assert np.mean(np.abs(value - 1.0) < 1.96 * np.sqrt(variance)) > 0.9
    assert np.median(np.sqrt(variance)) < 3.0 * np.hypot(own, between) / np.sqrt(m)
    another = 1.0 + rng.normal(0.0, between, (50, n))
    assert np.mean(np.abs(another - value) < scatters.next_within(value)) > 0.88  # measured 0.90 to 1.00; 0.59 before


def test_a_shared_scale_error_is_named_and_its_members_are() -> None:
    """One laboratory of 50; `python -m benchmarks.pooling` has the rates over 20."""
    found, truths = laboratory(0)
    pooled = pool(found, scopes_of(found))
    row = judge(pooled, truths)
    assert row["shared"]
    assert row["members"] >= 0.95  # measured 1.00
    assert row["own"] >= 0.90  # measured 0.96
    scale = pooled.named[0]
    assert abs(scale.value[0] - SHARED) < 4.0 * np.sqrt(scale.variance[0])


def test_without_a_shared_cause_none_is_named() -> None:
    found, _ = laboratory(1, n=20, n_shared=0)
    assert pool(found, scopes_of(found)).named == []


def test_of_one_phantom_what_measures_is_the_rigs_and_the_rest_is_the_phantoms() -> None:
    takes = [replace(e, phantom="gel") for e in laboratory(2, n=3)[0]]
    by_name = {scope.where: scope.effects for scope in scopes_of(takes)}
    assert {"stereo_scale", "camera_motion", "probe_offset"} <= by_name["rig rig"]
    assert {"stiffness", "skin"} <= by_name["phantom gel"]
    assert not by_name["rig rig"] & by_name["phantom gel"]


def test_takes_of_one_phantom_share_its_own_cause() -> None:
    """Three takes of one of eight phantoms have the same stiffness, and the camera is off in some of all."""
    rng = np.random.default_rng(5)
    takes = []
    for i in range(8):
        for k in range(3):
            truth = {"stiffness": np.array([1.5])} if i == 3 else {}
            if (i + k) % 3:
                truth["stereo_scale"] = np.array([SHARED])
            takes.append(replace(phantom(f"p{i}/take-{k}", truth, rng), phantom=f"p{i}"))
    found = {(s.where, s.effect): set(s.members) for s in pool(takes, scopes_of(takes)).named}
    assert found == {
        ("rig rig", "stereo_scale"): {e.name for e in takes if (int(e.name[1]) + int(e.name[-1])) % 3},
        ("phantom p3", "stiffness"): {f"p3/take-{k}" for k in range(3)},
    }


def test_what_all_takes_of_one_phantom_have_is_its_own_among_few_recordings() -> None:
    """Three of eight recordings of a rig, all of one phantom: choosing three of eight costs so little that the rig's
    recordings share the cause just as well."""
    rng = np.random.default_rng(6)
    takes = []
    for k in range(8):
        name = "gel" if k < 3 else f"other-{k % 2}"
        truth = {"stereo_scale": np.array([SHARED])} | ({"stiffness": np.array([1.8])} if k < 3 else {})
        takes.append(replace(phantom(f"{name}/take-{k}", truth, rng), phantom=name))
    found = {(s.where, s.effect): len(s.members) for s in pool(takes, scopes_of(takes)).named}
    assert found == {("rig rig", "stereo_scale"): 8, ("phantom gel", "stiffness"): 3}


MU, PRIOR, RELATIVE = 0.3, 0.5, 0.02  # a friction, its prior's sigma and what single recordings know it to


def kept(
    root: Path, name: str, phantom: str, values: Mapping[str, tuple[float, float, float]], of: float = np.nan
) -> Job:
    """A job that is done, whose diagnosis kept of each effect its value, the error of that and what is declared; a
    ratio is ``of`` what is declared."""
    folder = root / name
    (folder / "diagnosis").mkdir(parents=True)
    (folder / ROW).write_bytes(b"")
    columns = {"stiffness": ("ratio", 0.7, "log"), "probe_friction": ("mu", PRIOR, "linear")}
    z = {x: TRANSFORMS[columns[x][2]][0](v) - TRANSFORMS[columns[x][2]][0](at) for x, (v, _, at) in values.items()}
    weight = np.array([1.0 / error**2 for _, error, _ in values.values()])
    np.savez(
        folder / "diagnosis" / "linearised.npz", G=np.diag(weight), b=weight * list(z.values()), effect=list(values),
        parameter=[columns[x][0] for x in values], index=[-1] * len(values), sigma=[columns[x][1] for x in values],
        transform=[columns[x][2] for x in values], neutral=[at for _, _, at in values.values()],
        **({"of": [of] * len(values)} if np.isfinite(of) else {}),
    )  # fmt: skip
    recording = CampaignRecording(name=name, experiment=Path("e"), bag=Path("b"), phantom=phantom, rig="1")
    return Job(recording, folder)


def pooled(jobs: Sequence[Job], out: Path) -> dict[str, Any]:
    pool_jobs(jobs, out)
    return dict(json.loads((out / "shared.json").read_text()))


@pytest.mark.parametrize(("ratio", "error"), [(1.5, 0.05), (2.0, 0.2), (0.6, 0.1)])
def test_a_cause_of_its_own_has_the_value_that_the_recording_tells(tmp_path: Path, ratio: float, error: float) -> None:
    """With the prior N(0, 0.7^2) of the logarithm; it was written as 1.002 for 1.5 +- 5 %, 1.05 for 2 +- 20 %."""
    jobs = [kept(tmp_path, "a", "a", {"stiffness": (ratio, error, 1.0)})]
    jobs += [kept(tmp_path, name, name, {"stiffness": (1.0, 0.05, 1.0)}) for name in ("b", "c", "d")]
    (cause,) = pooled(jobs, tmp_path)["own"]["a"]
    (found,) = cause["parameters"]
    variance = 1.0 / (1.0 / error**2 + 1.0 / 0.7**2)
    mean = np.log(ratio) / error**2 * variance
    assert found["value"] == pytest.approx(np.exp(mean), rel=1e-6)
    assert found["interval_95"] == pytest.approx(np.exp(mean + 1.96 * np.sqrt(variance) * np.array([-1.0, 1.0])))


@pytest.mark.parametrize("elsewhere", [(), (0, 1), (6, 7), range(4), range(7)])
def test_a_shared_value_is_the_same_whatever_is_declared(tmp_path: Path, elsewhere: Sequence[int]) -> None:
    """Eight recordings rub by 0.3, some of which are declared with 0.2: two of them first made it 0.50 in the other
    six. Two that rub by 0.5 beside six without friction have causes of their own at that, whatever they declare."""
    rng = np.random.default_rng(0)
    for mu, folder in ((MU, tmp_path / "all"), (0.5, tmp_path / "one")):
        jobs = []
        for i in range(8):
            truth = mu if i == 0 or folder.name == "all" else 0.0
            declared = 0.2 if i in elsewhere and truth else 0.0
            told = truth + RELATIVE * rng.normal()
            jobs.append(kept(folder, f"p{i}", f"p{i}", {"probe_friction": (told, RELATIVE, declared)}))
        said = pooled(jobs, folder)
        values = [p["value"] for cause in said["shared"] for p in cause["parameters"]]
        own = {name: causes[0]["parameters"][0]["value"] for name, causes in said["own"].items()}
        if folder.name == "all":
            assert [cause["n_members"] for cause in said["shared"]] == [8]
            assert values == pytest.approx([mu], abs=0.03)  # measured 0.007
        else:
            assert not values and own == pytest.approx({"p0": mu}, abs=0.06)  # measured 0.015


@pytest.mark.parametrize("declared", [(4000.0, 5000.0, 16000.0), (4000.0, 16000.0)])
def test_ratios_to_other_declared_moduli_are_of_the_same_gel(tmp_path: Path, declared: Sequence[float]) -> None:
    """A gel of 8 kPa, declared in two or three ways, had no cause in common, and twice of 4 and twice of 8 kPa one."""
    moduli = {f"{e:.0f}-{k}": e for e in declared for k in range(3)}
    gel = [kept(tmp_path / "gel", name, "gel", {"stiffness": (8000.0 / e, 0.03, 1.0)}, e) for name, e in moduli.items()]
    right = [kept(tmp_path / "gel", f"p{k}", f"p{k}", {"stiffness": (1.0, 0.03, 1.0)}, 4000.0) for k in range(5)]
    (cause,) = pooled(gel + right, tmp_path / "gel")["shared"]
    (ratio,) = cause["parameters"]
    assert cause["n_members"] == len(gel)
    assert (ratio["value"], ratio["of"]) == (pytest.approx(2.0, rel=0.02), 4000.0)
    assert cause["said"][0].endswith(" of 4000")
    twice = [kept(tmp_path / "two", name, "gel", {"stiffness": (2.0, 0.03, 1.0)}, e) for name, e in moduli.items()]
    assert all(both["n_members"] < len(twice) for both in pooled(twice, tmp_path / "two")["shared"])


def test_in_common_units_a_recording_says_what_it_said() -> None:
    """Odds between two values of an effect do not change with the units and the neutral value that others have."""
    own = evidence(3, name="own")
    labels = {x: tuple(Label("x", k, 0.5, "log", 2.0) for k, _ in enumerate(own.labels[x])) for x in own.labels}
    wide = {x: tuple(Label("x", k, 2.0, "log", 3.0) for k, _ in enumerate(own.labels[x])) for x in own.labels}
    many = [replace(evidence(k, name=f"{k}"), labels=wide) for k in range(2)]
    other = in_common_units([replace(own, labels=labels), *many])[0]
    for value, effect in ((2.5, "two"), (1.2, "one")):
        x, y = (np.log(value / n) / s for n, s in ((2.0, 0.5), (3.0, 2.0)))
        assert other.gain_of(effect, y, 1e-12) == pytest.approx(own.gain_of(effect, x, 1e-12), rel=1e-6)
        assert other.given(effect, y, 0.01 / 16).gain == pytest.approx(own.given(effect, x, 0.01).gain, rel=1e-6)
        back = [label.value(v) for label, v in zip(other.labels[effect], other.told(effect)[0], strict=True)]
        assert back == pytest.approx(2.0 * np.exp(0.5 * own.told(effect)[0]))


def test_copies_of_a_recording_are_no_further_takes(tmp_path: Path) -> None:
    """Three copies of the one recording that is 1.4 times stiffer were a shared cause of "3 of 5"."""
    one, *rest = (kept(tmp_path, n, n, {"stiffness": (r, 0.05, 1.0)}) for n, r in (("a", 1.4), ("b", 1.0), ("c", 1.0)))
    names = ("a-backup", "a-old")
    copies = [Job(one.recording.model_copy(update={"name": n, "phantom": n}), one.folder) for n in names]
    once, thrice = (pooled(jobs, tmp_path) for jobs in ([one, *rest], [one, *rest, *copies]))
    assert once == thrice and once["shared"] == [] and list(once["own"]) == ["a"]


def test_an_interval_of_a_spring_ends_where_it_is_rigid() -> None:
    """A compliance of 1 +- 1 in sigmas may be none: no end, where a negative stiffness was the lower one."""
    label = Label("stiffness", -1, 1e-5, "inverse", np.inf)
    assert [label.value(x) for x in (2.96, 1.0, -0.96)] == pytest.approx([1e5 / 2.96, 1e5, np.inf])
    assert interval_words(1e5, label.value(2.96), label.value(-0.96)) == "1e+05 [3.38e+04, inf]"
