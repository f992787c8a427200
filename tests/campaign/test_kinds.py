"""Amplitudes of other things are told apart: other parameters, other places, other times."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("pyarrow")

from livedeform.campaign.evidence import KeptEvidence, Label, effect_of, in_common_units
from livedeform.campaign.jobs import ROW, Job
from livedeform.campaign.plan import CampaignRecording
from livedeform.campaign.pooling import PooledCampaign, pool_jobs, scopes_of
from livedeform.campaign.shared_causes import pool

ERROR = 0.05  # of a logarithm of a contrast


def kept(root: Path, name: str, contrast: float, place: float | None, *, phantom: str = "gel", **other: Any) -> Job:
    """A job that is done, whose diagnosis kept an inclusion of that contrast at x = ``place`` m (None: as before, when
    places were not kept), and nothing of a stiffness."""
    folder = root / name
    (folder / "diagnosis").mkdir(parents=True)
    (folder / ROW).write_bytes(b"")
    weight = np.array([1.0 / ERROR**2, 1.0 / ERROR**2])
    document: dict[str, Any] = {
        "G": np.diag(weight), "b": weight * [np.log(contrast), 0.0], "effect": ["inclusion", "stiffness"],
        "parameter": ["ratio", "ratio"], "index": [-1, -1], "sigma": [1.5, 0.7], "transform": ["log", "log"],
        "neutral": [1.0, 1.0],
    }  # fmt: skip
    if place is not None:
        document |= {
            "shape_effect": ["inclusion"] * 2, "shape_parameter": ["centre", "radius"], "shape_index": [0, -1],
            "shape_value": [place, 0.01], "shape_transform": ["linear", "log"], "shape_sigma": [0.05, 1.0],
            "shape_width": [0.08, 3.0],
        }  # fmt: skip
    np.savez(folder / "diagnosis" / "linearised.npz", **(document | other))
    recording = CampaignRecording(name=name, experiment=Path("e"), bag=Path("b"), phantom=phantom, rig="1")
    return Job(recording, folder)


def laboratory(root: Path, places: Sequence[float | None], **other: Any) -> list[Job]:
    """Takes of a gel with an inclusion at these places, beside gels without one."""
    takes = [kept(root, f"take-{k}", 4.0, place, **other) for k, place in enumerate(places)]
    return takes + [kept(root, f"p{k}", 1.0, 0.0, phantom=f"p{k}") for k in range(5)]


def shared(found: PooledCampaign) -> list[tuple[str, int]]:
    return [(cause["effect"], cause["n_members"]) for cause in found.shared]


def test_inclusions_at_one_place_are_one_and_at_others_are_not(tmp_path: Path) -> None:
    """Four takes with the same contrast at four corners of the body were "inclusion in 4 of 4"."""
    near = pool_jobs(laboratory(tmp_path / "near", [0.02, 0.021, 0.019, 0.02]), tmp_path)
    assert shared(near) == [("inclusion", 4)]
    at = {place["name"]: place["value"] for place in near.shared[0]["at"]}
    assert at == pytest.approx({"centre[0]": 0.02, "radius": 0.01})
    assert near.shared[0]["said"][1:] == ["at centre[0] 0.02 m", "at radius 0.01 m"]
    apart = pool_jobs(laboratory(tmp_path / "apart", [0.0, 0.03, 0.06, -0.03]), tmp_path)
    assert shared(apart) == []
    own = json.loads((tmp_path / "shared.json").read_text())["own"]
    assert {name: causes[0]["effect"] for name, causes in own.items()} == {f"take-{k}": "inclusion" for k in range(4)}
    assert own["take-1"][0]["at"][0] == {"name": "centre[0]", "value": 0.03}
    assert own["take-1"][0]["parameters"][0]["value"] == pytest.approx(4.0, rel=0.02)


def test_what_did_not_say_its_place_is_pooled_as_before(tmp_path: Path) -> None:
    assert shared(pool_jobs(laboratory(tmp_path, [None] * 4), tmp_path)) == [("inclusion", 4)]


def relaxing(name: str, parameters: Sequence[str]) -> KeptEvidence:
    """A recording of which nothing but a relaxation is asked, by amplitudes of these names."""
    n = len(parameters)
    labels = {"viscoelasticity": tuple(Label(p, k, 0.3, "linear", 0.0) for k, p in enumerate(parameters))}
    columns = {"viscoelasticity": np.arange(n)}
    return KeptEvidence(name, name, "1", 100.0 * np.eye(n), 100.0 * np.ones(n), columns, labels)


def test_another_number_of_terms_is_another_kind_with_causes_of_its_own() -> None:
    """One of three recordings had two terms: nothing was left of it, and the campaign ended in a division by zero."""
    for parameters in (("g",), ("g", "g", "g"), ("strength", "held")):
        evidence = in_common_units([relaxing("a", parameters), *(relaxing(k, ("g", "g")) for k in ("b", "c"))])
        kinds = [next(iter(e.columns)) for e in evidence]
        assert kinds[1] == kinds[2] == "viscoelasticity" != kinds[0] and effect_of(kinds[0]) == "viscoelasticity"
        found = pool(evidence, scopes_of(evidence))
        assert found.explanations["a"].own == (kinds[0],)
        assert [set(s.members) for s in found.named] == [{"b", "c"}]


@pytest.mark.parametrize("how", ["torn", "empty", "labels"])
def test_kept_evidence_that_cannot_be_read_is_named_and_the_rest_is_pooled(tmp_path: Path, how: str) -> None:
    """One torn file ended a whole campaign with a traceback, after all was done, and without a page."""
    jobs = laboratory(tmp_path, [0.02] * 5)
    file = jobs[0].folder / "diagnosis" / "linearised.npz"
    if how == "labels":  # as diagnoses wrote several terms before
        with np.load(file) as whole:
            np.savez(file, **{**whole, "G": np.eye(3), "b": np.ones(3)})
    else:
        file.write_bytes(file.read_bytes()[: 0 if how == "empty" else -200])
    found = pool_jobs(jobs, tmp_path)
    assert shared(found) == [("inclusion", 4)]
    assert list(found.left_out) == ["take-0"] and "linearised.npz: cannot be read" in found.left_out["take-0"]
    assert json.loads((tmp_path / "shared.json").read_text())["left_out"] == found.left_out
