"""Measured markers out of true ones: seen by both cameras, with noise, triangulated and registered as a tracker
would."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from livedeform.common.types import Array, Ids, MarkerFrame
from livedeform.synthetic.measuring.refraction import BodySurface, refracted
from livedeform.synthetic.rig import Rig, register
from livedeform.synthetic.truth.probe import TruthProbe


@dataclass(frozen=True)
class MeasuringTruth:
    """Describe what the measuring chain does that nobody declared; the names and signs are those of the effects.

    ``camera_motion``: translation (3,) m, rotation (3,) rad, onset s. ``index``: of the body, None: internal markers
    are
    seen where they are.
    """

    stereo_scale: float = 1.0
    k1: float = 0.0
    camera_motion: tuple[Array, Array, float] | None = None
    index: float | None = None


@dataclass(frozen=True)
class Seen:
    """The markers of the true body: ``ids`` (n,), ``kinds`` (n,), ``noise_px``; ``dropout``: share of points that a
    tracker
    loses at random; ``jitter``: share of points with three times the noise."""

    ids: Ids
    kinds: tuple[str, ...]
    noise_px: float = 0.08
    dropout: float = 0.02
    jitter: float = 0.01


class Tracker:
    """A stereo tracker with the declared calibration, looking at the true world."""

    def __init__(
        self, rig: Rig, truth: MeasuringTruth, seen: Seen, probe: TruthProbe | None, rng: np.random.Generator
    ) -> None:
        self.declared, self.truth, self.seen, self.probe, self.rng = rig, truth, seen, probe, rng
        camera = rig.left
        bent = replace(camera, k=(camera.k[0] + truth.k1, camera.k[1]))
        scaled = rig.T_right_left.copy()
        scaled[:3, 3] /= truth.stereo_scale  # the declared baseline is ``scale`` times the true one
        self.true = replace(rig, left=bent, right=bent, T_right_left=scaled)
        self.T_phantom_left = rig.T_phantom_left

    def register(self, rest: Array, normals: Array, n_frames: int = 10) -> None:
        """T_phantom_left from ``rest`` (n, 3), the markers' places at rest, averaged over some pictures."""
        pixels = np.mean([self._pixels(rest, normals, None, self.true) for _ in range(n_frames)], axis=0)
        good = np.isfinite(pixels).all(1) & np.array([k != "internal" for k in self.seen.kinds])
        measured, _, _ = self.declared.triangulate(pixels[good], self.seen.noise_px)
        self.T_phantom_left = register(measured, rest[good])

    def rig_at(self, time: float) -> Rig:
        """Return the true cameras, where they stand at a ``time`` (s after the first recording's start)."""
        if self.truth.camera_motion is None or time < self.truth.camera_motion[2]:
            return self.true
        return self.true.moved(*self.truth.camera_motion[:2])

    def frame(
        self,
        stamp_ns: int,
        time: float,
        points: Array,
        normals: Array,
        T_probe: Array | None,
        surface: BodySurface | None = None,
    ) -> MarkerFrame:
        """The markers at a time: ``points`` (n, 3) true places, ``normals`` (n, 3) outward; where the truth
        refracts, at this ``surface``."""
        assert surface is not None or self.truth.index is None, "what refracts has a surface"
        pixels = self._pixels(points, normals, T_probe, self.rig_at(time), surface)
        found = np.isfinite(pixels).all(1) & (self.rng.uniform(size=len(points)) >= self.seen.dropout)
        left, covariance, error = self.declared.triangulate(pixels[found], self.seen.noise_px)
        R = self.T_phantom_left[:3, :3]
        return MarkerFrame(
            stamp_ns,
            self.seen.ids[found],
            left @ R.T + self.T_phantom_left[:3, 3],
            R @ covariance @ R.T,
            error,
        )

    def _pixels(
        self, points: Array, normals: Array, T_probe: Array | None, rig: Rig, surface: BodySurface | None = None
    ) -> Array:
        """(n, 4) with noise; NaN where a camera does not see the marker."""
        internal = np.array([k == "internal" for k in self.seen.kinds])
        out = np.empty((len(points), 4))
        for c, (camera, T) in enumerate(rig.views()):
            eye = -T[:3, :3].T @ T[:3, 3]
            apparent = points
            if self.truth.index is not None and surface is not None:
                apparent = points.copy()
                apparent[internal] = refracted(points[internal], surface, eye, self.truth.index)
            uv = camera.project(apparent @ T[:3, :3].T + T[:3, 3])
            view = eye - points
            cosine = (view * normals).sum(1) / np.linalg.norm(view, axis=1)
            hidden = (cosine < 0.2) & ~internal
            hidden |= (uv < 4).any(1) | (uv > np.array(camera.size) - 5).any(1)
            if T_probe is not None and self.probe is not None:
                hidden |= behind(points, eye, T_probe, self.probe)
            uv[hidden] = np.nan
            out[:, 2 * c : 2 * c + 2] = uv
        noise = self.seen.noise_px * np.where(self.rng.uniform(size=(len(points), 1)) < self.seen.jitter, 3.0, 1.0)
        return out + noise * self.rng.normal(size=out.shape)


def behind(points: Array, eye: Array, T_probe: Array, shape: TruthProbe, margin: float = 0.002) -> NDArray[np.bool_]:
    """Return whether the probe hides each point from ``eye``: the line of sight passes it within ``margin``."""
    s = np.linspace(0.0, 0.5, 60)
    s = s[s * np.linalg.norm(eye - points.mean(0)) > 0.003]
    line = points[:, None] + s[None, :, None] * (eye - points)[:, None]
    local = (line.reshape(-1, 3) - T_probe[:3, 3]) @ T_probe[:3, :3]
    return np.asarray((shape.distance(local)[0].reshape(len(points), -1) < margin).any(1), dtype=bool)
