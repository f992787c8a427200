"""Tell whether recordings hold enough to be diagnosed at all; what they lack is said in one line."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from livedeform.closed_loop.evidence.observation import Observation
from livedeform.closed_loop.settings import Settings
from livedeform.common.errors import RecordingError
from livedeform.common.types import Array

LEAST_MARKERS = 4  # three place a rigid body; what deforms needs one more
LEAST_MOMENTS = 2  # of a recording that the probe presses: one before and one in the press


def check_enough(fitted: Sequence[Observation], held_out: Sequence[Observation]) -> None:
    """Raise ``RecordingError`` where markers, moments or contact are too few to fit something or to test it."""
    for o in (*fitted, *held_out):
        _check_markers(o)
    if not held_out:
        raise RecordingError("nothing is held out to test on", remedy="name a recording with --test")
    pressed = [o for o in fitted if o.path]
    for o in pressed:
        if o.n_moments < LEAST_MOMENTS:
            raise RecordingError(
                f"only {o.n_moments} moment of the recording can be fitted", where=o.name, remedy="record a whole press"
            )


def check_contact(fitted: Sequence[Observation], motion: Array, settings: Settings) -> None:
    """Raise ``RecordingError`` where there is a probe, and neither the model's markers, which move by ``motion`` (k, m)
    m, nor the measured ones move."""
    pressed, limit = [o for o in fitted if o.path], settings.sampling.moved
    moves = motion.max(initial=0.0) > settings.allowance.still
    if len(pressed) < len(fitted) or moves or any(has_moved(o, limit) for o in fitted):
        return
    raise RecordingError(
        "the probe moves no marker, neither in the model nor beyond the noise: there is no contact to learn from",
        where=", ".join(o.name for o in pressed),
        remedy="press deeper, or check the frame of the probe's poses",
    )


def _check_markers(o: Observation) -> None:
    if not o.n_moments:
        raise RecordingError(
            "no moment is left of the recording to fit or to test on",
            where=o.name,
            remedy="record longer, or name a recording with --test",
        )
    seen = int(np.isfinite(o.points).all(axis=2).any(axis=0).sum())
    if seen < LEAST_MARKERS:
        said = "no marker is ever seen" if not seen else f"only {seen} of the experiment's markers are ever seen"
        raise RecordingError(
            f"{said}, {LEAST_MARKERS} are needed",
            where=o.name,
            remedy="check the markers' ids and the topic /stereo/markers with `livedeform info`",
        )


def has_moved(o: Observation, limit: float) -> bool:
    """Tell whether the markers are elsewhere at some moment than at the first one, by ``limit`` sigmas of chi2."""
    return bool((_departure(o) > limit).any())


def _departure(o: Observation) -> Array:
    """Count the sigmas of chi-square by which each moment (k,) differs from the first."""
    out = np.zeros(o.n_moments)
    for k in range(1, o.n_moments):
        d = o.points[k] - o.points[0]
        both = np.isfinite(d).all(axis=1)
        if both.any():
            noise = np.linalg.inv(o.covariances[k][both] + o.covariances[0][both])
            size = float(np.einsum("mi,mij,mj->", d[both], noise, d[both]))
            out[k] = (size - 3.0 * both.sum()) / np.sqrt(6.0 * both.sum())
    return out
