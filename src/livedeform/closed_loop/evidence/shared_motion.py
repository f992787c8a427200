"""Tell motion, which markers have in common, from noise, which each has for itself.

A body moves its markers together: however they are pressed, their courses in time are mixtures of a few. Noise of
measuring is another one for each marker. The courses that two halves of the markers share (inter-battery factor
analysis, Tucker 1958) are taken off all of them one after another, each as long as it is shared by more than courses of
the same spectrum with random phases are (surrogates, Theiler et al. 1992). What remains is noise, whether the probe was
moving or not, and however the noise is correlated in time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft
from scipy.linalg import solveh_banded

from livedeform.closed_loop.settings import NoiseSettings
from livedeform.common.types import Array

TINY = 1e-30


@dataclass(frozen=True)
class Unshared:
    """The part that ``markers`` (q,), numbers of those that are seen often enough, do not share: ``residual`` (f, q, 3)
    m, NaN where not seen; ``courses`` (f, r), orthonormal, that were taken off, a constant among them; ``speed`` (f,)
    of the shared part, m rms per frame."""

    markers: np.ndarray
    residual: Array
    courses: Array
    speed: Array

    def kept(self, seconds: Array, tau: float, lags: int, frames: np.ndarray) -> Array:
        """Find the covariances (lags + 1,) that the residual of noise has whose variance is one and whose correlation
        between ``seconds`` (f,) fades as exp(-dt / tau), white with a ``tau`` of 0 s, on average over pairs of
        ``frames`` (f,) so many frames apart: what the courses took with them is missing."""
        C, among = self.courses, frames.astype(float)
        RC = _faded(C, np.exp(-np.diff(seconds) / tau)) if tau > 0.0 else C
        inner = 0.5 * (C.T @ RC)
        half = RC - C @ inner  # M R M = R - C half^T - half C^T
        C, half = among[:, None] * C, among[:, None] * half
        lost = lagged(C, half, lags) + lagged(half, C, lags)
        pairs = np.rint(lagged(among, among, lags))
        out = np.divide(_fading(seconds, tau, lags, among) - lost, pairs, out=np.zeros(lags + 1), where=pairs > 0.0)
        # one direction in space goes with each course that the data themselves chose
        kept: float = max(1.0 - (C.shape[1] - 1) / (3.0 * len(self.markers)), 0.0)
        return out * kept


def lagged(a: Array, b: Array, lags: int) -> Array:
    """Sum (lags + 1,) the products of ``a`` (f, ...) and ``b`` (f, ...) so many frames later, over frames and columns;
    by Fourier transforms, as a loop would grow with the square of a tracker's rate."""
    n = next_fast_len(len(a) + lags, real=True)
    spectra = [rfft(x.reshape(len(x), -1), n=n, axis=0) for x in (a, b)]
    return np.asarray(irfft((spectra[0].conj() * spectra[1]).sum(axis=1), n=n)[: lags + 1])


def _fading(seconds: Array, tau: float, lags: int, among: Array) -> Array:
    """Sum (lags + 1,) correlations that fade by exp(-dt / tau) over pairs of frames so many frames apart, of those that
    are ``among`` (f,) what counts."""
    out, part = np.zeros(lags + 1), among.copy()
    step = np.exp(-np.diff(seconds) / tau) if tau > 0.0 else np.zeros(len(seconds) - 1)
    for k in range(lags + 1):
        n = len(among) - k
        out[k] = part[:n] @ among[k:]
        part = part[: n - 1] * step[k:]
        if not part.max(initial=0.0) > TINY:
            break
    return out


def _faded(courses: Array, step: Array) -> Array:
    """Multiply ``courses`` (f, r) by the correlations (f, f) in time that fade by ``step`` (f - 1,) from frame to
    frame. Their matrix would grow with the square of the frames; its inverse has three diagonals (a Markov process)."""
    left = 1.0 - step**2
    diagonal = np.r_[1.0, 1.0 / left] + np.r_[step**2 / left, 0.0]
    return np.asarray(solveh_banded(np.array([np.r_[0.0, -step / left], diagonal]), courses))


