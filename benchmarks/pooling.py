"""Pooling on synthetic phantoms: of 50, 35 share a scale error; each may have a cause of its own.

    python -m benchmarks.pooling [--seeds 20]

The phantoms are normal equations as a diagnosis keeps them. Their columns are closed-form displacement fields on a dome
(sag, dimple, bulge, rigid motion, dilation) of 24 markers at 20 moments, another dome, another press and other places
for each phantom, with the registration integrated out. Nothing of the search or of the fit under test makes them.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping

import numpy as np

from livedeform.campaign.evidence import KeptEvidence, Label
from livedeform.campaign.pooling import scopes_of
from livedeform.campaign.shared_causes import Pooled, pool
from livedeform.common.types import Array

SIGMA = 1e-4  # m, noise of a coordinate of a marker
REGISTRATION = 5e-4, 5e-3  # m, rad: uncertain whatever is tried
SCALE = 0.01  # prior sigma of a scale error
SHARED = 1.2  # the scale error that is shared, in sigmas: 1.2 %
SCATTER = 0.03  # of it between takes


def fields(rng: np.random.Generator) -> dict[str, Array]:
    """Displacements (moments, markers, 3, d) m of one sigma of each effect, on a phantom of its own."""
    radius, height, n = rng.uniform(0.04, 0.06), rng.uniform(0.04, 0.06), 24
    u, angle = rng.uniform(0.05, 0.95, n), rng.uniform(0.0, 2.0 * np.pi, n)
    r = radius * np.sqrt(1.0 - u**2)
    x = np.column_stack([r * np.cos(angle), r * np.sin(angle), height * u])
    t = np.linspace(0.0, 20.0, 20)
    depth = np.maximum(0.0, np.sin(2.0 * np.pi * t / 8.0)) * rng.uniform(0.006, 0.012)
    rate = np.gradient(depth, t)
    away = x[None, :, :2] - np.column_stack([rng.normal(0.0, 0.01, 20), rng.normal(0.0, 0.01, 20)])[:, None]
    dimple = np.exp(-0.5 * (away**2).sum(axis=2) / 0.016**2) * u
    z, zero, one = np.array([0.0, 0.0, 1.0]), np.zeros((20, n)), np.ones((20, n))
    sag = u * (1.0 - 0.4 * u) * 2e-3 * one

    def down(amount: Array) -> Array:
        return -amount[..., None, None] * z[:, None]

    def sideways(amount: Array, axis: int) -> Array:
        return amount[..., None, None] * np.eye(3)[axis][:, None]

    bulge = np.concatenate([away, zero[..., None]], axis=2)[..., None] * (depth[:, None] * (1.0 - u))[..., None, None]
    press = depth[:, None] * dimple
    late = (t > rng.uniform(4.0, 16.0))[:, None] * one
    return {
        "_registration": registration(x, len(t)),
        "stiffness": down(-0.5 * sag),
        "density": down(0.2 * sag * (1.0 + 0.2 * u)),
        "gravity_tilt": np.concatenate([sideways(0.06 * sag, k) for k in (0, 1)], axis=-1),
        "poisson_ratio": 8.0 * bulge,
        "skin": down(0.15 * press * (1.0 - (away**2).sum(axis=2) / 0.02**2)),
        "stiffness_gradient": down(0.4 * sag * (u - 0.5)),
        "swelling": 0.01 * x[None, :, :, None] * (t / 20.0)[:, None, None, None],
        "viscoelasticity": down(0.2 * np.maximum(0.0, np.roll(press, 1, axis=0) - press)),
        "softening": down(0.3 * sag * (t / 20.0)[:, None]),
        "base_slip": 12.0 * bulge * (1.0 - u)[:, None, None],
        "probe_offset": np.concatenate(
            [
                down(1e-3 * dimple * (depth > 0)[:, None]),
                *(down(1e-3 * press * away[..., k] / 0.016**2) for k in (0, 1)),
            ],
            axis=-1,
        ),
        "time_offset": down(0.02 * rate[:, None] * dimple),
        "stereo_scale": SCALE * x[None, :, :, None] * one[..., None, None],
        "camera_motion": 1e-3 * np.concatenate([sideways(late, k) for k in range(3)], axis=-1),
    }


def registration(x: Array, moments: int) -> Array:
    """Displacements (moments, markers, 3, 6) m of one sigma of a rigid motion of the markers ``x`` (m, 3)."""
    shifts = [np.broadcast_to(REGISTRATION[0] * axis, x.shape) for axis in np.eye(3)]
    turns = [REGISTRATION[1] * np.cross(axis, x) for axis in np.eye(3)]
    return np.broadcast_to(np.stack([*shifts, *turns], axis=-1), (moments, *x.shape, 6))


def phantom(name: str, truth: Mapping[str, Array], rng: np.random.Generator) -> KeptEvidence:
    """What the diagnosis of a phantom with the causes ``truth`` (in sigmas) keeps."""
    made = {effect: f.reshape(-1, f.shape[-1]) / SIGMA for effect, f in fields(rng).items()}
    Z = made.pop("_registration")
    J = np.column_stack(list(made.values()))
    G = J.T @ J - J.T @ Z @ np.linalg.solve(Z.T @ Z + np.eye(Z.shape[1]), Z.T @ J)
    ends = np.cumsum([0, *(f.shape[1] for f in made.values())])
    columns = {effect: np.arange(a, b) for effect, a, b in zip(made, ends[:-1], ends[1:], strict=True)}
    x = np.zeros(len(G))
    for effect, value in truth.items():
        x[columns[effect]] = value
    noise = np.linalg.cholesky(G + 1e-9 * np.trace(G) / len(G) * np.eye(len(G))) @ rng.standard_normal(len(G))
    labels = {
        effect: tuple(Label("value", k if len(at) > 1 else -1, 1.0, "linear", 0.0) for k in range(len(at)))
        for effect, at in columns.items()
    }
    return KeptEvidence(name, name, "rig", G, G @ x + noise, columns, labels)


def laboratory(seed: int, n: int = 50, n_shared: int = 35) -> tuple[list[KeptEvidence], list[dict[str, Array]]]:
    """``n`` phantoms, ``n_shared`` with the shared scale error, six of ten with a cause of their own."""
    rng = np.random.default_rng(seed)
    names = [name for name in fields(rng) if name not in ("_registration", "stereo_scale")]
    shared = set(rng.permutation(n)[:n_shared].tolist())
    out, truths = [], []
    for i in range(n):
        truth: dict[str, Array] = {}
        if rng.random() < 0.6:
            effect = str(rng.choice(names))
            size = fields(np.random.default_rng(0))[effect].shape[-1]
            direction = rng.standard_normal(size)
            truth[effect] = direction / np.linalg.norm(direction) * rng.uniform(0.5, 2.0)
        if i in shared:
            truth["stereo_scale"] = np.array([SHARED * (1.0 + SCATTER * rng.standard_normal())])
        truths.append(truth)
        out.append(phantom(f"phantom-{i:02d}", truth, rng))
    return out, truths


def judge(found: Pooled, truths: list[dict[str, Array]]) -> dict[str, float]:
    """Compare what was found with the truth: whether the scale error, and nothing else, is named as shared; members and
    own causes that are right, as shares."""
    named = [s.effect for s in found.named]
    scale = next((s for s in found.named if s.effect == "stereo_scale"), None)
    members = set() if scale is None else set(scale.members)
    right_member = right_own = 0
    for i, truth in enumerate(truths):
        name = f"phantom-{i:02d}"
        right_member += (name in members) == ("stereo_scale" in truth)
        right_own += set(found.explanations[name].own) == set(truth) - {"stereo_scale"}
    value = float("nan") if scale is None else float(scale.value[0])
    n = len(truths)
    return {"shared": named == ["stereo_scale"], "members": right_member / n, "own": right_own / n, "value": value}


def figures(seeds: int) -> None:
    """Print a line per seed, and the shares over all of them."""
    rows = []
    for seed in range(seeds):
        evidence, truths = laboratory(seed)
        start = time.process_time()
        row = judge(pool(evidence, scopes_of(evidence)), truths)
        rows.append(row | {"cpu_s": time.process_time() - start})
        print(f"seed {seed}: " + ", ".join(f"{k} {float(v):.3f}" for k, v in rows[-1].items()), flush=True)
    mean = {k: float(np.mean([r[k] for r in rows])) for k in rows[0]}
    print(f"scale error named as shared, and nothing else: {100 * mean['shared']:.0f} % of {seeds} seeds (goal 95)")
    print(f"members right {100 * mean['members']:.1f} %, own causes right {100 * mean['own']:.1f} % (goal 90)")
    print(f"shared value {mean['value']:.3f} (true {SHARED}), {mean['cpu_s']:.1f} s of CPU per fit")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    figures(parser.parse_args().seeds)
