"""All that a diagnosis shows comes from the same residuals: headline, tiles, curves, bars, tabs, JSON and terminal."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import page_data
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "closed_loop"))

import toy
import toy_loop as loop

from livedeform.closed_loop.assessment.held_out import errors_of
from livedeform.closed_loop.assessment.next_experiment import ProbeReach
from livedeform.closed_loop.candidates import all_effects
from livedeform.closed_loop.diagnosis import Diagnosis
from livedeform.closed_loop.evidence.observation import Observation
from livedeform.closed_loop.forward import Column, Run
from livedeform.closed_loop.inputs import Inputs
from livedeform.closed_loop.loop import investigate
from livedeform.closed_loop.settings import Settings
from livedeform.closed_loop.write import as_json
from livedeform.commands.summary import tell_diagnosis
from livedeform.common.types import EffectValues
from livedeform.fem_node.mesh.structured import hemi_ellipsoid_mesh
from livedeform.report.diagnosis import collect
from livedeform.report.diagnosis import page as diagnosis_page
from livedeform.report.diagnosis.evidence import RestingBody
from livedeform.report.run.evidence import SurfaceMesh

OFF = np.array([2e-4, -1e-4, 3e-4])  # m, by which the cameras were registered wrongly: to another rest
RELAXING = toy.effect("viscoelasticity", g=[0.3], tau=[2.0])
NAMES = ("viscoelasticity", "gravity_tilt", "poisson_ratio")


@dataclass
class Failing(toy.ToyModel):
    """Finds no equilibrium in the first press of what was held out once it has an effect."""

    def run(
        self, effects: Sequence[EffectValues], observations: Sequence[Observation], columns: Sequence[Column] = ()
    ) -> list[Run]:
        runs = super().run(effects, observations, columns)
        for o, run in zip(observations, runs, strict=True):
            if effects and o.name == "test":
                run.points[3:6] = np.nan
        return runs


def diagnosed(
    effects: list[EffectValues],
    *,
    model: Callable[[toy.ToyBody], toy.ToyModel] = toy.ToyModel,
    detail: float = 0.0,
    sigma: float = 1e-4,
    names: Sequence[str] = NAMES,
    settings: Settings = toy.SETTINGS,
) -> Diagnosis:
    """The whole method on two held-out recordings whose cameras were registered to the declared model's rest."""
    body = toy.ToyBody(loop.PLACES, detail)
    fit = toy.record(effects, seed=0, body=body, name="fit", n=30, sigma=sigma)
    tests = [
        toy.record(effects, seed=s, body=body, name=name, n=20, sigma=sigma) for s, name in ((7, "test"), (8, "again"))
    ]
    declared = SimpleNamespace(stereo=SimpleNamespace(pose="registered"), thresholds=SimpleNamespace(error=0.005))
    inputs = Inputs(
        fitted=(fit,),
        held_out=tuple(replace(o, points=o.points + OFF, single=o.single + OFF) for o in tests),
        candidates=toy.candidates(loop.PLACES, names),
        uncertain=toy.uncertain(loop.PLACES),
        places=loop.PLACES,
        settings=settings,
        reach=ProbeReach(loop.LOWER, loop.UPPER, fit.path[0], 0.008),
        experiment=declared,  # type: ignore[arg-type]  # no more of it is asked
    )
    return investigate(model(toy.ToyBody(loop.PLACES)), inputs)


def body(_: object) -> RestingBody:
    mesh = hemi_ellipsoid_mesh((0.05, 0.05, 0.05), 4)
    triangles = np.searchsorted(mesh.boundary_nodes, mesh.boundary_triangles)
    ids = np.arange(len(loop.PLACES), dtype=np.uint32)
    return RestingBody(SurfaceMesh(mesh.nodes[mesh.boundary_nodes], triangles), ids, loop.PLACES)


@dataclass(frozen=True)
class Shown:
    """A diagnosis as JSON, page and terminal show it."""

    result: Diagnosis
    document: dict[str, Any]
    html: str
    terminal: str


