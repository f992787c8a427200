"""Which triangles look at one another, against all of them asked."""

import numpy as np
import pytest
import trimesh

from livedeform.fem_node.mesh.facing import facing


def all_asked(vertices, triangles):
    """Return the triangles that see the surface along their normal, are seen so, or touch one that does."""
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    seen = np.zeros(len(triangles), bool)
    for i, middle in enumerate((a + b + c) / 3):
        p, q = np.cross(normals[i], c - a), np.cross(middle - a, b - a)
        det = (p * (b - a)).sum(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            u, w = (p * (middle - a)).sum(axis=1) / det, q @ normals[i] / det
            ahead = ((a - middle) * normals).sum(axis=1) / (normals @ normals[i])
        meets = (normals @ normals[i] < -1e-6) & (ahead > 1e-9) & (u >= 0) & (w >= 0) & (u + w <= 1)
        if meets.any():
            seen[[i, np.argmin(np.where(meets, ahead, np.inf))]] = True
    touched = np.zeros(len(vertices), bool)
    touched[triangles[seen]] = True
    return np.flatnonzero(touched[triangles].any(axis=1))


def dented():
    ball = trimesh.creation.icosphere(3)
    off = np.linalg.norm(ball.vertices - [0, 0, 1], axis=1)
    ball.vertices[:, 2] -= 0.8 * np.exp(-((off / 0.3) ** 2))
    return ball


def hollow():
    inner = trimesh.creation.icosphere(2, radius=0.4)
    inner.invert()
    return trimesh.util.concatenate([trimesh.creation.icosphere(2), inner])


@pytest.mark.parametrize(
    ("body", "n"),
    [(dented, 84), (hollow, 320), (lambda: trimesh.creation.torus(1.0, 0.4, 20, 16), 320)],
    ids=["dent", "hollow", "ring"],
)
def test_what_looks_at_itself_is_what_all_triangles_tell(body, n):
    mesh = body()
    for turn in (0.0, 1.0):  # rad; at first its symmetries lie along the axes
        mesh.apply_transform(trimesh.transformations.rotation_matrix(turn, [0.3, 0.8, 0.1]))
        found = facing(np.asarray(mesh.vertices), np.asarray(mesh.faces))
        assert len(found) == n
    assert np.array_equal(found, all_asked(np.asarray(mesh.vertices), np.asarray(mesh.faces)))


def test_a_convex_body_does_not_look_at_itself():
    ball = trimesh.creation.icosphere(5)  # 20 480 triangles
    assert not len(facing(np.asarray(ball.vertices), np.asarray(ball.faces)))
