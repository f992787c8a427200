"""Every published effect is a candidate, and coordinates go there and back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import toy

from livedeform.closed_loop.candidates import Candidate, all_effects, catalogue, check_known, doubt, narrowed
from livedeform.closed_loop.forward import dictionary_columns
from livedeform.closed_loop.inference.forward_selection import entries_of
from livedeform.common.effect import EFFECT_PARAMETERS
from livedeform.common.errors import InputError
from livedeform.fem_node.effects import inclusion

AROUND = replace(toy.surroundings(toy.markers()), internal=True, has_cameras=True, has_release=True, has_loads=True)


def test_all_published_effects_are_there_with_their_parameters():
    infos = all_effects()
    assert {n: {p.name: p.size for p in i.parameters} for n, i in infos.items()} == EFFECT_PARAMETERS
    tracked = replace(AROUND, has_cameras=False)  # no cameras that are registered to the markers at rest
    assert set(catalogue(AROUND)) | set(catalogue(tracked)) == set(EFFECT_PARAMETERS)
    for info in infos.values():
        assert info.equation and info.source and info.summary and info.shown_by


@pytest.mark.parametrize("name", sorted(EFFECT_PARAMETERS))
def test_coordinates_go_there_and_back(name):
    found = catalogue(AROUND, [name]) or catalogue(replace(AROUND, has_cameras=False), [name])
    candidate = found[name]
    for shape in candidate.shapes:
        z = shape + 0.3 * candidate.array("step")
        values = candidate.values(z)
        assert set(values.values) == set(EFFECT_PARAMETERS[name])
        assert candidate.coordinates_of(values.values) == pytest.approx(z, rel=1e-9, abs=1e-12)
        sigmas = candidate.sigmas(z, np.diag(candidate.array("step") ** 2))
        assert all(np.shape(sigmas[k]) == np.shape(v) for k, v in values.values.items())


def of_shape(name: str, **values: float) -> tuple[Candidate, np.ndarray]:
    """A candidate and its coordinates, a ball's in the middle of the body."""
    candidate = catalogue(AROUND, [name])[name]
    return candidate, candidate.coordinates_of(
        {"centre": np.full(3, 0.02), **{k: np.array(v) for k, v in values.items()}}
    )


BALLS = {"radius": 0.0097, "ratio": 2.1}, {"radius": 0.0068, "ratio": 9.1}
SOFT_BALLS = {"radius": 0.0097, "ratio": 0.6}, {"radius": 0.012, "ratio": 0.8}
LAYERS = {"thickness": 0.002, "ratio": 5.0}, {"thickness": 0.006, "ratio": 2.0}


@pytest.mark.parametrize(
    ("name", "ends"), [("inclusion", BALLS), ("inclusion", BALLS[::-1]), ("inclusion", SOFT_BALLS), ("skin", LAYERS)]
)
def test_what_follows_a_length_and_an_amplitude_together_is_carried_along_their_line(name, ends):
    """A number that is linear in what they make and in the logarithm of the length, by its derivatives at one end."""
    (candidate, before), (_, after) = (of_shape(name, **values) for values in ends)
    made = candidate.info.together.of
    length = next(p.name for p in candidate.parameters if p.unit == "m" and p.size is None)

    def number(z: np.ndarray) -> float:
        values = candidate.values(z).values
        return float(made(values) / made(ends[0]) + 0.1 * np.log(values[length]))

    def slope(z: np.ndarray) -> np.ndarray:
        return np.array([(number(z + d) - number(z - d)) / 2e-5 for d in 1e-5 * np.eye(len(z))])

    step, turn = candidate.carried(before, after)
    assert number(before) + slope(before) @ step == pytest.approx(number(after), rel=1e-6)
    assert slope(before) @ turn == pytest.approx(slope(after), rel=1e-5, abs=1e-7)
    along = number(after) - number(before) - slope(before) @ (after - before)
    assert abs(along) > 0.05 * abs(number(before))  # it is not linear in the coordinates


def test_an_amplitude_goes_with_what_it_makes_together_with_a_length():
    """Of a ball of which only that is known, half as large again is a ratio of 1.3, two thirds as large too small."""
    candidate, z = of_shape("inclusion", radius=0.01, ratio=2.5)
    known = np.array([1e-3, 1e-3, 1e-3, np.log(1.5) / 1.96, 1e-9])  # of the radius, and of what they make
    G = np.eye(5)
    G[4] = [0.0, 0.0, 0.0, 3.0 * 0.375, 2.5 * 2.5 / 4.0**2]  # of radius^3 (ratio - 1) / (ratio + 1.5)
    inverse = np.linalg.inv(G)
    ends = candidate.intervals(z, inverse @ np.diag(known**2) @ inverse.T, 1.96)
    assert ends["radius"] == pytest.approx([0.01 / 1.5, 0.015])
    share = 0.375 / 1.5**3
    assert ends["ratio"][0] == pytest.approx((1.0 + 1.5 * share) / (1.0 - share), rel=0.01)  # 1.31
    assert ends["ratio"][1] == pytest.approx(50.0)  # smaller than 0.0073 m it would have to be rigid
    sure = np.diag([1e-3, 1e-3, 1e-3, 1e-6, 0.1]) ** 2
    assert candidate.intervals(z, sure, 1.96)["ratio"] == pytest.approx(
        2.5 * np.exp([-0.196, 0.196]), rel=0.05
    )  # measured 0.03