@pytest.fixture(scope="module")
def show(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Diagnosis], Shown]:
    known: dict[int, Shown] = {}

    def shown(result: Diagnosis) -> Shown:
        if id(result) not in known:
            out, lines = tmp_path_factory.mktemp("page"), []
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(collect, "body_at_rest", body)
                patch.setattr("typer.echo", lambda text="", **_: lines.append(str(text)))
                page = diagnosis_page.write_report(out, result, SimpleNamespace(name="toy"))  # type: ignore[arg-type]
                tell_diagnosis(result, out)
            document = json.loads(json.dumps(as_json(result)))
            known[id(result)] = Shown(result, document, page.read_text(), "\n".join(lines))
        return known[id(result)]

    return shown


@pytest.fixture(scope="module")
def traced() -> Diagnosis:
    return diagnosed([RELAXING])


@pytest.fixture(scope="module")
def lossy() -> Diagnosis:
    return diagnosed([RELAXING], model=Failing)


@pytest.fixture(scope="module")
def hasty() -> Diagnosis:
    never = replace(toy.SETTINGS.fit, tolerance=0.0)  # a step always promises more than nothing
    return diagnosed([RELAXING], settings=replace(toy.SETTINGS, fit=never), names=("viscoelasticity",))


@pytest.fixture(scope="module")
def nothing() -> Diagnosis:
    return diagnosed([])


@pytest.fixture(scope="module")
def unexplained() -> Diagnosis:
    return diagnosed([], detail=0.05, sigma=5e-5, names=("stiffness", "viscoelasticity"))


EVERY = ("traced", "lossy", "hasty", "nothing", "unexplained")


@pytest.fixture(params=EVERY)
def shown(request: pytest.FixtureRequest, show: Callable[[Diagnosis], Shown]) -> Shown:
    return show(request.getfixturevalue(request.param))


def test_the_cases_are_what_they_are_called(traced, nothing, unexplained):
    assert (traced.verdict, nothing.verdict, unexplained.verdict) == ("effect", "none", "unexplained")
    assert traced.effects[0].name == "viscoelasticity"
    assert traced.after.rmse < 0.9 * traced.before.rmse


def test_registration_matters_here(traced):
    """Without it the same frames show another error: figures that forget it cannot agree with the headline."""
    runs = [Run(r.predicted, None, np.zeros((*r.predicted.shape, 0)), None) for r in traced.errors_after.recordings]
    bare = errors_of(traced.held_out, runs).metrics().rmse
    assert bare > 1.3 * traced.after.rmse


@pytest.mark.parametrize("which", ["before", "after"])
def test_every_figure_has_the_rms_of_the_headline(shown: Shown, which: str):
    rmse = 1e3 * shown.document[f"error_{which}"]["rmse"]
    charts = page_data.charts(shown.html)
    curves = [
        t for name, traces in charts.items() if name.startswith("over-time") for t in traces if t["name"] == which
    ]
    assert len(curves) == 2
    y, w = (np.concatenate([page_data.numbers(t[key]) for t in curves]) for key in ("y", "customdata"))
    assert page_data.pooled(y, w) == pytest.approx(rmse, rel=1e-9)
    (bars,) = [t for t in charts["per-marker"] if t["name"] == which]
    seconds = page_data.numbers(bars["customdata"])
    assert page_data.pooled(page_data.numbers(bars["y"]), seconds) == pytest.approx(rmse, rel=1e-9)
    assert seconds.sum() == pytest.approx(w.sum())
    (dots,) = [t for t in charts["on-surface"] if t["meta"] == which and "customdata" in t]
    ids, sizes = page_data.numbers(dots["customdata"]).T
    assert [str(int(i)) for i in ids] == bars["x"]
    assert page_data.pooled(sizes, seconds) == pytest.approx(rmse, rel=1e-9)


