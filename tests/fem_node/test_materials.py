"""Every material: energy, stress and tangent agree by finite differences; small strain is Hooke's; turning changes
nothing."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from livedeform.common.errors import InputError
from livedeform.common.experiment.constants import shear_modulus_of
from livedeform.fem_node.element.simd import one_by_one, side_by_side
from livedeform.fem_node.materials import MATERIALS, make_material
from livedeform.fem_node.materials.volume import add_pressure
from livedeform.fem_node.physics.record import MaterialSpec

EXTRA = {
    "mooney_rivlin": {"ratio": 0.3},
    "yeoh": {"c2_ratio": 0.5, "c3_ratio": 0.1},
    "exponential": {"b": 0.8},
    "ogden": {"mu": [1.0, 0.4], "alpha": [3.0, -2.0]},
}
E, NU = 3000.0, 0.45


def _material(name):
    return make_material(MaterialSpec(name, E, NU, EXTRA.get(name, {})))


def _evaluate(material, F, *, tangent=True):
    """psi (n,), P (n, 3, 3), A (n, 9, 9) with the volume at each point."""
    n = len(F)
    psi, P, A = np.empty(n), np.empty((n, 3, 3)), side_by_side(np.empty((n, 9, 9)), 1) if tangent else None
    material.response(F, np.full(n, 1.3), psi, P, A)
    theta, c = np.empty(n), np.empty((n, 3, 3))
    material.volume.measure(F, theta, c)
    U, K = material.volumetric, 1.3 * material.bulk
    add_pressure(K * U.slope(theta), c, P)
    if tangent:
        material.volume.add_tangent(F, K * U.slope(theta), K * U.curvature(theta), c, A)
    return psi + K * U.value(theta), P, one_by_one(A, n)[:, 0] if tangent else None


def _deformations(rng, n=6, size=0.25):
    F = np.eye(3) + size * rng.standard_normal((n, 3, 3))
    F[0] = np.eye(3)  # equal stretches: where spectral formulas divide by zero
    F[1] = np.diag([1.2, 1.2, 0.8])
    return F[np.linalg.det(F) > 0.2]


@pytest.mark.parametrize("name", MATERIALS)
def test_stress_is_the_derivative_of_energy_and_tangent_of_stress(name):
    material, F, h = _material(name), _deformations(np.random.default_rng(1)), 1e-6
    _, P, A = _evaluate(material, F)
    for m in range(9):
        d = np.zeros(9)
        d[m] = h
        plus, minus = (_evaluate(material, F + s * d.reshape(3, 3), tangent=False) for s in (1.0, -1.0))
        scale = np.abs(A).max()
        np.testing.assert_allclose((plus[0] - minus[0]) / (2 * h), P.reshape(-1, 9)[:, m], atol=1e-8 * scale)
        # measured at worst: stress 4e-10, tangent 1.4e-9
        np.testing.assert_allclose((plus[1] - minus[1]).reshape(-1, 9) / (2 * h), A[:, :, m], atol=1e-8 * scale)
    np.testing.assert_allclose(A, A.transpose(0, 2, 1), atol=1e-12 * scale)


@pytest.mark.parametrize("name", MATERIALS)
def test_small_strain_is_hookes_law(name):
    material, mu = _material(name), 1.3 * E / (2 * (1 + NU))
    lame = 1.3 * E * NU / ((1 + NU) * (1 - 2 * NU))
    I = np.eye(3)
    hooke = lame * np.einsum("ij,kl->ijkl", I, I)
    hooke += mu * (np.einsum("ik,jl->ijkl", I, I) + np.einsum("il,jk->ijkl", I, I))
    psi, P, A = _evaluate(material, I[None])
    assert abs(psi[0]) < 1e-9
    np.testing.assert_allclose(P, 0.0, atol=1e-9)
    np.testing.assert_allclose(A[0], hooke.reshape(9, 9), atol=1e-9 * lame)


@pytest.mark.parametrize("name", [n for n in MATERIALS if n != "linear"])
def test_a_turned_body_has_the_same_energy_and_turned_stress(name):
    material, F = _material(name), _deformations(np.random.default_rng(2))
    Q, R = Rotation.random(2, random_state=3).as_matrix()
    psi, P, _ = _evaluate(material, F)
    turned_psi, turned_P, _ = _evaluate(material, Q @ F)
    np.testing.assert_allclose(turned_psi, psi, rtol=1e-10, atol=1e-9)
    np.testing.assert_allclose(turned_P, Q @ P, atol=1e-10 * np.abs(P).max())
    isotropic_psi, _, _ = _evaluate(material, F @ R)  # isotropy
    np.testing.assert_allclose(isotropic_psi, psi, rtol=1e-10, atol=1e-9)


def test_special_cases_are_neo_hookean():
    F = _deformations(np.random.default_rng(4))
    psi, P, A = _evaluate(_material("neo_hookean"), F)
    for name, extra in (
        ("exponential", {"b": 0.0}),
        ("yeoh", {}),
        ("mooney_rivlin", {"ratio": 0.0}),
        ("ogden", {"alpha": [2.0]}),
    ):
        other = _evaluate(make_material(MaterialSpec(name, E, NU, extra)), F)
        for mine, theirs in zip((psi, P, A), other, strict=True):
            np.testing.assert_allclose(theirs, mine, atol=1e-9 * np.abs(mine).max())


@pytest.mark.parametrize(
    "name", [n for n in MATERIALS if n not in ("linear", "corotational", "saint_venant_kirchhoff")]
)
def test_a_flattened_element_has_no_finite_energy_and_stops_nobody(name):
    """A wild trial step may make J exactly 0: an infinite (or undefined) energy turns it down, not an exception."""
    F = np.diag([1.0, 1.0, 0.0])[None]
    psi, P, A = np.empty(1), np.empty((1, 3, 3)), side_by_side(np.empty((1, 9, 9)), 1)
    with np.errstate(all="ignore"):
        _material(name).response(F, np.ones(1), psi, P, A)
    assert not np.isfinite(psi[0])


L = np.array([0.7, 1.25, 1.0 / (0.7 * 1.25)])  # principal stretches without a change of volume
I1, I2 = (L**2).sum(), (L**-2).sum()


def _ogden(mu, alpha):
    """Return the energy (Pa) of Ogden's formula of 1972 at the stretches L."""
    return sum(m / a * ((L**a).sum() - 3.0) for m, a in zip(mu, alpha, strict=True))