def test_zero_is_the_declared_model():
    for candidate in catalogue(AROUND).values():
        for c in candidate.coordinates:
            if c.amplitude:
                assert c.value(0.0) == pytest.approx(c.neutral)
                assert c.lower <= 1e-9 and c.upper >= 0.0


def test_effects_without_their_object_are_no_candidates():
    bare = catalogue(replace(AROUND, has_probe=False, internal=False, has_cameras=False, has_release=False))
    assert not {"probe_friction", "probe_offset", "time_offset", "refraction", "inertia"} & set(bare)
    assert {"stiffness", "viscoelasticity", "gravity_tilt"} <= set(bare)
    with pytest.raises(InputError, match="unknown effect"):
        catalogue(AROUND, ["magic"])
    with pytest.raises(InputError, match="did you mean 'stiffness'"):
        check_known(["skin", "stifness"])


def test_without_cameras_no_camera_can_be_wrong():
    cameras = {"camera_motion", "stereo_scale", "lens_distortion", "refraction"}
    filmed = catalogue(replace(AROUND, internal=True, has_cameras=True))
    assert cameras <= set(filmed)
    assert not cameras & set(catalogue(replace(AROUND, filmed=False, has_cameras=False)))


def test_adhesion_begins_at_a_strength_that_lifts_the_body():
    physics = AROUND.physics
    for modulus in (1e3, 4e3, 1e6):
        stiff = replace(physics, material=replace(physics.material, youngs_modulus=modulus))
        kick = catalogue(replace(AROUND, physics=stiff), ["probe_adhesion"])["probe_adhesion"].kick
        assert kick == pytest.approx([0.5 * modulus])


def test_columns_and_entries_agree():
    candidates = list(catalogue(AROUND).values())
    columns, entries = dictionary_columns(candidates), entries_of(candidates)
    assert sum(len(e.columns) for e in entries) == len(columns)
    for e in entries:
        assert {columns[i].candidate.name for i in e.columns} == {e.name}


def test_inclusions_are_looked_for_near_the_presses_first():
    grid = inclusion.grid(AROUND, 0.012)
    assert 0 < len(grid) <= 16
    near = np.linalg.norm(grid - AROUND.contacts[0], axis=1)
    assert near[0] == near.min()


def test_inclusions_are_looked_for_at_every_depth_and_within_the_body():
    candidate = catalogue(AROUND, ["inclusion"])["inclusion"]
    centres = candidate.shapes[:, :3]
    heights, each = np.unique(centres[:, 2].round(9), return_counts=True)
    assert len(heights) >= 3 and each.min() >= 3  # measured 4 heights of 4 each
    assert np.ptp(heights) > 0.4 * (AROUND.upper - AROUND.lower)[2]
    assert candidate.array("lower")[:3] == pytest.approx(AROUND.lower)
    assert candidate.array("upper")[:3] == pytest.approx(AROUND.upper)


def test_a_stated_sigma_is_the_prior():
    stiffness = catalogue(AROUND, ["stiffness"])["stiffness"]
    default = stiffness.array("sigma")[0]
    candidate = narrowed(stiffness, {"ratio": 0.05}, toy.SETTINGS.allowance.stated)
    assert candidate.array("sigma") == pytest.approx([np.hypot(0.05, 0.1 * default)])
    assert doubt(np.array([0.02]), candidate.stated, 6.0) == pytest.approx(0.16)
    assert doubt(np.array([0.5]), candidate.stated, 6.0) == doubt(np.array([0.3]), candidate.stated, 6.0) == 6.0
    assert doubt(np.array([0.5]), stiffness.stated, 6.0) == 0.0


def test_an_onset_is_known_to_lie_between_two_moments():
    """Nothing changes with it in between: a fit leaves it there, and its sigma is that of a uniform distribution."""
    moments = (0.0, 1.0, 3.0, 3.5)
    candidate = catalogue(replace(AROUND, moments=moments), ["camera_motion"])["camera_motion"]
    onset = [c.parameter for c in candidate.coordinates].index("onset")
    assert candidate.shapes[:, onset].tolist() == [0.5, 2.0, 3.25]
    z = candidate.shapes[1]
    sigmas = candidate.sigmas(z, np.diag(candidate.array("sigma") ** 2))
    assert sigmas["onset"] == pytest.approx(2.0 / np.sqrt(12.0))


def test_a_difference_stays_within_the_bounds_that_a_parameter_has():
    """A Poisson ratio that is declared as 0.499 has no room for a step up."""
    around = toy.surroundings(toy.markers())
    declared = around.physics.with_material(poisson_ratio=0.499)
    (c,) = catalogue(replace(around, physics=declared), ["poisson_ratio"])["poisson_ratio"].coordinates
    assert c.value(c.beside(0.0, c.step)) == pytest.approx(0.499 - c.step)
    assert c.beside(-0.1, c.step) == c.step
