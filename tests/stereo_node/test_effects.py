"""The measuring effects: inverse of each other, neutral where they say, and right against independent optics."""

from dataclasses import replace

import numpy as np
import pytest
from glass import ellipsoid_surface, measure_through_a_body
from scene import dome_markers, looking_down, make_test_rig
from scipy.optimize import minimize

from livedeform.common.errors import InputError
from livedeform.common.frames import apply, inverse
from livedeform.common.types import EffectValues
from livedeform.stereo_node.camera.rays import TriangleSurface, apparent, refract
from livedeform.stereo_node.camera.triangulate import triangulate
from livedeform.stereo_node.effects import EFFECTS, View, correct_all, distort_all

VALUES = {
    "stereo_scale": {"scale": np.array(1.04)},
    "lens_distortion": {"k1": np.array(0.05)},
    "refraction": {"index": np.array(1.41)},
    "camera_motion": {
        "translation": np.array([1e-3, -5e-4, 2e-3]),
        "rotation": np.array([0.01, -0.02, 0.005]),
        "onset": np.array(1.0),
    },
    "reference_pose": {"translation": np.array([5e-4, 0.0, -1e-3]), "rotation": np.array([0.01, -0.02, 0.005])},
}
LATE = 5_000_000_000


@pytest.fixture(scope="module")
def view():
    markers, normals = dome_markers(30)
    rest = markers.points.copy()
    kinds = markers.kinds.copy().astype("<U8")
    rest[:6] -= 0.012 * normals[:6]  # 12 mm under the surface
    kinds[:6] = "internal"
    surface = ellipsoid_surface()
    return View(looking_down(), make_test_rig(), rest, markers.ids, kinds, 0, lambda stamp_ns: surface)


@pytest.mark.parametrize("name", EFFECTS)
def test_correct_is_the_inverse_of_distort(view, name):
    true = view.rest + np.random.default_rng(0).normal(0, 1e-3, view.rest.shape)
    seen = EFFECTS[name].distort(true, LATE, VALUES[name], view)
    assert np.abs(seen - true).max() > 1e-4  # it does something: measured 0.3 mm (lens) to 8 mm
    assert np.allclose(EFFECTS[name].correct(seen, LATE, VALUES[name], view), true, atol=1e-9)


@pytest.mark.parametrize("name", EFFECTS)
def test_neutral_values_change_nothing(view, name):
    values = {
        p.name: np.full(() if p.size is None else p.size, p.neutral if p.neutral is not None else 0.0)
        for p in EFFECTS[name].INFO.parameters
    }
    assert np.allclose(EFFECTS[name].distort(view.rest, LATE, values, view), view.rest, atol=1e-12)


def test_all_together_in_order(view):
    effects = [EffectValues(name, values) for name, values in VALUES.items()]
    assert np.allclose(
        correct_all(distort_all(view.rest, LATE, effects, view), LATE, effects, view), view.rest, atol=1e-8
    )


def test_scale_keeps_the_mean_of_the_rest_and_multiplies_lengths(view):
    seen = EFFECTS["stereo_scale"].distort(view.rest, 0, VALUES["stereo_scale"], view)
    outside = view.kinds != "internal"
    assert np.allclose(seen[outside].mean(axis=0), view.rest[outside].mean(axis=0), atol=1e-12)
    assert np.linalg.norm(seen[1] - seen[9]) == pytest.approx(1.04 * np.linalg.norm(view.rest[1] - view.rest[9]))
    # a part of the markers is distorted as it is among all
    part = view.take(np.arange(3, 8))
    assert np.allclose(
        EFFECTS["stereo_scale"].distort(part.rest, 0, VALUES["stereo_scale"], part), seen[3:8], atol=1e-12
    )


def test_camera_motion_starts_at_its_onset(view):
    effect = EFFECTS["camera_motion"]
    assert np.array_equal(effect.distort(view.rest, 900_000_000, VALUES["camera_motion"], view), effect.distort(
        view.rest, 0, VALUES["camera_motion"], view))  # fmt: skip
    assert np.abs(effect.distort(view.rest, 1_000_000_000, VALUES["camera_motion"], view) - view.rest).max() > 1e-3


def test_a_rest_that_was_held_low_lifts_all_markers_but_those_on_the_support(view):
    """Stated 1 mm below the rest: a body that is carried from there comes out 1 mm lower than the markers do."""
    kinds = np.array(["support", *["surface"] * (len(view.ids) - 1)])
    held = replace(view, kinds=kinds)
    values = {"translation": np.array([0.0, 0.0, -1e-3]), "rotation": np.zeros(3)}
    seen = EFFECTS["reference_pose"].distort(view.rest, LATE, values, held)
    np.testing.assert_allclose(seen[0], view.rest[0])
    np.testing.assert_allclose(seen[1:] - view.rest[1:], np.tile([0.0, 0.0, 1e-3], (len(view.ids) - 1, 1)), atol=1e-12)