def unshared(points: Array, settings: NoiseSettings, *, seed: int = 0) -> Unshared | None:
    """Take the shared motion off ``points`` (f, m, 3) m; None where there are too few markers or frames to share."""
    seen: NDArray[np.bool_] = np.asarray(np.isfinite(points).all(axis=2))
    often = np.flatnonzero(seen.mean(axis=0) >= settings.often_seen) if len(points) else np.zeros(0, int)
    if len(often) < settings.least_markers or len(points) < settings.least_shared_frames:
        return None
    seen = seen[:, often]
    y = _filled(points[:, often], seen)
    wild = _wild(y, settings)
    seen = seen & ~wild
    y = _filled(np.where(seen[..., None], y, np.nan), seen)
    f, q, _ = y.shape
    flat = y.reshape(f, 3 * q) - y.reshape(f, 3 * q).mean(axis=0)
    flat = flat - flat.mean(axis=0)
    scale = np.sqrt(np.median(np.diff(flat, 2, axis=0) ** 2, axis=0)) + settings.tiny_length
    courses = _shared_courses(flat / scale, np.repeat(np.arange(q) % 2, 3), settings, seed)
    if courses is None:
        return None
    shared = courses @ (courses.T @ flat)
    residual = (flat - shared).reshape(f, q, 3)
    speed = np.sqrt(np.mean(np.gradient(shared, axis=0) ** 2, axis=1) * 3.0)
    return Unshared(
        often,
        np.where(seen[..., None], residual, np.nan),
        np.column_stack([np.full(f, 1.0 / np.sqrt(f)), courses]),
        speed,
    )


def _shared_courses(flat: Array, half: np.ndarray, settings: NoiseSettings, seed: int) -> Array | None:
    """Find orthonormal courses (f, r) that the columns (f, p) of both halves share; None where there are more of them
    than so few columns or frames can tell from noise."""
    rng = np.random.default_rng(seed)
    a, b = flat[:, half == 0], flat[:, half == 1]
    most = int(settings.most_shared * min(a.shape))
    ones, twos = np.zeros((len(flat), 0)), np.zeros((len(flat), 0))
    while True:
        together = a.T @ b
        if np.linalg.norm(together) <= max(_by_chance(a, b, twos, rng, settings.surrogates), TINY):
            break
        if ones.shape[1] >= most:
            return None
        u, _, vt = np.linalg.svd(together, full_matrices=False)
        # each half loses its own course: with a common one, the noise of either would go into both
        one, two = a @ u[:, 0], b @ vt[0]
        one, two = one / np.linalg.norm(one), two / np.linalg.norm(two)
        a, b = a - np.outer(one, one @ a), b - np.outer(two, two @ b)
        ones, twos = np.column_stack([ones, one]), np.column_stack([twos, two])
    # what both have found, without the differences, which are noise
    u, _, _ = np.linalg.svd(np.column_stack([ones, twos]), full_matrices=False)
    return np.asarray(u[:, : ones.shape[1]])


def _by_chance(a: Array, b: Array, gone: Array, rng: np.random.Generator, n: int) -> float:
    """Find the largest norm of a^T b of ``n`` surrogates of ``a``: random phases, common to its columns, and as large
    as it is in what b has left without the courses that are ``gone`` (f, r)."""
    spectrum = np.fft.rfft(a, axis=0)
    largest = 0.0
    for _ in range(n):
        turn = np.exp(2j * np.pi * rng.random(len(spectrum)))
        turn[0] = 1.0
        surrogate = np.fft.irfft(spectrum * turn[:, None], n=len(a), axis=0)
        surrogate -= gone @ (gone.T @ surrogate)
        size = float(np.linalg.norm(a)) / max(float(np.linalg.norm(surrogate)), TINY)
        largest = max(largest, size * float(np.linalg.norm(surrogate.T @ b)))
    return largest


def _filled(y: Array, seen: np.ndarray) -> Array:
    """Bridge what is not seen by straight lines in time."""
    out, t = y.copy(), np.arange(len(y))
    for i in np.flatnonzero(~seen.all(axis=0)):
        ok = seen[:, i]
        for axis in range(3):
            out[~ok, i, axis] = np.interp(t[~ok], t[ok], y[ok, i, axis])
    return out


def _wild(y: Array, settings: NoiseSettings) -> np.ndarray:
    """Return which points (f, m) are far off the straight line between their neighbours in time, by the marker's own
    measure."""
    d = np.zeros(y.shape[:2])
    d[1:-1] = np.linalg.norm(y[1:-1] - 0.5 * (y[2:] + y[:-2]), axis=2)
    usual = np.median(d[1:-1], axis=0) + settings.tiny_length
    # a wild point also shows at its neighbours, by half
    local = np.maximum(np.r_[d[1:], d[-1:]], np.r_[d[:1], d[:-1]])
    return np.asarray((d > settings.wild * usual) & (d > local))