def test_before_and_after_are_of_the_same_data(shown: Shown):
    before, after = shown.document["error_before"], shown.document["error_after"]
    assert before["n"] == after["n"] == int(page_data.tiles(shown.html)["held-out errors"])
    sizes = shown.result.errors_before.size, shown.result.errors_after.size
    assert np.array_equal(*map(np.isfinite, sizes))
    assert f"{after['n']} errors" in shown.terminal


def test_tiles_sentence_and_terminal_say_the_numbers_of_the_file(shown: Shown):
    d, tiles = shown.document, page_data.tiles(shown.html)
    _, headline, because = page_data.said(shown.html)
    before, after, floor = d["error_before"]["rmse"], d["error_after"]["rmse"], d["noise_floor"]
    for name, value in (("rmse before", before), ("rmse after", after), ("measuring noise", floor)):
        decimals = len(tiles[name].split(".")[1])
        assert tiles[name] == f"{1e3 * value:.{decimals}f}"
        assert len(tiles[name].replace(".", "").lstrip("0")) >= 2  # 0.02 for 0.015 and 0.024 says nothing
    assert f"{tiles['rmse before']} mm" in because and f"{tiles['measuring noise']} mm" in because
    assert f"rmse_mm before {1e3 * before:.3f}, after {1e3 * after:.3f}" in shown.terminal
    assert f"noise_mm {1e3 * floor:.3f}" in shown.terminal
    assert headline == shown.result.headline and headline in shown.terminal
    assert d["unexplained"] in shown.terminal


def test_the_explained_share_is_said_once(shown: Shown):
    """Tile, sentence and JSON: the same share, or none of them has one."""
    tile = page_data.tiles(shown.html)["explained"]
    told = re.findall(r"(-?\d+) % of the evidence", shown.document["unexplained"])
    share = shown.document["explained"]
    assert told == ([] if share is None else [f"{100 * share:.0f}"])
    assert tile == (told[0] if told else "–")


def test_the_ranking_says_the_error_of_the_fitted_model(traced):
    alone = next(r for r in traced.ranking if r.name == "viscoelasticity")
    assert len(traced.effects) == 1
    assert alone.test_rmse == pytest.approx(traced.after.rmse, rel=1e-12)


@pytest.mark.parametrize("case", ["lossy", "hasty"])
def test_doubts_are_in_the_headline(case: str, request: pytest.FixtureRequest, show: Callable[[Diagnosis], Shown]):
    """A moment that was left out and a fit that has not settled: no green tick, and the reason where it is read."""
    shown = show(request.getfixturevalue(case))
    word = {"lossy": "held-out moments are left out", "hasty": "the fit had not settled"}[case]
    (doubt,) = [d for d in shown.document["doubts"] if word in d]
    tone, headline, because = page_data.said(shown.html)
    assert tone != "good" and headline.endswith("with doubts")
    assert doubt[1:] in because and f"doubt: {doubt}" in shown.terminal


def test_without_doubts_the_headline_has_none(traced, show):
    tone, headline, _ = page_data.said(show(traced).html)
    assert not traced.doubts and tone == "good" and headline == "Traced to viscoelasticity"


def test_the_page_says_the_noise_of_each_recording(shown: Shown):
    card = shown.html.split("Noise of each recording")[1].split("</section>")[0]
    rows = re.findall(r"<tr>\s*<td[^>]*>(.*?)</td><td[^>]*>(.*?)</td>", card)
    assert rows == [("fit", "fitted"), ("test", "held out"), ("again", "held out")]


def test_page_and_terminal_give_values_with_sigmas_and_units(
    show: Callable[[Diagnosis], Shown], traced: Diagnosis
) -> None:
    shown = show(traced)
    for effect in shown.document["effects"]:
        info = all_effects()[effect["name"]]
        for name, entry in effect["parameters"].items():
            said = f"{name} = {info.in_words(name, entry['value'], entry['sigma'])}"
            assert said in shown.terminal and said in shown.html and "±" in said
    assert " s" in info.in_words("tau", [2.0]) and info.in_words("g", [0.3, 0.1]) == "(0.3, 0.1)"