@pytest.mark.parametrize(
    ("model", "constants", "energy"),
    [
        ("yeoh", {"c1": 800.0, "c2": 300.0, "c3": 50.0}, 800 * (I1 - 3) + 300 * (I1 - 3) ** 2 + 50 * (I1 - 3) ** 3),
        ("mooney_rivlin", {"c10": 900.0, "c01": 250.0}, 900 * (I1 - 3) + 250 * (I2 - 3)),
        ("ogden", {"mu": [1000.0, 300.0], "alpha": [2.0, -2.0]}, _ogden([1000.0, -300.0], [2.0, -2.0])),
        ("ogden", {"mu": [300.0, 1400.0], "alpha": [2.0, -4.0]}, _ogden([300.0, -700.0], [2.0, -4.0])),
        ("ogden", {"mu": [1.0, 1.0], "alpha": [2.0, -2.0]}, _ogden([1.0, -1.0], [2.0, -2.0])),
        ("ogden", {"mu": [500.0, 700.0], "alpha": [1.3, 5.0]}, _ogden([1000.0 / 1.3, 280.0], [1.3, 5.0])),
    ],
)
def test_constants_in_pascals_are_those_of_the_formula(model, constants, energy):
    """With the modulus that they have at small strain, which is the one that everybody asks `shear_modulus_of`."""
    modulus = 2.0 * (1.0 + NU) * shear_modulus_of(model, constants)
    psi, _, _ = _evaluate(make_material(MaterialSpec(model, modulus, NU, constants)), np.diag(L)[None])
    np.testing.assert_allclose(psi[0] / 1.3, energy, rtol=1e-12)  # of a modulus that is 1.3 times as large


@pytest.mark.parametrize(
    ("model", "constants"),
    [
        ("ogden", {"mu": [500.0, -500.0], "alpha": [2.0, -2.0]}),
        ("ogden", {"mu": [1000.0, -300.0], "alpha": [2.0, -2.0]}),
        ("ogden", {"mu": [1000.0, -300.0], "alpha": [2.0, 4.0]}),
        ("ogden", {"mu": [1000.0, 300.0], "alpha": [2.0, 0.0]}),
        ("ogden", {"mu": [0.0, 0.0], "alpha": [2.0, -2.0]}),
        ("ogden", {"mu": [1.0, 2.0], "alpha": [2.0]}),
        ("yeoh", {"c1": 0.0, "c2": 100.0}),
        ("mooney_rivlin", {"c10": 500.0, "c01": -500.0}),
    ],
)
def test_constants_without_stiffness_are_refused_by_the_solver_as_well(model, constants):
    with pytest.raises(InputError) as caught:
        make_material(MaterialSpec(model, E, NU, constants))
    assert caught.value.remedy


def test_an_unknown_model_names_the_known_ones():
    with pytest.raises(InputError, match="neo_hookean"):
        make_material(MaterialSpec("rubber"))
