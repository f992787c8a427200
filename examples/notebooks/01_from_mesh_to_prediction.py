# ---
# jupyter:
#   jupytext:
#     formats: py:percent
#   kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # From a mesh to a prediction
#
# A soft block stands on a table and a ball presses on it. Where do its markers go, and how hard must the ball press?
#
# This file is a notebook: `jupytext --to notebook 01_from_mesh_to_prediction.py`. It also runs as a script.

# %% [markdown]
# ## The body
# A block of 40 x 40 x 30 mm, cut into tetrahedra. Everything is in SI: metres, pascals, seconds, newtons.

# %%
from dataclasses import replace

import numpy as np

from livedeform.common.types import EffectValues, Pose
from livedeform.fem_node.contact.probe_shapes import make_shape
from livedeform.fem_node.effects import apply_effects
from livedeform.fem_node.element.element import make_space
from livedeform.fem_node.mesh.structured import block_mesh
from livedeform.fem_node.model import PhantomModel
from livedeform.fem_node.physics.record import MaterialSpec, Physics, Probe, Support

mesh = block_mesh((0.04, 0.04, 0.03), (5, 5, 3))
space = make_space(mesh)
print(f"{len(mesh.tets)} tetrahedra, {3 * space.n_nodes} unknowns")

# %% [markdown]
# ## What it is made of, and how it is held

# %%
physics = Physics(
    material=MaterialSpec("neo_hookean", youngs_modulus=4000.0, poisson_ratio=0.49),
    density=1000.0,
    supports=(Support(lambda points: points[:, 2] < 1e-6, "fixed"),),
    probe=Probe(make_shape("sphere", 0.012)),
)
markers = np.array([[0.010, 0.0, 0.03], [0.015, 0.0, 0.03], [0.02, 0.0, 0.02], [0.0, 0.02, 0.01]])
model = PhantomModel(space, physics, markers=markers)

# %% [markdown]
# ## Press
# The pose is of the probe's frame: origin at the lowest point of the ball, +z into the body. The quaternion
# (1, 0, 0, 0) turns +z down. Poses are asked for one after another, with their times.

# %%
DOWN = np.array([1.0, 0.0, 0.0, 0.0])


def press(model: PhantomModel, depths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Marker places (k, n, 3) m and vertical forces (k,) N at depths (k,) m below the unpressed top."""
    top = model.rest().surface[:, 2].max()
    found = [
        model.predict(Pose(10**9 * (k + 1), np.array([0.0, 0.0, top - depth]), DOWN)) for k, depth in enumerate(depths)
    ]
    assert all(prediction.converged for prediction in found)
    return np.array([p.markers for p in found]), np.array([p.force[2] for p in found])


depths = np.array([-0.001, 0.001, 0.002, 0.003])
places, force = press(model, depths)
for depth, f, place in zip(depths, force, places, strict=True):
    moved = 1e3 * np.linalg.norm(place - places[0], axis=1)
    print(f"{1e3 * depth:5.1f} mm  {f:7.4f} N   markers moved (mm): {np.round(moved, 3)}")

# %% [markdown]
# ## What if?
# An effect changes the record that the solver is built from. A body twice as stiff takes twice the force, and its
# markers move as before: markers alone, under a rigid probe and without weight, cannot tell a modulus.

# %%
light = replace(physics, gravity=np.zeros(3))
stiff = apply_effects(light, [EffectValues("stiffness", {"ratio": np.array(2.0)})])
soft_places, soft_force = press(PhantomModel(space, light, markers=markers), depths)
stiff_places, stiff_force = press(PhantomModel(space, stiff, markers=markers), depths)
print("force ratio", np.round(stiff_force[1:] / soft_force[1:], 4))
print("largest difference of a marker, um:", np.round(1e6 * np.abs(stiff_places - soft_places).max(), 2))

# %% [markdown]
# What must be true:

# %%
assert abs(force[0]) < 1e-9 and (np.diff(force) < 0).all()  # N on the body, downwards, more with depth
assert np.allclose(stiff_force[1:] / soft_force[1:], 2.0, rtol=5e-3)  # 2.0024 at 1 mm: contact is solved to 0.01 mm
assert np.abs(stiff_places - soft_places).max() < 1e-5