def test_lens_distortion_is_what_the_pictures_of_such_a_lens_give(view):
    """Pictures by a rig with k1, measured by the rig without: independent of the effect's own code."""
    true_rig = make_test_rig(dist=(0.05, 0, 0, 0, 0))
    in_left = apply(inverse(view.T_phantom_left), view.rest)
    left, right, _, _ = true_rig.project(in_left)
    measured = triangulate(view.rig, left, right).points
    given = View(view.T_phantom_left, view.rig, view.rest, view.ids, view.kinds, 0, registered=False)
    seen = EFFECTS["lens_distortion"].distort(view.rest, 0, VALUES["lens_distortion"], given)
    assert np.allclose(
        apply(view.T_phantom_left, measured), seen, atol=5e-6
    )  # measured 3.7 um: rays 0.1 px askew, midpoint against optimum


def test_refraction_obeys_fermat(view):
    """A point is seen in the direction in which the optical path to it is shortest (Fermat): neither Snell's law nor
    the triangles enter here."""
    index = 1.41
    surface = TriangleSurface(*ellipsoid_surface(120))
    axes = np.array([0.06, 0.06, 0.045])
    centre = view.T_phantom_left[:3, 3]
    seen = apparent(centre, view.rest[:6], surface, index)

    def place(angles):
        return axes * [np.sin(angles[0]) * np.cos(angles[1]), np.sin(angles[0]) * np.sin(angles[1]), np.cos(angles[0])]

    for i in range(6):
        start = view.rest[i] / axes
        start = [np.arccos(start[2] / np.linalg.norm(start)), np.arctan2(start[1], start[0])]
        path = lambda a, p=view.rest[i]: np.linalg.norm(place(a) - centre) + index * np.linalg.norm(p - place(a))  # noqa: E731
        best = minimize(path, start, method="Nelder-Mead", options={"xatol": 1e-11, "fatol": 1e-17, "maxiter": 4000}).x
        ray = place(best) - centre
        sine = np.linalg.norm(np.cross(ray, seen[i])) / np.linalg.norm(ray) / np.linalg.norm(seen[i])
        assert sine * 0.4 < 2e-5  # m at the marker: measured 4e-7


@pytest.mark.parametrize("depth", [0.005, 0.015])
def test_markers_near_a_domes_horizon_are_seen(depth):
    """Points along rays that Snell's law leads into the body, at angles of up to 78 degrees, are seen along them."""
    surface = TriangleSurface(*ellipsoid_surface(60))
    eye, index = np.array([0.05, -0.25, 0.33]), 1.33
    rays = np.random.default_rng(4).uniform([-0.06, -0.06, 0.0], [0.06, 0.06, 0.05], (600, 3)) - eye
    place, normal = surface.hit(eye, rays)
    cosine = -(rays * normal).sum(axis=1) / np.linalg.norm(rays, axis=1)
    points = place + depth * refract(rays, normal, index)
    found = []
    for low, high in ((0.2, 0.3), (0.3, 1.0)):
        ones = (cosine > low) & (cosine <= high) & (place[:, 2] > 0.005)
        seen = apparent(eye, points[ones], surface, index)
        off = np.linalg.norm(np.cross(seen, rays[ones]), axis=1) / np.linalg.norm(seen, axis=1)
        found.append(float((off < 1e-6).mean()))
    # measured 0.75 and 0.997, 0.88 and 1; a search that went on past the horizon found 0 and 0.997, 0.63 and 1
    assert found[0] > 0.7 and found[1] > 0.99


def test_a_flat_face_refracts_as_one_up_to_its_edge():
    """Markers in a block, also within an element of its edges, against a face without an end."""
    import trimesh

    box = trimesh.creation.box(bounds=[[-0.04, -0.03, 0.0], [0.04, 0.03, 0.045]])
    block = TriangleSurface(*trimesh.remesh.subdivide_to_size(box.vertices, box.faces, 0.015))
    wide = np.array([[-1.0, -1.0, 0.045], [1.0, -1.0, 0.045], [1.0, 1.0, 0.045], [-1.0, 1.0, 0.045]])
    face = TriangleSurface(wide, np.array([[0, 1, 2], [0, 2, 3]]))
    eye = np.array([0.02, -0.05, 0.40])
    points = np.array([[0.0, 0.0, 0.035], [-0.035, 0.01, 0.038], [0.037, 0.02, 0.04], [0.0, 0.027, 0.03]])
    seen, expected = (apparent(eye, points, surface, 1.35) for surface in (block, face))
    # measured 4e-12; normals that were smoothed over the edges were off by 1.4 mm
    assert np.abs(seen - expected).max() < 1e-9


def test_internal_markers_are_found_and_measured_through_a_rendered_body():
    """Balls 6 to 14 mm below the surface of a transparent body, in pictures that are ray-traced through the exact
    ellipsoid; the correction knows triangles."""
    status, internal, seen, left = measure_through_a_body()
    assert status.level == "ok" and internal.sum() == 6
    assert seen[internal].min() > 1.5e-3  # measured 1.8 to 4.7 mm: what refraction does
    assert np.sqrt((left[internal] ** 2).mean()) < 7e-5  # measured 0.033 mm; the pixel noise alone gives 0.025
    assert np.sqrt((seen[~internal] ** 2).mean()) < 4e-5  # measured 0.019 mm: internal ones do not spoil the pose


def test_effects_that_need_cameras_say_so(view):
    blind = View(view.T_phantom_left, None, view.rest, view.ids, view.kinds, 0)
    with pytest.raises(InputError, match="needs the cameras' calibration"):
        EFFECTS["lens_distortion"].distort(view.rest, 0, VALUES["lens_distortion"], blind)
